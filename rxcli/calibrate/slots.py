"""Line delay from pictures of a screen that sends: the receiver's own estimate of an unknown camera."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rxcli.calibrate.exposure import ExposureEstimate
from rxcli.calibrate.fitting import weighted_mean
from rxcli.calibrate.shutter import Axis, ShutterCalibration
from rxcli.errors import ReceiverError
from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile
from rxcli.receiver.camera.camera import camera_profile
from rxcli.receiver.receive import receive_frame
from rxcli.results.reasons import sentence_of
from rxcli.types import Frame

_CORRECTED = "the camera corrected its lens distortion: line delay and distortion were estimated together"
REVERSED = "the picture was turned upside down: a profile is of use for pictures as the camera stores them only"


def calibrate_slots(frames: Sequence[Frame], screen: ScreenProfile, axis: Axis = "rows") -> ShutterCalibration:
    """Line delay of the sensor behind pictures that give packets when received with an unknown camera.

    Args:
        frames: pictures of one readout mode.
        screen: the screen that they show.
        axis: the readout axis.

    Raises:
        ReceiverError: no picture gives a packet.
    """
    upright = [f if axis == "rows" else replace(f, pixels=np.rot90(f.pixels)) for f in frames]
    results = [receive_frame(frame, ReceiverOptions(screens=(screen,), cameras=())) for frame in upright]
    confirmed = [r.estimated for r in results if any(p.is_believable for p in r.packets)]
    if not confirmed:
        reason = next((f" ({sentence_of(r.remarks[0]).split(';')[0]})" for r in results if r.remarks), "")
        hint = "let the whole screen show and use a short exposure; at least two rows a slot are needed"
        raise ReceiverError(f"no slot clock of a sending screen in the pictures{reason}", hint)
    value, sd = weighted_mean(*zip(*(estimated["line_delay_s"] for estimated in confirmed), strict=True))
    bent = [estimated for estimated in confirmed if "k1" in estimated]
    surest = min(bent, key=lambda estimated: estimated["k1"][1], default=confirmed[0])
    lens = camera_profile(surest, "estimated", None, None, upright[0].width, upright[0].height).lens
    is_reversed = any(estimated["readout_reversed"][0] for estimated in confirmed)
    warnings = (_CORRECTED,) * bool(bent) + (REVERSED,) * is_reversed
    exposure = ExposureEstimate(None, None, "not estimated from data; use a lamp and --frequency")
    shape, periods = (frames[0].height, frames[0].width), upright[0].height * value * screen.slot_rate_hz
    return ShutterCalibration(axis, shape, value, sd, periods, exposure, warnings=warnings, lens=lens)
