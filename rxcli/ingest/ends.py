"""Where a file of a clip ends by the sizes that its container states."""

import os
from pathlib import Path

_TS_SYNC = 0x47
#: Elements of Matroska (RFC 9559, section 5): outermost ones, and those in a segment or cluster of unknown size.
_ELEMENTS = "1a45dfa3 18538067 114d9b74 1549a966 1654ae6b 1f43b675 1c53bb6b 1254c367 ec bf e7 a3 a0 a7 ab"
_IDS = tuple(map(bytes.fromhex, _ELEMENTS.split()))
#: Parts that are counted: hours of a recording.
_MAX_PARTS = 1 << 20


def is_cut(path: Path, container: str) -> bool:
    """Whether a file ends within one of its parts; what is behind the last of them is no part of a clip.

    Args:
        path: the file.
        container: FFmpeg's name of its kind.
    """
    if container == "mpegts":
        return _ends_within_packet(path)
    size_of = box_size if "mp4" in container else _flv_tag if container == "flv" else _element
    part, length = 0, path.stat().st_size
    with path.open("rb") as file:
        for _ in range(_MAX_PARTS):
            size = size_of(file.read(16))
            if not size or part + size >= length:
                return part + size > length
            part += size
            file.seek(part)
    return False


def box_size(head: bytes) -> int:
    """Size of a box of MP4 and MOV (ISO/IEC 14496-12, section 4.2); 0: to the end of the file, or some trailer."""
    size = int.from_bytes(head[:4])
    size = int.from_bytes(head[8:]) if size == 1 else size
    return size if size >= 8 and head[4:8].isalnum() else 0


def _element(head: bytes) -> int:
    """Size of an element of Matroska (RFC 8794, sections 4 and 6), of its head alone where its size is not known."""
    n_id = next((len(known) for known in _IDS if known.startswith(head[: len(known)])), 0)
    head = head.ljust(16, b"\0")  # of one that is cut
    n_size = 9 - head[n_id].bit_length()
    size = int.from_bytes(head[n_id : n_id + n_size]) & (1 << 7 * n_size) - 1
    return n_id and n_id + n_size + (size if size + 1 < 1 << 7 * n_size else 0)


def _flv_tag(head: bytes) -> int:
    """Size of the header of an FLV file, or of a tag, with the number behind it."""
    if head.startswith(b"FLV"):
        return int.from_bytes(head[5:9]) + 4
    return 11 + int.from_bytes(head[1:4]) + 4 if head[:1] in (b"\x08", b"\x09", b"\x12") else 0


def _ends_within_packet(path: Path) -> bool:
    """Whether a transport stream ends within one of its packets (ISO/IEC 13818-1, 2.4.3.2), which begin with 0x47.

    On discs a time of four bytes stands before each, in broadcasts sixteen of correction after it.
    """
    with path.open("rb") as file:
        head, length = file.read(1024), file.seek(0, os.SEEK_END)
        for size, offset in ((188, 0), (192, 4), (204, 0)):
            if len(head) > offset + size and head[offset] == head[offset + size] == _TS_SYNC:
                file.seek(length - length % size)
                return file.read(size)[offset : offset + 1] == bytes([_TS_SYNC])
    return False
