"""Finding the screen in a picture: where the stripes of a modulated backlight begin and end.

Nothing in a room changes from row to row as a modulated backlight does, and the change is the same in neighbouring
pixels. So the search looks at one product: the change of light over a few rows, times the same change a little further
along the rows. Its mean is the stripes' energy and zero for noise, for still light of any strength, and for upright
edges. Three steps, each on less of the picture:

1. Every fourth or so row is taken and averaged along the row: some thousand rows and pixels that keep the stripes' full
   contrast, whatever the number of rows of a slot. Cells of this plane with stripe energy outline the screen coarsely.
2. Across each coarse side many segments look for the place where the energy begins.
3. Through these places goes the *outermost* line with support. A column that is dark at the instant of the screen's top
   row, or a black part of the picture, makes energy begin too late, never too early.

A side that shows nothing (black, or outside the picture) is put where a flat screen of known aspect must have it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.types import BoolArray, Float32Array, FloatArray

Pixels = NDArray[np.uint8] | NDArray[np.uint16]

#: Rows and columns of the reduced plane, about.
_PLANE = 1040
#: Rows of the reduced plane between the two lights of a change: two slots at the top rate, a good part of a long one.
_LAG = 3
#: Picture pixels between the two changes of a product: further than demosaicing, denoising and coding spread noise.
_APART_PX = 7
#: Strips that the plane's width is summed into for the coarse map and for the top and bottom sides.
_STRIPS = 340
#: Rows of the reduced plane in one coarse cell, at most, and strips.
_CELL_ROWS, _CELL_STRIPS = 16, 4
#: Bands of rows for the left and right sides, at most, and rows of one band, at least.
_BANDS, _BAND_ROWS = 40, 26
#: Sides in the order of `ScreenSearch.corners`: side i goes from corner i to corner i + 1.
_TOP, _RIGHT, _BOTTOM, _LEFT = range(4)
#: Direction in which x or y grows from each side into the screen; and sign of its slope in depth for a positive roll.
_INWARD = (1, -1, -1, 1)
_TURN = (1, 1, -1, -1)
_SIDE_NAMES = ("top", "right", "bottom", "left")
#: Least share of a side's segments that must agree on a line.
_MIN_SUPPORT = 0.06
#: Least score of a screen; photographs without one stay below 0.15.
_MIN_SCORE = 0.2
#: Pairs of places through which lines are tried.
_TRIES = 300
#: A segment that begins outside a line counts this often against it, so that the outermost line wins with a sixth.
_OUTSIDE_COST = 6.0
#: Strips that begin on one and the same row may show a slot's end; together they count as this share of the side.
_ROW_TRUST = 0.05
#: Largest slope of a side, and its largest deviation from the others' when they are turned onto it.
_MAX_SLOPE, _MAX_SKEW = 0.25, 0.07
#: Times that the window of a side is moved outwards while stripes go on there.
_MOVES_OUT = 4
#: Focal length that the perspective of an invisible side assumes, picture widths.
_FOCAL_WIDTHS = 1.2
#: Smallest picture that is searched, pixels each way.
_MIN_SIZE = 96


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
    #: Sides (top, right, bottom, left of the stored picture) that were inferred from the others.
    inferred: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Plane:
    """The reduced picture: light on a scale near to that of the eye, black 0, white 1."""

    light: Float32Array
    #: Picture pixels of one plane pixel.
    fx: int
    fy: int
    #: Black wedges that the correction of a lens left along the picture's edges; None: there are none.
    wedge: BoolArray | None
    width: int
    height: int

    @property
    def cell_rows(self) -> int:
        """Rows of the plane in one coarse cell."""
        return int(np.clip(self.light.shape[0] // 60, 4, _CELL_ROWS))

    def apart(self, columns: int) -> int:
        """Steps between the two changes of a product, where one step is some columns of the plane."""
        return max(1, -(-_APART_PX // (columns * self.fx)))


@dataclass(frozen=True, slots=True)
class _Stripes:
    """Stripe energy of a plane."""

    #: (R - lag, strips - apart) products of the changes of two strips, where these grow and where they shrink.
    growing: Float32Array
    shrinking: Float32Array
    #: Plane pixels of one strip, and strips between the changes of a product.
    strip: int
    apart: int
    #: (rows, columns) of coarse cells that have stripes.
    striped: BoolArray
    #: Energy that the whole picture has: row noise of the sensor.
    floor: float
    #: Standard deviation of one product without light.
    noise: float


@dataclass(frozen=True, slots=True)
class _Side:
    """One side of the screen: x of left and right, y of top and bottom, as a polynomial of the other coordinate."""

    #: Highest power first, of (t - middle) / half.
    coefficients: FloatArray
    middle: float
    half: float
    #: Share of the side that supports it; 0 where it is inferred.
    support: float

    def at(self, t: FloatArray) -> FloatArray:
        """Place of the side at `t`."""
        return np.asarray(np.polyval(self.coefficients, (t - self.middle) / self.half), np.float64)

    @property
    def slope(self) -> float:
        """Change of place with t at the middle."""
        return float(self.coefficients[-2] / self.half)


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
        return ScreenSearch(None, 0.0, trouble)
    plane = _reduce(pixels, black, white, mosaic_period)
    stripes = _find_stripes(plane)
    guess = _coarse_sides(plane, stripes)
    if guess is None:
        return ScreenSearch(None, 0.0, "no area with the stripes of a modulated backlight was found in the picture")
    size = _extent(guess, plane)
    out = max(0.025 * size, 1.5 * plane.cell_rows * plane.fy)
    return _refine(plane, stripes, guess, out=out, inward=max(0.06 * size, 2 * out), aspect=aspect)


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
        return ScreenSearch(None, 0.0, trouble)
    plane = _reduce(pixels, black, white, mosaic_period)
    stripes = _find_stripes(plane)
    guess = [_straight(previous, side) for side in range(4)]
    size = float(np.linalg.norm(previous[1] - previous[0]))
    return _refine(plane, stripes, guess, out=reach * size, inward=3 * reach * size, aspect=aspect)


def _unusable(pixels: Pixels, black: float, white: float) -> str:
    """Why a picture cannot show a screen at all; empty where it can."""
    height, width = pixels.shape
    if min(height, width) < _MIN_SIZE:
        return f"the picture has {width} x {height} pixels, a screen needs at least {_MIN_SIZE} each way"
    sample = (pixels[:: max(1, height // 64), :: max(1, width // 64)] - np.float32(black)) / (white - black)
    if np.percentile(sample, 99.5) < 0.004:
        return "the picture is black"
    if np.percentile(sample, 1) > 0.98:
        return "the picture is saturated"
    return ""


def _reduce(pixels: Pixels, black: float, white: float, period: int) -> _Plane:
    """Every n-th row, averaged along the row over whole periods of the mosaic."""
    import cv2

    height, width = pixels.shape
    fy = period * max(1, round(height / _PLANE / period))
    fx = period * max(1, round(width / _PLANE / period))
    rows = pixels[::fy, : width // fx * fx]
    light = cv2.resize(rows, (width // fx, rows.shape[0]), interpolation=cv2.INTER_AREA).astype(np.float32)
    light -= np.float32(black)
    light *= np.float32(1 / (white - black))
    developed = pixels.dtype == np.uint8
    if not developed:
        # The offset keeps the noise of the dark from being stretched without bound.
        light = np.sqrt(np.maximum(light, 0) + np.float32(0.002))
    return _Plane(light, fx, fy, _wedge(light) if developed else None, width, height)


def _wedge(light: Float32Array) -> BoolArray | None:
    """The black wedges of a lens correction: runs of black from the picture's edges that change slowly along them."""
    import cv2

    mask = np.zeros(light.shape, np.uint8)
    depth = max(int(0.05 * light.shape[1]), 2)
    for turns in range(4):
        turned = np.rot90(light, turns)
        if np.mean(turned[:, 0] <= 0.008) < 0.05:
            continue
        dark = turned[:, :depth] <= 0.008
        run = np.logical_and.accumulate(dark, axis=1).sum(axis=1)
        # A dark slot of the screen is a long run too, but its neighbours are short.
        run = cv2.erode(run.astype(np.float32)[:, None], np.ones((25, 1), np.uint8))
        np.rot90(mask, turns)[:, :depth] |= (np.arange(depth) < run).astype(np.uint8)
    # The margin covers the ringing of the JPEG blocks at the wedge's edge.
    return cv2.dilate(mask, np.ones((7, 7), np.uint8)) > 0 if mask.any() else None


def _area(values: NDArray[np.float32], columns: int, rows: int) -> Float32Array:
    """Block means."""
    import cv2

    return np.asarray(cv2.resize(values, (columns, rows), interpolation=cv2.INTER_AREA), np.float32)


def _products(light: Float32Array, apart: int, wedge: BoolArray | None) -> tuple[Float32Array, BoolArray]:
    """Change over the lag, times the same change `apart` columns further; and where light grows down the rows."""
    change = light[_LAG:] - light[:-_LAG]
    product = np.asarray(change[:, apart:] * change[:, :-apart], np.float32)
    if wedge is not None:
        touched = wedge[_LAG:] | wedge[:-_LAG]
        product[touched[:, apart:] | touched[:, :-apart]] = 0
    return product, change[:, :-apart] > 0


def _find_stripes(plane: _Plane) -> _Stripes:
    """The map of stripe energy."""
    import cv2

    height, width = plane.light.shape
    strip = max(1, round(width / _STRIPS))
    n = width // strip
    light = _area(plane.light[:, : n * strip], n, height)
    wedge = None if plane.wedge is None else _area(plane.wedge[:, : n * strip].astype(np.float32), n, height) > 0
    apart = plane.apart(strip)
    products, grows = _products(light, apart, wedge)
    growing = products * grows
    shape = (products.shape[1] // _CELL_STRIPS, products.shape[0] // plane.cell_rows)
    inner = (slice(shape[1] * plane.cell_rows), slice(shape[0] * _CELL_STRIPS))
    cells = _area(products[inner], *shape)
    smooth = cv2.blur(cells, (3, 3))
    smooth = smooth * _balance(cells, _area(growing[inner], *shape))
    spread = np.maximum(cv2.blur(_area(products[inner] ** 2, *shape), (3, 3)), 0)
    strong = float(np.percentile(smooth, 92))
    # Row noise is alike along a row: what even the stillest tenth of a row of cells has, within its limits.
    still = np.maximum(np.percentile(smooth, 10, axis=1), 0)
    floor = min(float(np.percentile(still, 10)), 0.1 * strong)
    smooth = smooth - np.minimum(still, 3 * floor)[:, None].astype(np.float32)
    noise = float(np.sqrt(max(np.percentile(spread, 10), 0) / 3))
    significant = smooth > 1.5 * np.sqrt(spread / (plane.cell_rows * _CELL_STRIPS))
    threshold = max(0.02 * strong, floor, 1e-4)
    across = light[:, 1:] - light[:, :-1]
    upright = _area((across[_LAG:] * across[:-_LAG])[inner], *shape)
    striped = _large_areas((smooth > threshold) & significant, cells, upright)
    return _Stripes(growing, products - growing, strip, apart, striped, floor, noise)


def _balance(cells: Float32Array, growing: Float32Array) -> Float32Array:
    """0..1 whether light shrinks as often as it grows, as slots do; the edge of a wall or a bezel does one only."""
    import cv2

    both, up = cv2.blur(cells, (9, 5)), cv2.blur(growing, (9, 5))
    one_sided = np.abs(2 * up - both) / np.maximum(both, 1e-9)
    return np.asarray(np.clip((0.9 - one_sided) / 0.3, 0, 1), np.float32)


def _large_areas(mask: BoolArray, lying: Float32Array, upright: Float32Array) -> BoolArray:
    """Connected areas of some size in which changes down the rows outweigh those along them."""
    import cv2

    _, label = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    count = np.bincount(label.ravel())
    down, along = (np.bincount(label.ravel(), energy.ravel(), count.size) for energy in (lying, upright))
    good = (count >= max(12, 0.03 * count[1:].max(initial=0))) & (down > along)
    good[0] = False
    return np.asarray(good[label], np.bool_)


def _coarse_sides(plane: _Plane, stripes: _Stripes) -> list[_Side] | None:
    """A line along each side of the striped area; None where there is no such area."""
    rows, columns = stripes.striped.shape
    if stripes.striped.mean() < 0.02:
        return None
    step_y, step_x = plane.cell_rows * plane.fy, _CELL_STRIPS * stripes.strip * plane.fx
    y = (np.arange(rows, dtype=np.float64) + 0.5) * step_y + plane.fy * (_LAG - 1) / 2
    x = (np.arange(columns, dtype=np.float64) + 0.5) * step_x + plane.fx * stripes.strip * stripes.apart / 2 - 0.5
    onsets = [_cell_onsets(stripes.striped, x, y, side) for side in range(4)]
    lines = [
        _outermost_line(*o, 1.2 * step, 0.0, _MAX_SLOPE) for o, step in zip(onsets, (step_y, step_x) * 2, strict=True)
    ]
    if any(line is None for line in lines):
        return None
    # A side that is half black can be led astray; turned by a right angle the four slopes are nearly one.
    turned = np.array([_TURN[side] * line[1] for side, line in enumerate(lines) if line is not None])
    across = turned[[_TOP, _BOTTOM]]
    roll = float(across.mean() if np.ptp(across) < _MAX_SKEW else np.median(turned))
    sides = []
    for side, (places, step) in enumerate(zip(onsets, (step_y, step_x) * 2, strict=True)):
        line = _outermost_line(*places, 1.2 * step, _TURN[side] * roll, _MAX_SKEW)
        if line is None:
            return None
        sides.append(_Side(_INWARD[side] * np.array(line[1::-1]), 0.0, 1.0, line[2]))
    return sides


def _cell_onsets(
    striped: BoolArray, x: FloatArray, y: FloatArray, side: int
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Across a side: place along it, depth where striped cells begin and last, its weight, and where there are any."""
    mask, t, place = (striped.T, x, y) if side in (_TOP, _BOTTOM) else (striped, y, x)
    mask = mask[:, :: _INWARD[side]]
    following = np.pad(mask, ((0, 0), (0, 3))).astype(np.int64)
    lasting = mask & (following[:, 1:-2] + following[:, 2:-1] + following[:, 3:] >= 2)
    seen: BoolArray = np.any(lasting, axis=1)
    first = place[:: _INWARD[side]][lasting.argmax(axis=1)]
    depth: FloatArray = _INWARD[side] * first - (place[1] - place[0]) / 2
    return t, depth, seen.astype(np.float64), seen


def _outermost_line(
    t: FloatArray, depth: FloatArray, weight: FloatArray, seen: BoolArray, tolerance: float, slope: float, spread: float
) -> tuple[float, float, float] | None:
    """The best supported line with little beyond it, by trying lines through pairs of places.

    Args:
        t: (n,) place along the side.
        depth: (n,) where energy begins, growing inwards.
        weight: (n,) support that a place may give, 0..1.
        seen: (n,) places that may speak against one.
        tolerance: distance at which support ends.
        slope: expected slope.
        spread: largest deviation from it.

    Returns:
        Depth at t = 0, slope, and support as a share of the n places; None where there is too little.
    """
    candidates = np.flatnonzero(weight)
    if candidates.size < 5:
        return None
    rng = np.random.default_rng(1)
    i, j = rng.choice(candidates, (2, _TRIES))
    apart = np.abs(t[i] - t[j]) > 0.15 * np.ptp(t)
    i, j = i[apart], j[apart]
    slopes = (depth[j] - depth[i]) / (t[j] - t[i])
    fitting = np.abs(slopes - slope) < spread
    i, slopes = i[fitting], slopes[fitting]
    if not i.size:
        return None
    starts = depth[i] - slopes * t[i]
    beyond = (depth[seen] - starts[:, None] - slopes[:, None] * t[seen]) / tolerance
    support = np.maximum(1 - beyond**2, 0) @ weight[seen]
    against = np.clip(-beyond - 1, 0, 1).sum(axis=1)
    score = support - _OUTSIDE_COST * against
    best = int(score.argmax())
    return float(starts[best]), float(slopes[best]), float(support[best] / t.size)


def _extent(sides: list[_Side], plane: _Plane) -> float:
    """Width of the screen in pixels, through the picture's middle."""
    middle = np.array(plane.height / 2)
    return abs(float(sides[_RIGHT].at(middle) - sides[_LEFT].at(middle)))


def _straight(corners: FloatArray, side: int) -> _Side:
    """The straight side between two corners."""
    a, b = corners[side], corners[(side + 1) % 4]
    (ta, pa), (tb, pb) = (a, b) if side in (_TOP, _BOTTOM) else (a[::-1], b[::-1])
    half = (tb - ta) / 2 if tb != ta else 1.0
    return _Side(np.array([(pb - pa) / 2, (pa + pb) / 2]), float((ta + tb) / 2), float(half), 1.0)


def _corners(sides: list[_Side], plane: _Plane) -> FloatArray:
    """Where neighbouring sides meet, by turns."""
    found = []
    for across, down in ((_TOP, _LEFT), (_TOP, _RIGHT), (_BOTTOM, _RIGHT), (_BOTTOM, _LEFT)):
        x, y = np.array(plane.width / 2), np.array(plane.height / 2)
        for _ in range(12):
            x = sides[down].at(y)
            y = sides[across].at(x)
        found.append((float(x), float(y)))
    return np.array(found)


def _refine(
    plane: _Plane, stripes: _Stripes, guess: list[_Side], *, out: float, inward: float, aspect: float
) -> ScreenSearch:
    """Fit the four sides near a guess, infer those that do not show, and judge the result."""
    size = _extent(guess, plane)
    if not 0.02 * plane.width < size < 4 * plane.width:
        return ScreenSearch(None, 0.0, "the stripes in the picture do not have the shape of a screen")
    sides = [_fit_side(plane, stripes, guess, side, out, inward, size) for side in range(4)]
    missing = [side for side in range(4) if sides[side].support < _MIN_SUPPORT]
    if len(missing) > 2:
        return ScreenSearch(None, 0.0, "what looks like stripes in the picture has no clear outline of a screen")
    if len(missing) > 1:
        names = " and ".join(_SIDE_NAMES[side] for side in missing)
        return ScreenSearch(None, 0.0, f"stripes were found, but the {names} sides of the screen do not show")
    for side in missing:
        sides[side] = _infer_side(sides, side, plane, aspect)
    corners = _corners(sides, plane)
    start = int(np.argmin(corners.sum(axis=1)))
    trouble = _implausible(corners, plane, aspect)
    if trouble:
        return ScreenSearch(None, 0.0, trouble)
    score = float(np.mean([side.support for side in sides])) ** 0.5 * _striped_share(stripes, corners, plane)
    if score < _MIN_SCORE:
        return ScreenSearch(None, score, "what looks like stripes in the picture has no clear outline of a screen")
    return ScreenSearch(np.roll(corners, -start, axis=0), min(score, 1.0), "", tuple(_SIDE_NAMES[s] for s in missing))


@dataclass(frozen=True, slots=True)
class _Onsets:
    """Where stripe energy begins on K segments of one side."""

    #: (K,) place along the side, and where energy begins, picture pixels.
    t: FloatArray
    place: FloatArray
    #: (K,) energy was found; it begins inside the picture.
    seen: BoolArray
    usable: BoolArray
    #: (K,) energy is there from the window's first place on, and the picture goes on beyond it.
    earlier: BoolArray
    #: Resolution, picture pixels.
    step: float


@dataclass(frozen=True, slots=True)
class _Window:
    """A band along a side: N places from outside to inside on each of K segments, as indices into an energy map."""

    t: FloatArray
    #: (K, N) index of each place across the side.
    index: NDArray[Any]
    #: Places before the guess.
    outer: int
    origin: float
    step: float
    sign: int

    def place(self, depth: FloatArray) -> FloatArray:
        """Picture pixels of the (K,) fractional positions `depth` in the window."""
        return self.origin + self.step * (self.index[:, 0] + self.sign * depth)


def _window(
    guess: list[_Side], side: int, t: FloatArray, origin: float, step: float, out: float, inward: float, margin: float
) -> tuple[_Window, BoolArray]:
    """The window of a side and the (K,) segments of `t` that lie between the neighbouring sides."""
    between = _between(guess, side, t, margin)
    centre = np.round((guess[side].at(t[between]) - origin) / step).astype(np.int64)
    outer = max(int(out / step), 2)
    index = centre[:, None] + _INWARD[side] * np.arange(-outer, max(int(inward / step), 8))
    return _Window(t[between], index, outer, origin, step, _INWARD[side]), between


def _between(guess: list[_Side], side: int, t: FloatArray, margin: float) -> BoolArray:
    """(K,) places along a side that lie between the neighbouring sides, by a margin."""
    before, after = (guess[_LEFT], guess[_RIGHT]) if side in (_TOP, _BOTTOM) else (guess[_TOP], guess[_BOTTOM])
    middle = guess[side].at(np.array(t.mean()))
    return np.asarray((t > before.at(middle) + margin) & (t < after.at(middle) - margin), np.bool_)


def _fit_side(
    plane: _Plane, stripes: _Stripes, guess: list[_Side], side: int, out: float, inward: float, size: float
) -> _Side:
    """One side near its guess; support 0 where nothing shows."""
    find = _strip_onsets if side in (_TOP, _BOTTOM) else _band_onsets
    for _ in range(_MOVES_OUT):
        onsets = find(plane, stripes, guess, side, out, inward, 0.004 * size)
        if not onsets.t.size or onsets.earlier.mean() < 0.1:
            break
        guess = [_moved(old, -0.8 * out * _INWARD[side]) if i == side else old for i, old in enumerate(guess)]
    sign = _INWARD[side]
    tolerance = max(1.5 * onsets.step, (0.0012 if side in (_TOP, _BOTTOM) else 0.002) * size)
    # Where the picture ends before the screen does, a line must pass well outside.
    depth: FloatArray = sign * onsets.place - np.where(onsets.usable, 0, 3 * tolerance)
    weight: FloatArray = onsets.usable.astype(np.float64)
    if side in (_TOP, _BOTTOM):
        weight *= _row_trust(onsets)
    line = _outermost_line(onsets.t, depth, weight, onsets.seen, tolerance, sign * guess[side].slope, _MAX_SKEW)
    cut = onsets.seen & ~onsets.usable
    if line is None or line[2] < cut.mean():
        return _Side(guess[side].coefficients, guess[side].middle, guess[side].half, 0.0)
    return _bend(onsets, np.array(line[1::-1]), depth, weight, tolerance, sign)


def _moved(side: _Side, distance: float) -> _Side:
    """The side, moved across itself."""
    coefficients = side.coefficients.copy()
    coefficients[-1] += distance
    return _Side(coefficients, side.middle, side.half, side.support)


def _row_trust(onsets: _Onsets) -> FloatArray:
    """(K,) weight of every strip: many that begin on one row are one observation, a slot's end perhaps."""
    row = np.round(onsets.place / onsets.step - 0.25).astype(np.int64)
    row -= row.min(initial=0)
    count = np.convolve(np.bincount(row[onsets.usable], minlength=int(row.max(initial=0)) + 1), np.ones(3), "same")
    return np.asarray(np.minimum(1.0, _ROW_TRUST * row.size / np.maximum(count[row], 1)), np.float64)


def _bend(
    onsets: _Onsets, line: FloatArray, depth: FloatArray, weight: FloatArray, tolerance: float, sign: int
) -> _Side:
    """Let a line bend as a lens bends it, where its places cover most of the side."""
    middle, half = float(onsets.t.mean()), max(float(np.ptp(onsets.t)) / 2, 1.0)
    along = (onsets.t - middle) / half
    fit = np.array([line[0] * half, line[0] * middle + line[1]])
    near = onsets.usable
    for _ in range(4):
        beyond = depth - np.polyval(fit, along)
        # Late beginnings pull a line inwards, nothing pulls it outwards.
        near = onsets.usable & (beyond > -2 * tolerance) & (beyond < tolerance)
        covered = np.unique((along[near] * 3).round()).size
        if near.sum() < 5 or covered < 2:
            break
        degree = 2 if covered >= 6 and near.sum() >= 10 else 1
        fit = np.polyfit(along[near], depth[near], degree, w=np.sqrt(weight[near]))
    return _Side(sign * fit, middle, half, float(near.mean()))


def _strip_onsets(
    plane: _Plane, stripes: _Stripes, guess: list[_Side], side: int, out: float, inward: float, margin: float
) -> _Onsets:
    """Top and bottom: the first change of every strip, which is the screen's edge where its column is lit."""
    import cv2

    # The lit screen is brighter than its bezel, so light grows inwards; from a bright wall to the bezel it shrinks.
    products = stripes.growing if side == _TOP else stripes.shrinking
    rows, n = products.shape
    t = (np.arange(n, dtype=np.float64) + (1 + stripes.apart) / 2) * (stripes.strip * plane.fx) - 0.5
    # A change spans the lag; from outside, the lit row comes last at the top and first at the bottom.
    origin = plane.fy * ((_LAG - 0.5) if side == _TOP else 0.5)
    window, between = _window(guess, side, t, origin, plane.fy, out, inward, margin)
    if not window.t.size:
        return _no_onsets(plane.fy)
    first, last = _span(window.index, rows)
    smooth = cv2.blur(products[first:last], (3, 1))
    valid = (window.index >= 0) & (window.index < rows)
    energy = np.where(
        valid, smooth[np.clip(window.index, first, last - 1) - first, np.flatnonzero(between)[:, None]], 0
    )
    plateau = np.percentile(energy[:, window.outer :], 90, axis=1)
    level = np.maximum(max(8 * stripes.noise, 16 * stripes.floor, 2e-5), 0.06 * plateau)
    active = energy > level[:, None]
    depth = _half_way(energy, active.argmax(axis=1))
    place = window.place(depth.astype(np.float64))
    seen = active.any(axis=1) & _agrees(place, 2.5 * plane.fy)
    usable = seen & (depth > valid.argmax(axis=1) + 1)
    return _Onsets(window.t, place, seen, usable, seen & ~usable & valid[:, 0], plane.fy)


def _half_way(energy: FloatArray, start: NDArray[np.int64]) -> NDArray[np.int64]:
    """(K,) first place from `start` on where a change has half its later strength: the middle of a blurred edge."""
    ahead = start[:, None] + np.arange(2 * _LAG + 2)
    step = np.take_along_axis(energy, np.minimum(ahead, energy.shape[1] - 1), axis=1)
    return np.asarray(start + (step >= 0.25 * step.max(axis=1, keepdims=True)).argmax(axis=1), np.int64)


def _agrees(place: FloatArray, tolerance: float) -> BoolArray:
    """Places that two strips out of four close by share: noise stands alone."""
    padded = np.pad(place, 3, constant_values=np.inf)
    n = place.size
    close = [np.abs(padded[shift : shift + n] - place) <= tolerance for shift in (0, 1, 5, 6)]
    return np.asarray(np.sum(close, axis=0) >= 2, np.bool_)


def _band_onsets(
    plane: _Plane, stripes: _Stripes, guess: list[_Side], side: int, out: float, inward: float, margin: float
) -> _Onsets:
    """Left and right: where the energy of bands of rows begins and stays."""
    n_rows, apart = plane.light.shape[0] - _LAG, plane.apart(1)
    n_bands = int(np.clip(n_rows // _BAND_ROWS, 1, _BANDS))
    rows = n_rows // n_bands
    y = (np.arange(rows * n_bands) + (_LAG - 1) / 2) * float(plane.fy)
    # A product needs light on both its columns: the outermost one says where light begins.
    origin = -0.5 if side == _LEFT else plane.fx * (apart + 1) - 0.5
    window, between = _window(guess, side, y, origin, plane.fx, out, inward, -np.inf)
    n_columns = plane.light.shape[1] - apart
    if window.index.max() < 0 or window.index.min() >= n_columns:
        return _no_onsets(plane.fx)
    first, last = _span(window.index, n_columns)
    part = slice(first, last + apart)
    product, _ = _products(plane.light[:, part], apart, None if plane.wedge is None else plane.wedge[:, part])
    # Every row is taken along the slanted side, then bands of rows are summed.
    valid = (window.index >= first) & (window.index < last)
    column = np.clip(window.index, first, last - 1) - first
    values = np.where(valid, np.take_along_axis(product[: y.size], column, axis=1), 0).reshape(n_bands, rows, -1)
    energy, spread = values.mean(axis=1, dtype=np.float64), (values**2).mean(axis=1, dtype=np.float64)
    t = y.reshape(n_bands, rows).mean(axis=1)
    between = _between(guess, side, t, margin)
    bands = _Window(
        t, window.index.reshape(n_bands, rows, -1).mean(axis=1), window.outer, origin, plane.fx, window.sign
    )
    return _lasting_steps(energy, spread / rows, spread > 0, bands, between)


def _lasting_steps(
    energy: FloatArray, variance: FloatArray, valid: BoolArray, window: _Window, between: BoolArray
) -> _Onsets:
    """The first step of each segment's energy that is significant over some places."""
    box = 5
    n = energy.shape[1]
    plateau = np.percentile(energy[:, window.outer :], 90, axis=1)
    energy = energy - _row_noise(energy[:, : window.outer], 0.3 * plateau)[:, None]
    ahead, ahead_variance = _ahead(energy, box), _ahead(variance, box)
    least = np.maximum(0.05 * plateau, 2e-5)[:, None]
    rising = (ahead[:, :n] > least) & (ahead[:, :n] > 4.5 * np.sqrt(np.maximum(ahead_variance[:, :n], 0) / box))
    k, start = np.arange(len(energy)), rising.argmax(axis=1)
    level = ahead[k, start + box]
    active = (energy > level[:, None] / 2) & (np.arange(n) >= start[:, None]) & (level > 0)[:, None]
    seen = rising.any(axis=1) & active.any(axis=1)
    depth = active.argmax(axis=1)
    scale = np.where(seen, level, 1.0)
    covered = np.clip(energy[k, depth] / scale, 0, 1) + np.clip(energy[k, np.maximum(depth - 1, 0)] / scale, 0, 1)
    place = window.place(depth + 1 - covered)
    usable = seen & (depth > valid.argmax(axis=1) + 1)
    earlier = seen & ~usable & valid[:, 0]
    return _Onsets(window.t[between], place[between], seen[between], usable[between], earlier[between], window.step)


def _row_noise(outside: FloatArray, limit: FloatArray) -> FloatArray:
    """(K,) energy of the rows themselves: the median of what lies well outside, up to a limit."""
    return np.clip(np.median(outside[:, : max(outside.shape[1] // 2, 2)], axis=1), 0, np.maximum(limit, 0))


def _ahead(values: FloatArray, box: int) -> FloatArray:
    """(K, N + 2 box) mean of the `box` values from each place on; the last value goes on."""
    padded = np.pad(values.astype(np.float64), ((0, 0), (0, 3 * box)), mode="edge")
    total = np.cumsum(np.pad(padded, ((0, 0), (1, 0))), axis=1)
    return np.asarray((total[:, box:] - total[:, :-box]) / box)


def _span(index: NDArray[np.int64], n: int) -> tuple[int, int]:
    """First and last + 1 of the indices that exist."""
    first = int(np.clip(index.min(), 0, n - 1))
    return first, int(np.clip(index.max() + 1, first + 1, n))


def _no_onsets(step: float) -> _Onsets:
    nothing = np.zeros(0)
    return _Onsets(nothing, nothing, nothing > 0, nothing > 0, nothing > 0, step)


def _infer_side(sides: list[_Side], missing: int, plane: _Plane, aspect: float) -> _Side:
    """The side that a flat screen of known aspect has, from the three others: Gauss-Newton on its pose."""
    shown = [side for side in range(4) if side != missing]
    size = _extent(sides, plane) if missing in (_TOP, _BOTTOM) else _rise(sides, plane) * aspect
    roll = np.mean([sides[side].slope if side in (_TOP, _BOTTOM) else -sides[side].slope for side in shown])
    pose = np.array([0.0, 0.0, np.arctan(roll), *_rough_place(sides, missing, plane, size, aspect)])

    def residuals(pose: FloatArray) -> FloatArray:
        corners = _project(pose, plane, aspect)
        errors = []
        for side in shown:
            t = sides[side].middle + 0.8 * sides[side].half * np.array([-1.0, 1.0])
            errors.append((_straight(corners, side).at(t) - sides[side].at(t)) / (0.002 * size))
        return np.concatenate([*errors, pose[:2] / np.deg2rad(5)])

    for _ in range(12):
        error = residuals(pose)
        slopes = [(residuals(pose + delta) - error) / 1e-6 for delta in 1e-6 * np.eye(6)]
        pose = pose - np.linalg.lstsq(np.array(slopes).T, error, rcond=None)[0]
    side = _straight(_project(pose, plane, aspect), missing)
    return _Side(side.coefficients, side.middle, side.half, 0.0)


def _rise(sides: list[_Side], plane: _Plane) -> float:
    """Height of the screen in pixels, through the picture's middle."""
    middle = np.array(plane.width / 2)
    return abs(float(sides[_BOTTOM].at(middle) - sides[_TOP].at(middle)))


def _rough_place(sides: list[_Side], missing: int, plane: _Plane, size: float, aspect: float) -> FloatArray:
    """Offset of the screen's centre from the picture's (right, down) and log of its width, picture widths."""
    centre = []
    for low, high, extent, at in (
        (_LEFT, _RIGHT, size, plane.height / 2),
        (_TOP, _BOTTOM, size / aspect, plane.width / 2),
    ):
        place = [float(sides[side].at(np.array(at))) for side in (low, high)]
        if missing == low:
            place[0] = place[1] - extent
        if missing == high:
            place[1] = place[0] + extent
        centre.append((place[0] + place[1]) / 2)
    offset = (np.array(centre) - [plane.width / 2, plane.height / 2]) / plane.width
    return np.append(offset, np.log(size / plane.width))


def _project(pose: FloatArray, plane: _Plane, aspect: float) -> FloatArray:
    """(4, 2) corners of a screen: tilt, yaw, roll (rad), centre (picture widths from the middle), log width."""
    tilt, yaw, roll, right, down, width = pose
    x = np.array([-0.5, 0.5, 0.5, -0.5])
    y = np.array([-0.5, -0.5, 0.5, 0.5]) / aspect
    x, y = x * np.cos(roll) - y * np.sin(roll), x * np.sin(roll) + y * np.cos(roll)
    x, z = x * np.cos(yaw), x * np.sin(yaw)
    y, z = y * np.cos(tilt) - z * np.sin(tilt), y * np.sin(tilt) + z * np.cos(tilt)
    distance = _FOCAL_WIDTHS / np.exp(width)
    scale = _FOCAL_WIDTHS / (distance + z)
    u = (x + right * distance / _FOCAL_WIDTHS) * scale
    v = (y + down * distance / _FOCAL_WIDTHS) * scale
    return np.stack([u, v], axis=1) * plane.width + [plane.width / 2, plane.height / 2]


def _implausible(corners: FloatArray, plane: _Plane, aspect: float) -> str:
    """Why four corners cannot be a screen's; empty where they can."""
    edges = np.roll(corners, -1, axis=0) - corners
    following = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
    top, right, bottom, left = np.linalg.norm(edges, axis=1)
    ratio = (top + bottom) / (left + right) / aspect
    if not (turns > 0).all() or not (0.6 < top / bottom < 1.6 and 0.6 < left / right < 1.6):
        return "the stripes in the picture do not have the shape of a screen"
    if 0.8 < ratio * aspect**2 < 1.25:
        return "the screen stands upright in the picture, so its columns lie along the rows"
    if not 0.92 < ratio < 1.09:
        return f"the striped area is {ratio * aspect:.2f} times as wide as high, the screen {aspect:.2f} times"
    if (left + right) / 2 < 0.12 * plane.height:
        return f"the screen fills only {(left + right) / 2 / plane.height:.0%} of the picture's height"
    return ""


def _striped_share(stripes: _Stripes, corners: FloatArray, plane: _Plane) -> float:
    """Share of the coarse cells inside the corners that have stripes."""
    import cv2

    inside = np.zeros(stripes.striped.shape, np.uint8)
    cell = np.array([_CELL_STRIPS * stripes.strip * plane.fx, plane.cell_rows * plane.fy])
    cv2.fillConvexPoly(inside, np.round(corners / cell - 0.5).astype(np.int32), 1)
    return float(stripes.striped[inside > 0].mean()) if inside.any() else 0.0
