"""Two checkouts on the same files: are the results the same to the last bit, which has more packets, which is quicker?

Cases are drawn once, by this checkout. Each checkout decodes their files in a process of its own, through its command
line, which outlives what is moved and renamed within. The two take turns, and the least processor time of a file
counts.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from rxcli.errors import ReceiverError, UsageError
from rxcli.lab.benchmark.cases import Case
from rxcli.lab.benchmark.draw import DRAWERS, Place
from rxcli.lab.benchmark.measures import SURE, Row
from rxcli.lab.benchmark.runner import Task
from rxcli.lab.simulate.tiff import write_dng
from rxcli.options import SKIPS, ReceiverOptions
from rxcli.outputs import write_whole
from rxcli.profiles import CameraProfile, ScreenProfile, dump_profile
from rxcli.results.truth import truth_path

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
_ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
#: Earlier checkouts remembered cameras from file to file.
_ENVIRONMENT["VLC_RX_NO_CAMERA_CACHE"] = "1"


@dataclass(frozen=True)
class Decoded:
    """What one checkout made of one file."""

    #: Lines of JSON, without times.
    records: list[Any]
    cpu_s: float
    exit_code: int

    @property
    def packets(self) -> list[dict[str, Any]]:
        """Those of all columns of all frames."""
        columns = (column for record in self.records for column in record.get("columns", ()))
        return [packet for column in columns for packet in column["packets"]]


@dataclass(frozen=True)
class Job:
    """One file, and how it is decoded."""

    group: str
    #: Of `vlc-rx`; the second is the file.
    arguments: list[str]


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


def arguments_of(case: Case, stem: Path) -> list[str]:
    """Write a case as files of this stem: picture, truth, profiles; the arguments of `vlc-rx` that receive it."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    path, options = _written(case, stem), case.options
    arguments = ["decode", str(path), "--json", "-", "--quiet", "--truth", "auto", "--cae", options.cae]
    if case.truth is not None:
        write_whole(truth_path(path), msgspec.json.encode(case.truth))
    named: list[ScreenProfile | CameraProfile] = list(options.cameras if options.force_camera else ())
    named += () if options.screens == ReceiverOptions().screens else options.screens
    for number, profile in enumerate(named):
        toml = stem.with_suffix(f".{number}.toml")
        write_whole(toml, dump_profile(profile))
        arguments += [f"--{profile.kind}", str(toml)]
    if options.corners is not None:
        arguments += ["--corners", *(f"{x:.3f},{y:.3f}" for x, y in options.corners)]
    return arguments + [part for name in SKIPS if name not in options.skip for part in ("--no-skip", name)]


def _written(case: Case, stem: Path) -> Path:
    """The case's file: a copy, a JPEG or DNG where one was simulated, or else a PNG."""
    import cv2

    if isinstance(case.source, Path):
        return Path(shutil.copyfile(case.source, stem.with_suffix(case.source.suffix)))
    (frame, *_), capture = case.source, None if case.trial is None else case.trial.capture
    if capture is not None and capture.is_mosaic:
        path = stem.with_suffix(".dng")
        write_dng(capture.raw, capture.scene, path)
        return path
    # A phone's picture was stored anew, without metadata.
    as_simulated = capture is not None and frame.metadata.model is not None
    data = capture.jpeg if capture and as_simulated else cv2.imencode(".png", np.asarray(frame.pixels))[1].tobytes()
    path = stem.with_suffix(".jpg" if as_simulated else ".png")
    write_whole(path, data)
    return path


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


def compare(jobs: Sequence[Job], other: Path, repeats: int, tick: Callable[[], None]) -> list[Comparison]:
    """Decode every file with this checkout and with the other, by turns.

    Args:
        jobs: from `jobs_of`.
        other: folder of the other checkout.
        repeats: turns; the least time of each file counts.
        tick: called after every turn of either.

    Raises:
        ReceiverError: a checkout broke off.
    """
    found: dict[Path, list[list[Decoded]]] = {other: [], this_checkout(): []}
    for _ in range(repeats):
        for checkout, turns in found.items():
            turns.append(_decoded_by(checkout, [job.arguments for job in jobs]))
            tick()
    theirs, ours = (
        [replace(one[0], cpu_s=min(d.cpu_s for d in one)) for one in zip(*turns, strict=True)]
        for turns in found.values()
    )
    return [Comparison(*parts) for parts in zip(jobs, ours, theirs, strict=True)]


def jobs_of(tasks: Sequence[Task], folder: Path) -> Iterator[Job]:
    """Draw the cases of a scenario's tasks, and write them as files into `folder`."""
    for task in tasks:
        for number, case in enumerate(
            DRAWERS[task["draw"]](Place(task["seed"], task["number"], task["point"], folder))
        ):
            label = "-".join(filter(None, (task["draw"], task["label"])))
            stem = folder / f"{Path(label).stem}-{task['seed']}-{task['number']}-{number}"
            yield Job(next(iter(case.groups), label), arguments_of(case, stem.resolve()))


def _decoded_by(checkout: Path, jobs: Sequence[Sequence[str]]) -> list[Decoded]:
    environment = {**os.environ, **_ENVIRONMENT, "PYTHONPATH": str(checkout)}
    command = [sys.executable, "-P", "-c", _WORKER]
    # Elsewhere: python would look into the folder that it stands in first.
    done = subprocess.run(
        command, input=json.dumps(jobs), env=environment, capture_output=True, text=True, check=False, cwd="/"
    )
    if done.returncode:
        reason = done.stderr.strip().splitlines()[-1:] or [f"exit code {done.returncode}"]
        raise ReceiverError(f"{checkout}: decoding broke off ({reason[0]})", "run its own tests")
    return [Decoded(_records(text), cpu_s, code) for text, cpu_s, code in json.loads(done.stdout)]


def _records(text: str) -> list[Any]:
    """The lines of a run without what differs from run to run."""
    return [{k: v for k, v in json.loads(line).items() if k != "timing_ms"} for line in text.splitlines()]


def _differences(place: str, before: Any, now: Any) -> Iterator[str]:
    """Places where two JSON values differ, with both values."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key in dict.fromkeys((*before, *now)):
            yield from _differences(f"{place}.{key}".lstrip("."), before.get(key), now.get(key))
    elif isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        for number, parts in enumerate(zip(before, now, strict=True)):
            yield from _differences(f"{place}[{number}]", *parts)
    elif before != now or type(before) is not type(now):
        yield f"{place}: {json.dumps(before):.60} -> {json.dumps(now):.60}"


def rows(found: Sequence[Comparison]) -> list[Row]:
    """One row a group, and one for all."""
    groups = {
        name: [one for one in found if one.job.group == name] for name in dict.fromkeys(one.job.group for one in found)
    }
    return [_row(name, some) for name, some in (groups | {"all": list(found)}).items()]


def _row(name: str, found: Sequence[Comparison]) -> Row:
    row: Row = {"files": name, "n": len(found), "same": sum(one.difference is None for one in found)}
    for side in ("this", "other"):
        packets = [packet for one in found for packet in getattr(one, side).packets]
        sure = [packet for packet in packets if packet["confidence"] >= SURE]
        row[f"{side}_packets"] = len(packets)
        row[f"{side}_right"] = sum(packet.get("bit_errors") == 0 for packet in packets)
        row[f"{side}_surely_wrong"] = sum(bool(packet.get("bit_errors")) for packet in sure)
        row[f"{side}_cpu_s"] = sum(getattr(one, side).cpu_s for one in found)
    return {**row, "cpu_ratio": row["this_cpu_s"] / row["other_cpu_s"] if row["other_cpu_s"] else None}


def differing(found: Sequence[Comparison]) -> list[Row]:
    """The files whose results differ, and where first."""
    return [
        {"file": Path(one.job.arguments[1]).name, "first difference": one.difference} for one in found if one.difference
    ]
