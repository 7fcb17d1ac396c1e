"""Time per stage against the bare decode of the file, clips in times real time, peak memory, growth with size.

Every measurement runs in a process of its own, which prints one JSON object: so thread counts, warm caches and peak
memory of one do not touch another.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, TypeVar

import numpy as np

from rxcli.errors import ReceiverError, UsageError
from rxcli.ingest.sniff import HEAD_BYTES, read_bytes, sniff
from rxcli.lab.benchmark.statistics import power_law
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.options import AUTO, receiver_options
from rxcli.profiles import ScreenProfile, dump_profile, load_profile
from rxcli.protocol import payload_bits
from rxcli.receiver.pipeline import receive
from rxcli.runs.processes import package_environment, peak_memory_mb
from rxcli.types import Frame, FrameResult

_T = TypeVar("_T")
#: What a whole reception may take of the bare one-thread decode, on two cores.
TARGETS = {"jpeg-26mp": 1.6, "raw-26mp": 2.5, "jpeg-26mp-hard": 4.0, "jpeg-12mp-unknown": 10.0}
#: Megapixels and columns over which growth is measured.
MEGAPIXELS = (2.0, 4.0, 8.0, 16.0, 26.0, 50.0)
COLUMNS = (20, 50, 100, 200)
#: Megapixels of the preset's sensor, at which columns are varied.
_XS10_MP = 26.0


@dataclass(frozen=True)
class Medium:
    """One kind of file whose reception is timed."""

    name: str
    camera: str
    screen: str
    suffix: str
    #: Clips: frames to simulate, times that they are written, and bursts from one frame to the next, together a whole
    #: number, so that the clip may be repeated.
    n_frames: int = 1
    times: int = 1
    bursts_a_frame: float | None = None
    bit_rate: int | None = None
    picture: str = "coffee"
    #: Of the preset's.
    light: float = 1.0
    #: Whether the receiver is told neither camera nor screen.
    unknown: bool = False

    def receiver(self, path: Path) -> dict[str, Any]:
        """Screen and camera, as the receiver of the file is told them."""
        told = {"screen": self.screen, "camera": str(_profile_path(path))}
        return {"screen": AUTO, "camera": []} if self.unknown else told


MEDIA = (
    Medium("jpeg-26mp", "xs10-still", "paper-34k6", ".jpg"),
    Medium("raw-26mp", "xs10-still", "paper-34k6", ".dng"),
    Medium("jpeg-26mp-hard", "xs10-still", "paper-34k6", ".jpg", light=0.3),
    Medium("jpeg-12mp", "phone-plain", "paper-17k3", ".jpg"),
    Medium("jpeg-12mp-unknown", "phone-plain", "paper-17k3", ".jpg", unknown=True),
    Medium("video-4k", "video-4k", "paper-34k6", ".mp4", 16, 4, 1.5, 108_000_000, "rocket"),
    Medium("video-1080p", "video-1080p", "paper-17k3", ".mp4", 32, 6, 0.75, 28_000_000, "chelsea"),
)


@dataclass(frozen=True)
class Timing:
    """The quickest of repeated receptions of one file, milliseconds a frame: what else a machine does only adds."""

    medium: str
    threads: int
    #: Bare decode of the file: stills on one thread, clips on as many as FFmpeg takes. Wall, and processor.
    bare_ms: float
    bare_cpu_ms: float
    total_ms: float
    total_cpu_ms: float
    stages_ms: dict[str, float]
    #: Frames a second, as the clip is to be shown; None for stills.
    frame_rate_hz: float | None
    status: str

    @property
    def ratio(self) -> float:
        """Whole reception over bare decode."""
        return self.total_ms / self.bare_ms

    @property
    def times_real_time(self) -> float | None:
        """How much faster than it is shown a clip is received; None for stills."""
        return None if self.frame_rate_hz is None else 1e3 / self.frame_rate_hz / self.total_ms


def make_medium(medium: Medium, folder: Path, seed: int = 0) -> Path:
    """The medium's file in `folder`, simulated unless it is there already, beside its camera profile."""
    path = folder / f"{medium.name}{medium.suffix}"
    if path.exists() and _profile_path(path).exists():
        return path
    scene = preset(medium.camera, medium.screen)
    scene = replace(scene, picture=medium.picture, light_e_per_s=scene.light_e_per_s * medium.light)
    if medium.bursts_a_frame is None:
        write_capture(scene, path, seed)
        return path
    once = folder / f"{medium.name}-once{medium.suffix}"
    write_capture(endless(scene, medium.n_frames, medium.bursts_a_frame), once, seed, medium.bit_rate)
    repeat_clip(once, path, medium.times)
    _profile_path(once).replace(_profile_path(path))
    return path


def endless(scene: Scene, n_frames: int, bursts_a_frame: float) -> Scene:
    """The scene as a clip whose payload comes again after its last frame."""
    screen = scene.screen
    n_bits = round(bursts_a_frame * n_frames) * screen.columns * payload_bits(5, screen.payload_symbols)
    return replace(
        scene,
        payload=np.random.default_rng(0).bytes(n_bits // 8),
        shake_px=0.0,
        n_frames=n_frames,
        frame_rate_hz=screen.slot_rate_hz / (screen.packet_slots * screen.repeats * bursts_a_frame),
    )


def repeat_clip(short: Path, out: Path, times: int) -> None:
    """Write the packets of a clip several times over, one time after the other, without encoding them again."""
    import av

    with av.open(str(out), "w") as target:
        stream = None
        for turn in range(times):
            with av.open(str(short)) as source:
                video = source.streams.video[0]
                stream = stream or target.add_stream_from_template(video)
                for packet in source.demux(video):
                    if packet.dts is None or packet.pts is None:
                        continue  # the empty packet at the end
                    packet.pts += turn * video.duration
                    packet.dts += turn * video.duration
                    packet.stream = stream
                    target.mux(packet)


def _profile_path(path: Path) -> Path:
    return path.with_name(path.stem + ".camera.toml")


def write_capture(scene: Scene, path: Path, seed: int, bit_rate: int | None = None) -> None:
    from rxcli.lab.simulate.capture import prepare
    from rxcli.lab.simulate.tiff import write_dng
    from rxcli.lab.simulate.truth import build_camera_profile, write_truth
    from rxcli.lab.simulate.video import write_video

    path.parent.mkdir(parents=True, exist_ok=True)
    raw = path.suffix == ".dng"
    scene = replace(scene, output="raw" if raw else "developed")
    take = prepare(scene, seed)
    if path.suffix == ".mp4":
        frames = (take.frame(number).rgb for number in range(scene.n_frames))
        write_video(frames, path, "h264", scene.frame_rate_hz, bit_rate)
    elif raw:
        write_dng(take.frame().raw, scene, path)
    else:
        path.write_bytes(take.frame().jpeg)
    write_truth(take.truth(path.name), path)
    _profile_path(path).write_text(dump_profile(build_camera_profile(scene, take.exposure())), encoding="utf-8")


def bare_decode(path: Path) -> Callable[[], int]:
    """A function that decodes the file, nothing else, and returns the number of frames.

    Raises:
        UsageError: neither JPEG, RAW nor clip.
    """
    kind = sniff(read_bytes(path, HEAD_BYTES), path.suffix.lower())
    bare = {"jpeg": _bare_jpeg, "video": _bare_video, "raw": _bare_raw, "tiff": _bare_raw}.get(kind or "")
    if bare is None:
        raise UsageError(f"{path}: there is no bare decode of this kind", "name a JPEG, a RAW file or a clip")
    return partial(bare, path)


def _bare_jpeg(path: Path) -> int:
    import simplejpeg

    simplejpeg.decode_jpeg(path.read_bytes(), colorspace="GRAY")
    return 1


def _bare_raw(path: Path) -> int:
    import rawpy

    with rawpy.imread(str(path)) as raw:
        return int(raw.raw_image.ndim > 0)


def _bare_video(path: Path) -> int:
    """Decode every luma plane as a view, on as many threads as FFmpeg takes; returns the number of frames."""
    import av

    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_type, stream.codec_context.thread_count = "FRAME", 0
        return sum(np.frombuffer(frame.planes[0], np.uint8).size > 0 for frame in container.decode(stream))


def _frame_rate(path: Path) -> float | None:
    """Frames a second of a clip; None for a still."""
    import av

    if sniff(read_bytes(path, HEAD_BYTES), path.suffix.lower()) != "video":
        return None
    with av.open(str(path)) as container:
        return float(container.streams.video[0].average_rate)


class _Reception:
    """One file, received again and again, every stage timed."""

    def __init__(self, path: Path, screen: str, camera: str | list[str]) -> None:
        self._path = path
        self._options = receiver_options(screen, camera)
        self._ingest_s = 0.0

    def __call__(self) -> tuple[float, dict[str, float], list[FrameResult]]:
        """Wall time (ms a frame), stages (ms a frame), results."""
        self._ingest_s = 0.0
        start = time.perf_counter()
        results = list(receive(self._frames(), self._options))
        wall = 1e3 * (time.perf_counter() - start) / len(results)
        stages = {"ingest": 1e3 * self._ingest_s / len(results)}
        for name in dict.fromkeys(name for result in results for name in result.timing_ms):
            if name != "total":
                stages[name] = sum(result.timing_ms.get(name, 0.0) for result in results) / len(results)
        return wall, stages, results

    def _frames(self) -> Iterator[Frame]:
        from rxcli.ingest import open_source

        source = iter(open_source(self._path))
        while True:
            start = time.perf_counter()
            frame = next(source, None)
            self._ingest_s += time.perf_counter() - start
            if frame is None:
                return
            yield frame


def _work_timing(task: dict[str, Any]) -> dict[str, Any]:
    """The quickest of repeated bare decodes and whole receptions, by turns, after a warm-up."""
    import cv2

    path = Path(task["path"])
    cv2.setNumThreads(int(task["threads"]))
    bare, reception = bare_decode(path), _Reception(path, task["screen"], task["camera"])
    n_frames, _ = bare(), reception()
    decodes, wholes = [], []
    for _ in range(int(task["repeats"])):
        decodes.append(_timed(bare)[0])
        wholes.append(_timed(reception))
    (wall_ms, _), (_, stages, results) = min(wholes, key=lambda timed: timed[0][0])
    return {
        "bare_ms": min(wall for wall, _ in decodes) / n_frames,
        "bare_cpu_ms": min(cpu for _, cpu in decodes) / n_frames,
        "total_ms": wall_ms / len(results),
        "total_cpu_ms": min(cpu for (_, cpu), _ in wholes) / len(results),
        "stages_ms": stages,
        "frame_rate_hz": _frame_rate(path),
        "status": results[-1].status,
    }


def _timed(work: Callable[[], _T]) -> tuple[tuple[float, float], _T]:
    """Milliseconds of the wall and of the processor, and what came out."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return (1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)), result


def _work_memory(task: dict[str, Any]) -> dict[str, Any]:
    """Peak memory of one reception in a fresh process, and of the imports alone."""
    import cv2

    cv2.setNumThreads(int(task["threads"]))
    reception = _Reception(Path(task["path"]), task["screen"], task["camera"])
    idle = peak_memory_mb()
    reception()
    return {"idle_mb": idle, "peak_mb": peak_memory_mb()}


def _work_growth(task: dict[str, Any]) -> dict[str, Any]:
    """Median time of the processor in the stages after ingest on one simulated frame, outline handed over."""
    import cv2

    from rxcli.lab.benchmark.trial import simulate_trial

    trial = simulate_trial(growth_scene(task["megapixels"], task["columns"]), 0, threads=2)
    frame, options = trial.frame, trial.options()
    cv2.setNumThreads(1)
    totals = []
    for _ in range(int(task["repeats"]) + 1):
        start = time.process_time()
        result = next(iter(receive([frame], options)))
        totals.append(1e3 * (time.process_time() - start))
    return {"total_ms": median(totals[1:]), "status": result.status, "pixels": frame.pixels.size}


def growth_scene(megapixels: float, columns: int) -> Scene:
    """A still of a screen of `columns` columns with `megapixels`, which shows the same time at any size."""
    import msgspec

    screen = load_profile("paper-17k3", ScreenProfile)
    scene = preset("xs10-still", msgspec.structs.replace(screen, columns=columns))
    scene = replace(scene, picture="sky")
    factor = (megapixels / _XS10_MP) ** 0.5
    return scene.scaled(factor, keep_readout=True) if factor != 1 else scene


_WORK = {"timing": _work_timing, "memory": _work_memory, "growth": _work_growth}


def in_process(task: dict[str, Any]) -> dict[str, Any]:
    """Do one measurement in a process of its own; `task["work"]` names it, `task["threads"]` limits its threads.

    Raises:
        ReceiverError: it failed.
    """
    environment = package_environment(task.get("threads", 1))
    command = [sys.executable, "-m", "rxcli.lab.benchmark.speed", json.dumps(task)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        reason = done.stderr.strip().splitlines()[-1:] or [f"exit code {done.returncode}"]
        raise ReceiverError(f"measurement {task['work']} failed: {reason[0]}", "run it again, or report it")
    record: dict[str, Any] = json.loads(done.stdout)
    return record


def time_medium(medium: Medium, path: Path, threads: int, repeats: int) -> Timing:
    """Time the reception of one of the media."""
    return _time(path, medium.receiver(path), threads, repeats, medium.name)


def time_file(path: Path, screen: str, camera: str, threads: int, repeats: int) -> Timing:
    """Time the reception of any photograph or clip, whose screen and camera are named."""
    return _time(path, {"screen": screen, "camera": camera}, threads, repeats, path.name)


def _time(path: Path, receiver: dict[str, Any], threads: int, repeats: int, name: str) -> Timing:
    task = {"work": "timing", "path": str(path), "threads": threads, "repeats": repeats}
    return Timing(name, threads, **in_process({**task, **receiver}))


def memory_of(medium: Medium, path: Path) -> dict[str, float]:
    """Peak memory, MB: `idle_mb` after the imports, `peak_mb` after one reception."""
    return in_process({"work": "memory", "path": str(path), "threads": 1, **medium.receiver(path)})


@dataclass(frozen=True)
class Growth:
    """How the time after ingest grows with one thing."""

    axis: str
    x: tuple[float, ...]
    ms: tuple[float, ...]

    @property
    def exponent(self) -> float:
        """Of the power law nearest to the points."""
        return power_law(self.x, self.ms)

    def as_rows(self) -> list[dict[str, Any]]:
        """A table."""
        return [{self.axis: x, "ms": ms} for x, ms in zip(self.x, self.ms, strict=True)]


def growth(axis: str, repeats: int, tick: Callable[[], None] = lambda: None) -> Growth:
    """Measure growth over "megapixels" or "columns"; `tick` is called after every point."""
    x, ms = [], []
    for value in MEGAPIXELS if axis == "megapixels" else COLUMNS:
        place = {"megapixels": _XS10_MP, "columns": 20, axis: value}
        record = in_process({"work": "growth", "repeats": repeats, "threads": 1, **place})
        x.append(float(value))
        ms.append(float(record["total_ms"]))
        tick()
    return Growth(axis, tuple(x), tuple(ms))


def start_times(repeats: int = 7) -> dict[str, float]:
    """Milliseconds of bare Python, `import rxcli` and `vlc-rx --help`, medians."""
    commands = {"bare python": ["-c", "pass"], "import rxcli": ["-c", "import rxcli"]}
    commands["vlc-rx --help"] = ["-m", "rxcli.cli.main", "--help"]
    root = Path(__file__).resolve().parents[3]
    times: dict[str, list[float]] = {name: [] for name in commands}
    for _ in range(repeats):
        for name, arguments in commands.items():
            start = time.perf_counter()
            subprocess.run([sys.executable, *arguments], cwd=root, capture_output=True, check=True)
            times[name].append(1e3 * (time.perf_counter() - start))
    return {name: median(values) for name, values in times.items()}


def timing_rows(timings: Sequence[Timing]) -> list[dict[str, Any]]:
    """Stages as ratios to the bare decode; a table."""
    names = list(dict.fromkeys(name for timing in timings for name in timing.stages_ms))
    return [
        {
            "medium": t.medium,
            "threads": t.threads,
            "bare_ms": t.bare_ms,
            "total_ms": t.total_ms,
            **{name: t.stages_ms[name] / t.bare_ms if name in t.stages_ms else None for name in names},
            "ratio": t.ratio,
            "cpu_ratio": t.total_cpu_ms / t.bare_cpu_ms,
            "x real time": t.times_real_time,
            "target": TARGETS.get(t.medium) if t.threads > 1 else None,
            "status": t.status,
        }
        for t in timings
    ]


def main() -> None:
    """Do the measurement that the command line gives as JSON; print the record."""
    task = json.loads(sys.argv[1])
    print(json.dumps(_WORK[task["work"]](task)))


if __name__ == "__main__":
    main()
