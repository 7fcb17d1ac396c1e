"""Suppression of the messages of libpng, libtiff and LibRaw on stderr; errors are raised anyway."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

_LOCK = Lock()


@contextmanager
def quiet_libraries() -> Iterator[None]:
    """Discard all output to the file descriptor of stderr within the block; one thread at a time."""
    with _LOCK:
        try:
            original = os.dup(2)
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
            os.dup2(original, 2)
            os.close(original)
