"""The file of JSON lines as its own journal: what it holds whenever the process ends, and going on from there.

Every line is written whole, at once, and sources follow one another, so that after a kill at most the last source is
incomplete; `recover` drops it, and sources whose decoder was killed, and the run goes on behind the rest. The first
line says under `run` which version wrote the file with which options; the first line of every source says under `file`
how long the file was and when it was written; its last line says `last`. Other options or changed files would make
results that do not go together.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from rxcli.errors import InputError, UsageError
from rxcli.outputs import replacing, unwritable
from rxcli.results.record import from_record, to_record
from rxcli.types import FrameResult

try:
    import fcntl
except ImportError:  # no such locks on this system
    fcntl = None  # type: ignore[assignment]

#: What every line of results starts with, so that half of one is told from a foreign file.
_LINE_START = b'{"source": "'
_ANOTHER = "name the file that --json wrote before"
_PIECE_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class Head:
    """What results depend on beside the files."""

    version: str
    #: Option -> value, as JSON has it.
    options: Mapping[str, Any]

    def as_record(self) -> dict[str, Any]:
        """As it stands in the first line."""
        return {"version": self.version, "options": dict(self.options)}

    def differences(self, record: object) -> list[str]:
        """What is not as the first line of an earlier run says."""
        if not isinstance(record, dict) or not isinstance(record.get("options"), dict):
            return ["it does not say with which options it was written"]
        before: dict[str, Any] = record["options"]
        pairs: dict[str, tuple[Any, Any]] = {"version": (record.get("version"), self.version)}
        for name in sorted({*before, *self.options}):
            pairs["--" + name.replace("_", "-")] = before.get(name), self.options.get(name)
        return [f"{name} was {_shown(old)}, is {_shown(new)}" for name, (old, new) in pairs.items() if old != new]


def _shown(value: object) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 80 else f"{text[:77]}..."


def file_facts(path: str) -> dict[str, Any] | None:
    """Length in bytes of a file and when it was written, seconds; None where there is no regular file."""
    try:
        info = os.stat(path)
    except (OSError, ValueError):
        return None
    if not stat.S_ISREG(info.st_mode):
        return None
    return {"bytes": info.st_size, "modified_s": round(info.st_mtime_ns / 1e9, 6)}


@dataclass(slots=True)
class Lines:
    """Makes the JSON lines of a run, with what its journal needs to be resumed."""

    head: Head
    #: Name of a source -> where it is opened; a source without a file is not among them.
    paths: Mapping[str, str]
    #: Whether the first line is there already.
    begun: bool = False
    _source: str | None = None
    _facts: dict[str, Any] | None = None

    def begin(self, source: str) -> None:
        """Look at the file of a source before it is decoded."""
        path = self.paths.get(source)
        self._source, self._facts = None, file_facts(path) if path is not None else None

    def line(self, result: FrameResult, last: bool) -> str:
        """The line of a result, without its end.

        Args:
            result: of the source that was begun.
            last: whether its source has no more.
        """
        record = to_record(result)
        if not self.begun:
            record["run"] = self.head.as_record()
        if self._source is None and self._facts is not None:
            record["file"] = self._facts
        if last:
            record["last"] = True
        self.begun, self._source = True, result.source
        return json.dumps(record, allow_nan=False)


class Journal:
    """A file of JSON lines that holds whole lines only, whenever the process ends, and that one run writes at a time.

    Args:
        path: the file.
        resume: keep what is there (after `recover`) and go on behind it.

    Raises:
        UsageError: another run is writing it.
        OutputError: it cannot be written.
    """

    def __init__(self, path: Path, resume: bool = False) -> None:
        self._path = path
        #: A file that was replaced, whose lock is kept.
        self._replaced: BinaryIO | None = None
        self._open()
        if self._regular and not resume:
            self._file.truncate(0)

    def _open(self) -> None:
        try:
            self._file: BinaryIO = self._path.open("ab", buffering=0)
            self._regular = stat.S_ISREG(os.fstat(self._file.fileno()).st_mode)
        except (OSError, ValueError) as error:
            raise unwritable(self._path, error) from None
        try:
            self._lock()
        except BaseException:
            self._file.close()
            raise

    def follow(self) -> None:
        """Go on in the file that has taken the place of the one that was opened, if `recover` has put one there."""
        try:
            if not self._regular or os.path.samestat(os.fstat(self._file.fileno()), self._path.stat()):
                return
        except OSError as error:
            raise unwritable(self._path, error) from None
        self._replaced = self._file
        self._open()

    def _lock(self) -> None:
        if fcntl is None or not self._regular:
            return
        try:
            fcntl.flock(self._file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            reason = f"{self._path}: another run is writing this file"
            raise UsageError(reason, "wait for its end, or name another file with --json") from None
        except OSError:
            return  # some network file systems know no locks

    def write(self, result: FrameResult) -> None:
        """Append the line of `result`; see `append`."""
        self.append(json.dumps(to_record(result), allow_nan=False))

    def append(self, line: str) -> None:
        """Append one line, in one call of the system; where only half of it can be written, none of it stays.

        Raises:
            OutputError: it cannot be written.
        """
        rest = memoryview(line.encode() + b"\n")
        whole = len(rest)
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except BrokenPipeError:
            raise
        except OSError as error:
            if self._regular and len(rest) < whole:
                size = os.fstat(self._file.fileno()).st_size
                self._file.truncate(size - (whole - len(rest)))
            raise unwritable(self._path, error) from None

    def close(self) -> None:
        """Close the file, which unlocks it."""
        self._file.close()
        if self._replaced is not None:
            self._replaced.close()


def recover(
    path: Path, head: Head | None = None, paths: Mapping[str, str] | None = None
) -> Iterator[tuple[str, list[FrameResult]]]:
    """Give the complete sources of an earlier run's JSON lines, then leave only them in the file.

    The last source may be incomplete, and is cut off. Sources that say `retry` are left out wherever they stand, by
    a new file in the place of the old one (see `Journal.follow`). Exhaust it before the file is written to.

    Args:
        path: the file.
        head: of the run that goes on; None: not compared.
        paths: name of a source -> where it is opened, of those that the run is asked for; the others are kept.

    Raises:
        UsageError: the file is no output of `vlc-rx decode --json`, or was written with other options or of other
            files; it is left as it is.
        InputError: it cannot be read or cut.
    """
    try:
        _check_same(path, head, paths or {})
        with path.open("rb+") as file:
            kept = yield from _complete_sources(file, path)
            if len(kept) > 1 or (kept and kept[0][0] > 0):
                _leave_only(kept, file, path)
            else:
                file.truncate(kept[0][1] if kept else 0)
    except FileNotFoundError:
        return
    except OSError as error:
        raise InputError(f"{path}: cannot be resumed ({error.strerror})", "name another file") from None


def _check_same(path: Path, head: Head | None, paths: Mapping[str, str]) -> None:
    """Refuse to mix what does not go together, before anything is changed."""
    if head is None:
        return
    problems: list[str] = []
    with path.open("rb") as file:
        source = None
        for number, line in enumerate(file, start=1):
            if _is_cut(line):
                break
            record = _parse(line, f"{path} line {number}")
            if number == 1:
                problems += head.differences(record.get("run"))
            if record.get("source") != source:
                source = record.get("source")
                problems += _changes(str(source), record.get("file"), paths)
    if problems:
        more = f" (and {len(problems) - 3} other differences)" if len(problems) > 3 else ""
        raise UsageError(
            f"{path}: cannot be resumed, results would not go together: {'; '.join(problems[:3])}{more}",
            "run it with the same options and files, or name another file with --json",
        )


def _changes(source: str, facts: object, paths: Mapping[str, str]) -> list[str]:
    """How the file of a source differs from what it was."""
    if source not in paths:
        return []
    now = file_facts(paths[source])
    if facts == now:
        return []
    if not isinstance(facts, dict) or now is None:
        return [f"{source} was {'there' if facts else 'not there'}, is {'there' if now else 'not there'}"]
    name = next((name for name in now if facts.get(name) != now[name]), "file")
    unit = {"bytes": "bytes", "modified_s": "s"}.get(name, "")
    return [f"{source} has changed ({name.removesuffix('_s')} was {facts.get(name)!r}, is {now.get(name)} {unit})"]


def _complete_sources(
    file: BinaryIO, path: Path
) -> Generator[tuple[str, list[FrameResult]], None, list[tuple[int, int]]]:
    """Give every complete source; returns from where to where they stand, in pieces."""
    kept: list[tuple[int, int]] = []
    begin = offset = 0
    results: list[FrameResult] = []

    def complete() -> Iterator[tuple[str, list[FrameResult]]]:
        if any(result.retry for result in results):
            return
        if kept and kept[-1][1] == begin:
            kept[-1] = (kept[-1][0], offset)
        else:
            kept.append((begin, offset))
        yield results[0].source, results

    for number, line in enumerate(file, start=1):
        if _is_cut(line):
            break
        place = f"{path} line {number}"
        record = _parse(line, place)
        result = _result(record, place)
        if results and result.source != results[0].source:  # a version that did not say which line is the last
            yield from complete()
            results, begin = [], offset
        results.append(result)
        offset += len(line)
        if record.get("last") is True:
            yield from complete()
            results, begin = [], offset
    return kept


def _leave_only(kept: list[tuple[int, int]], file: BinaryIO, path: Path) -> None:
    """Replace a journal by pieces of it; what its first line says of the run stands in the first that is left."""
    file.seek(0)
    run = _parse(file.readline(), f"{path} line 1").get("run")
    with replacing(path) as hidden, hidden.open("wb") as out:
        for begin, end in kept:
            file.seek(begin)
            if out.tell() == 0 and begin > 0:
                record = _parse(file.readline(), str(path))
                at = list(record).index("file") if "file" in record else len(record)
                items = list(record.items())
                out.write(json.dumps(dict([*items[:at], ("run", run), *items[at:]])).encode() + b"\n")
            while piece := file.read(min(end - file.tell(), _PIECE_BYTES)):
                out.write(piece)


def _is_cut(line: bytes) -> bool:
    """Whether a kill has cut a line of ours."""
    return not line.endswith(b"\n") and line[: len(_LINE_START)] == _LINE_START[: len(line)]


def _parse(line: bytes, place: str) -> dict[str, Any]:
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        raise UsageError(f"{place}: not JSON of ours", _ANOTHER) from None
    if not isinstance(record, dict):
        raise UsageError(f"{place}: no result", _ANOTHER)
    return record


def _result(record: dict[str, Any], place: str) -> FrameResult:
    try:
        return from_record(record)
    except UsageError as error:
        raise UsageError(f"{place}: {error.message}", _ANOTHER) from None
