"""Where the screen's corners are in a frame, and what to say where they are not found. Part of the wiring."""

from __future__ import annotations

from typing import Any

import numpy as np

from rxcli.profiles import ScreenProfile
from rxcli.receiver.context import Failure, FrameContext
from rxcli.receiver.screen import geometry
from rxcli.types import FloatArray, Frame

#: Orientations in which the readout runs along the columns' width.
_PORTRAIT = (5, 6, 7, 8)


def unreadable_orientation(frame: Frame) -> Failure | None:
    """Why a picture whose readout runs along the columns' width cannot be received; None for others."""
    orientation = frame.metadata.orientation
    if orientation not in _PORTRAIT:
        return None
    return Failure(
        "no_signal",
        f"the picture was taken in portrait (EXIF orientation {orientation}): the sensor reads along the width of "
        "the columns, so that they cannot be told apart; hold the camera in landscape",
    )


def whole_picture(frame: Frame) -> FloatArray:
    """(4, 2) the picture's own corners, the viewer's top left first: it may show nothing but a part of the screen."""
    right, bottom = frame.width - 1.0, frame.height - 1.0
    corners = np.array([[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]])
    return geometry.viewer_order(corners, frame.metadata.orientation)


def levels_of(frame: Frame) -> dict[str, Any]:
    """What pixel values mean, by the names of the arguments of `find_screen` and `measure_side_curvature`."""
    levels = frame.mosaic
    if levels is None:
        return {"black": frame.black, "white": frame.white}
    return {"black": float(np.mean(levels.black)), "white": levels.white, "mosaic_period": levels.pattern.shape[1]}


def too_small(context: FrameContext, screen: ScreenProfile) -> str | None:
    """Why no packet of `screen` fits the rows that show it, None where one does."""
    frame, camera = context.frame, context.camera
    fill = float(np.ptp(np.clip(context.corners[:, 1], 0, frame.height - 1))) / frame.height
    needed = screen.packet_s / (camera.line_delay_s * frame.height)
    if fill >= needed:
        return None
    advice = "move closer" if needed < 1 else "use a faster slot rate or shorter packets"
    return (
        f"the screen fills {np.floor(100 * fill):.0f} % of the height: one packet at {screen.slot_rate_hz / 1e3:g} kHz "
        f"needs {np.ceil(100 * needed):.0f} % with this camera; {advice}"
    )
