"""Without the lines that libpng, libtiff and LibRaw write to stderr by themselves: what matters comes as an error."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

_LOCK = Lock()


@contextmanager
def quiet_libraries() -> Iterator[None]:
    """While this lasts, nothing that is written to the file descriptor of stderr is seen; one thread at a time."""
    with _LOCK:
        try:
            kept = os.dup(2)
        except OSError:  # there is no stderr
            yield
            return
        try:
            if sys.stderr is not None:
                sys.stderr.flush()
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, 2)
            os.close(null)
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
