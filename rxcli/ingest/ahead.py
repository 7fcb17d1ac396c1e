"""Frames read ahead in a thread of their own, so that the decoder need not wait for whoever receives them."""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Generator
from contextlib import closing, suppress
from threading import Condition, Thread, get_native_id

from rxcli.types import Frame

#: What may wait: pixels of so many bytes, and so many frames at least and at most.
_MAX_BYTES, _MIN_FRAMES, _MAX_FRAMES = 60_000_000, 2, 16
#: How much nicer to others the thread is than the process.
_NICER = 5


def read_ahead(frames: Generator[Frame, None, None]) -> Generator[Frame, None, None]:
    """The same frames, and then the same exception; those to come are fetched while one is looked at.

    Args:
        frames: run to its end, or closed, in a thread of its own.
    """
    shelf = _Shelf()
    thread = Thread(target=_fill, args=(frames, shelf), name="read-ahead", daemon=True)
    thread.start()
    try:
        while (frame := shelf.take()) is not None:
            yield frame
    finally:
        shelf.close()
        thread.join()


def _fill(frames: Generator[Frame, None, None], shelf: _Shelf) -> None:
    _give_way()
    try:
        with closing(frames):
            for frame in frames:
                if not shelf.put(frame):
                    return
    except BaseException as error:  # raised again where the frames are taken
        shelf.end(error)
    else:
        shelf.end(None)


def _give_way() -> None:
    """Let this thread, and those that a decoder starts from it, come after the one that looks at the frames.

    On as many cores as a decoder fills by itself, each frame otherwise has to wait among those that come after it.
    """
    if sys.platform == "linux":  # elsewhere priorities are those of whole processes
        me = get_native_id()
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, me, os.getpriority(os.PRIO_PROCESS, me) + _NICER)


class _Shelf:
    """Frames between the thread that brings them and the one that takes them."""

    def __init__(self) -> None:
        self._changed = Condition()
        self._frames: deque[Frame] = deque()
        self._bytes = 0
        self._ended = self._closed = False
        self._error: BaseException | None = None

    def put(self, frame: Frame) -> bool:
        """Wait for room and leave a frame there; False where nobody takes frames any more."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._has_room)
            self._frames.append(frame)
            self._bytes += frame.pixels.nbytes
            self._changed.notify_all()
            return not self._closed

    @property
    def _has_room(self) -> bool:
        n = len(self._frames)
        return n < _MIN_FRAMES or (n < _MAX_FRAMES and self._bytes < _MAX_BYTES)

    def take(self) -> Frame | None:
        """Wait for the next frame; None after the last one.

        Raises:
            BaseException: what ended the frames, after them.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._frames or self._ended)
            if self._frames:
                frame = self._frames.popleft()
                self._bytes -= frame.pixels.nbytes
                self._changed.notify_all()
                return frame
        if self._error is not None:
            raise self._error
        return None

    def end(self, error: BaseException | None) -> None:
        """No more frames come, because of an error where one is given."""
        with self._changed:
            self._ended, self._error = True, error
            self._changed.notify_all()

    def close(self) -> None:
        """No more frames are taken."""
        with self._changed:
            self._closed = True
            self._frames.clear()
            self._changed.notify_all()
