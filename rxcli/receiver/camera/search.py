"""All steps together: from strips to an estimate, or the reason why there is none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rxcli.profiles import ScreenProfile
from rxcli.receiver.camera.advice import why_not
from rxcli.receiver.camera.curvature import estimate_curvature, straightened
from rxcli.receiver.camera.edges import by_edges
from rxcli.receiver.camera.estimates import BentHypothesis, BlindEstimate, Hypothesis, distinct, on_one_curvature
from rxcli.receiver.camera.reading import Reading, read, read_slots
from rxcli.receiver.camera.scan import ALIKE_ROWS, every_clock, same_slots, short_list
from rxcli.receiver.camera.strips import Strips
from rxcli.receiver.camera.timing import ALIKE, refine
from rxcli.receiver.camera.views import Views
from rxcli.types import FloatArray

#: Which rows per slot are looked at: those that stand out in a picture, and others.
Periods = Literal["all", "outstanding", "others"]

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

#: Readings that are refined, and the share of the best one's evidence that another needs.
_REFINED, _CLOSE_EVIDENCE = 3, 0.3
#: A reading of this evidence is of the right clock: right ones have 254 and more nearly always, wrong ones 68 at most.
#: Below the second all periods are looked at, as a clock that is somewhat off reads at less; below the third not even
#: its neighbours are.
_READ_SURELY, _NOTHING_READ, _HOPELESS = 200.0, 150.0, 50.0
#: Clocks of the short list, and of all periods, that are read; of how many of them the neighbours are read too, and by
#: how many slots those are off by the end of the picture.
_READ, _READ_OF_ALL, _READ_AROUND = 4, 4, 2
_OFF_SLOTS = (-1.2, -0.6, 0.6, 1.2)
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


def estimate_camera(
    strips: Strips,
    screens: Sequence[ScreenProfile],
    exposure_s: float | None = None,
    shows_packets: Callable[[BlindEstimate], bool] = lambda _: False,
    *,
    periods: Periods = "all",
) -> BlindSearch:
    """Estimate the camera from one picture of a sending screen.

    Args:
        strips: see `strips_of`.
        screens: screens that it may be.
        exposure_s: exposure, None where the file does not tell it.
        shows_packets: whether packets show with an estimate beyond doubt; asked before the search is widened.
        periods: those that stand out and, where these read as nothing, all; or the ones without the others.

    Raises:
        ValueError: no screens.
    """
    if not screens:
        raise ValueError("screens must name at least one screen (got none)")
    rates = {screen.packet_slots: screen.slot_rate_hz for screen in reversed(screens)}
    lengths = sorted(rates)
    curvature, gain = (np.zeros(4), 0.0) if strips.correction == "no" else estimate_curvature(strips)
    sure = gain > _BEND_GAINS[1]
    curves = [curvature] if sure else [np.zeros(4), curvature] if gain > _BEND_GAINS[0] else [np.zeros(4)]
    views = Views(strips)
    straight = [straightened(strips, curvature) for curvature in curves]

    def refined(reading: Reading) -> list[BlindEstimate]:
        return refine(views, reading, lengths, lambda length: (exposure_s or 0.0) * rates[length], sure)

    outstanding = _clocks(short_list, straight, curves, lengths)[:_READ] if periods != "others" else []
    readings = sorted(_read_until_sure(views, outstanding, lengths), key=_by_evidence)
    if periods == "outstanding" and _best(readings) < _HOPELESS:
        return BlindSearch(None, why_not(strips))
    estimates: list[BlindEstimate] = []
    if _HOPELESS < _best(readings) < _READ_SURELY:
        estimates = refined(readings[0])
        likely = max(estimates, key=lambda one: _plausibility(one, strips, one.rows_per_slot))
        if _is_plausible(likely) and shows_packets(likely):
            return BlindSearch(likely, rivals=_worth_reading([one for one in estimates if one is not likely]))
    asked = readings[:1] if estimates else []
    for reading in _worth_refining(_more_readings(views, straight, curves, lengths, readings)):
        estimates += [] if any(reading is one for one in asked) else refined(reading)
    rows_per_slot = estimates[0].rows_per_slot if estimates else 1.0
    estimates.sort(key=lambda estimate: -_plausibility(estimate, strips, rows_per_slot))
    best = estimates[0] if estimates else None
    if best is None or not _is_plausible(best):
        return BlindSearch(None, why_not(strips), _worth_reading(estimates), by_edges(strips, estimates))
    rivals = _worth_reading(estimates[1:])
    if best.log_evidence > _BEYOND_DOUBT:
        least = _plausibility(best, strips, rows_per_slot) - _ANOTHER_LENGTH
        of_other_length = (one for one in rivals if same_slots(one, best) and one.packet_slots != best.packet_slots)
        rivals = tuple(one for one in of_other_length if _plausibility(one, strips, rows_per_slot) > least)
    return BlindSearch(best, rivals=rivals)


def _is_plausible(estimate: BlindEstimate) -> bool:
    return estimate.log_evidence >= MIN_EVIDENCE and estimate.explained >= _LEAST_EXPLAINED


def _more_readings(
    views: Views, straight: list[Strips], curves: list[FloatArray], lengths: list[int], readings: list[Reading]
) -> list[Reading]:
    """The readings, best first, with those of further clocks where they are not of the right one for sure."""
    if _best(readings) < _NOTHING_READ:
        found = _clocks(every_clock, straight, curves, lengths)
        outstanding = sorted(found, key=lambda pair: -pair[0].salience)
        either = [pair for both in zip(found, outstanding, strict=True) for pair in both]
        readings = readings + _read_until_sure(
            views, distinct(either, on_one_curvature(same_slots), _READ_OF_ALL), lengths
        )
    if _HOPELESS < _best(readings) < _READ_SURELY:
        readings = readings + _read_around(views, sorted(readings, key=_by_evidence)[:_READ_AROUND], lengths)
    return sorted(readings, key=_by_evidence)


def _clocks(
    find: Callable[[Strips, Sequence[int]], list[Hypothesis]],
    straight: list[Strips],
    curves: list[FloatArray],
    lengths: list[int],
) -> list[BentHypothesis]:
    """Clocks of different slots with the bends they were found with, best first."""
    found = [(clock, c) for strips, c in zip(straight, curves, strict=True) for clock in find(strips, lengths)]
    found.sort(key=lambda pair: -pair[0].log_evidence)
    return distinct(found, on_one_curvature(same_slots), len(found))


def _read_until_sure(views: Views, clocks: list[BentHypothesis], lengths: list[int]) -> list[Reading]:
    out: list[Reading] = []
    for clock, curvature in clocks:
        out.append(read(views, clock, curvature, lengths))
        if out[-1].log_evidence > _READ_SURELY:
            break
    return out


def _read_around(views: Views, readings: list[Reading], lengths: list[int]) -> list[Reading]:
    """Readings of clocks that are somewhat longer or shorter."""
    out = []
    for reading in readings:
        n_rows = float(views.strips.rows[-1] - views.strips.rows[0])
        for off in _OFF_SLOTS:
            values = reading.values.copy()
            values[1] *= 1 + off * values[1] / n_rows
            out.append(read_slots(views, reading.rows_per_slot, reading.is_reversed, values, lengths))
    return out


def _best(readings: list[Reading]) -> float:
    return max((reading.log_evidence for reading in readings), default=0.0)


def _by_evidence(reading: Reading) -> float:
    return -reading.log_evidence


def stripes_are_curved(strips: Strips) -> bool:
    """Whether neighbouring strips alone say beyond doubt that stripes are bent, whatever the screen's sides show."""
    return estimate_curvature(strips)[1] > _BEND_GAINS[1]


def _worth_reading(estimates: list[BlindEstimate]) -> tuple[BlindEstimate, ...]:
    """Estimates whose slots explain light."""
    return tuple(estimate for estimate in estimates if estimate.explained >= _LEAST_EXPLAINED)


def _worth_refining(readings: list[Reading]) -> list[Reading]:
    """The best reading, and where it is neither beyond doubt nor hopeless others of other slots that come close."""
    if not readings or readings[0].log_evidence < _HOPELESS:
        return readings[:1]
    least = _CLOSE_EVIDENCE * readings[0].log_evidence
    close = [one for one in readings if one.log_evidence >= least]
    return distinct(close, _same_slots, 1 if readings[0].log_evidence > _READ_SURELY else _REFINED) or readings[:1]


def _same_slots(one: Reading, other: Reading) -> bool:
    near = abs(np.log(one.values[1] / other.values[1])) < ALIKE_ROWS
    return near and one.is_reversed == other.is_reversed


def _plausibility(estimate: BlindEstimate, strips: Strips, rows_per_slot: float) -> float:
    """Evidence of the slots' structure and of the light that they explain, nats; of about so many rows a slot.

    A packet twice as long fits wherever no second header is in view to contradict it.
    """
    slots = strips.n_columns * strips.rows.size / rows_per_slot
    light = -0.5 * slots / ALIKE * float(np.log(max(1 - estimate.explained, 1e-3)))
    return estimate.log_evidence + light - _LONGER_PACKET * float(np.log2(estimate.packet_slots))
