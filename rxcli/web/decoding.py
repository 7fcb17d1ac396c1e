"""Decode pictures in a separate process with limits: it may die, hang or run out of memory, and is then replaced."""

import json
import logging
import os
import resource
import signal
import time
import warnings
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache, partial
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from PIL import Image

from rxcli.errors import InputError, capitalised, sentence, without_commands
from rxcli.link.collector import PhotoCollector
from rxcli.options import ReceiverOptions
from rxcli.profiles import CameraProfile
from rxcli.resources import data_dir
from rxcli.results import report
from rxcli.results.aim import split_message
from rxcli.results.cameras import Reception, estimated_camera
from rxcli.results.columns import column_rows, packet_rows, text_rows
from rxcli.results.overlay import Preview, picture_of, preview
from rxcli.results.record import to_record
from rxcli.results.summary import SourceSummary
from rxcli.runs.batch import Decoder, Source, use_one_thread
from rxcli.runs.processes import resident_bytes, start_process
from rxcli.types import Frame, FrameResult, ObjectProgress

log = logging.getLogger(__name__)

#: Larger pictures are refused before they are decoded: no phone takes them, and they cost memory.
MAX_PIXELS = 64_000_000
#: Maximum processor time of a clip; then the results so far are shown.
_CLIP_S = 12.0
_MAX_PACKETS = 2000
#: Time to the first partial result of a clip; each further one takes twice as long, for each repeats the one before.
_PARTIAL_S = 0.4
#: Maximum length of an answer, and of all partial ones of a clip together.
_MAX_ANSWER_BYTES = 8 << 20
_POLL_S = 0.05
#: Number of latest pages whose photos are combined, and the memory for incomplete files of each.
_SESSIONS, _SESSION_MB = 8, 32
#: Width of the picture on the page, and number of small copies of frames stored for results that arrive frames later.
_WIDTH_PX, _MAX_PREVIEWS = 1000, 40
#: Address space of the process: far more than it uses, far less than would harm the machine.
_ADDRESS_SPACE = 6 << 30


class DecodingProcess:
    """A process that decodes one file after the other; not for several threads at once.

    Args:
        options: of the receiver.
        max_s: for one picture, beyond which it is ended and replaced.
        max_bytes: likewise, its resident memory.
    """

    def __init__(self, options: ReceiverOptions, max_s: float = 45.0, max_bytes: int = 1 << 30) -> None:
        self._options, self._max_s, self._max_bytes = options, max_s, max_bytes
        self._process: BaseProcess | None = None
        self._connection: Connection | None = None

    def start(self) -> None:
        """Start the process before it is needed, so that the first picture need not wait for it."""
        self._process, self._connection = start_process(_work, self._options)

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
        """Process id, or None if no process runs."""
        return self._process.pid if self._process is not None else None

    def decode(
        self, path: Path, name: str, publish: Callable[[dict[str, Any]], None] | None = None, session: str = ""
    ) -> dict[str, Any]:
        """Decode the file at `path` to plain data for the page; a failure is an answer like any other.

        Args:
            path: the file.
            name: of the file in messages.
            publish: called from time to time with the answer so far of a clip that is still being read.
            session: photos of one session are combined; empty: not combined.
        """
        if self._process is None or not self._process.is_alive():
            self.close()
            self.start()
        assert self._connection is not None
        try:
            self._connection.send((str(path), name, session))
            return self._answer(publish)
        except InputError as ended:
            reason, step = ended.message, ended.hint
        except (EOFError, OSError, ValueError):
            reason, step = "reading it ended the program that reads pictures", "try another picture"
        log.warning("%s: %s", name, reason)
        self.close()
        return refusal(reason, step)

    def _answer(self, publish: Callable[[dict[str, Any]], None] | None) -> dict[str, Any]:
        assert self._connection is not None
        end_s, n_partial_bytes = time.monotonic() + self._max_s, 0
        while True:
            while not self._connection.poll(_POLL_S):
                if time.monotonic() > end_s:
                    reason = f"nothing was found in {self._max_s:.0f} s, after which the page gives up"
                    raise InputError(reason, "photograph the screen from nearer, or decode the file by `vlc-rx`")
                if resident_bytes(self.pid) > self._max_bytes:
                    raise InputError("it takes too much memory", "try a smaller picture")
            answer, n_bytes = receive(self._connection)
            if not answer.get("partial"):
                return answer
            n_partial_bytes += n_bytes
            if publish is not None and n_partial_bytes <= _MAX_ANSWER_BYTES:
                publish(answer)


def send(connection: Connection, answer: dict[str, Any]) -> None:
    """Send an answer as JSON: pickles of a process that a hostile picture has taken over could run programs."""
    connection.send_bytes(json.dumps(answer).encode())


def receive(connection: Connection) -> tuple[dict[str, Any], int]:
    """The next answer and its length in bytes.

    Raises:
        EOFError, OSError: the other end is closed, or the answer is too long.
        ValueError: it is no answer.
    """
    data = connection.recv_bytes(_MAX_ANSWER_BYTES)
    answer = json.loads(data)
    if not isinstance(answer, dict):
        raise ValueError("no answer")
    return answer, len(data)


def refusal(reason: str, step: str) -> dict[str, Any]:
    """The answer for a file that cannot be received."""
    return {
        "status": "unreadable",
        "headline": "The file could not be read",
        "reason": sentence(without_commands(reason)),
        "advice": sentence(without_commands(step)),
    }


def _work(connection: Connection, options: ReceiverOptions) -> None:
    """Main loop of the process: receive a file, send its answer, until the other end is closed."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # the server decides what they mean
        signal.signal(number, signal.SIG_IGN)
    _confine()
    _warm_up(options)
    photos_of = _by_session(options)
    with suppress(EOFError, OSError):
        while True:
            path, name, session = connection.recv()
            photos = photos_of(session) if session else None
            send(connection, answer_for(Path(path), name, options, partial(send, connection), photos))


def _by_session(options: ReceiverOptions) -> Callable[[str], PhotoCollector]:
    """Gives the combined photos of a session so far; sessions whose last photo is the oldest are forgotten."""
    memory_mb = min(options.file_memory_mb, _SESSION_MB)
    return lru_cache(_SESSIONS)(lambda _session: PhotoCollector(options.screens, memory_mb))


def _confine() -> None:
    """Forbid files and core dumps, limit the address space, and discard libraries' messages about broken pictures."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)


def _warm_up(options: ReceiverOptions) -> None:
    """Decode a sample, so that the first picture does not wait for imports and models."""
    from rxcli.ingest import video  # noqa: F401
    from rxcli.receiver import clip  # noqa: F401

    use_one_thread()
    sample = data_dir("sample_frames") / "phone_chelsea_17k3.jpg"
    if sample.is_file():
        try:
            answer_for(sample, "sample", options)
        except Exception as error:  # whatever it is, the first picture reports it
            log.debug("the sample was not decoded: %s", error)


def answer_for(
    path: Path,
    name: str,
    options: ReceiverOptions,
    publish: Callable[[dict[str, Any]], None] | None = None,
    photos: PhotoCollector | None = None,
) -> dict[str, Any]:
    """The answer for one file; see `DecodingProcess.decode`. A photo is added to `photos`."""
    started_s = time.monotonic()
    gathered, wait_s, published_s = _Gathered(options, time.process_time() + _CLIP_S), _PARTIAL_S, started_s
    if photos and photos.camera:  # the photos of one visitor are by one camera
        options = replace(options, cameras=(photos.camera, *options.cameras))
    decoder = Decoder(options, gathered.tap)
    try:
        _check_pixels(path)
        for result in decoder.results(Source(name, str(path))):
            gathered.add(_without(photos.add(result) if photos else result, path))
            if photos and gathered.frame is not None and result.frame == 0:
                photos.camera = photos.camera or _estimated_camera(result, gathered.frame)
            if publish is not None and gathered.has_news and time.monotonic() - published_s > wait_s:
                publish(gathered.answer() | {"name": name, "partial": True})
                wait_s, published_s = 2 * wait_s, time.monotonic()
        answer = gathered.answer()
    except InputError as error:
        return refusal(error.message, error.hint)
    except MemoryError:
        return refusal("it takes too much memory", "try a smaller picture")
    together = _files(photos.progress) if photos else None
    return answer | {"name": name, "seconds": round(time.monotonic() - started_s, 2), "together": together}


def _estimated_camera(result: FrameResult, frame: Frame) -> CameraProfile | None:
    """The camera as estimated from a photo that names its model and was not turned, None otherwise."""
    is_known = frame.metadata.model and result.gives_camera and not result.quarter_turns
    return estimated_camera(frame, result, "visitor") if is_known else None


def _files(progress: Iterable[ObjectProgress]) -> list[dict[str, Any]]:
    """Incomplete files, of a clip or of combined photos."""
    return [{"share": file.share, "bytes": file.container_bytes} for file in progress]


def _without(result: FrameResult, path: Path) -> FrameResult:
    """Adapt the message of a result to the page, without the path of the upload."""
    message = result.message and without_commands(result.message.replace(f"{path}: ", ""))
    return replace(result, message=message)


def _check_pixels(path: Path) -> None:
    """Refuse a picture by the size in its header, before memory is allocated for it."""
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as picture:
            width, height = picture.size
    except Exception:  # no picture that Pillow knows: the readers report what is wrong with it
        return
    if width * height > MAX_PIXELS:
        raise InputError(
            f"the picture claims {width} x {height} pixels, more than {MAX_PIXELS // 1_000_000} million",
            "send a photo as the camera makes it",
        )


class Previews:
    """Small copies of the last frames, taken before the frames are received.

    Args:
        width_px: approximate maximum width of a copy.
        quality: of its JPEG.
    """

    def __init__(self, width_px: int, quality: int = 80) -> None:
        self._width_px, self._quality = width_px, quality
        self._previews: dict[int, Preview] = {}
        #: The newest frame.
        self.frame: Frame | None = None

    def tap(self, frame: Frame, _name: str) -> None:
        """Store a copy of the next frame."""
        self.frame = frame
        self._previews[frame.index] = preview(frame, self._width_px)
        while len(self._previews) > _MAX_PREVIEWS:
            del self._previews[min(self._previews)]

    def picture(self, result: FrameResult, options: ReceiverOptions) -> dict[str, Any] | None:
        """Picture of a result as JPEG with outlines in its pixels, or None if its frame is no longer stored."""
        small = self._previews.get(result.frame)
        if small is None or self.frame is None:
            return None
        return picture_of(Reception.of(self.frame, result, options), small, self._quality)


class _Gathered(Previews):
    """All results of a source as one answer, with the picture of the best frame; stops a clip that takes too long."""

    def __init__(self, options: ReceiverOptions, end_s: float) -> None:
        super().__init__(_WIDTH_PX)
        self._options, self._end_s = options, end_s
        self._best: tuple[int, FrameResult, dict[str, Any] | None] | None = None
        self._packets: list[dict[str, Any]] = []
        self._texts: list[dict[str, Any]] = []
        self._files: list[dict[str, Any]] = []
        self._summary, self._cut_short = SourceSummary(""), False
        #: Whether packets or texts were received since the last answer, other than in the first frame.
        self.has_news = False

    def tap(self, frame: Frame, name: str) -> None:
        """Store a copy of the next frame, or stop a clip that has taken too long."""
        if time.process_time() > self._end_s and frame.index:
            self._cut_short = True
            raise InputError("only the beginning of the clip was read", "send a shorter one for the rest")
        super().tap(frame, name)

    def add(self, result: FrameResult) -> None:
        """Add the next result."""
        if self._cut_short and result.status == "unreadable":
            return
        self._summary.add(result)
        texts, found = text_rows(result), packet_rows(result)
        self._texts += texts
        self._files = _files(result.progress)
        self._packets += found[: _MAX_PACKETS - len(self._packets)]
        self.has_news = result.frame > 0 and (self.has_news or bool(texts or found))
        if self._best is None or len(found) > self._best[0]:
            self._best = len(found), result, self.picture(result, self._options)

    def answer(self) -> dict[str, Any]:
        """The answer so far."""
        self.has_news = False
        if self._best is None:
            return refusal("it holds no picture", "send another file")
        _, result, picture = self._best
        packets, n = self._packets, self._summary.n
        counted = report.count_packets(n["received"], n["unsure"])
        is_received = bool(packets or self._texts)
        reason, advice = ("", "") if is_received else split_message(result)
        columns = [
            row | {"message": row["message"] and without_commands(row["message"])} for row in column_rows(result)
        ]
        return {
            "status": result.status if not is_received or result.status != "unreadable" else "partial",
            "headline": capitalised(counted) if packets else "Received" if self._texts else report.headline(result),
            "reason": reason,
            "advice": advice,
            "mirrored": report.mirror_note(result),
            "texts": list(self._texts),
            "files": list(self._files),
            "packets": list(packets),
            "n_frames": n["frames"],
            "cut_short": self._cut_short,
            "screen": result.screen_profile,
            "camera": result.camera_profile,
            "columns": columns,
            "record": to_record(result),
            "picture": picture,
        }
