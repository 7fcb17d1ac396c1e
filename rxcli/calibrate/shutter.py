"""Line delay and readout of a rolling shutter from pictures of lamps that blink at known frequencies.

One lamp lights all its rows at once, so wherever it shines the stripes have one period and one phase. The picture is
cut into cells; the clearest stripes give a template, every cell that follows it belongs to that lamp, and the search
goes on among the rest. Lamps that are small spots in a dark picture are looked for each in its own part
(`rxcli.calibrate.spots`). Each lamp's region is then summed to one profile and fitted (`rxcli.calibrate.periodic`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rxcli.calibrate.exposure import estimate_exposure
from rxcli.calibrate.periodic import (
    FEW_PERIODS,
    MIN_PERIODS,
    PeriodicFit,
    explained_share,
    fit_fundamental,
    longest_block,
    scatter_sd,
    search_few,
    search_many,
    significant,
)
from rxcli.calibrate.spots import find_spots
from rxcli.errors import ReceiverError, UsageError
from rxcli.types import BoolArray, FloatArray

Axis = Literal["rows", "columns"]
Picture = NDArray[np.float32] | NDArray[np.float64]
#: Two-sided 95 % quantile of the normal distribution.
_Z95 = 1.959964
_STRIPS = 32
#: Shortest side of a picture that is looked at, pixels.
_MIN_SIDE = 24
_MAX_LAMPS = 8
#: Logarithm of the ratio of two line delays that may still be one.
_SAME_LINE_DELAY = 0.02
#: Smallest region of a lamp, as a share of the picture, by its number of periods.
_MIN_AREA = ((2.0, 4.0, 6.0, 12.0), (0.15, 0.05, 0.015, 0.003))
_HINT = (
    "let the lamp fill more of the frame, shorten the exposure to well below half a period, and use the electronic "
    "shutter with HDR and flicker reduction off"
)


@dataclass(frozen=True, slots=True)
class Stripes:
    """The region of one lamp in one picture."""

    #: Left, top, right, bottom of the region, stored pixels; right and bottom are outside.
    bounds: tuple[int, int, int, int]
    #: Rows (or columns, along a columns axis) of one period, and its standard deviation.
    period_px: float
    period_sd_px: float
    periods: float
    #: Share of the profile's variance that the stripes explain.
    explained: float
    fit: PeriodicFit
    #: (n,) summed profile, picture units.
    profile: FloatArray


@dataclass(frozen=True, slots=True)
class LampReading:
    """One lamp in one picture with the line delay that it gives."""

    picture: int
    stripes: Stripes
    #: None where no given frequency fits the common line delay.
    frequency_hz: float | None
    line_delay_s: float | None
    line_delay_sd_s: float | None


@dataclass(frozen=True, slots=True)
class ShutterCalibration:
    """What the stripes say of the shutter."""

    axis: Axis
    #: Height and width of the pictures.
    shape: tuple[int, ...]
    #: Time between two rows, and its standard deviation.
    line_delay_s: float
    line_delay_sd_s: float
    #: Most periods seen in one region.
    periods: float
    #: Why there is no exposure, or what it rests on.
    exposure_note: str
    exposure_s: float | None = None
    exposure_interval_s: tuple[float, float] | None = None
    lamps: tuple[LampReading, ...] = ()
    #: What a user should know before trusting the figures.
    warnings: tuple[str, ...] = ()

    @property
    def n_lines(self) -> int:
        """Rows, or columns, that are read one after the other."""
        return self.shape[0 if self.axis == "rows" else 1]

    @property
    def line_delay_interval_s(self) -> tuple[float, float]:
        """95 % confidence interval."""
        return self.line_delay_s - _Z95 * self.line_delay_sd_s, self.line_delay_s + _Z95 * self.line_delay_sd_s

    @property
    def readout_s(self) -> float:
        """From the first line to the last."""
        return self.line_delay_s * self.n_lines

    @property
    def readout_interval_s(self) -> tuple[float, float]:
        """95 % confidence interval."""
        low, high = self.line_delay_interval_s
        return low * self.n_lines, high * self.n_lines


def find_stripes(picture: Picture, axis: Axis | None = None) -> tuple[Axis, list[Stripes]]:
    """Regions lit by blinking lamps.

    Args:
        picture: (height, width) brightness, any scale.
        axis: the readout axis; None: the one along which the stripes are clearer.

    Returns:
        The axis and one region a lamp, clearest first; none where there are no stripes.
    """
    spots = find_spots(picture)
    if axis is not None:
        return axis, _regions(picture, spots, axis)
    by_rows, by_columns = _regions(picture, spots, "rows"), _regions(picture, spots, "columns")
    return ("columns", by_columns) if _evidence(by_columns) > _evidence(by_rows) else ("rows", by_rows)


def _regions(picture: Picture, spots: Sequence[tuple[int, int, int, int]], axis: Axis) -> list[Stripes]:
    """Lamps of the whole picture, and of its spots where it shows none."""
    found = _find_along(picture if axis == "rows" else picture.T, axis)
    for spot in spots:
        if any(_holds_most(spot, other.bounds) for other in found):
            continue
        for lamp in _lamps_of_spot(picture, spot, axis):
            if not any(_overlap(lamp.bounds, other.bounds) for other in found):
                found.append(lamp)
    return found


def _holds_most(spot: tuple[int, int, int, int], region: tuple[int, int, int, int]) -> bool:
    """Whether a lamp's region is a spot, more or less."""
    return _common_area(spot, region) >= _area_of(spot) / 2


def _area_of(box: tuple[int, int, int, int]) -> int:
    return (box[2] - box[0]) * (box[3] - box[1])


def _common_area(one: tuple[int, int, int, int], other: tuple[int, int, int, int]) -> int:
    across = min(one[2], other[2]) - max(one[0], other[0])
    down = min(one[3], other[3]) - max(one[1], other[1])
    return max(across, 0) * max(down, 0)


def _overlap(one: tuple[int, int, int, int], other: tuple[int, int, int, int]) -> bool:
    """Whether two boxes share a fifth of the smaller one or more."""
    return 5 * _common_area(one, other) >= min(_area_of(one), _area_of(other))


def _lamps_of_spot(picture: Picture, spot: tuple[int, int, int, int], axis: Axis) -> list[Stripes]:
    """Lamps in a spot with enough periods to be sure."""
    left, top, right, bottom = spot
    part = picture[top:bottom, left:right]
    if min(part.shape) < _MIN_SIDE:
        return []
    lamps = _find_along(part if axis == "rows" else part.T, axis)
    return [_placed(lamp, left, top) for lamp in lamps if lamp.periods >= FEW_PERIODS]


def _evidence(found: list[Stripes]) -> float:
    """Light that the stripes explain, summed over their regions."""
    return sum(_area(s) * s.explained * float(np.std(s.profile)) for s in found)


def _area(stripes: Stripes) -> int:
    return _area_of(stripes.bounds)


def _find_along(picture: Picture, axis: Axis) -> list[Stripes]:
    """Peel off lamp after lamp; time runs along the first dimension."""
    edges = np.linspace(0, picture.shape[1], min(_STRIPS, picture.shape[1]) + 1).astype(int)
    strips = np.add.reduceat(picture, edges[:-1], axis=1, dtype=np.float64).T / np.diff(edges)[:, None]
    free = np.ones(strips.shape, dtype=bool)
    found: list[Stripes] = []
    for _ in range(_MAX_LAMPS):
        lamp = _clearest_lamp(strips, free)
        if lamp is None:
            break
        members, rows, fit, profile, taken = lamp
        free &= ~taken
        found.append(_stripes(members, rows, fit, profile, edges, axis))
    return found


def _stripes(
    members: BoolArray, rows: slice, fit: PeriodicFit, profile: FloatArray, edges: np.ndarray, axis: Axis
) -> Stripes:
    across = np.flatnonzero(members)
    left, right = int(edges[across[0]]), int(edges[across[-1] + 1])
    bounds = (left, rows.start, right, rows.stop) if axis == "rows" else (rows.start, left, rows.stop, right)
    period = 1 / fit.frequency
    return Stripes(bounds, period, fit.frequency_sd * period**2, fit.periods, fit.explained, fit, profile)


def _clearest_lamp(
    strips: FloatArray, free: BoolArray
) -> tuple[BoolArray, slice, PeriodicFit, FloatArray, BoolArray] | None:
    """The lamp with the clearest stripes among the free cells, or None.

    Returns:
        Member strips, row range, fit, profile, and (strips, rows) all cells that follow this lamp.
    """
    fit = _seed(strips, free)
    if fit is None:
        return None
    for _ in range(2):
        blocks, shares = _follow(strips, free, fit)
        members = shares >= max(0.3, 0.75 * float(np.quantile(shares, 0.95)))
        b0, b1 = longest_block(members)
        if b1 == b0:
            return None
        chosen = np.asarray(members[:, b0:b1].all(axis=1), np.bool_)
        rows = slice(int(blocks[b0]), int(blocks[b1]))
        profile = np.asarray(strips[chosen, rows].mean(axis=0))
        grown = fit_fundamental(profile, fit.frequency, rows.start)
        if grown is None or grown.periods < MIN_PERIODS or not significant(grown):
            return None
        if not _one_lamp(shares, members, float(np.mean(chosen)) * profile.size / strips.shape[1], grown):
            return None
        fit = grown
    sd = max(fit.frequency_sd, scatter_sd(fit.influence, strips[chosen, rows]))
    fit = replace(fit, frequency_sd=sd)
    taken = np.repeat(shares > 0.15, np.diff(blocks), axis=1)
    taken[chosen, rows] = True
    return chosen, rows, fit, profile, taken


def _one_lamp(shares: FloatArray, members: BoolArray, area: float, fit: PeriodicFit) -> bool:
    """Whether a region can be a lamp's: large enough, and nowhere upside down.

    A lamp lights its rows at once, while tiles, windows and chessboards stand beside their own negatives.
    """
    few = fit.periods < 2 * FEW_PERIODS
    upside_down = int(np.sum(shares < -0.3))
    least = float(np.interp(fit.periods, *_MIN_AREA))
    return area >= least and not (few and 8 * upside_down > int(members.sum()))


def _seed(strips: FloatArray, free: BoolArray) -> PeriodicFit | None:
    """The best fit of the best-scoring windows: groups of neighbouring strips by spans of rows.

    A few waves are looked for only where there are not many: the fall-off of a spot passes for a wave or two.
    """
    windows = []
    for first, length in _windows(strips.shape[1]):
        rows = slice(first, first + length)
        groups = _groups(strips[:, rows], np.asarray(free[:, rows].all(axis=1)))
        if len(groups):
            windows.append((first, groups))
    for search in (search_many, search_few):
        for frequency, profile, first in _best_windows(windows, search):
            fit = fit_fundamental(profile, frequency, first)
            if fit is not None and fit.periods >= MIN_PERIODS and significant(fit):
                return fit
    return None


def _best_windows(
    windows: list[tuple[int, FloatArray]], search: Callable[[FloatArray], tuple[FloatArray, FloatArray]]
) -> list[tuple[float, FloatArray, int]]:
    """Frequency, profile and first row of the three clearest windows."""
    candidates = []
    for first, groups in windows:
        frequencies, scores = search(groups)
        at = int(np.argmax(scores))
        if scores[at] > 0:
            # Among equally clear windows the longer one tells the frequency better.
            worth = float(scores[at] * np.log(groups.shape[1]))
            candidates.append((worth, float(frequencies[at]), groups[at], first))
    return [candidate[1:] for candidate in sorted(candidates, key=lambda c: -c[0])[:3]]


def _windows(n: int) -> list[tuple[int, int]]:
    """Spans of rows: the whole, halves and quarters, half overlapping."""
    spans = []
    for parts in (1, 2, 4):
        length = n // parts
        if length >= 24:
            spans += [(first, length) for first in range(0, n - length + 1, max(length // 2, 1))]
    return spans


def _groups(strips: FloatArray, usable: BoolArray) -> FloatArray:
    """Means over runs of 1, 4 and all strips, where all of a run is usable and not flat."""
    runs = [
        slice(first, first + size)
        for size in sorted({1, 4, len(strips)})
        for first in range(0, len(strips) - size + 1, max(size // 2, 1))
    ]
    means = [strips[run].mean(axis=0) for run in runs if usable[run].all()]
    groups: FloatArray = np.array(means, np.float64).reshape(len(means), strips.shape[1])
    return np.asarray(groups[np.ptp(groups, axis=1) > 1e-9])


def _follow(strips: FloatArray, free: BoolArray, fit: PeriodicFit) -> tuple[np.ndarray, FloatArray]:
    """How well each cell follows a lamp's template.

    Returns:
        (blocks + 1,) row edges of the blocks, (strips, blocks) explained shares; zero where a cell is not free.
    """
    n = strips.shape[1]
    length = max(2.5 / fit.frequency, n / 32, 16.0)
    blocks = np.linspace(0, n, max(int(n / length), 1) + 1).astype(int)
    template = fit.waveform(np.arange(n, dtype=np.float64))
    shares = np.zeros((len(strips), blocks.size - 1))
    for block in range(blocks.size - 1):
        rows = slice(int(blocks[block]), int(blocks[block + 1]))
        share, _ = explained_share(strips[:, rows], template[rows])
        shares[:, block] = np.where(free[:, rows].all(axis=1), share, 0)
    return blocks, shares


def calibrate_shutter(
    pictures: Sequence[Picture],
    frequencies_hz: Sequence[float],
    axis: Axis | None = None,
    exif_exposure_s: float | None = None,
    window: tuple[int, int, int, int] | None = None,
    tone_known: bool = True,
) -> ShutterCalibration:
    """Line delay from pictures (or frames of a clip) of lamps of known frequency.

    Args:
        pictures: (height, width) each, all of one size and readout mode; best proportional to light, for the exposure.
        frequencies_hz: what the lamps blink at; more than one where lamps differ.
        axis: the readout axis, None to find it.
        exif_exposure_s: exposure as the file says, which decides between exposure and flash length.
        window: left, top, width, height of the part to look at; None: all.
        tone_known: whether the values are surely proportional to light; if not, the exposure's interval says so.

    Raises:
        ReceiverError: no stripes, or too few periods.
    """
    found = [_found_in(picture, axis, window) for picture in pictures]
    axis = _common_axis(found)
    seen = [(i, s) for i, (of, regions) in enumerate(found) if of == axis for s in regions]
    if not seen:
        where = "the picture" if len(pictures) == 1 else f"any of {len(pictures)} pictures"
        raise ReceiverError(f"no stripes of a blinking lamp in {where}", _HINT)
    reference = _common_line_delay([s for _, s in seen], frequencies_hz)
    lamps = [_reading(i, s, frequencies_hz, reference) for i, s in seen]
    return _combine(lamps, pictures[0].shape, axis, frequencies_hz, exif_exposure_s, tone_known)


def _found_in(
    picture: Picture, axis: Axis | None, window: tuple[int, int, int, int] | None
) -> tuple[Axis, list[Stripes]]:
    """Stripes in the window, placed in the whole picture."""
    if window is None:
        return find_stripes(picture, axis)
    x, y, width, height = window
    part = picture[y : y + height, x : x + width]
    if min(part.shape) < _MIN_SIDE:
        raise UsageError(
            f"region {x},{y},{width},{height} lies outside the picture of {picture.shape[1]}x{picture.shape[0]}",
            "give it in stored pixels",
        )
    axis, regions = find_stripes(part, axis)
    return axis, [_placed(s, x, y) for s in regions]


def _placed(stripes: Stripes, x: int, y: int) -> Stripes:
    """The region of a part of a picture, in the whole, whose pixel (x, y) is the part's first."""
    left, top, right, bottom = stripes.bounds
    return replace(stripes, bounds=(left + x, top + y, right + x, bottom + y))


def _common_axis(found: list[tuple[Axis, list[Stripes]]]) -> Axis:
    """The axis with most evidence over all pictures."""
    weight = {"rows": 0.0, "columns": 0.0}
    for axis, regions in found:
        weight[axis] += _evidence(regions)
    return "columns" if weight["columns"] > weight["rows"] else "rows"


def _tolerance(stripes: Stripes) -> float:
    """Relative deviation at which a region still agrees with a line delay."""
    return max(4 * stripes.period_sd_px / stripes.period_px, 3e-3)


def _common_line_delay(seen: list[Stripes], frequencies_hz: Sequence[float]) -> float:
    """The line delay under which most of the light is of a given frequency.

    Every pairing of a region with a frequency proposes one; a proposal is worth the regions that agree with it, and,
    so that several lamps are told apart, the number of given frequencies that it accounts for.

    Raises:
        ReceiverError: several frequencies are given, and the regions fit them in more than one way.
    """
    proposals = []
    for proposer in seen:
        for proposed in frequencies_hz:
            line_delay = 1 / (proposed * proposer.period_px)
            matches = [(s, _match(s, frequencies_hz, line_delay)) for s in seen]
            weight = sum(_area(s) * s.explained for s, match in matches if match is not None)
            used = {match for _, match in matches} - {None}
            proposals.append((len(used), weight, line_delay))
    n_used, weight, chosen = max(proposals)
    far = [p for p in proposals if abs(np.log(p[2] / chosen)) > _SAME_LINE_DELAY]
    if len(set(frequencies_hz)) > 1 and any(n == n_used and w > weight / 2 for n, w, _ in far):
        rival = max(p for p in far if p[0] == n_used)[2]
        raise ReceiverError(
            f"the lamps that were found (periods of {_periods(seen)} px) fit the frequencies given in more than one "
            f"way: {chosen * 1e6:.4g} or {rival * 1e6:.4g} us a row",
            "give the frequencies of these lamps alone, or let all of the lamps show",
        )
    return chosen


def _periods(seen: list[Stripes]) -> str:
    return ", ".join(f"{period:.4g}" for period in sorted(s.period_px for s in seen))


def _match(stripes: Stripes, frequencies_hz: Sequence[float], line_delay: float) -> float | None:
    """The given frequency that explains a region under a line delay."""
    seen_hz = 1 / (stripes.period_px * line_delay)
    nearest = min(frequencies_hz, key=lambda f: abs(np.log(f / seen_hz)))
    return nearest if abs(nearest / seen_hz - 1) <= _tolerance(stripes) else None


def _reading(picture: int, stripes: Stripes, frequencies_hz: Sequence[float], line_delay: float) -> LampReading:
    frequency = _match(stripes, frequencies_hz, line_delay)
    if frequency is None:
        return LampReading(picture, stripes, None, None, None)
    value = stripes.fit.frequency / frequency
    return LampReading(picture, stripes, frequency, value, stripes.fit.frequency_sd / frequency)


def weighted_mean(values: FloatArray, sds: FloatArray) -> tuple[float, float]:
    """Inverse-variance mean and its standard deviation, enlarged where the values scatter more than they say."""
    weights = 1 / np.maximum(sds, 1e-12 * np.abs(values)) ** 2
    mean = float(weights @ values / weights.sum())
    scatter = float(weights @ (values - mean) ** 2) / max(values.size - 1, 1)
    return mean, float(np.sqrt(max(scatter, 1.0) / weights.sum()))


def _combine(
    lamps: list[LampReading],
    shape: tuple[int, ...],
    axis: Axis,
    frequencies_hz: Sequence[float],
    exif_exposure_s: float | None,
    tone_known: bool,
) -> ShutterCalibration:
    used = [lamp for lamp in lamps if lamp.line_delay_s is not None]
    value, sd = weighted_mean(
        np.array([lamp.line_delay_s for lamp in used]), np.array([lamp.line_delay_sd_s for lamp in used])
    )
    clearest = max(used, key=lambda lamp: lamp.stripes.explained * np.sqrt(_area(lamp.stripes)))
    exposure = estimate_exposure(clearest.stripes.fit, clearest.stripes.profile, value, exif_exposure_s, tone_known)
    return ShutterCalibration(
        axis,
        shape,
        value,
        sd,
        periods=max(lamp.stripes.periods for lamp in used),
        exposure_s=exposure.exposure_s,
        exposure_interval_s=exposure.interval_s,
        exposure_note=exposure.note,
        lamps=tuple(lamps),
        warnings=tuple(_warnings(lamps, frequencies_hz, value)),
    )


def _warnings(lamps: list[LampReading], frequencies_hz: Sequence[float], line_delay_s: float) -> list[str]:
    """What a user should know before trusting the figures."""
    notes = []
    strange = [lamp for lamp in lamps if lamp.frequency_hz is None]
    for lamp in strange:
        seen_hz = 1 / (lamp.stripes.period_px * line_delay_s)
        notes.append(f"a lamp at {lamp.stripes.bounds} blinks at about {seen_hz:.4g} Hz, which was not given")
    missing = set(frequencies_hz) - {lamp.frequency_hz for lamp in lamps}
    if missing:
        notes.append("no lamp of " + ", ".join(f"{f:g} Hz" for f in sorted(missing)) + " was seen")
    periods = max(lamp.stripes.periods for lamp in lamps if lamp.frequency_hz)
    if periods < 4:
        notes.append(f"only {periods:.1f} periods seen; a faster lamp gives a narrower interval")
    return notes
