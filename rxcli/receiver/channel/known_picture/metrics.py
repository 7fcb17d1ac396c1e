"""Log-likelihood ratio of every slot."""

from functools import cache

import numpy as np

from rxcli.protocol import slot_patterns
from rxcli.receiver.channel.known_picture.exposure import ExpectedLight, SlotView
from rxcli.receiver.channel.known_picture.picture import ColumnLight
from rxcli.receiver.channel.likelihoods import SlotLikelihoods
from rxcli.receiver.channel.patterns import propagated, word_metrics
from rxcli.types import Clock, Float32Array, IntArray


def slot_likelihoods(observed: ColumnLight, expected: ExpectedLight, clock: Clock, isi_memory: int) -> SlotLikelihoods:
    """Log-likelihood ratio of every slot, the counterpart of `channel.slot_likelihoods`.

    Args:
        observed: the columns' light.
        expected: light predicted from the current estimate of the slots.
        clock: the clock.
        isi_memory: ISI memory.
    """
    value = (observed.value - expected.beside) * observed.precision
    parts = [
        _row_metrics(value[group], observed.precision[group], view, clock.n_slots, isi_memory)
        for group, view in expected.views
    ]
    # Squared contrast over variance of a slot is the precision of the rows around; a row of every slot shows it.
    some = observed.precision[:, :: max(int(clock.rows_per_slot), 1)]
    snr = np.median(some, axis=1, keepdims=True) * np.float32(clock.rows_per_slot)
    metrics = np.concatenate(parts)
    llr, odds = propagated(metrics)
    return SlotLikelihoods(llr, snr, words=word_metrics(metrics, llr, odds, clock))


def _row_metrics(
    weighted: Float32Array, precision: Float32Array, view: SlotView, n_slots: int, isi_memory: int
) -> Float32Array:
    """Metrics of columns with equal delay; `weighted` (C, R) is their light times its precision."""
    borders = np.searchsorted(view.metric, np.arange(n_slots + isi_memory + 1))
    sums, basis = _slot_sums(weighted, precision, view.share[1:-1], borders), _pattern_basis(isi_memory)
    metrics = sums.reshape(len(basis), -1).T @ basis
    return metrics.reshape(*sums.shape[1:], -1)


def _slot_sums(weighted: Float32Array, precision: Float32Array, share: Float32Array, borders: IntArray) -> Float32Array:
    """Sums over the rows of every metric: J sums of light, then sums of precision for every pair of shares.

    Args:
        weighted: (C, R) light times precision.
        precision: (C, R).
        share: (J, R) share of each slot in a row.
        borders: (n + 1,) first row of every metric, and the end of the last.

    Returns:
        (J + J (J + 1) / 2, C, n).
    """
    n_shares, (left, right) = len(share), _pairs(len(share))
    terms = np.concatenate([share, share[left] * share[right]])
    counts = np.diff(borders)
    sums = np.zeros((len(terms), weighted.shape[0], counts.size), np.float32)
    # All metrics' first rows, then all second rows, and so on: long vectors although metrics have few rows.
    for place in range(int(counts.max(initial=0))):
        rows = np.minimum(borders[:-1] + place, weighted.shape[1] - 1)
        here = terms.take(rows, axis=1) * (place < counts)
        sums[:n_shares] += here[:n_shares, None] * weighted.take(rows, axis=1)
        sums[n_shares:] += here[n_shares:, None] * precision.take(rows, axis=1)
    return sums


@cache
def _pairs(n: int) -> tuple[IntArray, IntArray]:
    """All pairs of `n` indices, including equal ones."""
    left, right = np.triu_indices(n)
    return left, right


@cache
def _pattern_basis(isi_memory: int) -> Float32Array:
    """(terms, patterns) coefficients of `_slot_sums` in the log-likelihood of every pattern."""
    patterns = slot_patterns(isi_memory).astype(np.float32)
    left, right = _pairs(isi_memory + 1)
    power = patterns[:, left] * patterns[:, right] * np.where(left == right, np.float32(0.5), np.float32(1))
    return np.ascontiguousarray(np.concatenate([patterns, -power], axis=1).T)
