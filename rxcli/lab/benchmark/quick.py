"""The headline: error beside both yardsticks, run time beside the bare decode, and stability, in three minutes."""

import subprocess
import sys
import time
from pathlib import Path
from statistics import median

import msgspec

from rxcli.lab.benchmark.cases import Record
from rxcli.lab.benchmark.measures import Group, Row, rows
from rxcli.lab.benchmark.runner import CHECKOUT, Run, Scenario, scenarios

_MEDIA = ("body 26 MP", "RAW 26 MP", "body 26 MP, little light", "phone 12 MP")
#: Runs of each medium, and small random scenes.
_REPEATS, _SCENES = 3, 20
#: Measures of error and of time.
_ERRORS = ("expected", "right", "false", "ber", "ber95")
_TIMES = ("bare_ms", "total_ms", "over_bare_wall", "over_bare", "target", "status")


def run(how: Run, seed: int, folder: Path) -> list[tuple[str, list[Row]]]:
    """Measure the headline: titles and tables; the media that are timed lie in `folder`."""

    def records(scenario: Scenario, name: str, count: int) -> list[Record]:
        return how(scenario.tasks(seed, count, folder), name)

    quick, changed = scenarios()["quick"], msgspec.structs.replace
    media = {name: point for name, point in scenarios()["speed"].points.items() if name in _MEDIA}
    speed = changed(scenarios()["speed"], points=media, ways=("two threads",))
    stability = changed(scenarios()["stability"], points={"": {"named": True}}, ways=("receiver",))
    problems = Group(records(stability, "stability", _SCENES), "receiver", "receiver").problems
    # The rows of all scenes and of all media mean little.
    errors = rows(records(quick, "quick", quick.count), quick.ways, _ERRORS)[: -len(quick.ways)]
    timed = rows(records(speed, "speed", _REPEATS), speed.ways, _TIMES)[:-1]
    checks = {f"{_SCENES} random scenes": "; ".join(dict.fromkeys(problems)) or "ok"}
    checks |= {name: f"{ms:.0f} ms" for name, ms in start_times(_REPEATS).items()}
    return [
        ("bit error rate, lost packets included: receiver, bound, the paper's pipeline", errors),
        ("time on two threads, of the wall and of the processor, against the bare decode", timed),
        ("checks", [{"check": name, "result": result} for name, result in checks.items()]),
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
