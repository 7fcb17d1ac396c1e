"""Clips from a hand: what comes of them by how fast the picture moves, and what of their frames one by one.

The same scene is filmed at every speed: whole 1080p frames, through H.264, screen and camera named, the outline to be
found. A clip takes a minute or so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rxcli.lab.benchmark.confidence import reported_packets
from rxcli.lab.benchmark.journal import Record, Task
from rxcli.lab.benchmark.tables import Row
from rxcli.lab.benchmark.trial import receive_clip, truth_of
from rxcli.lab.simulate.capture import Take, prepare
from rxcli.lab.simulate.pictures import draw_name
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.lab.simulate.truth import build_camera_profile
from rxcli.lab.simulate.video import write_video
from rxcli.options import SKIPS
from rxcli.receiver.pipeline import ReceiverOptions
from rxcli.results.truth import Truth

#: Pixels from frame to frame, on average.
SPEEDS_PX = (0.0, 2.0, 4.0, 8.0)
_SCREENS = ("paper-8k65", "paper-17k3")
#: Bits per pixel and frame: a phone's or a camera's, not a starved encoder's.
_BITS_PER_PIXEL = (0.12, 0.5)
#: Confidence from which a wrong packet counts as surely wrong.
_SURE = 0.99


def scene_of(seed: int, n_frames: int) -> Scene:
    """A clip of a random picture and pose, on a tripod."""
    rng = np.random.default_rng([seed, 5])
    base = preset("video-1080p", str(rng.choice(_SCREENS)))
    exposure_s = float(rng.choice([0.5, 1.0]) * rng.uniform(0.85, 1.15)) / base.screen.slot_rate_hz
    pose = replace(
        base.pose,
        fill=rng.uniform(0.75, 0.88),
        roll_deg=rng.normal(0, 1.2),
        yaw_deg=rng.normal(0, 3),
        pitch_deg=rng.normal(0, 2),
    )
    return replace(
        base,
        picture=draw_name(rng),
        w=5 if rng.random() < 0.6 else int(rng.integers(3, 8)),
        pose=pose,
        exposure_s=exposure_s,
        light_e_per_s=base.light_e_per_s * (base.exposure_s / exposure_s) * 10 ** rng.uniform(-0.5, 0.2),
        shake_px=0.0,
        n_frames=n_frames,
    )


def record_of(task: Task) -> Record:
    """Film one scene at every speed, and receive it as a clip and frame by frame."""
    scene = scene_of(task["seed"], task["n_frames"])
    rng = np.random.default_rng([task["seed"], 6])
    bits = np.exp(rng.uniform(*np.log(_BITS_PER_PIXEL)))
    bit_rate = int(bits * scene.sensor.width * scene.sensor.height * scene.frame_rate_hz)
    moving = [_received(prepare(replace(scene, hand_px=speed), task["seed"]), bit_rate) for speed in SPEEDS_PX]
    return {"screen": scene.screen.name, "picture": scene.picture, "speeds": moving}


def _received(take: Take, bit_rate: int) -> dict[str, Record]:
    scene = take.scene
    options = ReceiverOptions(
        screens=(scene.screen,), cameras=(build_camera_profile(scene, take.exposure()),), force_camera=True
    )
    truth = truth_of(take)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "clip.mp4"
        frames = (take.frame(n, threads=1).rgb for n in range(scene.n_frames))
        write_video(frames, path, "h264", scene.frame_rate_hz, bit_rate)
        one_by_one = replace(options, skip=frozenset(SKIPS) - {"tracking"})
        return {"clip": _scored(path, options, truth), "one_by_one": _scored(path, one_by_one, truth)}


def _scored(path: Path, options: ReceiverOptions, truth: Truth) -> Record:
    results, score = receive_clip(path, options, truth)
    packets = [packet for result in results for packet in reported_packets(result, truth.w)]
    sure = [packet["bit_errors"] for packet in packets if packet["confidence"] >= _SURE]
    return {
        "expected": score.expected,
        "error_free": score.error_free,
        "false": score.false,
        "sure": len(sure),
        "surely_wrong": sum(errors != 0 for errors in sure),
    }


def rows(records: Sequence[Record]) -> list[Row]:
    """One a speed: sums over the clips."""
    return [
        {"pixels_a_frame": speed, "expected": _sum(records, number, "clip", "expected")}
        | {
            f"{way}_{name}": _sum(records, number, way, name)
            for way in ("clip", "one_by_one")
            for name in ("error_free", "false", "sure", "surely_wrong")
        }
        for number, speed in enumerate(SPEEDS_PX)
    ]


def _sum(records: Sequence[Record], number: int, way: str, name: str) -> int:
    return sum(int(record["speeds"][number][way][name]) for record in records)
