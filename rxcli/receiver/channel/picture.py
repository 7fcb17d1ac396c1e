"""The picture at every sample, predicted from the samples around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.numerics import box_sums
from rxcli.receiver.channel.model import ObservationModel
from rxcli.receiver.channel.settings import SETTINGS
from rxcli.types import Float32Array


@dataclass(frozen=True, slots=True)
class Prediction:
    """The picture at every sample from other samples, (C, S, n) float32 each."""

    picture: Float32Array
    variance: Float32Array


def predict_picture(
    light: Float32Array,
    expected: Float32Array,
    valid: Float32Array,
    model: ObservationModel,
    scales: tuple[float, ...],
    one_sided: bool,
) -> list[Prediction]:
    """The picture at every sample from both sides, from before and from after; on each the best of all scales.

    Args:
        light: (C, S, n) light over the floor, 0 where not valid.
        expected: (C, S, n) light per unit of picture, by the present idea of the slots.
        valid: (C, S, n) 1 or 0.
        model: the observation model.
        scales: slots over which it is predicted.
        one_sided: predict from before and from after as well.
    """
    samples_per_slot, floor = model.exposure.samples_per_slot, np.float32(model.noise.floor)
    weighted = expected * valid
    numerator, denominator = weighted * light, weighted * expected
    hole = max(int(np.ceil(SETTINGS.hole_slots * samples_per_slot)) - 1, 0)
    texture = _Texture(light, expected, valid, floor, samples_per_slot)
    pictures: list[Float32Array] = []
    variances: list[Float32Array] = []
    for half in dict.fromkeys(max(int(scale * samples_per_slot), 1) for scale in scales):
        sides = _sides if one_sided else _both_sides
        sums = zip(
            sides(box_sums(numerator, half), half, hole), sides(box_sums(denominator, half), half, hole), strict=True
        )
        for side, (light_observed, observed) in enumerate(sums):
            initial = np.maximum(light_observed, 0, out=light_observed)
            initial /= observed + np.float32(1e-4)
            # Which scale is best is asked once a slot, in its middle.
            variance = np.square(initial[..., samples_per_slot // 2 :: samples_per_slot]) * texture.of(initial)
            variance += floor / (observed[..., samples_per_slot // 2 :: samples_per_slot] + np.float32(1e-6))
            if len(pictures) <= side:
                pictures.append(initial)
                variances.append(variance)
                continue
            # Arithmetic picks several times quicker than a masked copy.
            better = (variance < variances[side]).astype(np.float32)
            initial -= pictures[side]
            initial *= np.repeat(better, samples_per_slot, axis=-1)
            pictures[side] += initial
            np.minimum(variances[side], variance, out=variances[side])
    return [
        Prediction(picture, np.repeat(variance, samples_per_slot, axis=-1))
        for picture, variance in zip(pictures, variances, strict=True)
    ]


def _both_sides(boxes: Float32Array, half: int, hole: int) -> tuple[Float32Array]:
    """Sums over both sides of a hole, from sums centred on samples."""
    away = hole + half + 1
    both = np.zeros_like(boxes)
    both[..., away:] = boxes[..., :-away]
    both[..., :-away] += boxes[..., away:]
    return (both,)


def _sides(boxes: Float32Array, half: int, hole: int) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Sums over both sides of a hole, over the side before it, over the side after, from sums centred on samples."""
    away = hole + half + 1
    before, after = np.zeros_like(boxes), np.zeros_like(boxes)
    before[..., away:] = boxes[..., :-away]
    after[..., :-away] = boxes[..., away:]
    return before + after, before, after


class _Texture:
    """Relative variance of a prediction thereabouts, beyond the noise.

    Every other sample tells it, averaged slot by slot, which is fine enough.
    """

    def __init__(
        self, light: Float32Array, expected: Float32Array, valid: Float32Array, floor: np.float32, samples_per_slot: int
    ) -> None:
        self._q = samples_per_slot
        self._step = 2 if samples_per_slot % 2 == 0 else 1
        self._light = np.ascontiguousarray(light[..., :: self._step])
        self._expected = expected[..., :: self._step] * valid[..., :: self._step]
        count = self._around(np.ascontiguousarray(valid[..., :: self._step]))
        self._noise = floor * count
        self._least = np.float32(1e-5) * count + np.float32(1e-9)

    def of(self, picture: Float32Array) -> Float32Array:
        """(C, S, N) relative variance of `picture`, slot by slot."""
        predicted = picture[..., :: self._step] * self._expected
        residual = self._light - predicted
        error = self._around(np.square(residual, out=residual)) - self._noise
        power = self._around(np.square(predicted, out=predicted)) + self._least
        low, high = SETTINGS.texture_bounds
        return np.asarray(np.clip(error / power, np.float32(low), np.float32(high)))

    def _around(self, values: Float32Array) -> Float32Array:
        return box_sums(by_slot(values, self._q // self._step), SETTINGS.error_slots // 2)


def by_slot(values: Float32Array, samples_per_slot: int) -> Float32Array:
    """Sums over the samples of each slot, last axis; adding slices is far quicker than a sum over a short axis."""
    total = values[..., ::samples_per_slot].copy()
    for offset in range(1, samples_per_slot):
        total += values[..., offset::samples_per_slot]
    return total
