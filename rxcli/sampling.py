"""Frame and outlines to row profiles: the one pass over the pixels.

Light is linearised pixel by pixel, averaged over cells of a few pixels along each row, and the cells are summed between
the slanted edges of every strip. A mosaic is read without demosaicing: each row's pixels are weighted so that every row
measures the same mix of red, green and blue.
"""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import NDArray

from rxcli.types import BoolArray, Float32Array, FloatArray, Frame, Mosaic, Outlines, RowProfiles

#: Scale of linear light in 16-bit cells; headroom is not needed, values are clipped at white.
_FULL = 65535.0
#: Pixels that a strip should have before a column gets another one.
_STRIP_PX = 12
_MAX_STRIPS = 8
#: Cells that a strip should have, so that the fractions at its slanted edges are fine.
_CELLS_PER_STRIP = 4
#: Rows converted at a time: what fits the cache.
_BAND_ROWS = 64
#: One row in this many is read for the noise model.
_NOISE_ROW_STEP = 16
_NOISE_BINS = 24


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


def sample_rows(frame: Frame, outlines: Outlines, tone: str) -> RowProfiles:
    """Mean linear light of every strip on every row.

    Args:
        frame: the picture.
        outlines: where the strips lie.
        tone: the curve to undo, see `tone_to_light`; a mosaic is linear already.
    """
    edges = outlines.edges_x
    strip_px = float(np.median(np.abs(np.diff(edges[:, edges.shape[1] // 2]))))
    first, last = int(outlines.rows[0]), int(outlines.rows[-1]) + 1
    cells, cell_px = _cells(frame, first, last, strip_px, tone)
    light, n_cells = _between_edges(cells, (edges + 0.5) / cell_px)
    inside = outlines.inside
    light = light.reshape(inside.shape) * inside
    n_cells = n_cells.reshape(inside.shape)
    floor, slope = _noise_model(cells)
    return RowProfiles(
        light=light,
        inside=inside,
        rows=outlines.rows,
        sensor_row=outlines.sensor_row,
        count=np.median(n_cells[:, :, ::_NOISE_ROW_STEP], axis=2) * cell_px,
        noise_floor=floor * cell_px,
        noise_slope=slope * cell_px,
    )


def _cells(frame: Frame, first: int, last: int, strip_px: float, tone: str) -> tuple[Float32Array, int]:
    """Mean light of runs of `cell_px` pixels of the rows `first` to `last`; (rows, cells) float32."""
    if frame.mosaic is not None:
        return _mosaic_cells(frame, frame.mosaic, first, last)
    cell_px = int(np.clip(strip_px // _CELLS_PER_STRIP, 1, 16))
    return _developed_cells(frame, first, last, cell_px, tone), cell_px


def _developed_cells(frame: Frame, first: int, last: int, cell_px: int, tone: str) -> Float32Array:
    import cv2

    table = _light_table(frame, "linear" if frame.linear else tone)
    width = frame.width // cell_px * cell_px
    out = np.empty((last - first, width // cell_px), np.float32)
    for top in range(first, last, _BAND_ROWS):
        band = frame.pixels[top : min(top + _BAND_ROWS, last), :width]
        light = cv2.LUT(band, table) if band.dtype == np.uint8 else table[band]
        size = (out.shape[1], band.shape[0])
        out[top - first : top - first + band.shape[0]] = cv2.resize(light, size, interpolation=cv2.INTER_AREA)
    return out


def _light_table(frame: Frame, tone: str) -> Float32Array:
    """Light of every pixel value; float32, one entry a value."""
    values = np.arange(np.iinfo(frame.pixels.dtype).max + 1, dtype=np.float64)
    encoded = np.clip((values - frame.black) / (frame.white - frame.black), 0, 1)
    return tone_to_light(tone, encoded).astype(np.float32)


def _mosaic_cells(frame: Frame, mosaic: Mosaic, first: int, last: int) -> tuple[Float32Array, int]:
    weights, offsets, smooth = _mosaic_weights(mosaic)
    period_y, cell_px = weights.shape
    n_cells = frame.width // cell_px
    out = np.empty((last - first, n_cells), np.float32)
    for phase in range(period_y):
        start = (phase - first) % period_y
        band = frame.pixels[first + start : last : period_y, : n_cells * cell_px]
        if band.shape[0]:
            runs = band.astype(np.float32).reshape(-1, cell_px)
            out[start::period_y] = (runs @ weights[phase] - offsets[phase]).reshape(-1, n_cells)
    return (_smooth_rows(out) if smooth else out), cell_px


def _mosaic_weights(mosaic: Mosaic) -> tuple[Float32Array, Float32Array, bool]:
    """Weights (period_y, cell_px) and offsets (period_y,) that make each row measure the same mix of the colours.

    Green counts most, red and blue by the inverse square of their gains, which is near the best signal to noise. A row
    that lacks a colour (Bayer) cannot measure the mix: its mean is taken as it is, and rows are then smoothed so that
    each holds both kinds, at the price of one row of blur.
    """
    pattern = mosaic.pattern
    present = np.stack([(pattern == colour).sum(axis=1) for colour in range(3)], axis=1)
    complete = bool((present > 0).all())
    mix = 1 / np.maximum(np.array(mosaic.gains), 1.0) ** 2
    share = mix / mix.sum() / np.maximum(present, 1) if complete else np.full(present.shape, 1 / pattern.shape[1])
    black = np.array(mosaic.black)
    weights = share[np.arange(pattern.shape[0])[:, None], pattern] / (mosaic.white - black.mean())
    offsets = (weights * black[pattern]).sum(axis=1)
    return weights.astype(np.float32), offsets.astype(np.float32), not complete


def _smooth_rows(values: Float32Array) -> Float32Array:
    import cv2

    kernel = np.array([0.25, 0.5, 0.25], np.float32)
    return cast(
        Float32Array, cv2.sepFilter2D(values, -1, np.ones(1, np.float32), kernel, borderType=cv2.BORDER_REFLECT)
    )


def _between_edges(cells: Float32Array, edges: FloatArray) -> tuple[Float32Array, Float32Array]:
    """Means of `cells` (rows, n) between neighbouring `edges` (n_edges, rows), in cells from the left border.

    Returns:
        (n_edges - 1, rows) float32: means, 0 where the edges enclose less than a tenth of a cell; and cells enclosed.
    """
    n_rows, n = cells.shape
    total = np.zeros((n_rows, n + 1))
    np.cumsum(cells, axis=1, out=total[:, 1:])
    position = np.clip(edges, 0, n)
    left = np.minimum(position.astype(np.int64), n - 1)
    flat = left + np.arange(n_rows) * (n + 1)
    below = total.ravel()[flat]
    at_edge = below + (total.ravel()[flat + 1] - below) * (position - left)
    widths = np.diff(position, axis=0)
    enclosed = np.abs(widths)
    sums = np.diff(at_edge, axis=0)
    light = np.divide(sums, widths, out=np.zeros_like(sums), where=enclosed > 0.1)
    return light.astype(np.float32), enclosed.astype(np.float32)


def _noise_model(cells: Float32Array) -> tuple[float, float]:
    """Variance of a cell as floor + slope * light, from differences of adjacent cells.

    Medians over bins of equal light ignore the picture's edges; a straight line through the bins with floor and slope
    not below zero.
    """
    rows = cells[::_NOISE_ROW_STEP]
    if rows.shape[1] < 2:
        return 1e-6, 0.0
    difference = np.abs(np.diff(rows, axis=1)).ravel()
    light = ((rows[:, 1:] + rows[:, :-1]) / 2).ravel()
    order = np.argsort(light)
    n_bins = min(_NOISE_BINS, max(1, light.size // 50))
    bins = np.array_split(order, n_bins)
    x = np.array([np.median(light[part]) for part in bins])
    # For a normal difference of two cells of variance s2: median |d| = 0.6745 sqrt(2 s2).
    y = np.array([np.median(difference[part]) for part in bins]) ** 2 / (2 * 0.6745**2)
    return _floor_and_slope(x, y)


def _floor_and_slope(x: NDArray[np.floating], y: NDArray[np.floating]) -> tuple[float, float]:
    floor = float(max(y[: max(1, y.size // 4)].mean(), 1e-10))
    excess = x - x[0]
    slope = float(np.median(np.divide(y - floor, excess, out=np.zeros_like(y), where=excess > 1e-4)))
    return floor, max(slope, 0.0)


def lit_share(inside: BoolArray) -> float:
    """Share of strip rows that lie on the screen and in the picture."""
    return float(inside.mean()) if inside.size else 0.0
