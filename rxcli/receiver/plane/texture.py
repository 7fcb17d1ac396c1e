"""A frame of a clip without the texture of its picture, which all frames have in common: slots are left.

The texture hides the slots of a long exposure, which change the light by little. The mean of other frames shows it, and
hardly their slots, which differ from frame to frame.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rxcli.receiver.plane.rows import light_of_levels, tone_to_light
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


class CommonTexture:
    """The texture that frames of a clip have in common; it is summed once, where the first of them has it.

    Args:
        frames: developed pictures of one camera, of as many pixels; at least two.
        tone: the curve to undo, see `tone_to_light`.
    """

    def __init__(self, frames: Sequence[Frame], tone: str) -> None:
        self._frames, self._table = frames, _light_of_values(frames[0], tone)
        self._total = self._light(0)
        texture = _gradient(self._total)
        #: Of each frame, (2,) pixels x and y from where its texture is in the first one.
        self.shifts = [np.zeros(2)]
        for number in range(1, len(frames)):
            light = self._light(number)
            self.shifts.append(-_shift(light, texture))
            self._total += _moved(light, -self.shifts[number])

    def removed_from(self, number: int) -> Frame:
        """The light of a frame over the mean of the others, at its level."""
        import cv2

        frame, light, shift = self._frames[number], self._light(number), self.shifts[number]
        mean = _moved(self._total - _moved(light, -shift), shift) / np.float32(len(self._frames) - 1)
        light *= cv2.blur(mean, (1, round(_LEVEL_SHARE * frame.height)))
        light /= mean
        light -= np.float32(_ADDED_LIGHT)
        pixels = np.rint(np.clip(light, 0, 1, out=light) * np.float32(_WHITE)).astype(np.uint16)
        return replace(frame, pixels=pixels, black=0.0, white=float(_WHITE), linear=True, colours=None)

    def _light(self, number: int) -> Float32Array:
        return self._table.take(self._frames[number].pixels)


def shows_same(frame: Frame, flat: Frame, tone: str) -> bool:
    """Whether a frame shows the picture whose texture was taken out of it.

    Args:
        frame: a frame.
        flat: the same without its `CommonTexture`; that of another picture is added to the frame's own.
        tone: of the frame.
    """
    before, after = (_gradient(_light_of_values(each, tone).take(each.pixels)) for each in (frame, flat))
    return float(np.abs(after).mean()) <= _TEXTURE_LIMIT * float(np.abs(before).mean())


def _moved(light: Float32Array, shift: FloatArray) -> Float32Array:
    """Light moved by (2,) pixels x and y."""
    import cv2

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
    light = light_of_levels(frame, 1, lambda coded: tone_to_light(tone, coded))
    return np.asarray(light + _ADDED_LIGHT, np.float32)
