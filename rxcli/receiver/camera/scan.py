"""Clocks that a picture may show: headers and repeated packets over a grid of rows per slot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import folded, header_correlation
from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL
from rxcli.receiver.camera.edges import edge_power
from rxcli.receiver.camera.estimates import BlindEstimate, Hypothesis, distinct
from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.strips import SAMPLES, Strips, levelled
from rxcli.receiver.camera.structure import structure_llr
from rxcli.receiver.light import NoiseModel
from rxcli.types import Float32Array, FloatArray

#: Periods whose combs are looked at together.
_AT_ONCE = 64


@dataclass(frozen=True, slots=True)
class _Octave:
    """Columns between their local extremes, reduced by a power of two, for an octave of rows per slot."""

    #: (C, R') float32.
    columns: Float32Array
    #: Rows of one reduced row.
    rows: int
    #: Rows per slot that it serves.
    low: float
    high: float
    #: (R',) deviation of the autocorrelation at every lag from chance, in standard deviations.
    repeats: FloatArray
    #: Nats by which the edges keep to a grid, over chance, for every quarter of a slot more over the whole picture; as
    #: far as they count, and all.
    line: FloatArray
    line_uncapped: FloatArray

    def line_at(self, rows_per_slot: FloatArray) -> FloatArray:
        """Nats by which edges keep to grids of slots."""
        places = SETTINGS.line_fine * self.columns.shape[1] * self.rows / rows_per_slot
        return np.asarray(np.interp(places, np.arange(self.line.size), self.line))

    def repeats_at(self, lags: FloatArray) -> FloatArray:
        """Surprise of the autocorrelation at some lags, rows."""
        return np.asarray(np.interp(lags / self.rows, np.arange(self.repeats.size), self.repeats, right=0.0))

    def line_near(self, rows_per_slot: float, slots: float) -> float:
        """The most of `line_at` within so many slots over the whole picture."""
        middle = SETTINGS.line_fine * self.columns.shape[1] * self.rows / rows_per_slot
        reach = SETTINGS.line_fine * slots
        return float(self.line[max(int(middle - reach), 0) : int(middle + reach) + 2].max(initial=0.0))


def _octaves(strips: Strips) -> list[_Octave]:
    """All octaves whose slots, by the columns' autocorrelation at short lags, may be of its length."""
    out = []
    light, inside, rows = strips.light, strips.inside, 1
    low, high = SETTINGS.octave_rows_per_slot
    bounds = [(1, SETTINGS.least_rows_per_slot, low)]
    while low * (1 << (len(bounds) - 1)) < SETTINGS.most_rows_per_slot:
        reduce = 1 << (len(bounds) - 1)
        bounds.append((reduce, low * reduce, min(high * reduce, SETTINGS.most_rows_per_slot)))
    for reduce, least, most in bounds:
        if reduce > rows:
            light, inside, rows = _halved(light), _halved(inside), reduce
        if light.shape[1] * rows < 2 * PREAMBLE_SLOTS * least:
            break
        window = round(SETTINGS.octave_rows * most / (SETTINGS.octave_rows_per_slot[1] * rows))
        noise = strips.noise.over(rows)
        columns = _pooled(light, (inside > 0.99).astype(np.float32), window, noise, strips.n_columns)
        correlation = autocorrelation(columns)
        width = half_width(correlation) * rows
        least, most = max(least, width / SETTINGS.half_width_slots[1]), min(most, width / SETTINGS.half_width_slots[0])
        if least < most:
            surprise = _surprise(correlation, round(PREAMBLE_SLOTS * least / rows))
            line = _slot_line(columns)
            capped = np.minimum(line, SETTINGS.most_for_line)
            out.append(_Octave(columns, rows, least, most, surprise, capped, line))
    return out


def _halved(values: Float32Array) -> Float32Array:
    even = values.shape[1] // 2 * 2
    return np.asarray((values[:, 0:even:2] + values[:, 1:even:2]) / 2, np.float32)


def _pooled(light: Float32Array, inside: Float32Array, window: int, noise: NoiseModel, n_columns: int) -> Float32Array:
    """(C, R) mean of the levelled strips of each column, small where little light is behind it."""
    level, weight = levelled(light, inside, window, noise)
    total = weight.reshape(n_columns, -1, weight.shape[1]).sum(axis=1)
    summed = (level * weight).reshape(n_columns, -1, weight.shape[1]).sum(axis=1)
    return np.asarray(summed / (total + 0.01) * (total / (total + 1)), np.float32)


def autocorrelation(columns: Float32Array) -> FloatArray:
    """(R,) sum over columns of the product with the same column later."""
    n = columns.shape[1]
    size = 1 << int(np.ceil(np.log2(2 * n)))
    spectrum = np.fft.rfft(columns, size, axis=1)
    return np.asarray(np.fft.irfft((spectrum * spectrum.conj()).real.sum(axis=0), size)[:n])


def half_width(correlation: FloatArray) -> float:
    """Lag at which the correlation falls to half of that at the shortest lag."""
    top = correlation[1] if correlation.size > 2 else 0.0
    below = np.flatnonzero(correlation[1:] < top / 2)
    if top <= 0 or below.size == 0:
        return 0.0
    lag = int(below[0]) + 1
    return float(lag - (top / 2 - correlation[lag]) / max(correlation[lag - 1] - correlation[lag], 1e-12))


def _surprise(correlation: FloatArray, shortest: int) -> FloatArray:
    n = correlation.size
    scaled = correlation / np.sqrt(np.arange(n, 0, -1))
    part = scaled[min(shortest, n // 2) : max(n - 10, n // 2 + 1)]
    middle = float(np.median(part))
    spread = 1.4826 * float(np.median(np.abs(part - middle))) + 1e-9
    out = np.maximum(scaled - middle, 0) / spread
    out[-10:] = 0
    return np.asarray(out)


def _slot_line(columns: Float32Array) -> FloatArray:
    """Spectrum of the edges' power, nats over chance, by slots over the whole picture times SETTINGS.line_fine.

    It tells rows per slot where there is but one header, or where those drown.
    """
    power = edge_power(columns).sum(axis=0, dtype=np.float64)
    spectrum = np.abs(np.fft.rfft(power, SETTINGS.line_fine * columns.shape[1])) ** 2
    return np.asarray(spectrum / max(float(power @ power), 1e-30))


def _header_responses(total: FloatArray, rows_per_slot: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
    """Correlation with a header that starts at each quarter of a slot, the first one a header's length before row 0.

    The negative of it shows the header read backwards.

    Args:
        total: (R + 1,) running sum of the columns' mean.
        rows_per_slot: (K,) rows a slot.

    Returns:
        (K, n) for every period; and (K,) how many places the picture has then.
    """
    lead = SLOTS_PER_SYMBOL * SAMPLES
    n_places = ((total.size - 1) / rows_per_slot * SAMPLES).astype(np.int64) + lead
    step = rows_per_slot[:, None] / SAMPLES
    summed = np.interp(np.arange(-lead, int(n_places.max()) + 1) * step, np.arange(total.size), total)
    return header_correlation(summed, SAMPLES)[:, : int(n_places.max())] / step, n_places


def _comb(
    responses: FloatArray, n_places: NDArray[np.int64], packet_slots: int
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Best sums of responses (K, n) over copies of a packet, over the root of their number; and their places, (K,)."""
    n = responses.shape[1]
    period, lead = packet_slots * SAMPLES, SLOTS_PER_SYMBOL * SAMPLES
    # Headers that are not seen as a whole do not count.
    place = np.arange(n)
    inner = np.where((place >= lead) & (place < n_places[:, None] - lead), responses, 0.0)
    phase = np.arange(period)
    count = (n_places[:, None] - lead - 1 - phase) // period - (lead - 1 - phase) // period
    score = folded(inner, period) / np.sqrt(np.maximum(count, 1))
    best = score.argmax(axis=1)
    return score[np.arange(len(score)), best], best


def short_list(strips: Strips, packet_lengths: Sequence[int]) -> list[Hypothesis]:
    """Clocks that the picture may show, from periods that stand out by themselves, best first.

    Edges fall between slots, so that their power has a line at the rate of the slots; and columns are like themselves a
    packet later.

    Args:
        strips: straightened strips.
        packet_lengths: slots of a packet, of every screen in question.
    """
    pairs = []
    for octave in _octaves(strips):
        total = _running_mean_sum(octave)
        for periods, lengths in _outstanding_periods(octave, packet_lengths):
            near = periods * (1 + np.array(SETTINGS.short_off_slots)[:, None] * periods / strips.rows.size)
            pairs += [(one, octave) for one in _combs(octave, total, near.ravel(), lengths)]
    return _tried(pairs, SETTINGS.short_trials)


def _outstanding_periods(octave: _Octave, packet_lengths: Sequence[int]) -> list[tuple[FloatArray, Sequence[int]]]:
    """Rows per slot at the strongest lines of the edges' power and peaks of the autocorrelation, with packets' lengths.

    A line says nothing of packets; a peak is one of packets of some length.
    """
    n_rows = octave.columns.shape[1] * octave.rows
    low, high = (int(SETTINGS.line_fine * n_rows / period) for period in (octave.high, octave.low))
    lines = _strongest(octave.line_uncapped[low : high + 2], SETTINGS.short_lines, 2 * SETTINGS.line_fine)
    found: list[tuple[FloatArray, Sequence[int]]] = [(SETTINGS.line_fine * n_rows / (low + lines), packet_lengths)]
    for packet_slots in packet_lengths:
        least, most = (int(period * packet_slots / octave.rows) for period in (octave.low, octave.high))
        slot = max(int(octave.low / octave.rows), 1)
        peaks = _strongest(octave.repeats[least : most + 1], SETTINGS.short_peaks, 2 * slot)
        found.append(((least + peaks) * octave.rows / packet_slots, [packet_slots]))
    return [(periods, lengths) for periods, lengths in found if periods.size]


def _strongest(values: FloatArray, most: int, apart: int) -> FloatArray:
    """Places of the highest peaks, to fractions of a place by a parabola; none nearer to a higher one than `apart`."""
    inner = np.flatnonzero((values[1:-1] > values[:-2]) & (values[1:-1] >= values[2:])) + 1
    chosen = distinct(inner[np.argsort(-values[inner])].tolist(), lambda one, other: abs(one - other) < apart, most)
    out = []
    for at in chosen:
        before, here, after = values[at - 1 : at + 2]
        out.append(at + 0.5 * (before - after) / (before - 2 * here + after))
    return np.array(out)


def every_clock(strips: Strips, packet_lengths: Sequence[int]) -> list[Hypothesis]:
    """Clocks that the picture may show, over a grid of all periods, best first.

    Args:
        strips: straightened strips.
        packet_lengths: slots of a packet, of every screen in question.
    """
    pairs = [(h, o) for o in _octaves(strips) for h in _scan_octave(o, strips.rows.size, packet_lengths)]
    return _tried(pairs, SETTINGS.scan_trials)


def _tried(found: list[tuple[Hypothesis, _Octave]], most: int) -> list[Hypothesis]:
    """The best hypotheses, and those of different clocks, as their slots show them, best first."""
    found.sort(key=lambda pair: -pair[0].log_evidence)
    places = range(len(found))
    chosen = distinct(places, lambda n, m: alike(found[n][0], found[m][0]), most)
    chosen += distinct(places, lambda n, m: same_slots(found[n][0], found[m][0]), most)
    return sorted((_try(*found[n]) for n in dict.fromkeys(chosen)), key=lambda hypothesis: -hypothesis.log_evidence)


def alike(one: Hypothesis, other: Hypothesis) -> bool:
    return one.packet_slots == other.packet_slots and same_slots(one, other)


def same_slots(one: Hypothesis | BlindEstimate, other: Hypothesis | BlindEstimate) -> bool:
    near = abs(np.log(one.rows_per_slot / other.rows_per_slot)) < SETTINGS.same_rows_per_slot
    return near and one.reversed == other.reversed


def _scan_octave(octave: _Octave, n_rows: int, packet_lengths: Sequence[int]) -> list[Hypothesis]:
    out = []
    total = _running_mean_sum(octave)
    periods = [octave.low]
    while periods[-1] < octave.high:
        periods.append(periods[-1] * (1 + SETTINGS.scan_step / min(n_rows / periods[-1], SETTINGS.scan_slots)))
    for first in range(0, len(periods) - 1, _AT_ONCE):
        out += _combs(octave, total, np.array(periods[first : min(first + _AT_ONCE, len(periods) - 1)]), packet_lengths)
    return out


def _combs(
    octave: _Octave, total: FloatArray, rows_per_slot: FloatArray, packet_lengths: Sequence[int]
) -> list[Hypothesis]:
    """The best combs of headers at some periods, in both directions, for every length of packet."""
    import cv2

    response, n_places = _header_responses(total, rows_per_slot / octave.rows)
    # Neighbouring quarters of a slot say the same.
    size = np.abs(response[:, : int(n_places.min()) : 2])
    spread = 1.4826 * np.partition(size, size.shape[1] // 2, axis=1)[:, size.shape[1] // 2] + 1e-6
    # The largest response within a slot: a period may then miss copies by a slot.
    reach = np.ones((1, 2 * SAMPLES + 1), np.uint8)
    line = [2 * octave.line_near(period, SETTINGS.scan_step / 2) for period in rows_per_slot.tolist()]
    out = []
    either = [(is_reversed, cv2.dilate(-response if is_reversed else response, reach)) for is_reversed in (False, True)]
    for packet_slots in packet_lengths:
        repeats = [_repeats_near(octave, period, packet_slots) for period in rows_per_slot.tolist()]
        for is_reversed, near in either:
            score, place = _comb(near, n_places, packet_slots)
            start = (place / SAMPLES - SLOTS_PER_SYMBOL) * rows_per_slot
            log_evidence = (score / spread) ** 2 + np.square(repeats) + line
            out += [
                Hypothesis(period, packet_slots, at, is_reversed, nats)
                for period, at, nats in zip(*(v.tolist() for v in (rows_per_slot, start, log_evidence)), strict=True)
            ]
    return out


def _running_mean_sum(octave: _Octave) -> FloatArray:
    mean = octave.columns.mean(axis=0).astype(np.float64)
    return np.concatenate([[0.0], np.cumsum(mean)])


def _repeats_near(octave: _Octave, rows_per_slot: float, packet_slots: int) -> float:
    """Surprise of the autocorrelation at lags within a slot of one packet."""
    lag, slot = rows_per_slot * packet_slots / octave.rows, max(rows_per_slot / octave.rows, 1.0)
    return float(octave.repeats[int(lag - slot) : int(lag + slot) + 2].max(initial=0.0))


def _try(hypothesis: Hypothesis, octave: _Octave) -> Hypothesis:
    """The hypothesis with the clock that fits best thereabouts, and the evidence of its slots."""
    fine = _fine_clock(hypothesis, octave)
    columns = octave.columns[:, ::-1] if fine.reversed else octave.columns
    rows_per_slot = fine.rows_per_slot / octave.rows
    start = fine.start_row / octave.rows
    if fine.reversed:
        start = columns.shape[1] - start - SLOTS_PER_SYMBOL * rows_per_slot
    before = int(start // rows_per_slot)
    first = start - before * rows_per_slot
    borders = np.arange(first, columns.shape[1], rows_per_slot)
    total = np.concatenate([np.zeros((columns.shape[0], 1)), np.cumsum(columns, axis=1)], axis=1)
    log_evidence = structure_llr(_slot_means(total, borders), -before % fine.packet_slots, fine.packet_slots)
    return replace(fine, start_row=start * octave.rows, log_evidence=log_evidence, salience=hypothesis.log_evidence)


def _slot_means(total: FloatArray, borders: FloatArray) -> FloatArray:
    """(C, N) means between borders, from (C, R + 1) running sums."""
    place = np.clip(borders, 0, total.shape[1] - 1 - 1e-9)
    low = place.astype(np.int64)
    at = total[:, low] + (total[:, low + 1] - total[:, low]) * (place - low)
    return np.asarray(np.diff(at, axis=1) / np.maximum(np.diff(place), 1e-6))


def _fine_clock(hypothesis: Hypothesis, octave: _Octave) -> Hypothesis:
    """The clock near the hypothesis with the highest header peaks."""
    n_rows = octave.columns.shape[1] * octave.rows
    step = 0.3 / min(n_rows / hypothesis.rows_per_slot, SETTINGS.scan_slots)
    tried = hypothesis.rows_per_slot * (1 + step * np.arange(-8, 9))
    responses, n_places = _header_responses(_running_mean_sum(octave), tried / octave.rows)
    score, place = _comb(-responses if hypothesis.reversed else responses, n_places, hypothesis.packet_slots)
    score += SETTINGS.say_of_rest * (octave.repeats_at(tried * hypothesis.packet_slots) + octave.line_at(tried))
    best = int(score.argmax())
    start = (float(place[best]) / SAMPLES - SLOTS_PER_SYMBOL) * float(tried[best])
    return replace(hypothesis, rows_per_slot=float(tried[best]), start_row=start)
