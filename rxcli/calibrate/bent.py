"""Line delay from pictures of a sending screen whose stripes are bent: their lens distortion was taken out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rxcli.calibrate.shutter import ShutterCalibration, weighted_mean
from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile
from rxcli.receiver.cameras import find_camera
from rxcli.receiver.context import Failure, Timer
from rxcli.receiver.outline import find_outline
from rxcli.types import Frame

_NOTE = (
    "the stripes are bent, as in a picture whose lens distortion the camera took out: line delay and bend were "
    "estimated together"
)
#: Pictures that are looked at; one takes a second or two.
_MOST = 8


def calibrate_bent(frames: Sequence[Frame], screen: ScreenProfile) -> ShutterCalibration | None:
    """Line delay of the sensor behind pictures whose distortion was corrected; None where no bent stripes are seen.

    There, no row is an instant, and the slot clock along the picture's rows is not the sensor's.

    Args:
        frames: pictures of one readout mode.
        screen: what they show.
    """
    found = [one for frame in frames[:_MOST] if frame.mosaic is None and (one := _bent_line_delay(frame, screen))]
    if not found:
        return None
    value, sd = weighted_mean(*np.array(found).T)
    frame = frames[0]
    return ShutterCalibration(
        "rows",
        (frame.height, frame.width),
        value,
        sd,
        periods=frame.height * value * screen.slot_rate_hz,
        exposure_note="not told by data; use a lamp and --frequency",
        warnings=(_NOTE,),
    )


def _bent_line_delay(frame: Frame, screen: ScreenProfile) -> tuple[float, float] | None:
    """Line delay and its standard deviation; None where no screen is found or its stripes are not bent."""
    options = ReceiverOptions(screens=(screen,), cameras=())
    outline = find_outline(frame, options, Timer())
    context = outline if isinstance(outline, Failure) else find_camera(frame, outline.corners, options, Timer())
    if isinstance(context, Failure):
        return None
    estimated = context.camera.estimated
    return estimated["line_delay_s"] if "k1" in estimated else None
