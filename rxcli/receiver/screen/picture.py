"""The picture as the search reads it: a reduced plane, and pixels at full resolution along a side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rxcli.types import BoolArray, Float32Array

Pixels = NDArray[np.uint8] | NDArray[np.uint16]

#: Smallest picture that is searched, pixels each way.
MIN_SIZE = 96
#: Rows of the reduced plane, and strips that its rows are summed into, about.
_ROWS, _STRIPS = 1040, 340
#: Picture pixels between the two changes of a product: further than demosaicing, denoising and coding spread noise.
_APART_PX = 7
#: Linear light below which a picture is dark: noise is not stretched further there.
_DARK = 0.002
#: Light below which a picture shows nothing, and share of its width in which a lens correction leaves wedges.
_NOTHING, _WEDGE_DEPTH = 0.008, 0.05
#: Exponent of the tone curve that is taken off where an edge or texture is placed; any of the usual ones will do.
TONE = 2.2


@dataclass(frozen=True, slots=True)
class Picture:
    """Pixels and what their values mean."""

    #: (height, width) uint8: gamma-coded luma; uint16: linear, a mosaic perhaps.
    pixels: Pixels
    black: float
    white: float
    #: Pixels after which the colours of a mosaic repeat; 1 for luma.
    period: int

    @property
    def height(self) -> int:
        return int(self.pixels.shape[0])

    @property
    def width(self) -> int:
        return int(self.pixels.shape[1])

    @property
    def developed(self) -> bool:
        return self.pixels.dtype == np.uint8

    def linear(self, values: Pixels) -> Float32Array:
        """Light of pixel values, black 0, white 1."""
        import cv2

        scale = np.float32(1 / (self.white - self.black))
        if not self.developed:
            return (values.astype(np.float32) - np.float32(self.black)) * scale
        coded = (np.arange(256, dtype=np.float32) - np.float32(self.black)) * scale
        return np.asarray(cv2.LUT(values, np.maximum(coded, 0) ** np.float32(TONE)), np.float32).reshape(values.shape)


@dataclass(frozen=True, slots=True)
class Plane:
    """The reduced picture: every n-th row in strips, light on a scale near to that of the eye, black 0, white 1."""

    light: Float32Array
    #: Picture pixels of one strip and from row to row.
    fx: int
    fy: int
    #: Black wedges that the correction of a lens left along the picture's edges; None: there are none.
    wedge: BoolArray | None
    width: int
    height: int

    @property
    def cell_rows(self) -> int:
        """Rows of the plane in one coarse cell."""
        return int(np.clip(self.light.shape[0] // 60, 4, 16))

    @property
    def apart(self) -> int:
        """Strips between the two changes of a product."""
        return apart(self.fx)


def apart(fx: int) -> int:
    """Steps between the two changes of a product, for steps of `fx` pixels."""
    return max(1, -(-_APART_PX // fx))


def reduce(picture: Picture) -> Plane:
    """Every n-th row, averaged along the row over whole periods of the mosaic."""
    fy = row_step(picture)
    fx = picture.period * max(1, round(picture.width / _STRIPS / picture.period))
    light = _averaged(picture, 0, picture.width // fx, fx, fy)
    wedge = _wedge(light) if picture.developed else None
    return Plane(light, fx, fy, wedge, picture.width, picture.height)


def row_step(picture: Picture) -> int:
    """Rows from row to row of the reduced plane."""
    return picture.period * max(1, round(picture.height / _ROWS / picture.period))


def fine_step(picture: Picture) -> int:
    """Pixels of one column of the finer plane, which is read around the left and right sides: a third of a strip."""
    return picture.period * max(1, round(picture.width / (3 * _STRIPS) / picture.period))


def finer(picture: Picture, plane: Plane, first: int, last: int) -> tuple[Float32Array, BoolArray | None]:
    """Columns `first` to `last` of the finer plane, with its wedges."""
    fx = fine_step(picture)
    light = _averaged(picture, first, last, fx, plane.fy)
    if plane.wedge is None:
        return light, None
    strip = np.minimum((np.arange(first, last) * fx + fx // 2) // plane.fx, plane.light.shape[1] - 1)
    return light, plane.wedge[:, strip]


def _averaged(picture: Picture, first: int, last: int, fx: int, fy: int) -> Float32Array:
    import cv2

    rows = picture.pixels[::fy, first * fx : last * fx]
    light = cv2.resize(rows, (last - first, rows.shape[0]), interpolation=cv2.INTER_AREA).astype(np.float32)
    light -= np.float32(picture.black)
    light *= np.float32(1 / (picture.white - picture.black))
    if not picture.developed:
        light = np.sqrt(np.maximum(light, 0) + np.float32(_DARK))
    return np.asarray(light, np.float32)


def _wedge(light: Float32Array) -> BoolArray | None:
    """The black wedges of a lens correction: runs of black from the picture's edges that change slowly along them."""
    import cv2

    mask = np.zeros(light.shape, np.uint8)
    for turns in range(4):
        turned, marked = np.rot90(light, turns), np.rot90(mask, turns)
        depth = max(int(_WEDGE_DEPTH * turned.shape[1]), 2)
        run = np.logical_and.accumulate(turned[:, :depth] <= _NOTHING, axis=1).sum(axis=1)
        # A dark slot of the screen is a long run too, but its neighbours are short.
        run = cv2.erode(run.astype(np.float32)[:, None], np.ones((25, 1), np.uint8))
        marked[:, :depth] |= (np.arange(depth) < run).astype(np.uint8)
    # The margin covers the ringing of the JPEG blocks at the wedge's edge.
    return cv2.dilate(mask, np.ones((7, 3), np.uint8)) > 0 if mask.any() else None
