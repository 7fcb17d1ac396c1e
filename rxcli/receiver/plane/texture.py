"""A frame of a clip without the texture of its picture, which all frames have in common: slots are left.

The texture hides the slots of a long exposure, which change the light by little. The mean of other frames shows it, and
hardly their slots, which differ from frame to frame.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rxcli.receiver.plane.rows import tone_to_light
from rxcli.types import Float32Array, FloatArray, Frame

#: Light that every frame is taken to have besides, of full light, so that the noise of dark parts is no texture.
_ADDED_LIGHT = 0.002
#: Share of the picture's height over which its light is a level, and no texture.
_LEVEL_SHARE = 0.2
#: Motion that is none, pixels.
_STILL_PX = 0.1
_WHITE = 65535
#: Texture that noise of other frames may add to a frame that shows the same, as a factor.
_TEXTURE_LIMIT = 1.2


def without_texture(frame: Frame, frames: Sequence[Frame], tone: str) -> Frame:
    """The light of a frame over the mean of other frames, at its level.

    Args:
        frame: a developed picture.
        frames: others of the same camera, of as many pixels; at least one.
        tone: the curve to undo, see `tone_to_light`.
    """
    import cv2

    table = _light_of_values(frame, tone)
    light = table.take(frame.pixels)
    mean, texture = np.zeros_like(light), _gradient(light)
    for each in frames:
        mean += _moved(table.take(each.pixels), texture)
    mean /= np.float32(len(frames))
    light *= cv2.blur(mean, (1, round(_LEVEL_SHARE * frame.height)))
    light /= mean
    light -= np.float32(_ADDED_LIGHT)
    pixels = np.rint(np.clip(light, 0, 1, out=light) * np.float32(_WHITE)).astype(np.uint16)
    return replace(frame, pixels=pixels, black=0.0, white=float(_WHITE), linear=True, colours=None)


def shows_same(frame: Frame, flat: Frame, tone: str) -> bool:
    """Whether a frame shows the picture whose texture was taken out of it.

    Args:
        frame: a frame.
        flat: the same `without_texture`; that of another picture is added to the frame's own.
        tone: of the frame.
    """
    before, after = (_gradient(_light_of_values(each, tone).take(each.pixels)) for each in (frame, flat))
    return float(np.abs(after).mean()) <= _TEXTURE_LIMIT * float(np.abs(before).mean())


def shift_of_texture(frame: Frame, to: Frame, tone: str) -> FloatArray:
    """(2,) pixels x and y from where the texture of a frame is to where it is in another one."""
    table = _light_of_values(frame, tone)
    return _shift(table.take(frame.pixels), _gradient(table.take(to.pixels)))


def _moved(light: Float32Array, texture: Float32Array) -> Float32Array:
    """The light of a frame, moved so that its texture is where that of another one is."""
    import cv2

    shift = _shift(light, texture)
    if np.abs(shift).max() < _STILL_PX:
        return light
    motion = np.array([[1, 0, shift[0]], [0, 1, shift[1]]])
    return np.asarray(cv2.warpAffine(light, motion, light.shape[::-1], borderMode=cv2.BORDER_REPLICATE))


def _shift(light: Float32Array, texture: Float32Array) -> FloatArray:
    """(2,) pixels x and y by which the texture of light is further left and up than that of another frame."""
    import cv2

    shift, _ = cv2.phaseCorrelate(_gradient(light), texture)
    return 2 * np.array(shift)


def _gradient(light: Float32Array) -> Float32Array:
    """Texture: changes of the logarithm of light along the rows, which stripes leave alone, at half the size."""
    import cv2

    half = cv2.resize(light, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return np.diff(np.log(half), axis=1)


def _light_of_values(frame: Frame, tone: str) -> Float32Array:
    values = np.arange(np.iinfo(frame.pixels.dtype).max + 1, dtype=np.float64)
    encoded = np.clip((values - frame.black) / (frame.white - frame.black), 0, 1)
    light = encoded if frame.linear else tone_to_light(tone, encoded)
    return np.asarray(light + _ADDED_LIGHT, np.float32)
