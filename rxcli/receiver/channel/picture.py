"""Prediction of the picture at every slot from its neighbouring slots."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.numerics import TINY, box_sums
from rxcli.protocol import SLOTS_PER_SYMBOL
from rxcli.receiver.channel.settings import SETTINGS
from rxcli.types import Float32Array

#: Squared prediction that is added to a sum of them, for samples without light.
_MIN_POWER = np.float32(1e-4)
#: Predictions of the picture per slot: exposures that overlap a sample's own cannot contradict it.
PER_SLOT = 2


@dataclass(frozen=True, slots=True)
class Prediction:
    """Picture predicted from both sides and, optionally, from earlier and from later slots alone; float32."""

    #: (sides, 2, C, S, N) picture in the first and the second half of every slot.
    picture: Float32Array
    #: (sides, C, S, N) variance of the picture.
    variance: Float32Array

    def at_samples(self, samples_per_slot: int) -> Float32Array:
        """(Q, C, S, N) picture predicted from both sides, at every sample of a slot."""
        return np.repeat(self.picture[0], samples_per_slot // PER_SLOT, axis=0)


@dataclass(frozen=True, slots=True)
class PictureSums:
    """Sufficient statistics of the picture: sums over the valid samples of each half slot, (2, C, S, N) float32."""

    #: Light times prediction per unit of picture, squared prediction, squared light, and number of samples.
    cross: Float32Array
    power: Float32Array
    light: Float32Array
    count: Float32Array

    @staticmethod
    def of(light: Float32Array, expected: Float32Array, valid: Float32Array) -> PictureSums:
        """Sum over samples ordered `by_place`; `light` is 0 where not valid."""
        weighted = expected * valid
        return PictureSums(
            *(_of_halves(values) for values in (weighted * light, weighted * expected, light * light, valid))
        )


def _of_halves(values: Float32Array) -> Float32Array:
    """(2, ...) sums over the samples (Q, ...) of each half slot; faster by slices than as a reduction."""
    by_half = values.reshape(PER_SLOT, -1, *values.shape[1:])
    total = by_half[:, 0]
    for sample in range(1, by_half.shape[1]):
        total = total + by_half[:, sample]
    return total


def by_place(samples: Float32Array, samples_per_slot: int) -> Float32Array:
    """(Q, ..., N) samples (..., n) ordered by position in the slot first."""
    by_slot = samples.reshape(*samples.shape[:-1], -1, samples_per_slot)
    return np.ascontiguousarray(np.moveaxis(by_slot, -1, 0))


def in_time(samples: Float32Array) -> Float32Array:
    """(..., n) samples in order of time, the inverse of `by_place`."""
    return np.moveaxis(samples, 0, -1).reshape(*samples.shape[1:-1], -1)


def predict_picture(sums: PictureSums, noise_floor: float, scales: tuple[int, ...], one_sided: bool) -> Prediction:
    """Predict the picture from other slots, with the best scale on each side.

    Args:
        sums: statistics of the samples, given the current estimate of the slots.
        noise_floor: variance of a dark sample.
        scales: numbers of slots on each side from which the picture is predicted.
        one_sided: predict from earlier and from later slots alone too.
    """
    dark_variance, margin = np.float32(noise_floor), PER_SLOT * max(scales) + 1
    around = np.stack([in_time(sums.cross), in_time(sums.power)])
    around = np.pad(around, [(0, 0)] * 3 + [(2, margin)])
    best: Prediction | None = None
    for scale in scales:
        light, observed = _sides(around, PER_SLOT * scale, sums.cross.shape[-1], one_sided)
        picture = np.maximum(light, 0, out=light)
        observed += _MIN_POWER
        picture /= observed
        # The scale is chosen once per slot.
        variance = np.square(picture[:, 1]) * _texture(picture, sums, dark_variance)
        variance += dark_variance / observed[:, 1]
        if best is None:
            best = Prediction(picture, variance)
            continue
        # Selection by arithmetic is several times faster than a masked copy.
        picture -= best.picture
        picture *= (variance < best.variance)[:, None].astype(np.float32)
        np.add(best.picture, picture, out=best.picture)
        np.minimum(best.variance, variance, out=best.variance)
    assert best is not None
    return best


def _sides(around: Float32Array, size: int, n_slots: int, one_sided: bool) -> Float32Array:
    """(2, sides, 2, C, S, N) sums over `size` half slots before and after every half slot.

    The adjacent half slots are left out. The sides are both together and, with `one_sided`, before and after alone.

    Args:
        around: (2, C, S, half slots) values in time, padded by two zeros before and `size` + 1 after.
        size: number of half slots.
        n_slots: slots, N.
        one_sided: whether single sides are requested.
    """
    import cv2

    flat = around.reshape(-1, around.shape[-1])
    summed = cv2.boxFilter(flat, -1, (size, 1), anchor=(size - 1, 0), normalize=False, borderType=cv2.BORDER_CONSTANT)
    before = np.asarray(summed, np.float32).reshape(around.shape)
    out = np.empty((2, 3 if one_sided else 1, PER_SLOT, *around.shape[1:-1], n_slots), np.float32)
    for half in range(PER_SLOT):
        early, late = (before[..., start + half :: PER_SLOT][..., :n_slots] for start in (0, size + 3))
        np.add(early, late, out=out[:, 0, half])
        if one_sided:
            out[:, 1, half], out[:, 2, half] = early, late
    return out


def _texture(picture: Float32Array, sums: PictureSums, dark_variance: np.float32) -> Float32Array:
    """(sides, C, S, N) local relative variance of a prediction (sides, 2, C, S, N), beyond the noise."""
    shown = picture * sums.power
    left = shown - 2 * sums.cross
    left *= picture
    shown *= picture
    error = box_sums(left[:, 0] + left[:, 1] + sums.light.sum(axis=0), SLOTS_PER_SYMBOL)
    noise = dark_variance * box_sums(sums.count.sum(axis=0), SLOTS_PER_SYMBOL) + np.float32(TINY)
    error -= noise
    error /= box_sums(shown[:, 0] + shown[:, 1], SLOTS_PER_SYMBOL) + noise
    return np.clip(error, np.float32(SETTINGS.min_texture), np.float32(2), out=error)
