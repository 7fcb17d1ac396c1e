"""Wall time of a frame by stage."""

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Timer:
    """Wall time by stage, from its construction on."""

    def __init__(self) -> None:
        self._timing_ms: dict[str, float] = {}
        self._start = time.perf_counter()

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Add the time of a `with` block to a stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._timing_ms[name] = self._timing_ms.get(name, 0.0) + _ms_since(start)

    def total(self) -> dict[str, float]:
        """Milliseconds by stage, and in total."""
        return {**self._timing_ms, "total": _ms_since(self._start)}


def _ms_since(start: float) -> float:
    return 1e3 * (time.perf_counter() - start)
