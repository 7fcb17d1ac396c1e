"""All steps together: from strips to an estimate, or the reason why there is none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rxcli.profiles import ScreenProfile
from rxcli.receiver.camera.advice import why_not
from rxcli.receiver.camera.curvature import estimate_curvature, straightened
from rxcli.receiver.camera.edges import by_edges
from rxcli.receiver.camera.estimates import BentHypothesis, BlindEstimate, distinct, on_one_curvature
from rxcli.receiver.camera.reading import read
from rxcli.receiver.camera.scan import alike, find_clocks, same_slots
from rxcli.receiver.camera.strips import Strips
from rxcli.receiver.camera.timing import ALIKE, refine

#: Log-likelihood ratio of header and weights, over chance, that a clock must reach.
MIN_EVIDENCE = 45.0
#: Share of the light's local variance that slots must explain; those of wrong clocks on random stripes reach a fifth.
_LEAST_EXPLAINED = 0.22

#: An estimate with this evidence has no rivals but those of its own slots in packets of another length, which may be as
#: plausible where less than two packets are in view: so many nats less at most.
_BEYOND_DOUBT, _ANOTHER_LENGTH = 250.0, 60.0

#: A bend that fits this many nats better than none is tried; from the second on, it alone: stripes of pictures whose
#: sides are bowed reach 12.
_BEND_GAINS = (5.0, 25.0)

#: Hypotheses that are refined, and the share of the best one's evidence that another needs.
_REFINED, _CLOSE_EVIDENCE = 3, 0.3

#: After an estimate of this evidence, others need this share of the first one's.
_PLAIN_EVIDENCE, _RIVAL = 150.0, 0.7
#: Below this evidence slots are read first: wrong clocks on textured pictures reach 201.
_READ_FIRST = 220.0
#: Below this evidence, more of them.
_WEAK_EVIDENCE, _REFINED_IF_WEAK = 120.0, 6
#: What doubling the length of a packet costs, nats.
_LONGER_PACKET = 3.0


@dataclass(frozen=True, slots=True)
class BlindSearch:
    """What was estimated, or why nothing was."""

    estimate: BlindEstimate | None
    #: Why not: thing, reason and next step. Empty where an estimate was found.
    reason: str = ""
    #: Other estimates that are worth a look, most plausible first.
    rivals: tuple[BlindEstimate, ...] = ()
    #: Where nothing was estimated: what the edges tell of rows per slot and bend all the same.
    by_edges: BlindEstimate | None = None

    @property
    def sure(self) -> bool:
        """Whether the estimate is beyond doubt but for the length of its packets; rivals are of other lengths then."""
        return self.estimate is not None and self.estimate.log_evidence > _BEYOND_DOUBT


def estimate_camera(strips: Strips, screens: Sequence[ScreenProfile], exposure_s: float | None = None) -> BlindSearch:
    """Estimate the camera from one picture of a sending screen.

    Args:
        strips: see `strips_of`.
        screens: screens that it may be.
        exposure_s: exposure, None where the file does not tell it.

    Raises:
        ValueError: no screens.
    """
    if not screens:
        raise ValueError("screens must name at least one screen (got none)")
    rates = {screen.packet_slots: screen.slot_rate_hz for screen in reversed(screens)}
    curvature, gain = (np.zeros(4), 0.0) if strips.correction == "no" else estimate_curvature(strips)
    curves = (
        [curvature] if gain > _BEND_GAINS[1] else [np.zeros(4), curvature] if gain > _BEND_GAINS[0] else [np.zeros(4)]
    )
    found = [(clock, b) for b in curves for clock in find_clocks(straightened(strips, b), sorted(rates))]
    found.sort(key=lambda pair: -pair[0].log_evidence)
    if found and found[0][0].log_evidence < _READ_FIRST:
        found = read(strips, found, sorted(rates))
    estimates: list[BlindEstimate] = []
    for clock, b in _worth_refining(found):
        plain = any(estimate.log_evidence > _PLAIN_EVIDENCE for estimate in estimates)
        if plain and clock.log_evidence < _RIVAL * found[0][0].log_evidence and not same_slots(clock, found[0][0]):
            continue
        exposure = (exposure_s or 0.0) * rates[clock.packet_slots]
        estimates.append(refine(strips, clock, b, exposure, sure=gain > _BEND_GAINS[1]))
    rows_per_slot = estimates[0].rows_per_slot if estimates else 1.0
    estimates.sort(key=lambda estimate: -_plausibility(estimate, strips, rows_per_slot))
    best = estimates[0] if estimates else None
    if best is None or best.log_evidence < MIN_EVIDENCE or best.explained < _LEAST_EXPLAINED:
        return BlindSearch(None, why_not(strips), _worth_reading(estimates), by_edges(strips, estimates))
    rivals = _worth_reading(estimates[1:])
    if best.log_evidence > _BEYOND_DOUBT:
        least = _plausibility(best, strips, rows_per_slot) - _ANOTHER_LENGTH
        of_other_length = (one for one in rivals if same_slots(one, best) and one.packet_slots != best.packet_slots)
        rivals = tuple(one for one in of_other_length if _plausibility(one, strips, rows_per_slot) > least)
    return BlindSearch(best, rivals=rivals)


def stripes_are_curved(strips: Strips) -> bool:
    """Whether neighbouring strips alone say beyond doubt that stripes are bent, whatever the screen's sides show."""
    return estimate_curvature(strips)[1] > _BEND_GAINS[1]


def _worth_reading(estimates: list[BlindEstimate]) -> tuple[BlindEstimate, ...]:
    """Estimates whose slots explain light."""
    return tuple(estimate for estimate in estimates if estimate.explained >= _LEAST_EXPLAINED)


def _worth_refining(found: list[BentHypothesis]) -> list[BentHypothesis]:
    """The best hypothesis, and others of another period, packet, direction or bend that come close.

    Where slots cannot be told by eye (dark pictures, long exposures) those that stood out in the scan come too.
    """
    if not found:
        return []
    best = found[0][0].log_evidence
    close = [pair for pair in found[: 4 * _REFINED] if pair[0].log_evidence >= _CLOSE_EVIDENCE * best]
    chosen = distinct(close, on_one_curvature(alike), _REFINED) or found[:1]
    # With the same slots a packet may have any length: they differ in where other headers would be.
    for pair in close:
        if same_slots(pair[0], found[0][0]) and all(pair[0].packet_slots != one.packet_slots for one, _ in chosen):
            chosen.append(pair)
    if best < _WEAK_EVIDENCE:
        outstanding = sorted(found, key=lambda pair: -pair[0].salience)
        chosen = distinct([*chosen, *outstanding], on_one_curvature(alike), _REFINED_IF_WEAK)
    return chosen


def _plausibility(estimate: BlindEstimate, strips: Strips, rows_per_slot: float) -> float:
    """Evidence of the slots' structure and of the light that they explain, nats; of about so many rows a slot.

    A packet twice as long fits wherever no second header is in view to contradict it.
    """
    slots = strips.n_columns * strips.rows.size / rows_per_slot
    light = -0.5 * slots / ALIKE * float(np.log(max(1 - estimate.explained, 1e-3)))
    return estimate.log_evidence + light - _LONGER_PACKET * float(np.log2(estimate.packet_slots))
