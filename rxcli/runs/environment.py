"""The environment variables that other processes are started with."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

#: Read by libraries when they are loaded: how many threads of their own they start.
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)
#: A process whose libraries start no threads of their own.
ONE_THREAD = dict.fromkeys(THREAD_VARIABLES, "1")


@contextmanager
def environment(values: Mapping[str, str]) -> Iterator[None]:
    """The environment of this process with these values for a while."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
