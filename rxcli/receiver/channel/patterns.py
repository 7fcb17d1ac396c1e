"""Metrics of slot patterns, and their conversion between the grid of a frame and bursts."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rxcli.protocol import slot_patterns
from rxcli.receiver.light import Exposure
from rxcli.types import Clock, Float32Array, FloatArray


def initial_metrics(pooled: Float32Array, weight: Float32Array, exposure: Exposure) -> FloatArray:
    """Initial metrics (C, N + memory, patterns), from contrast alone.

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

    return by_pattern(exposure, of_level)


def by_pattern(exposure: Exposure, of_level: Callable[[int, float], Float32Array]) -> FloatArray:
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
    return np.asarray(of_metrics.swapaxes(1, 2) @ plan.shares, np.float64)


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


def metrics_of(llr: Float32Array, isi_memory: int) -> FloatArray:
    """Metrics (C, N + memory, patterns) of independent slots, from their log-likelihood ratios (C, N)."""
    padded = np.pad(llr, ((0, 0), (0, isi_memory)))
    return np.asarray(padded[..., None] / 2 * (2.0 * slot_patterns(isi_memory)[:, -1] - 1))


def by_burst(metrics: FloatArray, clock: Clock) -> FloatArray:
    """Add the metrics of the grid (C, N + memory, patterns) over the copies of each burst.

    Returns:
        (B, C, packet + memory, patterns); see `detect.detect`.
    """
    n_columns, n_metrics, n_patterns = metrics.shape
    length, isi_memory = clock.packet_slots, n_metrics - clock.n_slots
    padded = np.zeros((n_columns, clock.n_copies * length + isi_memory, n_patterns))
    end = min(clock.first_slot + metrics.shape[1], padded.shape[1])
    padded[:, clock.first_slot : end] = metrics[:, : end - clock.first_slot]
    out = np.zeros((int(clock.burst.max()) + 1, n_columns, length + isi_memory, n_patterns))
    for copy, burst in enumerate(clock.burst):
        out[burst] += padded[:, copy * length : (copy + 1) * length + isi_memory]
    out[:, :, :isi_memory] = 0
    return out
