"""Whether the directories of a TIFF or RAW file are those of a whole file.

LibRaw fills what a cut file lacks with anything and says nothing, or writes to stderr; and every library reads what
directories claim as often as they claim it, so that a megabyte can keep it busy for minutes. So this is asked before.
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
#: TIFF 6.0, section 2, and BigTIFF: bytes of a value by its type.
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
_MAX_ENTRIES = 4096
#: Directories may share values; not many times over.
_SHARED_BYTES = 1 << 20
_POINTERS = (_SUB_DIRECTORIES, 34665, 34853, 40965)
#: Magic numbers of TIFF, BigTIFF, and RAW files that differ from them by the magic only.
_CLASSIC, _BIG = (b"*\0", b"\0*", b"RO", b"RS", b"U\0", b"OR"), (b"+\0", b"\0+")

Directory = dict[int, tuple[int, ...]]


def claims_too_much(file: BinaryIO) -> bool:
    """Whether the directories of a TIFF-like file claim more values than the file can hold; False for other files."""
    try:
        head = file.read(16)
        if head[:2] not in (b"II", b"MM") or head[2:4] not in (*_CLASSIC, *_BIG):
            return False
        length = file.seek(0, 2)
        return _Claims(file, "<" if head[:2] == b"II" else ">", head[2:4] in _BIG).total(head) > length + _SHARED_BYTES
    except (struct.error, OSError, OverflowError, ValueError):
        return False
    finally:
        file.seek(0)


class _Claims:
    """Adds up the bytes of all values that the directories of a file point to."""

    def __init__(self, file: BinaryIO, order: str, big: bool) -> None:
        self._file = file
        self._count, self._entry, self._next = ("Q", "HHQQ", "Q") if big else ("H", "HHII", "I")
        self._count, self._entry, self._next = order + self._count, order + self._entry, order + self._next
        self._first_at = 8 if big else 4

    def total(self, head: bytes) -> float:
        """Bytes claimed; infinity where a directory has more entries than any has."""
        first = struct.unpack_from(self._next, head, self._first_at)[0]
        waiting, seen, claimed = [(first, True)], set[int](), 0
        while waiting and len(seen) < _MAX_DIRECTORIES:
            at, in_chain = waiting.pop()
            if not at or at in seen:
                continue
            seen.add(at)
            self._file.seek(at)
            (count,) = struct.unpack(self._count, self._file.read(struct.calcsize(self._count)))
            if count > _MAX_ENTRIES:
                return float("inf")
            entries = self._file.read(count * struct.calcsize(self._entry))
            for tag, kind, n, value in struct.iter_unpack(self._entry, entries):
                claimed += n * _SIZES.get(kind, 0)
                waiting += [(value, False)] if tag in _POINTERS and n == 1 else []
            following = self._file.read(struct.calcsize(self._next))
            # What follows a directory of EXIF or GPS is no pointer: some cameras write none there.
            if in_chain and len(following) == struct.calcsize(self._next):
                waiting.append((struct.unpack(self._next, following)[0], True))
        return claimed


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
        if tag in wanted and kind in _TYPES and tag not in found:
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
