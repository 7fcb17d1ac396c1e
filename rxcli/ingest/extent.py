"""Whether a RAW file is as long as its own directories say.

LibRaw fills what a cut file lacks with anything and says nothing, or writes to stderr; so this is asked before.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import BinaryIO

_STRIP_OFFSETS, _STRIP_COUNTS, _SUB_DIRECTORIES, _TILE_OFFSETS, _TILE_COUNTS = 273, 279, 330, 324, 325
#: TIFF 6.0, section 2: type -> struct code; others hold no offsets.
_TYPES = {3: "H", 4: "I", 13: "I"}
#: No camera writes more; damaged files point in circles.
_MAX_DIRECTORIES = 32
_MAX_VALUES_BYTES = 1 << 24

Directory = dict[int, tuple[int, ...]]


def bytes_claimed(file: BinaryIO) -> int:
    """The least length in bytes that a RAW file must have, by its own directories; 0 where they do not tell."""
    head = file.read(128)
    try:
        if head.startswith(b"FUJIFILMCCD-RAW"):
            offset, length = struct.unpack_from(">II", head, 100)
            return int(offset + length)
        if head[:4] in (b"II*\0", b"MM\0*"):
            return max((_end(directory) for directory in _directories(file, head)), default=0)
    except struct.error:
        return 0
    return 0


def _end(directory: Directory) -> int:
    pairs = ((_STRIP_OFFSETS, _STRIP_COUNTS), (_TILE_OFFSETS, _TILE_COUNTS))
    ends = [a + n for at, size in pairs for a, n in zip(directory.get(at, ()), directory.get(size, ()), strict=False)]
    return max(ends, default=0)


def _directories(file: BinaryIO, head: bytes) -> Iterator[Directory]:
    order = "<" if head[:2] == b"II" else ">"
    waiting, seen = [struct.unpack_from(order + "I", head, 4)[0]], set[int]()
    while waiting and len(seen) < _MAX_DIRECTORIES:
        at = waiting.pop()
        if at and at not in seen:
            seen.add(at)
            directory, following = _directory(file, at, order)
            waiting += [following, *directory.get(_SUB_DIRECTORIES, ())]
            yield directory


def _directory(file: BinaryIO, at: int, order: str) -> tuple[Directory, int]:
    """The entries that hold offsets, and where the next directory starts."""
    file.seek(at)
    (count,) = struct.unpack(order + "H", file.read(2))
    entries = file.read(12 * count)
    (following,) = struct.unpack(order + "I", file.read(4))
    wanted = (_STRIP_OFFSETS, _STRIP_COUNTS, _SUB_DIRECTORIES, _TILE_OFFSETS, _TILE_COUNTS)
    found: Directory = {}
    for start in range(0, len(entries), 12):
        tag, kind, n = struct.unpack_from(order + "HHI", entries, start)
        if tag in wanted and kind in _TYPES:
            found[tag] = _values(file, entries[start + 8 : start + 12], f"{order}{n}{_TYPES[kind]}", order)
    return found, following


def _values(file: BinaryIO, field: bytes, form: str, order: str) -> tuple[int, ...]:
    size = struct.calcsize(form)
    if size > _MAX_VALUES_BYTES:
        return ()
    if size > len(field):
        file.seek(struct.unpack(order + "I", field)[0])
        field = file.read(size)
    return struct.unpack(form, field[:size])
