"""The map of stripe energy, and the coarse outline of where there is any."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.receiver.screen.picture import Plane
from rxcli.receiver.screen.sides import BOTTOM, INWARD, TOP, TURN, Line, Side, across, outermost_line
from rxcli.types import BoolArray, Float32Array, FloatArray

#: Rows of the reduced plane between the two lights of a change: some slots at the top rate, about one at the lowest.
LAG = 5
#: Strips in one coarse cell.
_CELL_STRIPS = 4
#: Largest slope of a side, and its largest deviation from the others' when they are turned onto it.
_MAX_SLOPE, MAX_SKEW = 0.25, 0.13
#: A segment that begins outside a line counts this often against it, so that the outermost line wins with a sixth.
OUTSIDE_COST = 6.0
#: In an area of stripes, changes down the rows have at least this many times the energy of those along them.
_LYING = 1.6
#: Least share of the picture with stripes.
_MIN_STRIPED = 0.02


@dataclass(frozen=True, slots=True)
class Stripes:
    """Stripe energy of a plane."""

    #: (R - lag, strips - apart) products of the changes of two strips, where these grow and where they shrink.
    growing: Float32Array
    shrinking: Float32Array
    #: (rows, columns) of coarse cells that have stripes.
    striped: BoolArray
    #: Picture pixels of a cell, (x, y).
    cell_px: FloatArray
    #: Energy that the whole picture has: row noise of the sensor.
    floor: float
    #: Standard deviation of one product without light.
    noise: float

    def share_inside(self, corners: FloatArray) -> float:
        """Share of the coarse cells inside the corners that have stripes."""
        import cv2

        inside = np.zeros(self.striped.shape, np.uint8)
        cv2.fillConvexPoly(inside, np.round(corners / self.cell_px - 0.5).astype(np.int32), 1)
        return float(self.striped[inside > 0].mean()) if inside.any() else 0.0


def products(light: Float32Array, wedge: BoolArray | None, apart: int) -> tuple[Float32Array, BoolArray]:
    """Change over the lag, times the same change `apart` columns further; and where light grows down the rows."""
    change = light[LAG:] - light[:-LAG]
    product = np.asarray(change[:, apart:] * change[:, :-apart], np.float32)
    if wedge is not None:
        touched = wedge[LAG:] | wedge[:-LAG]
        product[touched[:, apart:] | touched[:, :-apart]] = 0
    return product, change[:, :-apart] > 0


def _area(values: Float32Array, columns: int, rows: int) -> Float32Array:
    """Block means."""
    import cv2

    return np.asarray(cv2.resize(values, (columns, rows), interpolation=cv2.INTER_AREA), np.float32)


def find_stripes(plane: Plane) -> Stripes:
    """The map of stripe energy."""
    import cv2

    product, grows = products(plane.light, plane.wedge, plane.apart)
    growing = product * grows
    shape = (product.shape[1] // _CELL_STRIPS, product.shape[0] // plane.cell_rows)
    inner = (slice(shape[1] * plane.cell_rows), slice(shape[0] * _CELL_STRIPS))
    cells = _area(product[inner], *shape)
    smooth = cv2.blur(cells, (3, 3))
    smooth = smooth * _balance(cells, _area(growing[inner], *shape))
    spread = np.maximum(cv2.blur(_area(product[inner] ** 2, *shape), (3, 3)), 0)
    strong = float(np.percentile(smooth, 92))
    # Row noise is alike along a row: what even the stillest tenth of a row of cells has, within its limits.
    still = np.maximum(np.percentile(smooth, 10, axis=1), 0)
    floor = min(float(np.percentile(still, 10)), 0.1 * strong)
    smooth = smooth - np.minimum(still, 3 * floor)[:, None].astype(np.float32)
    noise = float(np.sqrt(max(np.percentile(spread, 10), 0) / 3))
    significant = smooth > 1.5 * np.sqrt(spread / (plane.cell_rows * _CELL_STRIPS))
    threshold = max(0.02 * strong, floor, 1e-4)
    along = plane.light[:, 1:] - plane.light[:, :-1]
    upright = _area((along[LAG:] * along[:-LAG])[inner], *shape)
    # What a cell lacks altogether its neighbours cannot lend it.
    own = cells > 0.3 * threshold
    striped = _large_areas((smooth > threshold) & significant & own, cells, upright)
    cell_px = np.array([_CELL_STRIPS * plane.fx, plane.cell_rows * plane.fy], np.float64)
    return Stripes(growing, product - growing, striped, cell_px, floor, noise)


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
    good = (count >= max(12, 0.03 * count[1:].max(initial=0))) & (down > _LYING * along)
    good[0] = False
    return np.asarray(good[label], np.bool_)


def coarse_sides(plane: Plane, stripes: Stripes) -> list[Side] | None:
    """A line along each side of the striped area; None where there is no such area."""
    rows, columns = stripes.striped.shape
    if stripes.striped.mean() < _MIN_STRIPED:
        return None
    step_x, step_y = stripes.cell_px
    y = (np.arange(rows, dtype=np.float64) + 0.5) * step_y + plane.fy * (LAG - 1) / 2
    x = (np.arange(columns, dtype=np.float64) + 0.5) * step_x + plane.fx * plane.apart / 2 - 0.5
    onsets = [_cell_onsets(stripes.striped, x, y, side) for side in range(4)]
    steps = (step_y, step_x) * 2
    lines = [_cell_line(*o, step, 0.0, _MAX_SLOPE) for o, step in zip(onsets, steps, strict=True)]
    # A side that is half black can be led astray; turned by a right angle the four slopes are nearly one.
    turned = np.array([TURN[side] * line.slope for side, line in enumerate(lines) if line is not None])
    if turned.size < 4:
        return None
    level = turned[[TOP, BOTTOM]]
    roll = float(level.mean() if np.ptp(level) < MAX_SKEW else np.median(turned))
    sides = []
    for side, (places, step) in enumerate(zip(onsets, steps, strict=True)):
        line = _cell_line(*places, step, TURN[side] * roll, MAX_SKEW)
        if line is None:
            return None
        sides.append(Side(INWARD[side] * np.array([line.slope, line.start]), 0.0, 1.0, line.support))
    return sides


def _cell_line(
    t: FloatArray, depth: FloatArray, observed: BoolArray, step: float, slope: float, spread: float
) -> Line | None:
    return outermost_line(
        t,
        depth,
        observed.astype(np.float64),
        observed,
        1.2 * step,
        slope=slope,
        spread=spread,
        outside_cost=OUTSIDE_COST,
    )


def _cell_onsets(
    striped: BoolArray, x: FloatArray, y: FloatArray, side: int
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Across a side: place along it, depth where striped cells begin and last, and where there are any."""
    mask, t, place = (striped.T, x, y) if across(side) else (striped, y, x)
    mask = mask[:, :: INWARD[side]]
    following = np.pad(mask, ((0, 0), (0, 3))).astype(np.int64)
    lasting = mask & (following[:, 1:-2] + following[:, 2:-1] + following[:, 3:] >= 2)
    first = place[:: INWARD[side]][lasting.argmax(axis=1)]
    depth = INWARD[side] * first - (place[1] - place[0]) / 2
    return t, np.asarray(depth, np.float64), np.asarray(np.any(lasting, axis=1), np.bool_)
