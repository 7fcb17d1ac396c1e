"""Long runs that survive an interruption: a journal of JSON lines, one per finished task, and workers that fill it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from rxcli.errors import InputError, UsageError
from rxcli.runs.batch import use_one_thread
from rxcli.runs.processes import ONE_THREAD, environment

Record = dict[str, Any]
#: A task is what its work needs, as JSON values; its key says what makes it the same task in another run.
Task = dict[str, Any]
Work = Callable[[Task], Record]


class Journal:
    """Records of finished tasks, in memory and, where a path is given, on disk.

    Args:
        path: JSON lines file that is appended to; None keeps the records in memory only.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._path = path
        self._records: dict[str, Record] = {}
        if path is not None and path.exists():
            self._load(path)

    def _load(self, path: Path) -> None:
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: cannot be read as a journal ({error})", "name another file") from None
        lines = text.splitlines(keepends=True)
        for number, line in enumerate(lines, 1):
            if not line.endswith("\n"):
                # The run was killed while it wrote this line: its task is simply done again.
                path.write_text("".join(lines[:-1]), encoding="utf-8")
                break
            self._load_line(line, path, number)

    def _load_line(self, line: str, path: Path, number: int) -> None:
        try:
            entry = json.loads(line)
            self._records[entry["key"]] = entry["record"]
        except (ValueError, KeyError, TypeError):
            raise InputError(f"{path}: line {number} is no journal entry", "name another file") from None

    def __contains__(self, key: str) -> bool:
        return key in self._records

    def __getitem__(self, key: str) -> Record:
        return self._records[key]

    @property
    def records(self) -> list[Record]:
        """All of them, in the order in which they were added."""
        return list(self._records.values())

    def add(self, key: str, record: Record) -> None:
        """Keep the record of a finished task."""
        self._records[key] = record
        if self._path is None:
            return
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"key": key, "record": record}, separators=(",", ":")) + "\n")
        except OSError as error:
            raise UsageError(
                f"{self._path}: cannot be written ({error.strerror})", "name another folder with --out"
            ) from None


def task_key(task: Task) -> str:
    """What tells tasks apart: their values in canonical order."""
    return json.dumps(task, sort_keys=True, separators=(",", ":"))


@lru_cache(maxsize=1)
def code_fingerprint() -> str:
    """Hash of the package's source: what an earlier version has found is not taken for what this one does."""
    root = Path(__file__).resolve().parents[2]
    digest = sha256()
    for path in sorted(root.rglob("*.py")):
        if path.parent.name != "cli":
            digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


#: Seeds of a run's scenes: this many times the run's, and on.
SEEDS_A_RUN = 1_000_000


@dataclass(frozen=True, slots=True)
class Run:
    """How the tasks of a benchmark are done: those that the journal lacks, in processes of one thread each."""

    #: What is done already; it grows task by task.
    journal: Journal = field(default_factory=Journal)
    #: Of all random scenes.
    seed: int = 0
    #: Processes.
    jobs: int = 1
    #: Show no progress bar.
    quiet: bool = False

    def tasks(self, label: str, tasks: Sequence[Task], work: Work) -> list[Record]:
        """The records of all tasks, in order.

        Args:
            label: of the progress bar.
            tasks: JSON values each.
            work: a function of a module, so that other processes find it.
        """
        from tqdm import tqdm

        code = code_fingerprint()
        keys = [task_key({**task, "code": code}) for task in tasks]
        missing = [(key, task) for key, task in zip(keys, tasks, strict=True) if key not in self.journal]
        n_done = len(tasks) - len(missing)
        with tqdm(total=len(tasks), initial=n_done, desc=label, disable=self.quiet or None, leave=False) as bar:
            for key, record in _each(missing, work, self.jobs):
                self.journal.add(key, record)
                bar.update()
        return [self.journal[key] for key in keys]

    def scenes(self, label: str, work: Work, count: int, **more: Any) -> list[Record]:
        """The records of `count` random scenes, of which each task tells its own seed; in order.

        Args:
            label: of the run: the same seed in another one is another task.
            work: simulates the scene of `task["seed"]`, receives it, and says what came out.
            count: scenes.
            more: what else the work needs.
        """
        first = SEEDS_A_RUN * self.seed
        return self.tasks(label, [{"run": label, "seed": first + number, **more} for number in range(count)], work)


def _each(tasks: Sequence[tuple[str, Task]], work: Work, jobs: int) -> Iterator[tuple[str, Record]]:
    if jobs <= 1 or len(tasks) <= 1:
        with _one_thread():
            for key, task in tasks:
                yield key, work(task)
        return
    yield from _in_processes(tasks, work, jobs)


def _in_processes(tasks: Sequence[tuple[str, Task]], work: Work, jobs: int) -> Iterator[tuple[str, Record]]:
    from concurrent.futures import ProcessPoolExecutor, as_completed
    from multiprocessing import get_context

    # Libraries read these when they are loaded, which in a spawned worker is later than here.
    with (
        environment(ONE_THREAD),
        ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=use_one_thread) as pool,
    ):
        futures = {pool.submit(work, task): key for key, task in tasks}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


@contextmanager
def _one_thread() -> Iterator[None]:
    """OpenCV on one thread for a while, so that times mean the same on every machine."""
    import cv2

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
