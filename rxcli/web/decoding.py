"""Pictures are decoded in a process of its own, with limits: it may die, hang or swell, and another takes its place."""

from __future__ import annotations

import logging
import os
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rxcli.errors import InputError, capitalised, sentence, without_commands
from rxcli.runs.processes import resident_bytes, start_process

if TYPE_CHECKING:
    from collections.abc import Callable
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess

    from rxcli.options import ReceiverOptions
    from rxcli.results.overlay import Preview
    from rxcli.types import Frame, FrameResult

log = logging.getLogger(__name__)

#: Larger pictures are refused before they are decoded: no phone makes them, and they cost memory.
MAX_PIXELS = 64_000_000
#: Clips are read until they have cost so much time of the processor; then what was received till then is shown.
_CLIP_S = 12.0
_MAX_PACKETS = 2000
#: What was received of a clip so far is told after so many seconds at the earliest.
_PARTIAL_S = 0.4
_POLL_S = 0.05
#: Address space of the process: far more than it uses, far less than would hurt the machine.
_ADDRESS_SPACE = 6 << 30


@dataclass(frozen=True, slots=True)
class Limits:
    """What one picture may cost."""

    time_s: float = 45.0
    #: Resident memory of the process, bytes.
    memory: int = 1 << 30


class DecodingProcess:
    """A process that decodes one file after the other; not for several threads at once.

    Args:
        options: of the receiver.
        limits: when it is ended and replaced.
        folder: of uploads, which it removes where the server was killed; None: there is none.
    """

    def __init__(self, options: ReceiverOptions, limits: Limits | None = None, folder: Path | None = None) -> None:
        self._options = options
        self._folder = folder
        self._limits = limits or Limits()
        self._process: BaseProcess | None = None
        self._connection: Connection | None = None

    def start(self) -> None:
        """Start the process before it is needed, so that the first picture need not wait for it."""
        self._process, self._connection = start_process(_work, self._options, self._folder)

    def close(self) -> None:
        """End the process; may be called again."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
        if self._connection is not None:
            self._connection.close()
        self._process = self._connection = None

    @property
    def pid(self) -> int | None:
        """Number of the process, None where there is none."""
        return self._process.pid if self._process is not None else None

    def decode(self, path: Path, name: str, tell: Callable[[dict[str, Any]], None] | None = None) -> dict[str, Any]:
        """What became of the file at `path`, as plain data for the page; a failure is an answer like any other.

        Args:
            path: the file.
            name: what messages call it.
            tell: given, from time to time, the answer so far of a clip that is still being read.
        """
        if self._process is None or not self._process.is_alive():
            self.close()
            self.start()
        assert self._connection is not None
        try:
            self._connection.send((str(path), name))
            return self._answer(tell)
        except _EndedError as ended:
            reason, step = ended.args
        except (EOFError, OSError):
            reason, step = "reading it ended the program that reads pictures", "try another picture"
        log.warning("%s: %s", name, reason)
        self.close()
        return refusal(reason, step)

    def _answer(self, tell: Callable[[dict[str, Any]], None] | None) -> dict[str, Any]:
        assert self._connection is not None
        end_s = time.monotonic() + self._limits.time_s
        while True:
            while not self._connection.poll(_POLL_S):
                if time.monotonic() > end_s:
                    raise _EndedError(f"it took more than {self._limits.time_s:.0f} s", "try a smaller picture")
                if resident_bytes(self.pid) > self._limits.memory:
                    raise _EndedError("it takes too much memory", "try a smaller picture")
            answer: dict[str, Any] = self._connection.recv()
            if not answer.get("partial"):
                return answer
            if tell is not None:
                tell(answer)


class _EndedError(Exception):
    """A limit was passed: reason and next step."""


def refusal(reason: str, step: str) -> dict[str, Any]:
    """The answer for a file that is not received."""
    return {
        "status": "unreadable",
        "headline": "The file could not be read",
        "reason": sentence(without_commands(reason)),
        "advice": sentence(without_commands(step)),
    }


def _work(connection: Connection, options: ReceiverOptions, folder: Path | None) -> None:
    """The process's life: take a file, send the answer, until the other end is closed."""
    import shutil
    import signal

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # the server decides what they mean
        signal.signal(number, signal.SIG_IGN)
    _confine()
    _warm_up(options)
    try:
        while True:
            path, name = connection.recv()
            connection.send(answer_for(Path(path), name, options, connection.send))
    except (EOFError, OSError):
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)


def _confine() -> None:
    """No file is written, no core dumped; libraries' own messages about broken pictures go nowhere."""
    import resource

    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)


def _warm_up(options: ReceiverOptions) -> None:
    """Import and load what the first picture would otherwise wait for, by decoding a sample."""
    from rxcli.ingest import video  # noqa: F401
    from rxcli.receiver import clip  # noqa: F401
    from rxcli.resources import data_dir
    from rxcli.runs.batch import use_one_thread

    use_one_thread()
    sample = data_dir("sample_frames") / "phone_chelsea_17k3.jpg"
    if sample.is_file():
        try:
            answer_for(sample, "sample", options)
        except Exception as error:  # whatever it is, pictures that come will tell
            log.debug("the sample was not decoded: %s", error)


def answer_for(
    path: Path, name: str, options: ReceiverOptions, tell: Callable[[dict[str, Any]], None] | None = None
) -> dict[str, Any]:
    """The answer for one file; see `DecodingProcess.decode`."""
    from rxcli.runs.batch import Source, standard_decoder

    started_s = time.monotonic()
    frames = _Frames(time.process_time() + _CLIP_S)
    try:
        _check_pixels(path)
    except InputError as error:
        return refusal(error.message, error.hint)
    decoder = standard_decoder(options, frames.tap)
    gathered, told_s = _Gathered(frames, options), started_s
    try:
        for result in decoder.results(Source(name, str(path))):
            gathered.add(_without(result, path))
            if tell is not None and gathered.has_news and time.monotonic() - told_s > _PARTIAL_S:
                tell(gathered.answer() | {"name": name, "partial": True})
                told_s = time.monotonic()
        answer = gathered.answer()
    except MemoryError:
        return refusal("it takes too much memory", "try a smaller picture")
    return answer | {"name": name, "seconds": round(time.monotonic() - started_s, 2)}


def _without(result: FrameResult, path: Path) -> FrameResult:
    """The result, with a message that fits the page, and does not tell where the upload lies."""
    return (
        replace(result, message=without_commands(result.message.replace(f"{path}: ", ""))) if result.message else result
    )


def _check_pixels(path: Path) -> None:
    """Refuse a picture by the size that its header claims, before memory is taken for it."""
    import warnings

    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as picture:
                width, height = picture.size
    except Exception:  # no picture that Pillow knows: the readers say what is wrong with it
        return
    if width * height > MAX_PIXELS:
        raise InputError(
            f"the picture claims {width} x {height} pixels, more than {MAX_PIXELS // 1_000_000} million",
            "send a photo as the camera makes it",
        )


class _Frames:
    """Sees every frame before it is received: keeps those that may be shown, and ends a clip in good time."""

    def __init__(self, end_s: float) -> None:
        self._end_s = end_s
        self._kept: dict[int, Frame] = {}
        self.cut_short = False

    def tap(self, frame: Frame, _name: str) -> None:
        if time.process_time() > self._end_s and frame.index:
            self.cut_short = True
            raise InputError("only the beginning of the clip was read", "send a shorter one for the rest")
        self._kept[frame.index] = frame
        while len(self._kept) > 40:  # results come some frames later than frames
            del self._kept[min(self._kept)]

    def take(self, index: int) -> Frame | None:
        """The frame of a result, if it is still there."""
        return self._kept.get(index)


class _Gathered:
    """All results of a source as one answer, shown with the frame that gave most."""

    def __init__(self, frames: _Frames, options: ReceiverOptions) -> None:
        self._frames, self._options = frames, options
        self._best: tuple[int, FrameResult, dict[str, Any]] | None = None
        self._packets: list[dict[str, Any]] = []
        self._texts: list[dict[str, Any]] = []
        self._n_frames = self._n_received = self._n_unsure = 0
        #: Whether packets or texts came in a frame that is not the first since the last answer.
        self.has_news = False

    def add(self, result: FrameResult) -> None:
        """Take the next result."""
        if self._frames.cut_short and result.status == "unreadable":
            return
        self._n_frames += 1
        from rxcli.results.columns import packet_rows, text_rows

        texts, found = text_rows(result), packet_rows(result)
        self._texts += texts
        received = sum(packet.is_believable for packet in result.packets)
        self._n_received += received
        self._n_unsure += len(result.packets) - received
        self._packets += found[: _MAX_PACKETS - len(self._packets)]
        self.has_news = result.frame > 0 and (self.has_news or bool(texts or found))
        if self._best is None or len(found) > self._best[0]:
            self._best = len(found), result, self._picture(result)

    def _picture(self, result: FrameResult) -> dict[str, Any]:
        from rxcli.results.overlay import preview

        frame = self._frames.take(result.frame)
        return {} if frame is None else {"picture": picture_of(result, frame, preview(frame), self._options)}

    def answer(self) -> dict[str, Any]:
        """What is known so far."""
        self.has_news = False
        if self._best is None:
            return refusal("it holds no picture", "send another file")
        from rxcli.results.aim import split_message
        from rxcli.results.columns import column_rows
        from rxcli.results.record import to_record
        from rxcli.results.report import count_packets, headline, mirror_note

        _, result, picture = self._best
        packets = self._packets
        reason, advice = ("", "") if packets else split_message(result)
        columns = [
            row | {"message": row["message"] and without_commands(row["message"])} for row in column_rows(result)
        ]
        return {
            "status": result.status if not packets or result.status != "unreadable" else "partial",
            "headline": capitalised(count_packets(self._n_received, self._n_unsure)) if packets else headline(result),
            "reason": reason,
            "advice": advice,
            "mirrored": mirror_note(result),
            "texts": list(self._texts),
            "packets": list(packets),
            "n_frames": self._n_frames,
            "cut_short": self._frames.cut_short,
            "screen": result.screen_profile,
            "camera": result.camera_profile,
            "columns": columns,
            "record": to_record(result),
            **picture,
        }


def picture_of(
    result: FrameResult, frame: Frame, small: Preview, options: ReceiverOptions, quality: int = 80
) -> dict[str, Any]:
    """The small copy of a frame as JPEG, and outlines in its pixels."""
    from rxcli.results import overlay
    from rxcli.results.cameras import camera_of, screen_of

    screen, camera = screen_of(result, options.screens), camera_of(frame, result, options.cameras)
    return overlay.picture_of(result, frame, small, screen, camera, quality)
