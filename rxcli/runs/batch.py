"""Many sources: which files there are, and decoding them here or in worker processes.

Results come source by source in the order of the input, whoever decodes them; `rxcli.runs.journal` keeps them.
"""

from __future__ import annotations

import logging
import os
import signal
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from rxcli.errors import InputError, OutputError, ProfileError, ReceiverError, UsageError
from rxcli.outputs import OUTPUT_MARKER
from rxcli.runs.processes import ONE_THREAD, environment, start_process
from rxcli.types import FILE_MEMORY_MB, Frame, FrameResult

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess

    from rxcli.profiles import ScreenProfile
    from rxcli.receiver.pipeline import ReceiverOptions

log = logging.getLogger(__name__)

OpenSource = Callable[[str], Iterable[Frame]]
Receive = Callable[[Iterable[Frame], Any], Iterator[FrameResult]]
#: One source with its results, which are to be taken before the next source is asked for.
Decoded = tuple["Source", Iterator[FrameResult]]

#: What these signals mean is decided by the first process; they often come to all at once.
_FIRST_DECIDES = (signal.SIGINT, signal.SIGTERM)
#: Sources per worker that may be decoded ahead of the one whose results are being taken.
_AHEAD = 32


@dataclass(frozen=True, slots=True)
class Source:
    """A file or device to decode."""

    #: What results and messages call it.
    name: str
    #: Where it is opened.
    path: str
    #: Why there is nothing to open, None where there is.
    problem: str | None = None
    #: Where its taps go, below their folder: where it lies itself below what all sources of the run have in common.
    subfolder: str = ""


def collect_sources(paths: Iterable[str], suffixes: frozenset[str]) -> list[Source]:
    """The sources that `paths` name: files as they are, folders recursively and in order of name.

    Each file is taken once. In folders, files of other suffixes and hidden ones are passed over; "-" is stdin.

    Args:
        paths: files and folders.
        suffixes: lower-case suffixes, with the dot, of files to take from folders.
    """
    found = [source for path in paths for source in _sources_of(path, suffixes)]
    return _with_subfolders(list({os.path.normpath(source.name): source for source in found}.values()))


def _with_subfolders(sources: list[Source]) -> list[Source]:
    """The sources with a place of its own for the taps of each, whatever others are called."""
    from rxcli.results.dump import plain_name

    folders = [os.path.dirname(os.path.abspath(source.name)) for source in sources]
    try:
        common = os.path.commonpath(folders) if folders else ""
    except ValueError:  # several drives
        common = os.sep
    count: Counter[tuple[str, str]] = Counter()
    placed = []
    for source, folder in zip(sources, folders, strict=True):
        below = os.path.relpath(folder, common) if folder != common else ""
        place = (below, plain_name(source.name).casefold())
        count[place] += 1
        own = below if count[place] == 1 else os.path.join(below, f"{count[place]}")
        placed.append(replace(source, subfolder=own))
    return placed


def _sources_of(path: str, suffixes: frozenset[str]) -> Iterator[Source]:
    if path == "-" or not os.path.isdir(path):
        yield Source(path, path)
        return
    refused: list[OSError] = []
    files = [name for name in _walk(path, refused.append) if os.path.splitext(name)[1].casefold() in suffixes]
    if not files and not refused:
        listed = ", ".join(sorted(suffix.lstrip(".") for suffix in suffixes))
        problem = f"{path}: the folder holds no picture or clip; name files, or a folder with {listed}"
        yield Source(path, path, problem)
    for name in files:
        yield Source(name, name)
    for error in refused:
        name = error.filename
        problem = f"{name}: the folder may not be read ({error.strerror}); ask for permission, or leave it out"
        yield Source(name, name, problem)


def _walk(folder: str, refused: Callable[[OSError], None]) -> Iterator[str]:
    for parent, folders, files in os.walk(folder, onerror=refused):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        if OUTPUT_MARKER in files:  # what `inspect` has written
            folders.clear()
            continue
        yield from (os.path.join(parent, name) for name in sorted(files) if not name.startswith("."))


@dataclass(frozen=True, slots=True)
class Decoder:
    """How one source is decoded; picklable where its functions are."""

    options: Any
    open_source: OpenSource
    receive: Receive
    #: Sees every frame before it is received, and the subfolder of its source.
    tap: Callable[[Frame, str], None] | None = None
    #: Sees every result, and the subfolder of its source.
    after: Callable[[FrameResult, str], None] | None = None
    #: Screens whose messages and files are looked for; empty: none are.
    link_screens: tuple[ScreenProfile, ...] = ()
    #: Bound of all files under way, 2^20 bytes.
    file_memory_mb: int = FILE_MEMORY_MB

    def results(self, source: Source) -> Iterator[FrameResult]:
        """The results of all frames of `source`, at least one; an input that fails ends in an `unreadable` one.

        Raises:
            UsageError: the options make no sense, whatever the source.
            ProfileError: likewise.
            OutputError: taps cannot be written.
        """
        failure = _Failure(source)
        count = 0
        try:
            if source.problem:
                raise InputError(source.problem)
            for result in self.linked(self.receive(failure.guard(self._frames(source)), self._options_of(source))):
                result = replace(result, source=source.name)
                if self.after is not None:
                    self.after(result, source.subfolder)
                yield result
                count += 1
        except (UsageError, ProfileError, OutputError):
            raise
        except Exception as error:
            failure.note(error)
        if failure.message or not count:
            yield unreadable(source, count, failure.message or f"{source.name}: holds no picture; name another file")

    def linked(self, results: Iterator[FrameResult]) -> Iterator[FrameResult]:
        """Results with the messages and files that are complete with them.

        A photograph without any keeps its soft bits, for others may show the same.
        """
        if not self.link_screens:
            yield from results
            return
        from rxcli.link.collector import Collector

        collector = Collector(self.link_screens, self.file_memory_mb)
        for number, (result, last) in enumerate(with_last(results)):
            taken = collector.add(result)
            if last:
                taken = collector.finish(taken)
                alone = number == 0 and not (taken.messages or taken.objects)
                taken = replace(taken, soft_bits=result.soft_bits if alone else None)
            yield taken

    def _frames(self, source: Source) -> Iterator[Frame]:
        told = False
        for frame in self.open_source(source.path):
            frame = replace(frame, source=source.name)  # as the user named it, wherever it is opened
            if frame.metadata.not_believed and not told:
                claims, told = ", ".join(frame.metadata.not_believed), True
                log.warning("%s: not believed, and taken as unknown: %s", source.name, claims)
            if self.tap is not None:
                self.tap(frame, source.subfolder)
            yield frame

    def _options_of(self, source: Source) -> Any:
        """The options with a place of its own for the source's taps."""
        folder = getattr(self.options, "dump_dir", None)
        return self.options if folder is None else replace(self.options, dump_dir=folder / source.subfolder)


class _Failure:
    """What went wrong with a source. The receiver behind a guarded iterator still gives what it had got till then."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self.message: str | None = None

    def guard(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """The frames up to the failure, which is noted instead of raised."""
        try:
            yield from frames
        except (UsageError, ProfileError, OutputError):
            raise
        except Exception as error:
            self.note(error)

    def note(self, error: Exception) -> None:
        """Keep the message of `error`; one that is no `ReceiverError` is a bug, whose traceback goes to the log."""
        name = self._source.name
        if isinstance(error, ReceiverError):
            self.message = str(error).replace(self._source.path, name)
            return
        if isinstance(error, (OSError, MemoryError)):
            reason = getattr(error, "strerror", None) or "more memory is needed than there is"
            self.message = f"{name}: cannot be decoded ({reason}); try it by itself"
            return
        log.debug("unexpected error", exc_info=error)
        self.message = f"internal error ({type(error).__name__}: {error}); run again with --verbose and report it"


def unreadable(source: Source, frame: int, message: str) -> FrameResult:
    """The result of a frame that could not be had."""
    return FrameResult(source=source.name, frame=frame, time_s=0.0, status="unreadable", message=message)


def with_last(results: Iterator[FrameResult]) -> Iterator[tuple[FrameResult, bool]]:
    """Each result, and whether it is the last one; where they break off, none is."""
    held: FrameResult | None = None
    try:
        for result in results:
            if held is not None:
                yield held, False
            held = result
    except (Exception, KeyboardInterrupt):
        if held is not None:
            yield held, False
        raise
    if held is not None:
        yield held, True


def standard_decoder(
    options: ReceiverOptions,
    tap: Callable[[Frame, str], None] | None = None,
    after: Callable[[FrameResult, str], None] | None = None,
) -> Decoder:
    """The decoder that reads files and receives them."""
    from rxcli.ingest import open_source
    from rxcli.receiver.pipeline import receive

    screens = options.screens if options.soft_bits else ()
    return Decoder(options, open_source, receive, tap, after, screens, options.file_memory_mb)


def decode_here(sources: Iterable[Source], decoder: Decoder) -> Iterator[Decoded]:
    """Decode one source after the other in this process."""
    for source in sources:
        yield source, decoder.results(source)


def decode_in_processes(sources: Sequence[Source], decoder: Decoder, workers: int) -> Iterator[Decoded]:
    """Decode sources in worker processes; results as from `decode_here`, in the same order.

    The source that a worker had in hand when it died is decoded again, by another worker while all others rest (what
    ended it may have been the want of memory). A source that ends two workers is unreadable.

    Args:
        sources: what to decode.
        decoder: how; must be picklable.
        workers: number of processes, each of which uses one thread.
    """
    with _Pool(sources, decoder, min(workers, len(sources))) as pool:
        for index, source in enumerate(sources):
            yield source, pool.results(index)


@dataclass(slots=True)
class _Worker:
    process: BaseProcess
    connection: Connection
    #: Index of the source in hand, None while idle.
    index: int | None = None
    #: Results of that source that another worker has given, and are still to come again.
    skip: int = 0
    #: Whether the others rest meanwhile.
    alone: bool = False


class _Finished:
    """Sent by a worker after the last result of a source."""


@dataclass(slots=True)
class _Buffer:
    """Results of one source that have come and were not taken yet."""

    results: deque[FrameResult] = field(default_factory=deque)
    #: Results that have come at all.
    count: int = 0
    complete: bool = False
    #: Workers that died with the source in hand.
    deaths: int = 0


class _Pool:
    def __init__(self, sources: Sequence[Source], decoder: Decoder, n_workers: int) -> None:
        self._sources = sources
        self._decoder = decoder
        self._n_workers = n_workers
        self._workers: list[_Worker] = []
        self._buffers: dict[int, _Buffer] = {}
        self._next = 0
        self._taking = 0
        #: Sources whose worker died.
        self._again: deque[int] = deque()

    def __enter__(self) -> _Pool:
        self._fill()
        return self

    def __exit__(self, *exception: object) -> None:
        for worker in self._workers:
            worker.connection.close()
            worker.process.kill()  # it has nothing of its own, and passes over gentler signals
        for worker in self._workers:
            worker.process.join()

    def results(self, index: int) -> Iterator[FrameResult]:
        self._taking = index
        self._fill()
        buffer = self._buffers.setdefault(index, _Buffer())
        while True:
            while buffer.results:
                yield buffer.results.popleft()
            if buffer.complete:
                del self._buffers[index]
                return
            self._wait()

    def _fill(self) -> None:
        """Give every idle worker a source, and start workers where some are missing."""
        if self._again:
            if all(worker.index is None for worker in self._workers):
                self._assign(self._workers[0] if self._workers else self._started(), self._again.popleft())
            return
        if any(worker.alone for worker in self._workers):
            return
        while len(self._workers) < self._n_workers and self._may_assign():
            self._started()
        for worker in self._workers:
            if worker.index is None and self._may_assign():
                self._assign(worker, self._next)
                self._next += 1

    def _may_assign(self) -> bool:
        return self._next < min(len(self._sources), self._taking + _AHEAD * self._n_workers)

    def _started(self) -> _Worker:
        with environment(ONE_THREAD), _signals_held():
            self._workers.append(_Worker(*start_process(_work, self._decoder, log_level())))
        return self._workers[-1]

    def _assign(self, worker: _Worker, index: int) -> None:
        buffer = self._buffers.setdefault(index, _Buffer())
        worker.index, worker.skip, worker.alone = index, buffer.count, buffer.deaths > 0
        try:
            worker.connection.send(self._sources[index])
        except OSError:
            log.debug("worker %s is gone", worker.process.pid)  # the next wait finds its connection closed

    def _wait(self) -> None:
        """Take what the workers send, waiting for the first of it."""
        from multiprocessing.connection import wait

        busy = {worker.connection: worker for worker in self._workers if worker.index is not None}
        for connection in wait(list(busy)):
            worker = busy[connection]  # type: ignore[index]
            try:
                self._take(worker, worker.connection.recv())
            except (EOFError, ConnectionResetError):
                self._bury(worker)
        self._fill()

    def _take(self, worker: _Worker, message: object) -> None:
        if isinstance(message, Exception):
            raise message
        assert worker.index is not None
        buffer = self._buffers[worker.index]
        if not isinstance(message, FrameResult):
            buffer.complete = True
            worker.index, worker.alone = None, False
        elif worker.skip:
            worker.skip -= 1
        else:
            buffer.results.append(message)
            buffer.count += 1

    def _bury(self, worker: _Worker) -> None:
        """Take a dead worker's source up again, or put it down as unreadable where it is the second to die of it."""
        worker.connection.close()
        worker.process.join()
        self._workers.remove(worker)
        assert worker.index is not None
        source, buffer = self._sources[worker.index], self._buffers[worker.index]
        ending = _ending(worker.process.exitcode)
        buffer.deaths += 1
        if buffer.deaths == 1:
            log.warning("%s: the process that decoded it %s; it is tried again", source.name, ending)
            self._again.append(worker.index)
            return
        message = f"{source.name}: two processes that decoded it died, the last one {ending}; try it by itself"
        buffer.results.append(replace(unreadable(source, buffer.count, message), retry=True))
        buffer.complete = True


def _ending(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        return f"was ended by {signal.Signals(-exitcode).name}"
    return f"ended with code {exitcode}"


def _work(connection: Connection, decoder: Decoder, level: int) -> None:
    """A worker's life: take a source, send its results, until the other end is closed."""
    for number in _FIRST_DECIDES:
        signal.signal(number, signal.SIG_IGN)
    _hold_signals(signal.SIG_UNBLOCK)
    logging.basicConfig(level=level)
    use_one_thread()
    try:
        while True:
            _send_results(connection, decoder, connection.recv())
    except (EOFError, OSError):
        return


def _send_results(connection: Connection, decoder: Decoder, source: Source) -> None:
    try:
        for result in decoder.results(source):
            connection.send(result)
    except ReceiverError as error:
        connection.send(error)
    else:
        connection.send(_Finished())


def log_level() -> int:
    """The level that worker processes log at."""
    return logging.getLogger("rxcli").getEffectiveLevel()


def use_one_thread() -> None:
    """Keep OpenCV to one thread; the other libraries go by the environment that the worker was started with."""
    import cv2

    cv2.setNumThreads(1)


@contextmanager
def _signals_held() -> Iterator[None]:
    """While a worker starts, which inherits this, signals wait."""
    _hold_signals(signal.SIG_BLOCK)
    try:
        yield
    finally:
        _hold_signals(signal.SIG_UNBLOCK)


def _hold_signals(how: int) -> None:
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(how, _FIRST_DECIDES)
