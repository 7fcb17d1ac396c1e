"""Where stripe energy begins across each side of the reduced picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.receiver.screen.picture import Picture, Plane, apart, fine_step, finer
from rxcli.receiver.screen.sides import BOTTOM, INWARD, LEFT, RIGHT, TOP, Side, across, outermost_line
from rxcli.receiver.screen.stripes import LAG, MAX_SKEW, OUTSIDE_COST, Stripes, products
from rxcli.types import BoolArray, FloatArray

#: Bands of rows for the left and right sides, at most, and rows of one band, at least.
_BANDS, _BAND_ROWS = 40, 26
#: Of more strips than these every second is looked at.
_MANY_STRIPS = 240
#: Strips that begin on one and the same row may show a slot's end; together they count as this share of the side.
_ROW_TRUST = 0.05
#: Rows in which a blurred edge comes to its full strength.
_AHEAD = 8
#: Times that the window of a side is moved outwards while stripes go on there.
_MOVES_OUT = 4


@dataclass(frozen=True, slots=True)
class Reach:
    """How far from a guessed side its places are looked for, pixels."""

    out: float
    inward: float
    #: Width of the screen.
    size: float


@dataclass(frozen=True, slots=True)
class _Onsets:
    """Where stripe energy begins on K segments of one side."""

    #: (K,) place along the side, and where energy begins, picture pixels.
    t: FloatArray
    place: FloatArray
    #: (K,) energy was found; it begins inside the picture.
    observed: BoolArray
    usable: BoolArray
    #: (K,) energy is there from the window's first place on, and the picture goes on beyond it.
    earlier: BoolArray
    #: Resolution, picture pixels.
    step: float


@dataclass(frozen=True, slots=True)
class _Window:
    """A band along a side: N places from outside to inside on each of K segments, as indices into an energy map."""

    t: FloatArray
    #: (K, N) index of each place across the side.
    index: NDArray[Any]
    #: Places before the guess.
    outer: int
    origin: float
    step: float
    sign: int

    def place(self, depth: FloatArray) -> FloatArray:
        """Picture pixels of the (K,) fractional positions `depth` in the window."""
        return self.origin + self.step * (self.index[:, 0] + self.sign * depth)


def between(initial: list[Side], side: int, t: FloatArray, margin: float) -> BoolArray:
    """(K,) places along a side that lie between the neighbouring sides, by a margin."""
    before, after = (initial[LEFT], initial[RIGHT]) if across(side) else (initial[TOP], initial[BOTTOM])
    middle = initial[side].at(float(t.mean()))
    return np.asarray((t > before.at(middle) + margin) & (t < after.at(middle) - margin), np.bool_)


def fit_side(picture: Picture, plane: Plane, stripes: Stripes, initial: list[Side], side: int, reach: Reach) -> Side:
    """One side near its guess; support 0 where nothing shows."""
    for _ in range(_MOVES_OUT):
        if across(side):
            onsets = _strip_onsets(plane, stripes, initial, side, reach)
        else:
            onsets = _band_onsets(picture, plane, initial, side, reach)
        if not onsets.t.size or onsets.earlier.mean() < 0.1:
            break
        initial = [old.moved(-0.8 * reach.out * INWARD[side]) if i == side else old for i, old in enumerate(initial)]
    sign = INWARD[side]
    tolerance = max(1.5 * onsets.step, (0.0012 if across(side) else 0.002) * reach.size)
    # Where the picture ends before the screen does, a line must pass well outside.
    depth: FloatArray = sign * onsets.place - np.where(onsets.usable, 0, 3 * tolerance)
    weight: FloatArray = onsets.usable.astype(np.float64)
    if across(side):
        weight = row_trust(onsets.place, onsets.usable, onsets.step)
    slope = sign * initial[side].slope
    line = outermost_line(
        onsets.t, depth, weight, onsets.observed, tolerance, slope=slope, spread=MAX_SKEW, outside_cost=OUTSIDE_COST
    )
    cut = onsets.observed & ~onsets.usable
    if line is None or line.support < cut.mean():
        return Side(initial[side].coefficients, initial[side].middle, initial[side].half, 0.0)
    return _bend(onsets, np.array([line.slope, line.start]), depth, weight, tolerance, sign, across(side))


def row_trust(place: FloatArray, usable: BoolArray, step: float) -> FloatArray:
    """(K,) weight of every strip: many that begin on one row are one observation, a slot's end perhaps."""
    row = np.round(place / step - 0.25).astype(np.int64)
    row -= row.min(initial=0)
    count = np.convolve(np.bincount(row[usable], minlength=int(row.max(initial=0)) + 1), np.ones(3), "same")
    return np.where(usable, np.minimum(1.0, _ROW_TRUST * row.size / np.maximum(count[row], 1)), 0.0)


def _bend(
    onsets: _Onsets,
    line: FloatArray,
    depth: FloatArray,
    weight: FloatArray,
    tolerance: float,
    sign: int,
    across_side: bool,
) -> Side:
    """Let a line bend as a lens bends it, where its places cover most of the side."""
    middle, half = float(onsets.t.mean()), max(float(np.ptp(onsets.t)) / 2, 1.0)
    along = (onsets.t - middle) / half
    fit = np.array([line[0] * half, line[0] * middle + line[1]])
    near = np.zeros_like(onsets.usable)
    for _ in range(4):
        beyond = depth - np.polyval(fit, along)
        # Late beginnings pull a line inwards, nothing pulls it outwards.
        before, near = near, onsets.usable & (beyond > -2 * tolerance) & (beyond < tolerance)
        if np.array_equal(near, before):
            break
        covered = np.count_nonzero(np.bincount((along[near] * 3).round().astype(np.int64) + 3))
        if near.sum() < 5 or covered < 2:
            break
        degree = 2 if covered >= 6 and near.sum() >= 10 else 1
        powers = along[near, None] ** np.arange(degree, -1, -1)
        weighted = powers * weight[near, None]
        fit = np.linalg.solve(weighted.T @ powers + 1e-9 * np.eye(degree + 1), weighted.T @ depth[near])
    return Side(sign * fit, middle, half, float((weight * near).mean() ** 0.5 if across_side else near.mean()))


def _window(
    initial: list[Side], side: int, t: FloatArray, origin: float, step: float, reach: Reach, margin: float
) -> tuple[_Window, BoolArray]:
    """The window of a side and the (K,) segments of `t` that lie between the neighbouring sides."""
    inside = between(initial, side, t, margin)
    centre = np.round((initial[side].at(t[inside]) - origin) / step).astype(np.int64)
    outer = max(int(reach.out / step), 2)
    index = centre[:, None] + INWARD[side] * np.arange(-outer, max(int(reach.inward / step), 8))
    return _Window(t[inside], index, outer, origin, step, INWARD[side]), inside


def _strip_onsets(plane: Plane, stripes: Stripes, initial: list[Side], side: int, reach: Reach) -> _Onsets:
    """Top and bottom: the first change of every strip, which is the screen's edge where its column is lit."""
    import cv2

    # The lit screen is brighter than its bezel, so light grows inwards; from a bright wall to the bezel it shrinks.
    energies = stripes.growing if side == TOP else stripes.shrinking
    rows, n = energies.shape
    strips = np.arange(0, n, 2 if n > _MANY_STRIPS else 1)
    t = (strips.astype(np.float64) + (1 + plane.apart) / 2) * plane.fx - 0.5
    # A change spans the lag; from outside, the lit row comes last at the top and first at the bottom.
    origin = plane.fy * ((LAG - 0.5) if side == TOP else 0.5)
    window, inside = _window(initial, side, t, origin, plane.fy, reach, 0.004 * reach.size)
    if not window.t.size:
        return _no_onsets(plane.fy)
    first, last = _span(window.index, rows)
    smooth = cv2.blur(energies[first:last], (3, 1))
    valid = (window.index >= 0) & (window.index < rows)
    energy = np.where(valid, smooth[np.clip(window.index, first, last - 1) - first, strips[inside][:, None]], 0)
    level = np.maximum(max(8 * stripes.noise, 16 * stripes.floor, 2e-5), 0.06 * _plateau(energy, window.outer))
    active = energy > level[:, None]
    depth = _half_way(energy, active.argmax(axis=1))
    place = window.place(depth.astype(np.float64))
    observed = active.any(axis=1) & agreeing(place, 2.5 * plane.fy)
    usable = observed & (depth > valid.argmax(axis=1) + 1)
    return _Onsets(window.t, place, observed, usable, observed & ~usable & valid[:, 0], plane.fy)


def _plateau(energy: FloatArray, outer: int) -> FloatArray:
    """(K,) what a tenth of the places inside exceed."""
    inside = energy[:, outer:]
    rank = int(0.9 * (inside.shape[1] - 1))
    return np.asarray(np.partition(inside, rank, axis=1)[:, rank])


def _half_way(energy: FloatArray, start: NDArray[np.int64]) -> NDArray[np.int64]:
    """(K,) first place from `start` on where a change has half its later strength: the middle of a blurred edge."""
    ahead = start[:, None] + np.arange(_AHEAD)
    step = np.take_along_axis(energy, np.minimum(ahead, energy.shape[1] - 1), axis=1)
    return np.asarray(start + (step >= 0.25 * step.max(axis=1, keepdims=True)).argmax(axis=1), np.int64)


def agreeing(place: FloatArray, tolerance: float) -> BoolArray:
    """Places that two segments out of four close by share: noise stands alone."""
    n = place.size
    padded = np.full(n + 6, np.inf)
    padded[3 : n + 3] = place
    close = [np.abs(padded[shift : shift + n] - place) <= tolerance for shift in (0, 1, 5, 6)]
    return np.asarray(np.sum(close, axis=0) >= 2, np.bool_)


def _band_onsets(picture: Picture, plane: Plane, initial: list[Side], side: int, reach: Reach) -> _Onsets:
    """Left and right: where the energy of bands of rows begins and stays."""
    fx = fine_step(picture)
    n_rows, steps = plane.light.shape[0] - LAG, apart(fx)
    n_bands = int(np.clip(n_rows // _BAND_ROWS, 1, _BANDS))
    rows = n_rows // n_bands
    y = (np.arange(rows * n_bands) + (LAG - 1) / 2) * float(plane.fy)
    # A product needs light on both its columns: the outermost one says where light begins.
    origin = -0.5 if side == LEFT else fx * (steps + 1) - 0.5
    window, _ = _window(initial, side, y, origin, fx, reach, -np.inf)
    n_columns = picture.width // fx - steps
    if window.index.max() < 0 or window.index.min() >= n_columns:
        return _no_onsets(fx)
    first, last = _span(window.index, n_columns)
    product, _ = products(*finer(picture, plane, first, last + steps), steps)
    # Every row is taken along the slanted side, then bands of rows are summed.
    valid = (window.index >= first) & (window.index < last)
    column = np.clip(window.index, first, last - 1) - first
    values = np.where(valid, np.take_along_axis(product[: y.size], column, axis=1), 0).reshape(n_bands, rows, -1)
    energy, spread = values.mean(axis=1, dtype=np.float64), (values**2).mean(axis=1, dtype=np.float64)
    t = y.reshape(n_bands, rows).mean(axis=1)
    index = window.index.reshape(n_bands, rows, -1).mean(axis=1)
    bands = _Window(t, index, window.outer, origin, fx, window.sign)
    return _lasting_steps(energy, spread / rows, spread > 0, bands, between(initial, side, t, 0.004 * reach.size))


def _lasting_steps(
    energy: FloatArray, variance: FloatArray, valid: BoolArray, window: _Window, inside: BoolArray
) -> _Onsets:
    """The first step of each segment's energy that is significant over some places."""
    box = 5
    n = energy.shape[1]
    plateau = _plateau(energy, window.outer)
    energy = energy - _row_noise(energy[:, : window.outer], 0.3 * plateau)[:, None]
    ahead, ahead_variance = _ahead(energy, box), _ahead(variance, box)
    least = np.maximum(0.05 * plateau, 2e-5)[:, None]
    rising = (ahead[:, :n] > least) & (ahead[:, :n] > 4.5 * np.sqrt(np.maximum(ahead_variance[:, :n], 0) / box))
    k, start = np.arange(len(energy)), rising.argmax(axis=1)
    level = ahead[k, start + box]
    active = (energy > level[:, None] / 2) & (np.arange(n) >= start[:, None]) & (level > 0)[:, None]
    observed = rising.any(axis=1) & active.any(axis=1)
    depth = active.argmax(axis=1)
    scale = np.where(observed, level, 1.0)
    covered = np.clip(energy[k, depth] / scale, 0, 1) + np.clip(energy[k, np.maximum(depth - 1, 0)] / scale, 0, 1)
    place = window.place(depth + 1 - covered)
    usable = observed & (depth > valid.argmax(axis=1) + 1)
    earlier = observed & ~usable & valid[:, 0]
    return _Onsets(window.t[inside], place[inside], observed[inside], usable[inside], earlier[inside], window.step)


def _row_noise(outside: FloatArray, limit: FloatArray) -> FloatArray:
    """(K,) energy of the rows themselves: the median of what lies well outside, up to a limit."""
    return np.clip(np.median(outside[:, : max(outside.shape[1] // 2, 2)], axis=1), 0, np.maximum(limit, 0))


def _ahead(values: FloatArray, box: int) -> FloatArray:
    """(K, N + 2 box) mean of the `box` values from each place on; the last value goes on."""
    n = values.shape[1]
    padded = np.zeros((values.shape[0], 1 + n + 3 * box))
    padded[:, 1 : n + 1] = values
    padded[:, n + 1 :] = values[:, -1:]
    total = np.cumsum(padded, axis=1)
    return np.asarray((total[:, box:] - total[:, :-box]) / box)


def _span(index: NDArray[np.int64], n: int) -> tuple[int, int]:
    """First and last + 1 of the indices that exist."""
    first = int(np.clip(index.min(), 0, n - 1))
    return first, int(np.clip(index.max() + 1, first + 1, n))


def _no_onsets(step: float) -> _Onsets:
    nothing = np.zeros(0)
    return _Onsets(nothing, nothing, nothing > 0, nothing > 0, nothing > 0, step)
