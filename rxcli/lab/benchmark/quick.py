"""The headline: error beside both yardsticks, run time beside the bare decode, and stability, in three minutes."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from typing import Any

import msgspec

from rxcli.lab.benchmark.cases import Record
from rxcli.lab.benchmark.measures import MEASURES, Group, Row
from rxcli.lab.benchmark.runner import Run, scenarios

_MEDIA = ("jpeg-26mp", "raw-26mp", "jpeg-26mp-hard", "jpeg-12mp-unknown")
#: Runs of each medium, and small random scenes.
_REPEATS, _SCENES = 3, 20


def run(how: Run, seed: int, folder: Path) -> list[tuple[str, list[Row]]]:
    """Measure the headline: titles and tables; the media that are timed lie in `folder`."""
    table = scenarios()
    speed = {name: point for name, point in table["speed"].points.items() if name in _MEDIA}
    timed = msgspec.structs.replace(table["speed"], points=speed, ways=("two threads",))
    watched = msgspec.structs.replace(table["stability"], ways=("receiver",))
    errors = how(table["quick"].tasks(seed, table["quick"].count, folder), "errors")
    stability = how(watched.tasks(seed, _SCENES, folder), "stability")
    times = how(timed.tasks(seed, _REPEATS, folder), "times")
    return [
        ("bit error rate, lost packets included: receiver, bound, the paper's pipeline", _by_label(errors, _errors)),
        ("time on two threads, of the wall and of the processor, against the bare decode", _by_label(times, _times)),
        ("checks", [_check(stability), *({"check": k, "result": f"{ms:.0f} ms"} for k, ms in start_times(3).items())]),
    ]


def _by_label(records: list[Record], row: Any) -> list[Row]:
    labels = dict.fromkeys(record["groups"][0] for record in records)
    return [row(label, [record for record in records if record["groups"][0] == label]) for label in labels]


def _errors(label: str, cases: list[Record]) -> Row:
    receiver, bound, paper = (Group(cases, way, "receiver") for way in ("receiver", "bound", "paper"))
    return {
        "scene": label,
        "kb/s": cases[0]["about"]["rate_kbps"],
        "packets": receiver.score.expected,
        "receiver": receiver.score.ber,
        "receiver95": MEASURES["ber95"](receiver),
        "bound": bound.score.ber,
        "paper": paper.score.ber,
        "error_free": receiver.score.error_free,
        "false": receiver.score.false,
    }


def _times(label: str, cases: list[Record]) -> Row:
    columns = {"bare_ms": "bare_ms", "total_ms": "total_ms", "ratio": "over_bare_wall", "cpu_ratio": "over_bare"}
    columns |= {"target": "target", "status": "status"}
    group = Group(cases, "two threads", "two threads")
    return {"medium": label, **{name: MEASURES[measure](group) for name, measure in columns.items()}}


def _check(records: list[Record]) -> Row:
    problems = Group(records, "receiver", "receiver").problems
    return {"check": f"{len(records)} random scenes", "result": "; ".join(dict.fromkeys(problems)) or "ok"}


def start_times(repeats: int) -> dict[str, float]:
    """Milliseconds of bare Python, `import rxcli` and `vlc-rx --help`, medians."""
    commands = {"bare python": ["-c", "pass"], "import rxcli": ["-c", "import rxcli"]}
    commands["vlc-rx --help"] = ["-m", "rxcli.cli.main", "--help"]
    times: dict[str, list[float]] = {name: [] for name in commands}
    for name, arguments in repeats * list(commands.items()):
        start = time.perf_counter()
        root = Path(__file__).resolve().parents[3]
        subprocess.run([sys.executable, *arguments], cwd=root, capture_output=True, check=True)
        times[name].append(1e3 * (time.perf_counter() - start))
    return {name: median(values) for name, values in times.items()}
