"""On which rows a screen's columns have light, and where its corners lie then.

Across the columns a grid says all. Along them the screen's lines stand at right angles to the columns' at its middle,
its height follows from its aspect, and its place from where light begins and ends: there strips are what the waveforms
of their columns predict.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rxcli.numerics import TINY
from rxcli.receiver.screen.grid import Grid, columns_at
from rxcli.receiver.screen.sides import SHOWS, Side
from rxcli.receiver.screen.waveforms import StripLight, predicted_light
from rxcli.types import Float32Array, FloatArray

#: Places along the screen at which light is asked for, and how far beyond its ends, screen heights.
_BINS, _BEYOND = 320, 0.6
#: Share of the strips, the least alike, that are taken to be without light.
_DARK_SHARE = 0.1
#: Places with less than this share of the strips that others have count in proportion.
_FEW_STRIPS = 0.5
#: Light counts from this share of what the lit rows have.
_LIT_SHARE = 0.18
#: Bars take no more than this, screen heights.
_BARS = 0.45
#: Sides are no further apart than the screen's height and this share of it.
_WHOLE = 0.035
#: How far sides may be slanted against the columns, and lie from the ends of the light, screen heights.
_SLANTED, _NEAR = 0.06, 0.08
_ROUNDS = 2


@dataclass(frozen=True, slots=True)
class Plane:
    """The coordinate along the columns, 0 at the top and 1 at the bottom: v = (v0 + c x + d y) / (1 + g x + h y)."""

    grid: Grid
    v0: float
    c: float
    d: float

    @classmethod
    def through(cls, grid: Grid, n_columns: int, aspect: float, row: float) -> Plane:
        """The plane whose middle lies on a row."""
        x, y = (float(value) for value in grid.flat(_middle_of(grid, n_columns, row)))
        _, a, b, g, h, _ = grid.numbers
        below = 1 + g * x + h * y
        u = (a * x + b * y) / below
        by_x, by_y = (a - u * g) / below, (b - u * h) / below
        c = -by_y * aspect / n_columns * below + 0.5 * g
        d = by_x * aspect / n_columns * below + 0.5 * h
        return cls(grid, float(0.5 * below - c * x - d * y), float(c), float(d))

    def along(self, points: FloatArray) -> FloatArray:
        """(...) v of (..., 2) pixels."""
        return self._along(*self.grid.flat(points))

    def along_flat(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """(...) v of places that `strip_places` gives."""
        scale = 1 + self.grid.numbers[5] * (x * x + y * y)
        return self._along(x * scale, y * scale)

    def _along(self, x: FloatArray, y: FloatArray) -> FloatArray:
        _, _, _, g, h, _ = self.grid.numbers
        return np.asarray((self.v0 + self.c * x + self.d * y) / (1 + g * x + h * y))

    def pixels(self, points: FloatArray) -> FloatArray:
        """(n, 2) pixels of (n, 2) columns and v."""
        u0, a, b, g, h, _ = self.grid.numbers
        u, v = points[:, 0] - u0, points[:, 1]
        matrix = np.empty((len(points), 2, 2))
        matrix[:, 0, 0], matrix[:, 0, 1] = a - u * g, b - u * h
        matrix[:, 1, 0], matrix[:, 1, 1] = self.c - v * g, self.d - v * h
        right = np.stack([u, v - self.v0], axis=-1)
        return self.grid.pixels_of(np.linalg.solve(matrix, right[..., None])[..., 0])


def _middle_of(grid: Grid, n_columns: int, row: float) -> FloatArray:
    """(2,) pixel of the screen's middle column on a picture row."""
    x = grid.width / 2.0
    for _ in range(8):
        u = grid.columns_at(np.array([[x, row], [x + 1, row]]))
        x += (n_columns / 2 - float(u[0])) / max(float(u[1] - u[0]), TINY)
        x = float(np.clip(x, -2 * grid.width, 3 * grid.width))
    return np.array([x, row])


@dataclass(frozen=True, slots=True)
class Rows:
    """Where the light of a screen begins and ends along its columns."""

    plane: Plane
    #: (2, 2) v of top and bottom at the left of the first and the right of the last column.
    ends: FloatArray
    n_columns: int

    def corners(self, first: int = 0) -> FloatArray:
        """(4, 2) corners, pixels, clockwise from the top left, of as many columns from another first one on."""
        u = np.array([first, first + self.n_columns], np.float64)
        top, bottom = self.ends[:, :1] + np.diff(self.ends, axis=1) * u / self.n_columns
        return self.plane.pixels(np.array([[u[0], top[0]], [u[1], top[1]], [u[1], bottom[1]], [u[0], bottom[0]]]))


def find_rows(
    strips: StripLight, grid: Grid, n_columns: int, aspect: float, row: float, sides: Sequence[Side] = ()
) -> tuple[Rows, ...]:
    """Where the screen may begin and end along the columns of a grid, likeliest first.

    Args:
        strips: of the picture.
        grid: counted from the screen's first column.
        n_columns: columns of the screen.
        aspect: width over height of the screen.
        row: a picture row in the middle of the light, about.
        sides: top and bottom, where stripes begin and end, taken where they show well; none: nothing is known of them.
    """
    plane, light_of = Plane.through(grid, n_columns, aspect, row), _PartLight.of(strips, grid, n_columns)
    for _ in range(_ROUNDS):
        top, bottom = lit_range(*light_along(light_of, plane))
        middle = plane.pixels(np.array([[n_columns / 2, (top + bottom) / 2]]))[0, 1]
        plane = Plane.through(grid, n_columns, aspect, float(middle))
    top, bottom = lit_range(*light_along(light_of, plane))
    light = np.array([[top, top], [bottom, bottom]])
    shown = _shown_sides(plane, n_columns, sides, light)
    return tuple(Rows(plane, ends, n_columns) for ends in _possible_ends(light, shown))


def _possible_ends(light: FloatArray, shown: FloatArray) -> list[FloatArray]:
    """(2, 2) ends that the screen may have, likeliest first: what has light, or more of it on either side.

    Args:
        light: (2, 2) where the light begins and ends, at the left and the right end.
        shown: (2, 2) the same by the sides; NaN for one that does not show.
    """
    sees = np.isfinite(shown).all(axis=1)
    less = 1 - float(np.diff(light.mean(axis=1))[0])
    tight = np.where(np.isfinite(shown), shown, light)
    if sees.all():
        return [tight]
    # A little more than the screen costs less than rows that are left out.
    whole = [light + less / 2 * np.array([[-1.0], [1.0]])]
    if not sees.any() and less < _WHOLE:
        return whole
    anchored = [tight[0] + np.array([[0.0], [1.0]]), tight[1] + np.array([[-1.0], [0.0]])]
    if sees.any():
        return [anchored[int(sees.argmax())], tight]
    if less < 2 * _WHOLE:
        return whole
    return [*whole, tight, *anchored] if less < _BARS else [*whole, *anchored, tight]


def _shown_sides(plane: Plane, n_columns: int, sides: Sequence[Side], light: FloatArray) -> FloatArray:
    """(2, 2) v at the left and right end of top and bottom, NaN for sides that do not show well or lie in the light."""
    ends = np.full((2, 2), np.nan)
    if not sides:
        return ends
    meets = np.array([[_meets(plane, side, u) for u in (0.0, float(n_columns))] for side in sides])
    shows = np.array([side.support >= SHOWS for side in sides]) & (np.abs(np.diff(meets, axis=1)[:, 0]) < _SLANTED)
    near = shows & (np.abs(meets.mean(axis=1) - light.mean(axis=1)) < _NEAR)
    ends[near] = meets[near]
    return ends


def _meets(plane: Plane, side: Side, u: float) -> float:
    """v where a side that runs along the rows meets the border of a column."""
    v = 0.5
    for _ in range(8):
        x, y = plane.pixels(np.array([[u, v]]))[0]
        step = plane.along(np.array([[x, side.at(float(x))], [x, y]]))
        v = float(np.clip(v + step[0] - step[1], -2, 3))
    return v


def lit_range(v: FloatArray, light: FloatArray) -> tuple[float, float]:
    """From where to where there is light, no more than a screen's height, 1."""
    step = float(v[1] - v[0])
    full = max(float(np.percentile(light[light != 0], 75)), TINY) if light.any() else TINY
    gain = np.concatenate([[0.0], np.cumsum(np.minimum(light, full) - _LIT_SHARE * full)])
    n = min(round(1 / step), light.size)
    end = int((gain - np.minimum.accumulate(gain)).argmax())
    start = int(gain[: end + 1].argmin())
    if end - start > n:
        start = int((gain[n:] - gain[:-n]).argmax())
        end = start + n
    return float(v[0] + (start - 0.5) * step), float(v[0] + (end - 0.5) * step)


@dataclass(frozen=True, slots=True)
class _PartLight:
    """How alike the strips of a screen are to what their neighbours predict, beyond what strips without light are.

    The strips of a column lie at the same place along the screen, and are taken together.
    """

    #: (P, rows), and how many strips each is the sum of.
    light: Float32Array
    n_together: int
    #: (P,) offsets of the parts from the picture's middle, and half the height of their rows, picture widths.
    x: FloatArray
    y: FloatArray
    half_height: float

    @classmethod
    def of(cls, strips: StripLight, grid: Grid, n_columns: int) -> _PartLight:
        """The light of the strips that lie on the columns of a grid."""
        u = columns_at(grid.numbers, strips.x, strips.y)
        alike = predicted_light(strips, u)
        mean = alike.mean(axis=(0, 2))
        dark = np.sort(mean)[: max(round(_DARK_SHARE * mean.size), 1)].mean()
        n_windows, n_strips, n_rows = alike.shape
        n = max(int(n_strips / max(float(np.ptp(u.mean(axis=0))), 1.0)), 1)
        whole = n_strips // n * n
        total = alike[:, :whole].reshape(n_windows, -1, n, n_rows).sum(axis=2)
        u, x, y = (values[:, :whole].reshape(n_windows, -1, n).mean(axis=2) for values in (u, strips.x, strips.y))
        inside = (u > 0) & (u < n_columns)
        light = (total - np.float32(n * max(dark, 0.0)))[inside]
        return cls(np.asarray(light, np.float32), n, x[inside], y[inside], strips.half_height)


def light_along(parts: _PartLight, plane: Plane) -> tuple[FloatArray, FloatArray]:
    """How much light the columns have along the screen: (n,) v, and the light there."""
    # A strip's rows of one window lie evenly along the screen.
    ends = np.stack([plane.along_flat(parts.x, parts.y + side * parts.half_height) for side in (-1, 1)], axis=-1)
    n_rows = parts.light.shape[1]
    share = (np.arange(n_rows) + 0.5) / n_rows
    v = ends[..., :1] + np.diff(ends) * share
    edges = np.linspace(-_BEYOND, 1 + _BEYOND, _BINS + 1)
    place = np.floor((v.ravel() - edges[0]) / (edges[1] - edges[0])).astype(np.int64)
    good = (place >= 0) & (place < _BINS)
    total = np.bincount(place[good], parts.light.ravel()[good], _BINS)
    count = parts.n_together * np.bincount(place[good], minlength=_BINS)
    # At the ends of the picture a few strips alone say little.
    enough = _FEW_STRIPS * float(np.median(count[count > 0])) if count.any() else 1.0
    return (edges[1:] + edges[:-1]) / 2, np.asarray(total / np.maximum(count, enough))
