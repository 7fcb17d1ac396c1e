"""Line delay from pictures of a screen that sends: the receiver's own estimate of an unknown camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rxcli.calibrate.exposure import ExposureEstimate
from rxcli.calibrate.fitting import weighted_mean
from rxcli.calibrate.shutter import Axis, ShutterCalibration
from rxcli.errors import ReceiverError
from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile
from rxcli.receiver.pipeline import receive_frame
from rxcli.types import Frame

#: Confidence of a packet that confirms a picture's slot clock.
_MIN_CONFIDENCE = 0.5


def calibrate_slots(frames: Sequence[Frame], screen: ScreenProfile, axis: Axis = "rows") -> ShutterCalibration:
    """Line delay of the sensor behind pictures that give packets when received with an unknown camera.

    Args:
        frames: pictures of one readout mode.
        screen: the screen that they show.
        axis: the readout axis.

    Raises:
        ReceiverError: no picture gives a packet.
    """
    options = ReceiverOptions(screens=(screen,), cameras=())
    upright = [f if axis == "rows" else replace(f, pixels=np.rot90(f.pixels)) for f in frames]
    results = [receive_frame(frame, options) for frame in upright]
    confirmed = [r.estimated for r in results if any(p.confidence >= _MIN_CONFIDENCE for p in r.packets)]
    if not confirmed:
        reason = next((f" ({r.message.split(';')[0]})" for r in results if r.message), "")
        hint = "let the whole screen show and use a short exposure; at least two rows a slot are needed"
        raise ReceiverError(f"no slot clock of a sending screen in the pictures{reason}", hint)
    value, sd = weighted_mean(*zip(*(estimated["line_delay_s"] for estimated in confirmed), strict=True))
    bent = any("k1" in estimated for estimated in confirmed)
    warning = "the camera corrected its lens distortion: line delay and distortion were estimated together"
    exposure = ExposureEstimate(None, None, "not estimated from data; use a lamp and --frequency")
    shape, periods = (frames[0].height, frames[0].width), upright[0].height * value * screen.slot_rate_hz
    return ShutterCalibration(axis, shape, value, sd, periods, exposure, warnings=(warning,) * bent)
