"""On which rows a screen's columns have light, and where its corners lie then.

Across the columns a grid says all. Along them the screen's lines stand at right angles to the columns' at its middle,
its height follows from its aspect, and its place from where light begins and ends: there the two halves of a column
change alike, and halves on either side of a border do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rxcli.receiver.screen.coherence import Coherence
from rxcli.receiver.screen.grid import Grid
from rxcli.receiver.screen.sides import Side
from rxcli.types import Float32Array, FloatArray, IntArray

#: Places along the screen at which light is asked for, and how far beyond its ends, screen heights.
_BINS, _BEYOND = 320, 0.6
#: Strips nearer than this to a column's border, or to its middle, are left out, columns.
_MARGIN, _GAP = 0.05, 0.1
#: Light counts from this share of what the lit rows have.
_LIT_SHARE = 0.2
#: By how many standard deviations rows must lack light to be left out, and how many at most; so many more are kept,
#: screen heights.
_CLEARLY, _BARS, _MORE = 2.0, 0.45, 0.015
#: Sides are no further apart than the screen's height and this share of it.
_WHOLE = 0.035
#: Support from which top and bottom show well; how far they may be slanted against the columns, and the least distance
#: of the two and most light that they leave out, screen heights.
_SHOWS, _SLANTED, _LEAST_HEIGHT, _LEFT_OUT = 0.35, 0.06, 0.3, 0.08
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
        x, y = self.grid.flat(points)
        return np.asarray(
            (self.v0 + self.c * x + self.d * y) / (1 + self.grid.numbers[3] * x + self.grid.numbers[4] * y)
        )

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
        x += (n_columns / 2 - float(u[0])) / max(float(u[1] - u[0]), 1e-6)
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
    coherence: Coherence, grid: Grid, n_columns: int, aspect: float, row: float, sides: Sequence[Side] = ()
) -> Rows:
    """Where the light under the columns of a grid begins and ends.

    Args:
        coherence: of the picture.
        grid: counted from the screen's first column.
        n_columns: columns of the screen.
        aspect: width over height of the screen.
        row: a picture row in the middle of the light, about.
        sides: top and bottom, where stripes begin and end, taken where they show well; none: nothing is known of them.
    """
    plane = Plane.through(grid, n_columns, aspect, row)
    top, bottom = lit_range(*light_along(coherence, plane, n_columns))
    for _ in range(_ROUNDS - 1):
        middle = plane.pixels(np.array([[n_columns / 2, (top + bottom) / 2]]))[0, 1]
        plane = Plane.through(grid, n_columns, aspect, float(middle))
        top, bottom = lit_range(*light_along(coherence, plane, n_columns))
    return Rows(plane, _by_sides(plane, n_columns, sides, top, bottom), n_columns)


def _by_sides(plane: Plane, n_columns: int, sides: Sequence[Side], top: float, bottom: float) -> FloatArray:
    """(2, 2) v at the left and right end of top and bottom: by the sides where they show well, else by the light."""
    light = np.array([[top, top], [bottom, bottom]])
    if not sides:
        return light
    ends = np.array([[_meets(plane, side, u) for u in (0.0, float(n_columns))] for side in sides])
    shows = np.array([side.support >= _SHOWS for side in sides]) & (np.abs(np.diff(ends, axis=1)[:, 0]) < _SLANTED)
    height = float(np.diff(ends.mean(axis=1))[0])
    if shows.all() and _LEAST_HEIGHT < height < 1 + _WHOLE and bottom - top < height + _LEFT_OUT:
        middle = ends.mean(axis=1)
        return ends if middle[0] < (top + bottom) / 2 < middle[1] else light
    off = np.abs(ends.mean(axis=1) - light[:, 0])
    near = np.flatnonzero(shows & (off < _LEFT_OUT))
    if not near.size:
        return light
    light[near] = ends[near]
    if near.size == 1 and float(np.diff(light.mean(axis=1))[0]) > 1 + _WHOLE:
        other = 1 - int(near[0])
        light[other] = light[1 - other] + (1 if other else -1)
    return light


def _meets(plane: Plane, side: Side, u: float) -> float:
    """v where a side that runs along the rows meets the border of a column."""
    v = 0.5
    for _ in range(8):
        x, y = plane.pixels(np.array([[u, v]]))[0]
        step = plane.along(np.array([[x, side.at(float(x))], [x, y]]))
        v = float(np.clip(v + step[0] - step[1], -2, 3))
    return v


def lit_range(v: FloatArray, light: FloatArray) -> tuple[float, float]:
    """From where to where the screen has light.

    No more than its height, 1, can have light. Less is taken where it is clear and no more than bars: a few lamps in
    the dark say little of where else there may be some.
    """
    step = float(v[1] - v[0])
    noise = 1.48 * float(np.median(np.abs(np.diff(light)))) / np.sqrt(2) + 1e-9
    gain = np.concatenate([[0.0], np.cumsum(light - _LIT_SHARE * max(float(np.percentile(light, 85)), 1e-6))])
    n = min(round(1 / step), light.size)
    whole = gain[n:] - gain[:-n]
    end = int((gain - np.minimum.accumulate(gain)).argmax())
    start = int(gain[: end + 1].argmin())
    less = n - (end - start)
    clear = gain[end] - gain[start] - whole.max() > _CLEARLY * noise * np.sqrt(max(less, 1))
    if clear and _WHOLE * n < less < _BARS * n:
        more = round(_MORE * n)
        start, end = max(start - more, 0), min(end + more, light.size)
    else:
        # Many places of the screen's height may hold all of the light: it lies in the middle of it.
        start = round((start + end - n) / 2) if 0 < less < n else int(whole.argmax())
        end = start + n
    return float(v[0] + (start - 0.5) * step), float(v[0] + (end - 0.5) * step)


def light_along(coherence: Coherence, plane: Plane, n_columns: int) -> tuple[FloatArray, FloatArray]:
    """How much light the columns have along the screen.

    Returns:
        (n,) v, and how much more alike the two halves of a column are there than halves on either side of a border.
    """
    edges = np.linspace(-_BEYOND, 1 + _BEYOND, _BINS + 1)
    total, count = np.zeros(_BINS), np.zeros(_BINS)
    for window, rows in zip(coherence.changes, coherence.rows, strict=True):
        half, middle = _halves(coherence, plane.grid, float(rows.mean()), n_columns)
        light = _alike(window, half, n_columns)
        there = np.isfinite(light[:, 0]) & np.isfinite(middle)
        points = np.stack(np.broadcast_arrays(middle[there, None], rows), axis=-1)
        place = np.floor((plane.along(points) - edges[0]) / (edges[1] - edges[0]))
        good = (place >= 0) & (place < _BINS)
        total += np.bincount(place[good].astype(np.int64), light[there][good], _BINS)
        count += np.bincount(place[good].astype(np.int64), minlength=_BINS)
    return (edges[1:] + edges[:-1]) / 2, np.asarray(total / np.maximum(count, 1.0))


def _halves(coherence: Coherence, grid: Grid, row: float, n_columns: int) -> tuple[IntArray, FloatArray]:
    """(S,) half of a column that each strip lies in on a row, -1 for none; and (C,) middle of the columns, pixels."""
    u = grid.columns_at(np.stack([coherence.x, np.full(coherence.x.size, row)], axis=-1))
    column = np.floor(u).astype(np.int64)
    off = u - column
    use = (np.abs(off - 0.5) < 0.5 - _MARGIN) & (np.abs(off - 0.5) > _GAP) & (column >= 0) & (column < n_columns)
    middle = np.interp(np.arange(n_columns) + 0.5, u, coherence.x, np.nan, np.nan)
    return np.where(use, 2 * column + (off > 0.5), -1), middle


def _alike(window: Float32Array, half: IntArray, n_columns: int) -> FloatArray:
    """(C, rows) products of the halves of a column, less those with the nearer halves of its neighbours; NaN: none.

    What is alike over a distance for other reasons, as bent row noise is, drops out.
    """
    member = (half[:, None] == np.arange(2 * n_columns)).astype(np.float32)
    n = member.sum(axis=0)
    mean = ((window @ member) / np.where(n > 0, n, np.nan)).T
    left, right = mean[::2], mean[1::2]
    across = np.full((n_columns + 1, mean.shape[1]), np.nan)
    across[1:-1] = right[:-1] * left[1:]
    beside = np.stack([across[:-1], across[1:]])
    known = np.isfinite(beside)
    apart = np.where(known, beside, 0).sum(axis=0) / np.where(known.any(axis=0), known.sum(axis=0), np.nan)
    return np.asarray(left * right - apart)
