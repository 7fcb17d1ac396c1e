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
    """Picture predicted from the slots around; float32."""

    #: (2, C, S, N) picture in the first and the second half of every slot.
    picture: Float32Array
    #: (C, S, N) variance of the picture.
    variance: Float32Array

    def at_samples(self, samples_per_slot: int) -> Float32Array:
        """(Q, C, S, N) picture at every sample of a slot."""
        return np.repeat(self.picture, samples_per_slot // PER_SLOT, axis=0)


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


def predict_picture(sums: PictureSums, noise_floor: float, scales: tuple[int, ...]) -> Prediction:
    """Predict the picture at every slot from the slots around it, with the scale of the smallest error.

    Args:
        sums: statistics of the samples, given the current estimate of the slots.
        noise_floor: variance of a dark sample.
        scales: numbers of slots on each side from which the picture is predicted.
    """
    import cv2

    dark_variance, n_halves = np.float32(noise_floor), PER_SLOT * sums.cross.shape[-1]
    in_halves = np.stack([in_time(sums.cross), in_time(sums.power)])
    around = np.pad(in_halves, [(0, 0)] * 3 + [(PER_SLOT, PER_SLOT * max(scales) + 1)])
    flat = around.reshape(-1, around.shape[-1])
    best = Prediction(np.zeros_like(sums.cross), np.full(sums.cross.shape[1:], np.inf, np.float32))
    for scale in scales:
        n = PER_SLOT * scale
        summed = cv2.boxFilter(flat, -1, (n, 1), anchor=(n - 1, 0), normalize=False, borderType=cv2.BORDER_CONSTANT)
        before = np.asarray(summed, np.float32).reshape(around.shape)
        # Before and after every half slot, without those beside it.
        sides = before[..., :n_halves] + before[..., n + PER_SLOT + 1 :][..., :n_halves]
        light, observed = by_place(sides, PER_SLOT).swapaxes(0, 1)
        observed = observed + _MIN_POWER
        picture = np.maximum(light, 0) / observed
        # The scale is chosen once per slot.
        variance = np.square(picture[1]) * _texture(picture, sums, dark_variance) + dark_variance / observed[1]
        is_better = variance < best.variance
        best = Prediction(np.where(is_better, picture, best.picture), np.minimum(variance, best.variance))
    return best


def _texture(picture: Float32Array, sums: PictureSums, dark_variance: np.float32) -> Float32Array:
    """(C, S, N) local relative variance of a prediction (2, C, S, N), beyond the noise."""
    shown = picture * sums.power
    left = shown - 2 * sums.cross
    left *= picture
    shown *= picture
    error = box_sums(left[0] + left[1] + sums.light.sum(axis=0), SLOTS_PER_SYMBOL)
    noise = dark_variance * box_sums(sums.count.sum(axis=0), SLOTS_PER_SYMBOL) + np.float32(TINY)
    error -= noise
    error /= box_sums(shown[0] + shown[1], SLOTS_PER_SYMBOL) + noise
    return np.clip(error, np.float32(SETTINGS.min_texture), np.float32(2), out=error)
