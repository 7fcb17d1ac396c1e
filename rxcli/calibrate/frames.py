"""Light of a frame, for the stripes of lamps."""

import cv2
import numpy as np

from rxcli.receiver.plane.rows import tone_to_light
from rxcli.types import Float32Array, Frame

_GREEN = 1


def frame_light(frame: Frame) -> Float32Array:
    """(height, width) values proportional to light, as far as the file states: 0 black, 1 white.

    Of a mosaic the green pixels of each row stand for the whole row: rows are not mixed, and a coloured lamp makes no
    pattern. A developed picture is taken to have the sRGB tone curve.
    """
    pixels = frame.pixels.astype(np.float32)
    if frame.mosaic is not None:
        black, white = frame.mosaic.black[_GREEN], frame.mosaic.white
        pattern = frame.mosaic.pattern
        rows, columns = (np.arange(n) % period for n, period in zip(pixels.shape, pattern.shape, strict=True))
        green = (pattern[np.ix_(rows, columns)] == _GREEN).astype(np.float32)
        green[~green.any(axis=1)] = 1
        window = (2 * pattern.shape[1] - 1, 1)
        total, count = (cv2.boxFilter(part, -1, window, normalize=False) for part in (pixels * green, green))
        return np.asarray(np.clip((total / count - black) / (white - black), 0, None), np.float32)
    values = np.clip((pixels - np.float32(frame.black)) / np.float32(frame.white - frame.black), 0, None)
    return np.asarray(tone_to_light("linear" if frame.linear else "srgb", values), np.float32)
