"""Plane and outlines to row profiles: the mean linear light of every strip on every row, with its noise.

Encoded values are averaged and the mean is linearised. Under a power law this changes the brightness of a textured
strip, but not how its light changes from row to row. Room light and the linear part of the tone curve add an error too
small to cost packets.
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import NORMAL_MEDIAN
from rxcli.types import Float32Array, FloatArray, Frame, LightPlane, Outlines, RowProfiles

#: Width of a strip in pixels from which a column is divided further, and maximum number of strips of a column.
_STRIP_PX, _MAX_STRIPS = 12, 8
#: The noise model compares neighbouring parts of a strip, because denoising correlates neighbouring pixels: parts per
#: strip, rows it is fitted to, and bins of equal light.
_PARTS_PER_STRIP, _NOISE_ROWS, _NOISE_BINS = 4, 20, 24
#: Row spacing at which the pixels of a strip are counted.
_COUNT_ROW_STEP = 16
#: Minimum distance of two edges, in cells, at which light is measured between them.
_MIN_ENCLOSED = 0.02
#: Steps of a tone curve's table.
_TONE_STEPS = 1 << 16


def strips_per_column(column_px: float) -> int:
    """Lateral strips for columns of `column_px` pixels."""
    return int(np.clip(column_px // _STRIP_PX, 1, _MAX_STRIPS))


def tone_to_light(tone: str, encoded: FloatArray) -> FloatArray:
    """Linear light of developed values, both in 0..1.

    Args:
        tone: "linear", "srgb" (IEC 61966-2-1) or "bt709" (ITU-R BT.709-6, section 1.2).
        encoded: values, 0 black and 1 white.
    """
    if tone == "linear":
        return encoded
    if tone == "srgb":
        return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    if tone == "bt709":
        return np.where(encoded < 0.081, encoded / 4.5, ((encoded + 0.099) / 1.099) ** (1 / 0.45))
    raise ValueError(f"tone must be linear, srgb or bt709 (got {tone!r})")


def sample_rows(plane: LightPlane, outlines: Outlines, tone: str) -> RowProfiles:
    """Mean linear light of every strip on every row.

    Args:
        plane: of the picture.
        outlines: where the strips lie.
        tone: the curve to undo, see `tone_to_light`; a mosaic is linear already.
    """
    edges = np.clip((outlines.edges_x + np.float32(0.5)) / np.float32(plane.cell_px), 0, len(plane.sums) - 1)
    light = np.diff(_sums_at(plane.sums, edges, int(outlines.rows[0])), axis=0)
    widths = np.diff(edges, axis=0) * np.float32(plane.cell_px)
    enclosed = np.abs(widths)
    widths[enclosed <= _MIN_ENCLOSED * plane.cell_px] = np.inf
    light /= widths
    inside = outlines.inside
    light = light_of(plane, light, tone).reshape(inside.shape)
    light *= inside
    count = np.median(enclosed[:, ::_COUNT_ROW_STEP], axis=1)
    cells = max(int(np.median(count) / (_PARTS_PER_STRIP * plane.cell_px)), 1)
    rows = slice(int(outlines.rows[0]), int(outlines.rows[-1]) + 1)
    sums = plane.sums[int(edges.min()) : int(edges.max()) + 2 : cells, rows]
    noise_floor, noise_slope = _noise_model(plane, sums, cells * plane.cell_px, tone)
    return RowProfiles(
        light=light,
        inside=inside,
        rows=outlines.rows,
        sensor_row=outlines.sensor_row,
        count=count.reshape(inside.shape[:2]),
        noise_floor=noise_floor,
        noise_slope=noise_slope,
    )


def _sums_at(sums: Float32Array, edges: Float32Array, first_row: int) -> Float32Array:
    """Interpolate running sums (N + 1, R) linearly at edges (n, rows), in cells; `first_row` is the first of R used."""
    height, flat = sums.shape[1], sums.ravel()
    place = np.minimum(edges, np.float32(len(sums) - 2)).astype(np.intp)
    part = np.subtract(edges, place, dtype=np.float32)
    place *= height
    place += np.arange(first_row, first_row + edges.shape[1])
    left = flat.take(place)
    place += height
    right = flat.take(place)
    right -= left
    right *= part
    left += right
    return left


def light_of_levels(frame: Frame, steps: int, to_light: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Linear light of every value that a pixel can have, in `steps` steps a level."""
    values = np.arange(np.iinfo(frame.pixels.dtype).max * steps + 1, dtype=np.float64) / steps
    encoded = np.clip((values - frame.black) / (frame.white - frame.black), 0, 1)
    return encoded if frame.linear else to_light(encoded)


def light_of(plane: LightPlane, values: Float32Array, tone: str) -> Float32Array:
    """Linear light of mean values."""
    encoded = (values - np.float32(plane.black)) * np.float32(1 / (plane.white - plane.black))
    if plane.is_linear or tone == "linear":
        return encoded
    encoded *= np.float32(_TONE_STEPS)
    return _tone_table(tone).take((encoded + np.float32(0.5)).astype(np.intp), mode="clip")


def encode(light: Float32Array) -> Float32Array:
    """Values 0..1 of the sRGB curve whose light is given; light below 0 and above 1 is cut off."""
    return _srgb_table().take((light * np.float32(_TONE_STEPS) + np.float32(0.5)).astype(np.intp), mode="clip")


@lru_cache(maxsize=1)
def _srgb_table() -> Float32Array:
    steps = np.arange(_TONE_STEPS + 1) / _TONE_STEPS
    return np.interp(steps, tone_to_light("srgb", steps), steps).astype(np.float32)


@lru_cache(maxsize=4)
def _tone_table(tone: str) -> Float32Array:
    return tone_to_light(tone, np.arange(_TONE_STEPS + 1) / _TONE_STEPS).astype(np.float32)


def _noise_model(plane: LightPlane, sums: Float32Array, part_px: int, tone: str) -> tuple[float, float]:
    """Variance of a pixel as floor + slope * light, from differences of adjacent parts of strips, `part_px` wide.

    Medians over bins of equal light ignore the picture's edges. The model is a straight line through the bins, with
    floor and slope at least zero.
    """
    every = max(sums.shape[1] // _NOISE_ROWS, 1)
    parts = light_of(plane, np.diff(sums[:, every // 2 :: every], axis=0) / np.float32(part_px), tone)
    if parts.shape[0] < 2:
        return 1e-6 * part_px, 0.0
    difference = np.abs(np.diff(parts, axis=0)).ravel()
    light = ((parts[1:] + parts[:-1]) / 2).ravel()
    n_bins = min(_NOISE_BINS, max(1, light.size // 50))
    # Bins of equal counts; the few brightest samples left over do not matter.
    bins = np.argsort(light)[: light.size // n_bins * n_bins].reshape(n_bins, -1)
    x = np.median(light[bins], axis=1)
    # For a normal difference of two parts of variance s2: median |d| = NORMAL_MEDIAN sqrt(2 s2).
    y = np.median(difference[bins], axis=1) ** 2 / (2 * NORMAL_MEDIAN**2)
    return _floor_and_slope(x, part_px * y)


def _floor_and_slope(x: NDArray[np.floating], y: NDArray[np.floating]) -> tuple[float, float]:
    """Line through bins of light and variance: slope by a median over pairs, weighted by their distance."""
    run, rise = x[:, None] - x, y[:, None] - y
    is_distinct = run > 1e-4
    slopes, weights = rise[is_distinct] / run[is_distinct], run[is_distinct]
    order = np.argsort(slopes)
    reached = np.cumsum(weights[order])
    slope = float(slopes[order[np.searchsorted(reached, reached[-1] / 2)]]) if order.size else 0.0
    slope = max(slope, 0.0)
    dark = slice(0, max(1, y.size // 4))
    return float(max((y[dark] - slope * x[dark]).mean(), 1e-10)), slope
