"""All steps together: from strips to an estimate, or the reason why there is none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rxcli.profiles import ScreenProfile
from rxcli.receiver.camera.advice import why_not
from rxcli.receiver.camera.curvature import estimate_curvature, straightened
from rxcli.receiver.camera.edges import by_edges, edge_nats
from rxcli.receiver.camera.estimates import BentHypothesis, BlindEstimate, Hypothesis, distinct, on_one_curvature
from rxcli.receiver.camera.reading import Reading, read, read_slots
from rxcli.receiver.camera.scan import every_clock, same_slots, short_list
from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.strips import Strips
from rxcli.receiver.camera.timing import refine
from rxcli.receiver.camera.views import Views
from rxcli.types import FloatArray

#: Which rows per slot are looked at: those that stand out in a picture, and others.
Periods = Literal["all", "outstanding", "others"]


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
        return self.estimate is not None and self.estimate.log_evidence > SETTINGS.beyond_doubt_nats


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
    sure = gain > SETTINGS.bend_gains[1]
    curves = [curvature] if sure else [np.zeros(4), curvature] if gain > SETTINGS.bend_gains[0] else [np.zeros(4)]
    views = Views(strips)
    straight = [straightened(strips, curvature) for curvature in curves]

    def refined(reading: Reading) -> list[BlindEstimate]:
        return refine(views, reading, lengths, lambda length: (exposure_s or 0.0) * rates[length], sure)

    outstanding = _clocks(short_list, straight, curves, lengths)[: SETTINGS.readings] if periods != "others" else []
    readings = sorted(_read_until_sure(views, outstanding, lengths), key=_by_evidence)
    if periods == "outstanding" and _best(readings) < SETTINGS.hopeless_nats:
        return BlindSearch(None, why_not(strips))
    estimates: list[BlindEstimate] = []
    if SETTINGS.hopeless_nats < _best(readings) < SETTINGS.read_surely_nats:
        estimates = refined(readings[0])
        likely = max(estimates, key=lambda one: _plausibility(one, strips, one.rows_per_slot))
        if _is_plausible(likely) and shows_packets(likely):
            return BlindSearch(likely, rivals=_worth_reading([one for one in estimates if one is not likely]))
    asked = readings[:1] if estimates else []
    if _best(readings) < SETTINGS.nothing_read_nats:
        readings = readings + _read_others(views, _clocks(every_clock, straight, curves, lengths), lengths)
    readings = _with_neighbours(views, sorted(readings, key=_by_evidence), lengths)
    if _best(readings) < SETTINGS.hopeless_nats and not (readings and _keeps_to_edges(views, readings[0])):
        return BlindSearch(None, why_not(strips))
    for reading in _worth_refining(readings):
        estimates += [] if any(reading is one for one in asked) else refined(reading)
    rows_per_slot = estimates[0].rows_per_slot if estimates else 1.0
    estimates.sort(key=lambda estimate: -_plausibility(estimate, strips, rows_per_slot))
    best = estimates[0] if estimates else None
    if best is None or not _is_plausible(best):
        return BlindSearch(None, why_not(strips), _worth_reading(estimates), by_edges(strips, estimates))
    rivals = _worth_reading(estimates[1:])
    if best.log_evidence > SETTINGS.beyond_doubt_nats:
        least = _plausibility(best, strips, rows_per_slot) - SETTINGS.another_length_nats
        of_other_length = (one for one in rivals if same_slots(one, best) and one.packet_slots != best.packet_slots)
        rivals = tuple(one for one in of_other_length if _plausibility(one, strips, rows_per_slot) > least)
    return BlindSearch(best, rivals=rivals)


def _is_plausible(estimate: BlindEstimate) -> bool:
    return estimate.log_evidence >= SETTINGS.least_evidence and estimate.explained >= SETTINGS.least_explained


def _read_others(views: Views, found: list[BentHypothesis], lengths: list[int]) -> list[Reading]:
    """Readings of the likeliest clocks, and of those that stand out."""
    outstanding = sorted(found, key=lambda pair: -pair[0].salience)
    either = [pair for both in zip(found, outstanding, strict=True) for pair in both]
    return _read_until_sure(views, distinct(either, on_one_curvature(same_slots), SETTINGS.readings), lengths)


def _with_neighbours(views: Views, readings: list[Reading], lengths: list[int]) -> list[Reading]:
    """The readings, best first, with those of clocks near the best where that is not of the right one for sure."""
    if not SETTINGS.hopeless_nats < _best(readings) < SETTINGS.read_surely_nats:
        return readings
    best, n_rows = readings[0], float(views.strips.rows[-1] - views.strips.rows[0])
    around = []
    for off in SETTINGS.around_slots:
        values = best.values.copy()
        values[1] *= 1 + off * values[1] / n_rows
        around.append(read_slots(views, best.rows_per_slot, best.is_reversed, values, lengths))
    return sorted(readings + around, key=_by_evidence)


def _keeps_to_edges(views: Views, reading: Reading) -> bool:
    """Whether edges keep to the clock of a reading beyond doubt, whatever its slots say."""
    curvature = views.at(reading.rows_per_slot, reading.is_reversed).curvature(reading.values[2:])
    return edge_nats(views.strips, float(reading.values[1]), curvature) > 0


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
        if out[-1].log_evidence > SETTINGS.read_surely_nats:
            break
    return out


def _best(readings: list[Reading]) -> float:
    return max((reading.log_evidence for reading in readings), default=0.0)


def _by_evidence(reading: Reading) -> float:
    return -reading.log_evidence


def stripes_are_curved(strips: Strips) -> bool:
    """Whether neighbouring strips alone say beyond doubt that stripes are bent, whatever the screen's sides show."""
    return estimate_curvature(strips)[1] > SETTINGS.bend_gains[1]


def _worth_reading(estimates: list[BlindEstimate]) -> tuple[BlindEstimate, ...]:
    """Estimates whose slots explain light, and look more like packets than slots of any kind."""
    return tuple(one for one in estimates if one.explained >= SETTINGS.least_explained and one.log_evidence > 0)


def _worth_refining(readings: list[Reading]) -> list[Reading]:
    """The best reading, and where it is neither beyond doubt nor hopeless others of other slots that come close."""
    if not readings or readings[0].log_evidence < SETTINGS.hopeless_nats:
        return readings[:1]
    least = max(SETTINGS.close_evidence * readings[0].log_evidence, SETTINGS.hopeless_nats)
    close = [one for one in readings if one.log_evidence >= least]
    return (
        distinct(
            close, _same_slots, 1 if readings[0].log_evidence > SETTINGS.read_surely_nats else SETTINGS.refined_readings
        )
        or readings[:1]
    )


def _same_slots(one: Reading, other: Reading) -> bool:
    near = abs(np.log(one.values[1] / other.values[1])) < SETTINGS.same_rows_per_slot
    return near and one.is_reversed == other.is_reversed


def _plausibility(estimate: BlindEstimate, strips: Strips, rows_per_slot: float) -> float:
    """Evidence of the slots' structure and of the light that they explain, nats; of about so many rows a slot.

    A packet twice as long fits wherever no second header is in view to contradict it.
    """
    slots = strips.n_columns * strips.rows.size / rows_per_slot
    light = -0.5 * slots / SETTINGS.samples_as_one * float(np.log(max(1 - estimate.explained, 1e-3)))
    return estimate.log_evidence + light - SETTINGS.longer_packet_nats * float(np.log2(estimate.packet_slots))
