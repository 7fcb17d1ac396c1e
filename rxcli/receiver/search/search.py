"""Best-first search: make an initial pass of the likeliest hypothesis; its score determines the next one."""

import heapq
from collections.abc import Generator, Iterable
from dataclasses import replace
from itertools import count

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.receiver.camera.settings import SETTINGS as camera_settings
from rxcli.receiver.decode.settings import QUICK_SURVIVORS
from rxcli.receiver.frame.acquisition import Acquisition
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.frame.passes import Reception, dark_columns
from rxcli.receiver.frame.result import Failure
from rxcli.receiver.frame.settings import SETTINGS as PASSES
from rxcli.receiver.light import LONG_EXPOSURE_SLOTS
from rxcli.receiver.screen.find import ColumnLayout
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.screen.pose import corners_by_slots
from rxcli.receiver.search import evidence
from rxcli.receiver.search.cameras import settle
from rxcli.receiver.search.hypothesis import Found, Hypothesis, Scored, Tried
from rxcli.receiver.search.numbers import numbered, rated_by_packets
from rxcli.receiver.search.outlines import proposed_screens
from rxcli.receiver.search.propose import Proposer, ways
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
    may_doubt: bool = False,
) -> Found | Failure:
    """Find outline, rows, camera, screen, clock and bursts of a frame.

    Args:
        cache: the picture.
        options: screens, cameras, and corners if given.
        known: context of a frame of the same camera, if the camera and the screens are known.
        outlines: of the screen to receive; those of the clearest one in the picture if left out.
        may_bend: whether an unknown camera may have taken a distortion out, so that stripes are bent.
        may_doubt: whether what profile and file state of the camera may be wrong.
    """
    if outlines is None:
        screens = proposed_screens(cache, options)
        if isinstance(screens, Failure):
            return screens
        outlines = screens[0]
    walk = _Walk(
        ways(cache, options, outlines, known, may_bend=may_bend, may_doubt=may_doubt), "unlikely" in options.skip
    )
    best = walk.run()
    min_evidence = (
        PASSES.min_packets_llr if best is None or best.context.camera.hypothesis is None else SETTINGS.few_packets
    )
    if best is None or best.evidence < min_evidence:
        best = walk.best_without_packets()
    if best is None:
        return replace(walk.why_no_packets(), tried=walk.record(None))
    proposer = walk.way_of(best.hypothesis)
    outlines, own = list(proposer.outlines), best.hypothesis.outline
    if best.evidence >= SETTINGS.few_packets:
        outlines = rated_by_packets(best, outlines, proposer)
        likeliest = max((rival for rival in outlines if rival.family == own.family), key=lambda rival: rival.log_odds)
        if likeliest.log_odds > own.log_odds >= max(rival.log_odds for rival in proposer.outlines):
            best = walk.renumbered(best, likeliest)
    chosen = numbered(best.hypothesis.outline, outlines, walk.score_of)
    refused = light_without_data(best.context, best.reception)
    if refused is not None and proposer.doubts:
        return replace(walk.why_no_packets(), tried=walk.record(best, "no data"))
    if refused is not None:
        return replace(refused, outline=chosen, context=best.context, tried=walk.record(best, "no data"))
    chosen = replace(chosen, corners=_corners_by_slots(chosen, best))
    possible = proposer.possible_screens(best.hypothesis)
    return Found(best, chosen, walk.record(best), possible, proposer.doubts, walk.best_as_stated())


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
    """One search under way.

    Args:
        possible: ways to look at the picture, likeliest first.
        gives_up: whether to end when the work for a picture without evidence is done.
    """

    def __init__(self, possible: Iterable[Proposer], gives_up: bool = True) -> None:
        self._possible, self._gives_up = iter(possible), gives_up
        #: Ways that were begun.
        self.ways: list[Proposer] = []
        self._scored: list[Scored] = []
        self._tried: list[Tried] = []
        self._asked: set[tuple[object, ...]] = set()
        #: Work that is done, see `SearchSettings.work`.
        self._work = 0
        self._number = count()
        self._fresh: list[_Entry] = []
        self._siblings: list[_Entry] = []
        #: None when there are no more; upper bound of the next one's log prior.
        self._cameras: _Cameras | None = None
        self._next_prior = np.inf
        #: Of each way, the reason why it has no more cameras, and its first hypothesis.
        self._reasons: dict[int, Remark | None] = {}
        self._nearest: dict[int, Hypothesis] = {}

    def run(self) -> Scored | None:
        """Score hypotheses, best first, until nothing is near the best or the budget is spent; returns the best."""
        while (entry := self._next()) is not None:
            queue, (key, _, _, hypothesis) = entry
            if self._is_spent():
                left = (hypothesis, *(likely for _, _, _, likely in sorted(self._fresh)))
                self._tried += [Tried(likely, 0.0, likely.log_prior, "not tried") for likely in left]
                break
            if (hypothesis.identity, hypothesis.clock is None) in self._asked:
                continue
            self._asked.add((hypothesis.identity, hypothesis.clock is None))
            if hypothesis.clock is None:
                proposer = self.way_of(hypothesis)
                found = proposer.with_clock(hypothesis)
                self._work += proposer.work(hypothesis)
                if found is None:
                    self._tried.append(Tried(hypothesis, 0.0, hypothesis.log_prior, "no clock"))
                else:
                    self._push(queue, -key, found)
                continue
            self._score(hypothesis)
        return self._best()

    def way_of(self, hypothesis: Hypothesis) -> Proposer:
        """The way to look at the picture that a hypothesis belongs to."""
        return next(way for way in self.ways if way.way == hypothesis.way)

    def _is_spent(self, more: int = 0, found: float = 0.0) -> bool:
        """Whether more work is more than the evidence allows: that so far, and that of a part of a hypothesis."""
        best = self._best()
        gain = max(best.evidence if best else 0.0, found) / SETTINGS.plain_estimate
        return self._gives_up and self._work + more > SETTINGS.work * max(gain, 1.0)

    def _fitted(self, best: Scored) -> Scored:
        """The same with an estimated camera fitted to its slots until the clock no longer moves."""
        proposer = self.way_of(best.hypothesis)
        for _ in range(camera_settings.max_fits if best.context.camera.hypothesis else 0):
            camera, moved_slots = settle(best.context, best.acquisition, best.reception, may_bend=proposer.may_bend)
            is_enough = best.evidence > SETTINGS.plain_estimate or best.reception.is_long
            if moved_slots < camera_settings.matters_slots and is_enough:
                return best.with_camera(camera)
            hypothesis = proposer.with_clock(replace(best.hypothesis, camera=camera, clock=None))
            if hypothesis is None:
                break
            fitted = replace(self._measured(hypothesis, _acquired(hypothesis)), hypothesis=best.hypothesis)
            if fitted.evidence < best.evidence:
                break
            best = fitted
        return best

    def renumbered(self, best: Scored, outline: Outline) -> Scored:
        """The same under another outline of its family."""
        hypothesis = replace(best.hypothesis, outline=outline, camera=best.context.camera, clock=None)
        found = self.way_of(hypothesis).with_clock(hypothesis)
        return best if found is None else _in_likeliest_bursts(self._measured(found, _acquired(found)))

    def best_without_packets(self) -> Scored | None:
        """Hypothesis of the likeliest outline of a frame without packets, or None if the camera is not known."""
        shown = [scored for scored in self._scored if scored.context.camera.hypothesis is None]
        return max(shown, key=lambda scored: (scored.hypothesis.outline.log_odds, scored.score), default=None)

    def score_of(self, family: int) -> float | None:
        """The best score under outlines of a family, without their log-odds, or None if none was tried."""
        tried = (step for step in self._tried if step.fate != "no clock" and step.hypothesis.outline.family == family)
        scores = (step.score - SETTINGS.temper * step.hypothesis.outline.log_odds for step in tried)
        return max(scores, default=None)

    def record(self, best: Scored | None, fate: str = "won") -> tuple[Tried, ...]:
        """Every hypothesis that was tried, in order, with the fate of the best one."""
        own = best and best.hypothesis.identity
        return tuple(replace(step, fate=fate) if step.hypothesis.identity == own else step for step in self._tried)

    def why_no_packets(self) -> Failure:
        """Why no way to look at the picture as it is stated gave packets; light without borders may be a lamp's."""
        stated = [way for way in self.ways if not way.doubts]
        failures = [why_no_packets(w, self._nearest.get(w.way), self._reasons.get(w.way)) for w in stated]
        return next((failure for failure in failures if failure.reason == "steady_light"), failures[0])

    def best_as_stated(self) -> Scored | None:
        """The best by what profile and file state of the camera."""
        stated = (scored for scored in self._scored if not self.way_of(scored.hypothesis).doubts)
        return max(stated, key=lambda scored: scored.score, default=None)

    def _best(self) -> Scored | None:
        """The best; a camera that contradicts what is stated counts from where wrong clocks do not reach."""
        possible = (
            scored
            for scored in self._scored
            if scored.evidence > SETTINGS.plain
            or not (self.way_of(scored.hypothesis).doubts and self.ways[0].contradicts(scored))
        )
        return max(possible, key=lambda scored: scored.score, default=None)

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
            is_open = is_estimated and best.reception.is_long and best.context.frame.metadata.exposure_s is None
            # A wrong length of packets explains light to some extent, but gives none.
            shows_packets = bool(evidence.believable(best.reception).any())
            is_plain = best.evidence > (SETTINGS.plain_estimate if is_estimated and shows_packets else SETTINGS.plain)
            if is_plain and not is_open:
                self._cameras, self._fresh = None, []
        while True:
            self._propose()
            if self._fresh:
                return self._fresh, heapq.heappop(self._fresh)
            way = None if best is not None and self._is_settled(best) else next(self._possible, None)
            if way is None:
                return None
            self.ways.append(way)
            self._cameras, self._next_prior = way.cameras(), np.inf

    def _is_settled(self, best: Scored) -> bool:
        """Whether no other way to look at the picture is worth the work."""
        outline, reception = best.hypothesis.outline, best.reception
        if best.evidence < SETTINGS.plain_estimate or best.evidence > SETTINGS.plain:
            return best.evidence > SETTINGS.plain
        n_received = int(np.count_nonzero(evidence.believable(reception).any(axis=0)))
        is_clear = outline.stands_out and best.context.camera.hypothesis is not None and n_received > 0
        return is_clear or n_received >= SETTINGS.settled_share * int(np.count_nonzero(~dark_columns(reception.snr)))

    def _propose(self) -> None:
        """Take cameras of the last way until the likeliest hypothesis that is left is among the fresh ones."""
        while self._cameras is not None and (not self._fresh or self._next_prior > -self._fresh[0][0]):
            try:
                proposed = next(self._cameras)
            except StopIteration as end:
                self._cameras, self._reasons[self.ways[-1].way] = None, end.value
                break
            if not proposed:
                continue
            likeliest = min(proposed, key=lambda hypothesis: (-hypothesis.log_prior, hypothesis.identity))
            self._nearest.setdefault(likeliest.way, likeliest)
            self._next_prior = likeliest.log_prior - SETTINGS.next_camera
            for hypothesis in proposed:
                self._push(self._fresh, hypothesis.log_prior, hypothesis)

    def _score(self, hypothesis: Hypothesis) -> None:
        """Make an initial pass; after a better hypothesis, of the bright columns first.

        The others follow if the bright ones come near the best score; if that is beyond doubt, if they beat its own.
        """
        best, acquisition = self._best(), _acquired(hypothesis)
        bright = acquisition.of_columns(acquisition.bright_columns)
        if self._is_spent(_work_of(bright if best else acquisition)):
            self._tried.append(Tried(hypothesis, 0.0, hypothesis.log_prior, "not tried"))
            return
        if best is not None:
            half = self._measured(hypothesis, bright)
            lead = evidence.bright_score(best) - best.score if best.evidence > PASSES.min_packets_llr else 0.0
            min_score = best.score + (lead if best.evidence > SETTINGS.plain else -SETTINGS.reach)
            min_evidence = min(SETTINGS.few_packets if _is_long(acquisition) else PASSES.min_packets_llr, best.evidence)
            is_likely = half.score >= min_score and half.evidence >= min_evidence
            if not is_likely or self._is_spent(_work_of(acquisition), half.evidence):
                # By the bright columns alone scores are others than by all: the best one shows by how much.
                self._tried.append(Tried(hypothesis, half.evidence, half.score - lead, "half"))
                return
        scored = self._measured(hypothesis, acquisition)
        # A known camera keeps its first hypothesis without packets as well: it shows what the light is.
        if _is_long(acquisition) and hypothesis.camera.hypothesis and scored.evidence < SETTINGS.few_packets:
            self._tried.append(Tried(hypothesis, scored.evidence, scored.score, "lost"))
            return
        if scored.evidence > PASSES.min_packets_llr:
            # Packets may become certain once an estimated camera is fitted: then no other camera is tried.
            scored = self._fitted(scored)
        scored = _in_likeliest_bursts(scored)
        self._scored.append(scored)
        self._tried.append(Tried(hypothesis, scored.evidence, scored.score, "lost"))
        if scored.evidence > PASSES.min_packets_llr and (best is None or scored.score > best.score - SETTINGS.reach):
            for sibling in self.way_of(hypothesis).siblings(scored):
                self._push(self._siblings, scored.score + sibling.log_prior - hypothesis.log_prior, sibling)

    def _measured(self, hypothesis: Hypothesis, acquisition: Acquisition) -> Scored:
        proposer = self.way_of(hypothesis)
        self._work += _work_of(acquisition)
        with proposer.cache.timer("detect"):
            return _rated(hypothesis, proposer.context(hypothesis), acquisition, initial_pass(acquisition))


def _acquired(hypothesis: Hypothesis) -> Acquisition:
    assert hypothesis.profiles is not None
    assert hypothesis.clock is not None
    return Acquisition(hypothesis.screen, hypothesis.profiles, hypothesis.clock, hypothesis.variants)


def _is_long(acquisition: Acquisition) -> bool:
    return acquisition.clock.exposure_slots > LONG_EXPOSURE_SLOTS


def _work_of(acquisition: Acquisition) -> int:
    """Work of an initial pass, see `SearchSettings.work`."""
    n_paths = QUICK_SURVIVORS.max_paths if _is_long(acquisition) else 1
    return acquisition.clock.delay_slots.size * acquisition.clock.n_slots * n_paths


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
