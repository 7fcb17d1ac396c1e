"""Frames as the calibrations want them: light for stripes, grey pictures for boards."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rxcli.types import Float32Array, Frame, Mosaic

_GREEN = 1


def light_of(frame: Frame) -> Float32Array:
    """(height, width) values proportional to light, as far as the file tells: 0 black, 1 white.

    Of a mosaic the green pixels of each row stand for the whole row, so that rows are neither mixed nor, by a coloured
    lamp, set against each other. A developed picture is taken to have an sRGB-like tone curve.
    """
    if frame.mosaic is not None:
        return _green_rows(frame.pixels, frame.mosaic)
    values = (frame.pixels.astype(np.float32) - np.float32(frame.black)) / np.float32(frame.white - frame.black)
    np.clip(values, 0, None, out=values)
    if frame.linear:
        return values
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _green_rows(pixels: NDArray[np.uint8] | NDArray[np.uint16], mosaic: Mosaic) -> Float32Array:
    """Mean of the green pixels of each row over each repeat of the pattern, spread over the pattern's width."""
    height, width = pixels.shape
    rows, columns = mosaic.pattern.shape
    blocks = max(width // columns, 1)
    green = np.zeros((height, blocks), np.float32)
    for row in range(rows):
        at = np.flatnonzero(mosaic.pattern[row] == _GREEN)
        picked = [pixels[row::rows, x : blocks * columns : columns] for x in (at if at.size else range(columns))]
        green[row::rows] = np.mean([p[:, :blocks] for p in picked], axis=0, dtype=np.float32)
    light = (green - np.float32(mosaic.black[_GREEN])) / np.float32(mosaic.white - mosaic.black[_GREEN])
    spread = np.repeat(np.clip(light, 0, None), columns, axis=1)
    return np.pad(spread, ((0, 0), (0, width - spread.shape[1])), mode="edge")


def gray_of(frame: Frame) -> NDArray[np.uint8]:
    """(height, width) grey picture for a corner detector, never rotated."""
    if frame.mosaic is None:
        if frame.pixels.dtype == np.uint8:
            return frame.pixels.astype(np.uint8, copy=False)
        scaled: Float32Array = (frame.pixels.astype(np.float32) - frame.black) * (255.0 / (frame.white - frame.black))
        return np.asarray(np.clip(scaled, 0, 255), np.uint8)
    return _balanced(frame.pixels, frame.mosaic)


def _balanced(pixels: NDArray[np.uint8] | NDArray[np.uint16], mosaic: Mosaic) -> NDArray[np.uint8]:
    """The mosaic with its colours balanced, smoothed over one period and spread over 8 bits."""
    import cv2

    height, width = pixels.shape
    rows, columns = mosaic.pattern.shape
    gains, black = (
        np.array(mosaic.gains, np.float32)[mosaic.pattern],
        np.array(mosaic.black, np.float32)[mosaic.pattern],
    )
    tiles = (height // rows + 1, width // columns + 1)
    gain, level = (np.tile(part, tiles)[:height, :width] for part in (gains, black))
    smooth = cv2.GaussianBlur((pixels.astype(np.float32) - level) * gain, (0, 0), 0.8)
    # Contrast as in a developed picture: detectors expect squares of even brightness in the shade, too.
    level_of_white = max(float(np.quantile(smooth[::8, ::8], 0.995)), 1.0)
    return np.asarray(255 * np.sqrt(np.clip(smooth / level_of_white, 0, 1)), np.uint8)
