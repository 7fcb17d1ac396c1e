"""A run in figures: one row per source and a total, as text, CSV, Parquet, or JUnit's XML; and its exit code."""

import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rxcli.errors import ExitCode, UsageError, printable, require, worst
from rxcli.outputs import replacing, write_whole
from rxcli.results import report
from rxcli.results.report import count_packets, plural, printable_name
from rxcli.results.truth import EXPECTED_LENGTHS, Fault, Score
from rxcli.types import BELIEVABLE, FrameResult, Message

#: Packets that one sentence names.
_MAX_NAMED = 6
#: Columns of a row that are counts of the frames, and fields of the score.
_COUNTED = ("frames", "frames_failed", "packets", "received", "unsure", "combined")
_SCORED = ("expected", "error_free", "lost", "false", "extra", "wrong_w", "ber")
#: Columns that the terminal shows; those of the truth where any is known.
_SHOWN, _SHOWN_SCORED = ("source", "frames", "received", "unsure", "confidence"), (*_SCORED[:4], "ber")


@dataclass(frozen=True, slots=True)
class Limits:
    """What every source must keep for the run to pass."""

    #: Highest bit error rate, lost packets included; None: any.
    max_ber: float | None = None
    #: Fewest packets of `SourceSummary.min_confidence`; a text or a file counts as one.
    min_packets: int = 1
    #: Texts that must come.
    expected_texts: tuple[str, ...] = ()
    #: Lowest confidence that a packet may have; None: any.
    min_packet_confidence: float | None = None


@dataclass(slots=True)
class SourceSummary:
    """The figures of one source, gathered frame by frame."""

    source: str
    #: Packets below this confidence do not count for the limits.
    min_confidence: float = BELIEVABLE
    #: Counts by name. `frames`: all, `frames_failed`: without packets, `unreadable`. `packets`: all, `received`: the
    #: believable ones and their `bits`, `unsure`: the others, `sure`: at least `min_confidence`, `combined`: put
    #: together from several frames. `messages` and `files`: complete.
    n: Counter[str] = field(default_factory=Counter)
    #: (column, payload) of the `sure` ones, where a baseline is held against them: a camera sends without end.
    payloads: set[tuple[int, str]] | None = None
    confidence_sum: float = 0.0
    time_ms: float = 0.0
    #: Most columns in view of a frame.
    n_columns: int = 0
    #: Bursts of a clip with a reported packet, and times of its first and its last frame.
    bursts: set[int] = field(default_factory=set)
    first_s: float = math.inf
    last_s: float = -math.inf
    #: What it was received with.
    screen: str | None = None
    camera: str | None = None
    #: Texts and files, a line each, and the texts themselves; incomplete files, and files that could not be written.
    came: list[str] = field(default_factory=list)
    texts: set[str] = field(default_factory=set)
    incomplete: list[str] = field(default_factory=list)
    unwritten: list[str] = field(default_factory=list)
    lowest_confidence: float = math.inf
    #: Counts of failure reasons of frames and columns; `_kinds` merges reasons that differ only in numbers.
    reasons: Counter[str] = field(default_factory=Counter)
    _kinds: dict[str, str] = field(default_factory=dict)
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
        believable = [packet for packet in packets if packet.is_believable]
        self.n.update(
            frames=1,
            frames_failed=int(result.status not in ("ok", "partial")),
            unreadable=int(result.status == "unreadable"),
            packets=len(packets),
            received=len(believable),
            bits=sum(packet.payload_bits for packet in believable),
            unsure=len(packets) - len(believable),
            sure=sum(packet.confidence >= self.min_confidence for packet in packets),
            combined=sum(packet.frames is not None and len(packet.frames) > 1 for packet in packets),
            messages=len(result.messages),
            files=len(result.objects),
        )
        if self.payloads is not None:
            sure = ((c.column, p) for c in result.columns for p in c.packets if p.confidence >= self.min_confidence)
            self.payloads |= {(column, packet.payload) for column, packet in sure}
        self.confidence_sum += sum(packet.confidence for packet in packets)
        self.lowest_confidence = min((packet.confidence for packet in packets), default=self.lowest_confidence)
        total = result.timing_ms.get("total", math.nan)
        self.time_ms += total if math.isfinite(total) else 0.0
        self.n_columns = max(self.n_columns, len(result.columns))
        self.bursts |= {packet.burst for packet in packets if packet.burst is not None}
        self.first_s, self.last_s = min(self.first_s, result.time_s), max(self.last_s, result.time_s)
        self.screen, self.camera = result.screen_profile or self.screen, result.camera_profile or self.camera
        self.came += report.format_received(result)
        self.texts.update(message.text for message in result.messages if message.text is not None)
        self.incomplete += map(report.format_progress, result.progress)
        failed = [column.message for column in result.columns if column.status != "ok"]
        for reason in filter(None, (result.message, *failed)):
            self.reasons[self._kinds.setdefault(re.sub(r"\d+(\.\d+)?", "#", reason), reason)] += 1

    def add_part(self, message: Message) -> None:
        """Count a text that this photograph showed in part, and another one completed."""
        self.n["messages"] += 1
        self.n["frames_failed"] = 0
        self.texts.add(message.text or "")
        self.reasons = Counter({f"completed by {printable_name(message.source)}": 1})

    @property
    def is_clip(self) -> bool:
        """Whether there were several frames."""
        return self.n["frames"] > 1

    @property
    def is_complete(self) -> bool:
        """Whether every column gave a packet that can be believed, in every burst of a clip."""
        expected = self.n_columns * max(len(self.bursts), 1)
        is_whole = self.n["received"] >= expected > 0 or (self.n_came > 0 and not self.n_columns)
        return is_whole and not (self.n["frames_failed"] or self.n["unsure"])

    @property
    def n_came(self) -> int:
        """Number of texts and files."""
        return self.n["messages"] + self.n["files"]

    @property
    def confidence(self) -> float | None:
        """Mean confidence of the packets, None where it is not known."""
        mean = self.confidence_sum / self.n["packets"] if self.n["packets"] else math.nan
        return round(mean, 6) if math.isfinite(mean) else None

    @property
    def reason(self) -> str:
        """The commonest reason of failure, with how many others there are."""
        if not self.reasons:
            return ""
        common, _ = self.reasons.most_common(1)[0]
        n_others = len(self.reasons) - 1
        return f"{common} (and {plural(n_others, 'other reason')})" if n_others else common

    def failures(self, limits: Limits) -> list[tuple[ExitCode, str]]:
        """Why this source does not pass: exit codes with reasons; empty where it does."""
        found = [(ExitCode.NOT_RECEIVED, reason) for reason in self._shortfalls(limits)]
        if self.n["unreadable"]:
            found.insert(0, (ExitCode.UNREADABLE, self.reason))
        if self.truth_problem:
            found.append((ExitCode.UNREADABLE, self.truth_problem))
        return found

    def _shortfalls(self, limits: Limits) -> Iterator[str]:
        """What was not received, or not well enough."""
        n, lowest, least = self.n, self.lowest_confidence, limits.min_packet_confidence
        if n["frames"] and not n["unreadable"]:
            if not (n["packets"] or self.n_came):
                yield f"no packet: {self.reason}" if self.reason else "no packet"
            elif n["sure"] + self.n_came < limits.min_packets:
                counted, asked = count_packets(n["sure"], n["packets"] - n["sure"]), limits.min_packets
                of_them = "" if self.min_confidence == BELIEVABLE else f" (confidence {self.min_confidence:g} or more)"
                yield f"{counted}; {asked} {'was' if asked == 1 else 'were'} asked for{of_them}"
        if least is not None and lowest < least:
            yield f"a packet has a confidence of {lowest:.4g}, below {least:g}"
        yield from (f"the text {text!r} did not come" for text in limits.expected_texts if text not in self.texts)
        yield from (*self.regressions, *self.unwritten)
        if limits.max_ber is not None and n["frames"]:
            if self.score is None:
                yield "no truth to hold the bit error rate against"
            elif self.score.ber is None:
                yield f"no bit error rate: the truth shows no burst for {EXPECTED_LENGTHS:g} packet lengths"
            elif self.score.ber > limits.max_ber:
                named = ", ".join(map(str, self.faults[:_MAX_NAMED]))
                more = f" and {len(self.faults) - _MAX_NAMED} more" if len(self.faults) > _MAX_NAMED else ""
                yield f"bit error rate {self.score.ber:.3g} is above {limits.max_ber:.3g}: {named}{more}"

    def row(self, limits: Limits) -> dict[str, Any]:
        """The figures as plain data: the columns that every writer shows or chooses from; None where unknown."""
        failures = self.failures(limits)
        # That no packet is whole in some frames of a clip is no failure.
        is_whole = self.incomplete or (self.is_clip and not self.n["frames_failed"])
        reason = failures[0][1] if failures else "; ".join(self.incomplete) if is_whole else self.reason
        return {
            "source": printable_name(self.source),
            "exit_code": int(worst([code for code, _ in failures])),
            **{name: self.n[name] for name in _COUNTED},
            "confidence": self.confidence,
            **{name: getattr(self.score, name, None) for name in _SCORED},
            "messages": self.n["messages"],
            "files": self.n["files"],
            "time_ms": round(self.time_ms, 1),
            "reason": reason.removeprefix(f"{self.source}: "),
        }


def total(summaries: Sequence[SourceSummary]) -> SourceSummary:
    """All sources as one, named "total"; scored over sources with known truth."""
    whole = SourceSummary("total")
    for summary in summaries:
        whole.n.update(summary.n)
        whole.reasons.update(summary.reasons)
        whole.confidence_sum += summary.confidence_sum
        whole.time_ms += summary.time_ms
        if summary.score is not None:
            whole.score = (whole.score or Score()) + summary.score
    return whole


def exit_code(summaries: Sequence[SourceSummary], limits: Limits) -> ExitCode:
    """The exit code of a run over these sources."""
    return worst([code for summary in summaries for code, _ in summary.failures(limits)])


def format_summary(summaries: Sequence[SourceSummary], limits: Limits, is_shown: bool = False) -> str:
    """One row per source, a total where there are several, and columns for the truth where any is known.

    Args:
        summaries: of the sources.
        limits: that they must keep.
        is_shown: the table above states why a photo was not received; for a photo alone it is not repeated.
    """
    rows = [summary.row(limits) for summary in summaries]
    names = (*_SHOWN, *(_SHOWN_SCORED if any(summary.score is not None for summary in summaries) else ()))
    if len(summaries) > 1:
        failed = sum(row["exit_code"] != 0 for row in rows)
        is_whole = not failed and all(summary.is_complete for summary in summaries)
        ending = f"{failed} of {len(rows)} failed" if failed else "all received" if is_whole else ""
        rows.append(total(summaries).row(Limits()) | {"reason": ending})
    elif is_shown and not summaries[0].is_clip:
        shown = summaries[0].reason.removeprefix(f"{summaries[0].source}: ")
        rows[0]["reason"] = rows[0]["reason"].removesuffix(shown).removesuffix(": ")
    cells = [[*(_text(row[name]) for name in names), printable(row["reason"])] for row in rows]
    return report.format_table([*(name.replace("_", "-") for name in names), ""], cells)


def format_clip(clip: SourceSummary) -> str:
    """A clip in one line: what was received of it, with how many packets a burst, how quickly and how surely."""
    n, span_s = clip.n, (clip.last_s - clip.first_s) * clip.n["frames"] / max(clip.n["frames"] - 1, 1)
    parts = [printable_name(clip.source), f"clip of {plural(n['frames'], 'frame')}, {span_s:.2f} s"]
    if clip.screen:
        parts += [f"screen {clip.screen}", f"camera {clip.camera or 'unknown'}"]
    parts.append(f"{plural(len(clip.bursts), 'burst')}: {count_packets(n['received'], n['unsure'])}")
    if n["packets"]:
        rate = f"{n['bits'] / span_s / 1e3:.1f} kb/s" if span_s > 0 else "all in one instant"
        parts += [rate, f"mean confidence {_text(clip.confidence)}"]
    parts.append(f"{clip.time_ms:.0f} ms")
    lines = [" | ".join(parts)]
    if n["frames_failed"] and clip.reasons:
        lines.append(f"  {plural(n['frames_failed'], 'frame')} gave nothing: {printable(clip.reason)}")
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
    if path.suffix.casefold() == ".csv":
        write_whole(path, report.csv_text([_COLUMNS, *(row.values() for row in rows)]))
        return
    import pyarrow
    import pyarrow.parquet

    kinds = {"source": pyarrow.string(), "reason": pyarrow.string()}
    kinds |= dict.fromkeys(("confidence", "ber", "time_ms"), pyarrow.float64())
    schema = pyarrow.schema([(name, kinds.get(name, pyarrow.int64())) for name in _COLUMNS])
    with replacing(path) as hidden:
        pyarrow.parquet.write_table(pyarrow.Table.from_pylist(rows, schema=schema), hidden)


def check_summary_path(path: Path) -> None:
    """Raise what `write_summary` would, before a long run rather than after it.

    Raises:
        UsageError: the suffix is neither CSV's nor Parquet's, or the extra for Parquet is not installed.
    """
    suffix = path.suffix.casefold()
    if suffix not in (".csv", ".parquet"):
        raise UsageError(f"--summary must end in .csv or .parquet (got {str(path)!r})", "name such a file")
    if suffix == ".parquet":
        require(f"{path}: Parquet", "pyarrow")


_COLUMNS = tuple(SourceSummary("").row(Limits()))


def write_junit(path: Path, summaries: Sequence[SourceSummary], limits: Limits) -> None:
    """Write one test case per source: an error where it could not be read, a failure where it was not received.

    Raises:
        InputError: the file cannot be written.
    """
    from xml.etree import ElementTree

    root = ElementTree.Element("testsuites")
    suite, kinds = ElementTree.SubElement(root, "testsuite", name="vlc-rx decode"), Counter[str]()
    for summary in summaries:
        row, failures = summary.row(limits), summary.failures(limits)
        about = {"classname": "decode", "name": row["source"], "time": f"{row['time_ms'] / 1e3:.3f}"}
        case = ElementTree.SubElement(suite, "testcase", about)
        if failures:  # one a case, as the readers of these files expect it: the worst, with all reasons
            code = ExitCode(row["exit_code"])
            kind = "error" if code is ExitCode.UNREADABLE else "failure"
            reasons = "; ".join(dict.fromkeys(reason for _, reason in failures))
            element = ElementTree.SubElement(case, kind, message=printable(reasons), type=code.name.lower())
            element.text = "\n".join(map(str, summary.faults)) or None
            kinds[kind] += 1
        counted = count_packets(row["received"], row["unsure"])
        ElementTree.SubElement(case, "system-out").text = "\n".join([*summary.came, counted])
    counts = {"tests": len(summaries), "errors": kinds["error"], "failures": kinds["failure"]}
    suite.attrib |= {name: str(count) for name, count in counts.items()}
    suite.set("time", f"{sum(summary.time_ms for summary in summaries) / 1e3:.3f}")
    ElementTree.indent(root)
    write_whole(path, ElementTree.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")
