"""Likelihood of the light for every slot pattern, each slot separately."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rxcli.receiver.channel.model import Expected, ObservationModel
from rxcli.receiver.channel.patterns import by_pattern
from rxcli.receiver.channel.picture import PER_SLOT, PictureSums, Prediction, by_place, predict_picture
from rxcli.receiver.channel.settings import SETTINGS
from rxcli.types import Clock, Float32Array, FloatArray, SlotSamples

#: Degrees of freedom of the Student-t likelihood; `_density` is written for four.
_DEGREES = 4.0
#: Lower limit of densities, so that their logarithm exists.
_MIN_DENSITY = np.float32(1e-37)
#: Samples per batch, limited by the cache.
_SAMPLES_AT_A_TIME = 60_000


@dataclass(frozen=True, slots=True)
class SlotLikelihoods:
    """Log-likelihoods of the slots of some columns."""

    #: (C, N + memory, patterns) float64: log-likelihood of every pattern of slots n - memory .. n.
    metrics: FloatArray
    #: (C, N) float32: squared contrast of a slot over its noise variance; (C, 1) if common to all slots.
    snr: Float32Array
    #: (C, 2) float64: correlation of the residual with its derivative by time, and power of that derivative; their
    #: ratio is the lateness of the column's clock in slots. Empty if the clock was corrected before.
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
    """Log-likelihood of every slot pattern at every slot, given the current estimate of all slots.

    Args:
        samples: samples of `columns`, S strips, N slots of Q samples.
        clock: the clock.
        model: the light model.
        lit: (C, N) probability that each slot is lit, all columns.
        columns: numbers of the columns in `samples` and in the result.
        thorough: predict the picture also from each side alone, and on all scales; otherwise from both sides together
            on the middle scales, which is several times faster and sufficient for a plain picture.
        timing: compute the lateness of the columns' clocks; 0 otherwise.
    """
    expected, light = model.expected(lit, clock, columns, slope=timing), model.over_black(samples)

    n_parts = int(np.clip(round(samples.light.size / _SAMPLES_AT_A_TIME), 1, columns.size))
    done = [
        _likelihoods(_Part.of(light[part], samples.valid[part], expected.of(part), model), thorough)
        for part in np.array_split(np.arange(columns.size), n_parts)
    ]
    return SlotLikelihoods(
        np.concatenate([d.metrics for d in done]),
        np.concatenate([d.snr for d in done]),
        np.concatenate([d.timing for d in done]),
    )


@dataclass(frozen=True, slots=True)
class _Part:
    """Samples of some columns, ordered by position in the slot: (Q, C, S, N) float32 or broadcastable."""

    light: Float32Array
    valid: Float32Array
    #: Predicted light per unit of picture: of the adjacent columns, of the column itself when lit, and of all columns
    #: given the current estimate of the slots.
    neighbours: Float32Array
    own: Float32Array
    whole: Float32Array
    #: Derivative of the total by time, per slot; None unless requested.
    slope: Float32Array | None
    model: ObservationModel

    @staticmethod
    def of(light: Float32Array, valid: Float32Array, expected: Expected, model: ObservationModel) -> _Part:
        """Reorder samples (C, S, n) in order of time."""
        q = model.exposure.samples_per_slot
        light, valid, neighbours, shape = (
            by_place(each, q) for each in (light, valid, expected.neighbours, expected.shape)
        )
        slope = None if expected.slope is None else by_place(expected.slope, q)
        return _Part(light, valid, neighbours, expected.own, neighbours + expected.own * shape, slope, model)


def _likelihoods(part: _Part, thorough: bool) -> SlotLikelihoods:
    scales = SETTINGS.picture_scales if thorough else SETTINGS.picture_scales[1:]
    sums = PictureSums.of(part.light, part.whole, part.valid)
    prediction = predict_picture(sums, part.model.noise.dark_variance, scales, one_sided=thorough)
    timing = np.zeros((part.light.shape[1], 2)) if part.slope is None else _timing(part, prediction)
    return SlotLikelihoods(_pattern_metrics(part, prediction), _slot_snr(part, prediction), timing)


def _slot_snr(part: _Part, prediction: Prediction) -> Float32Array:
    """(C, N) squared contrast over variance of a slot, for the effective number of independent samples.

    Evaluated in the middle of the slot, since the picture hardly changes within a slot.
    """
    picture = prediction.picture[0, 1]
    contrast = picture * part.own
    noise = part.model.noise.through_picture(picture, prediction.variance[0], part.own)
    ratio = contrast * contrast / noise * part.valid[len(part.valid) // 2]
    return np.asarray(ratio.sum(axis=1) * np.float32(SETTINGS.slot_information))


def _timing(part: _Part, prediction: Prediction) -> FloatArray:
    """(C, 2) numerator and denominator of each column's lateness: one robust Gauss-Newton step."""
    assert part.slope is not None
    picture = prediction.at_samples(len(part.light))
    change = picture * part.slope
    residual = part.light - picture * part.whole
    variance = part.model.noise.through_picture(picture, prediction.variance[0], part.whole)
    weight = part.valid / (variance + residual * residual / np.float32(_DEGREES))
    terms = (weight * residual * change, weight * change * change)
    return np.stack([term.sum(axis=(0, -2, -1), dtype=np.float64) for term in terms], axis=1)


def _pattern_metrics(part: _Part, prediction: Prediction) -> FloatArray:
    """Mixture log-likelihoods summed over strips and the samples of a metric; (C, N + memory, patterns)."""
    exposure, noise = part.model.exposure, part.model.noise
    weight = np.float32(SETTINGS.slot_information / exposure.samples_per_slot) * part.valid
    dark_variance, shot_variance = np.float32(noise.dark_variance), np.float32(noise.shot_gain) * prediction.picture

    def log_likelihood(place: int, level: float) -> Float32Array:
        half = place * PER_SLOT // exposure.samples_per_slot
        whole = part.own * np.float32(level) + part.neighbours[place]
        # Same as `NoiseModel.through_picture`, in place.
        variance = prediction.variance * whole
        variance += shot_variance[:, half]
        variance *= whole
        variance += dark_variance
        density = _density(part.light[place] - prediction.picture[:, half] * whole, variance).sum(axis=0)
        np.log(np.maximum(density, _MIN_DENSITY, out=density), out=density)
        return np.asarray(np.einsum("csn,csn->cn", density, weight[place]))

    return by_pattern(exposure, log_likelihood)


def _density(residual: Float32Array, variance: Float32Array) -> Float32Array:
    """Student-t density of residuals, up to a constant; overwrites its arguments.

    With four degrees of freedom, variance v and residual r it is v^2 / (v + r^2 / 4)^2.5, which needs no logarithm.
    """
    wide = np.square(residual, out=residual)
    wide *= np.float32(1 / _DEGREES)
    wide += variance
    variance /= wide
    np.square(variance, out=variance)
    variance /= np.sqrt(wide, out=wide)
    return variance
