"""Slots through a picture that is known from the frames before.

What strip s of column c sees on a row is z = floor + T * sum over k of K[s, k] * m[c + k], with T the picture, K the
light spread and m the exposure-averaged slots of the columns (see `rxcli.channel`). In a clip T is known: the sum over
frames of z against what was expected. Then all columns' m of a row are one small linear system, solved for all rows at
once: no crosstalk is left, strips are pooled by what they tell, and every column is a single series with a precision.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.protocol import HEADER, SLOTS_PER_SYMBOL, slot_patterns
from rxcli.types import BoolArray, Clock, Float32Array, FloatArray, IntArray

#: Share of its weight that a frame keeps with every frame after it.
MEMORY = 0.95
#: Weight of the picture around a row against one frame's look at the row itself at full light.
_SMOOTH = 0.05
#: Share of a strip's light in doubt, inverse, from which it says nothing of the picture.
_DOUBT = 4.0
#: Rows around, in each direction, from which the picture of a row that was never lit is taken.
_AROUND_ROWS = 4
#: Relative error of a picture taken from the rows around, and of one that was looked at well.
_AROUND_ERROR, _LEAST_ERROR = 0.3, 0.02
#: A slot's light is at 0.5 with this precision before anything is seen.
_PRIOR = 4.0
#: Rows of a slot err alike; their log-likelihoods count this much.
_TEMPER = 0.5
#: Error of a column's light, in parts of full light, that no pooling removes.
_COMMON_ERROR = 0.04
#: Slots around, in each direction, over which a strip's error is averaged, and those of them left out as its own.
_ERROR_SLOTS, _OWN_SLOTS = 20.0, 1.3
#: A column's light further than this beyond dark or lit is not to be trusted.
_BEYOND = 0.15
#: Slots to each side that a blur reaches, what is possible in the middle and at a side, and how much less is likelier.
_SIDE, _CENTRE, _AT_SIDE, _RIDGE = 0.5, (0.3, 1.3), (-0.1, 0.35), 1e-4
#: Groups of rows by their precision, and the contrast that compression may leave of theirs.
_GROUPS, _GAIN = 8, (0.15, 1.3)
#: Steps of the table of what lies between the groups.
_TABLE = 256
#: Rows of columns, about, from which a response is measured, more would tell no more; and the golden ratio, whose
#: multiples fall evenly between whole numbers.
_SAMPLES_OF_RESPONSE, _GOLDEN = 9000, 0.6180339887
#: A slot that is lit, or dark, but for this probability is sure.
_SURE = 1e-4
#: Slots beyond the grid that a position may reach.
_BEYOND_SLOTS = 8
#: Slots of the header between which it is dark, and rows of a strip, over all frames, from which its light is known.
_DARK_SLOTS, _LEAST_DARK_ROWS = (5.0, 8.0), 12
#: Rows of a single column's header that must show, that it be judged.
_LEAST_ROWS = 40
#: Largest correction of the clock at a time, slots.
_MAX_LATE = 0.4


@dataclass(frozen=True, slots=True)
class ColumnLight:
    """Light of C columns on R rows, between 0, dark, and 1, lit."""

    #: (C, R) float32.
    value: Float32Array
    #: (C, R) float32: inverse of the variance; 0 where nothing is seen.
    precision: Float32Array
    #: (C, R) float32: the value drawn to 0.5 where little is seen.
    shrunk: Float32Array


@dataclass(frozen=True, slots=True)
class _System:
    """The normal equations of all rows, factored; see `_factor`. Arrays (C, R)."""

    #: (C, S, R): what a strip's light is multiplied with.
    gain: Float32Array
    diagonal: Float32Array
    next: Float32Array
    next_but_one: Float32Array
    precision: Float32Array


class KnownPicture:
    """The picture without stripes, learned frame by frame.

    Args:
        inside: (C, S, R) the strip is on the screen there.
        spread: (S, 3) share of the light of columns -1, 0, +1 in each strip.
        floor: light of a dark slot, one for all or (C, S).
        variance: of a strip's light where it is dark.
        shot: variance per unit of light.
    """

    def __init__(
        self, inside: BoolArray, spread: FloatArray, floor: float | Float32Array, variance: float, shot: float
    ) -> None:
        self._inside = inside.astype(np.float32)
        self._spread = spread.astype(np.float32)
        self._floor = np.asarray(floor, np.float32)[..., None]
        self._variance, self._shot = np.float32(variance), np.float32(shot)
        self._light: Float32Array = np.zeros(inside.shape, np.float32)
        self._seen: Float32Array = np.zeros(inside.shape, np.float32)
        self._system: _System | None = None
        self._of_one: Float32Array | None = None
        self._picture = self._error = self._light
        #: (C,) variance of the columns' light over what was foreseen.
        self._excess = np.ones(inside.shape[0], np.float32)

    def learn(self, light: Float32Array, slots: Float32Array, trust: Float32Array, keep: float = MEMORY) -> None:
        """Take a frame whose slots are known into the picture.

        Args:
            light: (C, S, R).
            slots: (C, R) exposure-averaged slots, 0..1.
            trust: (C, R) 0..1.
            keep: share of their weight that the frames before keep.
        """
        lit, seen = self._lesson(light, slots, trust)
        self._light = self._light * np.float32(keep) + lit
        self._seen = self._seen * np.float32(keep) + seen
        self._system = None

    def without(self, light: Float32Array, slots: Float32Array, trust: Float32Array) -> KnownPicture:
        """What the other frames say alone, for a frame that was learned last or with nothing forgotten since.

        A picture learned from a frame's own light bears out whatever was decided there, wrong or right.

        Args:
            light: (C, S, R) as it was learned.
            slots: (C, R) likewise.
            trust: (C, R) likewise.
        """
        lit, seen = self._lesson(light, slots, trust)
        other = copy(self)
        other._light, other._seen = self._light - lit, np.maximum(self._seen - seen, 0)
        other._system, other._excess = None, self._excess.copy()
        return other

    def _lesson(
        self, light: Float32Array, slots: Float32Array, trust: Float32Array
    ) -> tuple[Float32Array, Float32Array]:
        """Light and light expected of a picture of 1, each weighted with the latter."""
        expected = self._spread @ _with_neighbours(slots)
        doubt = self._spread @ (1 - _with_neighbours(trust, 1.0))
        weighted = expected * np.maximum(1 - np.float32(_DOUBT) * doubt, 0) * self._inside
        return weighted * (light - self._floor), weighted * expected

    def solve(self, light: Float32Array) -> ColumnLight:
        """The columns' own light in a frame.

        Args:
            light: (C, S, R).
        """
        return self._solved(light, self._settled())

    def _settled(self) -> _System:
        """The equations of the picture as it is, made when first needed."""
        if self._system is None:
            self._system = self._factor()
        return self._system

    def solve_again(self, light: Float32Array, expected: Float32Array, rows_per_slot: float) -> ColumnLight:
        """The columns' own light once more, strips trusted as far as they show what is expected of other slots nearby.

        Were a slot's own error counted, whatever was decided of it would bear itself out.

        Args:
            light: (C, S, R).
            expected: (C, R) light that the slots decided so far give.
            rows_per_slot: rows per slot.
        """
        self._settled()
        foreseen = self._picture * (self._spread @ _with_neighbours(expected))
        error = light - self._floor - foreseen
        error *= error
        error *= self._inside
        around = np.maximum(_around(error, rows_per_slot), 0)
        around *= self._share_of_one(rows_per_slot)
        return self._solved(light, self._factor(around))

    def _share_of_one(self, rows_per_slot: float) -> Float32Array:
        """(C, S, R) inverse of how many rows `_around` adds up."""
        if self._of_one is None:
            self._of_one = np.float32(1) / (_around(self._inside, rows_per_slot) + np.float32(1e-3))
        return self._of_one

    def _solved(self, light: Float32Array, system: _System) -> ColumnLight:
        seen = self._spread.T @ (system.gain * (light - self._floor))
        right = seen[:, 1] + np.float32(_PRIOR / 2)
        right[1:] += seen[:-1, 2]
        right[:-1] += seen[1:, 0]
        shrunk = _solve(system, right)
        precision = np.maximum(system.precision - np.float32(_PRIOR), 0)
        value = shrunk + (shrunk - np.float32(0.5)) * (np.float32(_PRIOR) / np.maximum(precision, np.float32(1e-3)))
        return ColumnLight(value, self._tempered(value, precision), shrunk)

    def judge(self, seen: ColumnLight, expected: Float32Array, share: float) -> tuple[ColumnLight, float]:
        """Compare columns with what was decided; they are trusted accordingly, now and, in part, from now on.

        Args:
            seen: as `solve` gave it.
            expected: (C, R) what the decided slots give.
            share: weight of this frame against those before, 0..1.

        Returns:
            The light with its precision put right; and the median over the columns of the squared error over the
            variance foreseen.
        """
        error = np.square(seen.value - expected) * seen.precision
        ratio = error.sum(axis=1) / np.maximum((seen.precision > 0).sum(axis=1), 1) / np.float32(_TEMPER)
        now = np.clip(self._excess * ratio, 0.25, 100.0)
        self._excess += np.float32(share) * (now - self._excess)
        better = ColumnLight(seen.value, seen.precision / np.maximum(ratio, 0.5)[:, None], seen.shrunk)
        return better, float(np.median(ratio))

    def moved(self, row_of: FloatArray, inside: BoolArray) -> None:
        """Follow the screen to another place.

        Args:
            row_of: (C, R) index of the row, before, of what each row shows now.
            inside: (C, S, R) as for the class, now.
        """
        n_before = self._light.shape[-1]
        place = np.clip(row_of, 0, n_before - 1.001)[:, None]
        left: IntArray = place.astype(np.int64)
        part = (place - left).astype(np.float32)
        for name in ("_light", "_seen"):
            values = getattr(self, name)
            before = np.take_along_axis(values, left, 2)
            after = np.take_along_axis(values, left + 1, 2)
            setattr(self, name, before + (after - before) * part)
        self._inside = inside.astype(np.float32)
        self._system = self._of_one = None

    def _tempered(self, value: Float32Array, precision: Float32Array) -> Float32Array:
        variance = self._excess[:, None] / np.maximum(precision, np.float32(1e-6)) + np.float32(_COMMON_ERROR**2)
        beyond = np.maximum(np.abs(value - np.float32(0.5)) - np.float32(0.5 + _BEYOND), 0)
        variance += 4 * beyond * beyond
        return np.where(precision > 1e-3, np.float32(_TEMPER) / variance, np.float32(0))

    def picture(self) -> tuple[Float32Array, Float32Array]:
        """The picture and its relative variance, (C, S, R) each."""
        around = _box(self._light, _AROUND_ROWS) / (_box(self._seen, _AROUND_ROWS) + np.float32(1e-3))
        total = self._seen + np.float32(_SMOOTH)
        picture = np.maximum(self._light + np.float32(_SMOOTH) * around, 0) / total
        unseen = np.float32(_SMOOTH * _AROUND_ERROR) / total
        return picture, unseen * unseen + np.float32(_LEAST_ERROR**2)

    def _factor(self, measured: Float32Array | None = None) -> _System:
        """Normal equations A m = b of every row, A symmetric with two bands: A = L D L', and the diagonal of A^-1."""
        if self._system is None:
            self._picture, self._error = self.picture()
        picture = self._picture
        half = np.float32(0.5) * picture
        variance = self._variance + half * (self._shot + half * self._error)
        if measured is not None:
            variance += measured
        gain = picture * self._inside / variance
        left, own, right = self._spread.T
        products = np.stack([own * own, left * left, right * right, own * right, left * own, left * right])
        power = products @ (gain * picture)
        middle = power[:, 0] + np.float32(_PRIOR)
        middle[:-1] += power[1:, 1]
        middle[1:] += power[:-1, 2]
        beside, beyond = np.zeros_like(middle), np.zeros_like(middle)
        beside[:-1] = power[:-1, 3] + power[1:, 4]
        beyond[:-2] = power[1:-1, 5]
        return _System(gain, *_factored(middle, beside, beyond))


def _with_neighbours(columns: Float32Array, edge: float = 0.0) -> Float32Array:
    """(C, 3, R): each column between its neighbours."""
    padded = np.pad(columns, ((1, 1), (0, 0)), constant_values=edge)
    return np.stack([padded[:-2], padded[1:-1], padded[2:]], axis=1)


def _around(values: Float32Array, rows_per_slot: float) -> Float32Array:
    """Sum over the slots around, a row's own left out; last axis."""
    near, far = (int(slots * rows_per_slot) for slots in (_OWN_SLOTS, _ERROR_SLOTS))
    return _box(values, far) - _box(values, near)


def _box(values: Float32Array, half: int) -> Float32Array:
    """Sum over the rows at most `half` away; last axis."""
    import cv2

    flat = values.reshape(-1, values.shape[-1])
    summed = cv2.boxFilter(flat, -1, (2 * half + 1, 1), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(summed).reshape(values.shape)


def _factored(
    middle: Float32Array, beside: Float32Array, beyond: Float32Array
) -> tuple[Float32Array, Float32Array, Float32Array, Float32Array]:
    """D, the two bands of L, and the inverse of the diagonal of A^-1, of R symmetric systems (C, R) with two bands.

    A^-1 by the recursion of Takahashi, Fagan and Chin (1973): from the last column up.
    """
    n, _ = middle.shape
    diagonal, first, second = middle.copy(), np.zeros_like(middle), np.zeros_like(middle)
    for i in range(n):
        if i >= 1:
            diagonal[i] -= first[i - 1] ** 2 * diagonal[i - 1]
        if i >= 2:
            diagonal[i] -= second[i - 2] ** 2 * diagonal[i - 2]
        first[i] = beside[i]
        if i >= 1:
            first[i] -= second[i - 1] * first[i - 1] * diagonal[i - 1]
        first[i] /= diagonal[i]
        second[i] = beyond[i] / diagonal[i]
    inverse, near = np.zeros((n + 2, middle.shape[1]), np.float32), np.zeros((n + 2, middle.shape[1]), np.float32)
    for i in range(n - 1, -1, -1):
        far = -first[i] * near[i + 1] - second[i] * inverse[i + 2]
        near[i] = -first[i] * inverse[i + 1] - second[i] * near[i + 1]
        inverse[i] = 1 / diagonal[i] - first[i] * near[i] - second[i] * far
    return diagonal, first, second, np.asarray(1 / inverse[:n], np.float32)


def _solve(system: _System, right: Float32Array) -> Float32Array:
    """The solution of every row, (C, R)."""
    n = right.shape[0]
    out = right.copy()
    for i in range(1, n):
        out[i] -= system.next[i - 1] * out[i - 1]
        if i >= 2:
            out[i] -= system.next_but_one[i - 2] * out[i - 2]
    out /= system.diagonal
    for i in range(n - 2, -1, -1):
        out[i] -= system.next[i] * out[i + 1]
        if i + 2 < n:
            out[i] -= system.next_but_one[i] * out[i + 2]
    return out


def exposed(slots: Float32Array, positions: FloatArray, exposure_slots: float) -> Float32Array:
    """Mean of the slots over the exposure, (C, R).

    Args:
        slots: (C, N) values; half lit beyond.
        positions: (C, R) or (1, R) exposure's centre in slots.
        exposure_slots: exposure in slots.
    """
    return _Light(slots).between(positions, exposure_slots / 2) / np.float32(exposure_slots)


def trusted(lit: Float32Array, positions: FloatArray, exposure_slots: float) -> Float32Array:
    """(C, R) 0..1 how far rows can be learned from whose slots are lit with probability `lit`; see `exposed`."""
    doubt = lit * (1 - lit)
    each: IntArray = np.arange(len(lit))
    if len(positions) == 1:  # columns without doubt are alike
        unsure = np.flatnonzero(doubt.max(axis=1) > _SURE)
        each = np.zeros(len(lit), np.int64)
        each[unsure] = 1 + np.arange(unsure.size)
        doubt = np.concatenate([np.zeros_like(doubt[:1]), doubt[unsure]])
    trust = np.clip(1 - 8 * exposed(doubt, positions, exposure_slots), 0, 1)
    return np.asarray(trust[each], np.float32)


class _Light:
    """Slots (C, N), half lit beyond, and what they add up to.

    Args:
        slots: (C, N) values.
    """

    def __init__(self, slots: Float32Array) -> None:
        n_columns, n = slots.shape
        self._slots = np.full((n_columns, n + 2 * _BEYOND_SLOTS + 1), 0.5, np.float32)
        self._slots[:, _BEYOND_SLOTS : _BEYOND_SLOTS + n] = slots
        self._total = np.zeros_like(self._slots)
        np.cumsum(self._slots[:, :-1], axis=1, out=self._total[:, 1:])

    def between(self, positions: FloatArray, half: float) -> Float32Array:
        """(C, R) light from `half` a slot before to as much after the positions, (C, R) or (1, R)."""
        upper = self._until(positions + half)
        upper -= self._until(positions - half)
        return upper

    def _until(self, positions: FloatArray) -> Float32Array:
        place = np.clip(positions + _BEYOND_SLOTS, 0, self._total.shape[1] - 1.001)
        left = place.astype(np.intp)
        out = _taken(self._slots, left)
        out *= (place - left).astype(np.float32)
        out += _taken(self._total, left)
        return out


def _taken(values: NDArray[Any], index: IntArray) -> NDArray[Any]:
    """`values` (C, n) at the places (C, R) or (1, R)."""
    return values.take(index[0], axis=1) if index.shape[0] == 1 else np.take_along_axis(values, index, 1)


def _read(values: FloatArray, place: FloatArray) -> FloatArray:
    """`values` (C, n) at the places (C, R) or (1, R), linearly between."""
    place = np.clip(place, 0, values.shape[1] - 1.001)
    left = place.astype(np.intp)
    low = _taken(values, left)
    return np.asarray(low + (_taken(values, left + 1) - low) * (place - left))


def row_positions(rows: FloatArray, clock: Clock) -> FloatArray:
    """Exposure's centre of each row in slots of the grid, (C, R), or (1, R) where no column is delayed."""
    common = (rows - clock.row0) / clock.rows_per_slot
    if not clock.delay_slots.any():
        return np.asarray(common)[None]
    return np.asarray(common - clock.delay_slots[:, None])


@dataclass(frozen=True, slots=True)
class Response:
    """What a camera and its compression make of the exposed slots m: offset + centre m(g) + side (m(g - h) + m(g + h)),
    h being half a slot. Compression blurs stripes, frame by frame as its bits last."""

    centre: float = 1.0
    side: float = 0.0
    offset: float = 0.0

    def expected(self, lit: Float32Array, positions: FloatArray, exposure_slots: float) -> Float32Array:
        """(C, R) light that slots give; arguments as for `exposed`."""
        groups = _alike_columns(positions)
        return np.concatenate(
            [self._of_rows(lit[g], at, exposure_slots) for g, at in zip(groups, positions, strict=True)]
        )

    def _of_rows(self, lit: Float32Array, centre: FloatArray, exposure_slots: float) -> Float32Array:
        """(C, R) light that slots give to rows at `centre` (R,)."""
        reach = exposure_slots / 2 + (_SIDE if self.side else 0)
        slots = np.floor(centre - reach).astype(np.intp)[:, None] + np.arange(int(np.ceil(2 * reach)) + 1)
        share = _shares(centre, slots, exposure_slots, self)
        beyond = _BEYOND_SLOTS
        padded = np.pad(lit, ((0, 0), (beyond, beyond)), constant_values=np.float32(0.5))
        slots = np.clip(slots + beyond, 0, padded.shape[1] - 1)
        out = np.full((lit.shape[0], centre.size), self.offset, np.float32)
        for place in range(slots.shape[1]):
            out += share[:, place] * padded.take(slots[:, place], axis=1)
        return out


@dataclass(frozen=True, slots=True)
class Exposures:
    """Exposed slots of some rows, from which a response is fitted; (C, n) each."""

    #: (n,) index of the rows.
    rows: IntArray
    here: Float32Array
    #: The sum of those a little before and after, and their slope.
    beside: Float32Array
    slope: Float32Array


def exposures(lit: Float32Array, positions: FloatArray, exposure_slots: float) -> Exposures:
    """Of as many rows as tell all there is to know of the response.

    Args:
        lit: (C, N) probability that each slot is lit.
        positions: (C, R) or (1, R) exposure's centre of the rows, in slots.
        exposure_slots: exposure in slots.
    """
    n_rows = positions.shape[1]
    every = max(n_rows * lit.shape[0] / _SAMPLES_OF_RESPONSE, 1.0)
    step = np.arange(int(n_rows / every))
    # Evenly spread, but not evenly spaced: the rows must not fall on the same part of every slot.
    rows = ((step + (step * _GOLDEN if every > 1 else 0) % 1) * every).astype(np.intp)
    some = positions[:, rows]
    before, here, after = (exposed(lit, some + shift, exposure_slots) for shift in (-_SIDE, 0.0, _SIDE))
    return Exposures(rows, here, before + after, (after - before) * np.float32(0.5 / _SIDE))


@dataclass(frozen=True, slots=True)
class Fit:
    """A frame's response, fitted."""

    response: Response
    #: How many slots the clock is late.
    late: float


def fit_response(seen: ColumnLight, slots: Exposures) -> Fit:
    """The response of a frame by least squares over all columns.

    Args:
        seen: the columns' light.
        slots: what they should have seen.
    """
    value, precision = (values.take(slots.rows, axis=1).ravel() for values in (seen.value, seen.precision))
    parts = np.stack([slots.here, slots.beside, np.ones_like(slots.here), slots.slope]).reshape(4, -1)
    weighted = parts * precision
    weight = float(precision.sum()) + 1e-9
    normal, right = weighted @ parts.T / weight, weighted @ value / weight
    # Drawn, a little, to no blur.
    usual = np.array([1.0, 0.0, 0.0, 0.0])
    centre, side, offset, late = usual + np.linalg.solve(normal + _RIDGE * np.eye(4), right - normal @ usual)
    response = Response(
        float(np.clip(centre, *_CENTRE)), float(np.clip(side, *_AT_SIDE)), float(np.clip(offset, -0.2, 0.2))
    )
    return Fit(response, float(np.clip(late / max(centre + 2 * side, 0.3), -_MAX_LATE, _MAX_LATE)))


def first_decision(seen: ColumnLight, positions: FloatArray, clock: Clock) -> Float32Array:
    """(C, N) probability that each slot is lit, from the rows around its middle alone.

    Args:
        seen: the columns' light.
        positions: (C, R) or (1, R) exposure's centre of the rows, in slots.
        clock: the clock.
    """
    middles = np.arange(clock.n_slots) + 0.5
    total = np.zeros((seen.value.shape[0], seen.value.shape[1] + 1))
    np.cumsum((seen.value - np.float32(0.5)) * seen.precision, axis=1, out=total[:, 1:])
    step = positions[:, -1:] - positions[:, :1]
    rows = (middles - positions[:, :1]) * ((positions.shape[1] - 1) / step) + 0.5
    reach = 0.35 * clock.rows_per_slot
    llr = _read(total, rows + reach) - _read(total, rows - reach)
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * llr), np.float32)


def header_contrast(seen: ColumnLight, positions: FloatArray, clock: Clock) -> float:
    """Contrast of the headers where the clock has them, 1 being full and 0 none; 1 where no header shows.

    Args:
        seen: the columns' light.
        positions: (C, R) or (1, R) exposure's centre of the rows, in slots.
        clock: the clock.
    """
    place = (np.floor(positions).astype(np.int64) + clock.first_slot) % clock.packet_slots
    rows = np.flatnonzero((place < SLOTS_PER_SYMBOL).any(axis=0))
    place = place[:, rows]
    sign = np.where(place < SLOTS_PER_SYMBOL, 2.0 * np.array(HEADER)[np.minimum(place, SLOTS_PER_SYMBOL - 1)] - 1, 0)
    value, precision = (values.take(rows, axis=1) for values in (seen.value, seen.precision))
    weight = np.abs(sign) * np.minimum(precision, np.float32(_PRIOR))
    if weight.sum() < _PRIOR * _LEAST_ROWS:
        return 1.0
    return float((weight * sign * np.clip(2 * value - 1, -1.5, 1.5)).sum() / weight.sum())


def header_dark(positions: FloatArray, clock: Clock) -> BoolArray:
    """(C, R) or (1, R) rows that see nothing but the three dark slots in the middle of a header."""
    place = (positions + clock.first_slot) % clock.packet_slots
    margin = clock.exposure_slots / 2
    return np.asarray((place >= _DARK_SLOTS[0] + margin) & (place <= _DARK_SLOTS[1] - margin))


def dark_light(lights: list[Float32Array], dark: list[BoolArray], inside: BoolArray, usual: float) -> Float32Array:
    """(C, S) light of the strips where nothing is lit.

    What a black picture or a starved encoder leaves of a strip does not change with the slots: it is no picture.

    Args:
        lights: (C, S, R) each.
        dark: (C, R) or (1, R) each, from `header_dark`.
        inside: (C, S, R) as for `KnownPicture`.
        usual: what is taken where too few rows tell.
    """
    seen = [
        np.where(np.broadcast_to(rows[:, None], light.shape) & inside, light, np.float32(np.nan))[..., rows.any(axis=0)]
        for light, rows in zip(lights, dark, strict=True)
    ]
    together = np.concatenate(seen, axis=2)
    few = (~np.isnan(together)).sum(axis=2) < _LEAST_DARK_ROWS
    if together.shape[2] == 0:
        return np.full(together.shape[:2], usual, np.float32)
    together[few] = np.float32(usual)
    return np.asarray(np.nanmedian(together, axis=2), np.float32)


def evened(seen: ColumnLight, slots: Exposures) -> ColumnLight:
    """The light with its contrast put right: compression takes stripes away where they are faint, and only there.

    Rows are grouped by their precision; in each group the contrast that is left is measured against the slots.

    Args:
        seen: the columns' light.
        slots: what they should have seen.
    """
    half = np.float32(0.5)
    level = np.log(np.maximum(seen.precision, np.float32(1e-3)))
    some = level.take(slots.rows, axis=1).ravel()
    shown = np.flatnonzero(some > np.log(2e-3))
    if shown.size < 10 * _GROUPS:
        return seen
    size = shown.size // _GROUPS
    order = shown[np.argpartition(some[shown], size * np.arange(1, _GROUPS))][: size * _GROUPS]
    value = np.clip(seen.value.take(slots.rows, axis=1).ravel()[order] - half, -1.2, 1.2)
    here, beside = slots.here.ravel()[order] - half, slots.beside.ravel()[order] - 1
    model = np.stack([here, beside, np.ones_like(here)]).reshape(3, _GROUPS, size).transpose(1, 0, 2)
    normal = model @ model.transpose(0, 2, 1) / size + np.float32(1e-3) * np.eye(3, dtype=np.float32)
    right = model @ value.reshape(_GROUPS, size, 1) / size + np.float32(1e-3) * np.eye(3, 1, dtype=np.float32)
    centre, side, offset = np.linalg.solve(normal, right)[..., 0].T
    gain, middle = np.clip(centre + 2 * side, *_GAIN), np.median(some[order].reshape(_GROUPS, size), axis=1)
    gains, offsets = _interpolated(level, middle, gain, offset)
    return ColumnLight((seen.value - half - offsets) / gains + half, seen.precision * gains * gains, seen.shrunk)


def _interpolated(level: Float32Array, at: FloatArray, *values: FloatArray) -> list[Float32Array]:
    """`values`, known at ascending levels, at every `level`: by a fine table, which is quicker than `np.interp`."""
    steps = np.linspace(at[0], at[-1], _TABLE)
    step = np.float32((_TABLE - 1) / max(at[-1] - at[0], 1e-6))
    place = np.clip((level - np.float32(at[0])) * step + np.float32(0.5), 0, _TABLE - 1).astype(np.intp)
    return [np.interp(steps, at, one).astype(np.float32).take(place) for one in values]


def pattern_metrics(
    seen: ColumnLight,
    positions: FloatArray,
    clock: Clock,
    memory: int,
    response: Response,
    expected: Float32Array,
    lit: Float32Array,
) -> FloatArray:
    """Log-likelihood of every slot pattern at every slot, (C, N + memory, patterns); see `channel.SlotLikelihoods`.

    Args:
        seen: the columns' light.
        positions: (C, R) or (1, R) exposure's centre of the rows, in slots.
        clock: the clock.
        memory: slots of memory.
        response: what becomes of the exposed slots.
        expected: (C, R) light that the slots give by it.
        lit: (C, N) present idea of the slots, for what reaches beyond the memory.
    """
    value = seen.value - expected
    parts = [
        _row_metrics(value[group], seen.precision[group], centre, clock, memory, response, lit[group])
        for group, centre in zip(_alike_columns(positions), positions, strict=True)
    ]
    return np.concatenate(parts).astype(np.float64)


def _alike_columns(positions: FloatArray) -> list[slice]:
    """The columns that each row of `positions`, (C, R) or (1, R), is for."""
    return [slice(None)] if len(positions) == 1 else [slice(c, c + 1) for c in range(len(positions))]


def _row_metrics(
    value: Float32Array,
    precision: Float32Array,
    centre: FloatArray,
    clock: Clock,
    memory: int,
    response: Response,
    lit: Float32Array,
) -> Float32Array:
    """Metrics of columns whose rows lie at `centre` (R,); `value` is what the slots `lit` do not explain."""
    metric = np.floor(centre + memory / 2).astype(np.intp)
    borders = np.searchsorted(metric, np.arange(clock.n_slots + memory + 1))
    use = slice(borders[0], borders[-1])
    slots = metric[use, None] + np.arange(-memory, 1)
    share = _shares(centre[use], slots, clock.exposure_slots, response)
    value, precision = value[:, use].copy(), precision[:, use]
    padded = np.pad(lit, ((0, 0), (memory, memory)), constant_values=np.float32(0.5))
    for back in range(memory + 1):
        value += share[:, back] * padded.take(slots[:, back] + memory, axis=1)
    value *= precision
    sums, basis = _slot_sums(value, precision, share, borders - borders[0]), _pattern_basis(memory)
    metrics = sums.reshape(len(basis), -1).T @ basis
    return np.asarray(metrics.reshape(*sums.shape[1:], -1))


def _slot_sums(weighted: Float32Array, precision: Float32Array, share: Float32Array, borders: IntArray) -> Float32Array:
    """What the rows of every metric add up to: J sums of light, then of the precision of every pair of shares.

    Args:
        weighted: (C, R) light times precision.
        precision: (C, R).
        share: (R, J) share of each slot in a row.
        borders: (n + 1,) first row of every metric, and the end of the last.

    Returns:
        (J + J (J + 1) / 2, C, n).
    """
    pairs = np.triu_indices(share.shape[1])
    terms = np.concatenate([share.T, share.T[pairs[0]] * share.T[pairs[1]]])
    counts = np.diff(borders)
    sums = np.zeros((len(terms), weighted.shape[0], counts.size), np.float32)
    # The first rows of all metrics, then the second ones, and so on: long vectors, where metrics have few rows each.
    for place in range(int(counts.max(initial=0))):
        rows = np.minimum(borders[:-1] + place, weighted.shape[1] - 1)
        here = terms.take(rows, axis=1) * (place < counts)
        sums[: share.shape[1]] += here[: share.shape[1], None] * weighted.take(rows, axis=1)
        sums[share.shape[1] :] += here[share.shape[1] :, None] * precision.take(rows, axis=1)
    return sums


def _pattern_basis(memory: int) -> Float32Array:
    """(terms, patterns) how `_slot_sums` make up the log-likelihood of every pattern."""
    patterns = slot_patterns(memory).astype(np.float32)
    first, second = np.triu_indices(memory + 1)
    power = patterns[:, first] * patterns[:, second] * np.where(first == second, np.float32(0.5), np.float32(1))
    return np.ascontiguousarray(np.concatenate([patterns, -power], axis=1).T)


def _shares(centre: FloatArray, slots: IntArray, exposure_slots: float, response: Response) -> Float32Array:
    """(R, n) share of each of the `slots` (R, n) in what a row at `centre` (R,) sees."""
    share = response.centre * _overlap(centre, slots, exposure_slots)
    if response.side:
        share += response.side * _overlap(centre - _SIDE, slots, exposure_slots)
        share += response.side * _overlap(centre + _SIDE, slots, exposure_slots)
    return np.asarray(share, np.float32)


def _overlap(centre: FloatArray, slots: IntArray, exposure_slots: float) -> FloatArray:
    """Share of an exposure around `centre` (R,) that falls into each of its `slots` (R, n)."""
    half = exposure_slots / 2
    reach = np.minimum((centre + half)[:, None], slots + 1) - np.maximum((centre - half)[:, None], slots)
    return np.asarray(np.maximum(reach, 0) / exposure_slots)
