"""Quick sampling of strips whose place is known from the frame before: what tracked frames of a clip need.

Pixels are added up along the rows in small cells as they are stored, the cells over the width of a strip; these sums
are read at the middle of every strip on every row, between cells, and only these few values are made linear. Cells are
small against a strip because the screen before a camera in a hand lies elsewhere among them in every frame, and its
picture must look the same. The order of adding and of undoing the tone curve does not matter to a light that is a
product of picture and slots, as long as the curve is near a power law; and the picture is learned from the same
samples. Ten times quicker than `rxcli.receiver.sampling.rows`, which is exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.receiver.sampling.settings import SETTINGS
from rxcli.types import BoolArray, Float32Array, FloatArray, Frame, Outlines

#: Pixels of eight bits in a half word, half words whose sum 16 bits hold, and rows that fit the cache at a time.
_HALF, _MAX_HALVES, _ROWS_AT_A_TIME = 4, 64, 128


@dataclass(frozen=True, slots=True)
class StripMap:
    """Where the strips of C columns of S strips lie on a picture, and what their values mean."""

    cell_px: int
    #: Cells that are added up for every sample.
    n_cells: int
    first_row: int
    #: (C*S, R) float32 each: cell, and row from the first, whose values are read.
    places: tuple[Float32Array, Float32Array]
    #: (values,) light of every value that a sample can have.
    light: Float32Array
    #: (C, S, R) bool: the strip is on the screen and in the picture.
    inside: BoolArray

    @property
    def pixels(self) -> float:
        """Pixels behind each sample."""
        return float(self.cell_px * self.n_cells)

    @property
    def rows(self) -> FloatArray:
        """(R,) sensor rows that are read."""
        return self.first_row + np.arange(self.inside.shape[2], dtype=np.float64)


def map_strips(outlines: Outlines, frame: Frame, light_of: Callable[[FloatArray], FloatArray]) -> StripMap:
    """The places of the strips; worth keeping as long as the screen stays where it is.

    Args:
        outlines: of the strips.
        frame: its levels: which are black and white, and whether they are linear.
        light_of: linear light of coded values, both 0..1.
    """
    strip_px = float(np.median(np.abs(np.diff(outlines.edges_x[:, outlines.rows.size // 2]))))
    cell_px, n_cells = _cells_of(strip_px, frame)
    light = _light_of_values(frame, light_of, (cell_px if _has_words(frame, cell_px) else 1) * n_cells)
    places = _places_of(outlines, cell_px, n_cells)
    return StripMap(cell_px, n_cells, int(outlines.rows[0]), places, light, outlines.inside)


def moved_map(strips: StripMap, outlines: Outlines) -> StripMap:
    """The same strips on a screen that is elsewhere now, by `outlines`."""
    places = _places_of(outlines, strips.cell_px, strips.n_cells)
    return replace(strips, first_row=int(outlines.rows[0]), places=places, inside=outlines.inside)


def _places_of(outlines: Outlines, cell_px: int, n_cells: int) -> tuple[Float32Array, Float32Array]:
    middles = (outlines.edges_x[1:] + outlines.edges_x[:-1]) * np.float32(0.5 / cell_px)
    # The middle of an even number of cells lies half a cell before the one that OpenCV calls the middle one.
    x = np.ascontiguousarray(middles + np.float32(0.5 / cell_px - 0.5 * (n_cells % 2)), np.float32)
    return x, np.ascontiguousarray(np.broadcast_to(np.arange(outlines.rows.size, dtype=np.float32), x.shape))


def sample_strips(frame: Frame, strips: StripMap) -> Float32Array:
    """(C, S, R) linear light of the strips.

    Args:
        frame: the picture; no mosaic.
        strips: where to look.
    """
    import cv2

    n_rows = strips.inside.shape[2]
    pixels = frame.pixels[strips.first_row : strips.first_row + n_rows]
    pixels = pixels[:, : frame.width // strips.cell_px * strips.cell_px]
    if _has_words(frame, strips.cell_px):
        cells = _sums(pixels, strips.cell_px)
    else:
        cells = cv2.resize(pixels, (pixels.shape[1] // strips.cell_px, n_rows), interpolation=cv2.INTER_AREA)
    if strips.n_cells > 1:
        cells = cv2.boxFilter(cells, cv2.CV_16U, (strips.n_cells, 1), normalize=False, borderType=cv2.BORDER_REPLICATE)
    values = cv2.remap(cells, *strips.places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(strips.light.take(values)).reshape(strips.inside.shape)


def _cells_of(strip_px: float, frame: Frame) -> tuple[int, int]:
    """Width of a cell and cells of a sample: whole half words where there are some, which are added up more quickly."""
    if frame.pixels.dtype != np.uint8:
        return max(int(strip_px * SETTINGS.tracked_cell_share), 1), 1
    halves = int(np.clip(round(strip_px / SETTINGS.tracked_cells / _HALF), 1, _MAX_HALVES))
    if strip_px >= SETTINGS.from_halves_px and _has_words(frame, halves * _HALF):
        cell_px = halves * _HALF
    else:
        cell_px = max(int(strip_px / SETTINGS.tracked_cells), 1)
    most = max((1 << 16) // (cell_px * 256), 1)
    return cell_px, int(np.clip(round(strip_px / cell_px), 1, most))


def _has_words(frame: Frame, cell_px: int) -> bool:
    """Whether cells are whole words or half words, which are added up; of others the mean is taken."""
    return frame.pixels.dtype == np.uint8 and frame.pixels.strides[1] == 1 and cell_px % _HALF == 0


def _light_of_values(frame: Frame, light_of: Callable[[FloatArray], FloatArray], scale: int) -> Float32Array:
    """Light of every value that `scale` pixels added up can have."""
    values = np.arange(np.iinfo(frame.pixels.dtype).max * scale + 1, dtype=np.float64) / scale
    coded = np.clip((values - frame.black) / (frame.white - frame.black), 0, 1)
    return np.asarray(coded if frame.linear else light_of(coded), np.float32)


def _sums(pixels: NDArray[Any], cell_px: int) -> NDArray[np.uint16]:
    """(R, W) pixels -> (R, W / cell_px) sums over cells, a multiple of four pixels wide.

    The odd and the even bytes of a word are added as two or four numbers of 16 bits at a time, then these by one
    multiplication, which leaves their sum in the topmost.
    """
    word: Any = np.uint32 if cell_px % 8 else np.uint64
    size = 4 if cell_px % 8 else 8
    n, every_byte = cell_px // size, (1 << 8 * size) - 1
    even, add = word(0x00FF00FF00FF00FF & every_byte), word(0x0001000100010001 & every_byte)
    words: NDArray[Any] = pixels.view(word)
    sums = np.empty((words.shape[0], words.shape[1] // n), np.uint16)
    for top in range(0, words.shape[0], _ROWS_AT_A_TIME):
        some = words[top : top + _ROWS_AT_A_TIME]
        pairs, odd = some & even, some >> word(8)
        odd &= even
        pairs += odd
        cells = pairs[:, ::n]
        for place in range(1, n):
            cells += pairs[:, place::n]
        cells *= add
        cells >>= word(8 * size - 16)
        sums[top : top + _ROWS_AT_A_TIME] = cells
    return sums
