"""Results as tables and sentences for people."""

import csv
import io
import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Any

from rxcli.errors import capitalised, printable
from rxcli.results.columns import PACKET_TABLE, PAYLOAD_TABLE, packet_rows
from rxcli.results.record import plain
from rxcli.types import FrameResult, ObjectProgress, PacketResult, ReceivedObject

#: Hex digits of a payload that a table of 80 characters shows.
_SHOWN_DIGITS = 20
_STATUS = {
    "ok": "Received",
    "partial": "Received in part",
    "no_screen": "No screen found",
    "no_signal": "Nothing could be received",
    "unreadable": "The file could not be read",
}
#: What the columns of the table mean, for those who see it for the first time.
LEGEND = (
    "w: lit slots of ten. copies: how often the packet is in view. confidence: probability that every bit is right.\n"
    "payload: hex. *: corrected by the auto-encoder. weak: confidence below 0.5, not counted as received.\n"
    "dark: too little light to try."
)


def format_link(result: FrameResult) -> list[str]:
    """What came through the link layer with a frame, one line each, for people."""
    notes = [f"note: {printable(hint)}" for hint in result.link_notes]
    return [*format_received(result), *map(format_progress, result.progress), *notes]


def format_received(result: FrameResult) -> list[str]:
    """Texts and files that are complete with a frame, one line each."""
    texts = (
        f"bytes: {message.data.hex()}" if message.text is None else f"{message.kind}: {printable(message.text)}"
        for message in result.messages
    )
    return [*texts, *map(format_object, result.objects)]


def format_object(received: ReceivedObject) -> str:
    """A file in one line."""
    where = f"written to {printable(received.path)}" if received.path else "not written; give --out FOLDER to have it"
    return f"file: {printable(received.name)}, {received.size} bytes, SHA-256 {received.sha256[:16]}…, {where}"


def format_progress(progress: ObjectProgress) -> str:
    """A file under way in one line."""
    share = f"{math.floor(100 * progress.share)} % of a file of about {progress.container_bytes} bytes"
    if progress.seconds_left is None:
        return f"incomplete: {share}; take a clip, or more of it"
    return f"incomplete: {share}, {math.ceil(progress.seconds_left)} more seconds of this clip would do"


def mirror_note(result: FrameResult, option: str = "") -> str:
    """A sentence on which side columns are counted from, where it is not the left; else empty.

    Args:
        result: of a frame.
        option: what counts them from the other side, where the reader can do it.
    """
    if result.mirrored:
        return "The picture is mirrored: columns are counted from its right."
    if result.mirrored is None and result.packets:
        more = f" ({option})" if option else ""
        return f"Taken with a front camera. If the picture is mirrored, columns count from its right{more}."
    return ""


def csv_text(rows: Iterable[Iterable[Any]]) -> str:
    """Rows as CSV; a spreadsheet takes their texts for texts, not for formulas (OWASP, CSV injection)."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows(
        [f"'{cell}" if isinstance(cell, str) and cell.startswith(_FORMULA_STARTS) else cell for cell in row]
        for row in rows
    )
    return text.getvalue()


def payload_rows(result: FrameResult) -> Iterator[list[Any]]:
    """One row of `PAYLOAD_TABLE` a packet."""
    for packet in packet_rows(result):
        written = {"source": printable_name(result.source), "confidence": f"{packet['confidence']:.6f}"}
        yield [(packet | written)[key] for key in PAYLOAD_TABLE.values()]


def printable_name(name: str) -> str:
    """The name of a file as `printable`, with backslashes doubled, so that the original name can be recovered."""
    return printable(name.replace("\\", "\\\\"))


#: What makes a spreadsheet compute a cell.
_FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r")


def format_frame(result: FrameResult) -> str:
    """A heading and one row per packet; columns without packets are grouped if their rows are equal."""
    reason = printable((result.message or "").removeprefix(result.source + ": "))
    texts = (mirror_note(result, "--mirrored"), *reason.split("; ", 1))
    lines = [format_heading(result), *(f"  {text}" for text in texts if text)]
    clip = _is_clip(result)
    scored = any(packet.bit_errors is not None for packet in result.packets)
    lines += packet_table(result, clip, scored)
    for screen in result.other_screens:
        lines += [f"  another screen: {_place(screen)} | screen {screen.screen_profile} | {_counts(screen)}"]
        lines += packet_table(screen, clip, scored)
    return "\n".join(lines)


def format_heading(result: FrameResult) -> str:
    """Source, screen, camera, status and counts in one line."""
    parts = [
        printable_name(result.source),
        f"frame {result.frame} at {result.time_s:.3f} s" if _is_clip(result) else "",
        result.status,
        f"screen {result.screen_profile}" if result.screen_profile else "",
        f"camera {result.camera_profile or 'unknown'}" if result.status != "unreadable" else "",
        _counts(result) if result.columns else "",
        f"{result.timing_ms['total']:.0f} ms" if "total" in result.timing_ms else "",
    ]
    return " | ".join(filter(None, parts))


def _counts(result: FrameResult) -> str:
    if _goes_on(result):
        return "its packets end in later frames"
    return f"{packets_in_words(result.packets)} ({plural(len(result.columns), 'column')})"


def packets_in_words(packets: Sequence[PacketResult]) -> str:
    """Packets, unsure ones apart; see `count_packets`."""
    n_received = sum(packet.is_believable for packet in packets)
    return count_packets(n_received, len(packets) - n_received)


def headline(result: FrameResult) -> str:
    """What became of a frame, in a few words."""
    return capitalised(packets_in_words(result.packets)) if result.packets else _STATUS[result.status]


def count_packets(n_received: int, n_unsure: int) -> str:
    """The packets of a photo, a clip or a run: received ones, and unsure ones separately.

    Args:
        n_received: packets that are believable, see `rxcli.types.BELIEVABLE`.
        n_unsure: packets of lower confidence.
    """
    received = f"{plural(n_received, 'packet')} received" if n_received else "no packet received"
    return f"{received}, {n_unsure} unsure" if n_unsure else received


def result_in_words(result: FrameResult) -> str:
    """What was done for a frame, in one line: its heading, the place of its screen, times, what was left out."""
    details = {"ms": result.timing_ms, "left out": result.skipped, "auto-encoder": result.denoiser}
    details |= {"screen at": _place(result), "us a row": result.line_delay_s and 1e6 * result.line_delay_s}
    shown = (f"{name} {plain(value)}" for name, value in details.items() if value)
    return "; ".join([format_heading(result), *shown])


def _place(result: FrameResult) -> str:
    """Corners of the screen, pixels."""
    return "" if result.corners is None else " ".join(f"{x:.0f},{y:.0f}" for x, y in result.corners)


def plural(number: int, noun: str) -> str:
    """`1 packet`, `2 packets`."""
    return f"{number} {noun}{'s' * (number != 1)}"


def wrapped(text: str, width: int) -> str:
    """`text` with lines longer than `width` broken between words; continuation lines are indented by four more.

    Rows of tables and file names are never longer by more than one word, which is left whole.
    """
    lines = []
    for line in text.split("\n"):
        indent = " " * (len(line) - len(line.lstrip()) + 4)
        lines += textwrap.wrap(
            line, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
        ) or [""]
    return "\n".join(lines)


def _is_clip(result: FrameResult) -> bool:
    return result.frame > 0 or any(packet.burst is not None for packet in result.packets) or _goes_on(result)


def _goes_on(result: FrameResult) -> bool:
    """Whether a frame of a clip was received and all its bursts continue in the next frame."""
    return result.status == "ok" and bool(result.columns) and not result.packets


def _table_line(cells: Mapping[str, Any], clip: bool, scored: bool) -> str:
    """The cells of the packets' table that are shown, side by side."""
    hidden = (() if clip else ("time_s", "burst")) + (() if scored else ("errors",))
    shown = (
        f"{_cell(cells[key], form):{'><'[width < 0]}{abs(width)}}"
        for key, _, width, form in PACKET_TABLE
        if key not in hidden
    )
    return ("" if clip else "  ") + "  ".join(shown)


def _cell(value: Any, form: str) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    return value if isinstance(value, str) else format(value, form)


def packet_table(result: FrameResult, clip: bool, scored: bool, header: bool = True) -> list[str]:
    """One row per packet; columns without packets share a row where their reasons agree, and are left out in a clip.

    Args:
        result: of a frame.
        clip: whether it is a frame of a clip, whose packets have a time and a burst.
        scored: whether wrong bits are counted.
        header: whether titles stand above the rows, where there are any.
    """
    rows: list[str] = []
    # Columns with packets stand alone; of one reason the first is shown, whose figures are about those of the others.
    groups = groupby(result.columns, key=lambda c: c.column if c.packets else (c.status, c.reason or c.message))
    for column, *equal in (list(group) for _, group in groups):
        if column.packets:
            packets = packet_rows(replace(result, columns=(column,)))
            rows += [_table_line(_shown(packet), clip, scored) for packet in packets]
        elif not clip:
            span = f"{column.column}-{equal[-1].column}" if equal else str(column.column)
            rows.append(f"  {span:>5}  {column.status:<9}  {column.message or ''}".rstrip())
    titles = [_table_line({key: title for key, title, _, _ in PACKET_TABLE}, clip, scored)]
    return titles * (header and bool(rows)) + rows


def _shown(packet: Mapping[str, Any]) -> dict[str, Any]:
    """The row of a packet for people; confidence is rounded downwards, so that only certainty reads 1.0000."""
    confidence = packet["confidence"]
    return {
        **packet,
        "status": packet["status"] + "*" * packet["denoised"],
        "confidence": math.floor(confidence * 1e4) / 1e4 if math.isfinite(confidence * 1e4) else None,
        "payload": shorten(packet["payload"]),
    }


def shorten(payload: str) -> str:
    """The payload's first and last digits where it has more than are shown."""
    if len(payload) <= _SHOWN_DIGITS:
        return payload
    return f"{payload[: _SHOWN_DIGITS - 5]}…{payload[-4:]}"


def format_table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Text columns under a header: the first and the last one flush left, the others flush right."""
    cells = [list(header), *(list(row) for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    last = len(widths) - 1
    pad = [str.ljust if i in (0, last) else str.rjust for i in range(len(widths))]
    return "\n".join(
        "  ".join(justify(cell, width) for justify, cell, width in zip(pad, row, widths, strict=True)).rstrip()
        for row in cells
    )
