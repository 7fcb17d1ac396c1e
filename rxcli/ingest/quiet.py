"""Suppression of the messages of libpng, libtiff and LibRaw on stderr; errors are raised anyway."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import IO

_LOCK = Lock()


@contextmanager
def quiet_libraries(sink: IO[bytes] | None = None) -> Iterator[None]:
    """Discard all output to the file descriptor of stderr within the block; one thread at a time.

    Args:
        sink: an open file that takes it instead.
    """
    with _LOCK:
        try:
            original = os.dup(2)
        except OSError:  # there is no stderr
            yield
            return
        try:
            if sys.stderr is not None:
                sys.stderr.flush()
            with open(os.devnull, "wb") as null:
                os.dup2((sink or null).fileno(), 2)
            yield
        finally:
            os.dup2(original, 2)
            os.close(original)
