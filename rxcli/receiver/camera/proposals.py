"""Hypotheses of an unknown camera, best first, from one picture of a sending screen. Nothing is decided here.

Edges fall between slots, so their power has a spectral line at the rate of the slots; and columns repeat themselves a
packet later. The periods that stand out so are scored by the correlation with the header. Read backwards, the header is
its own complement, so the sign gives the direction of readout. The bend of the stripes is taken from the
similarity of neighbouring columns; `fit` estimates it from the decoded slots.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import numpy as np

from rxcli.numerics import NORMAL_MEDIAN, TINY, folded, header_correlation, local_mean, peak_offset
from rxcli.profiles import ScreenProfile
from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL
from rxcli.receiver.camera.curvature import LENS_PRECISION, UNIT_BEND, curvature_terms, likeliest_bend, straightened
from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.strips import ColumnStrips, columns_of, joined, levelled
from rxcli.receiver.light import LONG_EXPOSURE_SLOTS, MAX_EXPOSURE_SLOTS, changes_over
from rxcli.types import Float32Array, FloatArray

#: Samples a slot at which headers are sought; bins of the spectrum to a line's width.
_SAMPLES, _FINE = 4, 4
#: Rows after which the mosaic of colours shows.
_MOSAIC_ROWS = 4
#: Shape of a slot's difference from the next, _SAMPLES a slot.
_TRIANGLE = np.convolve(np.full(_SAMPLES, 1 / _SAMPLES), np.full(_SAMPLES, 1 / _SAMPLES))


@dataclass(frozen=True, slots=True)
class CameraHypothesis:
    """A camera that may have taken a picture, with standard deviations where its slots were fitted."""

    rows_per_slot: float
    packet_slots: int
    #: True where the picture's rows run against the readout.
    reversed: bool
    #: (4,) k1 k2 p1 p2 of the distortion that the camera took out of its picture, for a focal length of one picture
    #: width; 0 where stripes are straight.
    curvature: FloatArray
    exposure_slots: float
    #: Twice a log-likelihood ratio, roughly, of what stands out over chance.
    score: float
    rows_per_slot_sd: float
    curvature_sd: FloatArray
    #: 0 where it was not measured.
    exposure_slots_sd: float = 0.0
    #: Exposure that the file states, 0 where it does not: the least there can be.
    stated_exposure_slots: float = 0.0
    #: Number among the proposals for a picture, the best first; a fit keeps it.
    number: int = 0


def propose(
    strips: ColumnStrips, screens: Sequence[ScreenProfile], exposure_s: float | None = None, *, may_bend: bool = True
) -> list[CameraHypothesis]:
    """Cameras that may have taken a picture, the best few; `in_phase` makes one precise.

    Args:
        strips: of the picture as it is stored.
        screens: screens that it may show, at least one.
        exposure_s: exposure, None where the file does not state it.
        may_bend: whether the camera may have taken a distortion out, as it cannot from a mosaic.
    """
    coarse, level, width = _coarse(strips)
    if width <= 0:
        return []
    rates = {screen.packet_slots: screen.slot_rate_hz for screen in reversed(screens)}
    exposures = {length: (exposure_s or 0.0) * rate for length, rate in rates.items()}
    bends = [np.zeros(4)] + ([likeliest_bend(coarse, level)] if may_bend else [])
    found = [clock for curvature in bends for clock in _clocks(coarse, level, curvature, width, exposures)]
    is_short = exposure_s is not None and max(exposures.values()) <= LONG_EXPOSURE_SLOTS
    smeared = [] if is_short else _distinct(_smeared_clocks(strips, exposures, may_bend=may_bend))
    if smeared:  # Stripes as wide as those of the longest exposures are of no short one.
        found = [clock for clock in found if clock.exposure_slots < LONG_EXPOSURE_SLOTS]
    short = _distinct(clock for clock in found if not any(_is_same(clock, better) for better in smeared))
    ranked = sorted(smeared + short, key=lambda clock: -clock.score)
    least = {False: SETTINGS.min_score, True: SETTINGS.min_long_score}
    likely = [clock for clock in ranked if clock.score >= least[clock.exposure_slots > LONG_EXPOSURE_SLOTS]]
    return [replace(clock, number=number) for number, clock in enumerate(likely or short[:1])]


def in_phase(strips: ColumnStrips, clock: CameraHypothesis, *, may_bend: bool) -> CameraHypothesis:
    """A clock of a short exposure with rows per slot and bend by the whole picture, where that is plain."""
    rows = clock.rows_per_slot / strips.pitch
    # Beside the line of the mosaic, its phase cannot be distinguished from that of the slots.
    if clock.exposure_slots > LONG_EXPOSURE_SLOTS or abs(rows / _MOSAIC_ROWS - 1) < 2 * SETTINGS.off_clock:
        return clock
    found = along_the_line(strips, rows, SETTINGS.off_clock, may_bend=may_bend)
    # Lines of text have a phase as well.
    if found is None or found[2] < 2 * SETTINGS.max_line:
        return clock
    return replace(clock, rows_per_slot=found[0] * strips.pitch, curvature=found[1])


def propose_slots(strips: ColumnStrips, *, may_bend: bool = True) -> list[CameraHypothesis]:
    """Cameras by the spectral line of the slot rate alone, for pictures of less than a packet; its length stays open.

    Args:
        strips: of the picture as it is stored.
        may_bend: whether the camera may have taken a distortion out, as it cannot from a mosaic.
    """
    coarse, level, width = _coarse(strips)
    if width <= 0:
        return []
    n_bends = SETTINGS.n_bends if may_bend else 1
    bends = np.linspace(-SETTINGS.max_bend, SETTINGS.max_bend, n_bends) if may_bend else np.zeros(1)
    curvatures = bends[:, None] * UNIT_BEND
    found = [_strongest_line(coarse, level, curvature, width) for curvature in curvatures]
    best = max(range(n_bends), key=lambda number: found[number][1])
    if found[best][1] < SETTINGS.min_slot_line:
        return []
    return [
        CameraHypothesis(
            rows_per_slot=rows,
            packet_slots=0,
            reversed=is_reversed,
            curvature=curvatures[place],
            exposure_slots=min(exposure_of(width / rows, rows), LONG_EXPOSURE_SLOTS),
            score=strength,
            rows_per_slot_sd=rows * rows / (4 * level.shape[1] * coarse.pitch),
            curvature_sd=np.abs(curvatures[place]) / 4,
            number=number,
        )
        for number, place in enumerate(dict.fromkeys((best, n_bends // 2)))
        for rows, strength in (found[place],)
        for is_reversed in (False, True)
    ]


def _coarse(strips: ColumnStrips) -> tuple[ColumnStrips, Float32Array, float]:
    """The strips on rows that are as few as their stripes allow, their levelled light, and the stripes' half width."""
    width = stripe_rows(strips)
    coarse = joined(strips, max(1, int(width / SETTINGS.rows_per_width)))
    return coarse, levelled(coarse.light, coarse.inside, round(SETTINGS.level_widths * width / coarse.pitch)), width


def _strongest_line(
    strips: ColumnStrips, level: Float32Array, curvature: FloatArray, width: float
) -> tuple[float, float]:
    """Rows a slot of the strongest line of the slots on stripes of one bend, and its strength."""
    columns = columns_of(straightened(strips, level, curvature), strips.n_columns)
    line, n_rows = _slot_line(columns), columns.shape[1]
    low, high = (int(_FINE * n_rows / rows) for rows in reversed(_slot_range(width, strips.pitch)))
    peaks = low + _peaks(line[low : high + 2], 1, 1) if high > low + 2 else np.zeros(0)
    place = peaks[0] if peaks.size else 0.0  # where there is no light, there is none
    return (_FINE * n_rows / place * strips.pitch, float(line[round(place)])) if place > 0 else (width, 0.0)


def _slot_range(width: float, pitch: float) -> tuple[float, float]:
    """Fewest and most joined rows of a slot, for stripes of a half width."""
    fewest, most = (width / slots / pitch for slots in reversed(SETTINGS.half_width_slots))
    return max(fewest, SETTINGS.min_rows_per_slot / pitch), most


def _distinct(found: Iterable[CameraHypothesis]) -> list[CameraHypothesis]:
    """The best few that differ, the best first."""
    out: list[CameraHypothesis] = []
    for clock in sorted(found, key=lambda clock: -clock.score):
        if len(out) < SETTINGS.n_proposed and not any(_is_same(clock, better) for better in out):
            out.append(clock)
    return out


@lru_cache(maxsize=4)  # The reason why a picture shows no clock asks again.
def stripe_rows(strips: ColumnStrips) -> float:
    """Rows of the lag at which strips are half as like the one beside as a row later; 0 where there are no stripes.

    Neighbours have no noise in common. Texture that is wider than the stripes counts as well, so that levels follow
    what was found.
    """
    width = SETTINGS.rows_per_width
    for _ in range(SETTINGS.width_rounds):
        level = levelled(strips.light, strips.inside, round(SETTINGS.level_widths * width))
        width = _half_width(_autocorrelation(level[:-1:2], level[1::2]))
        if width <= 0:
            break
    return width


def exposure_of(half_width_slots: float, rows_per_slot: float) -> float:
    """Exposure, slots, by the half width of the light's autocorrelation.

    Slots of random light give a triangle that is one slot wide at half its height; exposure and developing widen it by
    boxes, and widths of boxes add up in square.
    """
    square = (2 * half_width_slots) ** 2 - 1 - (SETTINGS.mixed_rows / rows_per_slot) ** 2
    return float(np.sqrt(max(square, SETTINGS.min_exposure_slots**2)))


def _half_width(correlation: FloatArray) -> float:
    """Lag at which an autocorrelation is half of that at lag 1; 0 where there is none."""
    top = correlation[1] if correlation.size > 2 else 0.0
    below = np.flatnonzero(correlation[1:] < top / 2)
    if top <= 0 or below.size == 0:
        return 0.0
    lag = int(below[0]) + 1
    return float(lag - (top / 2 - correlation[lag]) / max(correlation[lag - 1] - correlation[lag], TINY))


def _is_same(candidate: CameraHypothesis, better: CameraHypothesis) -> bool:
    return abs(np.log(candidate.rows_per_slot / better.rows_per_slot)) < SETTINGS.same_clock and (
        (candidate.reversed, candidate.packet_slots) == (better.reversed, better.packet_slots)
    )


def _clocks(
    strips: ColumnStrips, level: Float32Array, curvature: FloatArray, width: float, exposures: dict[int, float]
) -> Iterator[CameraHypothesis]:
    """Clocks that stand out on stripes of one bend, in any order."""
    straight = straightened(strips, level, curvature)
    columns = columns_of(straight, strips.n_columns)
    n_rows, pitch = columns.shape[1], strips.pitch
    # Of the light itself: soft signs have steeper edges.
    half_width = _half_width(_autocorrelation(straight.reshape(strips.n_columns, -1, n_rows).mean(axis=1)))
    shortest, longest = _slot_range(width, pitch)
    # The line: places are cycles over the picture, times _FINE.
    line = _slot_line(columns)
    low, high = (int(_FINE * n_rows / rows) for rows in (longest, shortest))
    lines = _FINE * n_rows / (low + _peaks(line[low : high + 2], SETTINGS.n_peaks, 2 * _FINE))
    # Light exposed for about a slot has a stronger line at twice the rate.
    harmonics = _FINE * np.array([1, 2])
    copies = _surprise(_autocorrelation(_from_their_tops(columns)), round(2 * SLOTS_PER_SYMBOL * shortest))
    total = np.concatenate([[0.0], np.cumsum(columns.mean(axis=0, dtype=np.float64))])
    for length, exposure in exposures.items():
        low, high = (int(rows * length) for rows in (shortest, longest))
        lags = low + _peaks(copies[low : high + 1], SETTINGS.n_peaks, max(round(2 * shortest), 1))
        for rows in np.concatenate([lines, lags / length]).tolist():
            # Of the shortest packets a picture may show less than a payload, but more than a preamble.
            least = length - PREAMBLE_SLOTS
            least = least if length > min(exposures) else min(least, 2 * PREAMBLE_SLOTS)
            if rows * least > n_rows:
                continue
            strength = float(np.interp(harmonics * n_rows / rows, np.arange(line.size), line).max())
            found = min(exposure_of(half_width / rows, rows * pitch), LONG_EXPOSURE_SLOTS)
            clock = _Clock(rows, length, strength, exposure, found)
            yield from _both_ways(clock, copies, total, curvature, pitch)


def _smeared_clocks(strips: ColumnStrips, exposures: dict[int, float], *, may_bend: bool) -> Iterator[CameraHypothesis]:
    """Clocks of light that is exposed for several slots: its changes over one slot are as sharp as a short exposure.

    Args:
        strips: of the picture.
        exposures: stated exposure in slots by packet length, 0 for none.
        may_bend: whether the camera may have taken a distortion out.
    """
    is_stated = any(exposures.values())
    for rows, curvature, strength, found, change in _long_exposures(strips, may_bend=may_bend, is_stated=is_stated):
        columns = columns_of(straightened(strips, change, curvature), strips.n_columns)
        copies = _surprise(_autocorrelation(_from_their_tops(columns)), round(2 * SLOTS_PER_SYMBOL * rows))
        total = np.concatenate([[0.0], np.cumsum(columns.mean(axis=0, dtype=np.float64))])
        for length, exposure in exposures.items():
            if rows * (length - PREAMBLE_SLOTS) <= columns.shape[1]:
                clock = _Clock(rows, length, strength, exposure, found)
                yield from _both_ways(clock, copies, total, curvature, strips.pitch)


@dataclass(frozen=True, slots=True)
class _Clock:
    """Rows a slot and length of packets that may be those of a picture."""

    rows: float
    length: int
    #: How far the line of the slots stands out, log-likelihood.
    strength: float
    #: Exposure that the file states, 0 where it does not, and that the light shows, slots.
    stated: float
    found: float


def _both_ways(
    clock: _Clock, copies: FloatArray, total: FloatArray, curvature: FloatArray, pitch: float
) -> Iterator[CameraHypothesis]:
    """Cameras with a clock, as the rows stand and read backwards.

    Args:
        clock: the clock.
        copies: (R,) excess of the columns' autocorrelation.
        total: (R + 1,) running sum of the columns' mean.
        curvature: (4,) of the stripes.
        pitch: picture rows of a row.
    """
    rows, length = clock.rows, clock.length
    common = float(np.interp(rows * length, np.arange(copies.size), copies, right=0.0)) ** 2
    common += 2 * min(clock.strength, SETTINGS.max_line)
    off_slots = SETTINGS.period_error[clock.found > LONG_EXPOSURE_SLOTS]
    for is_reversed, header in enumerate(_header_peaks(total, rows, length)):
        yield CameraHypothesis(
            rows_per_slot=rows * pitch,
            packet_slots=length,
            reversed=bool(is_reversed),
            curvature=curvature,
            exposure_slots=clock.stated or clock.found,
            score=max(header, 0.0) ** 2 + common,
            # A period that is off by a part of a slot over the picture shows as well.
            rows_per_slot_sd=rows * rows * pitch * off_slots / copies.size,
            curvature_sd=np.abs(curvature) / 4,
            stated_exposure_slots=clock.stated,
        )


def _long_exposures(
    strips: ColumnStrips, *, may_bend: bool, is_stated: bool
) -> Iterator[tuple[float, FloatArray, float, float, Float32Array]]:
    """Rows a slot, bend, strength of their line, exposure in slots and the changes of the light over a slot.

    None if the strongest line is of a short exposure.
    """
    lines = slot_lines(strips)
    # Lines of noise have a strength of 2 on average.
    least = max(2 + SETTINGS.min_slot_line, SETTINGS.min_line_share * max((line[1] for line in lines), default=0.0))
    lines = [(rows, strength) for rows, strength in lines if strength >= least]
    # Of light that is exposed for half a slot more than whole ones the line is at twice the rate.
    reach = SETTINGS.off_line
    tried = [along_the_line(strips, order * rows, reach, may_bend=may_bend) for order in (1, 2) for rows, _ in lines]
    tried += [(rows, np.zeros(4), strength) for rows, strength in lines if rows <= SETTINGS.min_phase_rows]
    found = sorted((line for line in tried if line), key=lambda line: -line[2])
    for number, (rows, curvature, strength) in enumerate(found):
        if strength < SETTINGS.min_line_share * found[0][2] or _is_among(rows, (line[0] for line in found[:number])):
            continue
        change, _ = changes_over(strips.light, strips.inside, rows, strips.noise.sigma)
        exposure = exposure_by_changes(columns_of(change, strips.n_columns), rows)
        if exposure > LONG_EXPOSURE_SLOTS or is_stated:
            yield rows, curvature, strength, exposure, change
        elif number == 0:
            return


def _is_among(rows: float, known: Iterable[float]) -> bool:
    return any(abs(np.log(rows / near)) < SETTINGS.same_clock for near in known)


def exposure_by_changes(columns: Float32Array, rows_per_slot: float) -> float:
    """Exposure of random words, slots, by changes (C, R) of the light over a slot; 0 where too little is in view.

    A slot that comes into an exposure leaves it an exposure later, so that changes are unlike those an exposure before.
    """
    lags, exposures, shapes = _likeness_of_changes()
    if columns.shape[1] < 2 * lags[-1] * rows_per_slot:
        return 0.0
    overlap = np.arange(columns.shape[1], 0, -1)
    own = _autocorrelation(_own_light(columns)) / overlap
    likeness = np.interp(lags * rows_per_slot, np.arange(overlap.size), own)
    similarity = shapes @ likeness
    best = int(np.clip(similarity.argmax(), 1, similarity.size - 2))
    offset = np.clip(peak_offset(*similarity[best - 1 : best + 2]), -0.5, 0.5)
    return float(exposures[best] + SETTINGS.exposure_step * offset)


@cache
def _likeness_of_changes() -> tuple[FloatArray, FloatArray, FloatArray]:
    """(K,) lags and (E,) exposures in slots; (E, K) autocorrelation of the light's changes over a slot, of norm 1."""
    step, reach = 1 / _SAMPLES, 3 * SLOTS_PER_SYMBOL
    every = np.arange(-reach, reach + step / 2, step)
    # Slots of a word have a fixed sum.
    distance = np.abs(np.arange(-reach, reach + 1))
    expected = np.where(distance == 0, 1.0, -np.maximum(1 - distance / SLOTS_PER_SYMBOL, 0) / (SLOTS_PER_SYMBOL - 1))
    slots = np.convolve(np.interp(every, np.arange(-reach, reach + 1), expected), _TRIANGLE, "same")
    exposures = np.arange(SETTINGS.min_exposure_slots, MAX_EXPOSURE_SLOTS, SETTINGS.exposure_step)
    lags = np.arange(0, MAX_EXPOSURE_SLOTS + 1.5, step)
    shapes = [
        2 * np.interp(lags, every, slots) - np.interp(lags - e, every, slots) - np.interp(lags + e, every, slots)
        for e in exposures.tolist()
    ]
    return lags, exposures, np.stack([shape / np.linalg.norm(shape) for shape in shapes])


@lru_cache(maxsize=2)  # A picture is asked again without the exposure that its file states.
def slot_lines(strips: ColumnStrips) -> list[tuple[float, float]]:
    """Rows a slot and how far its line stands out, by the turns of the light, likeliest first."""
    import cv2

    found: list[tuple[float, float]] = []
    for lag in SETTINGS.turn_lags:
        parts = _turns(strips, lag)
        if not parts:
            continue
        product, turns = parts
        size = cv2.getOptimalDFTSize(_FINE * turns.shape[1])
        # Together, and each column by itself, since the stripes of corrected pictures are bent.
        own = product.sum(axis=0, keepdims=True), product, turns
        spectrum = np.asarray(sum(_line_spectrum(part, lag, size) for part in own))
        frequency = np.arange(spectrum.size) / size
        # The mosaic shows as periods of two and of four rows.
        mosaic = np.minimum(np.abs(frequency - 0.25), np.abs(frequency - 0.5)) < SETTINGS.mosaic_line
        fewest, most = (lag * lags for lags in SETTINGS.slot_lags)
        inside = (frequency > 1 / most) & (frequency < 1 / fewest) & ~mosaic
        peaks = _peaks(np.where(inside, spectrum, 0.0), SETTINGS.n_peaks, 2 * _FINE)
        found += [(float(spectrum[round(peak)]), size / peak) for peak in peaks.tolist() if peak > 0]
    distinct: list[tuple[float, float]] = []
    for strength, rows in sorted(found, reverse=True):
        if len(distinct) < SETTINGS.n_peaks and not _is_among(rows, (line[0] for line in distinct)):
            distinct.append((rows, strength))
    return distinct


@lru_cache(maxsize=4)
def _turns(strips: ColumnStrips, lag: int) -> tuple[Float32Array, ...]:
    """What has a line at the rate of the slots: products (C, n) of turns of the light over `lag` rows, and their size.

    Whatever the exposure, light turns between slots only: where a slot comes in, and the other way where it leaves. The
    product of both has a line even of exposures that are not whole slots. Nothing where too few rows are in view.
    """
    black = np.percentile(strips.light, SETTINGS.dark_percent)
    light = np.log(np.maximum(strips.light - np.float32(black), np.float32(SETTINGS.min_light)))
    fewest, most = (lag * lags for lags in SETTINGS.slot_lags)
    nearest, furthest = int(LONG_EXPOSURE_SLOTS * fewest), int(MAX_EXPOSURE_SLOTS * most)
    if light.shape[1] < 2 * furthest:
        return ()
    smooth = local_mean(light, max(lag // 2, 1))
    turn = smooth[:, 2 * lag :] - 2 * smooth[:, lag:-lag] + smooth[:, : -2 * lag]
    turn /= np.median(np.abs(turn), axis=1, keepdims=True) + np.float32(TINY)
    turn = np.clip(turn, -SETTINGS.max_turn, SETTINGS.max_turn)
    n = turn.shape[1]
    columns, turns = (part.reshape(strips.n_columns, -1, n).mean(axis=1) for part in (turn, np.abs(turn)))
    columns = _own_light(columns)
    likeness = _autocorrelation(columns)[nearest:furthest] / np.arange(n, 0, -1)[nearest:furthest]
    exposure = nearest + int(likeness.argmin())
    product = np.zeros_like(columns)
    product[:, exposure:] = -columns[:, :-exposure] * columns[:, exposure:]
    return product, turns


@lru_cache(maxsize=16)
def along_the_line(
    strips: ColumnStrips, rows: float, reach: float, *, may_bend: bool
) -> tuple[float, FloatArray, float] | None:
    """Rows a slot, and bend, by which the turns of the light in the whole picture are in phase, and how much they are.

    None if they stand out no more than by chance.

    Blocks of a few slots of each column have a phase at the rate of the slots. The rate and the bend under which they
    agree are sought on a grid and then by Newton's method, with the lens as it is before the picture is seen.

    Args:
        strips: of the picture.
        rows: a slot, about.
        reach: how far they may be off, relatively.
        may_bend: whether the camera may have taken a distortion out.
    """
    lag = min(SETTINGS.turn_lags, key=lambda lag: abs(np.log(rows / lag / np.prod(SETTINGS.slot_lags) ** 0.5)))
    parts = _turns(strips, lag) if rows > SETTINGS.min_phase_rows else ()
    if not parts:
        return None
    size = max(round(SETTINGS.block_slots * rows), 1)
    n = parts[0].shape[1] // size
    middle = lag + (np.arange(n) + 0.5) * size - 0.5
    x = strips.x.reshape(strips.n_columns, -1, strips.rows.size).mean(axis=1)
    at = np.rint(middle).astype(int)
    terms = curvature_terms(x[:, at], strips.rows[at], strips.width, strips.height) / strips.pitch
    # Of light exposed for half a slot more than whole ones the line is at twice the rate.
    place_in_block = (np.arange(size) - (size - 1) / 2) / rows
    blocks = []
    for part in parts:
        changes = (part - local_mean(part, SLOTS_PER_SYMBOL**2 * lag))[:, : n * size].reshape(len(part), n, size)
        for order in (1, 2):
            block = changes @ np.exp(-2j * np.pi * order * place_in_block)
            blocks.append((order, block / np.linalg.norm(block)))
    bends = np.linspace(-SETTINGS.max_bend, SETTINGS.max_bend, SETTINGS.n_bends) * may_bend
    grid = np.array([[k1, share * k1, 0, 0] for k1 in bends for share in SETTINGS.bend_shares])
    off = np.arange(-reach, reach, SETTINGS.step_off)
    wave = np.exp(-2j * np.pi * (middle + np.tensordot(grid, terms, 1)) / rows)
    nearby = np.exp(-2j * np.pi * middle[:, None] * off / rows)
    score = sum(np.abs((wave**order * block).sum(axis=1) @ nearby**order) ** 2 for order, block in blocks)
    score = score - np.einsum("bi,ij,bj->b", grid, LENS_PRECISION, grid)[:, None] / 2
    # Mosaic and JPEG show as periods of 4, 8 / 3 and 2 rows.
    eighths = 8 * (1 + off) / rows
    score[:, (np.abs(eighths - np.rint(eighths)) < 16 / strips.rows.size) & (eighths > 1.5)] = 0
    by_bend = score.max(axis=1)
    best, straight = int(by_bend.argmax()), int(np.abs(grid).sum(axis=1).argmin())
    if by_bend[best] < 2 * SETTINGS.min_slot_line:
        return None
    if by_bend[best] < by_bend[straight] + SETTINGS.min_slot_line:
        best, may_bend = straight, False
    values = np.append((1 + off[score[best].argmax()]) / rows, grid[best])
    prior, free = np.zeros((5, 5)), slice(0, 5 if may_bend else 1)
    prior[1:, 1:] = LENS_PRECISION
    for _ in range(SETTINGS.line_steps):
        place = middle + np.tensordot(values[1:], terms, 1)
        slopes = 2 * np.pi * np.concatenate([place[None], terms * values[0]])[free].reshape(-1, place.size)
        normal, pull = prior[free, free].copy(), -(prior @ values)[free]
        for order, block in blocks:
            turned = (block * np.exp(-2j * np.pi * order * place * values[0])).ravel()
            turned = turned * (2 * order * turned.sum().conj())
            around = slopes - (slopes @ turned.real / turned.real.sum())[:, None]
            normal += order * (around * np.maximum(turned.real, 0)) @ around.T
            pull += around @ turned.imag
        values[free] += np.linalg.solve(normal, pull)
    return 1 / float(values[0]), values[1:], float(by_bend[best])


def _line_spectrum(values: Float32Array, lag: int, size: int) -> FloatArray:
    """Power of values (C, n) over what is usual at such frequencies; places are cycles in `size` values."""
    values = values - local_mean(values, SLOTS_PER_SYMBOL**2 * lag)
    n = values.shape[1]
    power = np.square(np.abs(np.fft.rfft(values * np.hanning(n).astype(np.float32), size, axis=1)))
    spectrum = (power / (power.mean(axis=1, keepdims=True) + TINY)).sum(axis=0)
    return np.asarray(spectrum / (local_mean(spectrum[None].astype(np.float32), SETTINGS.line_bins)[0] + TINY))


def _own_light(columns: Float32Array) -> Float32Array:
    """What columns (C, R) do not have in common, as headers, unless all of them send the same."""
    own = columns - columns.mean(axis=0)
    return own if np.square(own).mean() > np.square(columns).mean() / 2 else columns


def _autocorrelation(columns: Float32Array, later: Float32Array | None = None) -> FloatArray:
    """(R,) sum over columns (C, R) of the product with the same columns later, or with others."""
    import cv2

    n = columns.shape[1]
    size = cv2.getOptimalDFTSize(2 * n)
    spectrum = np.fft.rfft(columns, size, axis=1)
    beside = spectrum if later is None else np.fft.rfft(later, size, axis=1)
    return np.asarray(np.fft.irfft((spectrum * beside.conj()).real.sum(axis=0), size)[:n])


def _from_their_tops(columns: Float32Array) -> Float32Array:
    """Columns (C, R) from the first row of each on, as many as the longest has: leaning ones share few."""
    shown, n_rows = columns != 0, columns.shape[1]
    top, bottom = shown.argmax(axis=1), (n_rows - shown[:, ::-1].argmax(axis=1)) * shown.any(axis=1)
    rows = top[:, None] + np.arange(int((bottom - top).max()) or n_rows)
    return np.asarray(np.take_along_axis(columns, rows % n_rows, axis=1) * (rows < n_rows), np.float32)


def _surprise(correlation: FloatArray, shortest: int) -> FloatArray:
    """(R,) excess of an autocorrelation over its median, in standard deviations of lags from `shortest` on."""
    n = correlation.size
    scaled = correlation / np.sqrt(np.arange(n, 0, -1))
    part = scaled[min(shortest, n // 2) : max(n - SLOTS_PER_SYMBOL, n // 2 + 1)]
    middle = float(np.median(part))
    out = np.maximum(scaled - middle, 0) / (float(np.median(np.abs(part - middle))) / NORMAL_MEDIAN + TINY)
    # Hardly any row overlaps there.
    out[-SLOTS_PER_SYMBOL:] = 0
    return np.asarray(out)


def _slot_line(columns: Float32Array) -> FloatArray:
    """Log-likelihood ratio of a line in the spectrum of the edges' power, by cycles over the picture times _FINE."""
    steps = np.diff(columns, axis=1)
    square = np.asarray(steps * steps, np.float32)
    # The level's window is ten symbols at one row a slot, one at ten.
    power = (square - local_mean(square, SLOTS_PER_SYMBOL**2)).sum(axis=0, dtype=np.float64)
    spectrum = np.abs(np.fft.rfft(power, _FINE * columns.shape[1])) ** 2
    return np.asarray(spectrum / max(float(power @ power), TINY))


def _peaks(values: FloatArray, n: int, distance: int) -> FloatArray:
    """Places of the `n` highest peaks, by parabolas; none nearer to a higher one than `distance`."""
    inner = np.flatnonzero((values[1:-1] > values[:-2]) & (values[1:-1] >= values[2:])) + 1
    chosen: list[int] = []
    for at in inner[np.argsort(-values[inner])].tolist():
        if len(chosen) < n and all(abs(at - higher) >= distance for higher in chosen):
            chosen.append(at)
    at = np.array(chosen, np.int64)
    return np.asarray(at + peak_offset(values[at - 1], values[at], values[at + 1]))


def _header_peaks(total: FloatArray, rows_per_slot: float, packet_slots: int) -> tuple[float, float]:
    """Highest peaks of the folded header correlation, in deviations: of headers as sent, and of ones read backwards.

    Args:
        total: (R + 1,) running sum of the columns' mean.
        rows_per_slot: rows a slot.
        packet_slots: slots of a packet.
    """
    step = rows_per_slot / _SAMPLES
    places = np.arange(int((total.size - 1) / step) + 1) * step
    response = header_correlation(np.interp(places, np.arange(total.size), total), _SAMPLES) / step
    if response.size == 0:
        return 0.0, 0.0
    deviation = float(np.median(np.abs(response))) / NORMAL_MEDIAN + TINY
    period = packet_slots * _SAMPLES
    n_copies = folded(np.ones(response.size), period)
    score = folded(response, period) / np.sqrt(np.maximum(n_copies, 1)) / deviation
    return float(score.max()), float(-score.min())
