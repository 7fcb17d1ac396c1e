"""Results as JSON lines for programs, and back."""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import cache
from typing import Any, TypeVar, get_type_hints

from rxcli.errors import UsageError, failure_explained
from rxcli.types import ColumnResult, FrameResult, Message, ObjectProgress, PacketResult, Reason, ReceivedObject, Remark

_T = TypeVar("_T")
#: Fields of a record in their order, with the decimals that are written; None: as it is, `_SIGNIFICANT`: seven digits.
_SIGNIFICANT = -1
_FRAME = {"source": None, "frame": None, "time_s": 6, "status": None}
_COLUMN = {"column": None, "status": None, "w": None, "snr_db": 2, "denoised": None, "delay_slots": 3}
_PACKET = {"first_row": 2, "copies": 3, "payload_bits": None, "payload": None, "confidence": 6, "bit_errors": None}
_PACKET |= {"ber_hat": _SIGNIFICANT}
_OBJECT = {"name": None, "size": None, "sha256": None, "share": 4, "n_blocks": None, "object_id": None, "path": None}
_PROGRESS = {"object_id": None, "container_bytes": None, "share": 4, "n_blocks": None, "blocks_done": None}
_PROGRESS |= {"seconds_left": 2}
#: Fields of a result that stand with its screen.
_OF_SCREEN = ("inferred_sides", "column_certainty", "column_offset", "mirrored", "quarter_turns")


def to_record(result: FrameResult) -> dict[str, Any]:
    """The result as plain data in the order of the documented JSON shape; unknown or non-finite values are None."""
    record = _written(result, _FRAME) | _present(result, "reason", "message")
    corners = [] if result.corners is None else [[_rounded(x, 2) for x in corner] for corner in result.corners.tolist()]
    record["screen"] = {"profile": result.screen_profile, "corners": corners or None, **_numbering(result)}
    record["camera"] = {
        "profile": result.camera_profile,
        **_written(result, {"line_delay_s": _SIGNIFICANT, "exposure_s": _SIGNIFICANT}),
    }
    record["columns"] = [
        _written(column, _COLUMN)
        | {"packets": [_written(p, _PACKET) | _present(p, "burst", "frames") for p in column.packets]}
        | _present(column, "reason", "message")
        for column in result.columns
    ]
    record["timing_ms"] = {stage: _rounded(value, 2) for stage, value in result.timing_ms.items()}
    return record | _details(result)


def to_json_line(result: FrameResult) -> str:
    """The result as one line of JSON, without the line's end; ASCII, so that any file name survives."""
    return json.dumps(to_record(result), allow_nan=False, separators=(", ", ": "))


def _details(result: FrameResult) -> dict[str, Any]:
    """Optional parts of a record, present only if they are not empty."""
    details = {
        "other_screens": [to_record(screen) for screen in result.other_screens],
        "estimated": result.estimated,
        "skipped": result.skipped,
        "denoiser": result.denoiser,
        "messages": [
            {"kind": m.kind, **_present(m, "text"), "hex": m.data.hex()} | ({"photos": m.photos} if m.photos else {})
            for m in result.messages
        ],
        "objects": [_blocks(_written(received, _OBJECT)) for received in result.objects],
        "objects_incomplete": [_blocks(_written(progress, _PROGRESS)) for progress in result.progress],
        "link_notes": list(result.link_notes),
        "retry": result.retry,
    }
    return {name: plain(value) for name, value in details.items() if value}


def _blocks(record: dict[str, Any]) -> dict[str, Any]:
    return {"blocks" if name == "n_blocks" else name: value for name, value in record.items()}


def _numbering(result: FrameResult) -> dict[str, Any]:
    """Optional parts of a screen's place, present only where they differ from those of a screen in plain view."""
    usual = {"inferred_sides": [], "column_certainty": 1, "column_offset": 0, "quarter_turns": 0, "mirrored": False}
    found = {name: getattr(result, name) for name in usual}
    found["inferred_sides"] = list(result.inferred_sides)
    found["column_certainty"] = _rounded(result.column_certainty, 4)
    return {name: value for name, value in found.items() if value != usual[name]}


def _written(value: Any, digits: Mapping[str, int | None]) -> dict[str, Any]:
    """Fields of a dataclass as they are written."""
    values = ((name, n, getattr(value, name, 1.0)) for name, n in digits.items())
    return {name: plain(item) if n in (None, _SIGNIFICANT) else _rounded(item, n) for name, n, item in values}


def _present(value: Any, *names: str) -> dict[str, Any]:
    """Fields of a dataclass that are known."""
    return {name: plain(getattr(value, name)) for name in names if getattr(value, name) is not None}


def _rounded(value: float | None, digits: int) -> float | None:
    if value is None or not math.isfinite(value):
        return None
    return round(float(value), digits) + 0.0  # no negative zero


def plain(value: Any) -> Any:
    """`value` with numpy's scalars and arrays as Python's, floats of seven digits, and what is not finite as None."""
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.7g}") if math.isfinite(value) else None
    return value


def from_record(record: dict[str, Any]) -> FrameResult:
    """The result that `to_record` wrote, as far as its rounding goes.

    Raises:
        UsageError: `record` is not of the documented shape.
    """
    import numpy as np

    with failure_explained("not a result line of `vlc-rx decode --json`", "name another file", UsageError):
        screen, camera, corners = record["screen"], record["camera"], record["screen"]["corners"]
        place = {name: record[name] for name in ("source", "frame", "time_s")}
        about = {name: screen[name] for name in _OF_SCREEN if name in screen}
        about |= {"screen_profile": screen["profile"], "camera_profile": camera["profile"]}
        about |= {name: camera[name] for name in ("line_delay_s", "exposure_s")}
        about["timing_ms"] = {stage: _number(value) for stage, value in record["timing_ms"].items()}
        about["estimated"] = {name: [*map(_number, pair)] for name, pair in record.get("estimated", {}).items()}
        files = [{**o, **place, "n_blocks": o["blocks"]} for o in record.get("objects", ())]
        under_way = [{**p, "n_blocks": p["blocks"]} for p in record.get("objects_incomplete", ())]
        messages = [_read(m, Message, data=bytes.fromhex(m["hex"]), **place) for m in record.get("messages", ())]
        return _read(
            {**record, **about},
            FrameResult,
            corners=None if corners is None else np.array(corners, dtype=np.float64).reshape(4, 2),
            columns=tuple(map(_column, record["columns"])),
            remarks=tuple(filter(None, (_remark(record),))),
            other_screens=tuple(map(from_record, record.get("other_screens", ()))),
            messages=tuple(messages),
            objects=tuple(_read(file, ReceivedObject, data=b"") for file in files),
            progress=tuple(_read(file, ObjectProgress) for file in under_way),
            retry=record.get("retry") is True,
        )


def _column(record: dict[str, Any]) -> ColumnResult:
    return _read(record, ColumnResult, packets=tuple(map(_packet, record["packets"])), remark=_remark(record))


def _remark(record: dict[str, Any]) -> Remark | None:
    """The reason of a frame or a column; what was measured of it stands in the message alone."""
    import msgspec

    reason = record.get("reason")
    return None if reason is None else Remark(msgspec.convert(reason, Reason))


def _packet(record: dict[str, Any]) -> PacketResult:
    packet = _read(record, PacketResult)
    if len(packet.payload_bytes) != -(-packet.payload_bits // 8):
        raise ValueError("payload and payload_bits disagree")
    return packet


def _read(record: dict[str, Any], kind: Callable[..., _T], **known: Any) -> _T:
    """A dataclass of the fields of a record by name; null is NaN where a number must stand."""
    import msgspec

    for field, hint in _hints(kind).items():
        if field not in known and field in record:
            value = record[field]
            if isinstance(value, int) and abs(value) >= 1 << 63:
                raise ValueError(f"{field} is too large")
            known[field] = _number(value) if hint is float else msgspec.convert(value, hint)
    return kind(**known)


@cache
def _hints(kind: Any) -> dict[str, Any]:
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in fields(kind)}


def _number(value: Any) -> float:
    if not isinstance(value, (int, float, type(None))):
        raise TypeError(f"{value!r:.60} is no number")
    return math.nan if value is None else float(value)
