"""Read the pixels of a frame, each once, into running sums along the rows.

Pixels are added in cells a few pixels wide as they are stored. A running sum along the row, interpolated between the
borders of cells, then gives the mean over any part of the row, so that columns of any slant, strips of any width and
finer strips of narrow columns come from one reading. Sums of 8-bit values are exact.

A mosaic is read without demosaicing: each row's pixels are weighted so that every row measures the same mix of red,
green and blue, in cells of whole periods of its colours.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from rxcli.types import Float32Array, Frame, LightPlane, Mosaic

#: Minimum number of cells of a row, several for every strip of a hundred columns; and of a picture rotated by 90
#: degrees, which is searched for wide columns only.
_MIN_CELLS, _TURNED_CELLS = 1500, 400
#: Bytes of a word that holds any sum.
_MAX_BYTES = 4
#: Rows read at a time, chosen to fit the processor's cache.
BAND_ROWS = 64


def read_plane(frame: Frame) -> LightPlane:
    """Read every pixel of a frame."""
    mix = None if frame.mosaic is None else _ColourMix.of(frame.mosaic)
    height, width = frame.pixels.shape
    cell_px = _cell_px(width, 1 if mix is None else mix.weights.shape[1])
    n_cells = width // cell_px
    sums = np.zeros((n_cells + 1, height), np.float32)
    for top in range(0, height, BAND_ROWS):
        band = frame.pixels[top : top + BAND_ROWS, : n_cells * cell_px]
        sums[1:, top : top + BAND_ROWS] = (cells_of(band, cell_px) if mix is None else mix.cells(band, cell_px, top)).T
    if mix is None:
        return LightPlane(running_sums(sums), cell_px, width, frame.black, frame.white, is_linear=frame.linear)
    return LightPlane(running_sums(mix.evened(sums)), cell_px, width, 0.0, 1.0, is_linear=True)


def turned(plane: LightPlane) -> LightPlane:
    """The plane of the picture rotated by 90 degrees, in square pixels of a cell's width."""
    import cv2

    cells = np.diff(plane.sums, axis=0)
    cell_px = max(cells.shape[1] // plane.cell_px // _TURNED_CELLS, 1)
    n = cells.shape[1] // (cell_px * plane.cell_px)
    rows = cells[:, : n * cell_px * plane.cell_px]
    sums = np.zeros((n + 1, len(cells)), np.float32)
    sums[1:] = cv2.resize(rows, (n, len(cells)), interpolation=cv2.INTER_AREA).T
    sums *= np.float32(cell_px / plane.cell_px)
    return replace(plane, sums=running_sums(sums), cell_px=cell_px, width=n * cell_px)


def _cell_px(width: int, period: int) -> int:
    """Width of a cell: the largest period times a power of two that leaves at least `min_cells` cells."""
    cell_px = period
    while width // (2 * cell_px) >= _MIN_CELLS:
        cell_px *= 2
    return cell_px


def running_sums(sums: Float32Array) -> Float32Array:
    """Running sums over the first axis, in place."""
    # Much faster than numpy.cumsum, which goes down one column at a time.
    for left, here in pairwise(sums):
        np.add(left, here, out=here)
    return sums


def cells_of(band: NDArray[Any], cell_px: int) -> NDArray[Any]:
    """Sums (rows, n) of `cell_px` neighbouring integers; `cell_px` is a power of two."""
    while cell_px > 1:
        wider = np.dtype(f"u{min(2 * band.dtype.itemsize, _MAX_BYTES)}")
        band = np.add(band[:, ::2], band[:, 1::2], dtype=wider)
        cell_px //= 2
    return band


@dataclass(frozen=True, slots=True)
class _ColourMix:
    """How every row of a mosaic measures the same mix of colours.

    Green counts most, red and blue by the inverse square of their gains, which is near the best signal to noise. A row
    that lacks a colour (Bayer) cannot measure the mix: its mean is taken as it is, and rows are then smoothed so that
    each holds both kinds, at the price of one row of blur.
    """

    #: (period_y, period_x) weights of pixels, and (period_y,) offsets.
    weights: Float32Array
    offsets: Float32Array
    is_complete: bool

    @classmethod
    def of(cls, mosaic: Mosaic) -> Self:
        """The mix of a mosaic."""
        pattern = mosaic.pattern
        n = pattern.shape[1]
        present = np.stack([(pattern == colour).sum(axis=1) for colour in range(3)], axis=1)
        mix = 1 / np.maximum(np.array(mosaic.gains), 1.0) ** 2
        complete = bool((present > 0)[:, mix > 0].all())
        share = n * mix / mix.sum() / np.maximum(present, 1) if complete else np.ones(present.shape)
        black = np.array(mosaic.black)
        weights = share[np.arange(pattern.shape[0])[:, None], pattern] / (mosaic.white - black.mean())
        offsets = (weights * black[pattern]).mean(axis=1)
        return cls(weights.astype(np.float32), offsets.astype(np.float32), complete)

    def cells(self, band: NDArray[Any], cell_px: int, top: int) -> Float32Array:
        """Cells (rows, n) of a band of rows from row `top` on."""
        phase = np.arange(top, top + len(band)) % len(self.weights)
        weights = np.tile(self.weights, (1, cell_px // self.weights.shape[1]))[phase, :, None]
        cells = band.astype(np.float32).reshape(len(band), -1, cell_px) @ weights
        return np.asarray(cells[..., 0] - self.offsets[phase, None] * np.float32(cell_px))

    def evened(self, cells: Float32Array) -> Float32Array:
        """Cells (n, rows), smoothed where rows lack a colour."""
        import cv2

        smooth = np.array([[0.25, 0.5, 0.25]], np.float32)
        return cells if self.is_complete else np.asarray(cv2.filter2D(cells, -1, smooth))
