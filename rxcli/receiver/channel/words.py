"""Comparison of the likeliest words of uncertain symbols as a whole."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import box_sums
from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL
from rxcli.receiver.channel.model import ObservationModel
from rxcli.receiver.channel.settings import SETTINGS
from rxcli.types import Clock, Float32Array, FloatArray, SlotSamples

#: Regularisation of the equations for words with few differences.
_MIN_NORM = 1e-3


@dataclass(frozen=True, slots=True)
class _Halves:
    """Light of some columns at two samples per slot; (C, S, 2 N) float32."""

    #: Light above the black level.
    light: Float32Array
    #: Local mean picture.
    mean: Float32Array
    #: Light of the adjacent columns per unit of picture.
    neighbours: Float32Array
    #: Whether all samples of the half slot are visible.
    observed: NDArray[np.bool_]


def word_corrections(
    samples: SlotSamples,
    clock: Clock,
    model: ObservationModel,
    lit: Float32Array,
    columns: NDArray[np.int64],
    places: NDArray[np.int64],
    words: NDArray[np.uint8],
) -> Float32Array:
    """Corrections of slot log-likelihood ratios by which words score as the light of the whole symbol indicates.

    Args:
        samples: samples of `columns`, S strips, N slots of four samples.
        clock: the clock.
        model: the light model.
        lit: (C, N) probability that each slot is lit, all columns.
        columns: numbers of the columns in `samples`.
        places: (J, 3) burst, index in `columns` and symbol number of each uncertain symbol.
        words: (J, K, 10) likeliest words of each symbol, best first.

    Returns:
        (len(columns), N) values to add; 0 for certain symbols.
    """
    out = np.zeros((columns.size, clock.n_slots), np.float32)
    symbol, start = _occurrences(places, clock)
    if symbol.size == 0:
        return out
    halves = _halves(samples, clock, model, lit, columns)
    n_words = words.shape[1]
    column, begin = np.repeat(places[symbol, 1], n_words), np.repeat(start, n_words)
    levels = _word_levels(lit[columns[column]], begin, words[symbol].reshape(-1, SLOTS_PER_SYMBOL), model)
    score = np.zeros(words.shape[:2])
    np.add.at(score, symbol, _process_likelihood(halves, column, begin, levels, model).reshape(-1, n_words))
    # The effective number of samples per slot does not depend on their actual number, here two.
    slots = _as_slots(SETTINGS.slot_information / 2 * score, words)
    _share_among_copies(out, slots, symbol, places[symbol, 1], start)
    return out


def _share_among_copies(
    out: Float32Array,
    slots: FloatArray,
    symbol: NDArray[np.int64],
    column: NDArray[np.int64],
    start: NDArray[np.int64],
) -> None:
    """Write the corrections (J, 10) of symbols to the grid, divided equally among the copies that show the slot."""
    at = start[:, None] + np.arange(SLOTS_PER_SYMBOL)
    inside = (at >= 0) & (at < out.shape[1])
    count = np.zeros(slots.shape)
    np.add.at(count, symbol, inside)
    share = (slots / np.maximum(count, 1))[symbol]
    rows = np.broadcast_to(column[:, None], at.shape)
    out[rows[inside], at[inside]] = share[inside]


def _occurrences(places: NDArray[np.int64], clock: Clock) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Symbol number and first slot of every visible copy of the symbols."""
    symbol, copy = np.nonzero(places[:, :1] == clock.burst)
    start = copy * clock.packet_slots + PREAMBLE_SLOTS + SLOTS_PER_SYMBOL * places[symbol, 2] - clock.first_slot
    visible = (start > -SLOTS_PER_SYMBOL) & (start < clock.n_slots)
    return symbol[visible], start[visible]


def _halves(
    samples: SlotSamples, clock: Clock, model: ObservationModel, lit: Float32Array, columns: NDArray[np.int64]
) -> _Halves:
    expected, light, q = model.expected(lit, clock, columns), model.over_black(samples), samples.samples_per_slot
    weight = expected.whole * samples.valid
    light_sum, weight_sum = (box_sums(part * weight, SETTINGS.level_slots * q) for part in (light, weight))
    mean = np.maximum(light_sum, np.float32(0)) / np.maximum(weight_sum, np.float32(1e-3))
    observed = _paired(samples.valid) > 0.9
    return _Halves(_paired(light), _paired(mean.astype(np.float32)), _paired(expected.neighbours), observed)


def _paired(values: Float32Array) -> Float32Array:
    """Mean of the two samples of every half slot, last axis."""
    return np.asarray((values[..., ::2] + values[..., 1::2]) * np.float32(0.5), np.float32)


def _word_levels(
    lit: Float32Array, start: NDArray[np.int64], words: NDArray[np.uint8], model: ObservationModel
) -> Float32Array:
    """(R, W) light of a word and of the estimated slots around it after the exposure, two samples per slot.

    Args:
        lit: (R, N) probability that each slot of the word's column is lit.
        start: (R,) first slot of the word.
        words: (R, 10).
        model: the light model.
    """
    lead, q = SETTINGS.around_slots + model.exposure.isi_memory, model.exposure.samples_per_slot
    at = start[:, None] + np.arange(-lead, SLOTS_PER_SYMBOL + lead)
    slots = np.take_along_axis(lit, np.clip(at, 0, lit.shape[1] - 1), axis=1)
    slots[(at < 0) | (at >= lit.shape[1])] = 0.5
    slots[:, lead : lead + SLOTS_PER_SYMBOL] = words
    skip = model.exposure.isi_memory * q
    return _paired(model.exposure.mean_light(slots)[:, skip:-skip])


def _process_likelihood(
    halves: _Halves, column: NDArray[np.int64], start: NDArray[np.int64], levels: Float32Array, model: ObservationModel
) -> FloatArray:
    """(R,) log-likelihood of R words, added over the strips, each with its likeliest picture processes."""
    n, width = halves.light.shape[2], levels.shape[1]
    at = 2 * (start[:, None] - SETTINGS.around_slots) + np.arange(width)
    index = (column[None, :, None], np.arange(halves.light.shape[1])[None, None], np.clip(at, 0, n - 1).T[:, :, None])
    # From here on time is the first axis: (W, R, S).
    mean, observed = halves.mean[index], halves.observed[index] & ((at >= 0) & (at < n)).T[:, :, None]
    gain = (halves.neighbours[index] + model.crosstalk.own[..., 0] * levels.T[:, :, None]) * mean
    # The noise is not halved: adjacent samples are interpolated between the same rows.
    noise = model.noise.variance(gain)
    residual = np.where(observed, halves.light[index] - gain, np.float32(0))
    gain = np.where(observed, gain, np.float32(0))
    kinds = _innovations(residual, gain, noise, SETTINGS.picture_kinds)
    return np.asarray(np.logaddexp.reduce(kinds, axis=0).sum(axis=1), np.float64)


def _innovations(
    residual: Float32Array, gain: Float32Array, noise: Float32Array, kinds: tuple[tuple[float, float], ...]
) -> Float32Array:
    """(kinds, R, S) log-likelihood, up to a constant, of the picture's deviation from its mean, by a Kalman filter.

    Args:
        residual: (W, R, S) light minus that of the mean picture.
        gain: (W, R, S) light per unit of relative deviation; 0 where nothing is visible.
        noise: (W, R, S) variance of the light.
        kinds: standard deviation and correlation length in slots of every picture process.
    """
    deviation, length = np.array(kinds, np.float32).T[:, :, None, None]
    keep, power = np.exp(np.float32(-0.5) / length), np.square(deviation)
    state = np.zeros((len(kinds), *residual.shape[1:]), np.float32)
    variance, total = state + power, state.copy()
    for light, slope, error in zip(residual, gain, noise, strict=True):
        covariance = slope * variance
        innovation_variance = covariance * slope
        innovation_variance += error
        innovation = light - slope * state
        step = innovation / innovation_variance
        innovation *= step
        total += innovation
        total += np.log(innovation_variance)
        np.divide(covariance, innovation_variance, out=innovation_variance)
        step *= covariance
        state += step
        state *= keep
        covariance *= innovation_variance
        variance -= covariance
        variance -= power
        variance *= keep * keep
        variance += power
    total *= np.float32(-0.5)
    return total


def _as_slots(score: FloatArray, words: NDArray[np.uint8]) -> FloatArray:
    """(J, 10) smallest slot corrections that add up to the scores of words (J, K) relative to the first word."""
    wanted = score[:, 1:] - score[:, :1]
    difference = words[:, 1:].astype(np.float64) - words[:, :1]
    gram = difference @ difference.transpose(0, 2, 1) + _MIN_NORM * np.eye(difference.shape[1])
    return np.asarray((np.linalg.solve(gram, wanted[..., None]).transpose(0, 2, 1) @ difference)[:, 0])
