"""The column grid of a screen: the column as a function of the position in a picture.

A flat screen has its columns at `u = u0 + (a X + b Y) / (1 + g X + h Y)`. X and Y are offsets from the picture's middle
in picture widths, with lens distortion removed: that of a known lens, or of one radial coefficient estimated with the
grid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.strips import Course, flat_places
from rxcli.types import FloatArray, Lens

#: Prior standard deviations of perspective and of radial distortion.
_PERSPECTIVE_SD, _RADIAL_SD = 0.15, 0.004
#: Gauss-Newton steps to a grid through given columns; their spacing, as they lie on a smooth surface; their precision,
#: columns to the power of minus two.
_STEPS, _EVERY, _PRECISION = 4, 8, 100.0


@dataclass(frozen=True, slots=True)
class Grid:
    """Columns as a function of the position in a picture."""

    #: (6,) u0, a, b, g, h, and the radial coefficient, see the module's text.
    coefficients: FloatArray
    width: int
    height: int
    #: Known lens of the picture; None: no lens, or an unknown one.
    lens: Lens | None
    #: Log-likelihood of the strips' light that the columns' waveforms explain, and its excess over that with borders
    #: half a column further on; 0 if not computed.
    explained: float = 0.0
    contrast: float = 0.0

    @property
    def course(self) -> Course:
        """Course of the columns, without the lens."""
        _, a, b, g, h, _ = self.coefficients.tolist()
        return Course(b / a, g, h)

    @property
    def estimated_lens(self) -> Lens | None:
        """Lens with the estimated radial coefficient, or None if the lens is known."""
        if self.lens is not None:
            return None
        radial = self.coefficients[-1]
        matrix = np.array([[self.width, 0, (self.width - 1) / 2], [0, self.width, (self.height - 1) / 2], [0, 0, 1.0]])
        # `distort` goes the other way: the inverse series.
        return Lens(matrix, np.array([-radial, 3 * radial**2, 0.0, 0.0, 0.0]), corrected=False)

    def columns_at(self, points: FloatArray) -> FloatArray:
        """(...) columns of (..., 2) pixels."""
        return columns_at(self.coefficients, *flat_places(points, self.width, self.height, self.lens))

    def flat(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Offsets of (..., 2) pixels from the picture's middle in picture widths, with lens distortion removed."""
        return straightened(self.coefficients[-1], *flat_places(points, self.width, self.height, self.lens))

    def pixels_of(self, flat: FloatArray) -> FloatArray:
        """(n, 2) pixels of (n, 2) offsets, the inverse of `flat`."""
        distorted = flat
        for _ in range(geometry.INVERSE_STEPS):
            distorted = flat / (1 + self.coefficients[-1] * (distorted**2).sum(axis=-1, keepdims=True))
        pixels = distorted * self.width + np.array([(self.width - 1) / 2, (self.height - 1) / 2])
        return geometry.distort(pixels, geometry.bending(self.lens))

    def shifted(self, columns: float) -> Grid:
        """The grid with its columns renumbered from column `columns` on."""
        return replace(self, coefficients=self.coefficients - np.array([columns, 0, 0, 0, 0, 0]))


def grid_between(corners: FloatArray, n_columns: int, size: tuple[int, int], lens: Lens | None) -> Grid:
    """The grid of a screen's columns between its corners.

    Args:
        corners: (4, 2) pixels, clockwise from the top left.
        n_columns: columns of the screen.
        size: width and height of the picture, pixels.
        lens: of the picture, if known.
    """
    width, height = size
    to_screen = np.linalg.inv(geometry.homography(geometry.undistort(corners, geometry.bending(lens))))
    matrix = to_screen @ np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1]])
    across, below = n_columns * matrix[0] / matrix[2, 2], matrix[2] / matrix[2, 2]
    u0, g, h = across[2], below[0], below[1]
    return Grid(np.array([u0, across[0] - u0 * g, across[1] - u0 * h, g, h, 0.0]), width, height, lens)


def grid_through(grid: Grid, x: FloatArray, y: FloatArray, u: FloatArray) -> Grid:
    """The grid nearest to columns `u` (n,) at (n,) offsets from the picture's middle; `grid` is the start."""
    coefficients = grid.coefficients
    x, y, u = (values[::_EVERY] for values in (x, y, u))
    for _ in range(_STEPS):
        off = u - columns_at(coefficients, x, y)
        coefficients = coefficients + grid_step(
            coefficients, off, np.full(off.shape, _PRECISION), grid_slopes(coefficients, x, y)
        )
    return replace(grid, coefficients=coefficients)


def straightened(radial: float, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Offsets from the picture's middle with the radial distortion of a grid removed."""
    scale = 1 + radial * (x * x + y * y)
    return x * scale, y * scale


def columns_at(coefficients: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """(...) columns at (...) offsets from the picture's middle, see the module's text."""
    u0, a, b, g, h, radial = coefficients
    x, y = straightened(radial, x, y)
    return np.asarray(u0 + (a * x + b * y) / (1 + g * x + h * y))


def grid_slopes(coefficients: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """(6, ...) derivatives of the columns by the six coefficients."""
    _, a, b, g, h, radial = coefficients
    r2 = x * x + y * y
    x, y = straightened(radial, x, y)
    below = 1 + g * x + h * y
    u = (a * x + b * y) / below
    by_x, by_y = (a - u * g) / below, (b - u * h) / below
    return np.stack([np.ones_like(x), x / below, y / below, -u * x / below, -u * y / below, r2 * (by_x * x + by_y * y)])


def grid_step(coefficients: FloatArray, off: FloatArray, weight: FloatArray, slopes: FloatArray) -> FloatArray:
    """(6,) Gauss-Newton step of a grid's parameters that moves its columns by `off`, with the priors.

    Args:
        coefficients: (6,) of the grid.
        off: (n,) columns.
        weight: (n,) their precision.
        slopes: (6, n), see `grid_slopes`.
    """
    tilt, radial = _PERSPECTIVE_SD**-2, _RADIAL_SD**-2
    prior = np.array([0, 0, 0, tilt, tilt, radial])
    normal = (slopes * weight) @ slopes.T
    gradient = slopes @ (weight * off) - prior * coefficients
    return np.asarray(np.linalg.solve(normal + np.diag(prior + 1e-3 * np.diag(normal)), gradient))
