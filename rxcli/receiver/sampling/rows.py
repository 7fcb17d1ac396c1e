"""Frame and outlines to row profiles: the one pass over the pixels.

Light is linearised pixel by pixel, averaged over cells of a few pixels along each row, and the cells are summed between
the slanted edges of every strip. A mosaic is read without demosaicing: each row's pixels are weighted so that every row
measures the same mix of red, green and blue.

For a quick look at a developed picture the coded values are averaged and the mean is linearised, which takes half the
time. Under a power law that changes how bright a textured strip is, but not how its light changes from row to row; room
light and the straight part of the tone curve make it a little worse, so it serves where no doubt is left after it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from rxcli.receiver.sampling.settings import SETTINGS
from rxcli.types import Float32Array, FloatArray, Frame, Mosaic, Outlines, RowProfiles

#: Pixels read at a time: what fits the cache.
_BAND_PIXELS = 900_000
#: Fewer bands than these are read sooner than threads for them are started.
_MANY_BANDS = 4
#: Places of the finer table for means of coded values, per value.
_FINE_STEPS = 64


def strips_per_column(column_px: float) -> int:
    """Lateral strips for columns of `column_px` pixels."""
    return int(np.clip(column_px // SETTINGS.strip_px, 1, SETTINGS.max_strips))


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


def is_coded(frame: Frame) -> bool:
    """Whether pixels hold coded values of 8 bits, of which there is a quick look."""
    return frame.mosaic is None and frame.pixels.dtype == np.uint8 and not frame.linear


def sample_rows(
    frame: Frame, outlines: Outlines, tone: str, *, quick: bool = False, noise: tuple[float, float] | None = None
) -> RowProfiles:
    """Mean linear light of every strip on every row.

    Args:
        frame: the picture.
        outlines: where the strips lie.
        tone: the curve to undo, see `tone_to_light`; a mosaic is linear already.
        quick: linearise means, not pixels, where the frame `is_coded`.
        noise: floor and slope of the noise model, where they are known.
    """
    edges = outlines.edges_x
    reader = _reader(frame, edges, tone, quick=quick)
    n_rows = outlines.rows.size
    # Bands begin at rows of the noise model.
    band_rows = max(_BAND_PIXELS // reader.width // SETTINGS.noise_row_step, 1) * SETTINGS.noise_row_step
    light = np.empty((edges.shape[0] - 1, n_rows), np.float32)
    enclosed = np.empty_like(light)

    def read_band(start: int) -> Float32Array:
        band = slice(start, min(start + band_rows, n_rows))
        first, last = int(outlines.rows[band.start]), int(outlines.rows[band.stop - 1]) + 1
        light[:, band], enclosed[:, band], noise_cells = reader.read(first, last, edges[:, band])
        return noise_cells

    bands = range(0, n_rows, band_rows)
    if len(bands) < _MANY_BANDS or reader.threads == 1:
        noise_cells = [read_band(band) for band in bands]
    else:
        with ThreadPoolExecutor(reader.threads) as pool:
            noise_cells = list(pool.map(read_band, bands))
    floor, slope = noise or _noise_model(np.concatenate(noise_cells), reader.cell_px)
    inside = outlines.inside
    light = light.reshape(inside.shape)
    light *= inside
    return RowProfiles(
        light=light,
        inside=inside,
        rows=outlines.rows,
        sensor_row=outlines.sensor_row,
        count=np.median(enclosed[:, :: SETTINGS.noise_row_step], axis=1).reshape(inside.shape[:2]),
        noise_floor=floor,
        noise_slope=slope,
    )


def _reader(frame: Frame, edges: Float32Array, tone: str, *, quick: bool) -> _Reader:
    if frame.mosaic is not None:
        return _MosaicReader(frame, edges, frame.mosaic)
    return (_CodedReader if quick and is_coded(frame) else _DevelopedReader)(frame, edges, tone)


class _Reader(ABC):
    """Reads rows of a frame by way of cells: mean light of runs of `cell_px` pixels."""

    #: OpenCV and NumPy work outside the interpreter's lock.
    threads = 2

    def __init__(self, frame: Frame, edges: Float32Array, cell_px: int) -> None:
        self.cell_px = cell_px
        n_cells = frame.width // cell_px
        first = int(np.clip(edges.min() // cell_px, 0, n_cells - 1))
        last = int(np.clip((edges.max() + 1) // cell_px + 1, first + 1, n_cells))
        #: The cells that the screen reaches into, and where they begin.
        self._pixels = frame.pixels[:, first * cell_px : last * cell_px]
        self._first_x = first * cell_px

    @property
    def width(self) -> int:
        """Pixels of a row that are read."""
        return int(self._pixels.shape[1])

    @abstractmethod
    def _cells(self, first: int, last: int) -> Float32Array:
        """(last - first, cells) light of the rows `first` to `last`, not included."""

    def read(self, first: int, last: int, edges: Float32Array) -> tuple[Float32Array, Float32Array, Float32Array]:
        """Light between neighbouring edges (n, rows), pixels enclosed, and cells of some rows for the noise model."""
        import cv2

        cells = self._cells(first, last)
        area = cv2.integral(cells, sdepth=cv2.CV_64F)
        light, enclosed = _between_edges(area, self._places(edges) * np.float32(1 / self.cell_px))
        return light, enclosed * np.float32(self.cell_px), cells[:: SETTINGS.noise_row_step].copy()

    def _places(self, edges: Float32Array) -> Float32Array:
        """Edges as pixels from the left border of what is read."""
        return edges - np.float32(self._first_x - 0.5)


class _DevelopedReader(_Reader):
    """A developed picture, its tone curve undone pixel by pixel."""

    def __init__(self, frame: Frame, edges: Float32Array, tone: str) -> None:
        strip_px = float(np.median(np.abs(np.diff(edges[:, edges.shape[1] // 2]))))
        super().__init__(frame, edges, int(np.clip(strip_px // SETTINGS.cells_per_strip, 1, min(16, frame.width))))
        self._table = _light_table(int(np.iinfo(frame.pixels.dtype).max), 1, *_curve(frame, tone))

    def _cells(self, first: int, last: int) -> Float32Array:
        return self._cells_of(self._pixels[first:last])

    def _cells_of(self, rows: NDArray[Any]) -> Float32Array:
        import cv2

        light = cv2.LUT(rows, self._table) if rows.dtype == np.uint8 else self._table[rows]
        size = (rows.shape[1] // self.cell_px, rows.shape[0])
        return np.asarray(cv2.resize(light, size, interpolation=cv2.INTER_AREA))


class _CodedReader(_DevelopedReader):
    """A developed picture of 8 bits, the tone curve of its strips' means undone."""

    #: Its steps are so short that two threads would but wait for the interpreter's lock.
    threads = 1

    def __init__(self, frame: Frame, edges: Float32Array, tone: str) -> None:
        super().__init__(frame, edges, tone)
        self._fine_table = _light_table(255, _FINE_STEPS, *_curve(frame, tone))

    def read(self, first: int, last: int, edges: Float32Array) -> tuple[Float32Array, Float32Array, Float32Array]:
        import cv2

        rows = self._pixels[first:last]
        coded, enclosed = _between_edges(cv2.integral(rows, sdepth=cv2.CV_32S), self._places(edges))
        nearest = (coded * np.float32(_FINE_STEPS) + np.float32(0.5)).astype(np.intp)
        light = self._fine_table.take(nearest, mode="clip")
        return light, enclosed, self._cells_of(rows[:: SETTINGS.noise_row_step])


class _MosaicReader(_Reader):
    """A mosaic, in cells of one period of its colours."""

    def __init__(self, frame: Frame, edges: Float32Array, mosaic: Mosaic) -> None:
        self._weights, self._offsets, self._smooth = _mosaic_weights(mosaic)
        super().__init__(frame, edges, int(self._weights.shape[1]))

    def _cells(self, first: int, last: int) -> Float32Array:
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


def _curve(frame: Frame, tone: str) -> tuple[float, float, str]:
    """Black, white and tone of a developed frame."""
    return frame.black, frame.white, "linear" if frame.linear else tone


@lru_cache(maxsize=8)
def _light_table(last: int, steps: int, black: float, white: float, tone: str) -> Float32Array:
    """Linear light of the pixel values 0 to `last`, at so many steps a value."""
    encoded = np.clip((np.arange(last * steps + 1) / steps - black) / (white - black), 0, 1)
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


def _between_edges(area: NDArray[Any], edges: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Means of values between neighbouring edges.

    Args:
        area: (rows + 1, n + 1) sums of all values above and left of a place (`cv2.integral`).
        edges: (n_edges, rows) in values from the left border.

    Returns:
        (n_edges - 1, rows) float32: means, 0 where the edges enclose next to nothing; and how many values they enclose.
    """
    n = area.shape[1] - 1
    above, below = area[:-1].ravel(), area[1:].ravel()
    position = np.clip(edges, 0, n)
    left = np.minimum(position, np.float32(n - 1)).astype(np.intp)
    part = np.subtract(position, left, dtype=np.float32)
    left += np.arange(0, above.size, n + 1)
    at_edge = (below.take(left) - above.take(left)).astype(np.float32)
    left += 1
    # Sums over a thousand cells are exact to 6e-5 of white in float32, shared by the cells of a strip: far below noise.
    at_edge += ((below.take(left) - above.take(left)).astype(np.float32) - at_edge) * part
    mean, widths = np.diff(at_edge, axis=0), np.diff(position, axis=0)
    enclosed = np.abs(widths)
    widths[enclosed <= SETTINGS.min_enclosed] = np.inf
    mean /= widths
    return mean, enclosed


def _noise_model(cells: Float32Array, cell_px: int) -> tuple[float, float]:
    """Variance of a pixel as floor + slope * light, from differences of adjacent cells of so many pixels.

    Medians over bins of equal light ignore the picture's edges; a straight line through the bins with floor and slope
    not below zero.
    """
    if cells.shape[1] < 2:
        return 1e-6 * cell_px, 0.0
    rows = cells[:: max(1, cells.size // SETTINGS.noise_cells)]
    difference = np.abs(np.diff(rows, axis=1)).ravel()
    light = ((rows[:, 1:] + rows[:, :-1]) / 2).ravel()
    n_bins = min(SETTINGS.noise_bins, max(1, light.size // 50))
    # Bins of equal numbers; the few brightest that are left over do not matter.
    bins = np.argsort(light)[: light.size // n_bins * n_bins].reshape(n_bins, -1)
    x = np.median(light[bins], axis=1)
    # For a normal difference of two cells of variance s2: median |d| = 0.6745 sqrt(2 s2).
    y = np.median(difference[bins], axis=1) ** 2 / (2 * 0.6745**2)
    return _floor_and_slope(x, cell_px * y)


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
