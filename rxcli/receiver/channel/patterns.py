"""Metrics of slot patterns; slots and metrics on the grid of a frame, and by burst."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rxcli.protocol import slot_patterns
from rxcli.receiver.channel.settings import SETTINGS
from rxcli.receiver.light import Exposure
from rxcli.types import Clock, Float32Array, FloatArray


def first_metrics(pooled: Float32Array, weight: Float32Array, exposure: Exposure) -> FloatArray:
    """First guess of the metrics (C, N + memory, patterns), from contrast alone.

    Args:
        pooled: (C, N * Q) light between its local extremes, -1 dark to 1 lit.
        weight: (C, N * Q) strips of full contrast behind it.
        exposure: of the samples.
    """
    # Squared errors, so weighted that a slot seen right in all samples has the log-likelihood ratio of the constant.
    most = np.float32(SETTINGS.first_llr / 4 / exposure.samples_per_slot)
    trust = np.minimum(weight / np.float32(SETTINGS.first_strips), 1) * most
    value = np.clip(pooled, -1.5, 1.5)
    return by_pattern(exposure, pooled.shape[1], lambda levels: -np.square(value - (2 * levels - 1)) * trust)


def by_pattern(exposure: Exposure, n: int, of_levels: Callable[[Float32Array], Float32Array]) -> FloatArray:
    """(C, N + memory, patterns) sums over the samples of a metric of what (C, n) samples say of every pattern.

    Args:
        exposure: of the samples.
        n: samples.
        of_levels: from the (n,) levels between dark and lit that a pattern has in every sample, to (C, n).
    """
    q, isi_memory = exposure.samples_per_slot, exposure.isi_memory
    lead = isi_memory * q // 2
    # Many patterns have the same level in a sample, which need be asked but once: `chosen` numbers a sample's levels.
    levels = slot_patterns(isi_memory) @ exposure.taps.T
    distinct = [np.unique(in_sample, return_inverse=True) for in_sample in levels.T]
    chosen = np.stack([number for _, number in distinct], axis=1)
    tables = np.stack([np.resize(values, chosen.max() + 1) for values, _ in distinct], axis=1)
    asked = []
    for of_samples in tables:
        # Sample i belongs to metric (i + lead) // q.
        values = of_levels(np.tile(np.roll(of_samples, -(lead % q)).astype(np.float32), -(-n // q))[:n])
        padded = np.zeros((values.shape[0], n + isi_memory * q), np.float32)
        padded[:, lead : lead + n] = values
        asked.append([padded[:, place::q] for place in range(q)])
    out = np.empty((*asked[0][0].shape, levels.shape[0]))
    for pattern, numbers in enumerate(chosen):
        total = asked[numbers[0]][0].copy()
        for place in range(1, q):
            total += asked[numbers[place]][place]
        out[..., pattern] = total
    return out


def metrics_of(llr: Float32Array, isi_memory: int) -> FloatArray:
    """Metrics (C, N + memory, patterns) of slots (C, N) that are independent, given their log-likelihood ratios."""
    padded = np.pad(llr, ((0, 0), (0, isi_memory)))
    return np.asarray(padded[..., None] / 2 * (2.0 * slot_patterns(isi_memory)[:, -1] - 1))


def by_burst(metrics: FloatArray, clock: Clock) -> FloatArray:
    """Metrics of the grid (C, N + memory, patterns) added over the copies of each burst.

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
