"""Maths that stages share; every stage may stand on it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.protocol import HEADER, SLOTS_PER_SYMBOL
from rxcli.types import Float32Array, FloatArray, IntArray

#: Change of a header's slots, lit 1 and dark -1, at its borders.
_HEADER_STEPS = np.diff(np.concatenate([[0.0], 2.0 * np.array(HEADER) - 1, [0.0]]))


def box_sums(values: Float32Array, half: int) -> Float32Array:
    """Sum over the samples at most `half` away, nothing beyond the ends; last axis, same shape."""
    import cv2

    flat = np.ascontiguousarray(values.reshape(-1, values.shape[-1]))
    summed = cv2.boxFilter(flat, -1, (2 * half + 1, 1), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(summed, np.float32).reshape(values.shape)


def local_mean(values: Float32Array, window: int) -> Float32Array:
    """Mean over a window of (at least) `window` samples, mirrored at the ends; (n, samples), same shape."""
    import cv2

    return np.asarray(cv2.blur(values, (window | 1, 1)))


def log_alike(
    first: NDArray[np.floating], second: NDArray[np.floating], share: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Log-likelihood ratio of two slots being the same one over their being two independent ones.

    Args:
        first: probability that the first is lit.
        second: probability that the second is lit.
        share: of lit slots among all, 0..1 exclusive.
    """
    return np.asarray(np.log(first * second / share + (1 - first) * (1 - second) / (1 - share)))


def header_correlation(total: FloatArray, samples_per_slot: int) -> FloatArray:
    """Mean over the slots of a header that starts at each sample, dark ones counting negative.

    Args:
        total: (..., n + 1) running sums at the borders of samples.
        samples_per_slot: samples a slot.

    Returns:
        (..., n + 1 - samples of a header), in the samples' unit.
    """
    length = SLOTS_PER_SYMBOL * samples_per_slot
    n = total.shape[-1] - length
    out = np.zeros((*total.shape[:-1], n))
    for slot in np.flatnonzero(_HEADER_STEPS):
        out -= _HEADER_STEPS[slot] * total[..., slot * samples_per_slot :][..., :n]
    return out / length


def exposure_shares(centre: FloatArray, slots: NDArray[np.integer] | FloatArray, exposure_slots: float) -> FloatArray:
    """Share of an exposure that falls into each slot; the one idea of a shutter that all light models have.

    Args:
        centre: centre of the exposure, slots.
        slots: numbers of the slots, which begin there; broadcast against `centre`.
        exposure_slots: length of the exposure, slots.
    """
    half = exposure_slots / 2
    reach = np.minimum(centre + half, slots + 1) - np.maximum(centre - half, slots)
    return np.asarray(np.maximum(reach, 0) / exposure_slots)


class SlotLight:
    """Slots (C, N) as light: what they add up to between any two instants.

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

    def seen(self, positions: FloatArray | Float32Array, exposure_slots: float) -> Float32Array:
        """(C, R) mean over exposures centred at positions (C, R) or, the same for all columns, (1, R), in slots."""
        late, _ = self._until(positions + np.float32(exposure_slots / 2))
        early, _ = self._until(positions - np.float32(exposure_slots / 2))
        late -= early
        late *= np.float32(1 / exposure_slots)
        return late

    def seen_with_slope(
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
        slots, total = taken(self._slots, left), taken(self._total, left)
        return total + slots * (place - left).astype(np.float32), slots


def taken(values: NDArray[Any], index: IntArray) -> NDArray[Any]:
    """`values` (C, n) at the places (C, R) or, the same for all rows, (1, R)."""
    if index.shape[0] == 1:
        return np.asarray(values.take(index[0], axis=1))
    return np.asarray(values.ravel().take(index + (np.arange(values.shape[0]) * values.shape[1])[:, None]))
