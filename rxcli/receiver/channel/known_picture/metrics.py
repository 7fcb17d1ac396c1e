"""The light's likelihood under every pattern of slots."""

from __future__ import annotations

from functools import cache

import numpy as np

from rxcli.protocol import slot_patterns
from rxcli.receiver.channel.known_picture.exposure import ExpectedLight, SlotView
from rxcli.receiver.channel.known_picture.picture import ColumnLight
from rxcli.receiver.channel.known_picture.settings import SETTINGS
from rxcli.receiver.channel.likelihoods import SlotLikelihoods
from rxcli.types import Clock, Float32Array, FloatArray, IntArray


def slot_likelihoods(observed: ColumnLight, expected: ExpectedLight, clock: Clock, isi_memory: int) -> SlotLikelihoods:
    """Log-likelihood of every slot pattern at every slot, as `channel.slot_likelihoods` has it of an unknown picture.

    Args:
        observed: the columns' light.
        expected: light that the present idea of the slots gives.
        clock: the clock.
        isi_memory: slots of memory.
    """
    value = (observed.value - expected.beside) * observed.precision
    parts = [
        _row_metrics(value[group], observed.precision[group], view, clock.n_slots, isi_memory)
        for group, view in expected.views
    ]
    # Squared contrast over variance of a slot is the precision of the rows around.
    some = np.sort(observed.precision[:, :: SETTINGS.snr_every_row], axis=1)
    snr = some[:, some.shape[1] // 2, None] * np.float32(clock.rows_per_slot)
    return SlotLikelihoods(np.concatenate(parts), snr)


def _row_metrics(
    weighted: Float32Array, precision: Float32Array, view: SlotView, n_slots: int, isi_memory: int
) -> FloatArray:
    """Metrics of columns that are alike; `weighted` is their light times its precision, (C, R)."""
    borders = np.searchsorted(view.metric, np.arange(n_slots + isi_memory + 1))
    sums, basis = _slot_sums(weighted, precision, view.share[1:-1], borders), _pattern_basis(isi_memory)
    metrics = sums.reshape(len(basis), -1).T @ basis
    return metrics.reshape(*sums.shape[1:], -1).astype(np.float64)


def _slot_sums(weighted: Float32Array, precision: Float32Array, share: Float32Array, borders: IntArray) -> Float32Array:
    """What the rows of every metric add up to: J sums of light, then of the precision of every pair of shares.

    Args:
        weighted: (C, R) light times precision.
        precision: (C, R).
        share: (J, R) share of each slot in a row.
        borders: (n + 1,) first row of every metric, and the end of the last.

    Returns:
        (J + J (J + 1) / 2, C, n).
    """
    n_shares, (first, second) = len(share), _pairs(len(share))
    terms = np.concatenate([share, share[first] * share[second]])
    counts = np.diff(borders)
    sums = np.zeros((len(terms), weighted.shape[0], counts.size), np.float32)
    # The first rows of all metrics, then the second ones, and so on: long vectors, where metrics have few rows each.
    for place in range(int(counts.max(initial=0))):
        rows = np.minimum(borders[:-1] + place, weighted.shape[1] - 1)
        here = terms.take(rows, axis=1) * (place < counts)
        sums[:n_shares] += here[:n_shares, None] * weighted.take(rows, axis=1)
        sums[n_shares:] += here[n_shares:, None] * precision.take(rows, axis=1)
    return sums


@cache
def _pairs(n: int) -> tuple[IntArray, IntArray]:
    """Every two of `n`, and each with itself."""
    first, second = np.triu_indices(n)
    return first, second


@cache
def _pattern_basis(isi_memory: int) -> Float32Array:
    """(terms, patterns) how `_slot_sums` make up the log-likelihood of every pattern."""
    patterns = slot_patterns(isi_memory).astype(np.float32)
    first, second = _pairs(isi_memory + 1)
    power = patterns[:, first] * patterns[:, second] * np.where(first == second, np.float32(0.5), np.float32(1))
    return np.ascontiguousarray(np.concatenate([patterns, -power], axis=1).T)
