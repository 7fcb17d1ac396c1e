"""Two checkouts on the same files: are the results the same to the last bit, which has more packets, which is quicker?

Cases are drawn once, by this checkout. Each checkout decodes their files in a process of its own, through its command
line, which outlives what is moved and renamed within. The two take turns, and the least processor time of a file
counts.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rxcli.errors import ReceiverError, UsageError
from rxcli.lab.benchmark.cases import Record, arguments_of, write_case
from rxcli.lab.benchmark.draw import DRAWERS, Place
from rxcli.lab.benchmark.measures import Row
from rxcli.lab.benchmark.runner import CHECKOUT, Task
from rxcli.runs.processes import ONE_THREAD

#: What the other process runs: argument lists come on stdin as JSON, records and CPU seconds go to stdout.
_WORKER = """
import contextlib, io, json, sys, time
from rxcli.cli.main import run
jobs, done = json.load(sys.stdin), []
for arguments in jobs[:1] + jobs:  # the first one once more: what is loaded once is nobody's time
    printed, start = io.StringIO(), time.process_time()
    with contextlib.redirect_stdout(printed):
        code = run(arguments)
    done.append([printed.getvalue(), time.process_time() - start, int(code)])
json.dump(done[1:], sys.stdout)
"""
#: The ways of a comparison; packets of this checkout are compared with those of the other.
WAYS = ("other checkout", "this checkout")
COLUMNS = ("n", "same", "packets", "right_packets", "sure", "surely_wrong", "changed", "cpu_s", "cpu_ratio")


def check_checkout(path: Path) -> Path:
    """The folder of another checkout, absolute.

    Raises:
        UsageError: there is no receiver in it.
    """
    if not (path / "rxcli" / "cli" / "main.py").is_file():
        raise UsageError(f"{path}: no checkout of this project", "name the folder that holds its rxcli/")
    return path.resolve()


def compare(tasks: Sequence[Task], rival: Path, folder: Path, repeats: int, tick: Callable[[], None]) -> list[Record]:
    """Draw the cases of the tasks as files, and decode each with this checkout and with the other, by turns.

    Args:
        tasks: of a scenario.
        rival: folder of the other checkout.
        folder: where the files go.
        repeats: turns; the least time of each file counts.
        tick: called after every turn of either.

    Raises:
        ReceiverError: a checkout broke off.
    """
    records: list[Record] = []
    jobs: list[list[str]] = []
    for task in tasks:
        for case in DRAWERS[task["draw"]](Place(task["seed"], task["number"], task["point"], folder)):
            stem = (folder / f"{task['draw']}-{task['seed']}-{len(jobs)}").resolve()
            jobs.append(arguments_of(write_case(case, stem), case.options))
            groups = [*filter(None, [task["label"]]), *case.groups]
            records.append({"about": {"file": stem.name}, "has_data": case.has_data, "groups": groups, "ways": {}})
    turns: dict[str, list[list[Record]]] = {way: [] for way in WAYS}
    for _ in range(repeats):
        for way, checkout in zip(WAYS, (rival, CHECKOUT), strict=True):
            turns[way].append(_decoded_by(checkout, jobs))
            tick()
    for way, several in turns.items():
        for record, decoded in zip(records, zip(*several, strict=True), strict=True):
            record["ways"][way] = {**decoded[0], "cpu_s": min(turn["cpu_s"] for turn in decoded)}
    for record in records:
        before, after = (record["ways"][way] for way in WAYS)
        after["difference"] = next(differences("", before["lines"], after["lines"]), None)
    return records


def _decoded_by(checkout: Path, jobs: Sequence[Sequence[str]]) -> list[Record]:
    """What one checkout made of every file: lines without times, packets, seconds."""
    environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": str(checkout)}
    command = [sys.executable, "-P", "-c", _WORKER]  # -P: no package of the folder that it is run in
    done = subprocess.run(command, input=json.dumps(jobs), env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        reason = done.stderr.strip().splitlines()[-1:] or [f"exit code {done.returncode}"]
        raise ReceiverError(f"{checkout}: decoding broke off ({reason[0]})", "run its own tests")
    return [_reception(text, cpu_s, code) for text, cpu_s, code in json.loads(done.stdout)]


def _reception(text: str, cpu_s: float, exit_code: int) -> Record:
    lines = [{k: v for k, v in json.loads(line).items() if k != "timing_ms"} for line in text.splitlines()]
    packets = [
        {**packet, "frame": line["frame"], "column": column["column"], "bit_errors": packet["bit_errors"] or 0}
        for line in lines
        for column in line.get("columns", ())
        for packet in column["packets"]
    ]
    return {"lines": [*lines, {"exit code": exit_code}], "packets": packets, "cpu_s": cpu_s}


def differences(place: str, before: Any, after: Any) -> Iterator[str]:
    """Places where two JSON values differ, with both values."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in dict.fromkeys((*before, *after)):
            yield from differences(f"{place}.{key}".lstrip("."), before.get(key), after.get(key))
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for number, parts in enumerate(zip(before, after, strict=True)):
            yield from differences(f"{place}[{number}]", *parts)
    elif before != after or type(before) is not type(after):
        yield f"{place}: {json.dumps(before):.60} -> {json.dumps(after):.60}"


def differing(records: Sequence[Record]) -> list[Row]:
    """The files whose results differ, and where first."""
    found = ((record["about"]["file"], record["ways"][WAYS[1]]["difference"]) for record in records)
    return [{"file": Path(file).name, "first difference": difference} for file, difference in found if difference]
