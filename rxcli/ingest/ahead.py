"""Frames read ahead in a thread of their own, so that the decoder need not wait for whoever receives them."""

from __future__ import annotations

import os
import sys
from collections.abc import Generator
from contextlib import closing, suppress
from queue import SimpleQueue
from threading import Event, Semaphore, Thread, get_native_id

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
    items: SimpleQueue[Frame | BaseException | None] = SimpleQueue()
    room, closed = Semaphore(_MIN_FRAMES), Event()

    def fill() -> None:
        _give_way()
        try:
            with closing(frames):
                for number, frame in enumerate(frames):
                    if number == 0:
                        n_frames = min(_MAX_BYTES // frame.pixels.nbytes, _MAX_FRAMES)
                        for _ in range(_MIN_FRAMES, n_frames):
                            room.release()
                    room.acquire()
                    if closed.is_set():
                        return
                    items.put(frame)
            items.put(None)
        except BaseException as error:  # raised again where the frames are taken
            items.put(error)

    thread = Thread(target=fill, name="read-ahead", daemon=True)
    thread.start()
    try:
        while isinstance(item := items.get(), Frame):
            room.release()
            yield item
        if item is not None:
            raise item
    finally:
        closed.set()
        room.release()
        thread.join()


def _give_way() -> None:
    """Let this thread, and those that a decoder starts from it, come after the one that looks at the frames.

    On as many cores as a decoder fills by itself, each frame otherwise has to wait among those that come after it.
    """
    if sys.platform == "linux":  # elsewhere priorities are those of whole processes
        me = get_native_id()
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, me, os.getpriority(os.PRIO_PROCESS, me) + _NICER)
