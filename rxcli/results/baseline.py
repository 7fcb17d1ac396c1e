"""An earlier run to hold a new one against: packets that it had, and the time that it took."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass, field
from pathlib import Path

from rxcli.errors import UsageError
from rxcli.results.record import from_record
from rxcli.results.report import plural
from rxcli.types import FrameResult

#: Of a slower source: less than this is the machine's noise, ms.
_NOISE_MS = 200.0


@dataclass(slots=True)
class Run:
    """One source in one run."""

    #: (column, payload) of packets that are sure enough.
    packets: set[tuple[int, str]] = field(default_factory=set)
    time_ms: float = 0.0


@dataclass(slots=True)
class Baseline:
    """What an earlier run gave, source by source; and what the run now gives."""

    earlier: dict[str, Run]
    #: Packets of less do not count, then or now.
    min_confidence: float
    #: A source may take so many times as long as then.
    slower: float
    now: dict[str, Run] = field(default_factory=dict)

    def add(self, result: FrameResult) -> None:
        """Count a frame of the run now."""
        self._count(result, self.now)

    def _count(self, result: FrameResult, runs: dict[str, Run]) -> None:
        run = runs.setdefault(_key(result.source), Run())
        run.packets |= {
            (column.column, packet.payload)
            for column in result.columns
            for packet in column.packets
            if packet.confidence >= self.min_confidence
        }
        total = result.timing_ms.get("total", 0.0)
        run.time_ms += total if math.isfinite(total) else 0.0

    def missing(self) -> list[str]:
        """Sources of the earlier run that this one had nothing of."""
        return sorted(self.earlier.keys() - self.now.keys())

    def regressions(self, source: str) -> list[str]:
        """In what a source is worse than in the earlier run; empty where it is not, or was not in that run."""
        before, now = self.earlier.get(_key(source)), self.now.get(_key(source), Run())
        if before is None:
            return []
        found = []
        lost = before.packets - now.packets
        if lost:
            columns = sorted({column for column, _ in lost})
            named = ", ".join(map(str, columns[:8])) + (", ..." if len(columns) > 8 else "")
            found.append(f"{plural(len(lost), 'packet')} of the baseline lost (column {named})")
        if now.time_ms > self.slower * before.time_ms + _NOISE_MS:
            found.append(
                f"{now.time_ms:.0f} ms, {now.time_ms / max(before.time_ms, 1e-3):.2f} times the baseline's "
                f"{before.time_ms:.0f} ms ({self.slower:g} times is allowed)"
            )
        return found


def load_baseline(path: Path, min_confidence: float, slower: float) -> Baseline:
    """The run that `decode --json` wrote to `path`.

    Raises:
        UsageError: it cannot be read, or is none.
    """
    baseline = Baseline({}, min_confidence, slower)
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(file, start=1):
                try:
                    baseline._count(from_record(json.loads(line)), baseline.earlier)
                except (ValueError, RecursionError, UsageError):
                    what = f"--baseline {path} line {number}: no result of `vlc-rx decode --json`"
                    raise UsageError(what, "name such a file") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UsageError(f"--baseline {path}: cannot be read ({reason})", "name a file that --json wrote") from None
    return baseline


def _key(source: str) -> str:
    """A source as both runs name it."""
    return os.path.normpath(source)
