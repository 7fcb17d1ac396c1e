"""The light's likelihood under every pattern of slots, each slot by itself."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
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
#: Densities are taken to be at least this, so that their logarithm exists.
_MIN_DENSITY = np.float32(1e-37)
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
    #: (C, N) float32: (lit minus dark) squared over the noise's variance, of a slot; (C, 1) where all are taken alike.
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
        return _likelihoods(_Part.of(light[part], samples.valid[part], expected.of(part), model), thorough)

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


@dataclass(frozen=True, slots=True)
class _Part:
    """Samples of some columns, those at one place in all slots side by side: (Q, C, S, N) float32 or broadcasting."""

    light: Float32Array
    valid: Float32Array
    #: Light expected per unit of picture: of the columns beside, of the column itself where it is lit, and of all by
    #: the present idea of the slots.
    others: Float32Array
    own: Float32Array
    whole: Float32Array
    #: Change of the whole by a slot of time; None where it was not asked for.
    slope: Float32Array | None
    model: ObservationModel

    @staticmethod
    def of(light: Float32Array, valid: Float32Array, expected: Expected, model: ObservationModel) -> _Part:
        """Of samples in order of time, (C, S, n)."""
        q = model.exposure.samples_per_slot
        light, valid, others, shape = (by_place(each, q) for each in (light, valid, expected.others, expected.shape))
        slope = None if expected.slope is None else by_place(expected.slope, q)
        return _Part(light, valid, others, expected.own, others + expected.own * shape, slope, model)


def _likelihoods(part: _Part, thorough: bool) -> SlotLikelihoods:
    scales = SETTINGS.picture_scales if thorough else SETTINGS.initial_scales
    sums = PictureSums.of(part.light, part.whole, part.valid)
    prediction = predict_picture(sums, part.model.noise.floor, scales, one_sided=thorough)
    timing = np.zeros((part.light.shape[1], 2)) if part.slope is None else _timing(part, prediction)
    return SlotLikelihoods(_pattern_metrics(part, prediction), _slot_snr(part, prediction), timing)


def _slot_snr(part: _Part, prediction: Prediction) -> Float32Array:
    """(C, N) squared contrast over variance of a slot, as far as strips and samples are independent.

    A slot's middle tells it: the picture hardly changes within.
    """
    picture = prediction.picture[0, 1]
    contrast = picture * part.own
    noise = part.model.noise.through_picture(picture, prediction.variance[0], part.own)
    ratio = contrast * contrast / noise * part.valid[len(part.valid) // 2]
    return np.asarray(ratio.sum(axis=1) * np.float32(SETTINGS.slot_information))


def _timing(part: _Part, prediction: Prediction) -> FloatArray:
    """(C, 2) numerator and denominator of each column's lateness: one Gauss-Newton step, samples weighted robustly."""
    assert part.slope is not None
    picture = prediction.at_samples(len(part.light))
    change = picture * part.slope
    residual = part.light - picture * part.whole
    variance = part.model.noise.through_picture(picture, prediction.variance[0], part.whole)
    weight = part.valid / (variance + residual * residual / np.float32(_DEGREES))
    of_columns = (0, 2, 3)
    numerator = (weight * residual * change).sum(axis=of_columns, dtype=np.float64)
    return np.stack([numerator, (weight * change * change).sum(axis=of_columns, dtype=np.float64)], axis=1)


def _pattern_metrics(part: _Part, prediction: Prediction) -> FloatArray:
    """Mixture log-likelihoods summed over strips and the samples of a metric; (C, N + memory, patterns)."""
    exposure, noise = part.model.exposure, part.model.noise
    weight = np.float32(SETTINGS.slot_information / exposure.samples_per_slot) * part.valid
    floor, shot = np.float32(noise.floor), np.float32(noise.slope) * prediction.picture

    def log_likelihood(place: int, level: float) -> Float32Array:
        half = place * PER_SLOT // exposure.samples_per_slot
        whole = part.own * np.float32(level) + part.others[place]
        # As `NoiseModel.through` has it.
        variance = prediction.variance * whole
        variance += shot[:, half]
        variance *= whole
        variance += floor
        density = _density(part.light[place] - prediction.picture[:, half] * whole, variance).sum(axis=0)
        np.log(np.maximum(density, _MIN_DENSITY, out=density), out=density)
        return np.asarray(np.einsum("csn,csn->cn", density, weight[place]))

    return by_pattern(exposure, log_likelihood)


def _density(residual: Float32Array, variance: Float32Array) -> Float32Array:
    """Student-t density of residuals, up to a constant; the arrays are worked in.

    With four degrees of freedom, variance v and residual r it is v^2 / (v + r^2 / 4)^2.5: a root, and no logarithm.
    """
    wide = np.square(residual, out=residual)
    wide *= np.float32(1 / _DEGREES)
    wide += variance
    variance /= wide
    np.square(variance, out=variance)
    variance /= np.sqrt(wide, out=wide)
    return variance
