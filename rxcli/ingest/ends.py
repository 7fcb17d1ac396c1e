"""Where a file of a clip ends by the sizes that its container states."""

import os
from pathlib import Path

_TS_SYNC = 0x47
_EBML, _SEGMENT = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"


def is_cut(path: Path, container: str) -> bool:
    """Whether a file ends within one of its outermost parts; what is behind the last of them is no part of a clip.

    Args:
        path: the file.
        container: FFmpeg's name of its kind.
    """
    if container == "mpegts":
        return _ends_within_packet(path)
    size_of = box_size if "mp4" in container else _element
    part, length = 0, path.stat().st_size
    with path.open("rb") as file:
        while part < length and (size := size_of(file.read(16))):
            part += size
            file.seek(min(part, length))
    return part > length


def box_size(head: bytes) -> int:
    """Size of a box of MP4 and MOV (ISO/IEC 14496-12, section 4.2); 0: to the end of the file, or some trailer."""
    size = int.from_bytes(head[:4])
    size = int.from_bytes(head[8:]) if size == 1 else size
    return size if size >= 8 and head[4:8].isalnum() else 0


def _element(head: bytes) -> int:
    """Size of an outermost element of Matroska (RFC 8794, sections 4 and 6); 0 where it is not known."""
    if not head.startswith((_EBML, _SEGMENT)) or len(head) < 16:
        return 0
    length = 9 - head[4].bit_length()
    size = int.from_bytes(head[4 : 4 + length]) & (1 << 7 * length) - 1
    return 4 + length + size if size + 1 < 1 << 7 * length else 0


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
