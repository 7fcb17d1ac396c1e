"""Child processes: their environment and their memory."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess

#: Read by libraries when they are loaded: how many threads of their own they start.
_VARIABLES = "OMP_NUM_THREADS OPENBLAS_NUM_THREADS MKL_NUM_THREADS VECLIB_MAXIMUM_THREADS OPENCV_FOR_THREADS_NUM"
#: A process whose libraries start no threads of their own.
ONE_THREAD = dict.fromkeys(_VARIABLES.split(), "1")
_STARTING = Lock()


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


def resident_bytes(pid: int | None) -> int:
    """Resident memory of a process, 0 if unknown."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return 0


def peak_memory_mb() -> float:
    """Peak resident memory of this process so far; `getrusage` counts that of the process which started it, too."""
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        return int(status.split("VmHWM:")[1].split()[0]) / 1024
    except (OSError, IndexError, ValueError):
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)


def start_process(work: Callable[..., None], *arguments: Any) -> tuple[BaseProcess, Connection]:
    """Start `work(connection, *arguments)` in a fresh Python, and give our end of the connection.

    A process is never forked: one that has threads can lock up. It takes no modules from the current folder, which may
    be that of somebody's files.
    """
    from multiprocessing import get_context

    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=work, args=(theirs, *arguments), daemon=True)
    with _STARTING, environment({"PYTHONSAFEPATH": "1"}):
        process.start()
    theirs.close()
    return process, ours
