"""Rolling shutter: what share of a row's exposure each slot fills."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def lit_share(
    slots: NDArray[np.uint8], start: FloatArray, length: float, decay: float = 0.0, level: float = 0.0
) -> FloatArray:
    """Mean over exposures of a slot sequence, or of a light that follows it exponentially, as a phosphor does.

    The sequence is piecewise constant, so its running integral is piecewise linear and the mean is exact. The light `y`
    obeys `decay * y' = slot - y`; so its integral is that of the slots less `decay` times its growth.

    Args:
        slots: (n,) 0/1, slot `k` lasting from k to k + 1; dark outside.
        start: (rows,) exposure starts, in slots; 0 or more where the light decays.
        length: of every exposure, in slots.
        decay: time to 1/e, in slots; 0 for light that goes out at once.
        level: light that decays at the start of slot 0.

    Returns:
        (rows,) share of the exposure that was lit, 0..1.
    """
    integral = np.concatenate([[0.0], np.cumsum(slots, dtype=np.float64)])
    knots = np.arange(integral.size, dtype=np.float64)
    lit = np.interp(start + length, knots, integral) - np.interp(start, knots, integral)
    share = np.asarray(np.clip(lit / length, 0.0, 1.0))
    if not decay:
        return share
    light = np.empty(slots.size + 1)
    light[0], keep = level, np.exp(-1 / decay)
    for slot, lit in enumerate(slots.tolist()):
        light[slot + 1] = lit + (light[slot] - lit) * keep

    def light_at(time: FloatArray) -> FloatArray:
        slot = np.minimum(time.astype(np.int64), slots.size - 1)
        return np.asarray(slots[slot] + (light[slot] - slots[slot]) * np.exp((slot - time) / decay))

    return share - decay / length * (light_at(start + length) - light_at(start))


def slot_shares(start: FloatArray, length: float, slots: FloatArray, decay: float = 0.0) -> FloatArray:
    """(rows, n) what one lit slot adds to the mean of every exposure, at once or decaying; see `lit_share`.

    Args:
        start: (rows,) exposure starts, in slots.
        length: of every exposure, in slots.
        slots: (n,) numbers of the slots.
        decay: time to 1/e, in slots; 0 for light that goes out at once.
    """

    def since(time: FloatArray) -> FloatArray:
        ramp = np.maximum(time, 0)
        return ramp + decay * np.expm1(-ramp / decay) if decay else ramp

    begin = start[:, None] - slots
    light = [since(time) - since(time - 1) for time in (begin + length, begin)]
    return np.asarray((light[0] - light[1]) / length)


def flicker(start_s: FloatArray, exposure_s: float, frequency_hz: float, depth: float, phase: float) -> FloatArray:
    """Mean of 1 + depth * sin(2 pi f t + phase) over exposures that start at `start_s`; (rows,)."""
    half = np.pi * frequency_hz * exposure_s
    attenuation = np.sinc(frequency_hz * exposure_s)
    return np.asarray(1 + depth * attenuation * np.sin(2 * np.pi * frequency_hz * start_s + half + phase))
