"""Observation physics shared by all parts of the receiver: how slots become light.

Strip s of column c, exposed around the time g (in slots), receives

    z = black level + T * (sum over k of K[s, k] * m[c + k](g)) + noise,    m(g) = sum over n of lit[n] * h(g - n)

where T is the local picture, K the `Crosstalk`, h a slot convolved with the `Exposure`, and the noise is that of the
`NoiseModel`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import NORMAL_MEDIAN, TINY, local_mean
from rxcli.protocol import HEADER
from rxcli.types import BoolArray, Float32Array, FloatArray, IntArray

#: Points over which the mean of a sample or a strip is taken.
_FINE = 32
#: Longest exposure that a memory of one slot covers, slots; those at its ends are hardly exposed.
_MEMORY_SLOTS = 1.3
#: Longest ISI memory; seven slots cover an exposure of seven.
_MAX_MEMORY = 7
#: Exposure from which no sample shows a slot by itself, so that changes of the light over a slot are looked at; and
#: one from which a packet's last slots reach beyond the header of the next, slots.
LONG_EXPOSURE_SLOTS, MAX_EXPOSURE_SLOTS = 2.3, 9.5
#: The dark slots in the middle of a header.
_DARK_FROM = HEADER.index(0, HEADER.index(1))
_DARK_TO = HEADER.index(1, _DARK_FROM)
#: Minimum variance of a dark row of a strip: dark parts of a clipped RAW file or of a starved clip show none.
MIN_VARIANCE = 1e-7
#: Largest light above black, relative to white, of a sample that counts as dark, and minimum number of those.
_DARK_LIGHT, _MIN_DARK_SAMPLES = 0.001, 50
#: Slots of the local level that changes of the light are relative to; limit of a change, in root mean squares.
_LEVEL_SLOTS, _MAX_CHANGE = 8, 1.5
#: Shortest exposure, slots, and narrowest spread of light, column pitches.
_MIN_WIDTH = 1e-3


def changes_over(
    light: Float32Array, inside: Float32Array, rows: float, sigma: float
) -> tuple[Float32Array, Float32Array]:
    """Changes of light over one slot, which are as sharp through a long exposure as the light of a short one.

    An exposure of L slots that ends one slot later has gained one slot and lost the one L slots before.

    Args:
        light: (M, R) of strips.
        inside: (M, R) 1 where it is on the screen, else 0.
        rows: of a slot.
        sigma: standard deviation of dark light.

    Returns:
        (M, R) changes against the local level, bounded; and 1 where they are on the screen.
    """
    smooth, size = local_mean(light, max(round(rows / 2), 1)), round(_LEVEL_SLOTS * rows)
    level = local_mean(light, size) / np.maximum(local_mean(inside, size), np.float32(TINY))
    n, before = light.shape[1], int(rows)
    share, change, valid = np.float32(rows - before), np.zeros_like(smooth), inside.copy()
    earlier = (1 - share) * smooth[:, 1 : n - before] + share * smooth[:, : n - before - 1]
    change[:, before + 1 :] = smooth[:, before + 1 :] - earlier
    valid[:, before + 1 :] *= inside[:, : n - before - 1]
    valid[:, : before + 1] = 0
    change *= valid / (np.maximum(level, 0) + np.float32(sigma + TINY))
    count = np.maximum(valid.sum(axis=1, keepdims=True), 1)
    change /= np.sqrt(np.square(change).sum(axis=1, keepdims=True) / count) + np.float32(TINY)
    return np.clip(change, -_MAX_CHANGE, _MAX_CHANGE), valid


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Read noise and shot noise: the variance of a sample of light x is dark_variance + shot_gain * x."""

    dark_variance: float
    shot_gain: float

    @property
    def sigma(self) -> float:
        """Standard deviation of a dark sample."""
        return float(np.sqrt(self.dark_variance))

    def of_mean(self, n: float) -> NoiseModel:
        """Noise of the mean of `n` samples."""
        return NoiseModel(self.dark_variance / n, self.shot_gain / n)

    def variance(self, light: Float32Array) -> Float32Array:
        """Variance of samples of the given light."""
        return np.maximum(light, np.float32(0)) * np.float32(self.shot_gain) + np.float32(self.dark_variance)

    def through_picture(self, picture: Float32Array, variance: Float32Array, expected: Float32Array) -> Float32Array:
        """Variance of samples of `expected` times a picture that is known with `variance`."""
        out = variance * expected
        out += np.float32(self.shot_gain) * picture
        out *= expected
        out += np.float32(self.dark_variance)
        return out


def dark_sigma(light: Float32Array, valid: Float32Array, black_level: float, min_sigma: float) -> float:
    """Standard deviation of dark samples (..., n) in order of time, from second differences; at least `min_sigma`."""
    mean = (light[..., 2:] + light[..., 1:-1] + light[..., :-2]) / 3
    dark = (mean < black_level + _DARK_LIGHT) & (valid[..., 2:] * valid[..., :-2] > 0)
    second_difference = (light[..., 2:] - 2 * light[..., 1:-1] + light[..., :-2])[dark]
    if second_difference.size < _MIN_DARK_SAMPLES:
        return min_sigma
    return max(float(np.median(np.abs(second_difference)) / (NORMAL_MEDIAN * np.sqrt(6.0))), min_sigma)


def exposure_shares(
    centre: FloatArray | Float32Array, slots: NDArray[np.integer] | FloatArray | Float32Array, exposure_slots: float
) -> FloatArray:
    """Share of an exposure in each slot.

    Args:
        centre: centre of the exposure, slots.
        slots: start times of the slots, i.e. their numbers; broadcast against `centre`.
        exposure_slots: length of the exposure, slots.
    """
    half = exposure_slots / 2
    reach = np.minimum(centre + half, slots + 1) - np.maximum(centre - half, slots)
    return np.asarray(np.maximum(reach, 0) / exposure_slots)


def sees_dark_header(places: FloatArray, exposure_slots: float) -> BoolArray:
    """Whether exposures lie in the three dark slots in the middle of a header; long ones, at most half a slot off.

    Args:
        places: centres of the exposures, slots from the start of a packet.
        exposure_slots: length of the exposures, slots.
    """
    reach = max((_DARK_TO - _DARK_FROM - exposure_slots) / 2, 0.5)
    return np.asarray(np.abs(places - (_DARK_FROM + _DARK_TO) / 2) <= reach)


def _taps(start: float, slots: FloatArray, exposure_slots: float, samples_per_slot: int) -> FloatArray:
    """(Q, slots) weight of slots in the samples of a slot that begins with the middle of an exposure at `start`."""
    fine = (np.arange(samples_per_slot * _FINE) + 0.5) / (samples_per_slot * _FINE)
    centre = start + fine.reshape(samples_per_slot, _FINE, 1)
    return np.asarray(exposure_shares(centre, slots, max(exposure_slots, _MIN_WIDTH)).mean(axis=1))


@dataclass(frozen=True, slots=True)
class Exposure:
    """Response of slots through the exposure, on a grid of Q samples per slot; a sample is a mean over its own length.

    The exposure of sample q of metric n is centred at n - memory / 2 + (q + 1/2) / Q.
    """

    #: (Q, memory + 1) weight of the slots n - memory .. n in sample q of metric n.
    taps: FloatArray
    #: Slots of these before those in which an exposure starts: the memory, or none.
    n_before: int

    @staticmethod
    @cache
    def by_start(exposure_slots: float, samples_per_slot: int) -> Exposure:
        """The response on a grid where exposures start: taps (Q, reach + 1) of the slots n .. n + reach."""
        length = max(exposure_slots, _MIN_WIDTH)
        return Exposure(_taps(length / 2, np.arange(np.ceil(length) + 1), length, samples_per_slot), 0)

    @staticmethod
    def of(exposure_slots: float, samples_per_slot: int) -> Exposure:
        """Build the response of an exposure, with the shortest ISI memory that covers it.

        Args:
            exposure_slots: length of the exposure, slots.
            samples_per_slot: samples per slot, Q.
        """
        # Odd, so that metrics lie between samples; the slots at both ends are hardly exposed.
        isi_memory = int(np.clip(2 * np.ceil((exposure_slots - _MEMORY_SLOTS) / 2) + 1, 1, _MAX_MEMORY))
        taps = _taps(-isi_memory / 2, np.arange(-isi_memory, 1.0), exposure_slots, samples_per_slot)
        return Exposure(taps, isi_memory)

    @property
    def isi_memory(self) -> int:
        """Number of earlier slots that a metric depends on; odd, so that metrics lie between samples."""
        return int(self.taps.shape[1]) - 1

    @property
    def samples_per_slot(self) -> int:
        """Samples a slot."""
        return int(self.taps.shape[0])

    def mean_light(self, lit: Float32Array) -> Float32Array:
        """(C, N * Q) mean of slots (C, N), or of their probabilities, over the exposure; 0.5 beyond the ends."""
        (q, n_taps), n = self.taps.shape, lit.shape[1]
        padded = np.pad(lit, ((0, 0), (self.n_before, n_taps - 1)), constant_values=0.5)
        windows = np.lib.stride_tricks.sliding_window_view(padded, n_taps, axis=1)
        light = (windows @ self.taps.T.astype(np.float32)).reshape(len(lit), -1)
        skip = self.n_before * q // 2
        return np.ascontiguousarray(light[:, skip : skip + n * q], np.float32)


def column_light(n_strips: int, n_columns: int, light_spread: float) -> FloatArray:
    """(M, C) light of every column at the centres of equal strips of a screen, relative to the brightest in each strip.

    Args:
        n_strips: strips of the screen, M.
        n_columns: columns of the screen, C.
        light_spread: standard deviation of the Gaussian profile of a column's light, column pitches.
    """
    place = (np.arange(n_strips) + 0.5) / n_strips * n_columns
    square = (place[:, None] - np.arange(n_columns) - 0.5) ** 2
    return np.asarray(np.exp((square.min(axis=1, keepdims=True) - square) / (2 * max(light_spread, _MIN_WIDTH) ** 2)))


@dataclass(frozen=True, slots=True)
class Crosstalk:
    """Light of the adjacent columns in each strip of a column."""

    #: (S, 3) share of the light of the columns to the left, of the column itself and to the right, in each strip.
    shares: FloatArray

    @staticmethod
    def of(n_strips: int, light_spread: float, tails: float = 0.0, offset: float = 0.0) -> Crosstalk:
        """Crosstalk of a Gaussian light profile with a standard deviation of `light_spread` pitches.

        The shares of a strip add up to 1, because the picture contains any common factor.

        Args:
            n_strips: strips of a column.
            light_spread: standard deviation, column pitches.
            tails: weight of shares of a profile twice as wide, as diffusers have tails.
            offset: columns by which the strips lie to the right of their places.
        """
        if tails:
            widths = (light_spread, 2 * light_spread)
            near, wide = (Crosstalk.of(n_strips, width, offset=offset).shares for width in widths)
            return Crosstalk(near + tails * (wide - near))
        across = (np.arange(n_strips * _FINE) + 0.5) / (n_strips * _FINE) - 0.5 + offset
        distance = across[:, None] - np.arange(-1, 2)
        exponent = (-(distance**2) / (2 * max(light_spread, _MIN_WIDTH) ** 2)).reshape(n_strips, -1, 3)
        # A strip receives the mean over its width: a strip of a whole column has twice the crosstalk of its centre.
        weight = np.exp(exponent - exponent.max(axis=(1, 2), keepdims=True)).mean(axis=1)
        return Crosstalk(np.asarray(weight / weight.sum(axis=1, keepdims=True)))

    @property
    def own(self) -> Float32Array:
        """(1, S, 1) share of a column's own light in its strips."""
        return self.shares[None, :, 1, None].astype(np.float32)

    def from_neighbours(
        self, light: Float32Array, columns: NDArray[np.int64], delays: FloatArray | None = None
    ) -> Float32Array:
        """(len(columns), S, n) light of the adjacent columns in each strip of some columns.

        Args:
            light: (C, n) of all columns.
            columns: numbers of the columns.
            delays: (C,) of the columns, samples; none by default.
        """
        left, right = np.zeros_like(light), np.zeros_like(light)
        left[1:], right[:-1] = light[:-1], light[1:]
        if delays is not None and delays.any():
            ahead = np.diff(delays)
            left[1:], right[:-1] = _shifted(left[1:], ahead), _shifted(right[:-1], -ahead)
        shares = self.shares.astype(np.float32)
        return left[columns, None] * shares[None, :, 0, None] + right[columns, None] * shares[None, :, 2, None]

    def against_middle(self) -> Float32Array:
        """(1, S, 1) a column's own light in each strip relative to its centre.

        The shares of a Gaussian determine the position of a strip x: the second difference of their logarithms is
        1 / sigma**2, the first is x / sigma**2.
        """
        log = np.log(np.maximum(self.shares, TINY))
        curvature = np.maximum(2 * log[:, 1] - log[:, 0] - log[:, 2], TINY)
        slope = (log[:, 2] - log[:, 0]) / 2
        return np.asarray(np.exp(-np.square(slope) / (2 * curvature)), np.float32)[None, :, None]


def _shifted(rows: Float32Array, by: FloatArray) -> Float32Array:
    """Each row read `by` samples later, linearly interpolated."""
    index = np.arange(rows.shape[1])
    return np.stack([np.interp(index + b, index, row) for row, b in zip(rows, by, strict=True)]).astype(np.float32)


class SlotLight:
    """Light of slots (C, N), 0 dark to 1 lit, integrated between arbitrary instants; 0.5 before and after."""

    #: Number of slots before and after.
    _BEYOND = 8

    def __init__(self, slots: Float32Array) -> None:
        n_columns, n = slots.shape
        self._slots = np.full((n_columns, n + 2 * self._BEYOND + 1), 0.5, np.float32)
        self._slots[:, self._BEYOND : self._BEYOND + n] = slots
        self._total = np.zeros_like(self._slots)
        np.cumsum(self._slots[:, :-1], axis=1, out=self._total[:, 1:])

    def mean_over(self, positions: FloatArray | Float32Array, exposure_slots: float) -> Float32Array:
        """(C, R) mean over exposures centred at positions (C, R), or common ones (1, R), in slots."""
        return self.mean_and_slope(positions, exposure_slots)[0]

    def mean_and_slope(
        self, positions: FloatArray | Float32Array, exposure_slots: float
    ) -> tuple[Float32Array, Float32Array]:
        """Mean over exposures as in `mean_over`, and its derivative by time, per slot."""
        late, late_slope = self._until(positions + np.float32(exposure_slots / 2))
        early, early_slope = self._until(positions - np.float32(exposure_slots / 2))
        scale = np.float32(1 / exposure_slots)
        return (late - early) * scale, (late_slope - early_slope) * scale

    def _until(self, instants: FloatArray | Float32Array) -> tuple[Float32Array, Float32Array]:
        """Light integrated up to the instants, and the slots that contain them."""
        place = np.clip(instants + np.float64(self._BEYOND), 0, self._total.shape[1] - 1.001)
        left = place.astype(np.intp)
        slots, total = take_places(self._slots, left), take_places(self._total, left)
        return total + slots * (place - left).astype(np.float32), slots


def take_places(values: NDArray[Any], index: IntArray) -> NDArray[Any]:
    """`values` (C, n) at indices (C, R), or common ones (1, R)."""
    if index.shape[0] == 1:
        return np.asarray(values.take(index[0], axis=1))
    return np.asarray(values.ravel().take(index + (np.arange(values.shape[0]) * values.shape[1])[:, None]))
