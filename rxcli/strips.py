"""Quick sampling of strips whose place is known from the frame before: what tracked frames of a clip need.

Pixels are added up along the rows over about half a strip as they are stored, then read between these cells at the
middle of every strip on every row, and only these few values are made linear. The order of adding and of undoing the
tone curve does not matter to a light that is a product of picture and slots, as long as the curve is near a power law;
and the picture is learned from the same samples. Ten times quicker than `rxcli.sampling`, which is exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rxcli.types import BoolArray, Float32Array, FloatArray, Frame, Outlines

#: Part of a strip over which pixels are added up before the strip's middle is read.
_CELL_SHARE = 0.6
#: Pixels of eight bits in a word, words whose sum 16 bits hold, and rows whose words fit the cache at a time.
_WORD, _MOST_WORDS, _ROWS_AT_A_TIME = 8, 32, 128
#: Every other byte of a word, and the factor that adds its four numbers of 16 bits up in the topmost.
_EVEN, _ADD = np.uint64(0x00FF00FF00FF00FF), np.uint64(0x0001000100010001)


@dataclass(frozen=True, slots=True)
class StripMap:
    """Where the strips of C columns of S strips lie on a picture, and what their values mean."""

    cell_px: int
    first_row: int
    #: (C*S, R) float32 each: cell, and row from the first, whose values are read.
    places: tuple[Float32Array, Float32Array]
    #: (values,) light of every value that a cell can have.
    light: Float32Array
    #: (C, S, R) bool: the strip is on the screen and in the picture.
    inside: BoolArray

    @property
    def pixels(self) -> float:
        """Pixels behind each sample."""
        return self.cell_px * 1.5


def map_strips(outlines: Outlines, frame: Frame, light_of: Callable[[FloatArray], FloatArray]) -> StripMap:
    """The places of the strips; worth keeping as long as the screen stays where it is.

    Args:
        outlines: of the strips.
        frame: says how values are stored: which are black and white, and whether they are linear.
        light_of: linear light of coded values, both 0..1.
    """
    middles = (outlines.edges_x[1:] + outlines.edges_x[:-1]) / 2
    strip_px = float(np.median(np.abs(np.diff(outlines.edges_x[:, outlines.rows.size // 2]))))
    cell_px = _cell_px(strip_px * _CELL_SHARE, frame)
    x = np.ascontiguousarray((middles + 0.5) / cell_px - 0.5, np.float32)
    y = np.ascontiguousarray(np.broadcast_to(np.arange(outlines.rows.size, dtype=np.float32), x.shape))
    light = _light_of_values(frame, light_of, cell_px if _has_words(frame, cell_px) else 1)
    return StripMap(cell_px, int(outlines.rows[0]), (x, y), light, outlines.inside)


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
        cells = _sums_of_words(pixels.view(np.uint64), strips.cell_px // _WORD)
    else:
        cells = cv2.resize(pixels, (pixels.shape[1] // strips.cell_px, n_rows), interpolation=cv2.INTER_AREA)
    values = cv2.remap(cells, *strips.places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(strips.light.take(values)).reshape(strips.inside.shape)


def _cell_px(wanted: float, frame: Frame) -> int:
    """Width of a cell: whole words where that is about as many pixels, for they are added up more quickly."""
    words = min(round(wanted / _WORD), _MOST_WORDS)
    return words * _WORD if words and _has_words(frame, words * _WORD) else max(int(wanted), 1)


def _has_words(frame: Frame, cell_px: int) -> bool:
    """Whether cells are whole words, which are added up; of others the mean is taken."""
    return frame.pixels.dtype == np.uint8 and frame.pixels.strides[1] == 1 and cell_px % _WORD == 0


def _light_of_values(frame: Frame, light_of: Callable[[FloatArray], FloatArray], scale: int) -> Float32Array:
    """Light of every value that `scale` pixels added up can have."""
    values = np.arange(np.iinfo(frame.pixels.dtype).max * scale + 1, dtype=np.float64) / scale
    coded = np.clip((values - frame.black) / (frame.white - frame.black), 0, 1)
    return np.asarray(coded if frame.linear else light_of(coded), np.float32)


def _sums_of_words(words: NDArray[np.uint64], n: int) -> NDArray[np.uint16]:
    """(R, W) words of eight pixels each -> (R, W / n) sums of the pixels of `n` words.

    A word's odd and even pixels are added as four numbers of 16 bits at a time, then these four by one multiplication.
    """
    sums = np.empty((words.shape[0], words.shape[1] // n), np.uint16)
    for top in range(0, words.shape[0], _ROWS_AT_A_TIME):
        some = words[top : top + _ROWS_AT_A_TIME]
        pairs = (some & _EVEN) + ((some >> np.uint64(8)) & _EVEN)
        cells = pairs[:, ::n].copy()
        for word in range(1, n):
            cells += pairs[:, word::n]
        sums[top : top + _ROWS_AT_A_TIME] = (cells * _ADD) >> np.uint64(48)
    return sums
