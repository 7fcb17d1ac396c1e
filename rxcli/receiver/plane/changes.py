"""What changed from one frame of a clip to the next: there the picture cancels and only slots are left."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rxcli.receiver.plane.rows import tone_to_light
from rxcli.types import Float32Array, Frame

#: Light that both frames are taken to have besides, of full light, so that the noise of dark parts is no change.
_ADDED_LIGHT = 0.002


def changed_light(frame: Frame, following: Frame, tone: str) -> Frame:
    """The share of a frame in its own light and that of another one, as a picture of eight bits.

    Args:
        frame: a developed picture.
        following: another one of the same camera, of as many pixels.
        tone: the curve to undo, see `tone_to_light`.
    """
    table = _light_of_values(frame, tone)
    light = table.take(frame.pixels)
    total = table.take(following.pixels)
    total += light
    share = np.divide(light, total, out=total)
    share *= np.float32(255)
    np.rint(share, out=share)
    return replace(frame, pixels=share.astype(np.uint8), black=0.0, white=255.0, linear=True, colours=None)


def _light_of_values(frame: Frame, tone: str) -> Float32Array:
    values = np.arange(np.iinfo(frame.pixels.dtype).max + 1, dtype=np.float64)
    encoded = np.clip((values - frame.black) / (frame.white - frame.black), 0, 1)
    light = encoded if frame.linear else tone_to_light(tone, encoded)
    return np.asarray(light + _ADDED_LIGHT, np.float32)
