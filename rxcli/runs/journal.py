"""Journal of a run: a file of JSON lines from which a killed run can be resumed.

Every line is written in one call, and sources follow one another, so after a kill only the last source can be
incomplete. `Journal.recover` drops it, and sources whose decoder was killed, and the run continues after the rest. The
first line holds version and options under `run`, the first line of every source length and time of its file under
`file`, and its last line `last`. Resuming with other options is refused; changed files are decoded again.
"""

import json
import logging
import os
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from io import FileIO
from pathlib import Path
from typing import Any

from rxcli.errors import UsageError, failure_explained, shortened
from rxcli.outputs import is_stream, replacing, writable
from rxcli.results.record import from_record, to_record
from rxcli.types import FrameResult

try:
    import fcntl
except ImportError:  # no such locks on this system
    fcntl = None  # type: ignore[assignment]

log = logging.getLogger(__name__)

#: Start of every line of results, which distinguishes a truncated line from a foreign file.
_LINE_START = b'{"source": "'
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)
_ANOTHER = "name the file that --json wrote before"


@dataclass(frozen=True, slots=True)
class Head:
    """Version and options of a run, on which results depend beside the files."""

    version: str
    #: Option -> value, as JSON has it.
    options: dict[str, Any]


def _differences(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    def shown(values: Mapping[str, Any], name: str) -> str:
        return shortened(json.dumps(values.get(name), default=str))

    changed = [name for name in {**before, **after} if before.get(name) != after.get(name)]
    return [f"{name} was {shown(before, name)}, is {shown(after, name)}" for name in changed]


def file_facts(path: str) -> dict[str, Any] | None:
    """Length in bytes of a file and when it was written, seconds; None where there is no regular file."""
    try:
        info = os.stat(path)
    except (OSError, ValueError):
        return None
    facts = {"bytes": info.st_size, "modified_s": round(info.st_mtime_ns / 1e9, 6)}
    return facts if stat.S_ISREG(info.st_mode) else None


@dataclass(slots=True)
class Lines:
    """Gives the JSON lines of a run, one a result, with what its journal needs to be resumed, to `put`."""

    put: Callable[[str], None]
    head: Head
    #: Name of a source -> where it is opened; a source without a file is not among them.
    paths: Mapping[str, str]
    #: Whether the first line is there already.
    begun: bool = False
    _source: str | None = None
    _facts: dict[str, Any] | None = None

    def begin(self, source: str, _scored: bool = False) -> None:
        """Look at the file of a source before it is decoded."""
        path = self.paths.get(source)
        self._source, self._facts = None, file_facts(path) if path is not None else None

    def write(self, result: FrameResult, last: bool) -> None:
        """Give the line of a result, without its end.

        Args:
            result: of the source that was begun.
            last: whether its source has no more.
        """
        record = to_record(result)
        if not self.begun:
            record["run"] = asdict(self.head)
        if self._source is None and self._facts is not None:
            record["file"] = self._facts
        if last:
            record["last"] = True
        self.begun, self._source = True, result.source
        self.put(json.dumps(record, allow_nan=False))


class Journal:
    """A file of JSON lines that holds whole lines only, whenever the process ends, and that one run writes at a time.

    Args:
        path: the file.
        resume: keep what is there and go on behind it, after `recover`.

    Raises:
        UsageError: another run is writing it.
        OutputError: it cannot be written.
    """

    def __init__(self, path: Path, resume: bool = False) -> None:
        self._path = path
        self._open_files = ExitStack()
        if path.is_symlink() and not is_stream(path):
            raise UsageError(f"{path}: is a link, and could lead elsewhere during the run", "name the file itself")
        self._open()
        if self._regular and not resume:
            self._file.truncate(0)

    def _open(self) -> None:
        """Open and lock the file. One that it replaces stays locked, so that no other run goes on in that."""
        with writable(self._path):
            opener = None if is_stream(self._path) else lambda path, flags: os.open(path, flags | _NO_LINK, 0o666)
            self._file = self._open_files.enter_context(FileIO(self._path, "a", opener=opener))
        self._regular = stat.S_ISREG(os.fstat(self._file.fileno()).st_mode)
        try:
            if self._regular and fcntl is not None:
                fcntl.flock(self._file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.close()
            reason = f"{self._path}: another run is writing this file"
            raise UsageError(reason, "wait for its end, or name another file with --json") from None
        except OSError:
            return  # some network file systems know no locks

    def append(self, line: str) -> None:
        """Append one line, in one call of the system; where only half of it can be written, none of it stays.

        Raises:
            OutputError: it cannot be written.
        """
        rest = memoryview(line.encode() + b"\n")
        whole = len(rest)
        with writable(self._path):
            try:
                while rest:
                    rest = rest[self._file.write(rest) :]
            except OSError:
                if self._regular and len(rest) < whole:
                    size = os.fstat(self._file.fileno()).st_size
                    self._file.truncate(size - (whole - len(rest)))
                raise

    def recover(
        self, head: Head | None = None, paths: Mapping[str, str] | None = None
    ) -> Iterator[tuple[str, list[FrameResult]]]:
        """Give the complete sources of an earlier run, then leave only them in the file. Exhaust it before `append`.

        The last source may be incomplete, and is dropped; so are sources marked `retry`, and those whose files have
        changed.

        Args:
            head: of the run that goes on; None: not compared.
            paths: name -> path of the sources of this run; other sources are kept.

        Raises:
            UsageError: the file is no output of `vlc-rx decode --json`, or was written with other options; it is left
                as it is.
            InputError: it cannot be read.
            OutputError: it cannot be written.
        """
        if not self._regular:
            return
        run: Any = None
        facts: object = None
        lines: list[bytes] = []
        results: list[FrameResult] = []
        complete: set[str] = set()
        with replacing(self._path, follow=False) as hidden, hidden.open("wb") as out:
            for number, (line, record, result) in enumerate(_records(self._path)):
                run = record.get("run", run)
                if number == 0 and head is not None:
                    _check_same(self._path, head, run)
                if result.source in complete or (results and result.source != results[0].source):
                    reason = f"{self._path} line {number + 1}: results of {result.source} stand in two places"
                    raise UsageError(reason, f"the file was edited; {_ANOTHER}, as it was")
                if not results:
                    facts = record.get("file")
                lines.append(line)
                results.append(result)
                if record.get("last") is not True:
                    continue
                if not any(result.retry for result in results) and not _has_changed(result.source, facts, paths or {}):
                    if out.tell() == 0 and run is not None:  # the first line keeps the record of the run
                        lines[0] = json.dumps({**json.loads(lines[0]), "run": run}).encode() + b"\n"
                    out.writelines(lines)
                    yield results[0].source, results
                complete.add(result.source)
                lines, results = [], []
        self._open()

    def close(self) -> None:
        """Close the file, which unlocks it."""
        self._open_files.close()


def _records(path: Path) -> Iterator[tuple[bytes, dict[str, Any], FrameResult]]:
    """Line, record and result of every whole line of a journal."""
    with failure_explained(f"{path}: cannot be resumed", "name another file"), path.open("rb") as file:
        for number, line in enumerate(file, start=1):
            cut = line.rstrip(b"\0")[: len(_LINE_START)]  # a machine that stops leaves zeros behind it
            if not line.endswith(b"\n") and _LINE_START.startswith(cut):
                return
            try:
                record = json.loads(line)
                result = from_record(record)
            except (ValueError, RecursionError):
                raise UsageError(f"{path} line {number}: not JSON of ours", _ANOTHER) from None
            except UsageError as error:
                raise UsageError(f"{path} line {number}: {error.message}", _ANOTHER) from None
            yield line, record, result


def _check_same(path: Path, head: Head, run: object) -> None:
    """Refuse to mix results of different options, before anything is changed."""
    problems = ["it does not state the options of its run"]
    if isinstance(run, dict) and isinstance(run.get("options"), dict):
        before, after = (
            {"version": of.get("version")} | {"--" + name.replace("_", "-"): v for name, v in of["options"].items()}
            for of in (run, asdict(head))
        )
        problems = _differences(before, after)
    if problems:
        more = f" (and {len(problems) - 3} other differences)" if len(problems) > 3 else ""
        reason = f"{path}: cannot be resumed, results would not go together: {'; '.join(problems[:3])}{more}"
        raise UsageError(reason, "run it with the same options, or name another file with --json")


def _has_changed(source: str, facts: object, paths: Mapping[str, str]) -> bool:
    """Whether the file of a source is there and is another one than before; a warning states the difference."""
    current = file_facts(paths[source]) if source in paths else None
    changed = _differences(facts if isinstance(facts, dict) else {}, current) if current else []
    if changed:
        log.warning("%s has changed (%s); it is decoded again", source, ", ".join(changed))
    return bool(changed)
