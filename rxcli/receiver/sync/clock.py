"""Slot clock, copies and bursts, from the header and the repeats, jointly over the columns.

Model: all columns send the header 0011100011 at the same instants. Each strip is normalised to its local extremes; the
mean over the columns then shows the header at full contrast wherever a packet starts, while payloads average out. The
clock is the start with the largest header correlation over all visible copies. Copies of one burst are equal and copies
of different bursts are not, which gives the burst boundaries.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import TINY, folded, header_correlation, peak_offset
from rxcli.protocol import EXTREMES_SLOTS, PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, WEIGHTS
from rxcli.receiver.light import LONG_EXPOSURE_SLOTS, MAX_EXPOSURE_SLOTS, changes_over, dark_sigma
from rxcli.receiver.sync.settings import SETTINGS
from rxcli.types import BoolArray, Clock, Float32Array, FloatArray, IntArray, RowProfiles, SlotSamples

#: Percentile of the light that counts as black.
_BLACK_PERCENT = 2


def binned_strips(profiles: RowProfiles) -> RowProfiles:
    """Bin strips in pairs for clock search and initial pass; an odd number of strips is left as it is."""
    rows, light = profiles.sensor_row, _bounded(profiles.light)
    if light.shape[1] % 2:
        return replace(profiles, light=light)
    return replace(
        profiles,
        light=(light[:, ::2] + light[:, 1::2]) * np.float32(0.5),
        inside=profiles.inside[:, ::2] & profiles.inside[:, 1::2],
        sensor_row=None if rows is None else (rows[:, ::2] + rows[:, 1::2]) / 2,
        count=profiles.count[:, ::2] + profiles.count[:, 1::2],
        level=None if profiles.level is None else (profiles.level[:, ::2] + profiles.level[:, 1::2]) * np.float32(0.5),
    )


def resample(
    profiles: RowProfiles, row0: float | FloatArray, rows_per_sample: float, n_samples: int
) -> tuple[Float32Array, Float32Array]:
    """Resample light to equal steps of sensor rows.

    Args:
        profiles: C columns, S strips, R rows.
        row0: sensor row at which sample 0 starts, common or per column (C,); row r covers r - 0.5 .. r + 0.5.
        rows_per_sample: length of a sample.
        n_samples: number of samples.

    Returns:
        (C, S, n_samples) float32 light, 0 where not valid; and validity, 1 where a sample lies entirely on the screen.
    """
    borders = np.reshape(row0, (-1, 1)) + rows_per_sample * np.arange(n_samples + 1, dtype=np.float64)
    light = _bounded(profiles.light.reshape(-1, profiles.light.shape[-1]))
    start, stop = _shown_rows(profiles.inside.reshape(light.shape))
    positions = _row_positions(profiles, borders)
    widths = np.diff(positions, axis=-1)
    valid = (positions[:, :-1] >= start[:, None]) & (positions[:, 1:] <= stop[:, None]) & (widths > TINY)
    mean = _integrate(light, positions)
    mean *= valid / np.maximum(widths, TINY)
    shape = (*profiles.light.shape[:2], n_samples)
    return mean.astype(np.float32).reshape(shape), valid.astype(np.float32).reshape(shape)


def _bounded(light: Float32Array) -> Float32Array:
    """Replace NaN and impossible light by 0, since one NaN would spoil every sum after it."""
    if -SETTINGS.max_light <= light.min(initial=0.0) and light.max(initial=0.0) <= SETTINGS.max_light:
        return light
    return np.where(np.abs(light) <= SETTINGS.max_light, light, np.float32(0))


def _shown_rows(inside: BoolArray) -> tuple[IntArray, IntArray]:
    """First row of each strip on the screen, and the row after the last; (n,) each, equal where there is none."""
    n_rows = inside.shape[1]
    any_row = inside.any(axis=1)
    start = inside.argmax(axis=1)
    stop = n_rows - inside[:, ::-1].argmax(axis=1)
    return start, np.where(any_row, stop, start)


def _row_positions(profiles: RowProfiles, borders: FloatArray) -> FloatArray:
    """Sensor rows (1 or C, n) as positions in the strips' row arrays, (1 or C*S, n); position 0 is the top of row 0."""
    n_rows, n_strips = profiles.rows.size, profiles.light.shape[1]
    if profiles.sensor_row is None:
        out = borders - (profiles.rows[0] - 0.5)
        return np.asarray(np.clip(out if len(out) == 1 else np.repeat(out, n_strips, axis=0), 0, n_rows))
    strips = profiles.sensor_row.reshape(-1, n_rows)
    middles = np.arange(n_rows) + 0.5
    each = np.broadcast_to(borders, (len(profiles.light), borders.shape[1])).repeat(n_strips, axis=0)
    return np.stack([np.interp(at, strip, middles, 0, n_rows) for at, strip in zip(each, strips, strict=True)])


def _integrate(values: Float32Array, positions: FloatArray) -> FloatArray:
    """Integral of piecewise constant `values` (n, R) between neighbouring `positions`; (n, positions - 1) float64."""
    total = np.zeros((len(values), values.shape[1] + 1))
    np.cumsum(values, axis=1, dtype=np.float64, out=total[:, 1:])
    whole = np.minimum(positions.astype(np.intp), values.shape[1] - 1)
    part = positions - whole
    if len(whole) == 1:
        return np.diff(total.take(whole[0], axis=1) + part * values.take(whole[0], axis=1), axis=1)
    row = np.arange(len(values))[:, None]
    at_borders = total.take(whole + row * total.shape[1])
    at_borders += part * values.take(whole + row * values.shape[1])
    return np.diff(at_borders, axis=1)


def contrast(
    light: Float32Array, valid: Float32Array, samples_per_slot: int, sigma: float
) -> tuple[Float32Array, Float32Array]:
    """Normalise each strip to its local extremes, -1 dark to 1 lit, and pool the strips of a column.

    The extremes are taken from smoothed light to suppress noise. The light itself is not smoothed, because a blur dims
    single slots.

    Args:
        light: (C, S, n).
        valid: (C, S, n) 1 or 0.
        samples_per_slot: samples per slot.
        sigma: standard deviation of a dark sample.

    Returns:
        (C, n) float32: pooled value; and its weight, in strips of full contrast.
    """
    import cv2

    window = np.ones((1, EXTREMES_SLOTS * samples_per_slot), np.uint8)
    flat = light.reshape(-1, light.shape[-1])
    # An odd length avoids a shift by half a sample.
    smooth = cv2.blur(flat, (samples_per_slot // 2 * 2 + 1, 1)) if samples_per_slot > 1 else flat
    high = cv2.dilate(smooth, window).reshape(light.shape)
    low = cv2.erode(smooth, window).reshape(light.shape)
    span = high - low
    high += low
    high *= np.float32(0.5)
    value = light - high
    value /= span * np.float32(0.5) + np.float32(sigma)
    np.square(span, out=span)
    weight = span / (span + np.float32((SETTINGS.contrast_sigmas * sigma) ** 2))
    weight *= valid
    total = weight.sum(axis=1)
    value *= weight
    return value.sum(axis=1) / (total + np.float32(TINY)), total


def search_contrast(light: Float32Array, valid: Float32Array, min_sigma: float) -> tuple[Float32Array, Float32Array]:
    """As `contrast`, for the search for headers: faint strips count less, and noise is at least that of dark samples.

    Row noise is common to the pixels of a strip, so that their variance does not show it.
    """
    some, is_valid = light[:, :1], valid[:, :1]  # One strip of a column is enough.
    if is_valid.any():
        min_sigma = dark_sigma(some, is_valid, float(np.percentile(some[is_valid > 0], _BLACK_PERCENT)), min_sigma)
    pooled, weight = contrast(light, valid, SETTINGS.search_samples, min_sigma)
    weight *= weight / np.float32(light.shape[1])
    return pooled, weight


def slot_differences(light: Float32Array, valid: Float32Array, min_sigma: float) -> tuple[Float32Array, Float32Array]:
    """As `search_contrast`, for long exposures: changes of light over one slot."""
    flat, inside = (values.reshape(-1, light.shape[-1]) for values in (light, valid))
    changes = changes_over(flat, inside, SETTINGS.search_samples, min_sigma)
    change, is_valid = (part.reshape(light.shape) for part in changes)
    return change.mean(axis=1), is_valid.sum(axis=1)


def _without_echo(response: FloatArray, samples: float) -> FloatArray:
    """The response of differences (C, n) less the one an exposure later, where each header shows again, inverted."""
    n = response.shape[1]
    index = np.arange(n)
    return np.stack([row - np.interp(index + samples, index, row, right=0.0) for row in response])


def header_response(pooled: Float32Array, weight: Float32Array, samples_per_slot: int) -> FloatArray:
    """(C, n) float64 correlation of every column with a header that starts at each sample.

    Slots outside the samples contribute nothing.
    """
    total = np.cumsum(pooled * (weight / (weight + 1.0)), axis=1, dtype=np.float64)
    padded = np.pad(total, ((0, 0), (1, 0)))
    after = SLOTS_PER_SYMBOL * samples_per_slot - 1
    return header_correlation(np.pad(padded, ((0, 0), (0, after)), mode="edge"), samples_per_slot)


def find_clock(
    profiles: RowProfiles, rows_per_slot: float, exposure_slots: float, packet_slots: int, sigma: float
) -> Clock | None:
    """Find the clock of a picture with known rows per slot, bursts still unassigned; None if too little is visible.

    Args:
        profiles: row profiles of the screen.
        rows_per_slot: sensor rows per slot.
        exposure_slots: exposure in slots.
        packet_slots: slots of a packet.
        sigma: standard deviation of a dark row of a strip.
    """
    import cv2

    top, bottom = row_span(profiles)
    step = rows_per_slot / SETTINGS.search_samples
    n = int((bottom - top) / step)
    if n < SLOTS_PER_SYMBOL * SETTINGS.search_samples or exposure_slots >= MAX_EXPOSURE_SLOTS:
        return None
    light, valid = resample(profiles, top, step, n)
    is_long = exposure_slots > LONG_EXPOSURE_SLOTS
    row_sigma = sigma / np.sqrt(max(step, 1.0))
    pooled, weight = (slot_differences if is_long else search_contrast)(light, valid, row_sigma)
    response = header_response(pooled, weight, SETTINGS.search_samples)
    if is_long:
        response = _without_echo(response, exposure_slots * SETTINGS.search_samples)
    period = packet_slots * SETTINGS.search_samples
    power = folded(np.maximum(response.mean(axis=0), 0) ** 2, period)
    start, header_peak_ratio = header_comb(power, SETTINGS.search_samples)
    if not header_peak_ratio:
        return None
    # Twice the correlation less the contrast is proportional to the log-likelihood ratio against random slots.
    length = SLOTS_PER_SYMBOL * SETTINGS.search_samples
    share = cv2.blur(weight / (weight + 1), (length, 1), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
    by_column = folded(2 * response - share, period)
    # Through a long exposure, delays of single columns do not stand out.
    delays = np.zeros(len(light)) if is_long else _delays(by_column, start)
    staggered_start, staggered_ratio = _staggered_comb(by_column)
    is_clearer = header_peak_ratio < min(staggered_ratio, SETTINGS.clear_header_lead)
    if not is_long and (is_clearer or np.count_nonzero(delays) > delays.size * SETTINGS.many_columns):
        delays = _delays(by_column, staggered_start)
        middle = float(np.median(delays[delays != 0])) if delays.any() else 0.0
        start = staggered_start + middle * SETTINGS.search_samples
        delays = np.where(delays != 0, delays - middle, 0.0)
        header_peak_ratio = max(header_peak_ratio, staggered_ratio)
    if is_long:
        # A difference shows the last slot of its exposures.
        start += (exposure_slots - 1) / 2 * SETTINGS.search_samples
    row0 = top + start * step
    before = int(np.ceil((row0 - top) / rows_per_slot))
    n_slots = before + int(np.ceil((bottom - row0) / rows_per_slot))
    first_slot = -before % packet_slots
    n_copies = -(-(first_slot + n_slots) // packet_slots)
    return Clock(
        rows_per_slot=rows_per_slot,
        exposure_slots=exposure_slots,
        packet_slots=packet_slots,
        row0=row0 - before * rows_per_slot,
        n_slots=n_slots,
        first_slot=first_slot,
        burst=np.zeros(n_copies, np.int64),
        delay_slots=delays,
        header_peak_ratio=header_peak_ratio,
    )


def row_span(profiles: RowProfiles) -> tuple[float, float]:
    """Borders of the top and the bottom sensor row in view of any strip."""
    rows = profiles.rows if profiles.sensor_row is None else profiles.sensor_row
    shown = np.broadcast_to(rows, profiles.inside.shape)[profiles.inside]
    return (float(shown.min()) - 0.5, float(shown.max()) + 0.5) if shown.size else (0.0, 0.0)


def header_comb(score: FloatArray, samples_per_slot: int) -> tuple[float, float]:
    """Start of packets, in samples, with the largest header correlation, and its ratio to the next rival.

    The ratio is 0 if no correlation is positive.

    Args:
        score: (period,) power of the header correlation at each position in a packet, copies added.
        samples_per_slot: samples per slot.
    """
    best = int(score.argmax())
    if score[best] <= 0:
        return 0.0, 0.0
    offset = float(peak_offset(*score[[best - 1, best, (best + 1) % score.size]]))
    return best + offset, float(score[best] / _rival(score, best, samples_per_slot))


def _rival(score: FloatArray, best: int, samples_per_slot: int, further: int = 0) -> float:
    """Largest score more than a quarter of a header plus `further` samples away from `best`."""
    period = score.size
    distance = np.abs((np.arange(period) - best + period // 2) % period - period // 2)
    away = score[distance > SLOTS_PER_SYMBOL * samples_per_slot // 4 + further]
    return max(float(away.max(initial=0.0)), TINY)


def _staggered_comb(by_column: FloatArray) -> tuple[float, float]:
    """Start and lead of columns whose delays are too different for their mean to show a header.

    The start is where most columns have a peak within reach; `by_column` as for `_delays`.
    """
    import cv2

    reach = int(SETTINGS.max_delay_slots * SETTINGS.search_samples)
    wrapped = np.pad(by_column, ((0, 0), (reach, reach)), mode="wrap")
    near = cv2.dilate(wrapped, np.ones((1, 2 * reach + 1), np.uint8))[:, reach:-reach]
    score = np.maximum(near, 0).sum(axis=0)
    start = int(score.argmax())
    return float(start), float(score[start] / _rival(score, start, SETTINGS.search_samples, 2 * reach))


def _delays(by_column: FloatArray, start: float) -> FloatArray:
    """Delay of each column against the common clock, slots; 0 where it is not significant, or only few are delayed.

    Args:
        by_column: (C, period) proportional to the log-likelihood ratio of a header there, copies added.
        start: of packets, samples.
    """
    reach = int((SETTINGS.max_delay_slots + 1) * SETTINGS.search_samples)
    score = by_column.take(round(start) + np.arange(-reach, reach + 1), axis=1, mode="wrap")
    best, top = score.argmax(axis=1), score.max(axis=1)
    around = np.clip(best, 1, 2 * reach - 1)[:, None] + np.arange(-1, 2)
    offset = peak_offset(*np.take_along_axis(score, around, 1).T)
    fine = (best + offset - reach - (start - round(start))) / SETTINGS.search_samples
    sure = top > 0
    late = sure & (np.abs(fine) > SETTINGS.same_delay_slots)
    scattered = np.count_nonzero(late) > SETTINGS.many_columns * np.count_nonzero(sure)
    return np.where(scattered & sure & (best > 0) & (best < 2 * reach), fine, 0.0)


def corrected(clock: Clock, timing: FloatArray) -> Clock:
    """Correct the clock by its lateness over all columns, and the columns' delays where there are any.

    Args:
        clock: the clock.
        timing: (C, 2) numerator and denominator of each column's lateness, slots.
    """
    most = SETTINGS.max_correction_slots
    numerator, denominator = timing.sum(axis=0)
    late = float(np.clip(numerator / max(denominator, TINY), -most, most))
    moved = replace(clock, row0=clock.row0 - late * clock.rows_per_slot)
    own = (timing[:, 0] - late * timing[:, 1]) / (timing[:, 1] + SETTINGS.delay_information)
    if not clock.delay_slots.any() and np.sqrt(np.mean(own**2)) < SETTINGS.same_timing_slots:
        return moved
    return replace(moved, delay_slots=clock.delay_slots - np.clip(own, -most, most))


def sample_slots(
    profiles: RowProfiles, clock: Clock, samples_per_slot: int, columns: IntArray | None = None
) -> SlotSamples:
    """Sample row profiles on the slot grid of `clock`, each column at its own delay.

    Args:
        profiles: row profiles.
        clock: the clock.
        samples_per_slot: samples per slot, Q.
        columns: columns to sample, all by default.
    """
    step = clock.rows_per_slot / samples_per_slot
    n = clock.n_slots * samples_per_slot
    delays = clock.delay_slots if columns is None else clock.delay_slots[columns]
    if columns is not None:
        profiles = profiles.of_columns(columns)
    row0 = clock.row0 + delays * clock.rows_per_slot if delays.any() else clock.row0
    light, valid = resample(profiles, row0, step, n)
    level = None
    if profiles.level is not None:
        level, _ = resample(replace(profiles, light=profiles.level), row0, step, n)
    return SlotSamples(light, valid, samples_per_slot, level)


def possible_bursts(clock: Clock, llr: Float32Array, repeats: Sequence[int]) -> list[tuple[Clock, float]]:
    """All assignments of the copies to bursts, likeliest first.

    Args:
        clock: the clock.
        llr: (C, N) log-likelihood ratio of every slot being lit, 0 where it is not visible.
        repeats: how many copies a burst may have.

    Returns:
        Clocks, each with the log-likelihood ratio of its copies against different ones, plus its log prior.
    """
    scores = copy_similarity(llr, clock)
    prior: dict[bytes, float] = {}
    ways: dict[bytes, IntArray] = {}
    for n, burst in _assignments(clock.n_copies, repeats):
        key = ways.setdefault(burst.tobytes(), burst).tobytes()
        prior[key] = prior.get(key, 0.0) + 1 / (n * len(repeats))
    out = [
        (replace(clock, burst=way), float(scores[way[1:] == way[:-1]].sum() + np.log(prior[key])))
        for key, way in ways.items()
    ]
    return sorted(out, key=lambda assignment: -assignment[1])


def likely_repeats(clock: Clock, repeats: Sequence[int]) -> int:
    """The first of `repeats` that is consistent with the assigned bursts."""
    assigned = clock.burst - clock.burst[0]
    return next(
        (n for n, burst in _assignments(clock.n_copies, repeats) if np.array_equal(burst, assigned)), repeats[0]
    )


def _assignments(n_copies: int, repeats: Sequence[int]) -> Iterator[tuple[int, IntArray]]:
    """Every number of copies of a burst, and (n_copies,) bursts with it, from 0."""
    for n in repeats:
        for phase in range(n):
            burst = (np.arange(n_copies) + phase) // n
            yield n, burst - burst[0]


def copy_similarity(llr: Float32Array, clock: Clock) -> FloatArray:
    """(n_copies - 1,) log-likelihood ratio of each copy and the next being the same packet.

    Args:
        llr: (C, N) log-likelihood ratio of every slot being lit, 0 where it is not visible.
        clock: the clock.
    """
    copies = np.moveaxis(clock.to_copies(np.clip(llr, -SETTINGS.max_slot_llr, SETTINGS.max_slot_llr)), 1, 0)
    return np.array([similarity(*pair) for pair in pairwise(copies)])


def similarity(copy_a: NDArray[np.floating], copy_b: NDArray[np.floating]) -> float:
    """Log-likelihood ratio of two copies being the same packet against different ones.

    A slot decided with reliability p, right or erased, and one with q are equal with likelihood
    1 + p q (a - r)(b - r) / (r (1 - r)) relative to independent slots, where a and b are 1 if lit and r is the column's
    share of lit slots: slots without light count neither way. At an edge of the picture a slot is misread in all
    columns together: a slot counts for little, whatever its columns show.

    Args:
        copy_a: (C, packet) log-likelihood ratio of each slot being lit, 0 where not visible.
        copy_b: likewise.
    """
    soft = np.tanh(np.stack([copy_a[:, PREAMBLE_SLOTS:], copy_b[:, PREAMBLE_SLOTS:]]) / 2)
    by_slot = np.abs(soft).mean(axis=1)
    soft *= (by_slot > SETTINGS.min_slot_light * by_slot.max())[:, None]
    decided = np.abs(soft).sum(axis=(0, 2)) + TINY
    share = np.maximum(soft, 0).sum(axis=(0, 2)) / decided
    share = np.clip(share, WEIGHTS[0] / SLOTS_PER_SYMBOL, WEIGHTS[-1] / SLOTS_PER_SYMBOL)[:, None]
    off_a, off_b = soft * np.where(soft > 0, 1 - share, share)
    of_slots = np.log(np.maximum(1 + off_a * off_b / (share * (1 - share)), TINY)).sum(axis=0)
    right, misread = np.log(1 - SETTINGS.misread_slots), np.log(SETTINGS.misread_slots)
    return float((np.logaddexp(right + of_slots, misread) - np.logaddexp(right, misread + of_slots)).sum())
