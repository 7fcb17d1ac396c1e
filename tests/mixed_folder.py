"""A folder as people have them: photos, RAW files and clips, some of them bad, decoded by a run that is killed again
and again.

All cameras of the folder are one body with two readout modes, so that a single profile fits every file. The pictures
are small, because what is measured is what surrounds the receiver: which files are read, what is said of those that
cannot be, and what a kill leaves behind.
"""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rxcli.errors import ExitCode, ReceiverError, UsageError
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.profiles import ReadoutMode, dump_profile

if TYPE_CHECKING:
    from rxcli.lab.simulate.capture import Take

#: Suffixes of the good files, by turns; every sixth is a clip.
_STILLS = (".jpg", ".png", ".dng", ".tif", ".jpeg")
_CLIPS = (".mp4", ".avi", ".mov", ".mkv")
_CLIP_FRAMES, _CLIP_EVERY = 4, 6
#: Good files among which there is one of every kind that is spoilt.
_FEWEST_GOOD = 2 * _CLIP_EVERY
_PICTURES = ("sky", "chelsea", "gradient")
_SUBFOLDERS = ("", "monday", "monday/roof", "tuesday")
#: Readout modes of the one camera: name -> width, height, rows per slot. A mosaic gives up resolution to its colours.
_MODES = {"still": (640, 360, 3.0), "raw": (960, 540, 4.0), "clip": (704, 396, 3.0)}
_SLOT_RATE_HZ, _EXPOSURE_S, _PAYLOAD_SYMBOLS = 8650.0, 1 / 12000, 3
#: Slots of a burst at which a still begins, so that it shows one burst.
_FIRST_SLOTS = (8, 25)
#: A run is killed after a random time of up to this share of what an undisturbed one takes.
_LONGEST_LIFE = 0.25
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Contents:
    """The files of a folder that was made."""

    folder: Path
    good: tuple[Path, ...]
    bad: tuple[Path, ...]


def make_folder(folder: Path, n_good: int = 180, n_bad: int = 20, seed: int = 0) -> Contents:
    """Fill `folder` with good files, each with its truth, and bad ones.

    Args:
        folder: made where it does not exist; what it holds from an earlier call of the same numbers is kept.
        n_good: files that hold packets.
        n_bad: files that hold none, of as many kinds as there are.
        seed: of the scenes.

    Raises:
        UsageError: too few good files for bad ones to be made of them.
    """
    if n_bad and n_good < _FEWEST_GOOD:
        raise UsageError(f"bad files are made of {_FEWEST_GOOD} good ones (got {n_good})", "ask for more files")
    good = [_good_path(folder, number) for number in range(n_good)]
    for number, path in enumerate(good):
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            _write_good(path, seed + number)
    kinds = tuple(BAD.items())
    bad = []
    for number in range(n_bad):
        name, spoil = kinds[number % len(kinds)]
        stem, suffix = os.path.splitext(name)
        path = folder / _SUBFOLDERS[number % len(_SUBFOLDERS)] / f"bad-{number:02}-{stem}{suffix}"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(spoil(good, np.random.default_rng([seed, number])))
        bad.append(path)
    for name, text in (("camera", _camera()), ("screen", _screen())):
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    return Contents(folder, tuple(good), tuple(bad))


def _good_path(folder: Path, number: int) -> Path:
    is_clip = number % _CLIP_EVERY == _CLIP_EVERY - 1
    suffixes = _CLIPS if is_clip else _STILLS
    turn = number // _CLIP_EVERY if is_clip else number
    return folder / _SUBFOLDERS[number % len(_SUBFOLDERS)] / f"good-{number:03}{suffixes[turn % len(suffixes)]}"


def scene(mode: str, picture: str) -> Scene:
    """A small, easy scene: short packets, two of them in a frame, no distortion.

    Args:
        mode: of `_MODES`; "clip" gives several frames, "raw" a mosaic.
        picture: on the screen.
    """
    import msgspec

    width, height, rows_per_slot = _MODES[mode]
    base = preset("video-1080p" if mode == "clip" else "phone-plain", "paper-8k65")
    sensor = replace(
        base.sensor,
        width=width,
        height=height,
        line_delay_s=1 / (rows_per_slot * _SLOT_RATE_HZ),
        full_scale_e=4000.0,
    )
    return replace(
        base,
        # A coarse panel: drawing its picture would otherwise take longer than all the rest.
        screen=msgspec.structs.replace(base.screen, **_SCREEN, width_px=342, height_px=192),
        picture=picture,
        sensor=sensor,
        lens=replace(base.lens, distortion=(0.0,) * 5),
        pose=replace(base.pose, fill=0.88, roll_deg=0.3, yaw_deg=1.0, pitch_deg=-0.5),
        isp=replace(base.isp, tone="srgb"),
        exposure_s=_EXPOSURE_S,
        light_e_per_s=900 / _EXPOSURE_S,
        room=replace(base.room, light_e_per_s=8 / _EXPOSURE_S),
        blur_px=0.6,
        lcd_grid=0.0,
        make="Example",
        model="Folder",
        camera_name="folder",
        n_frames=_CLIP_FRAMES if mode == "clip" else 1,
        frame_rate_hz=30.0,
        shake_px=0.0,
        output="raw" if mode == "raw" else "developed",
    )


#: What the folder's screen differs in from the paper's.
_SCREEN: dict[str, Any] = {"name": "short-packets", "payload_symbols": _PAYLOAD_SYMBOLS}


def _screen() -> str:
    import msgspec

    from rxcli.profiles import ScreenProfile, load_profile

    return dump_profile(msgspec.structs.replace(load_profile("paper-8k65", ScreenProfile), **_SCREEN))


def _camera() -> str:
    from rxcli.profiles import CameraProfile

    modes = tuple(
        ReadoutMode(
            name=name,
            width=width,
            height=height,
            line_delay_s=1 / (rows_per_slot * _SLOT_RATE_HZ),
            exposure_s=_EXPOSURE_S,
        )
        for name, (width, height, rows_per_slot) in _MODES.items()
    )
    return dump_profile(CameraProfile(format=1, kind="camera", name="folder", modes=modes, tone="srgb"))


def _write_good(path: Path, seed: int) -> None:
    from rxcli.lab.simulate.capture import prepare
    from rxcli.lab.simulate.truth import write_truth

    mode = "clip" if path.suffix in _CLIPS else "raw" if path.suffix == ".dng" else "still"
    made = scene(mode, _PICTURES[seed % len(_PICTURES)])
    if mode != "clip":
        made = replace(made, start_slot=np.random.default_rng([seed, 13]).uniform(*_FIRST_SLOTS))
    take = prepare(made, seed)
    # Hidden until it is whole, and after its truth: a file that is there is as it should be, whatever interrupted it.
    write_truth(take.truth(path.name), path)
    hidden = path.with_name(f".{path.name}")
    _write_capture(take, hidden)
    hidden.replace(path)


def _write_capture(take: Take, path: Path) -> None:
    from rxcli.lab.simulate.files import write_png
    from rxcli.lab.simulate.tiff import write_dng, write_tiff
    from rxcli.lab.simulate.video import write_video

    if path.suffix in _CLIPS:
        frames = (take.frame(number, threads=1).rgb for number in range(take.scene.n_frames))
        codec = {".avi": "mjpeg", ".mkv": "hevc"}.get(path.suffix, "h264")
        write_video(frames, path, codec, take.scene.frame_rate_hz)
    elif path.suffix == ".dng":
        write_dng(take.frame(threads=1).raw, take.scene, path)
    elif path.suffix == ".png":
        write_png(take.frame(threads=1).rgb, path)
    elif path.suffix == ".tif":
        write_tiff(take.frame(threads=1).rgb, take.scene, path)
    else:
        path.write_bytes(take.frame(threads=1).jpeg)


# Bad files: what their bytes are, given the good ones.

Spoil = Callable[[Sequence[Path], np.random.Generator], bytes]


def _bytes_of(good: Sequence[Path], suffix: str) -> bytes:
    return next(path for path in good if path.suffix == suffix).read_bytes()


def _cut(suffix: str, share: float) -> Spoil:
    def spoil(good: Sequence[Path], _: np.random.Generator) -> bytes:
        data = _bytes_of(good, suffix)
        return data[: int(share * len(data))]

    return spoil


def _scratched(suffix: str) -> Spoil:
    """A good file with random bytes in its middle."""

    def spoil(good: Sequence[Path], rng: np.random.Generator) -> bytes:
        data = bytearray(_bytes_of(good, suffix))
        at, length = len(data) // 2, len(data) // 8
        data[at : at + length] = rng.bytes(length)
        return bytes(data)

    return spoil


def _fixed(data: bytes) -> Spoil:
    return lambda _good, _rng: data


def _picture(shape: tuple[int, int], low: int, high: int) -> Spoil:
    """A whole PNG that shows no screen."""

    def spoil(_: Sequence[Path], rng: np.random.Generator) -> bytes:
        import cv2

        return bytes(cv2.imencode(".png", rng.integers(low, high, shape, dtype=np.uint8))[1])

    return spoil


def _unlit(good: Sequence[Path], _: np.random.Generator) -> bytes:
    """A photo of a screen that sends nothing: the rows of a good one, all alike."""
    import cv2

    picture = cv2.imdecode(np.frombuffer(_bytes_of(good, ".jpg"), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    smooth = cv2.blur(picture, (1, 121))
    return bytes(cv2.imencode(".jpg", smooth)[1])


#: Name -> bytes. All but the last four cannot be read; those can, and hold no packet.
BAD: dict[str, Spoil] = {
    "empty.jpg": _fixed(b""),
    "letter.jpg": _fixed(b"Dear reader,\nthis is a letter and no picture.\n"),
    "cut.jpg": _cut(".jpg", 0.6),
    "cut.png": _cut(".png", 0.5),
    "cut.dng": _cut(".dng", 0.4),
    "cut.tif": _cut(".tif", 0.5),
    "noindex.mp4": _cut(".mp4", 0.5),
    "cut.avi": _cut(".avi", 0.6),
    "empty.mov": _fixed(b""),
    "page.mp4": _fixed(b"<!doctype html><title>404 Not Found</title>\n"),
    "random.dng": lambda _, rng: rng.bytes(4096),
    "random.heic": lambda _, rng: rng.bytes(4096),
    "zeros.jpg": _fixed(bytes(10_000)),
    "scratched.png": _scratched(".png"),
    "head.jpg": _cut(".jpg", 0.01),
    "archive.tif": _fixed(b"PK\x03\x04" + bytes(600)),
    "pixel.png": _picture((1, 1), 0, 255),
    "black.png": _picture((360, 640), 0, 1),
    "noise.png": _picture((360, 640), 0, 255),
    "unlit.jpg": _unlit,
}


# Runs.


@dataclass(frozen=True)
class Outcome:
    """What one run, whole or in pieces, made of the folder."""

    label: str
    n_kills: int
    exit_code: int
    #: Good files that gave a packet and were not failed.
    n_good: int
    #: Bad files with a reason of their own.
    n_reasons: int
    n_lines: int
    #: Whether its results are those of the undisturbed run, times aside.
    same: bool
    wall_s: float

    def as_row(self) -> dict[str, Any]:
        """The table's row."""
        return {
            "run": self.label,
            "kills": self.n_kills,
            "good": self.n_good,
            "reasons": self.n_reasons,
            "lines": self.n_lines,
            "same": self.same,
            "exit": self.exit_code,
            "s": self.wall_s,
        }


def run(
    contents: Contents, scratch: Path, n_kills: int = 10, seed: int = 0, workers: Sequence[int] = (1, 2)
) -> list[Outcome]:
    """Decode the folder undisturbed and killed, with each number of workers.

    Args:
        contents: of the folder.
        scratch: folder for results.
        n_kills: `kill -9` at random moments of every disturbed run.
        seed: of the moments.
        workers: processes that decode; the first run of the first number is what all are held against.
    """
    scratch.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([seed, 12])
    outcomes: list[Outcome] = []
    expected: list[str] | None = None
    for number in workers:
        longest_s = 0.0
        for kills in (0, n_kills):
            label = f"{number} worker{'s' * (number > 1)}{', killed' * (kills > 0)}"
            job = _Job(contents, scratch / f"results-{number}-{kills}.jsonl", number)
            code, wall_s, done = job.undisturbed() if kills == 0 else job.killed(kills, longest_s, rng)
            lines = job.lines()
            expected = lines if expected is None else expected
            longest_s = longest_s or _LONGEST_LIFE * wall_s
            good, reasons = job.judged()
            outcomes.append(Outcome(label, done, code, good, reasons, len(lines), lines == expected, wall_s))
    return outcomes


@dataclass(frozen=True)
class _Job:
    """`vlc-rx decode FOLDER` in a process of its own."""

    contents: Contents
    out: Path
    workers: int

    def _start(self, resume: bool) -> subprocess.Popen[bytes]:
        root = str(Path(__file__).resolve().parents[1])
        path = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
        environment = {**os.environ, "PYTHONPATH": path, **dict.fromkeys(_THREAD_VARIABLES, "1")}
        command = [sys.executable, "-m", "rxcli.cli.main", "decode", str(self.contents.folder), "--quiet"]
        folder = self.contents.folder
        command += ["--screen", str(folder / "screen.toml"), "--camera", str(folder / "camera.toml"), "--truth", "auto"]
        command += ["--json", str(self.out), "--summary", str(self._summary), "--workers", str(self.workers)]
        return subprocess.Popen(command + ["--resume"] * resume, env=environment, stderr=subprocess.DEVNULL)

    @property
    def _summary(self) -> Path:
        return self.out.with_suffix(".csv")

    def undisturbed(self) -> tuple[int, float, int]:
        """Exit code, seconds, and the number of kills: none."""
        start = time.monotonic()
        code = self._start(resume=False).wait()
        return code, time.monotonic() - start, 0

    def killed(self, n_kills: int, longest_s: float, rng: np.random.Generator) -> tuple[int, float, int]:
        """Killed at random moments, resumed each time, and left alone at last; exit code, seconds, kills.

        A run that ends before its time is begun anew, so that every kill hits a living process.
        """
        start = time.monotonic()
        self.out.unlink(missing_ok=True)
        done = 0
        while done < n_kills:
            process = self._start(resume=True)
            try:
                process.wait(timeout=rng.uniform(0, longest_s))
                self.out.unlink(missing_ok=True)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                done += 1
        code = self._start(resume=True).wait()
        return code, time.monotonic() - start, done

    def lines(self) -> list[str]:
        """The results, without the times that they took.

        Raises:
            ReceiverError: a line is no JSON.
        """
        found = []
        for number, line in enumerate(self.out.read_text(encoding="utf-8").splitlines(), 1):
            try:
                record = json.loads(line)
            except ValueError:
                raise ReceiverError(f"{self.out}: line {number} is no JSON", "report it") from None
            found.append(json.dumps({key: value for key, value in record.items() if key != "timing_ms"}))
        return found

    def judged(self) -> tuple[int, int]:
        """Good files that passed, and bad ones that failed with a reason, by the summary."""
        with self._summary.open(encoding="utf-8", newline="") as file:
            rows = {row["source"]: row for row in csv.DictReader(file)}
        good = sum(rows[str(path)]["exit_code"] == str(int(ExitCode.OK)) for path in self.contents.good)
        bad = [rows[str(path)] for path in self.contents.bad]
        return good, sum(row["exit_code"] != str(int(ExitCode.OK)) and bool(row["reason"]) for row in bad)


def passed(contents: Contents, outcomes: Sequence[Outcome]) -> bool:
    """Whether every run decoded all good files, gave a reason for all bad ones, and the results of the first."""
    wanted = len(contents.good), len(contents.bad), True
    code = ExitCode.UNREADABLE if contents.bad else ExitCode.OK
    return all((one.n_good, one.n_reasons, one.same) == wanted and one.exit_code == code for one in outcomes)


def reasons(contents: Contents, scratch: Path, workers: int = 1) -> list[dict[str, Any]]:
    """What the undisturbed run with so many workers said of every bad file; a table."""
    with (scratch / f"results-{workers}-0.csv").open(encoding="utf-8", newline="") as file:
        rows = {row["source"]: row for row in csv.DictReader(file)}
    names = {str(path): path.relative_to(contents.folder).as_posix() for path in contents.bad}
    return [
        {"file": name, "exit": int(rows[key]["exit_code"]), "reason": rows[key]["reason"]}
        for key, name in names.items()
    ]
