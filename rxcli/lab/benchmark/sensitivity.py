"""What hangs on the receiver's numbers: each is moved by 0.7 and by 1.4, and the same pictures are received again.

Numbers are the fields of the rooms' settings objects, and the numeric constants at the top of modules.

A number that changes no packet can be round, or go; one that changes many is a place where a model is missing.
"""

from __future__ import annotations

import ast
import importlib
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import rxcli
from rxcli.errors import UsageError
from rxcli.lab.benchmark import screens
from rxcli.lab.benchmark.journal import Record, Run, Task
from rxcli.lab.benchmark.tables import Row
from rxcli.lab.benchmark.trial import Trial, score_result, simulate_trial
from rxcli.options import ReceiverOptions
from rxcli.receiver.pipeline import receive_frame

FACTORS = (0.7, 1.4)
_ROOT = Path(rxcli.__file__).parent
Value = float | tuple[Any, ...]
#: Name of a room's settings object.
_SETTINGS = "SETTINGS"


@dataclass(frozen=True, slots=True)
class Number:
    """A numeric constant of a module, or a field of its settings object: a scalar, or a tuple scaled as a whole."""

    module: str
    name: str
    line: int
    value: Value

    @property
    def place(self) -> str:
        """`receiver/still.py:25 _MAX_ITERATIONS`, without the package's name."""
        return f"{self.module.removeprefix('rxcli.').replace('.', '/')}.py:{self.line} {self.name}"

    def times(self, factor: float) -> Value:
        """The value moved; whole numbers stay whole and move by one at least."""
        return _moved(self.value, factor)


def _moved(value: Value, factor: float) -> Value:
    if isinstance(value, tuple):
        return tuple(_moved(item, factor) for item in value)
    if not isinstance(value, int):
        return value * factor
    up = factor > 1
    return max(value + 1, round(value * factor)) if up else min(value - 1, round(value * factor))


def numbers(room: str = "receiver") -> list[Number]:
    """The numeric constants of all modules below the folder `room` of the package, in the order of the files.

    Args:
        room: a folder or a module without its ending, relative to the package: `receiver/screen`, `receiver/still`.

    Raises:
        UsageError: there is no such room, or it has no numbers.
    """
    place = _ROOT / room
    paths = sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]
    if not paths[0].is_file():
        raise UsageError(f"no room {room!r} in the package", "name a folder or module, like receiver/screen")
    found = [number for path in paths for number in _numbers_of(path)]
    if not found:
        raise UsageError(f"{room} has no numbers at the top of its modules", "name another room")
    return found


def _numbers_of(path: Path) -> Iterator[Number]:
    module = ".".join(("rxcli", *path.relative_to(_ROOT).with_suffix("").parts)).removesuffix(".__init__")
    body = ast.parse(path.read_text(encoding="utf-8")).body
    settings = {name for one in body if (name := _class_of_settings(one)) is not None}
    for statement in body:
        if isinstance(statement, ast.ClassDef) and statement.name in settings:
            fields = [(f"{_SETTINGS}.{name}", line, value) for name, line, value in _assigned(statement.body)]
        else:
            fields = list(_assigned([statement]))
        for name, line, value in fields:
            literal = _literal(value)
            if literal is not None:
                yield Number(module, name, line, literal)


def _class_of_settings(statement: ast.stmt) -> str | None:
    """The class of the settings object that a statement makes."""
    if not isinstance(statement, ast.Assign) or _name_of(statement.targets[0]) != _SETTINGS:
        return None
    return _name_of(statement.value.func) if isinstance(statement.value, ast.Call) else None


def _name_of(expression: ast.AST) -> str | None:
    return expression.id if isinstance(expression, ast.Name) else None


def _assigned(statements: Sequence[ast.stmt]) -> Iterator[tuple[str, int, ast.expr]]:
    """Names, lines and values of what statements assign; `A, B = 1, 2` is two."""
    for statement in statements:
        if isinstance(statement, ast.Assign) and len(statement.targets) == 1:
            target, value = statement.targets[0], statement.value
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple) and len(target.elts) == len(value.elts):
                pairs = list(zip(target.elts, value.elts, strict=True))
            else:
                pairs = [(target, value)]
        elif isinstance(statement, ast.AnnAssign) and statement.value is not None:
            pairs = [(statement.target, statement.value)]
        else:
            pairs = []
        for one, its in pairs:
            name = _name_of(one)
            if name is not None:
                yield name, statement.lineno, its


def _literal(expression: ast.expr) -> Value | None:
    try:
        value = ast.literal_eval(expression)
    except ValueError:
        return None
    return value if _is_number(value) else None


def _is_number(value: Any) -> bool:
    if isinstance(value, tuple):
        return bool(value) and all(_is_number(item) for item in value)
    return isinstance(value, int | float) and not isinstance(value, bool)


@contextmanager
def moved(number: Number, factor: float) -> Iterator[None]:
    """The number moved for a while, in its own module and in those that import it by name."""
    name, _, field = number.name.partition(".")
    before = getattr(importlib.import_module(number.module), name)
    after = replace(before, **{field: number.times(factor)}) if field else number.times(factor)
    holders = [
        module
        for path, module in list(sys.modules.items())
        if path.startswith("rxcli.") and module is not None and module.__dict__.get(name) is before
    ]
    try:
        for module in holders:
            setattr(module, name, after)
        yield
    finally:
        for module in holders:
            setattr(module, name, before)


@lru_cache(maxsize=1)
def _pictures(seed: int, count: int) -> list[Trial]:
    return [simulate_trial(screens.scene_of(seed, number)[0], number) for number in range(count)]


def received(task: Task) -> Record:
    """Receive the task's pictures with one number moved; what came out of each.

    A receiver that a number breaks (a division by zero, a shape that does not fit) counts as nothing received.
    """
    options = ReceiverOptions()
    out: list[Any] = []
    with moved(Number(**{**task["number"], "value": _tuple(task["number"]["value"])}), task["factor"]):
        start = time.process_time()
        for trial in _pictures(task["seed"], task["pictures"]):
            try:
                result, _ = score_result(receive_frame(trial.frame, options), trial.truth)
            except Exception as error:
                out.append({"broke": repr(error), "right": 0, "surely_wrong": 0})
                continue
            right = sum(packet.bit_errors == 0 for packet in result.packets)
            sure = sum(p.bit_errors != 0 and p.confidence >= screens.CONFIDENT for p in result.packets)
            out.append({"right": right, "surely_wrong": sure})
        cpu_s = time.process_time() - start
    return {"frames": out, "cpu_s": cpu_s}


def _tuple(value: Any) -> Value:
    return tuple(_tuple(item) for item in value) if isinstance(value, list) else value


def run(room: str, pictures: int, how: Run) -> list[Row]:
    """A row for every number of `room`, those on which most hangs first.

    Args:
        room: see `numbers`.
        pictures: random pictures of `screens.scene_of`, half of them dark; each process simulates them once.
        how: it is done.
    """
    found = numbers(room)
    shared = {"run": "sensitivity", "seed": how.seed, "pictures": pictures}
    moves = [(number, factor) for number in found for factor in FACTORS]
    # The first number times one is the receiver as it is.
    tasks = [{**shared, "number": asdict(number), "factor": factor} for number, factor in [(found[0], 1.0), *moves]]
    unmoved, *records = how.tasks("sensitivity", tasks, received)
    rows = [_row(number, unmoved, records[2 * at : 2 * at + 2]) for at, number in enumerate(found)]
    return sorted(rows, key=lambda row: -row["changed"])


def _row(number: Number, unmoved: Record, records: Sequence[Record]) -> Row:
    def change(record: Record, what: str) -> int:
        after, before = (sum(int(frame[what]) for frame in each["frames"]) for each in (record, unmoved))
        return after - before

    row: Row = {"number": number.place, "value": str(number.value)[:24]}
    for factor, record in zip(FACTORS, records, strict=True):
        row[f"right_{factor:g}"] = change(record, "right")
        row[f"surely_wrong_{factor:g}"] = change(record, "surely_wrong")
        row[f"cpu_{factor:g}"] = record["cpu_s"] / unmoved["cpu_s"]
    row["broke"] = sum("broke" in frame for record in records for frame in record["frames"])
    # Pictures of which another number of packets, right or surely wrong, came out.
    row["changed"] = sum(
        (frame["right"], frame["surely_wrong"]) != (before["right"], before["surely_wrong"])
        for record in records
        for frame, before in zip(record["frames"], unmoved["frames"], strict=True)
    )
    return row
