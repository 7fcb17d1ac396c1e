"""Quick sampling of strips whose place is known from the frame before: what tracked frames of a clip need.

Encoded values are added up in cells that are small against a strip, and cells over the width of a strip around each.
These sums are read at the middle of every strip on every row, and only these few values are made linear. The order of
adding and of undoing the tone curve does not matter to a light that is a product of picture and slots, as long as the
curve is near a power law; and the picture is learned from the same samples. `rxcli.receiver.plane.rows` is exact and
takes ten times as long.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rxcli.receiver.plane.read import BAND_ROWS, cells_of
from rxcli.receiver.plane.rows import light_of_levels
from rxcli.types import BoolArray, Float32Array, FloatArray, Frame, Outlines

#: Width of a cell of 8-bit values, minimum width of a strip for such cells, and maximum width: 16 bits hold its sum.
_CELL_PX, _MIN_PX, _MAX_PX = 4, 12, 256


@dataclass(frozen=True, slots=True)
class StripMap:
    """Where the strips of C columns of S strips lie on a picture, and what their values mean."""

    #: Width of a cell, and number of cells that are added up for every sample.
    cell_px: int
    n_cells: int
    first_row: int
    #: (C*S, R) float32 each: cell, and row from the first, whose values are read.
    places: tuple[Float32Array, Float32Array]
    #: (values,) light of every value that a sample can have.
    light: Float32Array
    #: (C, S, R) bool: the strip is on the screen and in the picture.
    inside: BoolArray

    @property
    def pixels(self) -> int:
        """Pixels behind each sample."""
        return self.cell_px * self.n_cells

    @property
    def rows(self) -> FloatArray:
        """(R,) sensor rows that are read."""
        return self.first_row + np.arange(self.inside.shape[2], dtype=np.float64)


def map_strips(outlines: Outlines, frame: Frame, light_of: Callable[[FloatArray], FloatArray]) -> StripMap:
    """The places of the strips; worth keeping as long as the screen stays where it is.

    Args:
        outlines: of the strips.
        frame: its levels: which are black and white, and whether they are linear.
        light_of: linear light of encoded values, both 0..1.
    """
    strip_px = min(float(np.median(np.abs(np.diff(outlines.edges_x[:, outlines.rows.size // 2])))), _MAX_PX)
    is_summed = frame.pixels.dtype == np.uint8
    cell_px = _CELL_PX if is_summed and strip_px >= _MIN_PX else 1
    n_cells = max(round(strip_px / cell_px), 1)
    light = np.asarray(light_of_levels(frame, cell_px * n_cells if is_summed else 1, light_of), np.float32)
    places = _places_of(outlines, cell_px, n_cells)
    return StripMap(cell_px, n_cells, int(outlines.rows[0]), places, light, outlines.inside)


def moved_map(strips: StripMap, outlines: Outlines) -> StripMap:
    """The same strips on a screen that is elsewhere now, by `outlines`."""
    places = _places_of(outlines, strips.cell_px, strips.n_cells)
    return replace(strips, first_row=int(outlines.rows[0]), places=places, inside=outlines.inside)


def _places_of(outlines: Outlines, cell_px: int, n_cells: int) -> tuple[Float32Array, Float32Array]:
    middles = (outlines.edges_x[1:] + outlines.edges_x[:-1] + 1) / (2 * cell_px)
    # The middle of an even number of cells lies half a cell before the one that OpenCV calls the middle one.
    x = (middles - 0.5 * (n_cells % 2)).astype(np.float32)
    return x, np.ascontiguousarray(np.broadcast_to(np.arange(outlines.rows.size, dtype=np.float32), x.shape))


def sample_strips(frame: Frame, strips: StripMap) -> Float32Array:
    """(C, S, R) linear light of the strips.

    Args:
        frame: the picture; no mosaic.
        strips: where to look.
    """
    import cv2

    cell_px, rows = strips.cell_px, strips.inside.shape[2]
    pixels = frame.pixels[strips.first_row : strips.first_row + rows, : frame.width // cell_px * cell_px]
    cells = pixels
    if cell_px > 1:
        cells = np.empty((rows, pixels.shape[1] // cell_px), np.uint16)
        for top in range(0, rows, BAND_ROWS):
            cells[top : top + BAND_ROWS] = cells_of(pixels[top : top + BAND_ROWS], cell_px)
    size, is_mean = (strips.n_cells, 1), pixels.dtype != np.uint8
    sums = cv2.boxFilter(cells, cv2.CV_16U, size, normalize=is_mean, borderType=cv2.BORDER_REPLICATE)
    values = cv2.remap(sums, *strips.places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(strips.light.take(values)).reshape(strips.inside.shape)
