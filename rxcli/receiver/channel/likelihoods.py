"""The light's likelihood under every pattern of slots, each slot by itself."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rxcli.receiver.channel.model import LightModel
from rxcli.receiver.channel.patterns import by_pattern
from rxcli.receiver.channel.picture import Prediction, by_slot, predict_picture
from rxcli.types import Clock, Float32Array, FloatArray, SlotSamples

#: Prior of the predictions from both sides, from before, from after.
_SIDES = (0.5, 0.25, 0.25)
#: Degrees of freedom of the Student-t likelihood; `_density` is written for four.
_DEGREES = 4.0
#: Densities are taken to be at least this, so that their logarithm exists.
_LEAST_DENSITY = np.float32(1e-37)
#: Samples of one slot and strips of one column err alike: the log-likelihoods of a slot's samples, added over the
#: strips, count as much as this many samples of one strip would.
_TEMPER = 0.64
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
    #: how many slots the column's clock is late.
    timing: FloatArray


@dataclass(frozen=True, slots=True)
class _Expected:
    """What C columns should show, per unit of picture; arrays (C, S, n) or broadcasting to it."""

    others: Float32Array
    own: Float32Array
    #: (C, 1, n): exposure over the expected slots of the column itself.
    shape: Float32Array
    #: Change of the whole by a slot of time.
    slope: Float32Array

    @property
    def whole(self) -> Float32Array:
        return self.others + self.own * self.shape


def slot_likelihoods(
    samples: SlotSamples,
    clock: Clock,
    model: LightModel,
    lit: Float32Array,
    columns: NDArray[np.int64],
    thorough: bool = True,
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
    """
    shape = shape_on_grid(lit, model)
    slope = np.zeros_like(shape)
    slope[:, 1:-1] = (shape[:, 2:] - shape[:, :-2]) * np.float32(samples.samples_per_slot / 2)
    others = from_neighbours(shape, model, clock, columns)
    others_slope = from_neighbours(slope, model, clock, columns)
    own = model.crosstalk[None, :, 1, None].astype(np.float32)

    def of_part(part: NDArray[np.int64]) -> SlotLikelihoods:
        these = columns[part]
        expected = _Expected(others[part], own, shape[these, None], others_slope[part] + own * slope[these, None])
        return _likelihoods(samples.light[part], samples.valid[part], expected, model, thorough)

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
    light: Float32Array, valid: Float32Array, expected: _Expected, model: LightModel, thorough: bool
) -> SlotLikelihoods:
    light = (light - np.float32(model.black_level)) * valid
    predictions = predict_picture(light, expected.whole, valid, model.sigma, model.taps.shape[0], thorough)
    metrics = _pattern_metrics(light, valid, predictions, expected, model)
    timing = _timing(light, valid, predictions[0], expected, model)
    return SlotLikelihoods(metrics, _slot_snr(valid, predictions[0], expected.own, model), timing)


def _slot_snr(valid: Float32Array, prediction: Prediction, own: Float32Array, model: LightModel) -> Float32Array:
    """(C, N) squared contrast over variance of a slot, as far as strips and samples are independent."""
    contrast = prediction.picture * own
    noise = np.float32(model.sigma**2) + np.float32(model.shot_gain) * contrast + prediction.variance * own * own
    q = model.taps.shape[0]
    ratio = (contrast * contrast / noise * valid).sum(axis=1) * np.float32(_TEMPER / q)
    return by_slot(ratio, q)


def _timing(
    light: Float32Array, valid: Float32Array, prediction: Prediction, expected: _Expected, model: LightModel
) -> FloatArray:
    """(C, 2) numerator and denominator of each column's lateness: one Gauss-Newton step, samples weighted robustly."""
    whole = prediction.picture * expected.whole
    change = prediction.picture * expected.slope
    crosstalk = (
        np.float32(model.sigma**2) + np.float32(model.shot_gain) * whole + prediction.variance * expected.whole**2
    )
    residual = light - whole
    weight = valid / (crosstalk + residual * residual / np.float32(_DEGREES))
    numerator = (weight * residual * change).sum(axis=(1, 2), dtype=np.float64)
    return np.stack([numerator, (weight * change * change).sum(axis=(1, 2), dtype=np.float64)], axis=1)


def shape_on_grid(lit: Float32Array, model: LightModel) -> Float32Array:
    """(C, N * Q) mean of the exposure over the expected slots; unknown slots beyond the grid are half lit."""
    isi_memory, q = model.isi_memory, model.taps.shape[0]
    padded = np.full((lit.shape[0], lit.shape[1] + 2 * isi_memory), 0.5, np.float32)
    padded[:, isi_memory : isi_memory + lit.shape[1]] = lit
    n_metrics = lit.shape[1] + isi_memory
    repeated = np.repeat(padded, q, axis=1)
    shape = np.zeros((lit.shape[0], n_metrics * q), np.float32)
    for place, weights in enumerate(model.taps.T.astype(np.float32)):
        shape += repeated[:, place * q :][:, : n_metrics * q] * np.tile(weights, n_metrics)
    skip = isi_memory * q // 2
    return np.ascontiguousarray(shape[:, skip : skip + lit.shape[1] * q])


def from_neighbours(shape: Float32Array, model: LightModel, clock: Clock, columns: NDArray[np.int64]) -> Float32Array:
    """(len(columns), S, N * Q) light that the adjacent columns shed into each strip, per unit of picture."""
    left, right = np.zeros_like(shape), np.zeros_like(shape)
    left[1:], right[:-1] = shape[:-1], shape[1:]
    if clock.delay_slots.any():
        ahead = np.diff(clock.delay_slots) * model.taps.shape[0]
        left[1:] = _shifted(left[1:], ahead)
        right[:-1] = _shifted(right[:-1], -ahead)
    crosstalk = model.crosstalk.astype(np.float32)
    return left[columns, None] * crosstalk[None, :, 0, None] + right[columns, None] * crosstalk[None, :, 2, None]


def _shifted(rows: Float32Array, by: FloatArray) -> Float32Array:
    """Each row read `by` samples later, linearly interpolated."""
    index = np.arange(rows.shape[1])
    return np.stack([np.interp(index + b, index, row) for row, b in zip(rows, by, strict=True)]).astype(np.float32)


def _pattern_metrics(
    light: Float32Array,
    valid: Float32Array,
    predictions: list[Prediction],
    expected: _Expected,
    model: LightModel,
) -> FloatArray:
    """Mixture log-likelihoods summed over strips and the samples of a metric; (C, N + memory, patterns)."""
    weight = np.float32(_TEMPER / model.taps.shape[0]) * valid
    priors = _SIDES if len(predictions) > 1 else (1.0,)

    def log_likelihood(levels: Float32Array) -> Float32Array:
        whole = expected.others + expected.own * levels
        density = np.zeros_like(light)
        for prediction, prior in zip(predictions, priors, strict=True):
            density += _density(light, whole, prediction, model, prior)
        np.log(np.maximum(density, _LEAST_DENSITY, out=density), out=density)
        density *= weight
        return np.asarray(density.sum(axis=1))

    return by_pattern(model.taps, light.shape[2], log_likelihood)


def _density(
    light: Float32Array, whole: Float32Array, prediction: Prediction, model: LightModel, prior: float
) -> Float32Array:
    """Student-t density of the light times a prior, up to a constant.

    With four degrees of freedom, variance v and residual r it is v^2 / (v + r^2 / 4)^2.5: a root, and no logarithm.
    """
    variance = prediction.variance * whole
    variance += np.float32(model.shot_gain) * prediction.picture
    variance *= whole
    variance += np.float32(model.sigma**2)
    wide = light - prediction.picture * whole
    np.square(wide, out=wide)
    wide *= np.float32(1 / _DEGREES)
    wide += variance
    variance /= wide
    np.square(variance, out=variance)
    variance *= np.float32(prior)
    variance /= np.sqrt(wide, out=wide)
    return variance
