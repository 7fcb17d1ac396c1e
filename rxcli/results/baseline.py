"""An earlier run to hold a new one against: packets that it had, and the time that it took."""

import json
import math
import os
from dataclasses import dataclass, field
from pathlib import Path

from rxcli.errors import UsageError, failure_explained
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
    """Results of an earlier run and of the current one, source by source."""

    earlier: dict[str, Run]
    #: Minimum confidence of counted packets in both runs.
    min_confidence: float
    #: Largest ratio of the time of a source to that of the baseline.
    slower: float
    current: dict[str, Run] = field(default_factory=dict)

    def add(self, result: FrameResult) -> None:
        """Count a frame of the current run if its source was in the earlier one, for cameras send without end."""
        if os.path.normpath(result.source) in self.earlier:
            self._count(result, self.current)

    def _count(self, result: FrameResult, runs: dict[str, Run]) -> None:
        run, total = runs.setdefault(os.path.normpath(result.source), Run()), result.timing_ms.get("total", 0.0)
        sure = ((c.column, p) for c in result.columns for p in c.packets if p.confidence >= self.min_confidence)
        run.packets |= {(column, packet.payload) for column, packet in sure}
        run.time_ms += total if math.isfinite(total) else 0.0

    def missing(self) -> list[str]:
        """Sources of the earlier run that this one had nothing of."""
        return sorted(self.earlier.keys() - self.current.keys())

    def regressions(self, source: str) -> list[str]:
        """In what a source is worse than in the earlier run; empty where it is not, or was not in that run."""
        name = os.path.normpath(source)
        current = self.current.get(name, Run())
        before = self.earlier.get(name, current)
        found = []
        if lost := before.packets - current.packets:
            columns = sorted({column for column, _ in lost})
            named = ", ".join(map(str, columns[:8])) + (", ..." if len(columns) > 8 else "")
            found.append(f"{plural(len(lost), 'packet')} of the baseline lost (column {named})")
        if current.time_ms > self.slower * before.time_ms + _NOISE_MS:
            found.append(
                f"{current.time_ms:.0f} ms, {current.time_ms / max(before.time_ms, 1e-3):.2f} times the baseline's "
                f"{before.time_ms:.0f} ms ({self.slower:g} times is allowed)"
            )
        return found


def load_baseline(path: Path | None, min_confidence: float, slower: float) -> Baseline:
    """The run that `decode --json` wrote to `path`; an empty one where no path is given.

    Raises:
        UsageError: it cannot be read, or is none.
    """
    baseline = Baseline({}, min_confidence, slower)
    if path is None:
        return baseline
    with failure_explained(f"--baseline {path}: cannot be read", "name a file that --json wrote", UsageError):
        lines = path.read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines, start=1):
        try:
            baseline._count(from_record(json.loads(line)), baseline.earlier)
        except (ValueError, RecursionError, UsageError):
            reason = f"--baseline {path} line {number}: no result of `vlc-rx decode --json`"
            raise UsageError(reason, "name such a file") from None
    return baseline
