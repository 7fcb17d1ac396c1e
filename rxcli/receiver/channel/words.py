"""Likely words of symbols in doubt, weighed as a whole."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import box_sums
from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL
from rxcli.receiver.channel.model import ObservationModel
from rxcli.receiver.channel.settings import SETTINGS
from rxcli.types import Clock, Float32Array, FloatArray, SlotSamples

#: Words that are alike make no singular system.
_MIN_NORM = 1e-3


@dataclass(frozen=True, slots=True)
class _Halves:
    """Light of some columns at two samples a slot; (C, S, 2 N) float32."""

    #: Light over the floor.
    light: Float32Array
    #: Mean picture around.
    mean: Float32Array
    #: Light of the adjacent columns per unit of picture.
    others: Float32Array
    #: Whether both samples are seen.
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
    """What to add to the log-likelihood ratio of every slot, so that words count as the light as a whole has them.

    Args:
        samples: of the columns to look at, S strips, N slots of four samples.
        clock: the clock.
        model: the light model.
        lit: (C, N) probability that each slot is lit, of all columns.
        columns: which columns the samples are of.
        places: (J, 3) burst, place in `columns` and number of each symbol in doubt.
        words: (J, K, 10) its likeliest words, best first.

    Returns:
        (len(columns), N); 0 for symbols that are not in doubt.
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
    # Both halves of a slot together count as any other number of samples would.
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
    """Put the corrections (J, 10) of symbols on the grid, each shared alike among the copies that show the slot."""
    at = start[:, None] + np.arange(SLOTS_PER_SYMBOL)
    inside = (at >= 0) & (at < out.shape[1])
    count = np.zeros(slots.shape)
    np.add.at(count, symbol, inside)
    share = (slots / np.maximum(count, 1))[symbol]
    rows = np.broadcast_to(column[:, None], at.shape)
    out[rows[inside], at[inside]] = share[inside]


def _occurrences(places: NDArray[np.int64], clock: Clock) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Of every copy of the symbols on the grid: which symbol, and its first slot."""
    symbol, copy = np.nonzero(places[:, :1] == clock.burst)
    start = copy * clock.packet_slots + PREAMBLE_SLOTS + SLOTS_PER_SYMBOL * places[symbol, 2] - clock.first_slot
    there = (start > -SLOTS_PER_SYMBOL) & (start < clock.n_slots)
    return symbol[there], start[there]


def _halves(
    samples: SlotSamples, clock: Clock, model: ObservationModel, lit: Float32Array, columns: NDArray[np.int64]
) -> _Halves:
    expected, light, q = model.expected(lit, clock, columns), model.over_black(samples), samples.samples_per_slot
    weight = expected.whole * samples.valid
    light_around, seen_around = (box_sums(part * weight, SETTINGS.level_slots * q) for part in (light, weight))
    mean = np.maximum(light_around, np.float32(0)) / np.maximum(seen_around, np.float32(1e-3))
    observed = _paired(samples.valid) > 0.9
    return _Halves(_paired(light), _paired(mean.astype(np.float32)), _paired(expected.others), observed)


def _paired(values: Float32Array) -> Float32Array:
    """Means of the two samples of every half of a slot, last axis."""
    return np.asarray((values[..., ::2] + values[..., 1::2]) * np.float32(0.5), np.float32)


def _word_levels(
    lit: Float32Array, start: NDArray[np.int64], words: NDArray[np.uint8], model: ObservationModel
) -> Float32Array:
    """(R, W) mean of the exposure over a word and the slots around it, as believed, at two samples a slot.

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
    """(R,) log-likelihood of the light by R words, strips added, whatever kind of picture each shows."""
    n, width = halves.light.shape[2], levels.shape[1]
    at = 2 * (start[:, None] - SETTINGS.around_slots) + np.arange(width)
    index = (column[None, :, None], np.arange(halves.light.shape[1])[None, None], np.clip(at, 0, n - 1).T[:, :, None])
    # From here on time comes first: (W, R, S).
    mean, observed = halves.mean[index], halves.observed[index] & ((at >= 0) & (at < n)).T[:, :, None]
    gain = (halves.others[index] + model.crosstalk.own[..., 0] * levels.T[:, :, None]) * mean
    # Two adjacent samples are interpolated between the same rows.
    noise = model.noise.variance(gain)
    residual = np.where(observed, halves.light[index] - gain, np.float32(0))
    gain = np.where(observed, gain, np.float32(0))
    kinds = _innovations(residual, gain, noise, SETTINGS.picture_kinds)
    return np.asarray(np.logaddexp.reduce(kinds, axis=0).sum(axis=1), np.float64)


def _innovations(
    residual: Float32Array, gain: Float32Array, noise: Float32Array, kinds: tuple[tuple[float, float], ...]
) -> Float32Array:
    """(kinds, R, S) log-likelihood, up to a constant, of light that follows the picture's deviation from its mean.

    Args:
        residual: (W, R, S) light less that of the mean picture.
        gain: (W, R, S) light per unit of relative deviation; 0 where nothing is seen.
        noise: (W, R, S) variance of the light.
        kinds: standard deviation of the process, and slots after which it is another one, of every kind of picture.
    """
    deviation, length = np.array(kinds, np.float32).T[:, :, None, None]
    keep, power = np.exp(np.float32(-0.5) / length), np.square(deviation)
    state = np.zeros((len(kinds), *residual.shape[1:]), np.float32)
    variance, total = state + power, state.copy()
    for light, slope, error in zip(residual, gain, noise, strict=True):
        shared = slope * variance
        crosstalk = shared * slope
        crosstalk += error
        innovation = light - slope * state
        step = innovation / crosstalk
        innovation *= step
        total += innovation
        total += np.log(crosstalk)
        np.divide(shared, crosstalk, out=crosstalk)
        step *= shared
        state += step
        state *= keep
        shared *= crosstalk
        variance -= shared
        variance -= power
        variance *= keep * keep
        variance += power
    total *= np.float32(-0.5)
    return total


def _as_slots(score: FloatArray, words: NDArray[np.uint8]) -> FloatArray:
    """(J, 10) least corrections of single slots that add up to what words (J, K) score against the first of them."""
    wanted = score[:, 1:] - score[:, :1]
    apart = words[:, 1:].astype(np.float64) - words[:, :1]
    across = apart @ apart.transpose(0, 2, 1) + _MIN_NORM * np.eye(apart.shape[1])
    return np.asarray((np.linalg.solve(across, wanted[..., None]).transpose(0, 2, 1) @ apart)[:, 0])
