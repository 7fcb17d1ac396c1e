"""Log-likelihood ratios of slots from the likelihoods of slot patterns, which resolves inter-symbol interference."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np

from rxcli.numerics import MIN_FLOAT32
from rxcli.protocol import slot_patterns
from rxcli.receiver.light import Exposure
from rxcli.types import Float32Array

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
    """(C, N) log-likelihood ratio of each slot being lit by its own light.

    A slot contributes to its own metric and to the `isi_memory` metrics after it; their ratios are added. A metric's
    ratio for a slot takes the other slots from the other metrics alone (belief propagation), so that none counts twice.

    Args:
        metrics: (C, N + memory, patterns) log-likelihood of every pattern of slots n - memory .. n.
        lit: (C, N) probability that each slot is lit, as far as it concerns its neighbours; None: by their own light.
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
    for _ in range(_PASSES if lit is None else 1):
        odds = np.clip(np.stack([llr[:, part] for part in of_age]) - gained, -_MAX_LLR, _MAX_LLR)
        likelihood = is_lit.T @ odds.reshape(isi_memory + 1, -1)
        likelihood += by_pattern
        likelihood -= likelihood.max(axis=0)
        np.exp(likelihood, out=likelihood)
        gained = np.log(is_lit @ likelihood + MIN_FLOAT32) - np.log((1 - is_lit) @ likelihood + MIN_FLOAT32)
        gained = (gained.reshape(odds.shape) - odds) * is_shown
        llr = np.zeros_like(llr)
        for part, values in zip(of_age, gained, strict=True):
            llr[:, part] += values
    return llr[:, isi_memory:n_metrics]


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
