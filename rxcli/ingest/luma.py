"""Colour reduced to luma."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.types import Colours, Float32Array, Frame, Metadata

Luma = NDArray[np.uint8] | NDArray[np.uint16]

#: Luma weights of red, green, blue (ITU-R BT.601 and BT.709).
Weights = tuple[float, float, float]
BT601: Weights = (0.299, 0.587, 0.114)
BT709: Weights = (0.2126, 0.7152, 0.0722)
_BAND_PIXELS = 1 << 22
#: Pixels and rows from one to the next of a thinned picture.
THINNED = 8


def without_red(weights: Weights) -> Weights:
    """Luma weights of green and blue alone."""
    _, green, blue = weights
    return 0.0, green / (green + blue), blue / (green + blue)


def as_shares(samples: NDArray[Any]) -> Float32Array:
    """Integer samples as shares of the largest one."""
    return np.asarray(samples, np.float32) / np.float32(np.iinfo(samples.dtype).max)


def colour_frame(
    path: Path, samples: NDArray[Any], metadata: Metadata, weights: Weights = BT601, white: float | None = None
) -> Frame:
    """The frame of grey or RGB samples, whose colours it keeps; `white` is their largest number by default."""
    white = float(np.iinfo(samples.dtype).max) if white is None else white
    colours = colours_of(samples, weights)
    return Frame(luma_of(samples, weights), str(path), metadata=metadata, white=white, colours=colours)


def colours_of(pixels: NDArray[Any], weights: Weights = BT601) -> Colours | None:
    """The colours of samples in memory; None of grey ones."""
    if pixels.ndim == 2 or pixels.shape[2] < 3:
        return None
    return Colours(lambda: as_shares(pixels[::THINNED, ::THINNED, :3]), lambda: luma_of(pixels, without_red(weights)))


def luma_of(pixels: NDArray[Any], weights: Weights = BT601) -> NDArray[Any]:
    """Luma (height, width) of grey or RGB(A) `pixels` of uint8, uint16 or float32; alpha is left out."""
    if pixels.ndim == 2:
        return pixels
    if pixels.shape[2] < 3:
        return np.ascontiguousarray(pixels[:, :, 0])
    import cv2

    luma = np.empty(pixels.shape[:2], pixels.dtype)
    step = max(_BAND_PIXELS // max(pixels.shape[1], 1), 1)
    for top in range(0, pixels.shape[0], step):  # in bands: a copy of the whole would double the memory
        rgb = np.ascontiguousarray(pixels[top : top + step, :, :3])
        if weights == BT601:
            luma[top : top + step] = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        else:
            luma[top : top + step] = cv2.transform(rgb, np.array([weights], np.float32))
    return luma
