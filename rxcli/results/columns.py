"""What a frame brought, as plain data: the rows and columns that the terminal, `--payloads` and the pages show."""

import base64
from typing import Any

from rxcli.types import FrameResult

#: Columns of the packets' table on the terminal: key of `packet_rows`, title, width, format; one of negative width is
#: flush left. Time and burst belong to clips, errors to packets that are compared with the truth.
PACKET_TABLE = (
    ("time_s", "time s", 9, ".3f"),
    ("burst", "burst", 5, "d"),
    ("column", "col", 5, "d"),
    ("status", "status", -9, ""),
    ("w", "w", 1, "d"),
    ("snr_db", "snr dB", 6, ".1f"),
    ("confidence", "confidence", 10, ".4f"),
    ("copies", "copies", 6, ".2f"),
    ("errors", "errors", 6, "d"),
    ("payload", "payload", 0, ""),
)
#: Columns of `--payloads`: title -> key of `packet_rows`.
PAYLOAD_TABLE = {name: name for name in ("source", "frame", "column", "burst")}
PAYLOAD_TABLE |= {"bits": "payload_bits", "hex": "payload", "confidence": "confidence"}


def packet_rows(result: FrameResult) -> list[dict[str, Any]]:
    """Every packet of a frame as plain data, by column and in time order.

    `status` is `weak` below the confidence that can be believed; `burst` and `errors` are None where nobody knows them.
    """
    return [
        {
            **{name: getattr(result, name) for name in ("frame", "time_s")},
            **{name: getattr(column, name) for name in ("column", "denoised", "w", "snr_db")},
            **{name: getattr(packet, name) for name in ("burst", "confidence", "copies", "payload_bits", "payload")},
            "status": "ok" if packet.is_believable else "weak",
            "errors": packet.bit_errors,
        }
        for column in result.columns
        for packet in column.packets
    ]


def text_rows(result: FrameResult) -> list[dict[str, Any]]:
    """Texts and files that are complete with a frame."""
    texts = [{"kind": message.kind, "text": message.text or message.data.hex()} for message in result.messages]
    files = [
        {"kind": "file", "name": o.name, "size": o.size, "base64": base64.b64encode(o.data).decode()}
        for o in result.objects
    ]
    return texts + files


def column_rows(result: FrameResult) -> list[dict[str, Any]]:
    """What became of every column, without its packets."""
    return [{"column": c.column, "status": c.status, "message": c.message} for c in result.columns]
