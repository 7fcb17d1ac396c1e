"""Results as JSON lines for programs and as tables for people."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Callable, Iterable
from itertools import groupby
from typing import Any, TypeVar, get_args

from rxcli.errors import UsageError, capitalised
from rxcli.types import (
    ColumnResult,
    ColumnStatus,
    FrameResult,
    FrameStatus,
    Message,
    ObjectProgress,
    PacketResult,
    ReceivedObject,
)

_T = TypeVar("_T")
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


def to_record(result: FrameResult) -> dict[str, Any]:
    """The result as plain data in the order of the documented JSON shape; unknown or non-finite values are None."""
    record: dict[str, Any] = {
        "source": result.source,
        "frame": int(result.frame),
        "time_s": _rounded(result.time_s, 6),
        "status": result.status,
    }
    if result.message is not None:
        record["message"] = result.message
    record["screen"] = {"profile": result.screen_profile, "corners": _corners(result), **_numbering(result)}
    record["camera"] = {
        "profile": result.camera_profile,
        "line_delay_s": _significant(result.line_delay_s),
        "exposure_s": _significant(result.exposure_s),
    }
    record["columns"] = [_column_record(column) for column in result.columns]
    record["timing_ms"] = {stage: _rounded(value, 2) for stage, value in result.timing_ms.items()}
    return record | _details(result)


def _details(result: FrameResult) -> dict[str, Any]:
    """The parts of a record that stand only where there is something to say."""
    details: dict[str, Any] = {}
    if result.estimated:
        details["estimated"] = {
            name: [_significant(value), _significant(sigma)] for name, (value, sigma) in result.estimated.items()
        }
    if result.skipped:
        details["skipped"] = plain(result.skipped)
    if result.denoiser is not None:
        details["denoiser"] = plain(result.denoiser)
    if result.messages:
        details["messages"] = [_message_record(message) for message in result.messages]
    if result.objects:
        details["objects"] = [_object_record(received) for received in result.objects]
    if result.progress:
        details["objects_incomplete"] = [_progress_record(progress) for progress in result.progress]
    if result.link_notes:
        details["link_notes"] = list(result.link_notes)
    if result.retry:
        details["retry"] = True
    return details


def _message_record(message: Message) -> dict[str, Any]:
    record: dict[str, Any] = {"kind": message.kind}
    if message.text is not None:
        record["text"] = message.text
    return record | {"hex": message.data.hex()}


def _object_record(received: ReceivedObject) -> dict[str, Any]:
    return {
        "name": received.name,
        "size": received.size,
        "sha256": received.sha256,
        "share": 1.0,
        "blocks": received.n_blocks,
        "object_id": received.object_id,
        "path": received.path,
    }


def _progress_record(progress: ObjectProgress) -> dict[str, Any]:
    return {
        "object_id": progress.object_id,
        "container_bytes": progress.container_bytes,
        "share": _rounded(progress.share, 4),
        "blocks": progress.n_blocks,
        "blocks_done": progress.blocks_done,
        "seconds_left": _rounded(progress.seconds_left, 2),
    }


def _place_of(record: dict[str, Any]) -> tuple[str, int, float]:
    return str(record["source"]), int(record["frame"]), _number(record["time_s"])


def _messages_from(record: dict[str, Any]) -> tuple[Message, ...]:
    place = _place_of(record)
    return tuple(Message(m["kind"], bytes.fromhex(m["hex"]), *place) for m in record.get("messages", ()))


def _objects_from(record: dict[str, Any]) -> tuple[ReceivedObject, ...]:
    place = _place_of(record)
    return tuple(
        ReceivedObject(o["name"], b"", o["size"], o["sha256"], o["object_id"], o["blocks"], *place, o["path"])
        for o in record.get("objects", ())
    )


def _progress_from(record: dict[str, Any]) -> tuple[ObjectProgress, ...]:
    return tuple(
        ObjectProgress(
            p["object_id"], p["container_bytes"], p["blocks"], p["blocks_done"], p["share"], p["seconds_left"]
        )
        for p in record.get("objects_incomplete", ())
    )


def format_link(result: FrameResult) -> list[str]:
    """What came through the link layer with a frame, one line each, for people."""
    lines = format_received(result)
    lines += [format_progress(progress) for progress in result.progress]
    return lines + [f"note: {printable(note)}" for note in result.link_notes]


def format_received(result: FrameResult) -> list[str]:
    """Texts and files that are complete with a frame, one line each."""
    return [*map(_message_line, result.messages), *map(format_object, result.objects)]


def _message_line(message: Message) -> str:
    if message.text is None:
        return f"bytes: {message.data.hex()}"
    return f"{message.kind}: {printable(message.text)}"


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


def _numbering(result: FrameResult) -> dict[str, Any]:
    """What is not plain of the screen's place: sides that were inferred, and which column is which."""
    out: dict[str, Any] = {}
    if result.inferred_sides:
        out["inferred_sides"] = list(result.inferred_sides)
    if result.column_certainty < 1:
        out["column_certainty"] = _rounded(result.column_certainty, 4)
    if result.column_offset is None:
        out["column_offset"] = None
    if result.mirrored is not False:
        out["mirrored"] = result.mirrored
    return out


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


def _corners(result: FrameResult) -> list[list[float | None]] | None:
    if result.corners is None:
        return None
    return [[_rounded(float(x), 2), _rounded(float(y), 2)] for x, y in result.corners]


def _column_record(column: ColumnResult) -> dict[str, Any]:
    record: dict[str, Any] = {
        "column": int(column.column),
        "status": column.status,
        "w": None if column.w is None else int(column.w),
        "snr_db": _rounded(column.snr_db, 2),
        "denoised": bool(column.denoised),
        "delay_slots": _rounded(column.delay_slots, 3),
        "packets": [_packet_record(packet) for packet in column.packets],
    }
    if column.message is not None:
        record["message"] = column.message
    return record


def _packet_record(packet: PacketResult) -> dict[str, Any]:
    record: dict[str, Any] = {
        "first_row": _rounded(packet.first_row, 2),
        "copies": _rounded(packet.copies, 3),
        "payload_bits": int(packet.payload_bits),
        "payload": packet.payload,
        "confidence": _rounded(packet.confidence, 6),
        "bit_errors": None if packet.bit_errors is None else int(packet.bit_errors),
        "ber_hat": _significant(packet.ber_hat),
    }
    if packet.burst is not None:
        record["burst"] = int(packet.burst)
    if packet.frames is not None:
        record["frames"] = [int(frame) for frame in packet.frames]
    return record


def _rounded(value: float | None, digits: int) -> float | None:
    if value is None or not math.isfinite(value):
        return None
    return round(float(value), digits) + 0.0  # no negative zero


def _significant(value: float | None) -> float | None:
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.7g}")


def plain(value: Any) -> Any:
    """`value` with numpy's scalars and arrays as Python's, and what is not finite as None."""
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return _significant(value)
    return value


def to_json_line(result: FrameResult) -> str:
    """The result as one line of JSON, without the line's end; ASCII, so that any file name survives."""
    return json.dumps(to_record(result), allow_nan=False, separators=(", ", ": "))


def from_record(record: dict[str, Any]) -> FrameResult:
    """The result that `to_record` wrote, as far as its rounding goes.

    Raises:
        UsageError: `record` is not of the documented shape.
    """
    import numpy as np

    try:
        corners, camera = record["screen"]["corners"], record["camera"]
        return FrameResult(
            source=_text(record["source"]),
            frame=_count(record["frame"]),
            time_s=_number(record["time_s"]),
            status=_one_of(record["status"], FrameStatus),
            message=_unless_none(_text, record.get("message")),
            screen_profile=_unless_none(_text, record["screen"]["profile"]),
            corners=None if corners is None else np.array(corners, dtype=np.float64).reshape(4, 2),
            inferred_sides=tuple(str(side) for side in record["screen"].get("inferred_sides", ())),
            column_certainty=float(record["screen"].get("column_certainty", 1.0)),
            column_offset=record["screen"].get("column_offset", 0),
            mirrored=record["screen"].get("mirrored", False),
            camera_profile=_unless_none(_text, camera["profile"]),
            line_delay_s=_unless_none(_number, camera["line_delay_s"]),
            exposure_s=_unless_none(_number, camera["exposure_s"]),
            estimated={name: (_number(v), _number(s)) for name, (v, s) in record.get("estimated", {}).items()},
            columns=tuple(_column_from(column) for column in record["columns"]),
            timing_ms={stage: _number(value) for stage, value in record["timing_ms"].items()},
            skipped={name: _count(value) for name, value in record.get("skipped", {}).items()},
            denoiser=_unless_none(dict, record.get("denoiser")),
            messages=_messages_from(record),
            objects=_objects_from(record),
            progress=_progress_from(record),
            link_notes=tuple(str(note) for note in record.get("link_notes", ())),
            retry=record.get("retry") is True,
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        shown = f"{error!r:.200}"
        raise UsageError(f"not a result line of `vlc-rx decode --json` ({shown})", "name another file") from None


def _column_from(record: dict[str, Any]) -> ColumnResult:
    return ColumnResult(
        column=_count(record["column"]),
        status=_one_of(record["status"], ColumnStatus),
        w=_unless_none(_count, record["w"]),
        snr_db=_unless_none(_number, record["snr_db"]),
        denoised=bool(record["denoised"]),
        delay_slots=_unless_none(_number, record["delay_slots"]),
        packets=tuple(_packet_from(packet) for packet in record["packets"]),
        message=_unless_none(_text, record.get("message")),
    )


def _packet_from(record: dict[str, Any]) -> PacketResult:
    frames = record.get("frames")
    if len(_text(record["payload"])) != 2 * -(-_count(record["payload_bits"]) // 8):
        raise ValueError("payload and payload_bits disagree")
    return PacketResult(
        first_row=_number(record["first_row"]),
        copies=_number(record["copies"]),
        payload_bits=_count(record["payload_bits"]),
        payload=_hex(record["payload"]),
        confidence=_number(record["confidence"]),
        ber_hat=_number(record["ber_hat"]),
        bit_errors=_unless_none(_count, record["bit_errors"]),
        burst=_unless_none(_count, record.get("burst")),
        frames=None if frames is None else tuple(_count(frame) for frame in frames),
    )


def _number(value: float | None) -> float:
    if not isinstance(value, (int, float, type(None))):
        raise TypeError(f"{value!r:.60} is no number")
    return math.nan if value is None else float(value)


def _count(value: Any) -> int:
    if not isinstance(value, int) or abs(value) >= 1 << 63:
        raise TypeError(f"{value!r:.60} is no count")
    return value


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r:.60} is no text")
    return value


def _hex(value: Any) -> str:
    return bytes.fromhex(_text(value)).hex()


def _one_of(value: Any, choices: Any) -> Any:
    if value not in get_args(choices):
        raise ValueError(f"{value!r:.60} is none of {', '.join(get_args(choices))}")
    return value


def _unless_none(convert: Callable[[Any], _T], value: Any) -> _T | None:
    return None if value is None else convert(value)


def csv_cell(value: Any) -> Any:
    """`value` so that a spreadsheet takes it for text, not for a formula (OWASP, CSV injection)."""
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA_STARTS) else value


def printable(text: str) -> str:
    """`text` in one line that any terminal takes: other characters are escaped, `\\xff` is a byte that is no UTF-8."""
    return "".join(character if character.isprintable() else _escape(character) for character in text)


def _escape(character: str) -> str:
    code = ord(character)
    if 0xDC80 <= code <= 0xDCFF:  # a byte of a file name (PEP 383)
        return f"\\x{code - 0xDC00:02x}"
    return {"\n": "\\n", "\r": "\\r", "\t": "\\t"}.get(character) or (
        f"\\u{code:04x}" if code < 1 << 16 else f"\\U{code:08x}"
    )


def printable_name(name: str) -> str:
    """The name of a file as `printable`, with backslashes doubled, so that it can be told what the name was."""
    return printable(name.replace("\\", "\\\\"))


#: What makes a spreadsheet compute a cell.
_FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r")


def format_frame(result: FrameResult) -> str:
    """A heading and one row per packet; columns without packets are put together where they tell the same."""
    lines = [format_heading(result)]
    note = mirror_note(result, "--mirrored")
    if note:
        lines.append(f"  {note}")
    if result.message:
        lines.append(f"  {printable(result.message.removeprefix(result.source + ': '))}")
    clip = _is_clip(result)
    scored = any(packet.bit_errors is not None for packet in result.packets)
    rows = table_rows(result, clip, scored)
    if rows:
        lines += [table_header(clip, scored), *rows]
    return "\n".join(lines)


def format_heading(result: FrameResult) -> str:
    """Source, screen, camera, status and counts in one line."""
    parts = [printable_name(result.source)]
    if _is_clip(result):
        parts.append(f"frame {result.frame} at {result.time_s:.3f} s")
    parts.append(result.status)
    if result.screen_profile:
        parts.append(f"screen {result.screen_profile}")
    if result.status != "unreadable":
        parts.append(f"camera {result.camera_profile or 'unknown'}")
    if result.columns:
        parts.append(_counts(result))
    if "total" in result.timing_ms:
        parts.append(f"{result.timing_ms['total']:.0f} ms")
    return " | ".join(parts)


def _counts(result: FrameResult) -> str:
    if _goes_on(result):
        return "its packets end in later frames"
    n_received = sum(packet.is_believable for packet in result.packets)
    return f"{count_packets(n_received, len(result.packets) - n_received)} ({plural(len(result.columns), 'column')})"


def headline(result: FrameResult) -> str:
    """What became of a frame, in a few words."""
    if not result.packets:
        return _STATUS[result.status]
    n_received = sum(packet.is_believable for packet in result.packets)
    return capitalised(count_packets(n_received, len(result.packets) - n_received))


def count_packets(n_received: int, n_unsure: int) -> str:
    """The packets of a photo, a clip or a run: those that can be believed, and the rest apart.

    Args:
        n_received: packets that are believable, see `rxcli.types.BELIEVABLE`.
        n_unsure: packets of lower confidence.
    """
    received = f"{plural(n_received, 'packet')} received" if n_received else "no packet received"
    return f"{received}, {n_unsure} unsure" if n_unsure else received


def result_in_words(result: FrameResult) -> str:
    """What was done for a frame, in one line: screen, camera, time by stage, what was left out."""
    parts = [f"{printable_name(result.source)} frame {result.frame}: {result.status}"]
    if result.corners is not None:
        parts.append("screen at " + " ".join(f"{x:.0f},{y:.0f}" for x, y in result.corners))
    if result.line_delay_s:
        known = result.camera_profile or "estimated"
        parts.append(f"camera {known}: {result.line_delay_s * 1e6:.4g} us a row")
    if result.columns:
        parts.append(_counts(result))
    parts += [f"{stage} {value:.0f} ms" for stage, value in result.timing_ms.items()]
    parts += [f"left out: {name} {count}" for name, count in result.skipped.items()]
    if result.denoiser:
        parts.append(f"auto-encoder: {plain(result.denoiser)}")
    return "; ".join(parts)


def plural(number: int, noun: str) -> str:
    """`1 packet`, `2 packets`."""
    return f"{number} {noun}{'s' * (number != 1)}"


def wrapped(text: str, width: int) -> str:
    """`text` with lines longer than `width` broken between words; those that follow are indented by as much and four.

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
    """Whether a frame of a clip was received, and all its bursts go on in the next."""
    return result.status == "ok" and bool(result.columns) and not result.packets


def table_header(clip: bool, scored: bool) -> str:
    """Header of `table_rows`."""
    start = "   time s  burst" if clip else ""
    return f"{start}    col  status     w  snr dB  confidence  copies{'  errors' * scored}  payload"


def table_rows(result: FrameResult, clip: bool, scored: bool) -> list[str]:
    """One row per packet; columns without packets share a row where their reasons agree, and are left out in a clip.

    Args:
        result: of a frame.
        clip: whether it is a frame of a clip, whose packets have a time and a burst.
        scored: whether wrong bits are counted.
    """
    rows: list[str] = []
    for _, group in groupby(result.columns, key=_row_key):
        columns = list(group)
        if columns[0].packets:
            start = f"{result.time_s:9.3f}  " if clip else ""
            rows += [_packet_row(columns[0], packet, start, clip, scored) for packet in columns[0].packets]
        elif not clip:
            rows.append(_empty_row(columns))
    return rows


def _row_key(column: ColumnResult) -> tuple[str, str | None] | int:
    """Equal for columns without packets that share a row; the column's number where it has packets."""
    return column.column if column.packets else (column.status, column.message)


def _empty_row(columns: list[ColumnResult]) -> str:
    first, last = columns[0].column, columns[-1].column
    span = str(first) if first == last else f"{first}-{last}"
    return f"  {span:>5}  {columns[0].status:<9}  {columns[0].message or ''}".rstrip()


def _packet_row(column: ColumnResult, packet: PacketResult, start: str, clip: bool, scored: bool) -> str:
    status = ("ok" if packet.is_believable else "weak") + "*" * column.denoised
    burst = f"{_cell(packet.burst, 'd'):>5}" if clip else ""
    errors = f"  {_cell(packet.bit_errors, 'd'):>6}" if scored else ""
    return (
        f"{start}{burst}  {column.column:>5}  {status:<9}  {_cell(column.w, 'd'):>1}  {_cell(column.snr_db, '.1f'):>6}"
        f"  {_confidence(packet.confidence):>10}  {_cell(packet.copies, '.2f'):>6}{errors}  {shorten(packet.payload)}"
    )


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None or not math.isfinite(value) else format(value, form)


def _confidence(value: float) -> str:
    """Rounded downwards, so that only certainty reads 1.0000."""
    return _cell(math.floor(value * 1e4) / 1e4 if math.isfinite(value * 1e4) else None, ".4f")


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
