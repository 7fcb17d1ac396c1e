"""Memory over a long clip: does it stay flat?

The clip is made once from a short one that ends where it begins: its frames show a whole number of bursts whose
payloads then come again, so that its packets, written one after the other many times, are one endless clip.
"""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rxcli.errors import ReceiverError, UsageError
from rxcli.profiles import CameraProfile, ReadoutMode, dump_profile
from rxcli.runs.processes import package_environment, resident_bytes

if TYPE_CHECKING:
    from rxcli.lab.simulate.scenes import Scene

#: Bursts from one frame to the next, and frames of the short clip: together a whole number of bursts.
_BURSTS_A_FRAME, _PERIOD_FRAMES = 1.25, 80
_WIDTH, _HEIGHT, _ROWS_PER_SLOT = 640, 360, 3.0
_SCREEN = "paper-8k65"


def clip_scene() -> Scene:
    """A small clip of an easy screen, whose payload comes again after the short clip's last frame."""
    import msgspec

    from rxcli.lab.benchmark.speed import endless
    from rxcli.lab.simulate.scenes import preset

    base = preset("video-1080p", _SCREEN)
    screen = msgspec.structs.replace(base.screen, width_px=342, height_px=192)
    delay = 1 / (_ROWS_PER_SLOT * screen.slot_rate_hz)
    sensor = replace(base.sensor, width=_WIDTH, height=_HEIGHT, line_delay_s=delay, full_scale_e=4000.0)
    scene = replace(
        base,
        screen=screen,
        picture="chelsea",
        sensor=sensor,
        lens=replace(base.lens, distortion=(0.0,) * 5),
        isp=replace(base.isp, tone="srgb"),
        light_e_per_s=1300 / base.exposure_s,
        start_slot=10.0,
    )
    return endless(scene, _PERIOD_FRAMES, _BURSTS_A_FRAME)


def make_clip(folder: Path, n_frames: int) -> Path:
    """The clip of at least `n_frames` frames in `folder`, beside its camera profile; made unless it is there."""
    from rxcli.lab.benchmark.speed import repeat_clip
    from rxcli.lab.simulate.capture import prepare
    from rxcli.lab.simulate.video import write_video

    path = folder / f"long-{n_frames}.mp4"
    if path.exists():
        return path
    folder.mkdir(parents=True, exist_ok=True)
    scene = clip_scene()
    take = prepare(scene, 0)
    short = folder / "short.mp4"
    frames = (take.frame(number, threads=1).rgb for number in range(scene.n_frames))
    write_video(frames, short, "h264", scene.frame_rate_hz, 3_000_000)
    _camera_path(folder).write_text(_camera(scene), encoding="utf-8")
    repeat_clip(short, path, -(-n_frames // scene.n_frames))
    return path


def _camera_path(folder: Path) -> Path:
    return folder / "long.camera.toml"


def _camera(scene: Scene) -> str:
    mode = ReadoutMode(
        name="clip",
        width=_WIDTH,
        height=_HEIGHT,
        line_delay_s=scene.sensor.line_delay_s,
        exposure_s=scene.exposure_s,
    )
    return dump_profile(CameraProfile(format=1, kind="camera", name="long-clip", modes=(mode,), tone="srgb"))


@dataclass(frozen=True)
class Memory:
    """Resident memory of `vlc-rx decode` at some frames of a clip."""

    frames: tuple[int, ...]
    #: MB once as many frames were decoded.
    resident_mb: tuple[float, ...]
    packets: int
    exit_code: int

    @property
    def growth_kb(self) -> float:
        """Kilobytes a frame from the first to the last of the places."""
        return 1024 * (self.resident_mb[-1] - self.resident_mb[0]) / max(self.frames[-1] - self.frames[0], 1)


def measure(clip: Path, frames: tuple[int, ...], out: Path) -> Memory:
    """Decode a clip in a process of its own and look at its memory as the lines of its results come.

    Args:
        clip: made by `make_clip`.
        frames: numbers of frames at which memory is read, ascending.
        out: file of the results.

    Raises:
        UsageError: this system does not tell the memory of a process.
        ReceiverError: the clip ended before the last of `frames`.
    """
    if not Path("/proc/self/status").exists():
        raise UsageError("the memory of a process is read from /proc, which this system lacks", "run it on Linux")
    process = _decode(clip, out)
    seen: list[float] = []
    n_lines = packets = 0
    with out.open(encoding="utf-8") as lines:
        while len(seen) < len(frames):
            line = lines.readline()
            if line.endswith("\n"):
                n_lines += 1
                packets += line.count('"payload": ')
                if n_lines == frames[len(seen)]:
                    seen.append(resident_bytes(process.pid) / 2**20)
            elif process.poll() is not None:
                raise ReceiverError(f"{clip}: ended after {n_lines} frames, {frames[-1]} were wanted", "make it anew")
            else:
                lines.seek(lines.tell() - len(line))
                time.sleep(0.02)
    return Memory(frames, tuple(seen), packets, process.wait())


def _decode(clip: Path, out: Path) -> subprocess.Popen[bytes]:
    out.write_bytes(b"")
    command = [sys.executable, "-m", "rxcli.cli.main", "decode", str(clip), "--quiet", "--json", str(out)]
    command += ["--screen", _SCREEN, "--camera", str(_camera_path(clip.parent))]
    return subprocess.Popen(command, env=package_environment())


def rows(memory: Memory) -> list[dict[str, Any]]:
    """The places as a table."""
    return [{"frame": n, "resident_mb": mb} for n, mb in zip(memory.frames, memory.resident_mb, strict=True)]
