"""What GoPro's clips state of the readout of their sensor, in GPMF (github.com/gopro/gpmf-parser).

It lies in a track of the clip, of cameras since HERO8 in a box of its header: entries of a key, a type, size and number
of values, and the values, filled up to four bytes.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from rxcli.ingest.ends import box_size

#: Name of the track; key of the readout, a number of single precision, milliseconds; type of nested entries.
_TRACK, _READOUT, _FLOAT, _NESTED = "GoPro MET", b"SROT", ord("f"), 0
_ENTRY = struct.Struct(">4sBBH")
#: Boxes of an MP4 file, from the outermost, and the longest contents that are read.
_BOXES, _MAX_BYTES = (b"moov", b"udta", b"GPMF"), 1 << 20


def stated_readout_s(path: Path, container: Any) -> float | None:
    """Readout that a clip states, seconds; None where it states none.

    Args:
        path: of the clip.
        container: the opened clip, at its beginning.
    """
    tracks = [s.index for s in container.streams.data if s.metadata.get("handler_name", "").strip() == _TRACK]
    if not tracks:
        return None
    in_track = next((bytes(packet) for packet in container.demux(tracks) if packet.size), b"")
    container.seek(0)
    with path.open("rb") as file:
        return next((found / 1000 for data in (in_track, _header(file)) for found in _readouts(data)), None)


def _readouts(data: bytes) -> Iterator[float]:
    place = 0
    while place + _ENTRY.size <= len(data):
        key, kind, size, count = _ENTRY.unpack_from(data, place)
        place += _ENTRY.size
        if kind == _NESTED:  # its entries follow
            continue
        if (key, kind, size) == (_READOUT, _FLOAT, 4) and place + size <= len(data):
            yield struct.unpack_from(">f", data, place)[0]
        place += -(-size * count // 4) * 4


def _header(file: BinaryIO) -> bytes:
    """Contents of the box of GPMF in an MP4 file's header, empty where there is none."""
    place, end, names = 0, file.seek(0, 2), list(_BOXES)
    while names and place < end:
        file.seek(place)
        head = file.read(16)
        if not (size := box_size(head)):
            return b""
        if head[4:8] == names[0]:
            names.pop(0)
            place, end = place + (16 if head[:4] == b"\0\0\0\1" else 8), min(place + size, end)
        else:
            place += size
    file.seek(place)
    return b"" if names else file.read(min(end - place, _MAX_BYTES))
