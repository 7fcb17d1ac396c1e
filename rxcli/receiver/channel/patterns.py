"""Log-likelihood ratios of slots from the likelihoods of slot patterns, which resolves inter-symbol interference."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import count

import numpy as np

from rxcli.numerics import MIN_FLOAT32
from rxcli.protocol import SLOTS_PER_SYMBOL, codewords, slot_patterns
from rxcli.receiver.light import Exposure
from rxcli.types import Clock, Float32Array

#: Passes over the slots, each with the neighbours as the pass before has them.
_PASSES = 3
#: Least distance of a slot's probability from 0 and 1, and the largest log-likelihood ratio.
_MIN_DOUBT = 1e-4
_MAX_LLR = np.float32(np.log(1 / _MIN_DOUBT - 1))


def llr_of(lit: Float32Array) -> Float32Array:
    """Log-likelihood ratios of slots from their probabilities."""
    bounded = np.clip(lit, _MIN_DOUBT, 1 - _MIN_DOUBT)
    return np.asarray(np.log(bounded) - np.log1p(-bounded), np.float32)


def lit_of(llr: Float32Array) -> Float32Array:
    """Probabilities that slots are lit, from their log-likelihood ratios."""
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * llr), np.float32)


def slot_llr(metrics: Float32Array, lit: Float32Array | None = None) -> Float32Array:
    """(C, N) log-likelihood ratio of each slot being lit by its own light; see `propagated`."""
    llr, _ = propagated(metrics, lit)
    return llr


def propagated(metrics: Float32Array, lit: Float32Array | None = None) -> tuple[Float32Array, Float32Array]:
    """Log-likelihood ratios of slots being lit by their own light.

    A slot contributes to its own metric and to the `isi_memory` metrics after it; their ratios are added. A metric's
    ratio for a slot takes the other slots from the other metrics alone (belief propagation), so that none counts twice.

    Args:
        metrics: (C, N + memory, patterns) log-likelihood of every pattern of slots n - memory .. n.
        lit: (C, N) probability that each slot is lit, as far as it concerns its neighbours; None: by their own light.

    Returns:
        (C, N) of each slot; and (memory + 1, C, N + memory) of the slot `age` slots ago, as the other metrics have it.
    """
    isi_memory = int(metrics.shape[-1]).bit_length() - 2
    n_columns, n_metrics, n_patterns = metrics.shape
    is_lit = _lit_by_age(isi_memory)
    # Patterns first: long vectors although patterns are few.
    by_pattern = np.ascontiguousarray(metrics.reshape(-1, n_patterns).T, np.float32)
    is_shown = np.ptp(by_pattern, axis=0).reshape(n_columns, n_metrics) > 0
    # With the slots before and after the grid, which the first and the last metrics show as well.
    llr = np.zeros((n_columns, n_metrics + isi_memory), np.float32)
    if lit is not None:
        llr[:, isi_memory:n_metrics] = llr_of(lit)
    of_age = [slice(isi_memory - age, isi_memory - age + n_metrics) for age in range(isi_memory + 1)]
    gained = np.zeros((isi_memory + 1, n_columns, n_metrics), np.float32)

    def odds_of(llr: Float32Array, gained: Float32Array) -> Float32Array:
        return np.asarray(np.clip(np.stack([llr[:, part] for part in of_age]) - gained, -_MAX_LLR, _MAX_LLR))

    for _ in range(_PASSES if lit is None else 1):
        odds = odds_of(llr, gained)
        likelihood = is_lit.T @ odds.reshape(isi_memory + 1, -1)
        likelihood += by_pattern
        likelihood -= likelihood.max(axis=0)
        np.exp(likelihood, out=likelihood)
        gained = np.log(is_lit @ likelihood + MIN_FLOAT32) - np.log((1 - is_lit) @ likelihood + MIN_FLOAT32)
        gained = (gained.reshape(odds.shape) - odds) * is_shown
        llr = np.zeros_like(llr)
        for part, values in zip(of_age, gained, strict=True):
            llr[:, part] += values
    return llr[:, isi_memory:n_metrics], odds_of(llr, gained)


def word_metrics(metrics: Float32Array, llr: Float32Array, odds: Float32Array, clock: Clock) -> Float32Array:
    """Log-likelihood of slot patterns in words beyond the ratios of their slots, as samples see several slots at once.

    The metrics at the ends of a word are averaged over the slots of adjacent words.

    Args:
        metrics, llr, odds: see `propagated`.
        clock: of their N slots.

    Returns:
        (C, copies, symbols, (10 + memory) * patterns), see `beyond_slots`.
    """
    n, isi_memory = SLOTS_PER_SYMBOL, len(odds) - 1

    def by_symbol(values: Float32Array) -> Float32Array:
        out = np.zeros((*values.shape[:-1], clock.n_copies * clock.packet_slots + isi_memory), np.float32)
        out[..., clock.first_slot : clock.first_slot + values.shape[-1]] = values
        return np.lib.stride_tricks.sliding_window_view(out, n + isi_memory, axis=-1)[..., ::n, :]

    is_lit, age = _lit_by_age(isi_memory), np.arange(isi_memory + 1)
    by_pattern = by_symbol(np.moveaxis(metrics, -1, 0)).copy()
    by_pattern[is_lit[0] > 0, ..., :n] -= by_symbol(llr)[..., :n]
    adjacent = by_symbol(odds)
    for place in (*range(isi_memory), *range(n, n + isi_memory)):
        beyond = (age > place) | (age <= place - n)
        own = by_pattern[..., place] + np.tensordot(is_lit[beyond], adjacent[beyond, ..., place], (0, 0))
        top = own.max(axis=0)
        agree = (is_lit[~beyond, :, None] == is_lit[~beyond, None]).all(axis=0).astype(np.float32)
        by_pattern[..., place] = top + np.log(np.tensordot(agree, np.exp(own - top), 1) + MIN_FLOAT32)
    return np.moveaxis(by_pattern, 0, -1).reshape(len(llr), clock.n_copies, clock.packet_slots // n, -1)


def beyond_slots(metrics: Float32Array) -> Float32Array:
    """(..., words) log-likelihood of the words in `codewords` beyond that of their slots, 0 on average."""
    isi_memory = next(n for n in count() if (SLOTS_PER_SYMBOL + n) << (n + 1) == metrics.shape[-1])
    found = metrics @ _word_patterns(isi_memory)
    return np.asarray(found - found.mean(axis=-1, keepdims=True))


@cache
def _word_patterns(isi_memory: int) -> Float32Array:
    """((10 + memory) * patterns, words): 1 where a metric has a pattern; adjacent slots do not count and are dark."""
    slots = np.pad(codewords()[0].astype(np.int64), ((0, 0), (isi_memory, isi_memory)))
    windows = np.lib.stride_tricks.sliding_window_view(slots, isi_memory + 1, axis=1)
    number = windows @ (1 << np.arange(isi_memory, -1, -1))
    has_pattern = number.T[:, None] == np.arange(2 << isi_memory)[:, None]
    return np.asarray(has_pattern.reshape(-1, len(slots)), np.float32)


@cache
def _lit_by_age(isi_memory: int) -> Float32Array:
    """(memory + 1, patterns): 1 where the slot `age` slots ago is lit."""
    return np.ascontiguousarray(slot_patterns(isi_memory)[:, ::-1].T, np.float32)


def initial_llr(pooled: Float32Array, weight: Float32Array, exposure: Exposure) -> Float32Array:
    """(C, N) initial log-likelihood ratio of each slot being lit, from contrast alone.

    Args:
        pooled: (C, N * Q) light between its local extremes, -1 dark to 1 lit.
        weight: (C, N * Q) its weight, in strips of full contrast.
        exposure: exposure of the samples.
    """
    # Squared errors, weighted so that a slot that fits in all samples has a log-likelihood ratio of 8 in three strips
    # of full contrast.
    q = exposure.samples_per_slot
    precision = np.minimum(weight / 3, 1) * np.float32(2 / q)

    def of_level(place: int, level: float) -> Float32Array:
        return np.asarray(-np.square(pooled[:, place::q] - np.float32(2 * level - 1)) * precision[:, place::q])

    return slot_llr(by_pattern(exposure, of_level))


def by_pattern(exposure: Exposure, of_level: Callable[[int, float], Float32Array]) -> Float32Array:
    """(C, N + memory, patterns) log-likelihood of every pattern, summed over the samples of a metric.

    Args:
        exposure: exposure of the samples.
        of_level: function of the position in the slot and a level between dark and lit; returns the log-likelihood of
            that level for the samples at that position, (C, N).
    """
    plan = _level_plan(exposure.taps.tobytes(), exposure.samples_per_slot)
    by_level = [of_level(place, level) for place, level in zip(plan.places, plan.levels, strict=True)]
    n_columns, n_slots = by_level[0].shape
    of_metrics = np.zeros((n_columns, len(by_level), n_slots + exposure.isi_memory), np.float32)
    for number, (metric, values) in enumerate(zip(plan.metrics, by_level, strict=True)):
        of_metrics[:, number, metric : metric + n_slots] = values
    return np.asarray(of_metrics.swapaxes(1, 2) @ plan.shares)


@dataclass(frozen=True, slots=True)
class _LevelPlan:
    """K levels at which likelihoods are evaluated, and their combination into patterns."""

    #: (K,) position in the slot, level, and index of the metric relative to the first metric of the slot.
    places: list[int]
    levels: list[float]
    metrics: list[int]
    #: (K, patterns) 1 where a pattern has the level.
    shares: Float32Array


@lru_cache
def _level_plan(taps: bytes, samples_per_slot: int) -> _LevelPlan:
    q = samples_per_slot
    weights = np.frombuffer(taps).reshape(q, -1)
    isi_memory = weights.shape[1] - 1
    # Sample i belongs to metric (i + lead) // q.
    lead = isi_memory * q // 2
    places, evaluated, metrics, shares = [], [], [], []
    for place in range(q):
        metric, sample = divmod(place + lead, q)
        # Many patterns have the same level in a sample, which is evaluated once.
        levels, number = np.unique((slot_patterns(isi_memory) @ weights[sample]).round(9), return_inverse=True)
        places += [place] * levels.size
        metrics += [metric] * levels.size
        evaluated += levels.tolist()
        shares.append(np.eye(levels.size)[number].T)
    return _LevelPlan(places, evaluated, metrics, np.concatenate(shares).astype(np.float32))
