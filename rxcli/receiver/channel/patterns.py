"""Metrics of slot patterns; slots and metrics on the grid of a frame, and by burst."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rxcli.protocol import slot_patterns
from rxcli.receiver.channel.settings import SETTINGS
from rxcli.receiver.light import Exposure
from rxcli.types import Clock, Float32Array, FloatArray

#: Levels between dark and lit at which samples are asked where patterns have more of them, as with exposures of more
#: than two slots: a polynomial through Chebyshev's nodes tells the others. Five lose packets of clear pictures.
_NODES = 0.5 - 0.5 * np.cos(np.pi * np.arange(8) / 7)


def initial_metrics(pooled: Float32Array, weight: Float32Array, exposure: Exposure) -> FloatArray:
    """First guess of the metrics (C, N + memory, patterns), from contrast alone.

    Args:
        pooled: (C, N * Q) light between its local extremes, -1 dark to 1 lit.
        weight: (C, N * Q) strips of full contrast behind it.
        exposure: of the samples.
    """
    # Squared errors, so weighted that a slot seen right in all samples has the log-likelihood ratio of the constant.
    q = exposure.samples_per_slot
    most = np.float32(SETTINGS.initial_llr / 4 / q)
    trust = np.minimum(weight / np.float32(SETTINGS.initial_full_strips), 1) * most
    value = np.clip(pooled, -1.5, 1.5)

    def of_level(place: int, level: float) -> Float32Array:
        return np.asarray(-np.square(value[:, place::q] - np.float32(2 * level - 1)) * trust[:, place::q])

    return by_pattern(exposure, of_level)


def by_pattern(exposure: Exposure, of_level: Callable[[int, float], Float32Array]) -> FloatArray:
    """(C, N + memory, patterns) sums over the samples of a metric of what they say of every pattern.

    Args:
        exposure: of the samples.
        of_level: from a place in the slot and a level between dark and lit to what the samples there say of that level,
            (C, N).
    """
    asked = _asked_levels(exposure.taps.tobytes(), exposure.samples_per_slot)
    said = [of_level(place, level) for place, level in zip(asked.places, asked.levels, strict=True)]
    n_columns, n_slots = said[0].shape
    of_metrics = np.zeros((n_columns, len(said), n_slots + exposure.isi_memory), np.float32)
    for number, (metric, values) in enumerate(zip(asked.metrics, said, strict=True)):
        of_metrics[:, number, metric : metric + n_slots] = values
    return np.asarray(of_metrics.swapaxes(1, 2) @ asked.shares, np.float64)


@dataclass(frozen=True, slots=True)
class _AskedLevels:
    """Levels at which samples are asked, K of them, and what patterns make of the answers."""

    #: (K,) place in the slot, level, and how many metrics later than its slot's first the sample counts.
    places: list[int]
    levels: list[float]
    metrics: list[int]
    #: (K, patterns) share of each answer in the sum of a pattern.
    shares: Float32Array


@lru_cache(maxsize=32)
def _asked_levels(taps: bytes, samples_per_slot: int) -> _AskedLevels:
    q = samples_per_slot
    weights = np.frombuffer(taps).reshape(q, -1)
    isi_memory = weights.shape[1] - 1
    # Sample i belongs to metric (i + lead) // q.
    lead = isi_memory * q // 2
    places, asked, metrics, shares = [], [], [], []
    for place in range(q):
        metric, sample = divmod(place + lead, q)
        # Many patterns have the same level in a sample, which need be asked but once.
        levels, number = np.unique((slot_patterns(isi_memory) @ weights[sample]).round(9), return_inverse=True)
        if levels.size <= _NODES.size:
            share = np.eye(levels.size)[number]
        else:
            levels, share = _NODES, _interpolated(levels)[number]
        places += [place] * levels.size
        metrics += [metric] * levels.size
        asked += levels.tolist()
        shares.append(share.T)
    return _AskedLevels(places, asked, metrics, np.concatenate(shares).astype(np.float32))


def _interpolated(levels: FloatArray) -> FloatArray:
    """(levels, nodes) shares of what is said at the nodes in the polynomial through them."""
    others = ~np.eye(_NODES.size, dtype=bool)
    ratios = (levels[:, None, None] - _NODES) / np.where(others, _NODES[:, None] - _NODES, 1)
    return np.asarray(np.where(others, ratios, 1).prod(axis=2))


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
