"""What may be, and what was estimated of a camera."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeVar

from rxcli.types import FloatArray

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A clock that a picture may show."""

    rows_per_slot: float
    packet_slots: int
    #: Where a header starts: rows from the upper edge of the first of the strips' rows, in readout order.
    start_row: float
    #: True where the picture's rows run against the readout.
    reversed: bool
    #: Log-likelihood ratio of header and weights over chance; of the scan while it was not tried.
    log_evidence: float
    #: How much headers and repeats stood out in the scan.
    salience: float = 0.0


#: A clock, and the bend of the stripes that it was found with.
BentHypothesis = tuple[Hypothesis, FloatArray]


@dataclass(frozen=True, slots=True)
class BlindEstimate:
    """What was estimated of a camera, with standard deviations."""

    rows_per_slot: float
    rows_per_slot_sd: float
    packet_slots: int
    reversed: bool
    exposure_slots: float
    exposure_slots_sd: float
    #: (4,) k1 k2 p1 p2 for a focal length of one picture width, of a picture that was corrected in the camera.
    curvature: FloatArray
    curvature_sd: FloatArray
    #: True where the stripes are bent beyond doubt.
    corrected: bool
    #: Log-likelihood ratio of header and weights over chance.
    log_evidence: float
    #: Share of the local variance of the light that the slots explain.
    explained: float
    #: Exposure that the file tells, 0 where it does not.
    least_exposure_slots: float = 0.0
    #: k1 of the lens that bows the screen's sides, and its standard deviation; None where none was seen to.
    side_curvature: tuple[float, float] | None = None
    #: Exponent that makes light of the picture's values, and its standard deviation; None while it was not measured.
    tone: tuple[float, float] | None = None


def distinct(found: Iterable[_T], same: Callable[[_T, _T], bool], most: int) -> list[_T]:
    """The first of what was found that are not the same as one before, `most` of them at most."""
    chosen: list[_T] = []
    for one in found:
        if len(chosen) == most:
            break
        if not any(same(one, other) for other in chosen):
            chosen.append(one)
    return chosen


def on_one_curvature(
    same: Callable[[Hypothesis, Hypothesis], bool],
) -> Callable[[BentHypothesis, BentHypothesis], bool]:
    """The comparison of hypotheses as one of hypotheses with the bends they were found with, which must be one."""
    return lambda one, other: same(one[0], other[0]) and one[1] is other[1]
