"""Frames as the calibrations want them: light for stripes, grey pictures for boards."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rxcli.types import Float32Array, Frame, Mosaic

_GREEN = 1


def light_of(frame: Frame) -> Float32Array:
    """(height, width) values proportional to light, as far as the file tells: 0 black, 1 white.

    Of a mosaic the green pixels of each row stand for the whole row: rows are not mixed, and a coloured lamp makes no
    pattern. A developed picture is taken to have the sRGB tone curve.
    """
    if frame.mosaic is not None:
        return _green_rows(frame.pixels, frame.mosaic)
    values = (frame.pixels.astype(np.float32) - np.float32(frame.black)) / np.float32(frame.white - frame.black)
    np.clip(values, 0, None, out=values)
    if frame.linear:
        return values
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _green_rows(pixels: NDArray[np.uint8] | NDArray[np.uint16], mosaic: Mosaic) -> Float32Array:
    """Mean of the green pixels of each row over each repeat of the pattern, repeated over the pattern's width."""
    height, width = pixels.shape
    rows, columns = mosaic.pattern.shape
    blocks = max(width // columns, 1)
    green = np.zeros((height, blocks), np.float32)
    for row in range(rows):
        at = np.flatnonzero(mosaic.pattern[row] == _GREEN)
        picked = [pixels[row::rows, x : blocks * columns : columns] for x in (at if at.size else range(columns))]
        green[row::rows] = np.mean([p[:, :blocks] for p in picked], axis=0, dtype=np.float32)
    light = (green - np.float32(mosaic.black[_GREEN])) / np.float32(mosaic.white - mosaic.black[_GREEN])
    repeated = np.repeat(np.clip(light, 0, None), columns, axis=1)
    return np.pad(repeated, ((0, 0), (0, width - repeated.shape[1])), mode="edge")


def gray_of(frame: Frame) -> NDArray[np.uint8]:
    """(height, width) grey picture for a corner detector, never rotated."""
    import cv2

    if frame.mosaic is None:
        if frame.pixels.dtype == np.uint8:
            return frame.pixels.astype(np.uint8, copy=False)
        scaled: Float32Array = (frame.pixels.astype(np.float32) - frame.black) * (255.0 / (frame.white - frame.black))
        return np.asarray(np.clip(scaled, 0, 255), np.uint8)
    # Balanced colours, smoothed over one period, with the contrast of a developed picture.
    (height, width), (rows, columns) = frame.pixels.shape, frame.mosaic.pattern.shape
    tiled = np.tile(frame.mosaic.pattern, (height // rows + 1, width // columns + 1))[:height, :width]
    gain, black = (np.array(part, np.float32)[tiled] for part in (frame.mosaic.gains, frame.mosaic.black))
    smooth = cv2.GaussianBlur((frame.pixels.astype(np.float32) - black) * gain, (0, 0), 0.8)
    white = max(float(np.quantile(smooth[::8, ::8], 0.995)), 1.0)
    return np.asarray(255 * np.sqrt(np.clip(smooth / white, 0, 1)), np.uint8)
