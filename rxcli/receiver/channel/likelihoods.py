"""The light's likelihood under every pattern of slots, each slot by itself."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rxcli.receiver.channel.model import Expected, ObservationModel
from rxcli.receiver.channel.patterns import by_pattern
from rxcli.receiver.channel.picture import Prediction, predict_picture
from rxcli.receiver.channel.settings import SETTINGS
from rxcli.types import Clock, Float32Array, FloatArray, SlotSamples

#: Degrees of freedom of the Student-t likelihood; `_density` is written for four.
_DEGREES = 4.0
#: Densities are taken to be at least this, so that their logarithm exists.
_LEAST_DENSITY = np.float32(1e-37)
#: Samples worked on at a time: what fits the cache.
_SAMPLES_AT_A_TIME = 60_000
#: NumPy works outside the interpreter's lock; more threads than this gain nothing on a few columns. Of fewer parts
#: than these threads spend more on waiting for that lock than they gain.
_THREADS, _MANY_PARTS = 2, 4


@dataclass(frozen=True, slots=True)
class SlotLikelihoods:
    """What the light says of the slots of some columns."""

    #: (C, N + memory, patterns) float64: log-likelihood of every pattern of slots n - memory .. n.
    metrics: FloatArray
    #: (C, N) float32: (lit minus dark) squared over the noise's variance, of a slot.
    snr: Float32Array
    #: (C, 2) float64: correlation of the residual with its change by the clock, and that change's power; their ratio is
    #: how many slots the column's clock is late. Empty where the clock was put right before.
    timing: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))


def slot_likelihoods(
    samples: SlotSamples,
    clock: Clock,
    model: ObservationModel,
    lit: Float32Array,
    columns: NDArray[np.int64],
    thorough: bool = True,
    timing: bool = True,
) -> SlotLikelihoods:
    """Log-likelihood of every slot pattern at every slot, given the present idea of all slots.

    Args:
        samples: of the columns to look at, S strips, N slots of Q samples.
        clock: the clock.
        model: the light model.
        lit: (C, N) probability that each slot is lit, of all columns.
        columns: which columns the samples are of; the result has these alone.
        thorough: predict the picture from each side too, and on all scales; else from both sides together, on the
            middle scales, which is several times quicker and enough for a plain picture.
        timing: ask how late the columns' clocks are; 0 where not.
    """
    expected, light = model.expected(lit, clock, columns, slope=timing), model.over_black(samples)

    def of_part(part: NDArray[np.int64]) -> SlotLikelihoods:
        return _likelihoods(light[part], samples.valid[part], expected.of(part), model, thorough)

    n_parts = int(np.clip(round(samples.light.size / _SAMPLES_AT_A_TIME), 1, columns.size))
    if n_parts == 1:
        return of_part(np.arange(columns.size))
    parts = np.array_split(np.arange(columns.size), n_parts)
    if n_parts < _MANY_PARTS:
        done = [of_part(part) for part in parts]
    else:
        with ThreadPoolExecutor(_THREADS) as pool:
            done = list(pool.map(of_part, parts))
    return SlotLikelihoods(
        np.concatenate([d.metrics for d in done]),
        np.concatenate([d.snr for d in done]),
        np.concatenate([d.timing for d in done]),
    )


def _likelihoods(
    light: Float32Array, valid: Float32Array, expected: Expected, model: ObservationModel, thorough: bool
) -> SlotLikelihoods:
    scales = SETTINGS.picture_scales if thorough else SETTINGS.first_scales
    predictions = predict_picture(light, expected.whole, valid, model, scales, one_sided=thorough)
    metrics = _pattern_metrics(light, valid, predictions, expected, model)
    asked = expected.slope is not None
    timing = _timing(light, valid, predictions[0], expected, model) if asked else np.zeros((len(light), 2))
    return SlotLikelihoods(metrics, _slot_snr(valid, predictions[0], expected.own, model), timing)


def _slot_snr(valid: Float32Array, prediction: Prediction, own: Float32Array, model: ObservationModel) -> Float32Array:
    """(C, N) squared contrast over variance of a slot, as far as strips and samples are independent.

    A slot's middle tells it: the picture hardly changes within.
    """
    q = model.exposure.samples_per_slot
    picture, variance, observed = (each[..., q // 2 :: q] for each in (prediction.picture, prediction.variance, valid))
    contrast = picture * own
    ratio = contrast * contrast / model.noise.through(picture, variance, own) * observed
    return np.asarray(ratio.sum(axis=1) * np.float32(SETTINGS.slot_information))


def _timing(
    light: Float32Array, valid: Float32Array, prediction: Prediction, expected: Expected, model: ObservationModel
) -> FloatArray:
    """(C, 2) numerator and denominator of each column's lateness: one Gauss-Newton step, samples weighted robustly."""
    assert expected.slope is not None
    whole = expected.whole
    change = prediction.picture * expected.slope
    residual = light - prediction.picture * whole
    variance = model.noise.through(prediction.picture, prediction.variance, whole)
    weight = valid / (variance + residual * residual / np.float32(_DEGREES))
    numerator = (weight * residual * change).sum(axis=(1, 2), dtype=np.float64)
    return np.stack([numerator, (weight * change * change).sum(axis=(1, 2), dtype=np.float64)], axis=1)


def _pattern_metrics(
    light: Float32Array,
    valid: Float32Array,
    predictions: list[Prediction],
    expected: Expected,
    model: ObservationModel,
) -> FloatArray:
    """Mixture log-likelihoods summed over strips and the samples of a metric; (C, N + memory, patterns)."""
    weight = np.float32(SETTINGS.slot_information / model.exposure.samples_per_slot) * valid
    shot = [np.float32(model.noise.slope) * prediction.picture for prediction in predictions]
    whole, floor = np.empty_like(light), np.float32(model.noise.floor)

    def log_likelihood(levels: Float32Array) -> Float32Array:
        np.multiply(expected.own, levels, out=whole)
        np.add(whole, expected.others, out=whole)
        density = _density(light, whole, predictions[0], shot[0], floor)
        for prediction, own_shot in zip(predictions[1:], shot[1:], strict=True):
            density += _density(light, whole, prediction, own_shot, floor)
        np.log(np.maximum(density, _LEAST_DENSITY, out=density), out=density)
        density *= weight
        return np.asarray(density.sum(axis=1))

    return by_pattern(model.exposure, light.shape[2], log_likelihood)


def _density(
    light: Float32Array, whole: Float32Array, prediction: Prediction, shot: Float32Array, floor: np.float32
) -> Float32Array:
    """Student-t density of the light, up to a constant, with the variance that `NoiseModel.through` tells.

    With four degrees of freedom, variance v and residual r it is v^2 / (v + r^2 / 4)^2.5: a root, and no logarithm.
    """
    variance = prediction.variance * whole
    variance += shot
    variance *= whole
    variance += floor
    wide = prediction.picture * whole
    np.subtract(light, wide, out=wide)
    np.square(wide, out=wide)
    wide *= np.float32(1 / _DEGREES)
    wide += variance
    variance /= wide
    np.square(variance, out=variance)
    variance /= np.sqrt(wide, out=wide)
    return variance
