"""The column grid of a screen from the coherence of its strips: which column each place of a picture belongs to.

A flat screen before a camera has its columns at `u = u0 + (a X + b Y) / (1 + g X + h Y)`, X and Y pixels from the
picture's middle over its width, after the lens has been taken off: a lens that is known, or one radial coefficient that
is estimated with the grid. The six numbers follow by least squares from the coherence of all pairs of strips up to some
1.4 columns apart, from each of the best combs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rxcli.receiver.screen.coherence import Coherence
from rxcli.receiver.screen.comb import Comb, Likeness, likeness
from rxcli.types import BoolArray, Float32Array, FloatArray, IntArray, Lens

#: Distances of the pairs that are fitted, columns, and how many of them.
_NEAREST, _FURTHEST, _DISTANCES = 0.3, 1.4, 7
#: Standard deviations of g, h and of the radial coefficient before anything is seen. Lenses that are left in a picture
#: are rare, and what is left out of the model looks like one: it is let go only where that explains much more, nats.
_TILT_SD, _RADIAL_SD, _BENT_SD, _BENT_GAIN = 0.15, 0.004, 0.05, 20.0
#: Largest step of the six numbers in one iteration; a fit that changes no place by this, columns, is at its end.
_LARGEST_STEP = np.array([0.3, 1.0, 1.0, 0.1, 0.1, 0.05])
_SMALLEST_STEP, _ITERATIONS = 2e-3, 12
_N = 6
_INVERSE_STEPS = 12
#: Strips nearer to a border than this, columns, are not asked whether their column has light.
_MARGIN = 0.04


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
    #: How much better the grid explains the coherence than columns anywhere, nats; and the comb's own score.
    gain: float = 0.0
    score: float = 0.0
    #: How much of the strips' light the waveforms of its columns explain, nats; 0 where it was not asked.
    explained: float = 0.0

    @property
    def pitch_px(self) -> float:
        """Width of a column at the picture's middle, pixels."""
        return float(self.width / self.numbers[1])

    def columns_at(self, points: FloatArray) -> FloatArray:
        """(...) columns of (..., 2) pixels."""
        return _columns(self.numbers, *_flat(points, self.width, self.height, self.lens))

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


def _columns(numbers: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    u0, a, b, g, h, radial = numbers
    scale = 1 + radial * (x * x + y * y)
    x, y = x * scale, y * scale
    return np.asarray(u0 + (a * x + b * y) / (1 + g * x + h * y))


def _slopes(numbers: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """(6, ...) slopes of the columns with the six numbers."""
    _, a, b, g, h, radial = numbers
    r2 = x * x + y * y
    x, y = x * (1 + radial * r2), y * (1 + radial * r2)
    below = 1 + g * x + h * y
    u = (a * x + b * y) / below
    by_x, by_y = (a - u * g) / below, (b - u * h) / below
    return np.stack([np.ones_like(x), x / below, y / below, -u * x / below, -u * y / below, r2 * (by_x * x + by_y * y)])


def _strips(coherence: Coherence, lens: Lens | None) -> tuple[FloatArray, FloatArray]:
    """(W, S) offsets of the strips' middles in each window from the picture's, a known lens taken off."""
    points = np.stack(np.meshgrid(coherence.x, coherence.y), axis=-1)
    return _flat(points, coherence.width, coherence.height, lens)


def columns_of_strips(coherence: Coherence, grid: Grid) -> FloatArray:
    """(W, S) columns of the strips of each window."""
    return _columns(grid.numbers, *_strips(coherence, grid.lens))


def grid_slopes(coherence: Coherence, grid: Grid) -> FloatArray:
    """(6, W, S) slopes of the strips' columns with the grid's numbers."""
    return _slopes(grid.numbers, *_strips(coherence, grid.lens))


def grid_prior(bent: bool) -> FloatArray:
    """(6,) precision of a grid's numbers around 0 before anything is seen."""
    radial = _BENT_SD if bent else _RADIAL_SD
    return np.array([0, 0, 0, _TILT_SD**-2, _TILT_SD**-2, radial**-2])


@dataclass(frozen=True, slots=True)
class _Pairs:
    """The pairs of strips that a grid is fitted to."""

    #: (N,) the strips of each pair.
    i: IntArray
    j: IntArray
    #: (W, N) coherence, and that which two strips of one place would have.
    seen: Float32Array
    share: Float32Array
    #: (W, S) offsets of the strips' middles in each window, a known lens taken off.
    x: FloatArray
    y: FloatArray
    #: Precision of one pair, and what is known of the six numbers before.
    weight: float
    prior: FloatArray


def _pairs_of(coherence: Coherence, grid: Grid) -> _Pairs:
    strips = coherence.width / coherence.strip_px / float(grid.numbers[1])
    last = min(coherence.widest, int(_FURTHEST * strips))
    first = min(max(1, int(np.ceil(_NEAREST * strips))), last)
    distances = np.unique(np.round(np.linspace(first, last, _DISTANCES)).astype(np.int64))
    n = coherence.x.size
    i = np.concatenate([np.arange(n - d) for d in distances])
    j = np.concatenate([np.arange(d, n) for d in distances])
    x, y = _strips(coherence, grid.lens)
    prior = grid_prior(grid.bent)
    share = np.sqrt(coherence.lit[:, i] * coherence.lit[:, j])
    return _Pairs(i, j, coherence.pairs[:, i, j - i], share, x, y, coherence.n_rows / distances.size, prior)


def fit_grid(coherence: Coherence, comb: Comb, sigma: float, lens: Lens | None = None) -> Grid:
    """The grid that fits the coherence best, near a comb.

    Args:
        coherence: of the picture's strips.
        comb: where to begin.
        sigma: light spread of the screen, column pitches.
        lens: of the picture, where it is known; one that has been corrected counts as none, but nothing is estimated.
    """
    start = np.array([comb.phase, comb.pitch, comb.pitch * comb.turn, -comb.across, -comb.along, 0.0])
    flat = refine_grid(coherence, Grid(start, coherence.width, coherence.height, lens, score=comb.score), sigma)
    if lens is not None:
        return flat
    bent = refine_grid(coherence, replace(flat, bent=True), sigma)
    return bent if bent.gain > flat.gain + _BENT_GAIN else flat


def refine_grid(coherence: Coherence, grid: Grid, sigma: float) -> Grid:
    """A grid that is nearly right, fitted to the coherence."""
    pairs, tables = _pairs_of(coherence, grid), likeness(sigma)
    numbers = grid.numbers
    for _ in range(_ITERATIONS):
        normal, gradient = _normal(pairs, numbers, tables)
        step = np.linalg.solve(normal + 1e-2 * np.diag(np.diag(normal)), gradient)
        step = np.clip(step, -_LARGEST_STEP, _LARGEST_STEP)
        numbers = numbers + step
        if np.abs(step).max() < _SMALLEST_STEP:
            break
    return replace(grid, numbers=numbers, gain=_gain(pairs, numbers, tables))


def gain_of(coherence: Coherence, grid: Grid, sigma: float) -> float:
    """How much better a grid explains the coherence than columns anywhere, nats."""
    return _gain(_pairs_of(coherence, grid), grid.numbers, likeness(sigma))


def _normal(pairs: _Pairs, numbers: FloatArray, tables: Likeness) -> tuple[FloatArray, FloatArray]:
    """Normal equations of one step of Gauss and Newton."""
    u = _columns(numbers, pairs.x, pairs.y)
    ui, uj = u[:, pairs.i], u[:, pairs.j]
    place = tables.place((ui + uj) / 2, uj - ui)
    left = pairs.seen - pairs.share * tables.cosine.ravel().take(place)
    by_middle = pairs.share * tables.by_middle.ravel().take(place) / 2
    by_distance = pairs.share * tables.by_distance.ravel().take(place)
    slopes = _slopes(numbers, pairs.x, pairs.y).astype(np.float32)
    jacobian = slopes[:, :, pairs.i] * (by_middle - by_distance) + slopes[:, :, pairs.j] * (by_middle + by_distance)
    flat = jacobian.reshape(_N, -1)
    normal = pairs.weight * (flat @ flat.T).astype(np.float64) + np.diag(pairs.prior)
    return normal, pairs.weight * (flat @ left.ravel()).astype(np.float64) - pairs.prior * numbers


def _gain(pairs: _Pairs, numbers: FloatArray, tables: Likeness) -> float:
    """How much better the pairs are explained than without any borders, nats."""
    u = _columns(numbers, pairs.x, pairs.y)
    ui, uj = u[:, pairs.i], u[:, pairs.j]
    place = tables.place((ui + uj) / 2, uj - ui)
    anywhere = pairs.seen - pairs.share * tables.mean.take(np.minimum(tables.step(uj - ui), tables.mean.size - 1))
    left = pairs.seen - pairs.share * tables.cosine.ravel().take(place)
    return float(pairs.weight / 2 * (np.sum(anywhere**2) - np.sum(left**2)) - 0.5 * (pairs.prior * numbers**2).sum())


@dataclass(frozen=True, slots=True)
class LightMap:
    """Where strips of one column change alike and strips some columns apart do not."""

    #: Column of the first one on the map.
    first: int
    #: (W, K) what columns' strips have in common beyond what those some columns away have, and its precision.
    light: FloatArray
    precision: FloatArray

    @property
    def significance(self) -> FloatArray:
        """(K,) light of each column over all windows in standard deviations."""
        total = self.precision.sum(axis=0)
        return np.asarray((self.light * self.precision).sum(axis=0) / np.sqrt(np.maximum(total, 1e-9)))


def light_map(coherence: Coherence, grid: Grid) -> LightMap:
    """The light of every column of a grid in every window of rows."""
    points = np.stack(np.meshgrid(coherence.x, coherence.y), axis=-1)
    u = grid.columns_at(points)
    strips = coherence.width / coherence.strip_px / float(grid.numbers[1])
    first, last = int(np.floor(u.min())), int(np.floor(u.max()))
    shape = (u.shape[0], last - first + 1)
    near, far = (np.zeros((2, *shape)) for _ in range(2))
    for distance in range(max(1, round(0.15 * strips)), max(2, round(0.55 * strips)) + 1):
        ui, uj = u[:, :-distance], u[:, distance:]
        column = np.floor((ui + uj) / 2)
        within = (ui > column + _MARGIN) & (uj < column + 1 - _MARGIN)
        _add(near, column - first, coherence.pairs[:, : ui.shape[1], distance], within)
    for distance in range(round(2.2 * strips), min(round(4 * strips), coherence.widest) + 1, 2):
        ui, uj = u[:, :-distance], u[:, distance:]
        for end in (ui, uj):
            _add(far, np.floor(end) - first, coherence.pairs[:, : ui.shape[1], distance], np.ones(ui.shape, np.bool_))
    light = near[0] / np.maximum(near[1], 1) - far[0] / np.maximum(far[1], 1)
    # Pairs of a column overlap: about one in three of them counts.
    precision = coherence.n_rows * np.minimum(near[1], far[1]) / 3
    return LightMap(first, light, precision)


def _add(sums: FloatArray, column: FloatArray, values: Float32Array, where: BoolArray) -> None:
    """Add values and their number to the columns that they belong to."""
    _, windows, columns = sums.shape
    place = (np.arange(windows)[:, None] * columns + column.astype(np.int64))[where]
    sums[0] += np.bincount(place, values[where], windows * columns).reshape(windows, columns)
    sums[1] += np.bincount(place, minlength=windows * columns).reshape(windows, columns)
