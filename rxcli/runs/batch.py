"""Many sources: collect files, and decode them here or in worker processes.

Results come source by source in the order of the input in either case; `rxcli.runs.journal` keeps them.
"""

from __future__ import annotations

import errno
import logging
import os
import re
import signal
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from importlib import import_module
from itertools import chain, islice
from queue import SimpleQueue
from threading import Lock, Semaphore, Thread, local
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from rxcli import ingest
from rxcli.errors import InputError, OutputError, ProfileError, ReceiverError, UsageError, is_out_of_memory, reason_of
from rxcli.ingest.ahead import in_order
from rxcli.ingest.sniff import is_unnamed_picture
from rxcli.link.collector import Collector
from rxcli.options import ReceiverOptions
from rxcli.outputs import OUTPUT_MARKER
from rxcli.results.dump import plain_name, taps_writer
from rxcli.results.reasons import explained
from rxcli.runs.processes import ONE_THREAD, environment, start_process
from rxcli.types import Frame, FrameResult

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess


log = logging.getLogger(__name__)

#: One source with its results, which are to be taken before the next source is asked for.
Decoded = tuple["Source", Iterator[FrameResult]]

#: Results of one source as they come, an error that ends them, and None behind the last.
_Results = SimpleQueue[FrameResult | Exception | None]

#: Errors that end the run, whatever the source.
_ENDS_RUN = (UsageError, ProfileError, OutputError)
#: Errors of rights, disks, networks and memory, which pass.
_OF_THE_MACHINE = (
    *(errno.EACCES, errno.EPERM, errno.EIO, errno.ENOMEM, errno.ENOSPC, errno.EMFILE, errno.ENFILE, errno.EBUSY),
    *(errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN, errno.ENODEV, errno.ENXIO, errno.EHOSTDOWN, errno.EAGAIN),
)
#: Folders that storage, cameras and programs keep beside photos: `@eaDir`, `#recycle`, `$RECYCLE.BIN`, thumbnails.
_ASIDE = re.compile(r"[@#$]|__MACOSX$|lost\+found$|thumb(nail)?s?$", re.IGNORECASE)
#: What these signals mean is decided by the first process; they often come to all at once.
_FIRST_DECIDES = (signal.SIGINT, signal.SIGTERM)
#: Sources per worker that may be decoded ahead of the one whose results are being taken.
_AHEAD = 32
#: What receiving a photo loads.
_LOADED = ("rxcli.receiver.receive", "cv2", "numpy.ma")


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

    Each file is taken once. In folders, hidden files and those of other suffixes are passed over; without a suffix
    the content decides. "-" is stdin.

    Args:
        paths: files and folders.
        suffixes: lower-case suffixes, with the dot, of files to take from folders.
    """
    found = [source for path in paths for source in _sources_of(path, suffixes)]
    return list(_with_subfolders({os.path.normpath(source.name): source for source in found}.values()))


def _with_subfolders(sources: Iterable[Source]) -> Iterator[Source]:
    """The sources with a place of its own for the taps of each, whatever others are called."""
    folders = [os.path.dirname(os.path.abspath(source.name)) for source in sources]
    try:
        common = os.path.commonpath(folders)
    except ValueError:  # none, or several drives
        common = os.sep
    count: Counter[tuple[str, str]] = Counter()
    for source, folder in zip(sources, folders, strict=True):
        below = os.path.relpath(folder, common)
        place = (below, plain_name(source.name).casefold())
        count[place] += 1
        own = below if count[place] == 1 else os.path.join(below, f"{count[place]}")
        yield replace(source, subfolder=own)


def _sources_of(path: str, suffixes: frozenset[str]) -> Iterator[Source]:
    if path == "-" or not os.path.isdir(path):
        yield Source(path, path)
        return
    refused: list[OSError] = []
    files = [
        name
        for name in _walk(path, refused.append)
        if os.path.splitext(name)[1].casefold() in suffixes or is_unnamed_picture(name)
    ]
    if not files and not refused:
        listed = ", ".join(sorted(suffix.lstrip(".") for suffix in suffixes))
        problem = f"{path}: the folder holds no picture or clip; name files, or a folder with {listed}"
        yield Source(path, path, problem)
    yield from (Source(name, name) for name in files)
    for error in refused:
        name = error.filename
        problem = f"{name}: the folder may not be read ({error.strerror}); ask for permission, or leave it out"
        yield Source(name, name, problem)


def _walk(folder: str, refused: Callable[[OSError], None]) -> Iterator[str]:
    for parent, folders, files in os.walk(folder, onerror=refused):
        shown = sorted(name for name in folders if not name.startswith("."))
        folders[:] = [name for name in shown if not (_ASIDE.match(name) or os.path.islink(os.path.join(parent, name)))]
        for name in sorted({*shown} - {*folders}):
            what = "thumbnails or deleted files" if _ASIDE.match(name) else "it is a link"
            log.warning("%s: passed over (%s); name the folder itself to decode it", os.path.join(parent, name), what)
        if OUTPUT_MARKER in files:  # what `inspect` has written
            folders.clear()
            continue
        yield from (os.path.join(parent, name) for name in sorted(files) if not name.startswith("."))


def _receive(frames: Iterable[Frame], options: ReceiverOptions) -> Iterator[FrameResult]:
    """Receive frames; the receiver is imported while the first frame is read."""

    def load() -> None:
        with suppress(Exception):  # which is raised again below
            for name in _LOADED:
                import_module(name)

    loading = Thread(target=load, daemon=True)
    loading.start()
    frames = iter(frames)
    try:
        head = list(islice(frames, 1))
    finally:
        loading.join()
    from rxcli.receiver.receive import receive

    yield from receive(chain(head, frames), options, taps_writer(options.dump_dir))


@dataclass(frozen=True, slots=True)
class Decoder:
    """How one source is decoded: by default, files are read and received. Picklable where its functions are."""

    options: ReceiverOptions
    #: Sees every frame before it is received, and the subfolder of its source.
    tap: Callable[[Frame, str], None] | None = None
    #: Sees every result, and the subfolder of its source.
    after: Callable[[FrameResult, str], None] | None = None
    open_source: Callable[[str], Iterable[Frame]] = ingest.open_source
    receive: Callable[[Iterable[Frame], ReceiverOptions], Iterator[FrameResult]] = _receive

    def results(self, source: Source) -> Iterator[FrameResult]:
        """The results of all frames of `source`, at least one; an input that fails ends in an `unreadable` one.

        Raises:
            UsageError: the options make no sense, whatever the source.
            ProfileError: likewise.
            OutputError: taps cannot be written.
        """
        problems: list[tuple[str, bool]] = []
        options, count = self.options, 0
        if options.dump_dir is not None:  # each source has a place of its own for its taps
            options = replace(options, dump_dir=options.dump_dir / source.subfolder)
        with _gathering(problems, source):
            for result in self.linked(self.receive(self._frames(source, problems), options)):
                result = replace(result, source=source.name)
                if self.after is not None:
                    self.after(result, source.subfolder)
                yield result
                count += 1
        if not (problems or count):
            problems.append((f"{source.name}: holds no picture; name another file", False))
        if problems:
            yield unreadable(source, count, *problems[-1])

    def linked(self, results: Iterator[FrameResult]) -> Iterator[FrameResult]:
        """Results with the messages and files that are complete with them.

        A photograph without any keeps its soft bits, and a clip its incomplete files, for others may show the same.
        """
        if not self.options.soft_bits:
            yield from map(explained, results)
            return
        collector = Collector(self.options.screens, self.options.file_memory_mb)
        for number, (result, last) in enumerate(with_last(results)):
            taken = collector.add(result)
            if last:
                taken = collector.finish(taken)
                if number == 0 and not (taken.messages or taken.objects):
                    taken = replace(taken, soft_bits=result.soft_bits, files=())
            yield explained(taken)

    def _frames(self, source: Source, problems: list[tuple[str, bool]]) -> Iterator[Frame]:
        """The frames of a source up to a failure, which joins `problems`: the receiver still gives what it holds."""
        warned = False
        with _gathering(problems, source):
            if source.problem:
                raise InputError(source.problem)
            for frame in self.open_source(source.path):
                frame = replace(frame, source=source.name)  # as the user named it, wherever it is opened
                if frame.metadata.not_believed and not warned:
                    claims, warned = ", ".join(frame.metadata.not_believed), True
                    log.warning("%s: not believed, and taken as unknown: %s", source.name, claims)
                if self.tap is not None:
                    self.tap(frame, source.subfolder)
                yield frame


@contextmanager
def _gathering(problems: list[tuple[str, bool]], source: Source) -> Iterator[None]:
    """Let an error in a source, which ends no run, join its `problems`: message, and whether a later run may do."""
    try:
        yield
    except _ENDS_RUN:
        raise
    except Exception as error:
        problems.append((_problem(error, source), bool(source.problem) or _may_pass(error)))


def _problem(error: Exception, source: Source) -> str:
    """Message of an error in a source; one that is no `ReceiverError` is a bug, whose traceback goes to the log."""
    if isinstance(error, ReceiverError):
        return str(error).replace(source.path, source.name)
    if isinstance(error, OSError) or is_out_of_memory(error):
        reason = "more memory is needed than there is" if is_out_of_memory(error) else reason_of(error)
        return f"{source.name}: cannot be decoded ({reason}); try it by itself"
    log.debug("unexpected error", exc_info=error)
    return f"internal error ({type(error).__name__}: {error}); run again with --verbose and report it"


def _may_pass(error: BaseException | None) -> bool:
    """Whether an error, or one that led to it, is the machine's and not the file's."""
    while error is not None:
        if is_out_of_memory(error) or (isinstance(error, OSError) and error.errno in _OF_THE_MACHINE):
            return True
        error = error.__context__
    return False


def unreadable(source: Source, frame: int, message: str, retry: bool = True) -> FrameResult:
    """The result of a frame that could not be had; `retry`: a later run may have it."""
    return FrameResult(source=source.name, frame=frame, time_s=0.0, status="unreadable", message=message, retry=retry)


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


def decode_here(sources: Iterable[Source], decoder: Decoder) -> Iterator[Decoded]:
    """Decode one source after the other in this process."""
    for source in sources:
        yield source, decoder.results(source)


def decode_in_processes(sources: Sequence[Source], decoder: Decoder, workers: int) -> Iterator[Decoded]:
    """Decode sources in worker processes; results as from `decode_here`, in the same order.

    If a worker dies, another one decodes its source again while all others rest (the first may have died for want of
    memory). A source that ends two workers is unreadable.

    Args:
        sources: what to decode.
        decoder: how; must be picklable.
        workers: number of processes with one thread each.
    """
    with environment(ONE_THREAD), closing(_Pool(decoder, min(workers, len(sources)))) as pool:
        for source, results in in_order(sources, pool.submit, _AHEAD * workers):
            yield source, _until_end(results)


def _until_end(results: _Results) -> Iterator[FrameResult]:
    """Results that arrive in a queue, up to a None; an error is raised."""
    while (result := results.get()) is not None:
        if isinstance(result, Exception):
            raise result
        yield result


class _WorkerDiedError(Exception):
    """A worker process ended with a source in hand; the argument describes how."""


class _Pool:
    """Threads that each have a worker process, give it one source after the other, and queue its results."""

    def __init__(self, decoder: Decoder, n_workers: int) -> None:
        from concurrent.futures import ThreadPoolExecutor

        self._decoder, self._n_workers = decoder, n_workers
        self._threads = ThreadPoolExecutor(n_workers)
        #: One for each worker; a thread that takes them all decodes alone.
        self._permits, self._taking_all = Semaphore(n_workers), Lock()
        self._starting, self._closed = Lock(), False
        self._processes: list[BaseProcess] = []
        #: Process and connection of each thread.
        self._own = local()

    def submit(self, source: Source) -> _Results:
        """Have a source decoded; returns the queue of its results, with a None behind the last."""
        results: _Results = SimpleQueue()
        self._threads.submit(self._serve, source, results)
        return results

    def close(self) -> None:
        """Kill the workers, which hold nothing that could be lost and ignore gentler signals; start no more."""
        with self._starting:
            self._closed = True
        for process in self._processes:
            process.kill()
            process.join()
        self._threads.shutdown(wait=False, cancel_futures=True)

    def _serve(self, source: Source, results: _Results) -> None:
        try:
            for result in self._decode(source):
                results.put(result)
        except Exception as error:
            results.put(error)
        results.put(None)

    def _decode(self, source: Source) -> Iterator[FrameResult]:
        """Results of a source, if need be in a second attempt, which repeats none of the first."""
        count = 0
        for attempt in (self._permits, self._alone()):
            try:
                with attempt:
                    for result in islice(self._results(source), count, None):
                        yield result
                        count += 1
                return
            except _WorkerDiedError as death:
                ending = death.args[0]
            if self._closed:
                return
            if attempt is self._permits:
                log.warning("%s: the process that decoded it %s; it is tried again", source.name, ending)
        message = f"{source.name}: two processes that decoded it died, the last one {ending}; try it by itself"
        yield unreadable(source, count, message)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """While no other worker decodes."""
        with self._taking_all:
            for _ in range(self._n_workers):
                self._permits.acquire()
        try:
            yield
        finally:
            self._permits.release(self._n_workers)

    def _results(self, source: Source) -> Iterator[FrameResult]:
        """The results of a source from this thread's worker, as they come.

        Raises:
            _WorkerDiedError: the process died first.
            ReceiverError: of the worker.
        """
        process, connection = self._worker()
        try:
            connection.send(source)
            while (message := connection.recv()) is not None:
                if isinstance(message, Exception):
                    raise message
                if isinstance(message, logging.LogRecord):
                    logging.getLogger(message.name).handle(message)
                else:
                    yield message
        except (EOFError, OSError):
            process.join()
            connection.close()
            del self._own.worker
            raise _WorkerDiedError(_ending(process.exitcode)) from None

    def _worker(self) -> tuple[BaseProcess, Connection]:
        """This thread's process, started where there is none, and the connection to it."""
        with self._starting:
            if self._closed:
                raise _WorkerDiedError("was ended")
            if not hasattr(self._own, "worker"):
                _hold_signals(signal.SIG_BLOCK)  # in this thread, and in the process until it ignores them
                self._own.worker = start_process(_work, self._decoder, logging.getLogger("rxcli").getEffectiveLevel())
                self._processes.append(self._own.worker[0])
        worker: tuple[BaseProcess, Connection] = self._own.worker
        return worker


def _ending(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        return f"was ended by {signal.Signals(-exitcode).name}"
    return f"ended with code {exitcode}"


def _work(connection: Connection, decoder: Decoder, level: int) -> None:
    """Worker loop: receive a source, send its results and a None, until the connection closes."""
    import logging.handlers

    for number in _FIRST_DECIDES:
        signal.signal(number, signal.SIG_IGN)
    _hold_signals(signal.SIG_UNBLOCK)
    to_first: Any = SimpleNamespace(put_nowait=connection.send)  # which writes the records in its own form
    logging.basicConfig(level=level, handlers=[logging.handlers.QueueHandler(to_first)])
    use_one_thread()
    try:
        while True:
            source = connection.recv()
            try:
                for result in decoder.results(source):
                    connection.send(result)
            except ReceiverError as error:
                connection.send(error)
            connection.send(None)
    except (EOFError, OSError):
        return


def use_one_thread() -> None:
    """Keep OpenCV to one thread; the other libraries go by the environment that the worker was started with."""
    import cv2

    cv2.setNumThreads(1)


def _hold_signals(how: int) -> None:
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(how, _FIRST_DECIDES)
