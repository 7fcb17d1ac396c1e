"""The column grid of a screen from the coherence of its strips: which column each place of a picture belongs to.

A flat screen before a camera has its columns at `u = u0 + (a X + b Y) / (1 + g X + h Y)`, X and Y pixels from the
picture's middle over its width, after the lens has been taken off: a lens that is known, or one radial coefficient that
is estimated with the grid. `waveforms.py` fits the six numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rxcli.receiver.screen.coherence import Coherence
from rxcli.receiver.screen.comb import Comb
from rxcli.types import FloatArray, Lens

#: Standard deviations of g, h and of the radial coefficient before anything is seen: no lens left, or an unknown one.
_TILT_SD, _RADIAL_SD, _BENT_SD = 0.15, 0.004, 0.05
#: A grid's contrast counts so many times beside what it explains.
_CONTRAST_COUNTS = 3.0
_INVERSE_STEPS = 12


@dataclass(frozen=True, slots=True)
class Grid:
    """Columns as a function of the place in a picture; which of them is the screen's first is not said."""

    #: (6,) u0, a, b, g, h, and the radial coefficient, see the module's text.
    numbers: FloatArray
    width: int
    height: int
    #: Lens that is left in the picture; None: none, or one that is not known.
    lens: Lens | None
    #: Whether a lens that nobody knows bends the columns.
    bent: bool = False
    #: How much of the strips' light the waveforms of its columns explain, nats, and by how much more than with borders
    #: half a column further; 0 where it was not asked.
    explained: float = 0.0
    contrast: float = 0.0
    #: Of the likeliest grid if columns are of unlike drive: log-odds against the one that explains most. None: another.
    drive_odds: float | None = None

    @property
    def likelihood(self) -> float:
        """What tells the right grid from others, nats: finer ones explain more, but wherever their borders are."""
        return self.explained + _CONTRAST_COUNTS * self.contrast

    @classmethod
    def of_comb(cls, comb: Comb, coherence: Coherence, lens: Lens | None) -> Grid:
        """The grid that a comb shows at first sight."""
        numbers = np.array([comb.phase, comb.pitch, comb.pitch * comb.turn, -comb.across, -comb.along, 0.0])
        return cls(numbers, coherence.width, coherence.height, lens)

    @property
    def pitch_px(self) -> float:
        """Width of a column at the picture's middle, pixels."""
        return float(self.width / self.numbers[1])

    def columns_at(self, points: FloatArray) -> FloatArray:
        """(...) columns of (..., 2) pixels."""
        return columns_at(self.numbers, *_flat(points, self.width, self.height, self.lens))

    def flat(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Offsets of (..., 2) pixels from the picture's middle in picture widths, all lenses taken off."""
        x, y = _flat(points, self.width, self.height, self.lens)
        scale = 1 + self.numbers[5] * (x * x + y * y)
        return x * scale, y * scale

    def pixels_of(self, flat: FloatArray) -> FloatArray:
        """(n, 2) pixels of (n, 2) such offsets."""
        from rxcli.receiver.screen import geometry

        seen = flat
        for _ in range(_INVERSE_STEPS):
            seen = flat / (1 + self.numbers[5] * (seen**2).sum(axis=-1, keepdims=True))
        pixels = seen * self.width + np.array([(self.width - 1) / 2, (self.height - 1) / 2])
        bent = self.lens is not None and not self.lens.corrected
        return geometry.distort(pixels, self.lens) if bent and self.lens is not None else np.asarray(pixels)

    def shifted(self, columns: float) -> Grid:
        """The grid with its columns counted from another one."""
        return replace(self, numbers=self.numbers - np.array([columns, 0, 0, 0, 0, 0]))


def grid_between(corners: FloatArray, n_columns: int, size: tuple[int, int], lens: Lens | None) -> Grid:
    """The grid of a screen's columns between its corners.

    Args:
        corners: (4, 2) pixels, clockwise from the top left.
        n_columns: columns of the screen.
        size: width and height of the picture, pixels.
        lens: of the picture, where it is known.
    """
    from rxcli.receiver.screen import geometry

    width, height = size
    bent = lens is not None and not lens.corrected
    seen = np.linalg.inv(geometry.homography(geometry.undistort(corners, lens) if bent and lens else corners))
    matrix = seen @ np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1]])
    across, below = n_columns * matrix[0] / matrix[2, 2], matrix[2] / matrix[2, 2]
    u0, g, h = across[2], below[0], below[1]
    return Grid(np.array([u0, across[0] - u0 * g, across[1] - u0 * h, g, h, 0.0]), width, height, lens)


def _flat(points: FloatArray, width: int, height: int, lens: Lens | None) -> tuple[FloatArray, FloatArray]:
    """Pixels as offsets from the picture's middle in picture widths, a known lens taken off."""
    from rxcli.receiver.screen import geometry

    if lens is not None and not lens.corrected:
        points = geometry.undistort(points, lens)
    return (points[..., 0] - (width - 1) / 2) / width, (points[..., 1] - (height - 1) / 2) / width


def columns_at(numbers: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """(...) columns at (...) offsets from the picture's middle, see the module's text."""
    u0, a, b, g, h, radial = numbers
    scale = 1 + radial * (x * x + y * y)
    x, y = x * scale, y * scale
    return np.asarray(u0 + (a * x + b * y) / (1 + g * x + h * y))


def grid_slopes(numbers: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """(6, ...) slopes of the columns with the six numbers."""
    _, a, b, g, h, radial = numbers
    r2 = x * x + y * y
    x, y = x * (1 + radial * r2), y * (1 + radial * r2)
    below = 1 + g * x + h * y
    u = (a * x + b * y) / below
    by_x, by_y = (a - u * g) / below, (b - u * h) / below
    return np.stack([np.ones_like(x), x / below, y / below, -u * x / below, -u * y / below, r2 * (by_x * x + by_y * y)])


def strip_places(coherence: Coherence, lens: Lens | None) -> tuple[FloatArray, FloatArray]:
    """(W, S) offsets of the strips' middles in each window from the picture's, a known lens taken off."""
    points = np.stack(np.meshgrid(coherence.x, coherence.y), axis=-1)
    return _flat(points, coherence.width, coherence.height, lens)


def grid_prior(bent: bool) -> FloatArray:
    """(6,) precision of a grid's numbers around 0 before anything is seen."""
    radial = _BENT_SD if bent else _RADIAL_SD
    return np.array([0, 0, 0, _TILT_SD**-2, _TILT_SD**-2, radial**-2])
