"""Propose hypotheses with log priors, likeliest first. Nothing is decided here."""

from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile
from rxcli.receiver.channel import within_light, without_steady_light
from rxcli.receiver.frame.acquisition import noise_of, variants_of
from rxcli.receiver.frame.cache import FrameCache, key_of
from rxcli.receiver.frame.camera import FrameCamera
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.frame.result import Failure
from rxcli.receiver.light import LONG_EXPOSURE_SLOTS
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.search.cameras import (
    estimated_camera,
    has_stated_readout,
    known_camera,
    propose_cameras,
    relabelled_camera,
)
from rxcli.receiver.search.evidence import USUAL_COLUMNS, is_whole
from rxcli.receiver.search.hypothesis import Hypothesis, Scored
from rxcli.receiver.search.outlines import without_borders
from rxcli.receiver.search.settings import SETTINGS
from rxcli.receiver.sync import clock as sync
from rxcli.types import Clock, Remark, RowProfiles

#: Relative difference of line delays up to which an estimate agrees with a profile.
_SAME_LINE_DELAY = 0.01


@dataclass(frozen=True, slots=True)
class Proposer:
    """Proposes hypotheses about one frame.

    Attributes:
        cache: the picture.
        options: screens and cameras.
        outlines: that the screen may have.
        known: the camera and the screens, if known from other frames.
        may_bend: whether an unknown camera may have taken a distortion out.
    """

    cache: FrameCache
    options: ReceiverOptions
    outlines: tuple[Outline, ...]
    known: FrameContext | None = None
    may_bend: bool = True
    #: Number of this way among the `ways` to look at the picture, and its log prior.
    way: int = 0
    log_prior: float = 0.0
    #: Whether it doubts what profile or file state of the camera; outlines of the light that shows an unknown camera,
    #: if these are others.
    doubts: bool = False
    lit: tuple[Outline, ...] = ()

    def families(self) -> list[Outline]:
        """One outline of every family, likeliest first: packets are the same whichever column is the first."""
        return _families(self.outlines)

    def cameras(self) -> Generator[list[Hypothesis], None, Remark | None]:
        """Hypotheses camera by camera, the likeliest camera first; returns the reason why there are none, or no more.

        Rows are the same instants wherever the columns are, so the first family with any camera serves for all.
        """
        known = self.known.camera if self.known else known_camera(self.cache.frame, self.options)
        if isinstance(known, Failure):
            return known.remark
        if known is not None:
            yield self._of_camera(known, self.log_prior)
            return None
        reason, n_proposed = None, 0
        usual = nearest_screen(self.options.screens, USUAL_COLUMNS).columns
        for outline in _families(self.lit or self.outlines):
            cameras = propose_cameras(self.cache, outline.corners, self.options, usual, may_bend=self.may_bend)
            try:
                while True:
                    if hypotheses := self._of_camera(next(cameras), self.log_prior - SETTINGS.next_camera * n_proposed):
                        yield hypotheses
                        n_proposed += 1
            except StopIteration as end:
                reason = reason or end.value
            if n_proposed:
                break
        return reason

    def _of_camera(self, camera: FrameCamera, log_prior: float) -> list[Hypothesis]:
        """Hypotheses of one camera: a screen for every outline and clock."""
        screens, out = self._screens(), []
        if camera.hypothesis is not None:
            screens = tuple(screen for screen in screens if screen.packet_slots == camera.hypothesis.packet_slots)
        # Rivals of a grid are tried once there are packets, as its siblings.
        for outline in (family for family in self.families() if not family.rival_odds):
            prior = log_prior + SETTINGS.temper * outline.log_odds
            nearest = (nearest_screen(same, USUAL_COLUMNS) for same in _by_clock(outline, camera, screens).values())
            out += [self._hypothesis(outline, camera, screen, prior) for screen in nearest]
        return out

    def _screens(self) -> tuple[ScreenProfile, ...]:
        return self.known.screens if self.known else self.options.screens

    def possible_screens(self, best: Hypothesis) -> tuple[ScreenProfile, ...]:
        """Screens that the camera of a hypothesis may have seen: without its readout any slot rate is possible."""
        shows_rate = best.camera.profile is not None or has_stated_readout(best.camera, self.cache.frame)
        rate = best.screen.slot_rate_hz
        return tuple(screen for screen in self.options.screens if screen.slot_rate_hz == rate or not shows_rate)

    def _hypothesis(self, outline: Outline, camera: FrameCamera, screen: ScreenProfile, log_prior: float) -> Hypothesis:
        variants = variants_of(screen, self.options.screens)
        camera = relabelled_camera(camera, screen, self.cache.frame)
        return Hypothesis(outline, camera, variants[0], variants, log_prior, self.way)

    def context(self, hypothesis: Hypothesis) -> FrameContext:
        """The frame under a hypothesis, with the screens that its camera allows."""
        camera, screens = hypothesis.camera, self._screens()
        if camera.lens is None:
            camera = replace(camera, lens=hypothesis.outline.lens)
        if camera.hypothesis is not None:
            own = hypothesis.screen
            screens = tuple(
                screen
                for screen in screens
                if (screen.slot_rate_hz, screen.packet_slots) == (own.slot_rate_hz, own.packet_slots)
            )
        return FrameContext(self.cache, hypothesis.outline.corners, camera, screens)

    def with_clock(self, hypothesis: Hypothesis) -> Hypothesis | None:
        """The hypothesis with its columns and its clock, or None if no header is found."""
        context = self.context(hypothesis)
        profiles = context.sample_columns(hypothesis.screen.columns)
        with self.cache.timer("clock"):
            clock = _clock(context, hypothesis.screen, profiles)
        # Through a long exposure headers stand out less, and evidence decides.
        is_long = clock is not None and clock.exposure_slots > LONG_EXPOSURE_SLOTS
        if clock is None or clock.header_peak_ratio < (1.0 if is_long else SETTINGS.min_lead):
            return None
        profiles = without_steady_light(within_light(profiles, clock, noise_of(profiles)), clock)
        return replace(hypothesis, clock=clock, profiles=profiles)

    def contradicts(self, scored: Scored) -> bool:
        """Whether an estimate is not the camera that is stated, or its exposure that of a screen of another rate.

        Under a screen that is not the one in the picture, an estimate may fit what profile and file rule out.
        """
        frame, camera, own = self.cache.frame, scored.context.camera, scored.hypothesis.screen.slot_rate_hz
        known, stated_s = known_camera(frame, self.options), frame.metadata.exposure_s
        if isinstance(known, FrameCamera) and abs(camera.line_delay_s / known.line_delay_s - 1) > _SAME_LINE_DELAY:
            return True
        if not stated_s:
            return False
        off = {
            rate: abs(np.log(camera.exposure_s * own / (stated_s * rate)))
            for rate in (s.slot_rate_hz for s in self.options.screens)
        }
        return min(off, key=off.__getitem__) != own

    def work(self, hypothesis: Hypothesis) -> int:
        """Slots x columns in view, which the search for a clock goes through; see `SearchSettings.work`."""
        shown = np.ptp(np.clip(hypothesis.outline.corners[:, 1], 0, self.cache.frame.height))
        screen = hypothesis.screen
        return int(shown * hypothesis.camera.line_delay_s * screen.slot_rate_hz * screen.columns)

    def siblings(self, scored: Scored) -> Iterator[Hypothesis]:
        """Hypotheses that differ from a scored one in one respect, with their changed log prior."""
        hypothesis = replace(scored.hypothesis, camera=scored.context.camera, clock=None, profiles=None)
        outline, camera, log_prior = hypothesis.outline, hypothesis.camera, hypothesis.log_prior
        clock, n_columns = _clock_of(hypothesis.screen, camera), hypothesis.screen.columns
        # Other columns than those of a grid all of whose columns have packets of their own would have fewer.
        for candidate in () if is_whole(scored.reception) else self.families():
            same_clock = _by_clock(candidate, camera, self.options.screens).get(clock)
            if same_clock and candidate.family != outline.family:
                change = SETTINGS.temper * (candidate.log_odds - outline.log_odds)
                change += candidate.rival_odds - outline.rival_odds
                yield self._hypothesis(candidate, camera, nearest_screen(same_clock, n_columns), log_prior + change)
        if camera.hypothesis is not None and scored.reception.is_long and scored.evidence < SETTINGS.plain:
            # What long exposures leave of a packet fits either way to some extent.
            other_way = replace(camera.hypothesis, reversed=not camera.reversed)
            back = estimated_camera(other_way, hypothesis.screen.slot_rate_hz, self.cache.frame)
            yield self._hypothesis(outline, back, hypothesis.screen, log_prior)
        by_clock = _by_clock(outline, camera, self.options.screens)
        by_columns = {screen.columns: screen for screen in reversed(by_clock.pop(clock, []))}
        for columns, screen in by_columns.items():
            if columns != n_columns and scored.evidence < SETTINGS.plain:
                yield self._hypothesis(outline, camera, screen, log_prior)


def ways(
    cache: FrameCache,
    options: ReceiverOptions,
    outlines: Sequence[Outline],
    known: FrameContext | None = None,
    *,
    may_bend: bool = True,
    may_doubt: bool = False,
) -> Iterator[Proposer]:
    """Ways to look at a picture, likeliest first: later ones are for pictures that the others do not explain.

    Args:
        cache: the picture.
        options: screens and cameras.
        outlines: that the screen may have.
        known: see `Proposer`.
        may_bend: see `Proposer`.
        may_doubt: whether what profile and file state of the camera may be wrong.
    """
    stated = Proposer(cache, options, tuple(outlines), known, may_bend)
    yield stated
    less_likely = replace(stated, way=1, log_prior=-SETTINGS.reach)
    if outlines[0].family >= 0 and (without := without_borders(cache)):
        # Of one column that sends alone, its own rows give the camera, and given corners its number.
        is_given = options.corners is not None
        yield replace(less_likely, outlines=(*outlines, *(() if is_given else without)), lit=tuple(without))
    if not may_doubt:
        return
    frame, estimated = cache.frame, replace(options, cameras=(), force_camera=False)
    doubtful = replace(less_likely, options=estimated, doubts=True)
    if known_camera(frame, options) is not None:
        yield replace(doubtful, way=2)
    if frame.metadata.exposure_s is not None:
        unstated = cache.with_metadata(replace(frame.metadata, exposure_s=None))
        yield replace(doubtful, cache=unstated, way=3, log_prior=-2 * SETTINGS.reach)


def _families(outlines: Sequence[Outline]) -> list[Outline]:
    families: dict[int, list[Outline]] = {}
    for outline in outlines:
        families.setdefault(outline.family, []).append(outline)
    chosen = [likeliest_of_family(family) for family in families.values()]
    return sorted(chosen, key=lambda outline: (-outline.rival_odds, -outline.log_odds, outline.family))


def likeliest_of_family(outlines: Sequence[Outline]) -> Outline:
    """The likeliest outline of a family, under which its packets are sought.

    If no numbering is likely, columns are counted from the left of the visible part.
    """
    odds = np.array([outline.log_odds for outline in outlines])
    best = max(outlines, key=lambda outline: (outline.log_odds, -_left(outline)))
    share = 1 / float(np.exp(odds - odds.max()).sum())
    if best.fills and share < SETTINGS.likely_certainty:
        possible = (outline for outline in outlines if outline.log_odds > best.log_odds - SETTINGS.reach)
        return max(possible, key=_left)
    return best


def _left(outline: Outline) -> float:
    """Position of an outline's left side along its top, for a viewer: larger is further right."""
    along = outline.corners[1] - outline.corners[0]
    return float(outline.corners[0] @ along / np.linalg.norm(along))


def nearest_screen(screens: Iterable[ScreenProfile], n_columns: int) -> ScreenProfile:
    """The screen whose number of columns is nearest."""
    return min(screens, key=lambda screen: (abs(np.log(screen.columns / n_columns)), screen.columns))


def _clock_of(screen: ScreenProfile, camera: FrameCamera) -> tuple[float, int]:
    """Key by which a picture distinguishes screens: packet slots, and with a known camera the slot rate."""
    return (0.0 if camera.hypothesis is not None else screen.slot_rate_hz), screen.packet_slots


def _by_clock(
    outline: Outline, camera: FrameCamera, screens: Iterable[ScreenProfile]
) -> dict[tuple[float, int], list[ScreenProfile]]:
    """Screens with the columns of an outline by their clock; if that has no slot rate, only the fastest of them."""
    groups: dict[tuple[float, int], list[ScreenProfile]] = {}
    for screen in sorted(screens, key=lambda profile: -profile.slot_rate_hz):
        group = groups.setdefault(_clock_of(screen, camera), [])
        is_fastest = all(faster.columns != screen.columns for faster in group)
        if outline.n_columns in (None, screen.columns) and (is_fastest or camera.hypothesis is None):
            group.append(screen)
    return {clock: groups[clock] for clock in sorted(groups) if groups[clock]}


def _clock(context: FrameContext, screen: ScreenProfile, profiles: RowProfiles) -> Clock | None:
    """The clock of a hypothesis; sought once for all exposures that are not long, as it is the same."""
    camera, corners = context.camera, context.sampled_corners
    rows_per_slot = 1 / (screen.slot_rate_hz * camera.line_delay_s)
    exposure_slots = camera.exposure_s * screen.slot_rate_hz

    def find() -> Clock | None:
        pooled = sync.binned_strips(profiles)
        return sync.find_clock(pooled, rows_per_slot, exposure_slots, screen.packet_slots, noise_of(pooled))

    long_slots = exposure_slots if exposure_slots > LONG_EXPOSURE_SLOTS else None
    place = corners.tobytes(), key_of(camera.lens), camera.tone, camera.reversed
    clock = context.cache.once((*place, screen.columns, screen.packet_slots, rows_per_slot, long_slots), find)
    return clock and replace(clock, exposure_slots=exposure_slots)
