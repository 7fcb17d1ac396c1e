"""Likelihood ratio of every slot, from that of the light for every slot pattern."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import MIN_FLOAT32
from rxcli.receiver.channel.model import Expected, ObservationModel
from rxcli.receiver.channel.patterns import by_pattern, propagated, word_metrics
from rxcli.receiver.channel.picture import PER_SLOT, PictureSums, Prediction, by_place, predict_picture
from rxcli.receiver.channel.settings import SETTINGS
from rxcli.types import Clock, Float32Array, FloatArray, SlotSamples

#: Degrees of freedom of the Student-t likelihood; `_density` is written for four.
_DEGREES = 4.0


@dataclass(frozen=True, slots=True)
class SlotLikelihoods:
    """What the light of some columns shows of their slots."""

    #: (C, N) log-likelihood ratio of every slot being lit; 0 where it is not visible.
    llr: Float32Array
    #: (C, N) float32: squared contrast of a slot over its noise variance; (C, 1) if common to all slots.
    snr: Float32Array
    #: (C, 2) float64: correlation of the residuals with their derivative by time, and power of that derivative; their
    #: ratio is the lateness of the column's clock in slots. Empty but for an initial pass.
    timing: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    #: (C, copies, symbols, n) see `word_metrics`; None: words are known by their slots alone.
    words: Float32Array | None = None


def slot_likelihoods(
    samples: SlotSamples,
    clock: Clock,
    model: ObservationModel,
    lit: Float32Array,
    columns: NDArray[np.int64],
    *,
    is_initial: bool = False,
) -> SlotLikelihoods:
    """Log-likelihood ratio of every slot, given the picture by the current estimate of all slots.

    Args:
        samples: samples of `columns`, S strips, N slots of Q samples.
        clock: the clock.
        model: the light model.
        lit: (C, N) probability that each slot is lit, all columns.
        columns: numbers of the columns in `samples` and in the result.
        is_initial: compute the lateness of the clock too, and predict the picture only from both sides together and
            not on the finest scale, which is several times faster and sufficient for a plain picture.
    """
    expected, light = model.expected(lit, clock, columns, slope=is_initial), model.over_black(samples)
    observed = _Observed.of(light, samples.valid, expected, model)
    scales = SETTINGS.picture_scales[is_initial:]
    sums = PictureSums.of(observed.light, observed.whole, observed.valid)
    prediction = predict_picture(sums, model.noise.dark_variance, scales, one_sided=not is_initial)
    late = np.zeros((0, 2)) if observed.slope is None else _timing(observed, observed.slope, prediction)
    metrics = _pattern_metrics(observed, prediction)
    llr, odds = propagated(metrics, None if is_initial else lit[columns])
    words = None if is_initial else word_metrics(metrics, llr, odds, clock)
    return SlotLikelihoods(llr, _slot_snr(observed, prediction), late, words)


@dataclass(frozen=True, slots=True)
class _Observed:
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
    def of(light: Float32Array, valid: Float32Array, expected: Expected, model: ObservationModel) -> _Observed:
        """Reorder samples (C, S, n) in order of time."""
        q = model.exposure.samples_per_slot
        light, valid, neighbours, shape = (
            by_place(each, q) for each in (light, valid, expected.neighbours, expected.shape)
        )
        slope = None if expected.slope is None else by_place(expected.slope, q)
        return _Observed(light, valid, neighbours, expected.own, neighbours + expected.own * shape, slope, model)


def _slot_snr(observed: _Observed, prediction: Prediction) -> Float32Array:
    """(C, N) squared contrast over variance of a slot, for the effective number of independent samples.

    Evaluated in the middle of the slot, since the picture hardly changes within a slot.
    """
    picture = prediction.picture[0, 1]
    contrast = picture * observed.own
    noise = observed.model.noise.through_picture(picture, prediction.variance[0], observed.own)
    ratio = contrast * contrast / noise * observed.valid[len(observed.valid) // 2]
    return np.asarray(ratio.sum(axis=1) * np.float32(SETTINGS.slot_information))


def _timing(observed: _Observed, slope: Float32Array, prediction: Prediction) -> FloatArray:
    """(C, 2) numerator and denominator of each column's lateness: one robust Gauss-Newton step."""
    picture = prediction.at_samples(len(observed.light))
    change = picture * slope
    residual = observed.light - picture * observed.whole
    variance = observed.model.noise.through_picture(picture, prediction.variance[0], observed.whole)
    weight = observed.valid / (variance + residual * residual / np.float32(_DEGREES))
    terms = (weight * change * factor for factor in (residual, change))
    return np.stack([term.sum(axis=(0, -2, -1), dtype=np.float64) for term in terms], axis=1)


def _pattern_metrics(observed: _Observed, prediction: Prediction) -> Float32Array:
    """Mixture log-likelihoods summed over strips and the samples of a metric; (C, N + memory, patterns)."""
    exposure, noise = observed.model.exposure, observed.model.noise
    weight = np.float32(SETTINGS.slot_information / exposure.samples_per_slot) * observed.valid

    def log_likelihood(place: int, level: float) -> Float32Array:
        half = place * PER_SLOT // exposure.samples_per_slot
        whole, picture = observed.own * np.float32(level) + observed.neighbours[place], prediction.picture[:, half]
        variance = noise.through_picture(picture, prediction.variance, whole)
        density = _density(observed.light[place] - picture * whole, variance).sum(axis=0)
        np.log(np.maximum(density, MIN_FLOAT32, out=density), out=density)
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
