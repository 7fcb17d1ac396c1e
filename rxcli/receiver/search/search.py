"""Best-first search: make an initial pass of the likeliest hypothesis; its score determines the next one."""

import heapq
from collections.abc import Generator
from dataclasses import replace
from itertools import count

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.receiver.camera.settings import SETTINGS as camera_settings
from rxcli.receiver.frame.acquisition import Acquisition
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.frame.passes import Reception
from rxcli.receiver.frame.result import Failure
from rxcli.receiver.frame.settings import SETTINGS as PASSES
from rxcli.receiver.light import LONG_EXPOSURE_SLOTS
from rxcli.receiver.screen.find import ColumnLayout
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.screen.pose import corners_by_slots
from rxcli.receiver.search import evidence
from rxcli.receiver.search.cameras import settle
from rxcli.receiver.search.hypothesis import Found, Hypothesis, Scored, Tried
from rxcli.receiver.search.numbers import less_likely_outlines, numbered
from rxcli.receiver.search.outlines import proposed_screens, without_borders
from rxcli.receiver.search.propose import Proposer
from rxcli.receiver.search.refusal import light_without_data, why_no_packets
from rxcli.receiver.search.settings import SETTINGS
from rxcli.receiver.still import in_other_bursts, initial_pass
from rxcli.types import FloatArray, Remark

_Cameras = Generator[list[Hypothesis], None, Remark | None]
#: Negative key, so that a heap returns the likeliest first; identity and a number order ties.
_Entry = tuple[float, tuple[object, ...], int, Hypothesis]


def search(
    cache: FrameCache,
    options: ReceiverOptions,
    known: FrameContext | None = None,
    *,
    outlines: list[Outline] | None = None,
    may_bend: bool = True,
    least: float = 0.0,
) -> Found | Failure:
    """Find outline, rows, camera, screen, clock and bursts of a frame.

    Args:
        cache: the picture.
        options: screens, cameras, and corners if given.
        known: context of a frame of the same camera, if the camera and the screens are known.
        outlines: of the screen to receive; those of the clearest one in the picture if left out.
        may_bend: whether an unknown camera may have taken a distortion out, so that stripes are bent.
        least: evidence that a better hypothesis has to exceed.
    """
    if outlines is None:
        screens = proposed_screens(cache, options)
        if isinstance(screens, Failure):
            return screens
        outlines = screens[0]
    found = _search(cache, options, known, outlines, may_bend, least)
    packets = _packet_evidence(found)
    if outlines[0].family < 0 or (packets and outlines[0].stands_out) or outlines[0].leans:
        return found
    without = without_borders(cache)
    if not without:
        return found
    borderless = _search(cache, options, known, without, may_bend, least)
    if options.corners is not None:
        if isinstance(borderless, Failure) or not _packet_evidence(borderless):
            return found
        # Of one column that sends alone, its own rows give the camera, and the corners its number.
        numbered_by_corners = _search(cache, options, borderless.best.context, outlines, may_bend, least)
        return numbered_by_corners if _packet_evidence(numbered_by_corners) else found
    is_steady = isinstance(borderless, Failure) and borderless.reason == "steady_light" and not packets
    return borderless if is_steady or _packet_evidence(borderless) > SETTINGS.borderless_gain * packets else found


def _packet_evidence(found: Found | Failure) -> float:
    """Evidence of what was found, or 0 if it shows no packets."""
    if isinstance(found, Failure) or found.best.evidence < SETTINGS.few_packets:
        return 0.0
    return found.best.evidence


def _search(
    cache: FrameCache,
    options: ReceiverOptions,
    known: FrameContext | None,
    outlines: list[Outline],
    may_bend: bool,
    least: float,
) -> Found | Failure:
    """`search` among outlines."""
    proposer = Proposer(cache, options, tuple(outlines), known, may_bend)
    is_doubtful = not outlines[0].stands_out and outlines[0].family >= 0
    walk = _Walk(proposer, SETTINGS.doubtful_budget if is_doubtful else SETTINGS.budget, least)
    best = walk.run()
    min_evidence = (
        PASSES.min_packets_llr if best is None or best.context.camera.hypothesis is None else SETTINGS.few_packets
    )
    if best is None or best.evidence < min_evidence:
        best = walk.best_without_packets()
    if best is None:
        return replace(why_no_packets(proposer, walk.nearest, walk.reason), tried=walk.record(None))
    if best.evidence >= SETTINGS.few_packets:
        outlines = less_likely_outlines(best, outlines, proposer)
    chosen = numbered(best.hypothesis.outline, outlines, walk.score_of)
    refused = light_without_data(best.context, best.reception)
    if refused is not None:
        return replace(refused, outline=chosen, context=best.context, tried=walk.record(best, "no data"))
    chosen = replace(chosen, corners=_corners_by_slots(chosen, best))
    return Found(best, chosen, walk.record(best), proposer.possible_screens(best.hypothesis))


def _corners_by_slots(outline: Outline, best: Scored) -> FloatArray:
    """Corners of an outline, refined with the decided slots if there are packets."""
    context, reception, screen = best.context, best.reception, best.acquisition.screen
    if outline.strips is None or best.evidence < SETTINGS.plain:
        return outline.corners
    return corners_by_slots(
        outline,
        ColumnLayout(screen.columns, screen.light_spread, screen.aspect),
        reception.clock,
        reception.clock.on_grid(reception.posteriors.lit),
        context.camera.lens or outline.lens,
        is_reversed=context.camera.reversed,
    )


class _Walk:
    """One search under way."""

    def __init__(self, proposer: Proposer, budget: int, least: float = 0.0) -> None:
        self._proposer, self._budget, self._least = proposer, budget, least
        self._scored: list[Scored] = []
        self._tried: list[Tried] = []
        self._asked: set[tuple[object, ...]] = set()
        #: Long exposures that showed no packets, or less than the best hypothesis.
        self._n_in_vain = 0
        self._number = count()
        self._fresh: list[_Entry] = []
        self._siblings: list[_Entry] = []
        #: None when there are no more; upper bound of the next one's log prior.
        self._cameras: _Cameras | None = proposer.cameras()
        self._next_prior = np.inf
        #: Reason why there are no cameras; and the first hypothesis.
        self.reason: Remark | None = None
        self.nearest: Hypothesis | None = None

    def run(self) -> Scored | None:
        """Score hypotheses, best first, until nothing is near the best or the budget is spent; returns the best."""
        while len(self._tried) < self._budget and (entry := self._next()) is not None:
            queue, (key, _, _, hypothesis) = entry
            if (hypothesis.identity, hypothesis.clock is None) in self._asked:
                continue
            self._asked.add((hypothesis.identity, hypothesis.clock is None))
            if hypothesis.clock is None:
                found = self._proposer.with_clock(hypothesis)
                if found is None:
                    self._tried.append(Tried(hypothesis, 0.0, hypothesis.log_prior, "no clock"))
                else:
                    self._push(queue, -key, found)
                continue
            self._score(hypothesis)
            if self._is_hopeless():
                break
        return self._best()

    def _fitted(self, best: Scored) -> Scored:
        """The same with an estimated camera fitted to its slots until the clock no longer moves."""
        for _ in range(camera_settings.max_fits if best.context.camera.hypothesis else 0):
            camera, moved_slots = settle(
                best.context, best.acquisition, best.reception, may_bend=self._proposer.may_bend
            )
            is_enough = best.evidence > SETTINGS.plain_estimate or best.reception.is_long
            if moved_slots < camera_settings.matters_slots and is_enough:
                return best.with_camera(camera)
            hypothesis = self._proposer.with_clock(replace(best.hypothesis, camera=camera, clock=None))
            if hypothesis is None:
                break
            fitted = replace(self._measured(hypothesis, _acquired(hypothesis)), hypothesis=best.hypothesis)
            if fitted.evidence < best.evidence:
                break
            best = fitted
        return best

    def best_without_packets(self) -> Scored | None:
        """Hypothesis of the likeliest outline of a frame without packets, or None if the camera is not known."""
        shown = [scored for scored in self._scored if scored.context.camera.hypothesis is None]
        return max(shown, key=lambda scored: (scored.hypothesis.outline.log_odds, scored.score), default=None)

    def score_of(self, family: int) -> float | None:
        """The best score under outlines of a family, or None if none was tried."""
        tried = (step for step in self._tried if step.fate != "no clock" and step.hypothesis.outline.family == family)
        return max((step.score for step in tried), default=None)

    def record(self, best: Scored | None, fate: str = "won") -> tuple[Tried, ...]:
        """Every hypothesis that was tried, in order, with the fate of the best one."""
        own = best and best.hypothesis.identity
        return tuple(replace(step, fate=fate) if step.hypothesis.identity == own else step for step in self._tried)

    def _best(self) -> Scored | None:
        return max(self._scored, key=lambda scored: scored.score, default=None)

    def _is_hopeless(self) -> bool:
        passes = [step.evidence for step in self._tried if step.fate != "no clock"]
        return len(passes) >= SETTINGS.hopeless_budget and max(passes) < PASSES.min_packets_llr

    def _push(self, queue: list[_Entry], key: float, hypothesis: Hypothesis) -> None:
        heapq.heappush(queue, (-key, hypothesis.identity, next(self._number), hypothesis))

    def _next(self) -> tuple[list[_Entry], _Entry] | None:
        """The next entry and its queue, or None if no entry could come near the best."""
        best = self._best()
        if best is not None:
            # An estimate without packets may be the wrong camera: other cameras come before its siblings.
            is_estimated = best.context.camera.hypothesis is not None
            is_doubtful = is_estimated and best.evidence < SETTINGS.few_packets
            is_near = self._siblings and -self._siblings[0][0] >= best.score - SETTINGS.reach
            if is_near and not (is_doubtful and (self._fresh or self._cameras is not None)):
                return self._siblings, heapq.heappop(self._siblings)
            # A long exposure that no file states explains the light of a short one to some extent.
            is_open = is_estimated and best.reception.is_long and self._proposer.cache.frame.metadata.exposure_s is None
            # A wrong length of packets explains light to some extent, but gives none.
            shows_packets = bool((best.reception.best_confidence() > SETTINGS.likely_certainty).any())
            is_plain = best.evidence > (SETTINGS.plain_estimate if is_estimated and shows_packets else SETTINGS.plain)
            if is_plain and not is_open:
                return None
        while self._cameras is not None and (not self._fresh or self._next_prior > -self._fresh[0][0]):
            try:
                proposed = next(self._cameras)
            except StopIteration as end:
                self._cameras, self.reason = None, end.value
                break
            if not proposed:
                continue
            likeliest = min(proposed, key=lambda hypothesis: (-hypothesis.log_prior, hypothesis.identity))
            self.nearest = self.nearest or likeliest
            self._next_prior = likeliest.log_prior - SETTINGS.next_camera
            for hypothesis in proposed:
                self._push(self._fresh, hypothesis.log_prior, hypothesis)
        return (self._fresh, heapq.heappop(self._fresh)) if self._fresh else None

    def _score(self, hypothesis: Hypothesis) -> None:
        """Make an initial pass; after a better hypothesis, and of a long exposure, of the bright columns first.

        The others follow if the bright ones come near the best score; if that is beyond doubt, if they beat its own.
        """
        best, acquisition = self._best(), _acquired(hypothesis)
        # Joint detection takes long.
        is_long = acquisition.clock.exposure_slots > LONG_EXPOSURE_SLOTS
        if is_long and self._n_in_vain >= SETTINGS.doubtful_budget:
            return
        if best is not None or is_long:
            half = self._measured(hypothesis, acquisition.of_columns(acquisition.bright_columns))
            min_evidence = SETTINGS.few_packets if is_long else PASSES.min_packets_llr
            min_score, lead = -np.inf, 0.0
            if best is not None:
                lead = evidence.bright_score(best) - best.score if best.evidence > PASSES.min_packets_llr else 0.0
                is_plain = best.evidence > SETTINGS.plain
                min_score = best.score + (lead if is_plain else -SETTINGS.reach)
                min_evidence = min(min_evidence, best.evidence)
            if half.score < min_score or half.evidence < max(min_evidence, self._least / 2):
                # By the bright columns alone scores are others than by all: the best one shows by how much.
                self._tried.append(Tried(hypothesis, half.evidence, half.score - lead, "half"))
                self._n_in_vain += is_long
                return
        scored = self._measured(hypothesis, acquisition)
        if scored.evidence > PASSES.min_packets_llr:
            # Packets may become certain once an estimated camera is fitted: then no other camera is tried.
            scored = self._fitted(scored)
        scored = _in_likeliest_bursts(scored)
        self._n_in_vain += is_long and best is not None and scored.score <= best.score
        self._scored.append(scored)
        self._tried.append(Tried(hypothesis, scored.evidence, scored.score, "lost"))
        if scored.evidence > PASSES.min_packets_llr and (best is None or scored.score > best.score - SETTINGS.reach):
            for sibling in self._proposer.siblings(scored):
                self._push(self._siblings, scored.score + sibling.log_prior - hypothesis.log_prior, sibling)

    def _measured(self, hypothesis: Hypothesis, acquisition: Acquisition) -> Scored:
        with self._proposer.cache.timer("detect"):
            return _rated(hypothesis, self._proposer.context(hypothesis), acquisition, initial_pass(acquisition))


def _acquired(hypothesis: Hypothesis) -> Acquisition:
    assert hypothesis.profiles is not None
    assert hypothesis.clock is not None
    return Acquisition(hypothesis.screen, hypothesis.profiles, hypothesis.clock, hypothesis.variants)


def _rated(hypothesis: Hypothesis, context: FrameContext, acquisition: Acquisition, reception: Reception) -> Scored:
    own = evidence.log_evidence(reception)
    score = evidence.score(reception, own, hypothesis.log_prior)
    return Scored(hypothesis, context, acquisition, reception, own, score)


def _in_likeliest_bursts(scored: Scored) -> Scored:
    """The same with its copies assigned to bursts as its packets fit best, if they are uncertain."""
    if scored.evidence < PASSES.min_packets_llr:
        return scored
    hypothesis, context, acquisition = scored.hypothesis, scored.context, scored.acquisition
    ways = [(scored, 0.0)]
    for reception, behind in in_other_bursts(acquisition, scored.reception):
        ways.append((_rated(hypothesis, context, acquisition, reception), behind))
    # Not by score: it distrusts columns that send the same, and wrong bursts make them differ.
    return max(ways, key=lambda way: SETTINGS.temper * way[0].evidence - way[1])[0]
