"""Speed of clips: how many times real time, and how many times the bare decode of the same clip?

    python -m rxcli.lab.benchmark.clip_speed --runs 5
    python -m rxcli.lab.benchmark.clip_speed --clip CLIP --camera PROFILE --screen NAME

Bare decode (luma planes, as many threads as FFmpeg takes) and reception take turns in one process, and the quickest run
of each counts: whatever else the machine does only adds. Time of the processor stands beside that of the wall, since on
a busy machine only the former means anything. Without a clip, two are simulated once and repeated without a seam.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rxcli.lab.simulate.scenes import Scene
    from rxcli.receiver.pipeline import ReceiverOptions


@dataclass(frozen=True)
class Kind:
    """A clip to simulate; its frames show a whole number of bursts, so that it may be repeated."""

    name: str
    camera: str
    screen: str
    picture: str
    bursts_a_frame: float
    n_frames: int
    #: Times that the frames are written.
    times: int
    bit_rate: int


KINDS = (
    Kind("1080p", "video-1080p", "paper-17k3", "chelsea", 0.75, 32, 6, 28_000_000),
    Kind("4k", "video-4k", "paper-34k6", "rocket", 1.5, 16, 4, 108_000_000),
)


@dataclass(frozen=True)
class Speed:
    """Bare decode and reception of a clip."""

    clip: str
    n_frames: int
    #: As the clip is to be shown.
    duration_s: float
    #: Wall, and processor.
    bare_s: tuple[float, float]
    received_s: tuple[float, float]

    def as_row(self) -> dict[str, object]:
        """For a table; milliseconds of the processor a frame."""
        return {
            "clip": self.clip,
            "frames": self.n_frames,
            "x real time": self.duration_s / self.received_s[0],
            "received / bare, wall": self.received_s[0] / self.bare_s[0],
            "received / bare, cpu": self.received_s[1] / self.bare_s[1],
            "bare cpu ms": 1e3 * self.bare_s[1] / self.n_frames,
            "received cpu ms": 1e3 * self.received_s[1] / self.n_frames,
        }


def scene_of(kind: Kind) -> Scene:
    """The scene of a clip, whose payload comes again after its last frame."""
    from dataclasses import replace

    import numpy as np

    from rxcli.lab.simulate.scenes import preset
    from rxcli.protocol import payload_bits

    base = preset(kind.camera, kind.screen)
    screen = base.screen
    n_bits = round(kind.bursts_a_frame * kind.n_frames) * screen.columns * payload_bits(5, screen.payload_symbols)
    return replace(
        base,
        picture=kind.picture,
        payload=np.random.default_rng(0).bytes(n_bits // 8),
        shake_px=0.0,
        n_frames=kind.n_frames,
        frame_rate_hz=screen.slot_rate_hz / (screen.packet_slots * screen.repeats * kind.bursts_a_frame),
    )


def make_clip(kind: Kind, folder: Path) -> Path:
    """The clip in `folder`, beside its camera profile; made unless it is there."""
    from rxcli.lab.benchmark.long_clip import repeat_clip
    from rxcli.lab.simulate.capture import prepare
    from rxcli.lab.simulate.truth import build_camera_profile
    from rxcli.lab.simulate.video import write_video
    from rxcli.profiles import dump_profile

    path = folder / f"speed-{kind.name}.mp4"
    if path.exists():
        return path
    folder.mkdir(parents=True, exist_ok=True)
    scene = scene_of(kind)
    take = prepare(scene, 0)
    short = folder / f"speed-{kind.name}-once.mp4"
    frames = (take.frame(number).rgb for number in range(scene.n_frames))
    write_video(frames, short, "h264", scene.frame_rate_hz, kind.bit_rate)
    profile = dump_profile(build_camera_profile(scene, take.exposure()))
    path.with_suffix(".camera.toml").write_text(profile, encoding="utf-8")
    repeat_clip(short, path, kind.times)
    return path


def options_for(camera: str, screen: str) -> ReceiverOptions:
    """Options that name camera and screen: by profiles, or paths of such."""
    from rxcli.profiles import CameraProfile, ScreenProfile, load_profile
    from rxcli.receiver.pipeline import ReceiverOptions

    cameras, screens = (load_profile(camera, CameraProfile),), (load_profile(screen, ScreenProfile),)
    return ReceiverOptions(screens=screens, cameras=cameras, force_camera=True)


def measure(clip: Path, options: ReceiverOptions, runs: int) -> Speed:
    """The quickest of `runs` bare decodes and receptions by turns."""
    from rxcli.ingest import open_source
    from rxcli.lab.benchmark.stages import bare_video
    from rxcli.receiver.pipeline import receive

    def received() -> int:
        return sum(1 for _ in receive(open_source(clip), options))

    n_frames, duration_s = _extent(clip)
    turns = [(_timed(lambda: bare_video(clip, threaded=True)), _timed(received)) for _ in range(runs)]
    bare, whole = ((min(t[0] for t in one), min(t[1] for t in one)) for one in zip(*turns, strict=True))
    return Speed(clip.name, n_frames, duration_s, bare, whole)


def _extent(clip: Path) -> tuple[int, float]:
    """Frames of a clip, and how long they last."""
    import av

    with av.open(str(clip)) as container:
        video = container.streams.video[0]
        n_frames = sum(packet.size > 0 for packet in container.demux(video))
        return n_frames, n_frames / float(video.average_rate)


def _timed(work: Callable[[], object]) -> tuple[float, float]:
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - cpu


def main() -> None:
    """Make the clips, measure, print."""
    # As `vlc-rx` does, before numpy is loaded.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("benchmark-results"))
    parser.add_argument("--clip", type=Path)
    parser.add_argument("--camera")
    parser.add_argument("--screen")
    given = parser.parse_args()
    if given.clip and not (given.camera and given.screen):
        parser.error("--clip needs --camera and --screen")
    from rxcli.lab.benchmark.tables import format_table

    if given.clip:
        speeds = [measure(given.clip, options_for(given.camera, given.screen), given.runs)]
    else:
        clips = [(make_clip(kind, given.out / "media"), kind) for kind in KINDS]
        speeds = [
            measure(clip, options_for(str(clip.with_suffix(".camera.toml")), kind.screen), given.runs)
            for clip, kind in clips
        ]
    print(format_table([speed.as_row() for speed in speeds]))


if __name__ == "__main__":
    main()
