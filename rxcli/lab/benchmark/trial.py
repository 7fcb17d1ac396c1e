"""One trial: a simulated frame as a receiver gets it, and what the simulator knows of it."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import msgspec
import numpy as np

from rxcli.lab.simulate.camera import Exposure
from rxcli.lab.simulate.capture import Capture, prepare
from rxcli.lab.simulate.optics import View
from rxcli.lab.simulate.scenes import Scene
from rxcli.lab.simulate.truth import build_camera_profile
from rxcli.options import ReceiverOptions
from rxcli.profiles import CameraProfile
from rxcli.results.truth import Truth
from rxcli.types import FloatArray, Frame, Metadata, Mosaic

#: Source of simulated frames.
SOURCE = "simulated"


@dataclass(frozen=True)
class Trial:
    """A simulated frame as the receiver is given it, with what the simulator knows of it."""

    capture: Capture

    @cached_property
    def frame(self) -> Frame:
        """The frame, as an ingest stage would hand it on: the luma of its JPEG, or its mosaic."""
        scene, sensor, mosaic = self.capture.scene, self.capture.scene.sensor, None
        exposure_s, orientation = scene.exposure_s, scene.orientation
        metadata = Metadata(make=scene.make, model=scene.model, exposure_s=exposure_s, orientation=orientation)
        if scene.is_mosaic and sensor.pattern is not None:
            red, green, blue = sensor.response
            black, gains = (float(sensor.black_level),) * 3, (green / red, 1.0, green / blue)
            mosaic = Mosaic(pattern=sensor.pattern, gains=gains, black=black, white=float(sensor.white_level))
        return Frame(self.capture.pixels, SOURCE, self.capture.frame, metadata=metadata, mosaic=mosaic)

    @cached_property
    def camera(self) -> CameraProfile:
        """The camera as a perfect calibration would know it."""
        return self.options().cameras[0]

    @cached_property
    def corners(self) -> FloatArray | None:
        """(4, 2) the screen's corners on the stored picture, top-left first, clockwise for a viewer."""
        return self.options().corners

    @cached_property
    def truth(self) -> Truth:
        """What was sent."""
        return msgspec.convert(self.capture.truth, Truth, str_keys=True)

    def options(self, **more: Any) -> ReceiverOptions:
        """Options of the receiver that name screen, camera and corners; `more` are further fields."""
        return replace(known_options(self.capture.exposure), **more)


def simulate_trial(scene: Scene, seed: int, *, oracle: bool = False) -> Trial:
    """Simulate one frame of `scene`; equal seeds give equal pixels."""
    return Trial(prepare(scene, seed).frame(oracle=oracle, threads=1))


def known_options(exposure: Exposure) -> ReceiverOptions:
    """Options that name screen, corners, and the camera as a perfect calibration would know it."""
    scene = exposure.scene
    tone = scene.isp.tone if scene.isp.tone in ("linear", "srgb", "bt709") else "auto"
    camera = msgspec.structs.replace(build_camera_profile(scene, exposure), tone=tone)
    corners = corrected_corners(exposure.view) if scene.is_corrected else exposure.corners
    return ReceiverOptions(screens=(scene.screen,), cameras=(camera,), force_camera=True, corners=corners)


def corrected_corners(view: View) -> FloatArray:
    """(4, 2) corners of the screen on a picture whose distortion was corrected in the camera."""
    matrix = view.camera_matrix
    return np.asarray(view.pixels_to_ideal(view.corners) * matrix[[0, 1], [0, 1]] + matrix[:2, 2])
