"""One trial: a simulated frame as a receiver gets it, and what the simulator knows of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import msgspec
import numpy as np

from rxcli.lab.simulate.capture import Capture, Recording, simulate_frame
from rxcli.lab.simulate.optics import View
from rxcli.lab.simulate.scenes import Scene
from rxcli.lab.simulate.truth import build_camera_profile
from rxcli.options import ReceiverOptions
from rxcli.profiles import CameraProfile
from rxcli.receiver.pipeline import receive
from rxcli.results.truth import Score, Scorer, Truth
from rxcli.types import FloatArray, Frame, FrameResult, Metadata, Mosaic

#: Source of simulated frames.
SOURCE = "simulated"


@dataclass(frozen=True)
class Trial:
    """A simulated frame as the receiver is given it, with what the simulator knows of it."""

    capture: Capture
    index: int = 0

    @cached_property
    def frame(self) -> Frame:
        """The frame, as an ingest stage would hand it on."""
        return frame_of(self.capture, self.index)

    @cached_property
    def camera(self) -> CameraProfile:
        """The camera as a perfect calibration would know it."""
        profile = build_camera_profile(self.capture.scene, self.capture.exposure)
        scene = self.capture.scene
        tone = scene.isp.tone if scene.isp.tone in ("linear", "srgb", "bt709") else "auto"
        return msgspec.structs.replace(profile, tone=tone)

    @cached_property
    def corners(self) -> FloatArray:
        """(4, 2) the screen's corners on the stored picture, top-left first, clockwise for a viewer."""
        scene = self.capture.scene
        corrected = scene.isp.correct_distortion and scene.output == "developed"
        return corners_on_picture(self.capture.exposure.view, corrected)

    @cached_property
    def truth(self) -> Truth:
        """What was sent."""
        return msgspec.convert(self.capture.truth, Truth, str_keys=True)

    def options(self, *, known_outline: bool = True, **more: Any) -> ReceiverOptions:
        """Options of the receiver that name the screen and the camera.

        Args:
            known_outline: hand over the true corners; otherwise the receiver looks for the screen.
            more: further fields of `ReceiverOptions`.
        """
        return ReceiverOptions(
            screens=(self.capture.scene.screen,),
            cameras=(self.camera,),
            force_camera=True,
            corners=self.corners if known_outline else None,
            **more,
        )

    def receive(self, options: ReceiverOptions) -> tuple[FrameResult, Score]:
        """The receiver's result, wrong bits filled in, and its score."""
        return score_result(next(iter(receive([self.frame], options))), self.truth)


def score_result(result: FrameResult, truth: Truth) -> tuple[FrameResult, Score]:
    """`result` with wrong bits filled in, and its score; a trial's truth holds one frame, numbered 0."""
    scorer = Scorer(truth)
    scored = scorer.add(replace(result, frame=0))
    return scored, scorer.score()


def truth_of(recording: Recording) -> Truth:
    """What all frames of a scene send."""
    return msgspec.convert(recording.truth("clip"), Truth, str_keys=True)


def simulate_trial(scene: Scene, seed: int, *, oracle: bool = False, threads: int = 1) -> Trial:
    """Simulate one frame of `scene`; equal seeds give equal pixels."""
    return Trial(simulate_frame(scene, np.random.default_rng(seed), oracle=oracle, threads=threads))


def corners_on_picture(view: View, corrected: bool) -> FloatArray:
    """(4, 2) corners of the screen on a picture whose distortion was corrected in the camera, or not."""
    if not corrected:
        return view.corners
    matrix = view.camera_matrix
    return np.asarray(view.pixels_to_ideal(view.corners) * matrix[[0, 1], [0, 1]] + matrix[:2, 2])


def frame_of(capture: Capture, index: int = 0) -> Frame:
    """A capture as a frame: the luma of its JPEG, or its mosaic."""
    scene = capture.scene
    metadata = Metadata(make=scene.make, model=scene.model, exposure_s=scene.exposure_s, orientation=scene.orientation)
    mosaic = mosaic_of(scene) if capture.scene.is_mosaic else None
    return Frame(pixels=capture.pixels, source=SOURCE, index=index, metadata=metadata, mosaic=mosaic)


def mosaic_of(scene: Scene) -> Mosaic:
    """Colour filter array and levels of a raw scene's frames."""
    sensor = scene.sensor
    pattern = sensor.pattern
    assert pattern is not None, "only sensors with a colour filter array give mosaics"
    red, green, blue = sensor.response
    return Mosaic(
        pattern=pattern,
        gains=(green / red, 1.0, green / blue),
        black=(float(sensor.black_level),) * 3,
        white=float(sensor.white_level),
    )
