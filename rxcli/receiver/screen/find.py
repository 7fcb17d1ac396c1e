"""Finding the screen in a picture: where the stripes of a modulated backlight begin and end.

Nothing in a room changes from row to row as a modulated backlight does, and the change is the same in neighbouring
pixels. So the search looks at one product: the change of light over a few rows, times the same change a little further
along the rows. Its mean is the stripes' energy and zero for noise, for still light of any strength, and for upright
edges. Four steps, each on less of the picture:

1. Every fourth or so row is taken and averaged along the row in strips: some thousand rows that keep the stripes' full
   contrast, whatever the number of rows of a slot. Cells of this plane with stripe energy outline the screen coarsely.
2. Across each coarse side many segments look for the place where the energy begins.
3. Through these places goes the *outermost* line with support. A column that is dark at the instant of the screen's top
   row, or a black part of the picture, makes energy begin too late, never too early.
4. Along the four lines pixels are read at full resolution (`edges`), and a flat screen of known aspect before one lens
   is fitted to all sides together (`pose`).

Where the camera is unknown, `side_curvature` asks afterwards what lens bows the sides between the corners.

A side that shows nothing (black, or outside the picture) is put where a flat screen of known aspect must have it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rxcli.receiver.screen.edges import refine
from rxcli.receiver.screen.onsets import Reach, fit_side
from rxcli.receiver.screen.picture import MIN_SIZE, Picture, Pixels, Plane, reduce
from rxcli.receiver.screen.pose import Places, Rectangle, fit_pose, misfit, pose_of
from rxcli.receiver.screen.side_curvature import measure_side_curvature
from rxcli.receiver.screen.sides import INWARD, SIDE_NAMES, Side, corners_of, extent, from_top_left, straight
from rxcli.receiver.screen.stripes import Stripes, coarse_sides, find_stripes
from rxcli.types import FloatArray

__all__ = ["ScreenSearch", "find_screen", "measure_side_curvature", "track_screen"]

#: Least share of a side's segments that must agree on a line.
_MIN_SUPPORT = 0.06
#: How well a side is known from the reduced picture, screen widths.
_SIDE_SD = 0.002
#: A side with this support is one of the screen's, or there is no screen.
_CLEAR_SUPPORT = 0.6
#: Misfit of four sides from which one is suspected to be another edge; what its support counts then; least margin.
_CONTRADICTION, _TRUST, _SUSPICION = 6.0, 12.0, 3.0
#: Least score of a screen; photographs without one stay below 0.15.
_MIN_SCORE = 0.25
_GIVE_CORNERS = (
    "take the whole screen into view, straight from the front; if the picture does show a screen that sends, give its "
    "place with --corners"
)
_LANDSCAPE = "hold the camera so that the long side of the picture lies along the long side of the screen"
_NO_STRIPES = "no area with the stripes of a modulated backlight was found in the picture"
_MAKE_STRIPES = (
    "photograph a screen that sends, from near, with the electronic shutter and a short exposure (1/8000 s), and use "
    "the picture in its full size"
)
_NO_OUTLINE = "what looks like stripes in the picture has no clear outline of a screen"
_NO_SHAPE = "the stripes in the picture do not have the shape of a screen"


@dataclass(frozen=True, slots=True)
class ScreenSearch:
    """Where the screen is, or why it was not found."""

    #: (4, 2) float64: pixels of the stored picture, clockwise from the corner of smallest x + y; may lie outside the
    #: picture. None: no screen.
    corners: FloatArray | None
    #: How sure, 0..1: share of the sides that is seen, times the share of the screen with stripes on it.
    score: float
    #: Why none was found: thing and reason. Empty where one was.
    reason: str = ""
    #: What to do about it, by what was seen.
    advice: str = _GIVE_CORNERS
    #: Sides (top, right, bottom, left of the stored picture) that were inferred from the others.
    inferred: tuple[str, ...] = ()
    #: Lines where stripes begin, in that order, whether or not they bound a screen; none where there are no stripes.
    lines: tuple[Side, ...] = ()


def find_screen(
    pixels: Pixels, *, black: float, white: float, mosaic_period: int = 1, aspect: float = 16 / 9
) -> ScreenSearch:
    """Find the lit screen in a picture.

    Args:
        pixels: (height, width) uint8 or uint16: luma (uint8 is taken as gamma-coded, uint16 as linear), or a mosaic.
        black: value of no light.
        white: value of full light.
        mosaic_period: pixels after which the colours of a mosaic repeat (2 Bayer, 6 X-Trans); 1 for luma.
        aspect: width over height of the screen.
    """
    trouble = _unusable(pixels, black, white)
    if trouble:
        return ScreenSearch(None, 0.0, *trouble)
    picture = Picture(pixels, black, white, mosaic_period)
    plane = reduce(picture)
    stripes = find_stripes(plane)
    initial = coarse_sides(plane, stripes)
    if initial is None:
        return ScreenSearch(None, 0.0, _NO_STRIPES, _MAKE_STRIPES)
    size = extent(initial, plane.height)
    out = max(0.025 * size, 1.5 * plane.cell_rows * plane.fy)
    return _search(picture, plane, stripes, initial, Reach(out, max(0.09 * size, 3 * out), size), aspect)


def track_screen(
    pixels: Pixels,
    previous: FloatArray,
    *,
    black: float,
    white: float,
    mosaic_period: int = 1,
    aspect: float = 16 / 9,
    reach: float = 0.012,
) -> ScreenSearch:
    """Find the screen again near where it was one frame earlier; no corners where it is not there any more.

    Args:
        pixels: as for `find_screen`.
        previous: (4, 2) corners as `find_screen` gave them.
        black: value of no light.
        white: value of full light.
        mosaic_period: as for `find_screen`.
        aspect: width over height of the screen.
        reach: how far a side may have moved, in screen widths.
    """
    trouble = _unusable(pixels, black, white)
    if trouble:
        return ScreenSearch(None, 0.0, *trouble)
    picture = Picture(pixels, black, white, mosaic_period)
    plane = reduce(picture)
    stripes = find_stripes(plane)
    initial = [straight(previous, side) for side in range(4)]
    size = float(np.linalg.norm(previous[1] - previous[0]))
    return _search(picture, plane, stripes, initial, Reach(reach * size, 3 * reach * size, size), aspect)


def _unusable(pixels: Pixels, black: float, white: float) -> tuple[str, str] | None:
    """Why a picture cannot show a screen at all, and what to do; None where it can."""
    height, width = pixels.shape
    if min(height, width) < MIN_SIZE:
        size = f"the picture has {width} x {height} pixels, a screen needs at least {MIN_SIZE} each way"
        return size, "use the picture in its full size, not a thumbnail or a messenger's copy"
    sample = (pixels[:: max(1, height // 64), :: max(1, width // 64)] - np.float32(black)) / (white - black)
    if np.mean(sample >= 0.004) < 0.005:
        return "the picture is black", "expose longer, raise ISO, or show a brighter picture on the screen"
    if np.mean(sample > 0.98) > 0.99:
        return "the picture is saturated", "expose shorter, or lower ISO"
    return None


def _search(
    picture: Picture, plane: Plane, stripes: Stripes, initial: list[Side], reach: Reach, aspect: float
) -> ScreenSearch:
    """Fit the four sides near a guess; where they bound a screen, infer those that do not show, and refine all."""
    if not 0.02 * plane.width < reach.size < 4 * plane.width:
        return ScreenSearch(None, 0.0, _NO_SHAPE)
    sides = [fit_side(picture, plane, stripes, initial, side, reach) for side in range(4)]
    sides = [side if side.support >= _MIN_SUPPORT else replace(side, support=0.0) for side in sides]
    return replace(_outlined(picture, plane, stripes, initial, reach, aspect, sides), lines=tuple(sides))


def _outlined(
    picture: Picture,
    plane: Plane,
    stripes: Stripes,
    initial: list[Side],
    reach: Reach,
    aspect: float,
    sides: list[Side],
) -> ScreenSearch:
    """The screen that sides bound."""
    rectangle = Rectangle(plane.width, plane.height, aspect)
    expected = corners_of(initial, plane.width, plane.height)
    missing = [number for number, side in enumerate(sides) if not side.support]
    if len(missing) > 1:
        names = [SIDE_NAMES[side] for side in missing]
        listed = " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
        return ScreenSearch(None, 0.0, f"something like stripes was found, but no {listed} side of a screen")
    sides, pose = _agreed(sides, missing, expected, reach.size, rectangle)
    trouble = _implausible(corners_of(sides, plane.width, plane.height), plane, aspect)
    if trouble:
        return ScreenSearch(None, 0.0, *trouble)
    corners, support = refine(picture, sides, pose, rectangle)
    return _judged(corners, sides, support, stripes, plane, aspect)


def _judged(
    corners: FloatArray, sides: list[Side], support: list[float], stripes: Stripes, plane: Plane, aspect: float
) -> ScreenSearch:
    trouble = _implausible(corners, plane, aspect)
    if trouble:
        return ScreenSearch(None, 0.0, *trouble)
    score = float(np.mean([side.support for side in sides])) ** 0.5 * stripes.share_inside(corners)
    if score < _MIN_SCORE:
        return ScreenSearch(None, score, _NO_OUTLINE)
    names = tuple(SIDE_NAMES[i] for i, side in enumerate(sides) if not side.support and not support[i])
    return ScreenSearch(from_top_left(corners), min(score, 1.0), inferred=names)


def _agreed(
    sides: list[Side], missing: list[int], expected: FloatArray, size: float, rectangle: Rectangle
) -> tuple[list[Side], FloatArray]:
    """The sides, those that are missing or contradict the others put where a flat screen has them; and its pose."""
    start = pose_of(corners_of(sides, rectangle.width, rectangle.height), rectangle)
    pose, cost = _pose_without(sides, missing, expected, start, rectangle, size)
    if not missing and cost > _CONTRADICTION:
        others = [_pose_without(sides, [number], expected, start, rectangle, size) for number in range(4)]
        costs = [
            left + side.support * (_TRUST + _inside(side, number, other, rectangle) / (_SIDE_SD * size))
            for number, (side, (other, left)) in enumerate(zip(sides, others, strict=True))
        ]
        number = int(np.argmin(costs))
        # Where two sides could be the false one, none is chosen.
        clear = min(*costs[:number], *costs[number + 1 :], cost) > costs[number] + _SUSPICION
        if clear and sides[number].support < _CLEAR_SUPPORT:
            pose, missing = others[number][0], [number]
    projected = rectangle.project(pose)
    agreed = [
        replace(straight(projected, number), support=0.0) if number in missing else side
        for number, side in enumerate(sides)
    ]
    return agreed, pose


def _pose_without(
    sides: list[Side],
    missing: list[int],
    expected: FloatArray,
    start: FloatArray,
    rectangle: Rectangle,
    size: float,
) -> tuple[FloatArray, float]:
    """The pose of a screen from the sides that are not missing, and how badly it fits them."""
    places = [
        None if number in missing else Places(*side.some_places, _SIDE_SD * size) for number, side in enumerate(sides)
    ]
    pose = fit_pose(places, expected, 0.3 * size, start, rectangle, 6)
    return pose, misfit(places, pose, rectangle)


def _inside(side: Side, number: int, pose: FloatArray, rectangle: Rectangle) -> float:
    """How far a pose has a side inside of where its stripes begin, pixels: stripes go to the side, not beyond."""
    expected = straight(rectangle.project(pose), number)
    return max(INWARD[number] * (expected.at(side.middle) - side.at(side.middle)), 0.0)


def _implausible(corners: FloatArray, plane: Plane, aspect: float) -> tuple[str, str] | None:
    """Why four corners cannot be a screen's, and what to do; None where they can."""
    edges = np.roll(corners, -1, axis=0) - corners
    following = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
    top, right, bottom, left = np.linalg.norm(edges, axis=1)
    ratio = (top + bottom) / (left + right) / aspect
    if not (turns > 0).all() or not (0.6 < top / bottom < 1.6 and 0.6 < left / right < 1.6):
        return _NO_SHAPE, _GIVE_CORNERS
    if 0.8 < ratio * aspect**2 < 1.25:
        return "the screen stands upright in the picture, so its columns lie along the rows", _LANDSCAPE
    if not 0.92 < ratio < 1.09:
        shape = f"the striped area is {ratio * aspect:.2f} times as wide as high, the screen {aspect:.2f} times"
        return shape, _GIVE_CORNERS
    if (left + right) / 2 < 0.12 * plane.height:
        fill = f"the screen fills only {(left + right) / 2 / plane.height:.0%} of the picture's height"
        return fill, "move closer, or zoom with the lens"
    return None
