"""The question of `rxcli.lab.benchmark.confidence` of clips: whole frames through real encoders, the screen searched.

A scene is filmed once and compressed several times, as phones and cameras do: bit rates from scarce to ample, codecs
and presets of any kind. Half of the pictures are dark, some clips are taken from a hand. Each clip is received with the
screen searched and, for comparison, with its corners handed over.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np

from rxcli.lab.benchmark.confidence import reported_packets
from rxcli.lab.benchmark.journal import Record, Task
from rxcli.lab.benchmark.statistics import wilson
from rxcli.lab.benchmark.tables import Row
from rxcli.lab.benchmark.trial import receive_clip, truth_of
from rxcli.lab.simulate.capture import Take, prepare
from rxcli.lab.simulate.dark_pictures import DARK_KINDS, draw_dark_picture
from rxcli.lab.simulate.pictures import draw_name
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.lab.simulate.truth import build_camera_profile
from rxcli.lab.simulate.video import write_video
from rxcli.receiver.pipeline import CaeMode, ReceiverOptions
from rxcli.results.truth import Truth

#: Camera, screen, how often they are drawn, frames, and bits per second. The fastest link has too few rows per slot in
#: 1080p.
_KINDS = (
    ("video-1080p", "paper-8k65", 0.42, (4, 9), (6e6, 25e6)),
    ("video-1080p", "paper-17k3", 0.42, (4, 9), (6e6, 25e6)),
    ("video-4k", "paper-17k3", 0.08, (3, 5), (20e6, 80e6)),
    ("video-4k", "paper-34k6", 0.08, (3, 5), (20e6, 80e6)),
)
_CODECS, _PRESETS = ("h264", "h264", "hevc"), ("ultrafast", "veryfast", "veryfast", "medium")
#: Times that a scene is compressed.
_ENCODINGS = 3
#: Shares of dark pictures, of clips from a hand, and of cameras that nobody told of; pixels that a hand moves a frame.
_DARK, _MOVING, _UNTOLD, _HAND_PX = 0.5, 0.35, 0.3, (0.5, 6.0)
#: Confidence from which a packet counts as confident.
CONFIDENT = 0.99


@dataclass(frozen=True)
class Encoding:
    """How a clip is compressed."""

    codec: str
    preset: str
    #: Bits per second.
    bit_rate: int


@dataclass(frozen=True)
class ClipScene:
    """A scene, what it shows, how its clips are compressed, and whether the receiver is told the camera."""

    scene: Scene
    kind: str
    encodings: tuple[Encoding, ...]
    camera_told: bool


def scene_of(seed: int) -> ClipScene:
    """A short clip of random quality."""
    rng = np.random.default_rng([seed, 17])
    name, screen, _, frames, bits = _KINDS[rng.choice(len(_KINDS), p=[kind[2] for kind in _KINDS])]
    base = preset(name, screen)
    kind = str(rng.choice(DARK_KINDS)) if rng.random() < _DARK else "photo"
    size = base.screen.width_px, base.screen.height_px
    picture = draw_name(rng) if kind == "photo" else draw_dark_picture(kind, rng, *size)
    exposure_slots = rng.choice([0.5, 1.0, 1.5]) * rng.uniform(0.8, 1.2)
    exposure_s = max(float(exposure_slots) / base.screen.slot_rate_hz, 1 / 32000)
    pose = replace(
        base.pose,
        fill=rng.uniform(0.75, 0.93),
        roll_deg=rng.normal(0, 0.8),
        yaw_deg=rng.normal(0, 2),
        pitch_deg=rng.normal(0, 2),
    )
    scene = replace(
        base,
        picture=picture,
        w="dimming" if rng.random() < 0.3 else int(rng.integers(2, 9)),
        pose=pose,
        exposure_s=exposure_s,
        light_e_per_s=base.light_e_per_s * (base.exposure_s / exposure_s) * 10 ** rng.uniform(-0.7, 0.3),
        slot_rate_error_ppm=rng.uniform(-50, 50),
        shake_px=0.0,
        hand_px=rng.uniform(*_HAND_PX) if rng.random() < _MOVING else 0.0,
        n_frames=int(rng.integers(*frames, endpoint=True)),
    )
    encodings = tuple(_encoding(rng, bits) for _ in range(_ENCODINGS))
    return ClipScene(scene, kind, encodings, bool(rng.random() >= _UNTOLD))


def _encoding(rng: np.random.Generator, bits: tuple[float, float]) -> Encoding:
    bit_rate = int(np.exp(rng.uniform(*np.log(bits))))
    return Encoding(str(rng.choice(_CODECS)), str(rng.choice(_PRESETS)), bit_rate)


@contextmanager
def clips_of(seed: int) -> Iterator[tuple[list[Path], Take]]:
    """A scene's clips as files, in a folder that goes away afterwards."""
    clip = scene_of(seed)
    take = prepare(clip.scene, seed)
    pictures = [take.frame(n, threads=1).rgb for n in range(clip.scene.n_frames)]
    with TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{seed}-{number}.mp4" for number in range(len(clip.encodings))]
        for path, how in zip(paths, clip.encodings, strict=True):
            write_video(pictures, path, how.codec, clip.scene.frame_rate_hz, how.bit_rate, how.preset)
        yield paths, take


def options_for(clip: ClipScene, take: Take, *, corners: bool, cae: CaeMode = "auto") -> ReceiverOptions:
    """What a user would tell: the camera, perhaps, and for comparison the corners."""
    exposure = take.exposure()
    return ReceiverOptions(
        cameras=(build_camera_profile(take.scene, exposure),) if clip.camera_told else (),
        force_camera=clip.camera_told,
        corners=exposure.corners if corners else None,
        cae=cae,
    )


def packets_of(task: Task) -> Record:
    """Film a scene, compress and receive it; returns what was reported of every packet, screen searched."""
    seed = task["seed"]
    clip = scene_of(seed)
    with clips_of(seed) as (paths, take):
        truth = truth_of(take)
        clips = []
        for path, how in zip(paths, clip.encodings, strict=True):
            ways = {
                name: _received(path, truth, options_for(clip, take, corners=corners, cae=task["cae"]))
                for name, corners in (("searched", False), ("given", True))
            }
            clips.append({**msgspec.to_builtins(how), "bytes": path.stat().st_size, **ways})
    scene = clip.scene
    return {
        "screen": scene.screen.name,
        "camera": scene.camera_name,
        "camera_told": clip.camera_told,
        "kind": clip.kind,
        "picture": scene.picture if isinstance(scene.picture, str) else clip.kind,
        "hand_px": scene.hand_px,
        "n_frames": scene.n_frames,
        "exposure_slots": scene.exposure_s * scene.screen.slot_rate_hz,
        "clips": clips,
        "packets": [packet for one in clips for packet in one["searched"]["packets"]],
    }


def _received(path: Path, truth: Truth, options: ReceiverOptions) -> Record:
    results, score = receive_clip(path, options, truth)
    return {
        "status": [result.status for result in results],
        "expected": score.expected,
        "error_free": score.error_free,
        "false": score.false,
        "packets": [packet for result in results for packet in reported_packets(result, truth.w)],
    }


def rows(records: Sequence[Record]) -> list[Row]:
    """Packets with the screen searched and given, and wrong ones that were confident, of clips of several sorts."""
    every = [(record, clip) for record in records for clip in record["clips"]]
    sorts: list[tuple[str, list[tuple[Record, Record]]]] = [
        ("1080p", [(r, c) for r, c in every if r["camera"] == "video1080"]),
        ("4K", [(r, c) for r, c in every if r["camera"] != "video1080"]),
        ("photographs", [(r, c) for r, c in every if r["kind"] == "photo"]),
        ("dark pictures", [(r, c) for r, c in every if r["kind"] != "photo"]),
        ("from a tripod", [(r, c) for r, c in every if not r["hand_px"]]),
        ("from a hand", [(r, c) for r, c in every if r["hand_px"]]),
        ("camera told", [(r, c) for r, c in every if r["camera_told"]]),
        ("camera unknown", [(r, c) for r, c in every if not r["camera_told"]]),
        *((codec, [(r, c) for r, c in every if c["codec"] == codec]) for codec in sorted(set(_CODECS))),
        ("all", every),
    ]
    return [_row(name, [clip for _, clip in some]) for name, some in sorts if some]


def _row(name: str, clips: Sequence[Record]) -> Row:
    packets = [packet for clip in clips for packet in clip["searched"]["packets"]]
    confident = [packet for packet in packets if packet["confidence"] >= CONFIDENT]
    wrong = sum(packet["bit_errors"] != 0 for packet in confident)
    searched, given = (sum(clip[way]["error_free"] for clip in clips) for way in ("searched", "given"))
    return {
        "clips": name,
        "n": len(clips),
        "expected": sum(clip["searched"]["expected"] for clip in clips),
        "searched": searched,
        "corners_given": given,
        "share": searched / given if given else None,
        f"confident_{CONFIDENT:g}": len(confident),
        "wrong": wrong,
        "wrong_at_most": wilson(wrong, len(confident))[1] if confident else None,
    }
