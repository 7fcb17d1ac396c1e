"""Slots through a picture that is known from the frames before.

What strip s of column c sees on a row is z = floor + T * sum over k of K[s, k] * m[c + k], with T the picture, K the
light spread and m the exposure-averaged slots of the columns (see `rxcli.channel`). In a clip T is known: the sum over
frames of z against what was expected. Then all columns' m of a row are one small linear system, solved for all rows at
once: no crosstalk is left, strips are pooled by what they tell, and every column is a single series with a precision.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.protocol import slot_patterns
from rxcli.types import BoolArray, Clock, Float32Array, FloatArray

#: Share of its weight that a frame keeps with every frame after it.
_MEMORY = 0.95
#: Weight of the picture around a row against one frame's look at the row itself at full light.
_SMOOTH = 0.05
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
#: A column's light further than this beyond dark or lit is not to be trusted.
_BEYOND = 0.15


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
        floor: light of a dark slot.
        variance: of a strip's light where it is dark.
        shot: variance per unit of light.
    """

    def __init__(self, inside: BoolArray, spread: FloatArray, floor: float, variance: float, shot: float) -> None:
        self._inside = inside.astype(np.float32)
        self._spread = spread.astype(np.float32)
        self._floor, self._variance, self._shot = np.float32(floor), np.float32(variance), np.float32(shot)
        self._light = np.zeros(inside.shape, np.float32)
        self._seen = np.zeros(inside.shape, np.float32)
        self._system: _System | None = None
        #: (C,) variance of the columns' light over what was foreseen.
        self._excess = np.ones(inside.shape[0], np.float32)

    def learn(self, light: Float32Array, slots: Float32Array, trust: Float32Array) -> None:
        """Take a frame whose slots are known into the picture.

        Args:
            light: (C, S, R).
            slots: (C, R) exposure-averaged slots, 0..1.
            trust: (C, R) 0..1.
        """
        expected = self._spread @ _with_neighbours(slots)
        trust = np.minimum.reduce(_with_neighbours(trust, 1.0), axis=1)
        weighted = expected * (trust[:, None] * self._inside)
        self._light *= np.float32(_MEMORY)
        self._light += weighted * (light - self._floor)
        self._seen *= np.float32(_MEMORY)
        self._seen += weighted * expected
        self._system = None

    def solve(self, light: Float32Array) -> ColumnLight:
        """The columns' own light in a frame.

        Args:
            light: (C, S, R).
        """
        if self._system is None:
            self._system = self._factor()
        system = self._system
        seen = self._spread.T @ (system.gain * (light - self._floor))
        right = seen[:, 1] + np.float32(_PRIOR / 2)
        right[1:] += seen[:-1, 2]
        right[:-1] += seen[1:, 0]
        shrunk = _solve(system, right)
        precision = np.maximum(system.precision - np.float32(_PRIOR), 0)
        value = shrunk + (shrunk - np.float32(0.5)) * (np.float32(_PRIOR) / np.maximum(precision, np.float32(1e-3)))
        return ColumnLight(value, self._tempered(value, precision), shrunk)

    def judge(self, seen: ColumnLight, slots: Float32Array, share: float) -> Float32Array:
        """Compare columns with what was decided; what comes next is trusted accordingly.

        Args:
            seen: as `solve` gave it.
            slots: (C, R) exposure-averaged decided slots.
            share: weight of this frame against those before, 0..1.

        Returns:
            (C,) mean squared error over the variance foreseen.
        """
        error = np.square(seen.value - slots) * seen.precision
        ratio = error.sum(axis=1) / np.maximum((seen.precision > 0).sum(axis=1), 1) / np.float32(_TEMPER)
        self._excess *= np.clip(1 + np.float32(share) * (ratio - 1), 0.25, 16.0)
        np.clip(self._excess, 0.25, 100.0, out=self._excess)
        return np.asarray(ratio)

    def moved(self, row_of: FloatArray, inside: BoolArray) -> None:
        """Follow the screen to another place.

        Args:
            row_of: (C, R) index of the row, before, of what each row shows now.
            inside: (C, S, R) as for the class, now.
        """
        n_before = self._light.shape[2]
        place = np.clip(row_of, 0, n_before - 1.001)
        left = place.astype(np.int64)[:, None]
        part = (place[:, None] - left).astype(np.float32)
        for name in ("_light", "_seen"):
            values = getattr(self, name)
            before = np.take_along_axis(values, left, 2)
            after = np.take_along_axis(values, left + 1, 2)
            setattr(self, name, before + (after - before) * part)
        self._inside = inside.astype(np.float32)
        self._system = None

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

    def _factor(self) -> _System:
        """Normal equations A m = b of every row, A symmetric with two bands: A = L D L', and the diagonal of A^-1."""
        picture, error = self.picture()
        half = np.float32(0.5) * picture
        gain = picture * self._inside / (self._variance + half * (self._shot + half * error))
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
    return diagonal, first, second, 1 / inverse[:n]


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
    n = slots.shape[1]
    pad = 8
    total = np.zeros((slots.shape[0], n + 2 * pad + 1))
    np.cumsum(np.pad(slots, ((0, 0), (pad, pad)), constant_values=0.5), axis=1, out=total[:, 1:])
    half = exposure_slots / 2
    upper = _read(total, positions + (half + pad))
    return np.asarray((upper - _read(total, positions - (half - pad))) / exposure_slots, np.float32)


def _read(values: FloatArray, place: FloatArray) -> FloatArray:
    """`values` (C, n) at the places (C, R) or (1, R), linearly between."""
    place = np.clip(place, 0, values.shape[1] - 1.001)
    left = place.astype(np.int64)
    part = place - left
    if place.shape[0] == 1:
        low, high = values[:, left[0]], values[:, left[0] + 1]
    else:
        low, high = np.take_along_axis(values, left, 1), np.take_along_axis(values, left + 1, 1)
    return np.asarray(low + (high - low) * part)


def row_positions(rows: FloatArray, clock: Clock) -> FloatArray:
    """Exposure's centre of each row in slots of the grid, (C, R), or (1, R) where no column is delayed."""
    common = (rows - clock.row0) / clock.rows_per_slot
    if not clock.delay_slots.any():
        return np.asarray(common)[None]
    return np.asarray(common - clock.delay_slots[:, None])


def pattern_metrics(seen: ColumnLight, positions: FloatArray, clock: Clock, memory: int) -> FloatArray:
    """Log-likelihood of every slot pattern at every slot, (C, N + memory, patterns); see `channel.SlotLikelihoods`.

    Args:
        seen: the columns' light.
        positions: (C, R) or (1, R) exposure's centre of the rows, in slots.
        clock: the clock.
        memory: slots of memory.
    """
    if positions.shape[0] > 1:
        return np.concatenate(
            [
                pattern_metrics(
                    ColumnLight(*(part[c : c + 1] for part in (seen.value, seen.precision, seen.shrunk))),
                    positions[c : c + 1],
                    clock,
                    memory,
                )
                for c in range(positions.shape[0])
            ]
        )
    centre = positions[0]
    metric = np.floor(centre + memory / 2).astype(np.int64)
    slots = metric[:, None] + np.arange(-memory, 1)
    half = clock.exposure_slots / 2
    reach = np.minimum((centre + half)[:, None], slots + 1) - np.maximum((centre - half)[:, None], slots)
    share = np.maximum(reach, 0) / clock.exposure_slots
    levels = (share @ slot_patterns(memory).T.astype(np.float64)).astype(np.float32)
    n_metrics = clock.n_slots + memory
    use = (metric >= 0) & (metric < n_metrics)
    borders = np.searchsorted(metric[use], np.arange(n_metrics + 1))
    precision, value, levels = seen.precision[:, use], seen.value[:, use], levels[use].T
    weighted = precision * value
    out = np.empty((value.shape[0], levels.shape[0], n_metrics))
    total = np.zeros((value.shape[0], value.shape[1] + 1))
    for number, level in enumerate(levels):
        np.cumsum(weighted * level - precision * (np.float32(0.5) * level * level), axis=1, out=total[:, 1:])
        out[:, number] = np.diff(total[:, borders], axis=1)
    return np.ascontiguousarray(out.transpose(0, 2, 1))
