"""A run in figures: one row per source and a total, as text, CSV, Parquet, or JUnit's XML; and its exit code."""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rxcli.errors import ExitCode, UsageError, worst
from rxcli.outputs import replacing, write_whole
from rxcli.results.report import (
    count_packets,
    csv_cell,
    format_progress,
    format_received,
    format_table,
    plural,
    printable,
    printable_name,
)
from rxcli.results.truth import EXPECTED_LENGTHS, Fault, Score
from rxcli.types import BELIEVABLE, FrameResult

#: Packets that one sentence names.
_MAX_NAMED = 6

#: Fields of the score in a row.
_SCORED = ("expected", "error_free", "lost", "false", "extra", "wrong_w", "ber")


@dataclass(frozen=True, slots=True)
class Limits:
    """What every source must keep for the run to pass."""

    #: Highest bit error rate, lost packets included; None: any.
    max_ber: float | None = None
    #: Fewest packets of `SourceSummary.min_confidence`.
    min_packets: int = 1
    #: Lowest confidence that a packet may have; None: any.
    min_packet_confidence: float | None = None


@dataclass(slots=True)
class SourceSummary:
    """The figures of one source, gathered frame by frame."""

    source: str
    n_frames: int = 0
    n_packets: int = 0
    confidence_sum: float = 0.0
    #: Packets below this confidence do not count for the limits.
    min_confidence: float = BELIEVABLE
    #: Packets that count.
    n_sure: int = 0
    #: Packets that can be believed, and the bits of them; columns in view, over all frames of photos.
    n_received: int = 0
    received_bits: int = 0
    n_columns: int = 0
    #: Bursts of a clip with a reported packet, and times of its first and its last frame.
    bursts: set[int] = field(default_factory=set)
    first_s: float = math.inf
    last_s: float = -math.inf
    #: What it was received with.
    screen: str | None = None
    camera: str | None = None
    #: Texts and files, a line each.
    came: list[str] = field(default_factory=list)
    lowest_confidence: float = math.inf
    #: Packets that were put together from several frames.
    n_combined: int = 0
    statuses: Counter[str] = field(default_factory=Counter)
    #: Counts of failure reasons of frames and columns; `_kinds` merges reasons that differ only in numbers.
    reasons: Counter[str] = field(default_factory=Counter)
    _kinds: dict[str, str] = field(default_factory=dict)
    time_ms: float = 0.0
    #: Complete messages and files, incomplete files, and files that could not be written.
    n_messages: int = 0
    n_objects: int = 0
    incomplete: list[str] = field(default_factory=list)
    unwritten: list[str] = field(default_factory=list)
    #: None where no truth is known.
    score: Score | None = None
    #: Expected packets that did not come as they were sent.
    faults: list[Fault] = field(default_factory=list)
    #: Why truth that was asked for is not there.
    truth_problem: str | None = None
    #: In what it is worse than an earlier run.
    regressions: list[str] = field(default_factory=list)

    def add(self, result: FrameResult) -> None:
        """Count one frame."""
        packets = result.packets
        self.n_frames += 1
        self.statuses[result.status] += 1
        self.n_packets += len(packets)
        self.confidence_sum += sum(packet.confidence for packet in packets)
        self.n_sure += sum(packet.confidence >= self.min_confidence for packet in packets)
        believable = [packet for packet in packets if packet.is_believable]
        self.n_received += len(believable)
        self.received_bits += sum(packet.payload_bits for packet in believable)
        self.n_columns = max(self.n_columns, len(result.columns))
        self.bursts |= {packet.burst for packet in packets if packet.burst is not None}
        self.first_s, self.last_s = min(self.first_s, result.time_s), max(self.last_s, result.time_s)
        self.screen, self.camera = result.screen_profile or self.screen, result.camera_profile or self.camera
        self.came += format_received(result)
        self.lowest_confidence = min((packet.confidence for packet in packets), default=self.lowest_confidence)
        self.n_combined += sum(packet.frames is not None and len(packet.frames) > 1 for packet in packets)
        total = result.timing_ms.get("total", math.nan)
        self.time_ms += total if math.isfinite(total) else 0.0
        self.n_messages += len(result.messages)
        self.n_objects += len(result.objects)
        self.incomplete += [format_progress(progress) for progress in result.progress]
        if result.message:
            self._count_reason(result.message)
        for column in result.columns:
            if column.message and column.status != "ok":
                self._count_reason(column.message)

    def _count_reason(self, reason: str) -> None:
        self.reasons[self._kinds.setdefault(re.sub(r"\d+(\.\d+)?", "#", reason), reason)] += 1

    @property
    def n_unsure(self) -> int:
        """Packets that were reported and cannot be believed."""
        return self.n_packets - self.n_received

    @property
    def is_clip(self) -> bool:
        """Whether there were several frames."""
        return self.n_frames > 1

    @property
    def frames_failed(self) -> int:
        """Frames without packets."""
        return self.n_frames - self.statuses["ok"] - self.statuses["partial"]

    @property
    def is_complete(self) -> bool:
        """Whether every column gave a packet that can be believed, in every burst of a clip."""
        expected = self.n_columns * max(len(self.bursts), 1)
        return not (self.frames_failed or self.n_unsure) and self.n_received >= expected > 0

    @property
    def confidence(self) -> float | None:
        """Mean confidence of the packets, None where there are none."""
        return self.confidence_sum / self.n_packets if self.n_packets else None

    @property
    def reason(self) -> str:
        """The commonest reason of failure, with how many others there are."""
        if not self.reasons:
            return ""
        common, _ = self.reasons.most_common(1)[0]
        n_others = len(self.reasons) - 1
        return f"{common} (and {n_others} other reason{'s' * (n_others > 1)})" if n_others else common

    def failures(self, limits: Limits) -> list[tuple[ExitCode, str]]:
        """Why this source does not pass: exit codes with reasons; empty where it does."""
        found: list[tuple[ExitCode, str]] = []
        if not self.n_frames:
            pass
        elif self.statuses["unreadable"]:
            found.append((ExitCode.UNREADABLE, self.reason))
        elif not self.n_packets and not self.n_messages and not self.n_objects:
            found.append((ExitCode.NOT_RECEIVED, f"no packet: {self.reason}" if self.reason else "no packet"))
        elif self.n_sure < limits.min_packets:
            found.append((ExitCode.NOT_RECEIVED, self._too_few(limits.min_packets)))
        if limits.min_packet_confidence is not None and self.lowest_confidence < limits.min_packet_confidence:
            reason = (
                f"a packet has a confidence of {self.lowest_confidence:.4g}, below {limits.min_packet_confidence:g}"
            )
            found.append((ExitCode.NOT_RECEIVED, reason))
        found += [(ExitCode.NOT_RECEIVED, problem) for problem in (*self.regressions, *self.unwritten)]
        if self.truth_problem:
            found.append((ExitCode.UNREADABLE, self.truth_problem))
        if limits.max_ber is not None and self.n_frames:
            found += self._ber_failures(limits.max_ber)
        return found

    def _too_few(self, asked: int) -> str:
        counted = count_packets(self.n_sure, self.n_packets - self.n_sure)
        of_them = "" if self.min_confidence == BELIEVABLE else f" (confidence {self.min_confidence:g} or more)"
        return f"{counted}; {asked} {'was' if asked == 1 else 'were'} asked for{of_them}"

    def _ber_failures(self, max_ber: float) -> list[tuple[ExitCode, str]]:
        if self.score is None:
            return [(ExitCode.NOT_RECEIVED, "no truth to hold the bit error rate against")]
        if self.score.ber is None:
            reason = f"no bit error rate: the truth shows no burst for {EXPECTED_LENGTHS:g} packet lengths"
            return [(ExitCode.NOT_RECEIVED, reason)]
        if self.score.ber <= max_ber:
            return []
        named = ", ".join(map(str, self.faults[:_MAX_NAMED]))
        more = f" and {len(self.faults) - _MAX_NAMED} more" if len(self.faults) > _MAX_NAMED else ""
        reason = f"bit error rate {self.score.ber:.3g} is above {max_ber:.3g}: {named}{more}"
        return [(ExitCode.NOT_RECEIVED, reason)]

    def row(self, limits: Limits) -> dict[str, Any]:
        """The figures as plain data; None where unknown."""
        failures = self.failures(limits)
        return {
            "source": printable_name(self.source),
            "exit_code": int(worst([code for code, _ in failures])),
            "frames": self.n_frames,
            "frames_failed": self.frames_failed,
            "packets": self.n_packets,
            "received": self.n_received,
            "unsure": self.n_unsure,
            "combined": self.n_combined,
            "confidence": _finite(self.confidence),
            **{name: getattr(self.score, name) if self.score else None for name in _SCORED},
            "messages": self.n_messages,
            "files": self.n_objects,
            "time_ms": round(self.time_ms, 1),
            "reason": (failures[0][1] if failures else self._shortfall).removeprefix(f"{self.source}: "),
        }

    @property
    def _shortfall(self) -> str:
        """What is missing of a source that passes: that no packet is whole in some frames of a clip is none."""
        if self.incomplete or (self.is_clip and not self.frames_failed):
            return "; ".join(self.incomplete)
        return self.reason


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, 6)


def total(summaries: Sequence[SourceSummary]) -> SourceSummary:
    """All sources as one, named "total"; scored over sources with known truth."""
    whole = SourceSummary("total")
    for summary in summaries:
        for name in (
            *("n_frames", "n_packets", "n_sure", "n_received", "confidence_sum", "n_combined", "time_ms"),
            *("n_messages", "n_objects"),
        ):
            setattr(whole, name, getattr(whole, name) + getattr(summary, name))
        whole.statuses.update(summary.statuses)
        whole.reasons.update(summary.reasons)
        if summary.score is not None:
            whole.score = (whole.score or Score()) + summary.score
    return whole


def exit_code(summaries: Sequence[SourceSummary], limits: Limits) -> ExitCode:
    """The exit code of a run over these sources."""
    return worst([code for summary in summaries for code, _ in summary.failures(limits)])


def format_summary(summaries: Sequence[SourceSummary], limits: Limits) -> str:
    """One row per source, a total where there are several, and columns for the truth where any is known."""
    rows = [summary.row(limits) for summary in summaries]
    scored = any(summary.score is not None for summary in summaries)
    names = ["source", "frames", "received", "unsure", "confidence"]
    names += ["expected", "error_free", "lost", "false", "ber"] if scored else []
    cells = [[_text(row[name]) for name in names] + [printable(str(row["reason"]))] for row in rows]
    if len(summaries) > 1:
        whole = total(summaries).row(Limits())
        failed = sum(row["exit_code"] != 0 for row in rows)
        ending = f"{failed} of {len(rows)} failed" if failed else ""
        if not failed and all(summary.is_complete for summary in summaries):
            ending = "all received"
        cells.append([_text(whole[name]) for name in names] + [ending])
    return format_table([name.replace("_", "-") for name in names] + [""], cells)


def format_clip(clip: SourceSummary) -> str:
    """A clip in one line: what was received of it, with how many packets a burst, how quickly and how surely."""
    span_s = (clip.last_s - clip.first_s) * clip.n_frames / max(clip.n_frames - 1, 1)
    parts = [printable_name(clip.source), f"clip of {plural(clip.n_frames, 'frame')}, {span_s:.2f} s"]
    if clip.screen:
        parts += [f"screen {clip.screen}", f"camera {clip.camera or 'unknown'}"]
    parts.append(f"{plural(len(clip.bursts), 'burst')}: {count_packets(clip.n_received, clip.n_unsure)}")
    if clip.n_packets:
        rate = f"{clip.received_bits / span_s / 1e3:.1f} kb/s" if span_s > 0 else "all in one instant"
        parts += [rate, f"mean confidence {_text(_finite(clip.confidence))}"]
    parts.append(f"{clip.time_ms:.0f} ms")
    lines = [" | ".join(parts)]
    if clip.frames_failed and clip.reasons:
        lines.append(f"  {plural(clip.frames_failed, 'frame')} gave nothing: {printable(clip.reason)}")
    return "\n".join(lines)


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def write_summary(path: Path, summaries: Sequence[SourceSummary], limits: Limits) -> None:
    """Write one row per source, as CSV or Parquet by the file's suffix.

    Raises:
        UsageError: the suffix is neither, or the extra for Parquet is not installed.
        InputError: the file cannot be written.
    """
    check_summary_path(path)
    rows = [summary.row(limits) for summary in summaries]
    with replacing(path) as hidden:
        if path.suffix.casefold() == ".csv":
            _write_csv(hidden, rows)
        else:
            _write_parquet(hidden, rows)


def check_summary_path(path: Path) -> None:
    """Raise what `write_summary` would, before a long run rather than after it.

    Raises:
        UsageError: the suffix is neither CSV's nor Parquet's, or the extra for Parquet is not installed.
    """
    suffix = path.suffix.casefold()
    if suffix not in (".csv", ".parquet"):
        raise UsageError(f"--summary must end in .csv or .parquet (got {str(path)!r})", "name such a file")
    if suffix == ".parquet":
        from importlib.util import find_spec

        if find_spec("pyarrow") is None:
            raise UsageError(f"{path}: Parquet needs the package pyarrow", "pip install '.[parquet]', or name a .csv")


def _write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, _COLUMNS)
        writer.writeheader()
        writer.writerows({name: csv_cell(value) for name, value in row.items()} for row in rows)


def _write_parquet(path: Path, rows: list[dict[str, Any]]) -> None:
    import pyarrow
    import pyarrow.parquet

    kinds = {"source": pyarrow.string(), "reason": pyarrow.string()}
    kinds |= dict.fromkeys(("confidence", "ber", "time_ms"), pyarrow.float64())
    schema = pyarrow.schema([(name, kinds.get(name, pyarrow.int64())) for name in _COLUMNS])
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist(rows, schema=schema), path)


_COLUMNS = tuple(SourceSummary("").row(Limits()))


def write_junit(path: Path, summaries: Sequence[SourceSummary], limits: Limits) -> None:
    """Write one test case per source: an error where it could not be read, a failure where it was not received.

    Raises:
        InputError: the file cannot be written.
    """
    from xml.etree import ElementTree

    suite, kinds = ElementTree.Element("testsuite", name="vlc-rx decode"), Counter[str]()
    for summary in summaries:
        about = {"classname": "decode", "name": printable_name(summary.source), "time": f"{summary.time_ms / 1e3:.3f}"}
        case = ElementTree.SubElement(suite, "testcase", about)
        failures = summary.failures(limits)
        if failures:  # one a case, as the readers of these files expect it: the worst, with all reasons
            code = worst([code for code, _ in failures])
            kind = "error" if code is ExitCode.UNREADABLE else "failure"
            reasons = "; ".join(dict.fromkeys(reason for _, reason in failures))
            element = ElementTree.SubElement(case, kind, message=printable(reasons), type=code.name.lower())
            element.text = "\n".join(map(str, summary.faults)) or None
            kinds[kind] += 1
        ElementTree.SubElement(case, "system-out").text = count_packets(summary.n_received, summary.n_unsure)
    counts = {"tests": len(summaries), "errors": kinds["error"], "failures": kinds["failure"]}
    suite.attrib |= {name: str(count) for name, count in counts.items()}
    suite.set("time", f"{sum(summary.time_ms for summary in summaries) / 1e3:.3f}")
    root = ElementTree.Element("testsuites")
    root.append(suite)
    ElementTree.indent(root)
    write_whole(path, ElementTree.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")
