"""The sides at full resolution: thin bands of pixels across each, and the pose that they agree on.

Left and right, the change of light over a few rows is compared with what it is a little further inside, which is the
same slots: the share of it that a pixel shows steps from 0 to 1 at the edge, whatever still light there is. Along top
and bottom, time runs across the edge, so that light itself is looked at: it steps up where a column is lit there, later
where it is dark. What supports a side is told apart by a line near the guess, then all four sides are fitted as one
flat screen before one lens, and each may deviate from that as far as its own places bear out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.receiver.screen.onsets import agreeing, row_trust
from rxcli.receiver.screen.picture import Picture, Pixels, row_step
from rxcli.receiver.screen.pose import INDEPENDENT, Places, Rectangle, fit_pose
from rxcli.receiver.screen.sides import (
    BOTTOM,
    INWARD,
    LEFT,
    RIGHT,
    TOP,
    Side,
    across,
    corners_of,
    outermost_line,
    width_of,
)
from rxcli.receiver.screen.stripes import LAG
from rxcli.types import BoolArray, Float32Array, FloatArray

#: How far outside and inside of the guess pixels are read, screen widths.
_OUT, _IN = 0.009, 0.018
#: Strips along top and bottom, and their width in pixels, about.
_STRIPS, _STRIP_PX = 160, 6
#: Rows that are read along left and right, about, and rows of one band.
_ROWS, _BAND_ROWS = 1000, 12
#: Half of the window over which a step is measured, screen widths and pixels.
_HALF_STEP, _LEAST_HALF_STEP = 0.0013, 3
#: Where the light inside that pixels are compared with begins, screen widths.
_INSIDE = 0.0025
#: A step counts from this many standard deviations on, this share of the largest, and this much light.
_SIGMAS, _LEAST_SHARE, _LEAST_LIGHT = 5.0, 0.11, 0.0008
#: Share of a full step that must be significant: bands are joined until it is. And bands that remain, at least.
_JOINED_SHARE, _LEAST_BANDS = 0.3, 10
#: Distance from a line at which support ends, screen widths, pixels, and periods of a mosaic.
_TOLERANCE, _LEAST_TOLERANCE, _PERIODS = 0.0005, 1.2, 0.4
#: Cost of a place outside a line, of a row-wise and of an upright side: a slot's end must not win over the edge.
_OUTSIDE_COST = {True: 4.5, False: 1.0}
#: Largest deviation of a slope from the guess, and from the pose.
_SKEW, _SMALL_SKEW = 0.007, 0.003
#: Least supporters of a side, as a number, share of its places, and share of its length that they span.
_SUPPORTERS, _SUPPORT, _SPAN = 6, 0.03, 0.3
#: Share of a side's places that makes it sure at once.
_SURE = 0.6
#: How well the guess knows the corners, a guessed side its place, and the pose the sides, screen widths.
_CORNER_SD, _GUESS_SD, _POSE_SD = 0.01, 0.002, 0.001


@dataclass(frozen=True, slots=True)
class Steps:
    """Where light steps up across one side: (K,) places along it and across it, which were found, what they count."""

    t: FloatArray
    place: FloatArray
    found: BoolArray
    weight: FloatArray
    sd: float


def refine(
    picture: Picture, initial: list[Side], pose: FloatArray, rectangle: Rectangle
) -> tuple[FloatArray, list[float]]:
    """Corners (4, 2) from pixels at full resolution, and the share of each side that supports them.

    Args:
        picture: the picture.
        initial: the four sides, within half a hundredth of the screen's width or so.
        pose: (8,) the pose that fits them.
        rectangle: picture and screen.
    """
    corners = corners_of(initial, picture.width, picture.height)
    size = width_of(corners)
    steps = [steps_of(picture, initial, side, size) for side in range(4)]
    depths = [INWARD[side] * (s.place - initial[side].at(s.t)) for side, s in enumerate(steps)]
    expected = rectangle.project(pose)
    supporters = [_supporters(steps[side], depths[side], side, 1.6 * steps[side].sd, _SKEW, 2.0) for side in range(4)]
    # A slot's end can look like an edge: a side that shows on a part of its length follows from the others at first.
    sure = [
        mask if mask.sum() > _SURE * mask.size or not initial[side].support else np.zeros_like(mask)
        for side, mask in enumerate(supporters)
    ]
    places = [_places(steps[side], sure[side], initial[side], size) for side in range(4)]
    pose = fit_pose(places, expected, _CORNER_SD * size, pose, rectangle, 4)
    depths = _depths(steps, pose, rectangle)
    for side, tolerance in enumerate(1.2 * s.sd for s in steps):
        nearer = _supporters(steps[side], depths[side], side, tolerance, _SMALL_SKEW, 1.2)
        supporters[side] = nearer if nearer.any() else sure[side]
    places = [_places(steps[side], supporters[side], initial[side], size) for side in range(4)]
    pose = fit_pose(places, expected, _CORNER_SD * size, pose, rectangle, 3)
    depths = _depths(steps, pose, rectangle)
    own = [_deviation(steps[side], supporters[side], depths[side], side, _POSE_SD * size) for side in range(4)]
    return _meet(pose, own, rectangle), [float(mask.mean()) if mask.size else 0.0 for mask in supporters]


def _depths(steps: list[Steps], pose: FloatArray, rectangle: Rectangle) -> list[FloatArray]:
    """How far inside the pose's sides the steps are."""
    corners = rectangle.project(pose)
    return [INWARD[side] * (s.place - rectangle.side_at(corners, pose[-1], side, s.t)) for side, s in enumerate(steps)]


def _supporters(steps: Steps, depth: FloatArray, side: int, tolerance: float, skew: float, window: float) -> BoolArray:
    """(K,) the steps that lie on the side."""
    none = np.zeros(steps.t.size, np.bool_)
    line = outermost_line(
        steps.t,
        depth,
        steps.weight,
        steps.found,
        tolerance,
        slope=0.0,
        spread=skew,
        outside_cost=_OUTSIDE_COST[across(side)],
    )
    if line is None:
        return none
    beyond = depth - line.start - line.slope * steps.t
    # Late steps pull a line inwards, nothing pulls it outwards.
    on_it = steps.found & (beyond > -1.5 * window * steps.sd) & (beyond < window * steps.sd)
    enough = on_it.sum() >= max(_SUPPORTERS, _SUPPORT * steps.t.size)
    return on_it if enough and np.ptp(steps.t[on_it]) >= _SPAN * np.ptp(steps.t) else none


def _places(steps: Steps, supporters: BoolArray, initial: Side, size: float) -> Places | None:
    """What a side contributes to the pose; its guess where it does not show at full resolution."""
    if supporters.any():
        return Places(steps.t[supporters], steps.place[supporters], steps.sd)
    if not initial.support:
        return None
    return Places(*initial.some_places, _GUESS_SD * size)


def _deviation(
    steps: Steps, supporters: BoolArray, depth: FloatArray, side: int, sd: float
) -> tuple[FloatArray, float, float]:
    """Offset and slope (per half length) by which a side deviates from the pose, its middle and half length."""
    if not supporters.any():
        return np.zeros(2), 0.0, 1.0
    middle, half = float(steps.t.mean()), max(float(np.ptp(steps.t)) / 2, 1.0)
    along = (steps.t[supporters] - middle) / half
    terms = np.stack([np.ones_like(along), along])
    weight = steps.sd**-2.0 / (1 + along.size / INDEPENDENT)
    normal = weight * terms @ terms.T + np.eye(2) / sd**2
    own = np.linalg.solve(normal, weight * terms @ depth[supporters])
    return np.asarray(INWARD[side] * own, np.float64), middle, half


def _meet(pose: FloatArray, own: list[tuple[FloatArray, float, float]], rectangle: Rectangle) -> FloatArray:
    """(4, 2) corners of a pose whose sides deviate a little."""
    ideal = rectangle.project(pose)
    offset = (ideal - rectangle.middle) / rectangle.width
    corners = ideal + pose[-1] * rectangle.width * (offset**2).sum(axis=1, keepdims=True) * offset
    edge = np.roll(ideal, -1, axis=0) - ideal
    for i, (flat, upright) in enumerate(((TOP, LEFT), (TOP, RIGHT), (BOTTOM, RIGHT), (BOTTOM, LEFT))):
        slope_x, slope_y = edge[upright, 0] / edge[upright, 1], edge[flat, 1] / edge[flat, 0]
        dy, dx = (
            fit[0] + fit[1] * (corners[i, along] - middle) / half
            for along, (fit, middle, half) in ((0, own[flat]), (1, own[upright]))
        )
        x = (dx + slope_x * dy) / (1 - slope_x * slope_y)
        corners[i] += (x, dy + slope_y * x)
    return np.asarray(corners, np.float64)


def steps_of(picture: Picture, initial: list[Side], side: int, size: float) -> Steps:
    """The steps of light across one side.

    Args:
        picture: the picture.
        initial: the four sides, within half a hundredth of the screen's width or so.
        side: which of them.
        size: the screen's width, pixels.
    """
    half = max(_LEAST_HALF_STEP, int(_HALF_STEP * size), picture.period)
    out, inward = max(int(_OUT * size), 3 * half), max(int(_IN * size), 6 * half)
    read = _across if across(side) else _upright
    t, centre, light, threshold, inside = read(picture, initial, side, size, out, inward, half)
    sd = max(_LEAST_TOLERANCE, _TOLERANCE * size, _PERIODS * picture.period)
    if not t.size:
        return Steps(t, t, t > 0, t, sd)
    if picture.period > 1:
        light = _blurred(light, picture.period)
    position, found = _first_step(light, inside, threshold, half)
    place = centre + INWARD[side] * (position - out)
    # Where the picture ends before the screen does, the first step is any.
    found &= inside[:, out // 2]
    found &= agreeing(place, max(4.0, 3 * sd))
    weight = row_trust(place, found, sd) if across(side) else found.astype(np.float64)
    return Steps(t, place, found, weight, sd)


def _blurred(light: Float32Array, period: int) -> Float32Array:
    """Mean over the colours of a mosaic."""
    import cv2

    return np.asarray(cv2.blur(light, (period, 1)), np.float32)


#: Place along the side and pixel of the guess (K,), light (K, N), its least step (K,), and where the picture is (K, N).
_Read = tuple[FloatArray, FloatArray, Float32Array, FloatArray, BoolArray]


def _ends(initial: list[Side], side: int, size: float, limit: int) -> tuple[float, float]:
    """From where to where a side goes, a little inside its neighbours and inside the picture."""
    before, after = (initial[LEFT], initial[RIGHT]) if across(side) else (initial[TOP], initial[BOTTOM])
    middle = initial[side].at(limit / 2)
    return max(before.at(middle) + 0.004 * size, 0.0), min(after.at(middle) - 0.004 * size, limit - 1.0)


def _across(picture: Picture, initial: list[Side], side: int, size: float, out: int, inward: int, half: int) -> _Read:
    """Top and bottom: light of strips of some pixels, from outside to inside."""
    strip = picture.period * max(1, round(_STRIP_PX / picture.period))
    first, last = _ends(initial, side, size, picture.width)
    n = min(_STRIPS, int((last - first) / strip))
    if n < _SUPPORTERS:
        return _nothing(out + inward)
    left = np.round(np.linspace(first, last - strip, n)).astype(np.int64)
    t: FloatArray = left.astype(np.float64) + (strip - 1) / 2
    centre = np.round(initial[side].at(t)).astype(np.int64)
    top = centre - (out if INWARD[side] > 0 else inward - 1)
    block = _cut(picture.pixels, top, left, (out + inward, strip), 1)
    mean = np.full(strip, 1 / strip, np.float32)
    light = (picture.linear(block.reshape(-1, strip)) @ mean).reshape(n, -1)[:, :: INWARD[side]]
    noise = float(np.median(light[:, : out // 2].std(axis=1)))
    threshold = np.maximum(_LEAST_SHARE * np.ptp(light, axis=1), max(_SIGMAS * noise * (2 / half) ** 0.5, _LEAST_LIGHT))
    inside = _in_picture(centre, side, out, inward, picture.height)
    return t, centre.astype(np.float64), light, threshold, inside


def _upright(picture: Picture, initial: list[Side], side: int, size: float, out: int, inward: int, half: int) -> _Read:
    """Left and right: the share of the inside's changes that pixels show, from outside to inside, in bands of rows."""
    first, last = _ends(initial, side, size, picture.height)
    step = picture.period * max(1, round((last - first) / _ROWS / picture.period))
    lag = max(1, round(LAG * row_step(picture) / step))
    n = int((last - first) / step - lag) // _BAND_ROWS
    if n < _SUPPORTERS:
        return _nothing(out + inward)
    top = int(first) + step * _BAND_ROWS * np.arange(n)
    t: FloatArray = top.astype(np.float64) + step * (_BAND_ROWS + lag - 1) / 2
    centre = np.round(initial[side].at(t)).astype(np.int64)
    left = centre - (out if INWARD[side] > 0 else inward - 1)
    light = picture.linear(_cut(picture.pixels, top, left, (_BAND_ROWS + lag, out + inward), step))
    change = light[:, lag:] - light[:, :-lag]
    change = change if INWARD[side] > 0 else np.ascontiguousarray(change[:, :, ::-1])
    within = change[:, :, out + int(_INSIDE * size) :].mean(axis=2)
    common, power = (within[:, None] @ change)[:, 0], (within**2).sum(axis=1)
    noise = float(np.median((change[:, :, : max(out // 3, 2)] ** 2).mean(axis=(1, 2)))) + 1e-7
    # A step over `half` places has this variance where n rows of the mean power are joined: 4 noise / (half n power).
    rows = 4 * noise * (_SIGMAS / _JOINED_SHARE) ** 2 / half / max(float((within**2).mean()), 1e-12)
    joined = int(np.clip(rows / _BAND_ROWS, 1, max(n // _LEAST_BANDS, 1)))
    common, t, middle = _joined(common, joined), _joined(t, joined), _joined(centre, joined)
    power = np.maximum(_joined(power, joined), 1e-12)
    threshold = np.maximum(_SIGMAS * np.sqrt(4 * noise / half / (power * joined)), _LEAST_SHARE)
    inside = _in_picture(centre, side, out, inward, picture.width)
    share = (common / power[:, None]).astype(np.float32)
    return t, middle, share, threshold, _joined(inside, joined) > 0.99


def _joined(values: NDArray[Any], n: int) -> FloatArray:
    """Means of `n` neighbours each along the first axis."""
    whole = values[: len(values) // n * n]
    return np.asarray(whole.reshape(-1, n, *values.shape[1:]).mean(axis=1), np.float64)


def _nothing(n: int) -> _Read:
    none = np.zeros(0)
    return none, none, np.zeros((0, n), np.float32), none, np.zeros((0, n), np.bool_)


def _in_picture(centre: NDArray[np.int64], side: int, out: int, inward: int, limit: int) -> BoolArray:
    """(K, out + inward) which places of the windows are in the picture."""
    place = centre[:, None] + INWARD[side] * np.arange(-out, inward)
    return np.asarray((place >= 0) & (place < limit), np.bool_)


def _cut(
    pixels: Pixels, tops: NDArray[np.int64], lefts: NDArray[np.int64], shape: tuple[int, int], step: int
) -> Pixels:
    """(K, rows, columns) blocks of every `step`-th row; 0 where they leave the picture."""
    height, width = pixels.shape
    rows, columns = shape
    highest, leftmost = height - (rows - 1) * step, width - columns + 1
    if min(tops.min(), lefts.min()) >= 0 and tops.max() < highest and lefts.max() < leftmost:
        # Whole blocks are copied many times quicker than single pixels.
        down, along = pixels.strides
        views = np.lib.stride_tricks.as_strided(
            pixels, (highest, leftmost, rows, columns), (down, along, step * down, along), writeable=False
        )
        return np.asarray(views[tops, lefts])
    y, x = tops[:, None] + step * np.arange(rows), lefts[:, None] + np.arange(columns)
    blocks = pixels[np.clip(y, 0, height - 1)[:, :, None], np.clip(x, 0, width - 1)[:, None]]
    there = ((y >= 0) & (y < height))[:, :, None] & ((x >= 0) & (x < width))[:, None]
    return np.asarray(blocks * there)


def _first_step(
    light: Float32Array, inside: BoolArray, threshold: FloatArray, half: int
) -> tuple[FloatArray, BoolArray]:
    """The first place at which light grows by more than a threshold, to a fraction of a pixel.

    Args:
        light: (K, N) from outside to inside.
        inside: (K, N) where it is in the picture.
        threshold: (K,) least growth.
        half: places on either side over which light is averaged.

    Returns:
        (K,) places, the centroid of the growth there, and (K,) whether there is one.
    """
    total = np.zeros((light.shape[0], light.shape[1] + 1))
    np.cumsum(light, axis=1, dtype=np.float64, out=total[:, 1:])
    n = light.shape[1] - 2 * half + 1
    growth = (total[:, 2 * half :] - 2 * total[:, half : half + n] + total[:, :n]) / half
    growth[~(inside[:, :n] & inside[:, 2 * half - 1 :])] = 0
    grows = growth > threshold[:, None]
    ahead = np.minimum(grows.argmax(axis=1)[:, None] + np.arange(2 * half), n - 1)
    peak = np.take_along_axis(ahead, np.take_along_axis(growth, ahead, axis=1).argmax(axis=1)[:, None], axis=1)
    near = np.clip(peak + np.arange(-half, half + 1), 0, n - 1)
    weight = np.maximum(np.take_along_axis(growth, near, axis=1), 0)
    # Growth number i lies between the places i + half - 1 and i + half.
    place = (weight * near).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-12) + half - 0.5
    return np.asarray(place), np.asarray(grows.any(axis=1), np.bool_)
