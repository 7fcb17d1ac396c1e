"""The picture at every slot, predicted from the slots around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.numerics import box_sums
from rxcli.receiver.channel.settings import SETTINGS
from rxcli.types import Float32Array

#: Keeps a power from zero where no light is seen.
_TINY = np.float32(1e-9)
#: The picture is predicted so many times a slot: exposures that overlap a sample's own say too little against it.
PER_SLOT = 2


@dataclass(frozen=True, slots=True)
class Prediction:
    """The picture from other slots, float32: from both sides and, if asked, from before alone and from after alone."""

    #: (sides, 2, C, S, N) in the first and the second half of every slot.
    picture: Float32Array
    #: (sides, C, S, N) its variance.
    variance: Float32Array

    def at_samples(self, samples_per_slot: int) -> Float32Array:
        """(Q, C, S, N) the picture from both sides at every sample of a slot."""
        return np.repeat(self.picture[0], samples_per_slot // PER_SLOT, axis=0)


@dataclass(frozen=True, slots=True)
class PictureSums:
    """What samples say of the picture, (2, C, S, N) float32 sums over those of each half of a slot that are seen."""

    #: Light by what is expected per unit of picture, the square of that, the square of light, and samples.
    cross: Float32Array
    power: Float32Array
    light: Float32Array
    count: Float32Array

    @staticmethod
    def of(light: Float32Array, expected: Float32Array, valid: Float32Array) -> PictureSums:
        """Those of samples `by_place`; `light` is 0 where not valid."""
        weighted = expected * valid
        return PictureSums(
            *(_of_halves(values) for values in (weighted * light, weighted * expected, light * light, valid))
        )


def _of_halves(values: Float32Array) -> Float32Array:
    """(2, ...) sums over the samples (Q, ...) of each half of a slot; adding slices is quicker than a reduction."""
    by_half = values.reshape(PER_SLOT, -1, *values.shape[1:])
    total = by_half[:, 0]
    for sample in range(1, by_half.shape[1]):
        total = total + by_half[:, sample]
    return total


def by_place(samples: Float32Array, samples_per_slot: int) -> Float32Array:
    """(Q, ..., N) samples (..., n) by their place in the slot: those at one place in all slots lie side by side."""
    by_slot = samples.reshape(*samples.shape[:-1], -1, samples_per_slot)
    return np.ascontiguousarray(np.moveaxis(by_slot, -1, 0))


def in_time(samples: Float32Array) -> Float32Array:
    """(..., n) samples `by_place` in order of time."""
    return np.moveaxis(samples, 0, -1).reshape(*samples.shape[1:-1], -1)


def predict_picture(sums: PictureSums, noise_floor: float, scales: tuple[int, ...], one_sided: bool) -> Prediction:
    """The picture from other slots, on each side the best of all scales.

    Args:
        sums: what samples say of it, by the present idea of the slots.
        noise_floor: variance of a sample of no light.
        scales: slots on a side from which it is predicted.
        one_sided: predict from before and from after as well.
    """
    floor, margin = np.float32(noise_floor), PER_SLOT * max(scales) + 1
    around = np.stack([in_time(sums.cross), in_time(sums.power)])
    around = np.pad(around, [(0, 0)] * 3 + [(2, margin)])
    texture = _Texture(sums, floor)
    best: Prediction | None = None
    for scale in scales:
        light, observed = _sides(around, PER_SLOT * scale, sums.cross.shape[-1], one_sided)
        picture = np.maximum(light, 0, out=light)
        picture /= observed + np.float32(1e-4)
        # Which scale is best is asked once a slot.
        variance = np.square(picture[:, 1]) * texture.of(picture)
        variance += floor / (observed[:, 1] + np.float32(1e-6))
        if best is None:
            best = Prediction(picture, variance)
            continue
        # Arithmetic picks several times quicker than a masked copy.
        picture -= best.picture
        picture *= (variance < best.variance)[:, None].astype(np.float32)
        np.add(best.picture, picture, out=best.picture)
        np.minimum(best.variance, variance, out=best.variance)
    assert best is not None
    return best


def _sides(around: Float32Array, size: int, n_slots: int, one_sided: bool) -> Float32Array:
    """(2, sides, 2, C, S, N) sums over `size` halves on both sides of every half slot and, if asked, on that before it
    and on that after; the halves next to it left out.

    Args:
        around: (2, C, S, halves) values in time, two halves of nothing before them and `size` + 1 after.
        size: halves.
        n_slots: slots, N.
        one_sided: whether sides by themselves are asked for.
    """
    import cv2

    flat = around.reshape(-1, around.shape[-1])
    summed = cv2.boxFilter(flat, -1, (size, 1), anchor=(size - 1, 0), normalize=False, borderType=cv2.BORDER_CONSTANT)
    before = np.asarray(summed, np.float32).reshape(around.shape)
    out = np.empty((2, 3 if one_sided else 1, PER_SLOT, *around.shape[1:-1], n_slots), np.float32)
    for half in range(PER_SLOT):
        early, late = (before[..., first + half :: PER_SLOT][..., :n_slots] for first in (0, size + 3))
        np.add(early, late, out=out[:, 0, half])
        if one_sided:
            out[:, 1, half], out[:, 2, half] = early, late
    return out


class _Texture:
    """Relative variance of a prediction thereabouts, beyond the noise."""

    def __init__(self, sums: PictureSums, floor: np.float32) -> None:
        self._sums = sums
        self._light = sums.light.sum(axis=0)
        self._twice = 2 * sums.cross
        #: What noise adds to an error; of light as faint as that nothing is known.
        self._noise = floor * _around(sums.count.sum(axis=0)) + _TINY

    def of(self, picture: Float32Array) -> Float32Array:
        """(sides, C, S, N) relative variance of `picture` (sides, 2, C, S, N)."""
        shown = picture * self._sums.power
        left = shown - self._twice
        left *= picture
        shown *= picture
        error = left[:, 0] + left[:, 1]
        error += self._light
        error = _around(error)
        error -= self._noise
        error /= _around(shown[:, 0] + shown[:, 1]) + self._noise
        low, high = SETTINGS.texture_bounds
        return np.clip(error, np.float32(low), np.float32(high), out=error)


def _around(values: Float32Array) -> Float32Array:
    return box_sums(values, SETTINGS.error_slots // 2)
