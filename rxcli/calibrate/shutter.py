"""Line delay and readout of a rolling shutter from pictures of lamps that blink at known frequencies.

One lamp lights all its rows at once, so wherever it shines the stripes have one period and one phase. The picture is
cut into cells; the clearest stripes give a template, every cell that follows it belongs to that lamp, and the search
goes on among the rest. Small lamps in a dark picture are searched each in its own part (`rxcli.calibrate.spots`). Each
lamp's region is then summed to one profile and fitted (`rxcli.calibrate.periodic`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from rxcli.calibrate import periodic
from rxcli.calibrate.exposure import ExposureEstimate, estimate_exposure
from rxcli.calibrate.fitting import weighted_mean
from rxcli.calibrate.periodic import FEW_PERIODS, PeriodicFit, fit_fundamental
from rxcli.calibrate.spots import find_spots
from rxcli.errors import ReceiverError, UsageError
from rxcli.numerics import Z95
from rxcli.profiles import LensModel
from rxcli.types import BoolArray, FloatArray, IntArray

Axis = Literal["rows", "columns"]
#: Whether it has few periods, negative worth, most likely frequency, strips [from, to) and rows [from, to) of a window.
_Candidate = tuple[int, float, float, int, int, int, int]
Picture = NDArray[np.float32] | NDArray[np.float64]
#: Left, top, right, bottom, stored pixels; right and bottom are outside.
Box = tuple[int, int, int, int]
#: Strips into which the picture is cut, and a region.
_STRIPS, _PARTS = 32, 12
#: Fewest lines along which stripes are sought.
_MIN_SIDE = 24
_MAX_LAMPS = 8
#: Share of textures taken for a lamp, where textures lie within `_TEXTURE_LEAN` radians of the lines at any angle.
_FALSE_ALARM, _TEXTURE_LEAN = 0.01, 0.1
#: Windows that are fitted in search of a lamp; fewest periods of a lamp in a spot.
_MAX_TRIED, _MIN_SPOT_PERIODS = 2, 2.5
#: Stripes that are enough wherever they are.
_ENOUGH_PERIODS = 6
#: Logarithm of the ratio of two line delays that may still be one.
_SAME_LINE_DELAY = 0.02
#: Readout from which it is doubted; periods of the blocks of codecs, and the relative distance at which one is equal.
_LONG_READOUT_S, _BLOCKS_PX, _SAME_PERIOD = 0.1, (8, 16), 2e-3
#: Smallest region of a lamp, as a share of the picture, by its number of periods.
_MIN_AREA = ((2.0, 4.0, 6.0, 12.0), (0.15, 0.05, 0.015, 0.003))


@dataclass(frozen=True, slots=True)
class Stripes:
    """The region of one lamp in one picture."""

    bounds: Box
    fit: PeriodicFit
    #: (n,) summed profile, picture units.
    profile: FloatArray
    #: How much the stripes may lean against the lines, lines per pixel across; those of a lamp do not.
    lean: float = np.inf
    #: The picture's number, and the given frequency that fits the common line delay, or None.
    picture: int = 0
    frequency_hz: float | None = None

    @property
    def period_px(self) -> float:
        """Rows (or columns, along a columns axis) of one period."""
        return 1 / self.fit.frequency

    @property
    def period_sd_px(self) -> float:
        """Standard deviation of the period."""
        return self.fit.frequency_sd / self.fit.frequency**2

    @property
    def is_lamp(self) -> bool:
        """Whether the stripes lie along the lines so exactly that texture does so by chance in `_FALSE_ALARM` only."""
        return self.lean < _FALSE_ALARM * _TEXTURE_LEAN

    @property
    def line_delay_s(self) -> float | None:
        """Line delay by the lamp's frequency."""
        return self.fit.frequency / self.frequency_hz if self.frequency_hz else None

    @property
    def area_px(self) -> int:
        """Pixels of the region."""
        return _common_area(self.bounds, self.bounds)


@dataclass(frozen=True, slots=True)
class ShutterCalibration:
    """Timing of the shutter."""

    axis: Axis
    #: Height and width of the pictures.
    shape: tuple[int, ...]
    #: Time between two rows, and its standard deviation.
    line_delay_s: float
    line_delay_sd_s: float
    #: Largest number of periods in one region.
    periods: float
    exposure: ExposureEstimate
    lamps: tuple[Stripes, ...] = ()
    #: What a user should know before trusting the figures.
    warnings: tuple[str, ...] = ()
    #: Lens whose distortion the camera corrected, estimated with the line delay; None where stripes are straight.
    lens: LensModel | None = None
    #: Why the stripes may be none of a lamp; a profile is then written on demand only.
    doubts: tuple[str, ...] = ()

    @property
    def n_lines(self) -> int:
        """Rows, or columns, that are read one after the other."""
        return self.shape[0 if self.axis == "rows" else 1]

    @property
    def line_delay_interval_s(self) -> tuple[float, float]:
        """95 % confidence interval."""
        return self.line_delay_s - Z95 * self.line_delay_sd_s, self.line_delay_s + Z95 * self.line_delay_sd_s

    @property
    def readout_s(self) -> float:
        """From the first line to the last."""
        return self.line_delay_s * self.n_lines

    @property
    def readout_interval_s(self) -> tuple[float, float]:
        """95 % confidence interval."""
        low, high = self.line_delay_interval_s
        return low * self.n_lines, high * self.n_lines


def find_stripes(picture: Picture, axis: Axis | None = None, window: Box | None = None) -> tuple[Axis, list[Stripes]]:
    """Find the regions lit by blinking lamps.

    Args:
        picture: (height, width) brightness, any scale.
        axis: the readout axis; None: the rows if they show a lamp, or that along which the stripes are clearer.
        window: part of the picture to search; None: all of it.

    Returns:
        The axis and one region a lamp, clearest first; none where there are no stripes.
    """
    left, top, right, bottom = window = window or (0, 0, picture.shape[1], picture.shape[0])
    by_axis: dict[Axis, list[Stripes]] = {}
    for along in (axis,) if axis else ("rows", "columns"):
        found = by_axis[along] = _find_in(picture, window, along)
        for x0, y0, x1, y1 in find_spots(picture[top:bottom, left:right], 0 if along == "rows" else 1):
            spot = (x0 + left, y0 + top, x1 + left, y1 + top)
            if any(2 * _common_area(spot, lamp.bounds) >= _common_area(spot, spot) for lamp in found):
                continue
            for lamp in _find_in(picture, spot, along):
                overlap = (5 * _common_area(lamp.bounds, s.bounds) >= min(lamp.area_px, s.area_px) for s in found)
                if lamp.fit.periods >= _MIN_SPOT_PERIODS and not any(overlap):
                    found.append(lamp)
        if any(lamp.is_lamp for lamp in found):
            return along, found
    return max(by_axis.items(), key=lambda item: _evidence(item[1]))


def _common_area(box_a: Box, box_b: Box) -> int:
    across, down = (min(box_a[i + 2], box_b[i + 2]) - max(box_a[i], box_b[i]) for i in (0, 1))
    return max(across, 0) * max(down, 0)


def _evidence(found: list[Stripes]) -> float:
    """Logarithm of what the stripes leave of the variance, summed over the pixels of their regions."""
    return sum(-s.area_px * float(np.log(max(1 - s.fit.explained, 1e-6))) for s in found)


def _find_in(picture: Picture, box: Box, axis: Axis) -> list[Stripes]:
    """Find lamp after lamp in a part of the picture, each among the cells that the ones before left free."""
    part = picture[box[1] : box[3], box[0] : box[2]]
    upright = part if axis == "rows" else part.T
    if upright.shape[0] < _MIN_SIDE:
        return []
    edges, strips = _cut(upright, _STRIPS)
    free = np.ones(strips.shape, dtype=bool)
    found: list[Stripes] = []
    candidates = _candidates(strips)
    while len(found) < _MAX_LAMPS and (lamp := _clearest_lamp(strips, free, candidates)):
        members, fit, taken = lamp
        free &= ~taken
        across, top, bottom = np.flatnonzero(members), fit.first_row, fit.first_row + fit.mean.size
        left, right = int(edges[across[0]]), int(edges[across[-1] + 1])
        x0, y0, x1, y1 = (left, top, right, bottom) if axis == "rows" else (top, left, bottom, right)
        bounds = (x0 + box[0], y0 + box[1], x1 + box[0], y1 + box[1])
        lean = periodic.lean_bound(fit, _cut(upright[top:bottom, left:right], _PARTS)[1], (right - left) / _PARTS)
        found.append(Stripes(bounds, fit, np.asarray(strips[members, top:bottom].mean(axis=0)), lean))
    return found


def _cut(upright: Picture, n: int) -> tuple[IntArray, FloatArray]:
    """Borders of `n` strips, fewer of a narrow picture, and (n, rows) their means."""
    edges = np.linspace(0, upright.shape[1], min(n, upright.shape[1]) + 1).astype(int)
    return edges, np.add.reduceat(upright, edges[:-1], axis=1, dtype=np.float64).T / np.diff(edges)[:, None]


def _clearest_lamp(
    strips: FloatArray, free: BoolArray, candidates: list[_Candidate]
) -> tuple[BoolArray, PeriodicFit, BoolArray] | None:
    """The lamp with the clearest stripes among the free cells, or None.

    Returns:
        Its strips, the fit of its rows, and (strips, rows) all cells that follow this lamp.
    """
    fit = _seed(strips, free, candidates)
    if fit is None:
        return None
    for _ in range(2):
        blocks, shares = _follow(strips, free, fit)
        members = shares >= max(0.3, 0.75 * float(np.quantile(shares, 0.95)))
        b0, b1 = periodic.longest_block(members)
        if b1 == b0:
            return None
        chosen = np.asarray(members[:, b0:b1].all(axis=1), np.bool_)
        rows = slice(int(blocks[b0]), int(blocks[b1]))
        fit = fit_fundamental(np.asarray(strips[chosen, rows].mean(axis=0)), fit.frequency, rows.start)
        if fit is None or not fit.significant:
            return None
        # A lamp lights its rows at once, in parts that can be compared; tiles, windows and chessboards stand beside
        # their own negatives.
        upside_down = fit.periods < 2 * FEW_PERIODS and 8 * int(np.sum(shares < -0.3)) > int(members.sum())
        area = float(np.mean(chosen)) * fit.mean.size / strips.shape[1]
        if upside_down or chosen.sum() < periodic.MIN_PARTS or area < float(np.interp(fit.periods, *_MIN_AREA)):
            return None
    sd = max(fit.frequency_sd, periodic.scatter_sd(fit.influence, strips[chosen, rows]))
    taken = np.repeat(shares > 0.15, np.diff(blocks), axis=1)
    taken[chosen, rows] = True
    return chosen, replace(fit, frequency_sd=sd), taken


def _candidates(strips: FloatArray) -> list[_Candidate]:
    """The most likely frequency of every window (a group of neighbouring strips by a span of rows), clearest first.

    A few waves come last: the fall-off of a spot passes for a wave or two.
    """
    n, n_strips = strips.shape[1], len(strips)
    sums = np.concatenate([np.zeros((1, n)), np.cumsum(strips, axis=0)])
    sizes = sorted({1, 4, n_strips})
    runs = [(at, at + size) for size in sizes for at in range(0, n_strips - size + 1, max(size // 2, 1))]
    groups = np.array([(sums[end] - sums[at]) / (end - at) for at, end in runs]).reshape(len(runs), n)
    found = []
    for length in (n, n // 2, n // 4):
        for start in range(0, n - length + 1, max(length // 2, 1)) if length >= _MIN_SIDE else ():
            part = groups[:, start : start + length]
            uneven = np.flatnonzero(np.ptp(part, axis=1) > 1e-9)
            for few, (frequencies, scores) in enumerate(periodic.search(part[uneven]) if uneven.size else ()):
                for run, frequency, score in zip(uneven.tolist(), frequencies.tolist(), scores.tolist(), strict=True):
                    if score > 0:
                        # Among equally clear windows the longer one determines the frequency better.
                        worth = score * np.log(length)
                        found.append((few, -worth, frequency, *runs[run], start, start + length))
    return sorted(found)


def _seed(strips: FloatArray, free: BoolArray, candidates: list[_Candidate]) -> PeriodicFit | None:
    """The first significant fit of the clearest windows that are free, one window a span of rows."""
    tried: set[tuple[int, int, int]] = set()
    for few, _, frequency, strip, end_strip, start, stop in candidates:
        n_tried = sum(number == few for number, *_ in tried)
        cells = slice(strip, end_strip), slice(start, stop)
        if (few, start, stop) in tried or n_tried == _MAX_TRIED or not free[cells].all():
            continue
        tried.add((few, start, stop))
        fit = fit_fundamental(strips[cells].mean(axis=0), frequency, start)
        if fit is not None and fit.significant:
            return fit
    return None


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
    for block, (start, stop) in enumerate(pairwise(blocks.tolist())):
        share = periodic.explained_share(strips[:, start:stop], template[start:stop])
        shares[:, block] = np.where(free[:, start:stop].all(axis=1), share, 0)
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
        frequencies_hz: of the lamps.
        axis: the readout axis, None to find it.
        exif_exposure_s: exposure in the file, which decides between exposure and flash length.
        window: left, top, width, height of the part to search; None: all.
        tone_known: whether the values are surely proportional to light; if not, the exposure's interval is wider.

    Raises:
        UsageError: the window lies outside the pictures.
        ReceiverError: no stripes, too few periods, or several ways to fit the frequencies.
    """
    height, width = pictures[0].shape
    box = None
    if window is not None:
        x, y, *size = window
        box = x, y, min(x + size[0], width), min(y + size[1], height)
        if min(box[2] - x, box[3] - y) < 1 or max(box[2] - x, box[3] - y) < _MIN_SIDE:
            reason = f"region {x},{y},{size[0]},{size[1]} lies outside the picture of {width}x{height}"
            raise UsageError(reason, "give it in stored pixels")
    by_picture = [find_stripes(picture, axis, box) for picture in pictures]
    axes: tuple[Axis, Axis] = ("rows", "columns")
    along = max(axes, key=lambda a: sum(_evidence(found) for of, found in by_picture if of == a))
    regions = [replace(s, picture=i) for i, (of, found) in enumerate(by_picture) if of == along for s in found]
    if not regions:
        where = "the picture" if len(pictures) == 1 else f"any of {len(pictures)} pictures"
        raise not_found(where, pictures, (axis,) if axis else axes, max(frequencies_hz))
    reference = _common_line_delay(regions, frequencies_hz)
    lamps = [replace(s, frequency_hz=_match(s, frequencies_hz, reference)) for s in regions]
    used = [(lamp, lamp.frequency_hz) for lamp in lamps if lamp.frequency_hz]
    delays = [(lamp.fit.frequency / hz, lamp.fit.frequency_sd / hz) for lamp, hz in used]
    value, sd = weighted_mean(*zip(*delays, strict=True))
    clearest = max((lamp for lamp, _ in used), key=lambda lamp: lamp.fit.explained * np.sqrt(lamp.area_px))
    exposure = estimate_exposure(clearest.fit, clearest.profile, value, exif_exposure_s, tone_known)
    notes, periods = _warnings(lamps, frequencies_hz, value), max(lamp.fit.periods for lamp, _ in used)
    result = ShutterCalibration(along, pictures[0].shape, value, sd, periods, exposure, tuple(lamps), tuple(notes))
    return replace(result, doubts=_doubts(result, is_coded=not tone_known))


def _doubts(result: ShutterCalibration, *, is_coded: bool) -> tuple[str, ...]:
    """Why the stripes may be none of a lamp, of a picture that may have been coded in blocks."""
    doubts = []
    if result.readout_s > _LONG_READOUT_S:
        doubts.append(f"a readout of {1e3 * result.readout_s:.0f} ms is rare in cameras: the stripes may be texture")
    for lamp in result.lamps if is_coded else ():
        block = next((px for px in _BLOCKS_PX if abs(lamp.period_px / px - 1) < _SAME_PERIOD), None)
        if lamp.frequency_hz and block:
            doubts.append(f"a period of {block} px is that of the blocks in which pictures and clips are coded")
    return tuple(doubts)


def not_found(
    where: str, pictures: Sequence[Picture], axes: Sequence[Axis] = ("rows", "columns"), hz: float | None = None
) -> ReceiverError:
    """Why there are no stripes in pictures of a lamp, of known frequency or not."""
    bands = max(bands_across(picture, axis) for picture in pictures for axis in axes)
    if bands:
        faster = (
            f"{_ENOUGH_PERIODS / bands:.2g} times its frequency"
            if hz is None
            else f"{hz * _ENOUGH_PERIODS / bands:.2g} Hz"
        )
        reason = f"too few stripes in {where}: {bands} bright band{'s' * (bands > 1)} across it at most"
        return ReceiverError(reason, f"let the lamp blink at {faster} or more, or use a slower readout")
    hint = "let the lamp fill more of the frame, expose for well below half a period, by the electronic shutter"
    return ReceiverError(f"no stripes of a blinking lamp in {where}", f"{hint}, without HDR and flicker reduction")


def bands_across(picture: Picture, axis: Axis) -> int:
    """Bright bands across the whole picture, as a lamp that is too slow makes them; 0 where there are none, or many."""
    upright = picture if axis == "rows" else picture.T
    small = cv2.resize(np.asarray(upright, np.float32), (16, 256), interpolation=cv2.INTER_AREA)
    levels = np.log(small + 0.02)
    common = levels.mean(axis=1)
    uneven = levels - common[:, None] - (levels - common[:, None]).mean(axis=0)
    if float(np.ptp(common)) < 0.3 or float(uneven.var()) > 0.1 * float(common.var()):
        return 0
    bright = common > (common.max() + common.min()) / 2
    bands = int(np.sum(np.diff(bright.astype(int), prepend=0) > 0))
    return bands if bands < _ENOUGH_PERIODS else 0


def _common_line_delay(regions: list[Stripes], frequencies_hz: Sequence[float]) -> float:
    """The line delay under which most of the light is of a given frequency.

    Every pairing of a region with a frequency proposes one. A proposal's weight is the number of given frequencies that
    it accounts for, then the light of the regions that agree with it.

    Raises:
        ReceiverError: several frequencies are given, and the regions fit them in more than one way.
    """
    proposals = []
    for line_delay_s in (1 / (hz * s.period_px) for s in regions for hz in frequencies_hz):
        matches = [(s, match) for s in regions if (match := _match(s, frequencies_hz, line_delay_s))]
        weight = sum(s.area_px * s.fit.explained for s, _ in matches)
        proposals.append((len({match for _, match in matches}), weight, line_delay_s))
    n_used, weight, chosen = max(proposals)
    rivals = [p for p in proposals if p[0] == n_used and abs(np.log(p[2] / chosen)) > _SAME_LINE_DELAY]
    if len(set(frequencies_hz)) > 1 and any(p[1] > weight / 2 for p in rivals):
        lamps = "lamps of periods of " + ", ".join(f"{px:.4g}" for px in sorted(s.period_px for s in regions)) + " px"
        ways = f"{chosen * 1e6:.4g} or {max(rivals)[2] * 1e6:.4g} us a row"
        reason = f"{lamps} were found, which fit the frequencies given in more than one way: {ways}"
        raise ReceiverError(reason, "give the frequencies of these lamps alone, or let all of the lamps show")
    return chosen


def _match(stripes: Stripes, frequencies_hz: Sequence[float], line_delay_s: float) -> float | None:
    """The given frequency that explains a region under a line delay."""
    observed_hz = 1 / (stripes.period_px * line_delay_s)
    nearest = min(frequencies_hz, key=lambda hz: abs(np.log(hz / observed_hz)))
    tolerance = max(4 * stripes.period_sd_px / stripes.period_px, 3e-3)
    return nearest if abs(nearest / observed_hz - 1) <= tolerance else None


def _warnings(lamps: list[Stripes], frequencies_hz: Sequence[float], line_delay_s: float) -> list[str]:
    """What a user should know before trusting the figures."""
    unknown = [(lamp.bounds, 1 / (lamp.period_px * line_delay_s)) for lamp in lamps if lamp.frequency_hz is None]
    notes = [f"a lamp at {box} blinks at about {hz:.4g} Hz, which was not given" for box, hz in unknown]
    missing = set(frequencies_hz) - {lamp.frequency_hz for lamp in lamps}
    if missing:
        notes.append("no lamp of " + ", ".join(f"{f:g} Hz" for f in sorted(missing)) + " was seen")
    periods = max(lamp.fit.periods for lamp in lamps if lamp.frequency_hz)
    if periods < 4:
        notes.append(f"only {periods:.1f} periods seen; a faster lamp gives a narrower interval")
    return notes
