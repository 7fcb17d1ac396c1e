"""Frame and outlines to row profiles: the one pass over the pixels.

Light is linearised pixel by pixel, averaged over cells of a few pixels along each row, and the cells are summed between
the slanted edges of every strip. A mosaic is read without demosaicing: each row's pixels are weighted so that every row
measures the same mix of red, green and blue.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Protocol, cast

import numpy as np
from numpy.typing import NDArray

from rxcli.types import Float32Array, FloatArray, Frame, Mosaic, Outlines, RowProfiles

#: Pixels that a strip should have before a column gets another one.
_STRIP_PX = 12
_MAX_STRIPS = 8
#: Cells that a strip should have, so that the fractions at its slanted edges are fine.
_CELLS_PER_STRIP = 4
#: Rows read at a time: what fits the cache; a multiple of the next.
_BAND_ROWS = 192
#: One row in this many is kept for the noise model, and of those as many as hold this many cells.
_NOISE_ROW_STEP = 16
_NOISE_CELLS = 10_000
#: OpenCV and NumPy work outside the interpreter's lock.
_THREADS = 2
_NOISE_BINS = 24
#: Edges that enclose less than this have no light between them, cells.
_LEAST_CELLS = 0.1


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
    reader = _reader(frame, strip_px, tone, edges)
    n_rows = outlines.rows.size
    light = np.empty((edges.shape[0] - 1, n_rows), np.float32)
    enclosed = np.empty_like(light)

    def read_band(start: int) -> Float32Array:
        stop = min(start + _BAND_ROWS, n_rows)
        cells = reader.read(int(outlines.rows[start]), int(outlines.rows[stop - 1]) + 1)
        positions = (edges[:, start:stop] - np.float32(reader.first_x - 0.5)) * np.float32(1 / reader.cell_px)
        light[:, start:stop], enclosed[:, start:stop] = _between_edges(cells, positions)
        return cells[::_NOISE_ROW_STEP].copy()

    with ThreadPoolExecutor(_THREADS) as pool:
        noise_cells = list(pool.map(read_band, range(0, n_rows, _BAND_ROWS)))
    floor, slope = _noise_model(np.concatenate(noise_cells))
    inside = outlines.inside
    light = light.reshape(inside.shape)
    light *= inside
    count = np.median(enclosed[:, ::_NOISE_ROW_STEP], axis=1).reshape(inside.shape[:2]) * reader.cell_px
    return RowProfiles(
        light=light,
        inside=inside,
        rows=outlines.rows,
        sensor_row=outlines.sensor_row,
        count=count.astype(np.float32),
        noise_floor=floor * reader.cell_px,
        noise_slope=slope * reader.cell_px,
    )


class _Reader(Protocol):
    """Reads rows of a frame as cells: mean light of runs of `cell_px` pixels, from the column `first_x` on."""

    cell_px: int
    first_x: int

    def read(self, first: int, last: int) -> Float32Array:
        """(last - first, cells) light of the rows `first` to `last`, not included."""


def _reader(frame: Frame, strip_px: float, tone: str, edges: Float32Array) -> _Reader:
    if frame.mosaic is not None:
        return _MosaicReader(frame, frame.mosaic, edges)
    return _DevelopedReader(frame, int(np.clip(strip_px // _CELLS_PER_STRIP, 1, min(16, frame.width))), tone, edges)


def _screen_columns(edges: Float32Array, width: int, cell_px: int) -> slice:
    """The whole cells of a row that the screen reaches into."""
    n_cells = width // cell_px
    first = int(np.clip(edges.min() // cell_px, 0, n_cells - 1))
    last = int(np.clip((edges.max() + 1) // cell_px + 1, first + 1, n_cells))
    return slice(first * cell_px, last * cell_px)


class _DevelopedReader:
    """Cells of a developed picture, its tone curve undone pixel by pixel."""

    def __init__(self, frame: Frame, cell_px: int, tone: str, edges: Float32Array) -> None:
        columns = _screen_columns(edges, frame.width, cell_px)
        self.cell_px, self.first_x = cell_px, int(columns.start)
        self._table = _light_table(frame, "linear" if frame.linear else tone)
        self._pixels = frame.pixels[:, columns]

    def read(self, first: int, last: int) -> Float32Array:
        import cv2

        band = self._pixels[first:last]
        light = cv2.LUT(band, self._table) if band.dtype == np.uint8 else self._table[band]
        size = (band.shape[1] // self.cell_px, band.shape[0])
        return np.asarray(cv2.resize(light, size, interpolation=cv2.INTER_AREA))


class _MosaicReader:
    """Cells of a mosaic, one period of the colour filter array long."""

    def __init__(self, frame: Frame, mosaic: Mosaic, edges: Float32Array) -> None:
        self._weights, self._offsets, self._smooth = _mosaic_weights(mosaic)
        self.cell_px = int(self._weights.shape[1])
        columns = _screen_columns(edges, frame.width, self.cell_px)
        self.first_x = int(columns.start)
        self._pixels = frame.pixels[:, columns]

    def read(self, first: int, last: int) -> Float32Array:
        if not self._smooth:
            return self._rows(first, last)
        top, bottom = max(first - 1, 0), min(last + 1, self._pixels.shape[0])
        return _smooth_rows(self._rows(top, bottom))[first - top : last - top]

    def _rows(self, first: int, last: int) -> Float32Array:
        period = self._weights.shape[0]
        n_cells = self._pixels.shape[1] // self.cell_px
        out = np.empty((last - first, n_cells), np.float32)
        for start in range(min(period, last - first)):
            phase = (first + start) % period
            runs = self._pixels[first + start : last : period].astype(np.float32).reshape(-1, self.cell_px)
            out[start::period] = (runs @ self._weights[phase] - self._offsets[phase]).reshape(-1, n_cells)
        return out


def _light_table(frame: Frame, tone: str) -> Float32Array:
    """Light of every pixel value; float32, one entry a value."""
    values = np.arange(np.iinfo(frame.pixels.dtype).max + 1, dtype=np.float64)
    encoded = np.clip((values - frame.black) / (frame.white - frame.black), 0, 1)
    return tone_to_light(tone, encoded).astype(np.float32)


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
        Float32Array, cv2.sepFilter2D(values, -1, np.ones(1, np.float32), kernel, borderType=cv2.BORDER_REFLECT_101)
    )


def _between_edges(cells: Float32Array, edges: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Means of `cells` (rows, n) between neighbouring `edges` (n_edges, rows), in cells from the left border.

    Returns:
        (n_edges - 1, rows) float32: means, 0 where the edges enclose less than a tenth of a cell; and cells enclosed.
    """
    import cv2

    n = cells.shape[1]
    # Running sums of each row. Over a thousand cells they are exact to 6e-5 of white in float32, far below noise.
    area = cv2.integral(cells, sdepth=cv2.CV_64F)
    total = np.subtract(area[1:], area[:-1]).astype(np.float32)
    position = np.clip(edges, 0, n)
    left = np.minimum(position, np.float32(n - 1)).astype(np.intp)
    part = np.subtract(position, left, dtype=np.float32)
    left += np.arange(0, total.size, n + 1)
    at_edge = total.take(left)
    left += 1
    at_edge += (total.take(left) - at_edge) * part
    light, widths = np.diff(at_edge, axis=0), np.diff(position, axis=0)
    enclosed = np.abs(widths)
    widths[enclosed <= _LEAST_CELLS] = np.inf
    light /= widths
    return light, enclosed


def _noise_model(cells: Float32Array) -> tuple[float, float]:
    """Variance of a cell as floor + slope * light, from differences of adjacent cells.

    Medians over bins of equal light ignore the picture's edges; a straight line through the bins with floor and slope
    not below zero.
    """
    if cells.shape[1] < 2:
        return 1e-6, 0.0
    rows = cells[:: max(1, cells.size // _NOISE_CELLS)]
    difference = np.abs(np.diff(rows, axis=1)).ravel()
    light = ((rows[:, 1:] + rows[:, :-1]) / 2).ravel()
    n_bins = min(_NOISE_BINS, max(1, light.size // 50))
    # Bins of equal numbers; the few brightest that are left over do not matter.
    bins = np.argsort(light)[: light.size // n_bins * n_bins].reshape(n_bins, -1)
    x = np.median(light[bins], axis=1)
    # For a normal difference of two cells of variance s2: median |d| = 0.6745 sqrt(2 s2).
    y = np.median(difference[bins], axis=1) ** 2 / (2 * 0.6745**2)
    return _floor_and_slope(x, y)


def _floor_and_slope(x: NDArray[np.floating], y: NDArray[np.floating]) -> tuple[float, float]:
    """Line through bins of light and variance: slope by a median over pairs, weighted by their distance."""
    run, rise = x[:, None] - x, y[:, None] - y
    apart = run > 1e-4
    slopes, weights = rise[apart] / run[apart], run[apart]
    order = np.argsort(slopes)
    reached = np.cumsum(weights[order])
    slope = float(slopes[order[np.searchsorted(reached, reached[-1] / 2)]]) if order.size else 0.0
    slope = max(slope, 0.0)
    dark = slice(0, max(1, y.size // 4))
    return float(max((y[dark] - slope * x[dark]).mean(), 1e-10)), slope
