"""Sides of the screen as curves, and lines through the places where energy begins."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

import numpy as np

from rxcli.types import BoolArray, FloatArray

_Places = TypeVar("_Places", float, FloatArray)

#: Sides in the order of `ScreenSearch.corners`: side i goes from corner i to corner i + 1.
TOP, RIGHT, BOTTOM, LEFT = range(4)
#: Direction in which x or y grows from each side into the screen; and sign of its slope in depth for a positive roll.
INWARD = (1, -1, -1, 1)
TURN = (1, 1, -1, -1)
SIDE_NAMES = ("top", "right", "bottom", "left")
#: Support from which a side shows well.
SHOWS = 0.35
#: Pairs of places through which lines are tried.
_TRIES = 140
#: Pairs that are closer than this share of the side say little of its slope.
_PAIR_APART = 0.15


@dataclass(frozen=True, slots=True)
class Side:
    """One side of the screen: x of left and right, y of top and bottom, as a polynomial of the other coordinate."""

    #: Highest power first, of (t - middle) / half; two at least.
    coefficients: FloatArray
    middle: float
    half: float
    #: Share of the side that supports it; 0 where it is inferred.
    support: float

    def at(self, t: _Places) -> _Places:
        """Place of the side at `t`, one or many."""
        along = (t - self.middle) / self.half
        powers: list[float] = self.coefficients.tolist()
        highest, second, *others = powers
        place = highest * along + second
        for coefficient in others:
            place = place * along + coefficient
        return place

    @property
    def slope(self) -> float:
        """Change of place with t at the middle."""
        return float(self.coefficients[-2] / self.half)

    @property
    def some_places(self) -> tuple[FloatArray, FloatArray]:
        """(5,) places along it, from near its start to near its end, and across it."""
        t: FloatArray = self.middle + self.half * np.linspace(-0.8, 0.8, 5)
        return t, self.at(t)

    def moved(self, distance: float) -> Side:
        """The side, moved across itself."""
        coefficients = self.coefficients.copy()
        coefficients[-1] += distance
        return Side(coefficients, self.middle, self.half, self.support)


@dataclass(frozen=True, slots=True)
class Line:
    """A line through places of depth: depth = start + slope * t."""

    start: float
    slope: float
    #: Share of the places that lie on it, nearer ones counting more.
    support: float


def across(side: int) -> bool:
    """Whether a side runs along the rows."""
    return side in (TOP, BOTTOM)


def straight(corners: FloatArray, side: int) -> Side:
    """The straight side between two corners."""
    a, b = corners[side], corners[(side + 1) % 4]
    (ta, pa), (tb, pb) = (a, b) if across(side) else (a[::-1], b[::-1])
    half = (tb - ta) / 2 if tb != ta else 1.0
    return Side(np.array([(pb - pa) / 2, (pa + pb) / 2]), float((ta + tb) / 2), float(half), 1.0)


def extent(sides: list[Side], height: int) -> float:
    """Width of the screen in pixels, through the picture's middle."""
    return abs(sides[RIGHT].at(height / 2) - sides[LEFT].at(height / 2))


def corners_of(sides: list[Side], width: int, height: int) -> FloatArray:
    """(4, 2) where neighbouring sides meet, by turns."""
    found = []
    for flat, upright in ((TOP, LEFT), (TOP, RIGHT), (BOTTOM, RIGHT), (BOTTOM, LEFT)):
        x, y = width / 2, height / 2
        # Each turn brings the corner nearer by the product of two slopes.
        for _ in range(4):
            x = sides[upright].at(y)
            y = sides[flat].at(x)
        found.append((x, y))
    return np.array(found)


@lru_cache(maxsize=1)
def _tries() -> FloatArray:
    """(2, _TRIES) which of the places make a pair, as shares of their number."""
    return np.random.default_rng(1).integers(0, 1 << 32, (2, _TRIES), np.uint32) / (1 << 32)


def width_of(corners: FloatArray) -> float:
    """Width of the screen in pixels, from its (4, 2) corners by turns."""
    return float(np.linalg.norm(corners[1] - corners[0] + corners[2] - corners[3])) / 2


def from_top_left(corners: FloatArray) -> FloatArray:
    """(4, 2) corners by turns, from that of smallest x + y on, which the sides' names go by."""
    return np.roll(corners, -int(np.argmin(corners.sum(axis=1))), axis=0)


def outermost_line(
    t: FloatArray,
    depth: FloatArray,
    weight: FloatArray,
    observed: BoolArray,
    tolerance: float,
    *,
    slope: float,
    spread: float,
    outside_cost: float,
) -> Line | None:
    """The best supported line with little beyond it, by trying lines through pairs of places.

    Args:
        t: (n,) place along the side.
        depth: (n,) where energy begins, growing inwards.
        weight: (n,) support that a place may give, 0..1.
        observed: (n,) places that may speak against one.
        tolerance: distance at which support ends.
        slope: expected slope.
        spread: largest deviation from it.
        outside_cost: how often a place counts against a line that it lies outside of.

    Returns:
        None where there is too little.
    """
    candidates = np.flatnonzero(weight)
    if candidates.size < 5:
        return None
    i, j = candidates[(_tries() * candidates.size).astype(np.int64)]
    far = np.abs(t[i] - t[j]) > _PAIR_APART * np.ptp(t)
    i, j = i[far], j[far]
    slopes = (depth[j] - depth[i]) / (t[j] - t[i])
    fitting = np.abs(slopes - slope) < spread
    i, slopes = i[fitting], slopes[fitting]
    if not i.size:
        return None
    starts = depth[i] - slopes * t[i]
    beyond = (depth[observed] - starts[:, None] - slopes[:, None] * t[observed]) / tolerance
    support = np.maximum(1 - beyond**2, 0) @ weight[observed]
    against = np.clip(-beyond - 1, 0, 1).sum(axis=1)
    best = int((support - outside_cost * against).argmax())
    return Line(float(starts[best]), float(slopes[best]), float(support[best] / t.size))
