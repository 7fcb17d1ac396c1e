"""Rolling shutter: what share of a row's exposure each slot fills."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def lit_share(slots: NDArray[np.uint8], start: FloatArray, length: float) -> FloatArray:
    """Mean of a slot sequence over exposures.

    The sequence is piecewise constant, so its running integral is piecewise linear and the mean is exact.

    Args:
        slots: (n,) 0/1, slot `k` lasting from k to k + 1; dark outside.
        start: (rows,) exposure starts, in slots.
        length: of every exposure, in slots.

    Returns:
        (rows,) share of the exposure that was lit, 0..1.
    """
    integral = np.concatenate([[0.0], np.cumsum(slots, dtype=np.float64)])
    knots = np.arange(integral.size, dtype=np.float64)
    lit = np.interp(start + length, knots, integral) - np.interp(start, knots, integral)
    return np.asarray(np.clip(lit / length, 0.0, 1.0))


def overlaps(start: FloatArray, length: float) -> tuple[NDArray[np.int64], FloatArray]:
    """Which slots every exposure touches, and for what share of it.

    Args:
        start: (rows,) exposure starts, in slots.
        length: of every exposure, in slots.

    Returns:
        (rows,) number of the first slot touched, and (rows, taps) share of the exposure in that slot and those after.
    """
    first_slot = np.floor(start).astype(np.int64)
    taps = int(np.ceil(length)) + 1
    left = first_slot[:, None] + np.arange(taps)
    begin = np.maximum(left, start[:, None])
    end = np.minimum(left + 1, start[:, None] + length)
    return first_slot, np.maximum(end - begin, 0.0) / length


def flicker(start_s: FloatArray, exposure_s: float, frequency_hz: float, depth: float, phase: float) -> FloatArray:
    """Mean of 1 + depth * sin(2 pi f t + phase) over exposures that start at `start_s`; (rows,)."""
    half = np.pi * frequency_hz * exposure_s
    attenuation = np.sinc(frequency_hz * exposure_s)
    return np.asarray(1 + depth * attenuation * np.sin(2 * np.pi * frequency_hz * start_s + half + phase))
