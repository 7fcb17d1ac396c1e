"""The headline: error beside both yardsticks, run time beside the bare decode, and stability, in three minutes."""

import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from typing import Any

import msgspec

from rxcli.lab.benchmark.cases import Record
from rxcli.lab.benchmark.measures import MEASURES, Group, Row
from rxcli.lab.benchmark.runner import CHECKOUT, Run, scenarios

_MEDIA = ("body 26 MP", "RAW 26 MP", "body 26 MP, little light", "phone 12 MP")
#: Runs of each medium, and small random scenes.
_REPEATS, _SCENES = 3, 20
#: Column of a table -> way and measure.
_ERRORS = {
    "packets": ("receiver", "expected"),
    "receiver": ("receiver", "ber"),
    "receiver95": ("receiver", "ber95"),
    "bound": ("bound", "ber"),
    "paper": ("paper", "ber"),
    "error_free": ("receiver", "right"),
    "false": ("receiver", "false"),
}
_TIMES = {
    "bare_ms": ("two threads", "bare_ms"),
    "total_ms": ("two threads", "total_ms"),
    "ratio": ("two threads", "over_bare_wall"),
    "cpu_ratio": ("two threads", "over_bare"),
    "target": ("two threads", "target"),
    "status": ("two threads", "status"),
}


def run(how: Run, seed: int, folder: Path) -> list[tuple[str, list[Row]]]:
    """Measure the headline: titles and tables; the media that are timed lie in `folder`."""

    def records(name: str, count: int, **changes: Any) -> list[Record]:
        scenario = msgspec.structs.replace(scenarios()[name], **changes)
        return how(scenario.tasks(seed, count, folder), name)

    speed = {name: point for name, point in scenarios()["speed"].points.items() if name in _MEDIA}
    errors = _by_label("scene", records("quick", scenarios()["quick"].count), _ERRORS)
    problems = Group(
        records("stability", _SCENES, ways=("receiver",), points={"": {"named": True}}), "receiver", "receiver"
    ).problems
    timed = _by_label("medium", records("speed", _REPEATS, points=speed, ways=("two threads",)), _TIMES)
    checks = {f"{_SCENES} random scenes": "; ".join(dict.fromkeys(problems)) or "ok"}
    checks |= {name: f"{ms:.0f} ms" for name, ms in start_times(_REPEATS).items()}
    return [
        ("bit error rate, lost packets included: receiver, bound, the paper's pipeline", errors),
        ("time on two threads, of the wall and of the processor, against the bare decode", timed),
        ("checks", [{"check": name, "result": result} for name, result in checks.items()]),
    ]


def _by_label(heading: str, records: list[Record], columns: dict[str, tuple[str, str]]) -> list[Row]:
    """A row for each point of a scenario; see `_ERRORS`."""
    labels = dict.fromkeys(record["groups"][0] for record in records)
    cases = {label: [record for record in records if record["groups"][0] == label] for label in labels}
    return [
        {heading: label, **{name: MEASURES[measure](Group(mine, way, way)) for name, (way, measure) in columns.items()}}
        for label, mine in cases.items()
    ]


def start_times(repeats: int) -> dict[str, float]:
    """Milliseconds of bare Python, `import rxcli` and `vlc-rx --help`, medians."""
    commands = {"bare python": ["-c", "pass"], "import rxcli": ["-c", "import rxcli"]}
    commands["vlc-rx --help"] = ["-m", "rxcli.cli.main", "--help"]
    times: dict[str, list[float]] = {name: [] for name in commands}
    for name, arguments in repeats * list(commands.items()):
        start = time.perf_counter()
        subprocess.run([sys.executable, *arguments], cwd=CHECKOUT, capture_output=True, check=True)
        times[name].append(1e3 * (time.perf_counter() - start))
    return {name: median(values) for name, values in times.items()}
