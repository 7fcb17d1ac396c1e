"""A small, easy scene of the simulator: short packets, two of them in a frame, no distortion."""

from dataclasses import replace
from typing import Any

import msgspec

from rxcli.lab.benchmark.trial import Trial
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.options import ReceiverOptions
from rxcli.profiles import CameraProfile, check_profile
from rxcli.receiver.receive import receive
from rxcli.results.truth import Score, Scorer, Truth
from rxcli.types import FrameResult

#: Width, height, rows per slot.
MODES = {"still": (640, 360, 3.0), "clip": (704, 396, 3.0)}
EXPOSURE_S = 1 / 12000
_SLOT_RATE_HZ = 8650.0


def scene(mode: str, picture: str) -> Scene:
    """The scene in a mode ("clip" gives several frames) with a picture on the screen."""
    width, height, rows_per_slot = MODES[mode]
    base = preset("video-1080p" if mode == "clip" else "phone-plain", "paper-8k65")
    delay_s = 1 / (rows_per_slot * _SLOT_RATE_HZ)
    return replace(
        base,
        # A coarse panel: drawing its picture would otherwise take longer than all the rest.
        screen=msgspec.structs.replace(
            base.screen, name="short-packets", payload_symbols=3, width_px=342, height_px=192
        ),
        picture=picture,
        sensor=replace(base.sensor, width=width, height=height, line_delay_s=delay_s, full_scale_e=4000.0),
        lens=replace(base.lens, distortion=(0.0,) * 5),
        pose=replace(base.pose, fill=0.88, roll_deg=0.3, yaw_deg=1.0, pitch_deg=-0.5),
        isp=replace(base.isp, tone="srgb"),
        exposure_s=EXPOSURE_S,
        light_e_per_s=900 / EXPOSURE_S,
        room=replace(base.room, light_e_per_s=8 / EXPOSURE_S),
        blur_px=0.6,
        panel=0.0,
        make="Example",
        model="Folder",
        camera_name="folder",
        n_frames=4 if mode == "clip" else 1,
        frame_rate_hz=30.0,
    )


def camera_of(camera: dict[str, Any], tone: str = "auto") -> CameraProfile:
    """The profile of the camera that a truth names."""
    size = {"width": camera["width"], "height": camera["height"]}
    mode = {"name": "truth", **size, "line_delay_s": camera["line_delay_s"], "exposure_s": camera["exposure_s"]}
    lens = {key: camera[key] for key in ("camera_matrix", "dist_coeffs", "distortion_already_corrected")}
    raw = {"format": 1, "kind": "camera", "name": "truth", "tone": tone, "modes": [mode], "lens": {**size, **lens}}
    return check_profile(raw, CameraProfile, "truth")


def scored(result: FrameResult, truth: Truth) -> tuple[FrameResult, Score]:
    """A result with wrong bits filled in, and its score; the truth holds one frame, numbered 0."""
    scorer = Scorer(truth)
    return scorer.add(replace(result, frame=0)), scorer.score()


def reception(trial: Trial, options: ReceiverOptions) -> tuple[FrameResult, Score]:
    """The scored result of a trial's frame."""
    return scored(next(iter(receive([trial.frame], options))), trial.truth)
