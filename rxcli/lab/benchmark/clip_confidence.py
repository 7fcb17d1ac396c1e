"""The question of `rxcli.lab.benchmark.confidence` of clips: through real encoders, from ample bits to starved ones."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np

from rxcli.ingest import open_source
from rxcli.lab.benchmark.confidence import reported_packets
from rxcli.lab.benchmark.journal import Record, Task
from rxcli.lab.simulate.capture import Take, prepare
from rxcli.lab.simulate.pictures import GENERATED, PHOTOS
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.lab.simulate.truth import build_camera_profile
from rxcli.lab.simulate.video import write_video
from rxcli.receiver.pipeline import CaeMode, ReceiverOptions, receive
from rxcli.results.truth import Scorer, Truth

#: Camera and screen; the fastest link has too few rows per slot in 1080p.
_KINDS = (("video-1080p", "paper-8k65"), ("video-1080p", "paper-17k3"), ("video-4k", "paper-34k6"))
#: Widths in pixels: few, because many clips are wanted; the rows stay as many as they are.
_WIDTH_PX = (360, 720)
_FRAMES = (2, 14)
#: Bits per pixel and frame, from starved to ample.
_BITS_PER_PIXEL = (0.03, 1.5)
_CODECS = ("h264", "h264", "hevc")


@dataclass(frozen=True)
class ClipScene:
    """A scene and how its clip is compressed."""

    scene: Scene
    codec: str
    #: Bits per second.
    bit_rate: int


def scene_of(seed: int) -> ClipScene:
    """A short, narrow clip of random quality: from clean to hopeless."""
    rng = np.random.default_rng([seed, 17])
    base = preset(*_KINDS[rng.integers(len(_KINDS))])
    # Encoders want even numbers of pixels.
    base = base.scaled(2 * int(rng.integers(*_WIDTH_PX) / 2) / base.sensor.width, 1.0)
    exposure_slots = rng.choice([0.5, 1.0, 1.5]) * rng.uniform(0.8, 1.2)
    exposure_s = max(float(exposure_slots) / base.screen.slot_rate_hz, 1 / 32000)
    scene = replace(
        base,
        picture=str(rng.choice([*PHOTOS, *(name for name in GENERATED if name != "black")])),
        w="dimming" if rng.random() < 0.3 else int(rng.integers(2, 9)),
        pose=replace(base.pose, fill=rng.uniform(0.8, 0.97), roll_deg=rng.normal(0, 0.5), yaw_deg=rng.normal(0, 2)),
        exposure_s=exposure_s,
        light_e_per_s=base.light_e_per_s * (base.exposure_s / exposure_s) * 10 ** rng.uniform(-1.0, 0.3),
        slot_rate_error_ppm=rng.uniform(-100, 100),
        shake_px=base.shake_px * rng.uniform(0, 0.5),
        n_frames=int(rng.integers(*_FRAMES, endpoint=True)),
    )
    pixels = scene.sensor.width * scene.sensor.height * scene.frame_rate_hz
    bits = np.exp(rng.uniform(*np.log(_BITS_PER_PIXEL)))
    return ClipScene(scene, str(rng.choice(_CODECS)), int(bits * pixels))


@contextmanager
def clip_of(seed: int, folder: Path | None = None) -> Iterator[tuple[Path, Take]]:
    """The clip as a file, in a folder that goes away afterwards where none is given."""
    clip = scene_of(seed)
    take = prepare(clip.scene, seed)
    with TemporaryDirectory() as temporary:
        path = (folder or Path(temporary)) / f"{seed}.mp4"
        frames = (take.frame(n, threads=1).rgb for n in range(clip.scene.n_frames))
        write_video(frames, path, clip.codec, clip.scene.frame_rate_hz, clip.bit_rate)
        yield path, take


def options_for(take: Take, *, cae: CaeMode = "auto") -> ReceiverOptions:
    """Screen, camera and outline named: how well they are found is not the question here."""
    exposure = take.exposure()
    return ReceiverOptions(
        screens=(take.scene.screen,),
        cameras=(build_camera_profile(take.scene, exposure),),
        force_camera=True,
        corners=exposure.view.corners,
        cae=cae,
    )


def packets_of(task: Task) -> Record:
    """Simulate, compress and receive one clip; returns what was reported of every packet."""
    with clip_of(task["seed"]) as (path, take):
        told = take.truth(path.name)
        truth = msgspec.convert({**told, "payload": {int(k): v for k, v in told["payload"].items()}}, Truth)
        scorer = Scorer(truth)
        results = [scorer.add(result) for result in receive(open_source(path), options_for(take, cae=task["cae"]))]
    clip, score = scene_of(task["seed"]), scorer.score()
    packets = [packet for result in results for packet in reported_packets(result, truth.w)]
    return {
        "screen": clip.scene.screen.name,
        "picture": clip.scene.picture,
        "codec": clip.codec,
        "bit_rate": clip.bit_rate,
        "n_frames": clip.scene.n_frames,
        "exposure_slots": clip.scene.exposure_s * clip.scene.screen.slot_rate_hz,
        "status": [result.status for result in results],
        "expected": score.expected,
        "error_free": score.error_free,
        "lost": score.lost,
        "false": score.false,
        "packets": packets,
    }
