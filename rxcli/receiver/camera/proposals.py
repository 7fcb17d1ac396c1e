"""Hypotheses of an unknown camera, best first, from one picture of a sending screen. Nothing is decided here.

Edges fall between slots, so their power has a spectral line at the rate of the slots; and columns repeat themselves a
packet later. The periods that stand out so are scored by the correlation with the header. Read backwards, the header is
its own complement, so the sign gives the direction of readout. The bend of the stripes is taken from the
similarity of neighbouring columns; `fit` estimates it from the decoded slots.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Self

import numpy as np

from rxcli.numerics import NORMAL_MEDIAN, TINY, folded, header_correlation, local_mean, peak_offset
from rxcli.profiles import ScreenProfile
from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL
from rxcli.receiver.camera.curvature import UNIT_BEND, likeliest_bend, straightened, tried_bends
from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.stripes import FINE, Stripes, autocorrelation, half_width, own_light, peaks
from rxcli.receiver.camera.strips import ColumnStrips, columns_of
from rxcli.receiver.light import LONG_EXPOSURE_SLOTS, MAX_EXPOSURE_SLOTS, changes_over
from rxcli.types import Float32Array, FloatArray

#: Samples a slot at which headers are sought.
_SAMPLES = 4
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
    stripes: Stripes, screens: Sequence[ScreenProfile], exposure_s: float | None = None
) -> list[CameraHypothesis]:
    """Cameras that may have taken a picture, the best few; `in_phase` makes one precise.

    Args:
        stripes: of the picture.
        screens: screens that it may show, at least one.
        exposure_s: exposure, None where the file does not state it.
    """
    if stripes.half_width <= 0:
        return []
    rates = {screen.packet_slots: screen.slot_rate_hz for screen in reversed(screens)}
    exposures = {length: (exposure_s or 0.0) * rate for length, rate in rates.items()}
    bends = [np.zeros(4)] + ([likeliest_bend(*stripes.coarse)] if stripes.strips.may_bend else [])
    found = [clock for curvature in bends for clock in _clocks(stripes, curvature, exposures)]
    is_short = exposure_s is not None and max(exposures.values()) <= LONG_EXPOSURE_SLOTS
    smeared = [] if is_short else _distinct(_smeared_clocks(stripes, exposures))
    if smeared:  # Stripes as wide as those of the longest exposures are of no short one.
        found = [clock for clock in found if clock.exposure_slots < LONG_EXPOSURE_SLOTS]
    short = _distinct(clock for clock in found if not any(_is_same(clock, better) for better in smeared))
    ranked = sorted(smeared + short, key=lambda clock: -clock.score)
    least = {False: SETTINGS.min_score, True: SETTINGS.min_long_score}
    likely = [clock for clock in ranked if clock.score >= least[clock.exposure_slots > LONG_EXPOSURE_SLOTS]]
    return [replace(clock, number=number) for number, clock in enumerate(likely or short[:1])]


def in_phase(stripes: Stripes, clock: CameraHypothesis) -> CameraHypothesis:
    """A clock of a short exposure with rows per slot and bend by the whole picture, where that is plain."""
    pitch = stripes.strips.pitch
    rows = clock.rows_per_slot / pitch
    # Beside the line of the mosaic, its phase cannot be distinguished from that of the slots.
    if clock.exposure_slots > LONG_EXPOSURE_SLOTS or abs(rows / _MOSAIC_ROWS - 1) < 2 * SETTINGS.off_clock:
        return clock
    found = stripes.in_phase(rows, SETTINGS.off_clock)
    # Lines of text have a phase as well.
    if found is None or found.strength < 2 * SETTINGS.max_line:
        return clock
    return replace(clock, rows_per_slot=found.rows * pitch, curvature=found.curvature)


def propose_slots(stripes: Stripes) -> list[CameraHypothesis]:
    """Cameras by the spectral line of the slot rate alone, for less than a packet, whose length stays open."""
    if (width := stripes.half_width) <= 0:
        return []
    coarse, level = stripes.coarse

    def line(curvature: FloatArray) -> tuple[float, float, FloatArray]:
        rows, strength = _strongest_line(coarse, level, curvature, width)
        return strength, rows, curvature

    lines = [line(np.zeros(4))]
    if coarse.may_bend:
        bends = tried_bends(coarse) * UNIT_BEND
        # Neighbouring columns show about the bend.
        near = np.abs(bends - likeliest_bend(coarse, level)).max(axis=1).argsort()[:3]
        lines.append(max(map(line, bends[near]), key=lambda found: found[0]))
    lines.sort(key=lambda found: -found[0])
    if lines[0][0] < SETTINGS.min_slot_line:
        return []
    return [
        CameraHypothesis(
            rows_per_slot=rows,
            packet_slots=0,
            reversed=is_reversed,
            curvature=curvature,
            exposure_slots=min(exposure_of(width / rows, rows), LONG_EXPOSURE_SLOTS),
            score=strength,
            rows_per_slot_sd=rows * rows / (4 * level.shape[1] * coarse.pitch),
            curvature_sd=np.abs(curvature) / 4,
            number=number,
        )
        for number, (strength, rows, curvature) in enumerate(lines)
        for is_reversed in (False, True)
    ]


def _strongest_line(
    strips: ColumnStrips, level: Float32Array, curvature: FloatArray, width: float
) -> tuple[float, float]:
    """Rows a slot of the strongest line of the slots on stripes of one bend, and its strength."""
    columns = columns_of(straightened(strips, level, curvature), strips.n_columns)
    line, n_rows = _slot_line(columns), columns.shape[1]
    low, high = (int(FINE * n_rows / rows) for rows in reversed(_slot_range(width, strips.pitch)))
    places = low + peaks(line[low : high + 2], 1, 1) if high > low + 2 else np.zeros(0)
    place = places[0] if places.size else 0.0  # where there is no light, there is none
    return (FINE * n_rows / place * strips.pitch, float(line[round(place)])) if place > 0 else (width, 0.0)


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


def exposure_of(half_width_slots: float, rows_per_slot: float) -> float:
    """Exposure, slots, by the half width of the light's autocorrelation.

    Slots of random light give a triangle that is one slot wide at half its height; exposure and developing widen it by
    boxes, and widths of boxes add up in square.
    """
    square = (2 * half_width_slots) ** 2 - 1 - (SETTINGS.mixed_rows / rows_per_slot) ** 2
    return float(np.sqrt(max(square, SETTINGS.min_exposure_slots**2)))


def _is_same(candidate: CameraHypothesis, better: CameraHypothesis) -> bool:
    return abs(np.log(candidate.rows_per_slot / better.rows_per_slot)) < SETTINGS.same_clock and (
        (candidate.reversed, candidate.packet_slots) == (better.reversed, better.packet_slots)
    )


def _clocks(stripes: Stripes, curvature: FloatArray, exposures: dict[int, float]) -> Iterator[CameraHypothesis]:
    """Clocks that stand out on stripes of one bend, in any order."""
    strips, level = stripes.coarse
    straight = straightened(strips, level, curvature)
    columns = columns_of(straight, strips.n_columns)
    n_rows, pitch = columns.shape[1], strips.pitch
    # Of the light itself: soft signs have steeper edges.
    light_width = half_width(autocorrelation(straight.reshape(strips.n_columns, -1, n_rows).mean(axis=1)))
    shortest, longest = _slot_range(stripes.half_width, pitch)
    # The line: places are cycles over the picture, times FINE.
    line = _slot_line(columns)
    low, high = (int(FINE * n_rows / rows) for rows in (longest, shortest))
    lines = FINE * n_rows / (low + peaks(line[low : high + 2], SETTINGS.n_peaks, 2 * FINE))
    # Light exposed for about a slot has a stronger line at twice the rate.
    harmonics = FINE * np.array([1, 2])
    repeats = _Repeats.of(columns, shortest, curvature, pitch)
    for length, stated in exposures.items():
        low, high = (int(rows * length) for rows in (shortest, longest))
        lags = low + peaks(repeats.copies[low : high + 1], SETTINGS.n_peaks, max(round(2 * shortest), 1))
        for rows in np.concatenate([lines, lags / length]).tolist():
            # Of the shortest packets a picture may show less than a payload, but more than a preamble.
            least = length - PREAMBLE_SLOTS
            least = least if length > min(exposures) else min(least, 2 * PREAMBLE_SLOTS)
            if rows * least > n_rows:
                continue
            strength = float(np.interp(harmonics * n_rows / rows, np.arange(line.size), line).max())
            found = min(exposure_of(light_width / rows, rows * pitch), LONG_EXPOSURE_SLOTS)
            yield from repeats.cameras(rows, length, strength, stated, found)


def _smeared_clocks(stripes: Stripes, exposures: dict[int, float]) -> Iterator[CameraHypothesis]:
    """Clocks of light that is exposed for several slots: its changes over one slot are as sharp as a short exposure.

    None if the strongest line is of a short exposure and the file states none.

    Args:
        stripes: of the picture.
        exposures: stated exposure in slots by packet length, 0 for none.
    """
    strips, is_stated = stripes.strips, any(exposures.values())
    for number, (rows, curvature, strength) in enumerate(stripes.long_lines):
        change, _ = changes_over(strips.light, strips.inside, rows, strips.noise.sigma)
        found = exposure_by_changes(columns_of(change, strips.n_columns), rows)
        if found <= LONG_EXPOSURE_SLOTS and not is_stated:
            if number == 0:
                return
            continue
        columns = columns_of(straightened(strips, change, curvature), strips.n_columns)
        repeats = _Repeats.of(columns, rows, curvature, strips.pitch)
        for length, stated in exposures.items():
            if rows * (length - PREAMBLE_SLOTS) <= columns.shape[1]:
                yield from repeats.cameras(rows, length, strength, stated, found)


@dataclass(frozen=True, slots=True)
class _Repeats:
    """What the columns of stripes of one bend show of copies and headers."""

    #: (R,) excess of the columns' autocorrelation, and (R + 1,) running sum of their mean.
    copies: FloatArray
    total: FloatArray
    #: (4,) bend of the stripes, and picture rows of a row.
    curvature: FloatArray
    pitch: float

    @classmethod
    def of(cls, columns: Float32Array, shortest: float, curvature: FloatArray, pitch: float) -> Self:
        """From columns (C, R) whose slots have `shortest` rows and more."""
        copies = _surprise(autocorrelation(_from_their_tops(columns)), round(2 * SLOTS_PER_SYMBOL * shortest))
        total = np.concatenate([[0.0], np.cumsum(columns.mean(axis=0, dtype=np.float64))])
        return cls(copies, total, curvature, pitch)

    def cameras(
        self, rows: float, length: int, strength: float, stated: float, found: float
    ) -> Iterator[CameraHypothesis]:
        """Cameras that may have taken the picture, as its rows stand and read backwards.

        Args:
            rows: of a slot.
            length: of a packet, slots.
            strength: how far the line of the slots stands out, log-likelihood.
            stated: exposure that the file states, slots, 0 where it does not.
            found: exposure that the light shows.
        """
        common = float(np.interp(rows * length, np.arange(self.copies.size), self.copies, right=0.0)) ** 2
        common += 2 * min(strength, SETTINGS.max_line)
        off_slots = SETTINGS.period_error[found > LONG_EXPOSURE_SLOTS]
        for is_reversed, header in enumerate(_header_peaks(self.total, rows, length)):
            yield CameraHypothesis(
                rows_per_slot=rows * self.pitch,
                packet_slots=length,
                reversed=bool(is_reversed),
                curvature=self.curvature,
                exposure_slots=stated or found,
                score=max(header, 0.0) ** 2 + common,
                # A period that is off by a part of a slot over the picture shows as well.
                rows_per_slot_sd=rows * rows * self.pitch * off_slots / self.copies.size,
                curvature_sd=np.abs(self.curvature) / 4,
                stated_exposure_slots=stated,
            )


def exposure_by_changes(columns: Float32Array, rows_per_slot: float) -> float:
    """Exposure of random words, slots, by changes (C, R) of the light over a slot; 0 where too little is in view.

    A slot that comes into an exposure leaves it an exposure later, so that changes are unlike those an exposure before.
    """
    lags, exposures, shapes = _likeness_of_changes()
    if columns.shape[1] < 2 * lags[-1] * rows_per_slot:
        return 0.0
    overlap = np.arange(columns.shape[1], 0, -1)
    own = autocorrelation(own_light(columns)) / overlap
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
    """Log-likelihood ratio of a line in the spectrum of the edges' power, by cycles over the picture times FINE."""
    steps = np.diff(columns, axis=1)
    square = np.asarray(steps * steps, np.float32)
    # The level's window is ten symbols at one row a slot, one at ten.
    power = (square - local_mean(square, SLOTS_PER_SYMBOL**2)).sum(axis=0, dtype=np.float64)
    spectrum = np.abs(np.fft.rfft(power, FINE * columns.shape[1])) ** 2
    return np.asarray(spectrum / max(float(power @ power), TINY))


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
