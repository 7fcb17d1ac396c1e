"""The light's likelihood under every pattern of slots."""

from __future__ import annotations

import numpy as np

from rxcli.protocol import slot_patterns
from rxcli.receiver.channel.known_picture.exposure import Response, alike_columns, shares_of_slots
from rxcli.receiver.channel.known_picture.picture import ColumnLight
from rxcli.receiver.channel.known_picture.settings import SETTINGS
from rxcli.receiver.channel.likelihoods import SlotLikelihoods
from rxcli.types import Clock, Float32Array, FloatArray, IntArray


def slot_likelihoods(
    observed: ColumnLight,
    positions: FloatArray,
    clock: Clock,
    isi_memory: int,
    response: Response,
    expected: Float32Array,
    lit: Float32Array,
) -> SlotLikelihoods:
    """Log-likelihood of every slot pattern at every slot, as `channel.slot_likelihoods` has it of an unknown picture.

    Args:
        observed: the columns' light.
        positions: (C, R) or (1, R) exposure's centre of the rows, in slots.
        clock: the clock.
        isi_memory: slots of memory.
        response: what becomes of the exposed slots.
        expected: (C, R) light that the slots give by it.
        lit: (C, N) present idea of the slots, for what reaches beyond the memory.
    """
    value = observed.value - expected
    parts = [
        _row_metrics(value[group], observed.precision[group], centre, clock, isi_memory, response, lit[group])
        for group, centre in zip(alike_columns(positions), positions, strict=True)
    ]
    # Squared contrast over variance of a slot is the precision of the rows around.
    mean = np.median(observed.precision[:, :: SETTINGS.snr_every_row], axis=1) * np.float32(clock.rows_per_slot)
    snr = np.repeat(mean[:, None], clock.n_slots, axis=1).astype(np.float32)
    return SlotLikelihoods(np.concatenate(parts).astype(np.float64), snr)


def _row_metrics(
    value: Float32Array,
    precision: Float32Array,
    centre: FloatArray,
    clock: Clock,
    isi_memory: int,
    response: Response,
    lit: Float32Array,
) -> Float32Array:
    """Metrics of columns whose rows lie at `centre` (R,); `value` is what the slots `lit` do not explain."""
    metric = np.floor(centre + isi_memory / 2).astype(np.intp)
    borders = np.searchsorted(metric, np.arange(clock.n_slots + isi_memory + 1))
    use = slice(borders[0], borders[-1])
    slots = metric[use, None] + np.arange(-isi_memory, 1)
    share = shares_of_slots(centre[use], slots, clock.exposure_slots, response)
    value, precision = value[:, use].copy(), precision[:, use]
    padded = np.pad(lit, ((0, 0), (isi_memory, isi_memory)), constant_values=np.float32(0.5))
    for back in range(isi_memory + 1):
        value += share[:, back] * padded.take(slots[:, back] + isi_memory, axis=1)
    value *= precision
    sums, basis = _slot_sums(value, precision, share, borders - borders[0]), _pattern_basis(isi_memory)
    metrics = sums.reshape(len(basis), -1).T @ basis
    return np.asarray(metrics.reshape(*sums.shape[1:], -1))


def _slot_sums(weighted: Float32Array, precision: Float32Array, share: Float32Array, borders: IntArray) -> Float32Array:
    """What the rows of every metric add up to: J sums of light, then of the precision of every pair of shares.

    Args:
        weighted: (C, R) light times precision.
        precision: (C, R).
        share: (R, J) share of each slot in a row.
        borders: (n + 1,) first row of every metric, and the end of the last.

    Returns:
        (J + J (J + 1) / 2, C, n).
    """
    pairs = np.triu_indices(share.shape[1])
    terms = np.concatenate([share.T, share.T[pairs[0]] * share.T[pairs[1]]])
    counts = np.diff(borders)
    sums = np.zeros((len(terms), weighted.shape[0], counts.size), np.float32)
    # The first rows of all metrics, then the second ones, and so on: long vectors, where metrics have few rows each.
    for place in range(int(counts.max(initial=0))):
        rows = np.minimum(borders[:-1] + place, weighted.shape[1] - 1)
        here = terms.take(rows, axis=1) * (place < counts)
        sums[: share.shape[1]] += here[: share.shape[1], None] * weighted.take(rows, axis=1)
        sums[share.shape[1] :] += here[share.shape[1] :, None] * precision.take(rows, axis=1)
    return sums


def _pattern_basis(isi_memory: int) -> Float32Array:
    """(terms, patterns) how `_slot_sums` make up the log-likelihood of every pattern."""
    patterns = slot_patterns(isi_memory).astype(np.float32)
    first, second = np.triu_indices(isi_memory + 1)
    power = patterns[:, first] * patterns[:, second] * np.where(first == second, np.float32(0.5), np.float32(1))
    return np.ascontiguousarray(np.concatenate([patterns, -power], axis=1).T)
