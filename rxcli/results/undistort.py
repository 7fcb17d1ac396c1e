"""Whole pictures without their lens distortion, for people to look at; the receiver itself never warps pixels."""

import logging
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rxcli.outputs import PICTURE, encode_png, tapped
from rxcli.profiles import CameraProfile, match_camera
from rxcli.receiver.screen.geometry import lens_for
from rxcli.results.cameras import camera_of
from rxcli.results.dump import MAX_NAME_BYTES, plain_name
from rxcli.types import Float32Array, Frame, FrameResult, Lens, Mosaic

log = logging.getLogger(__name__)

#: Frames that may wait for their result: a clip's come some frames later.
_MAX_WAITING = 48


def undistorted(frame: Frame, lens: Lens) -> NDArray[np.uint8]:
    """The frame as seen through a lens without distortion, (height, width) uint8 grey; a mosaic becomes grey first.

    Args:
        frame: a picture as stored.
        lens: the lens model for pictures of its size.
    """
    import cv2

    grey = grey_levels(frame)
    if lens.corrected:
        return grey
    return np.asarray(cv2.undistort(grey, lens.camera_matrix, lens.dist_coeffs), np.uint8)


def grey_levels(frame: Frame, step: int = 1) -> NDArray[np.uint8]:
    """The frame as (height, width) uint8 grey levels for the eye: RAW and linear pictures get a display's gamma.

    Args:
        frame: a picture as stored.
        step: decimation of rows and columns, applied to the whole picture.
    """
    if frame.mosaic is None:
        share = (frame.pixels[::step, ::step].astype(np.float32) - frame.black) / (frame.white - frame.black)
    else:
        share = _mosaic_grey(frame.pixels, frame.mosaic)[::step, ::step]
    share = np.clip(share, 0, 1)
    if frame.linear or frame.mosaic is not None:
        share **= 1 / 2.2
    levels: NDArray[np.uint8] = np.round(255 * share).astype(np.uint8)
    return levels


def _mosaic_grey(pixels: NDArray[np.uint8] | NDArray[np.uint16], mosaic: Mosaic) -> Float32Array:
    """The mosaic's colours on one scale, 0 to 1, averaged over three by three pixels to hide its pattern."""
    import cv2

    black, gains = np.array(mosaic.black, np.float32), np.array(mosaic.gains, np.float32)
    scale = gains / (np.float32(mosaic.white) - black)
    height, width = mosaic.pattern.shape
    values = np.empty(pixels.shape, np.float32)
    for y, x in np.ndindex(height, width):
        colour = int(mosaic.pattern[y, x])
        values[y::height, x::width] = (pixels[y::height, x::width] - black[colour]) * scale[colour]
    return np.asarray(cv2.blur(values, (3, 3)), np.float32)


@dataclass(frozen=True, slots=True)
class UndistortedWriter:
    """Writes every frame it is given into a folder, undistorted, as PNG; picklable.

    A frame without a lens profile waits for its result, which may hold an estimated lens.
    """

    folder: Path
    cameras: tuple[CameraProfile, ...]
    #: Use the first camera for every file.
    force_camera: bool = False
    #: Frames that wait, by source and index.
    _waiting: dict[tuple[str, int], Frame] = field(default_factory=dict, compare=False)

    def __call__(self, frame: Frame, subfolder: str = "") -> None:
        """Write `frame` into a subfolder, or keep it until its result comes.

        Raises:
            OutputError: the file cannot be written, or is there and none of ours.
        """
        meta = frame.metadata
        fits = match_camera(self.cameras, meta.make, meta.model, frame.width, frame.height)
        if not self._write(frame, self.cameras[0] if self.force_camera else fits, subfolder):
            self._waiting[frame.source, frame.index] = frame
        while len(self._waiting) > _MAX_WAITING:
            self._give_up(self._waiting.pop(next(iter(self._waiting))))

    def finish(self, result: FrameResult, subfolder: str = "") -> None:
        """Write the frame that a result is of, if it has waited; one without a lens is passed over with a warning.

        Raises:
            OutputError: the file cannot be written, or is there and none of ours.
        """
        frame = self._waiting.pop((result.source, result.frame), None)
        if frame is not None and not self._write(frame, camera_of(frame, result, self.cameras), subfolder):
            self._give_up(frame)

    def _write(self, frame: Frame, camera: CameraProfile | None, subfolder: str) -> bool:
        """Write a frame if the lens of its camera is known; returns whether it is."""
        lens = lens_for(camera.lens, frame.width, frame.height) if camera and camera.lens else None
        if lens is None:
            return False
        name = Path(frame.source).name
        name = name if len(os.fsencode(name)) <= MAX_NAME_BYTES else plain_name(name)
        path = self.folder / subfolder / f"{name}.{frame.index:05d}.png"
        with tapped(path, PICTURE, "--save-undistorted") as hidden:
            hidden.write_bytes(encode_png(undistorted(frame, lens)))
        return True

    @staticmethod
    def _give_up(frame: Frame) -> None:
        log.warning(
            "%s: no camera profile with a lens fits, and none could be estimated; not undistorted (name one with "
            "--camera)",
            frame.source,
        )
