"""Work ahead in other threads and processes, so that file decoding does not wait for the receiver."""

import os
import sys
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, suppress
from itertools import islice
from queue import Empty, Queue
from threading import Event, Thread, get_native_id
from typing import Any

from rxcli.types import Frame

#: Limits of the queue: bytes of pixels, and minimum and maximum number of frames.
_MAX_BYTES, _MIN_FRAMES, _MAX_FRAMES = 60_000_000, 2, 16
#: Increase of the thread's nice value over that of the process.
_NICER = 5


def in_order(items: Iterable[Any], submit: Callable[[Any], Any], n_ahead: int) -> Iterator[tuple[Any, Any]]:
    """Each item with what `submit` makes of it, which is called for `n_ahead` items before the first is taken."""
    waiting = iter(items)
    submitted = deque((item, submit(item)) for item in islice(waiting, n_ahead))
    while submitted:
        yield submitted.popleft()
        submitted.extend((item, submit(item)) for item in islice(waiting, 1))


def read_ahead(frames: Generator[Frame, None, None]) -> Generator[Frame, None, None]:
    """Fetch frames in a thread from now on, and yield them, and then their exception.

    Args:
        frames: generator, which is exhausted or closed in that thread.
    """
    items: Queue[Frame | BaseException | None] = Queue(_MIN_FRAMES)
    closed = Event()

    def fill() -> None:
        _give_way()
        try:
            with closing(frames):
                for frame in frames:
                    items.maxsize = min(max(_MAX_BYTES // frame.pixels.nbytes, _MIN_FRAMES), _MAX_FRAMES)
                    items.put(frame)
                    if closed.is_set():
                        return
            items.put(None)
        except BaseException as error:  # raised again where the frames are taken
            items.put(error)

    thread = Thread(target=fill, name="read-ahead", daemon=True)
    thread.start()

    def taken() -> Generator[Frame, None, None]:
        try:
            while isinstance(item := items.get(), Frame):
                yield item
            if item is not None:
                raise item
        finally:
            closed.set()
            with suppress(Empty):  # room for a frame that waits, after which the thread ends
                while True:
                    items.get_nowait()
            thread.join()

    return taken()


def _give_way() -> None:
    """Lower the priority of this thread and of the decoder threads that it starts.

    Otherwise a decoder that fills all cores delays the reception of the frame before.
    """
    if sys.platform == "linux":  # elsewhere priorities are those of whole processes
        me = get_native_id()
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, me, os.getpriority(os.PRIO_PROCESS, me) + _NICER)
