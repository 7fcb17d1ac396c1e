"""Colour reduced to luma."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Luma = NDArray[np.uint8] | NDArray[np.uint16]

#: Luma weights of red, green, blue (ITU-R BT.601 and BT.709).
BT601 = (0.299, 0.587, 0.114)
BT709 = (0.2126, 0.7152, 0.0722)
_BAND_PIXELS = 1 << 22


def luma_of(pixels: NDArray[Any], weights: tuple[float, float, float] = BT601) -> NDArray[Any]:
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
