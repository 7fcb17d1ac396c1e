"""How slots become light: the physics that every room of the receiver shares.

What strip s of column c sees at an exposure centred at g (in slots) is

    z = black level + T * (sum over k of K[s, k] * m[c + k](g)) + noise,    m(g) = sum over n of lit[n] * h(g - n)

with T the picture there, K the `Crosstalk`, h a slot seen through the `Exposure`, and noise that grows with light: the
`NoiseModel`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.protocol import HEADER
from rxcli.types import BoolArray, Float32Array, FloatArray, IntArray

#: The longest exposure, slots, that each memory of the trellis covers; longer ones have `MAX_MEMORY`.
_MEMORY_EXPOSURE_SLOTS = {1: 1.3, 3: 2.6}
#: Longest memory of the trellis; five slots cover an exposure of four.
MAX_MEMORY = 5
#: The dark slots in the middle of a header.
_DARK_FROM = HEADER.index(0, HEADER.index(1))
_DARK_TO = HEADER.index(1, _DARK_FROM)
#: A shutter is take_places to be open for so many slots at least.
_MIN_SLOTS = 1e-3


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """A sample of light x has variance floor + slope * x: read noise and the shot noise of light."""

    floor: float
    slope: float

    @property
    def sigma(self) -> float:
        """Standard deviation of a sample of no light."""
        return float(np.sqrt(self.floor))

    def of_mean(self, n: float) -> NoiseModel:
        """The noise of the mean of `n` samples."""
        return NoiseModel(self.floor / n, self.slope / n)

    def variance(self, light: Float32Array) -> Float32Array:
        """Variance of samples of some light."""
        return np.maximum(light, np.float32(0)) * np.float32(self.slope) + np.float32(self.floor)

    def through_picture(self, picture: Float32Array, variance: Float32Array, expected: Float32Array) -> Float32Array:
        """Variance of samples that show `expected` times a picture which is itself known with some variance."""
        out = variance * expected
        out += np.float32(self.slope) * picture
        out *= expected
        out += np.float32(self.floor)
        return out


def exposure_shares(
    centre: FloatArray | Float32Array, slots: NDArray[np.integer] | FloatArray | Float32Array, exposure_slots: float
) -> FloatArray:
    """Share of an exposure that falls into each slot.

    Args:
        centre: centre of the exposure, slots.
        slots: numbers of the slots, which begin there; broadcast against `centre`.
        exposure_slots: length of the exposure, slots.
    """
    half = exposure_slots / 2
    reach = np.minimum(centre + half, slots + 1) - np.maximum(centre - half, slots)
    return np.asarray(np.maximum(reach, 0) / exposure_slots)


def sees_dark_header(places: FloatArray, exposure_slots: float, least: float = 0.0) -> BoolArray:
    """Exposures that see nothing but the three dark slots in the middle of a header.

    Args:
        places: their centres, slots from the start of a packet.
        exposure_slots: their length.
        least: how far from the middle, slots, they count however long the exposure.
    """
    reach = max((_DARK_TO - _DARK_FROM - exposure_slots) / 2, least)
    return np.asarray(np.abs(places - (_DARK_FROM + _DARK_TO) / 2) <= reach)


@dataclass(frozen=True, slots=True)
class Exposure:
    """Slots seen through the exposure on a grid of Q samples a slot.

    Sample q of metric n has its exposure's centre at n - memory / 2 + (q + 1/2) / Q.
    """

    #: (Q, memory + 1) weight of the slots n - memory .. n in sample q of metric n.
    taps: FloatArray

    @staticmethod
    def of(
        exposure_slots: float, samples_per_slot: int, isi_memory: int | None = None, blur_slots: float | None = None
    ) -> Exposure:
        """An exposure of some slots.

        Args:
            exposure_slots: how long the shutter is open.
            samples_per_slot: samples a slot, Q.
            isi_memory: slots of memory; None for what covers the exposure.
            blur_slots: width of a further box that light is seen through; None for a sample's own length.
        """
        if isi_memory is None:
            covering = (memory for memory, most in _MEMORY_EXPOSURE_SLOTS.items() if exposure_slots <= most)
            isi_memory = next(covering, MAX_MEMORY)
        n_fine, q = 32, samples_per_slot
        offsets = ((np.arange(n_fine) + 0.5) / n_fine - 0.5) * max(blur_slots or 1 / q, _MIN_SLOTS)
        centres = -isi_memory / 2 + (np.arange(q) + 0.5) / q
        fine = (centres[:, None] + offsets)[:, None, :]
        slots = np.arange(-isi_memory, 1)[:, None]
        return Exposure(exposure_shares(fine, slots, max(exposure_slots, _MIN_SLOTS)).mean(axis=2))

    @property
    def isi_memory(self) -> int:
        """Slots before a metric's own that it depends on; odd, so that metrics sit between samples."""
        return int(self.taps.shape[1]) - 1

    @property
    def samples_per_slot(self) -> int:
        """Samples a slot."""
        return int(self.taps.shape[0])

    def mean_light(self, lit: Float32Array) -> Float32Array:
        """(C, N * Q) mean of slots (C, N), or of their probabilities, over the exposure; half lit beyond the ends."""
        (n_columns, n_slots), memory, q = lit.shape, self.isi_memory, self.samples_per_slot
        padded = np.full((n_columns, n_slots + 2 * memory), 0.5, np.float32)
        padded[:, memory : memory + n_slots] = lit
        n_metrics = n_slots + memory
        repeated = np.repeat(padded, q, axis=1)
        out = np.zeros((n_columns, n_metrics * q), np.float32)
        for place, weights in enumerate(self.taps.T.astype(np.float32)):
            out += repeated[:, place * q :][:, : n_metrics * q] * np.tile(weights, n_metrics)
        skip = memory * q // 2
        return np.ascontiguousarray(out[:, skip : skip + n_slots * q])


def column_light(n_strips: int, n_columns: int, light_spread: float) -> FloatArray:
    """(M, C) light of every column in the middles of strips spread evenly over a screen, the most in a strip being 1.

    Args:
        n_strips: strips of the screen, M.
        n_columns: its columns.
        light_spread: sigma of the Gaussian that a column's light falls off with, column pitches.
    """
    place = (np.arange(n_strips) + 0.5) / n_strips * n_columns
    square = (place[:, None] - np.arange(n_columns) - 0.5) ** 2
    return np.asarray(np.exp((square.min(axis=1, keepdims=True) - square) / (2 * max(light_spread, 1e-3) ** 2)))


@dataclass(frozen=True, slots=True)
class Crosstalk:
    """Light that each strip of a column gets from the columns beside it."""

    #: (S, 3) share of the light of the columns to the left, of the column itself and to the right, in each strip.
    shares: FloatArray

    @staticmethod
    def of(n_strips: int, light_spread: float) -> Crosstalk:
        """That of a screen, for a Gaussian of sigma `light_spread` pitches.

        Shares, because the picture takes up any common factor; so a spread of 0 is no crosstalk, not no light.
        """
        fine = 16
        across = (np.arange(n_strips * fine) + 0.5) / (n_strips * fine) - 0.5
        distance = across[:, None] - np.arange(-1, 2)
        exponent = (-(distance**2) / (2 * max(light_spread, 1e-3) ** 2)).reshape(n_strips, -1, 3)
        # A strip sees the mean over its width: one that is a whole column has twice the crosstalk of its middle.
        weight = np.exp(exponent - exponent.max(axis=(1, 2), keepdims=True)).mean(axis=1)
        return Crosstalk(np.asarray(weight / weight.sum(axis=1, keepdims=True)))

    @property
    def own(self) -> Float32Array:
        """(1, S, 1) a column's own share in the light of its strips."""
        return self.shares[None, :, 1, None].astype(np.float32)

    def of_strips(self, strips: slice) -> Crosstalk:
        """That of some strips."""
        return Crosstalk(self.shares[strips])

    def from_neighbours(
        self, light: Float32Array, columns: NDArray[np.int64], ahead: FloatArray | None = None
    ) -> Float32Array:
        """(len(columns), S, n) what the adjacent columns shed into each strip of some columns.

        Args:
            light: (C, n) of all columns.
            columns: those that are asked for.
            ahead: (C - 1,) how many samples later each column is read than the one before; None where none is.
        """
        left, right = np.zeros_like(light), np.zeros_like(light)
        left[1:], right[:-1] = light[:-1], light[1:]
        if ahead is not None:
            left[1:], right[:-1] = _shifted(left[1:], ahead), _shifted(right[:-1], -ahead)
        shares = self.shares.astype(np.float32)
        return left[columns, None] * shares[None, :, 0, None] + right[columns, None] * shares[None, :, 2, None]

    def against_middle(self) -> Float32Array:
        """(1, S, 1) a column's own light in each strip against that in the column's middle.

        A Gaussian's shares tell where in the column the strip lies: their logarithms bend by 1 / sigma**2 and rise by
        the strip's place over sigma**2.
        """
        log = np.log(np.maximum(self.shares, 1e-12))
        bend = np.maximum(2 * log[:, 1] - log[:, 0] - log[:, 2], 1e-6)
        rise = (log[:, 2] - log[:, 0]) / 2
        return np.asarray(np.exp(-np.square(rise) / (2 * bend)), np.float32)[None, :, None]


def _shifted(rows: Float32Array, by: FloatArray) -> Float32Array:
    """Each row read `by` samples later, linearly interpolated."""
    index = np.arange(rows.shape[1])
    return np.stack([np.interp(index + b, index, row) for row, b in zip(rows, by, strict=True)]).astype(np.float32)


class SlotLight:
    """Slots (C, N) as light at any instants: what they add up to between two of them.

    Args:
        slots: light of every slot, 0 dark to 1 lit, or the probability of that.
        beyond: light of the slots before and after; unknown ones are half lit.
    """

    #: Slots before and after that an instant may reach.
    _BEYOND = 8

    def __init__(self, slots: Float32Array, beyond: float = 0.5) -> None:
        n_columns, n = slots.shape
        self._slots = np.full((n_columns, n + 2 * self._BEYOND + 1), beyond, np.float32)
        self._slots[:, self._BEYOND : self._BEYOND + n] = slots
        self._total = np.zeros_like(self._slots)
        np.cumsum(self._slots[:, :-1], axis=1, out=self._total[:, 1:])

    def mean_over(self, positions: FloatArray | Float32Array, exposure_slots: float) -> Float32Array:
        """(C, R) mean over exposures centred at positions (C, R) or, the same for all columns, (1, R), in slots."""
        late, _ = self._until(positions + np.float32(exposure_slots / 2))
        early, _ = self._until(positions - np.float32(exposure_slots / 2))
        late -= early
        late *= np.float32(1 / exposure_slots)
        return late

    def mean_and_slope(
        self, positions: FloatArray | Float32Array, exposure_slots: float
    ) -> tuple[Float32Array, Float32Array]:
        """What is `seen`, and its change per slot of time."""
        late, late_slope = self._until(positions + np.float32(exposure_slots / 2))
        early, early_slope = self._until(positions - np.float32(exposure_slots / 2))
        scale = np.float32(1 / exposure_slots)
        return (late - early) * scale, (late_slope - early_slope) * scale

    def _until(self, instants: FloatArray | Float32Array) -> tuple[Float32Array, Float32Array]:
        """Light up to the instants, and the slots that they fall into."""
        place = np.clip(instants + np.float64(self._BEYOND), 0, self._total.shape[1] - 1.001)
        left = place.astype(np.intp)
        slots, total = take_places(self._slots, left), take_places(self._total, left)
        return total + slots * (place - left).astype(np.float32), slots


def take_places(values: NDArray[Any], index: IntArray) -> NDArray[Any]:
    """`values` (C, n) at the places (C, R) or, the same for all rows, (1, R)."""
    if index.shape[0] == 1:
        return np.asarray(values.take(index[0], axis=1))
    return np.asarray(values.ravel().take(index + (np.arange(values.shape[0]) * values.shape[1])[:, None]))
