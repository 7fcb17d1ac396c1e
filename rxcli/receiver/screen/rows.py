"""Find the rows on which a screen's columns have light, and with them its corners.

A grid determines positions across the columns. Along them, the screen's lines are at right angles to the columns at its
middle, its height follows from its aspect, and its position from the first and last light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.numerics import TINY, best_run
from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.grid import Grid, columns_at, straightened
from rxcli.receiver.screen.strips import PictureStrips
from rxcli.types import Float32Array, FloatArray

#: Bins along the screen in which light is measured, and their range beyond its ends, screen heights.
_BINS, _BEYOND = 640, 0.6
#: Share of the light of lit rows from which a row counts as lit.
_LIT_SHARE = 0.18
#: Share of missing height below which the light is taken for the whole screen; share of the light that is nearly all.
_WHOLE, _NEARLY_ALL = 0.07, 0.98
#: Focal length of a camera that no profile describes, picture widths.
_FOCAL_WIDTHS = 0.8


@dataclass(frozen=True, slots=True)
class ScreenAxis:
    """The coordinate along the columns, 0 at the top and 1 at the bottom: v = (v0 + c x + d y) / (1 + g x + h y)."""

    grid: Grid
    n_columns: int
    v0: float
    c: float
    d: float

    @classmethod
    def through(cls, grid: Grid, n_columns: int, aspect: float, row: float) -> ScreenAxis:
        """The coordinate with its middle on a row of the picture; the grid is numbered from the screen's first column.

        The vanishing line of a flat screen gives its normal, and the columns its direction across. The direction along
        the columns is at right angles to both.
        """
        u0, a, b, g, h, _ = grid.coefficients
        focal = _FOCAL_WIDTHS if grid.lens is None else float(grid.lens.camera_matrix[0, 0] / grid.width)
        depth = np.array([g * focal, h * focal, 1.0])
        normal = depth / np.linalg.norm(depth)
        across = np.array([(u0 * g + a) * focal, (u0 * h + b) * focal, u0])
        across -= (across @ normal) * normal
        c, d, v0 = np.cross(normal, across) * aspect / n_columns / np.array([focal, focal, 1.0])
        # The middle column's place on that row.
        y = (row - (grid.height - 1) / 2) / grid.width
        u = n_columns / 2 - u0
        x = (u * (1 + h * y) - b * y) / (a - u * g)
        shift = 0.5 - (v0 + c * x + d * y) / (1 + g * x + h * y)
        return cls(grid, n_columns, float(v0 + shift), float(c + shift * g), float(d + shift * h))

    def along(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """(...) v of offsets from the picture's middle, with lens distortion removed."""
        _, _, _, g, h, _ = self.grid.coefficients
        return np.asarray((self.v0 + self.c * x + self.d * y) / (1 + g * x + h * y))

    def pixels(self, points: FloatArray) -> FloatArray:
        """(n, 2) pixels of (n, 2) columns and v."""
        u0, a, b, g, h, _ = self.grid.coefficients
        to_screen = np.linalg.inv([[a, b, 0], [self.c, self.d, self.v0], [g, h, 1]])
        return self.grid.pixels_of(geometry.projected(points - [u0, 0.0], to_screen))

    def corners(self, ends: tuple[float, float], first_column: int = 0) -> FloatArray:
        """(4, 2) corners, pixels, clockwise from the top left, of the screen between two v from `first_column` on."""
        left, right = float(first_column), float(first_column + self.n_columns)
        return self.pixels(np.array([[left, ends[0]], [right, ends[0]], [right, ends[1]], [left, ends[1]]]))

    def ends_of(self, corners: FloatArray) -> tuple[float, float]:
        """v at the top and the bottom of a screen with (4, 2) corners, pixels."""
        v = self.along(*self.grid.flat(corners))
        return float(v[:2].mean()), float(v[2:].mean())


def find_rows(
    strips: PictureStrips, light: Float32Array, grid: Grid, n_columns: int, aspect: float
) -> tuple[ScreenAxis, tuple[float, float], bool]:
    """The coordinate along the columns; where the screen begins and ends; whether it is dark at its top or bottom.

    Args:
        strips: of the picture.
        light: (B, S, R) products of the strips with the waveforms predicted from their neighbours, `predicted_light`.
        grid: numbered from the screen's first column.
        n_columns: columns of the screen.
        aspect: width over height of the screen.
    """
    by_block = np.maximum(light.mean(axis=(1, 2)), 0.0)
    row = float((by_block * strips.raw_y.mean(axis=1)).sum() / max(float(by_block.sum()), TINY)) * strips.width
    row += (strips.height - 1) / 2
    axis = ScreenAxis.through(grid, n_columns, aspect, row)
    v, by_row = _light_along(strips, light, axis)
    top, bottom = lit_range(v, by_row)
    missing = 1 - (bottom - top)
    if missing > _WHOLE:
        return axis, (top - missing / 2, bottom + missing / 2), True
    # A whole screen from either end of the light: a slightly too large outline costs less than omitted rows.
    return axis, (bottom - 1, top + 1), False


def lit_range(v: FloatArray, light: FloatArray) -> tuple[float, float]:
    """Beginning and end of the light, at most one screen apart."""
    step = float(v[1] - v[0])
    full = max(float(np.percentile(light[light != 0], 75)), TINY) if light.any() else TINY
    gain, n = np.minimum(light, full) - _LIT_SHARE * full, min(round(1 / step), light.size)
    start, end = best_run(gain)
    if end - start > n:
        # The band pass smears light beyond both ends: use the middle of the positions that hold nearly all of it.
        held = np.convolve(gain, np.ones(n), "valid")
        start = round(float(np.flatnonzero(held > _NEARLY_ALL * held.max()).mean()))
        end = start + n
    return float(v[0] + (start - 0.5) * step), float(v[0] + (end - 0.5) * step)


def _light_along(strips: PictureStrips, light: Float32Array, axis: ScreenAxis) -> tuple[FloatArray, FloatArray]:
    """Light of the columns along the screen: (n,) v, and (n,) the light there.

    The strips of a column lie at the same position along the screen and are averaged.
    """
    u = columns_at(axis.grid.coefficients, strips.x, strips.y)
    n_blocks, n_strips, n_rows = light.shape
    n = max(int(n_strips / max(float(np.ptp(u, axis=1).mean()), 1.0)), 1)
    whole = n_strips // n * n
    together = light[:, :whole].reshape(n_blocks, -1, n, n_rows).mean(axis=2)
    slope = strips.course.slope(strips.raw_x, strips.raw_y)
    mixed = (u, strips.x, strips.y, slope)
    u, x, y, slope = (values[:, :whole].reshape(n_blocks, -1, n).mean(axis=2) for values in mixed)
    inside = (u > 0) & (u < axis.n_columns)
    # A strip's rows of one window lie evenly along the screen.
    radial = axis.grid.coefficients[-1]
    half = strips.half_height
    ends = [
        axis.along(*straightened(radial, (x + side * half * slope)[inside], y[inside] + side * half))
        for side in (-1, 1)
    ]
    v = ends[0][:, None] + (ends[1] - ends[0])[:, None] * (np.arange(n_rows) + 0.5) / n_rows
    extent = 1 + 2 * _BEYOND
    # One bin more at either end takes what lies beyond.
    number = np.clip((v + _BEYOND) * (_BINS / extent) + 1, 0, _BINS + 1).astype(np.int64).ravel()
    total = np.bincount(number, together[inside].ravel(), _BINS + 2)[1:-1]
    count = np.bincount(number, minlength=_BINS + 2)[1:-1]
    middles = (np.arange(_BINS) + 0.5) * (extent / _BINS) - _BEYOND
    return middles.astype(np.float64), np.asarray(total / np.maximum(count, 1), np.float64)
