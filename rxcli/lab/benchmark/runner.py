"""The one runner: draws the cases of a scenario, receives each in every way, and keeps a journal of it."""

import csv
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import sha256
from math import inf
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import msgspec

from rxcli.errors import UsageError, failure_explained
from rxcli.ingest import KNOWN_SUFFIXES, open_source
from rxcli.lab.benchmark import goodput
from rxcli.lab.benchmark.cases import TWIN, Case, Record, arguments_of, bare, received, write_case
from rxcli.lab.benchmark.draw import DRAWERS, Place
from rxcli.lab.benchmark.measures import COMMON, COMMON_COST
from rxcli.outputs import write_whole
from rxcli.resources import data_dir
from rxcli.runs.processes import ONE_THREAD, environment

#: The checkout that this package is imported from.
CHECKOUT = Path(__file__).resolve().parents[3]
#: What a case is drawn and received from, as JSON values; equal tasks of equal code give equal records.
Task = dict[str, Any]
Work = Callable[[Task], list[Record]]


class Scenario(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One row of `scenarios.toml`."""

    about: str
    #: Of `DRAWERS`, or "transfer".
    draw: str
    #: Numbers that are drawn at each point, by default.
    count: int
    #: Of `rxcli.lab.benchmark.cases.WAYS`. Packets of the others are compared with those of the first.
    ways: tuple[str, ...] = ("receiver",)
    #: The way whose right packets `share` counts against.
    beside: str | None = None
    #: Measures in the table, where they are not the common ones.
    columns: tuple[str, ...] = ()
    #: Measures in the table beside the common ones.
    more: tuple[str, ...] = ()
    #: Label -> arguments of the drawing at that point; and common arguments.
    points: dict[str, dict[str, Any]] = msgspec.field(default_factory=lambda: {"": {}})
    base: dict[str, Any] = {}
    #: Whether to print the bins of the confidence.
    bins: bool = False
    #: Whether every case has a process of its own, so that its memory is meaningful.
    alone: bool = False

    @property
    def all_columns(self) -> tuple[str, ...]:
        """Measures of the table."""
        return self.columns or (*COMMON, *self.more, *COMMON_COST)

    def tasks(self, seed: int, count: int, folder: Path, **more: str | None) -> list[Task]:
        """What is to be done: `count` numbers at every point."""
        shared = {"draw": self.draw, "ways": self.ways, "seed": seed, "folder": str(folder), "cae": None, **more}
        return [
            {**shared, "number": number, "label": point.get("label", name), "point": {**self.base, **point}}
            for name, point in self.points.items()
            for number in range(count)
        ]


@lru_cache(maxsize=1)
def scenarios() -> dict[str, Scenario]:
    """The table of scenarios, in order."""
    text = Path(__file__).with_name("scenarios.toml").read_text(encoding="utf-8")
    return msgspec.toml.decode(text, type=dict[str, Scenario])


def capture_points(folder: Path | None) -> dict[str, dict[str, Any]]:
    """The photographs and clips of a folder as points, by name; None: the samples."""
    paths = sorted((folder or data_dir("sample_frames")).resolve().iterdir())
    return {path.name: {"path": str(path)} for path in paths if path.suffix.lower() in KNOWN_SUFFIXES}


def labels_by_field(names: Iterable[str], folder: Path | None, field: str) -> dict[str, str]:
    """File -> value of a field, in its order: of a column of a CSV beside the captures, or of their metadata.

    Raises:
        UsageError: neither states it of a file.
    """
    place, stated, found = folder or data_dir("sample_frames"), dict[str, Any](), []
    for path in sorted(place.glob("*.csv")):
        with path.open(newline="", encoding="utf-8-sig") as file:
            stated |= {row["file"]: row.get(field) for row in csv.DictReader(file) if row.get("file")}
    for name in names:
        value = stated.get(name) or getattr(next(iter(open_source(place / name))).metadata, field, None)
        if value is None:
            reason = f"{place / name}: neither a CSV beside it nor its metadata states {field!r}"
            raise UsageError(reason, f"write {place / 'fields.csv'} with the columns file and {field}")
        try:
            found.append((float(value), f"{field} {float(value):g}", name))
        except (TypeError, ValueError):
            found.append((inf, f"{field} {value}", name))
    return {name: label for _, label, name in sorted(found)}


def do(task: Task) -> list[Record]:
    """Draw the cases of a task and receive each in every way."""
    if task["draw"] == "transfer":
        way = {"receiver": goodput.transferred(**task["point"], seed=(task["seed"], task["number"]))}
        return [{"about": {}, "has_data": True, "groups": [task["label"]], "ways": way}]
    ways = task["ways"]
    place = Place(task["seed"], task["number"], task["point"], Path(task["folder"]), "bound" in ways, TWIN in ways)
    records = []
    for turn, case in enumerate(DRAWERS[task["draw"]](place)):
        if task["cae"] is not None:
            case = replace(case, options=replace(case.options, cae=task["cae"]))
        found = {way: received(case, way) for way in ways}
        groups = [*filter(None, [task["label"]]), *case.groups]
        about = {"number": task["number"], **case.about}
        if task.get("save"):
            name = f"{task['label']} {task['seed']} {task['number']} {turn}".strip().replace(" ", "-")
            save(case, Path(task["save"]) / name, {"about": about, "groups": groups, "ways": found, "text": case.text})
            if case.twin is not None:
                save(case.twin, Path(task["save"]) / f"{name}-twin", {"about": about, "groups": groups, "ways": {}})
        records.append({"about": about, "has_data": case.has_data, "groups": groups, **bare(case), "ways": found})
    return records


def save(case: Case, stem: Path, known: Record) -> None:
    """Write a case as a file with truth and profiles, and `STEM.case.json`: corners, arguments, what is known.

    The arguments under "named" name screen, camera and corners.
    """
    paths = write_case(case, stem)
    known |= {"files": [path.name for path in paths], "arguments": arguments_of(paths, case.options)}
    known["named"] = None if case.named is None else arguments_of(paths, case.named)
    known["corners"] = None if case.corners is None else case.corners.tolist()
    write_whole(stem.with_name(stem.name + ".case.json"), json.dumps(known) + "\n")


def load_journal(path: Path) -> dict[str, list[Record]]:
    """Records of finished tasks by their key; a last line that a killed run left unfinished is taken away."""
    found = {}
    lines = path.read_text("utf-8").splitlines(keepends=True) if path.exists() else []
    if lines and not lines[-1].endswith("\n"):
        path.write_text("".join(lines := lines[:-1]), encoding="utf-8")
    for number, line in enumerate(lines, 1):
        with failure_explained(f"{path}: line {number} is no journal entry", "name another file"):
            entry = json.loads(line)
            found[entry["key"]] = entry["records"]
    return found


@lru_cache(maxsize=1)
def code_fingerprint() -> str:
    """Hash of the package's source: what an earlier version has found is not taken for what this one does."""
    root = CHECKOUT / "rxcli"
    digest = sha256()
    for path in sorted(path for path in root.rglob("*.py") if path.parent.name != "cli"):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


@dataclass(frozen=True, slots=True)
class Run:
    """Run the tasks that are missing in the journal, in processes of one thread each."""

    #: JSON lines, a finished task each.
    journal: Path
    jobs: int = 1
    quiet: bool = False

    def __call__(self, tasks: Sequence[Task], label: str, *, alone: bool = False, work: Work = do) -> list[Record]:
        """The records of all tasks, in order.

        Args:
            tasks: JSON values each.
            label: of the progress bar.
            alone: a process for each task.
            work: a function of a module, so that other processes find it.
        """
        from tqdm import tqdm

        keys = {json.dumps({**task, "code": code_fingerprint()}, sort_keys=True): task for task in tasks}
        done = load_journal(self.journal)
        missing = {key: task for key, task in keys.items() if key not in done}
        n_done = len(keys) - len(missing)
        progress = tqdm(total=len(keys), initial=n_done, desc=label, disable=self.quiet or None, leave=False)
        with progress as bar, self.journal.open("a", encoding="utf-8") as file:
            for key, records in self._each(missing, alone, work):
                done[key] = records
                file.write(json.dumps({"key": key, "records": records}, separators=(",", ":")) + "\n")
                file.flush()
                bar.update()
        return [record for key in keys for record in done[key]]

    def _each(self, tasks: dict[str, Task], alone: bool, work: Work) -> Iterator[tuple[str, list[Record]]]:
        if not alone and (self.jobs == 1 or len(tasks) <= 1):
            for key, task in tasks.items():
                yield key, work(task)
            return
        # Libraries read the environment when they are loaded, which in a spawned worker is later than here.
        workers = ProcessPoolExecutor(self.jobs, get_context("spawn"), max_tasks_per_child=1 if alone else None)
        with environment(ONE_THREAD), workers as pool:
            futures = {pool.submit(work, task): key for key, task in tasks.items()}
            try:
                for future in as_completed(futures):
                    yield futures[future], future.result()
            finally:
                pool.shutdown(wait=False, cancel_futures=True)
