"""An earlier run to hold a new one against: packets that it had, and the time that it took."""

import json
import os
from pathlib import Path

from rxcli.errors import UsageError, failure_explained
from rxcli.results.record import from_record
from rxcli.results.report import plural
from rxcli.results.summary import SourceSummary

#: Of a slower source: less than this is the machine's noise, ms.
_NOISE_MS = 200.0


def regressions(current: SourceSummary, before: SourceSummary, slower: float) -> list[str]:
    """In what a source is worse than in the earlier run; empty where it is not.

    Args:
        current: its figures, with `payloads`.
        before: those of the earlier run.
        slower: largest ratio of the times.
    """
    found = []
    if lost := (before.payloads or set()) - (current.payloads or set()):
        columns = sorted({column for column, _ in lost})
        named = ", ".join(map(str, columns[:8])) + (", ..." if len(columns) > 8 else "")
        found.append(f"{plural(len(lost), 'packet')} of the baseline lost (column {named})")
    if current.time_ms > slower * before.time_ms + _NOISE_MS:
        found.append(
            f"{current.time_ms:.0f} ms, {current.time_ms / max(before.time_ms, 1e-3):.2f} times the baseline's "
            f"{before.time_ms:.0f} ms ({slower:g} times is allowed)"
        )
    return found


def load_baseline(path: Path | None, min_confidence: float) -> dict[str, SourceSummary]:
    """The run that `decode --json` wrote to `path`, by `os.path.normpath` of its sources; empty where no path is given.

    Raises:
        UsageError: it cannot be read, or is none.
    """
    earlier: dict[str, SourceSummary] = {}
    if path is None:
        return earlier
    with failure_explained(f"--baseline {path}: cannot be read", "name a file that --json wrote", UsageError):
        lines = path.read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines, start=1):
        try:
            result = from_record(json.loads(line))
            name = os.path.normpath(result.source)
            earlier.setdefault(name, SourceSummary(name, min_confidence, payloads=set())).add(result)
        except (ValueError, OverflowError, RecursionError, UsageError):
            reason = f"--baseline {path} line {number}: no result of `vlc-rx decode --json`"
            raise UsageError(reason, "name such a file") from None
    return earlier
