"""Do two checkouts give the same results on the same files, and which takes longer?

Files are made once, by this checkout's simulator. Each checkout decodes all of them in a process of its own, through
its command line, which outlives what is moved and renamed within. The two take turns, and the least time of the
processor counts, so that a busy machine does little harm.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rxcli.errors import ReceiverError, UsageError
from rxcli.lab.benchmark import confidence, phones
from rxcli.lab.benchmark.speed import write_capture
from rxcli.lab.benchmark.tables import Row, write_text
from rxcli.lab.benchmark.trial import corners_on_picture, simulate_trial
from rxcli.lab.simulate.capture import prepare
from rxcli.profiles import ScreenProfile, dump_profile, shipped_profiles
from rxcli.types import FloatArray

#: What the other process runs: argument lists come on stdin as JSON, records and CPU seconds go to stdout.
_WORKER = """
import contextlib, io, json, sys, time
from rxcli.cli.main import run
jobs, done = json.load(sys.stdin), []
for arguments in jobs[:1] + jobs:  # the first one once more: what is loaded once is nobody's time
    said, start = io.StringIO(), time.process_time()
    with contextlib.redirect_stdout(said):
        code = run(arguments)
    done.append([said.getvalue(), time.process_time() - start, int(code)])
json.dump(done[1:], sys.stdout)
"""
_THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
_STILLS, _CLIPS = {".jpg", ".jpeg", ".png", ".tif", ".dng", ".raf"}, {".mp4", ".mov", ".mkv", ".avi"}
#: Digits to which corners are handed over.
_PLACES = 3


@dataclass(frozen=True)
class Job:
    """One file, and how it is decoded."""

    group: str
    path: Path
    #: Further arguments of `vlc-rx decode`.
    arguments: tuple[str, ...] = ()

    @property
    def command(self) -> list[str]:
        """Arguments of `vlc-rx`."""
        return ["decode", str(self.path), "--json", "-", "--quiet", *self.arguments]


@dataclass(frozen=True)
class Decoded:
    """What one checkout made of one file."""

    records: list[Any]
    cpu_s: float
    exit_code: int


@dataclass(frozen=True)
class Comparison:
    """Both checkouts on one file."""

    job: Job
    this: Decoded
    other: Decoded

    @property
    def difference(self) -> str | None:
        """The first place where the results differ, None where they are the same."""
        if self.this.exit_code != self.other.exit_code:
            return f"exit code: {self.other.exit_code} -> {self.this.exit_code}"
        return next(_differences("", self.other.records, self.this.records), None)


def captures(folder: Path, arguments: tuple[str, ...]) -> list[Job]:
    """The photographs and clips of a folder."""
    paths = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in _STILLS | _CLIPS]
    return [Job("clips" if path.suffix.lower() in _CLIPS else "captures", path, arguments) for path in paths]


def random_scenes(folder: Path, count: int, seed: int) -> Iterator[Job]:
    """Random scenes of the benchmark of confidences: camera, screen and corners handed over."""
    for number in range(count):
        yield _job("random scenes", folder / f"scene-{seed}-{number}", seed, number, _write_scene)


def random_phones(folder: Path, count: int, seed: int, screens: tuple[str, ...]) -> Iterator[Job]:
    """Random phones that nobody has measured: corners handed over, and which screens there are."""
    for number in range(count):
        job = _job("phones", folder / f"phone-{seed}-{number}", seed, number, _write_phone)
        yield replace(job, arguments=(*screens, *job.arguments))


def _job(group: str, stem: Path, seed: int, number: int, write: Callable[[Path, int, int], Job]) -> Job:
    """The job whose file has this stem, made unless an earlier run has."""
    note = stem.with_suffix(".job.json")
    if not note.exists():
        stem.parent.mkdir(parents=True, exist_ok=True)
        made = write(stem, seed, number)
        write_text(note, json.dumps([str(made.path), *made.arguments]))
    path, *arguments = json.loads(note.read_text(encoding="utf-8"))
    return Job(group, Path(path), tuple(arguments))


def _write_scene(stem: Path, seed: int, number: int) -> Job:
    scene = confidence.scene_of(1_000_000 * seed + number)
    path = stem.with_suffix(".dng" if scene.is_mosaic else ".jpg").resolve()
    exposure = prepare(scene, number).exposure()
    write_capture(scene, path, number)
    screen = write_text(path.with_suffix(".screen.toml"), dump_profile(scene.screen))
    corners = corners_on_picture(exposure.view, scene.isp.correct_distortion and not scene.is_mosaic)
    camera = str(path.with_suffix(".camera.toml"))
    return Job("", path, ("--screen", str(screen), "--camera", camera, *_corners(corners)))


def _write_phone(stem: Path, seed: int, number: int) -> Job:
    scene, turned = phones.phone_of(seed, number)
    trial = simulate_trial(scene, phones.FIRST_SEED + number)
    frame, corners = phones.as_stored(trial, turned)
    path = stem.with_suffix(".png").resolve()
    _write_grey(np.asarray(frame.pixels, np.uint8), path)
    return Job("", path, _corners(corners))


def _write_grey(pixels: np.ndarray[Any, np.dtype[np.uint8]], path: Path) -> None:
    import cv2

    path.write_bytes(cv2.imencode(".png", pixels)[1].tobytes())


def _corners(corners: FloatArray) -> tuple[str, ...]:
    return ("--corners", *(f"{x:.{_PLACES}f},{y:.{_PLACES}f}" for x, y in corners))


def shared_screens(other: Path) -> tuple[str, ...]:
    """`--screen` for every screen that both checkouts ship, by the other's files."""
    files = [other / "calibration" / "screens" / f"{screen.name}.toml" for screen in shipped_profiles(ScreenProfile)]
    return tuple(part for file in files if file.is_file() for part in ("--screen", str(file)))


def check_checkout(path: Path) -> Path:
    """The folder of another checkout, absolute.

    Raises:
        UsageError: there is no receiver in it.
    """
    if not (path / "rxcli" / "cli" / "main.py").is_file():
        raise UsageError(f"{path}: no checkout of this project", "name the folder that holds its rxcli/")
    return path.resolve()


def this_checkout() -> Path:
    """The folder that this package is imported from."""
    return Path(__file__).resolve().parents[3]


def compare(
    jobs: Sequence[Job], this: Path, other: Path, repeats: int = 2, tick: Callable[[], None] = lambda: None
) -> list[Comparison]:
    """Decode every file with both checkouts, by turns.

    Args:
        jobs: the files.
        this: folder of this checkout.
        other: folder of the other one.
        repeats: turns; the least time of each file counts.
        tick: called after every turn of either.

    Raises:
        ReceiverError: a checkout broke off.
    """
    found: dict[Path, list[list[Decoded]]] = {this: [], other: []}
    for _ in range(repeats):
        for checkout in (other, this):
            found[checkout].append(_decoded_by(checkout, jobs))
            tick()
    first, second = (_least(found[checkout]) for checkout in (this, other))
    return [Comparison(*parts) for parts in zip(jobs, first, second, strict=True)]


def _decoded_by(checkout: Path, jobs: Sequence[Job]) -> list[Decoded]:
    environment = {**os.environ, **_THREADS, "PYTHONPATH": str(checkout)}
    command = [sys.executable, "-P", "-c", _WORKER]
    given = json.dumps([job.command for job in jobs])
    # Elsewhere: python would look into the folder that it stands in first.
    done = subprocess.run(command, input=given, env=environment, capture_output=True, text=True, check=False, cwd="/")
    if done.returncode:
        reason = done.stderr.strip().splitlines()[-1:] or [f"exit code {done.returncode}"]
        raise ReceiverError(f"{checkout}: decoding broke off ({reason[0]})", "run its own tests")
    return [Decoded(_records(text), cpu_s, code) for text, cpu_s, code in json.loads(done.stdout)]


def _records(text: str) -> list[Any]:
    """The lines of a run without what differs from run to run."""
    return [{k: v for k, v in json.loads(line).items() if k != "timing_ms"} for line in text.splitlines()]


def _least(turns: Sequence[Sequence[Decoded]]) -> list[Decoded]:
    """Results of the first turn, with the least time of all turns."""
    return [Decoded(one[0].records, min(d.cpu_s for d in one), one[0].exit_code) for one in zip(*turns, strict=True)]


def _differences(place: str, before: Any, now: Any) -> Iterator[str]:
    """Places where two JSON values differ, with both values."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key in dict.fromkeys((*before, *now)):
            yield from _differences(f"{place}.{key}".lstrip("."), before.get(key), now.get(key))
    elif isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        for number, parts in enumerate(zip(before, now, strict=True)):
            yield from _differences(f"{place}[{number}]", *parts)
    elif before != now or type(before) is not type(now):
        yield f"{place}: {_short(before)} -> {_short(now)}"


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def rows(found: Sequence[Comparison]) -> list[Row]:
    """One row a group, and one for all."""
    groups = list(dict.fromkeys(one.job.group for one in found))
    return [_row(group, [one for one in found if one.job.group == group]) for group in groups] + [
        _row("all", list(found))
    ]


def _row(name: str, found: Sequence[Comparison]) -> Row:
    this, other = (sum(getattr(one, side).cpu_s for one in found) for side in ("this", "other"))
    columns = (column for one in found for record in one.this.records for column in record.get("columns", ()))
    return {
        "files": name,
        "n": len(found),
        "same": sum(one.difference is None for one in found),
        "packets": sum(len(column["packets"]) for column in columns),
        "cpu_s": this,
        "other_cpu_s": other,
        "cpu_ratio": this / other if other else None,
    }


def differing(found: Sequence[Comparison]) -> list[Row]:
    """The files whose results differ, and where first."""
    return [{"file": one.job.path.name, "first difference": one.difference} for one in found if one.difference]
