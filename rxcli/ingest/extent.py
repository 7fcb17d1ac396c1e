"""Check whether the directories of a TIFF or RAW file are consistent with its length.

LibRaw fills the missing part of a truncated file with arbitrary values, without an error. Every library reads the data
that directories claim, however often they claim them, so a file of a megabyte can keep it busy for minutes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import suppress
from typing import BinaryIO

_SUB_DIRECTORIES, _EXIF, _GPS, _INTEROPERABILITY = 330, 34665, 34853, 40965
_POINTERS = (_SUB_DIRECTORIES, _EXIF, _GPS, _INTEROPERABILITY)
#: Offsets and lengths of the picture's strips, and of its tiles.
_PARTS = ((273, 279), (324, 325))
#: TIFF 6.0, section 2, and BigTIFF: bytes of a value by its type; struct codes of types for offsets or lengths.
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
_TYPES = {3: "H", 4: "I", 13: "I", 16: "Q", 18: "Q"}
#: No camera writes more; damaged files point in circles.
_MAX_DIRECTORIES, _MAX_ENTRIES, _MAX_VALUES_BYTES = 32, 4096, 1 << 24
#: Directories may share values; not many times over.
_SHARED_BYTES = 1 << 20
#: Magic numbers of TIFF, BigTIFF, and RAW files that differ from them by the magic only.
_CLASSIC, _BIG = (b"*\0", b"\0*", b"RO", b"RS", b"U\0", b"OR"), (b"+\0", b"\0+")

#: Type, number of values, and the field that holds them or their offset, by tag.
Directory = list[tuple[int, int, int, bytes]]
#: Stands for a directory of more entries than any has: it claims more than any file holds.
_ENDLESS = (0, 1, 1 << 62, b"")


def claims_too_much(file: BinaryIO) -> bool:
    """Whether the directories of a TIFF-like file claim more values than the file can hold; False for other files."""
    try:
        head = file.read(16)
        if head[:2] not in (b"II", b"MM") or head[2:4] not in (*_CLASSIC, *_BIG):
            return False
        length = file.seek(0, 2)
        claimed = (n * _SIZES.get(kind, 0) for entries in _directories(file, head) for _, kind, n, _ in entries)
        return sum(claimed) > length + _SHARED_BYTES
    except (OSError, OverflowError, ValueError):
        return False
    finally:
        file.seek(0)


def bytes_claimed(file: BinaryIO) -> int:
    """Minimum length in bytes of a RAW file by its own directories; 0 if they do not determine it."""
    head = file.read(128)
    if head.startswith(b"FUJIFILMCCD-RAW") and len(head) >= 108:
        offset, length = struct.unpack_from(">II", head, 100)
        return int(offset + length)
    if head[:4] in (b"II*\0", b"MM\0*"):
        return max((_end(file, directory, _order(head)) for directory in _directories(file, head)), default=0)
    return 0


def values_of(file: BinaryIO, tag: int) -> set[int]:
    """Values of a tag in all directories of a TIFF-like file."""
    head = file.read(16)
    if head[:2] not in (b"II", b"MM"):
        return set()
    return {value for entries in _directories(file, head) for value in _values(file, entries, tag, _order(head))}


def _end(file: BinaryIO, directory: Directory, order: str) -> int:
    """End of the last strip or tile of a directory, bytes."""
    values = {tag: _values(file, directory, tag, order) for pair in _PARTS for tag in pair}
    ends = [a + n for at, size in _PARTS for a, n in zip(values[at], values[size], strict=False)]
    return max(ends, default=0)


def _order(head: bytes) -> str:
    return "<" if head[:2] == b"II" else ">"


def _directories(file: BinaryIO, head: bytes) -> Iterator[Directory]:
    """The directories of a TIFF-like file, including nested ones, up to the first broken one."""
    with suppress(struct.error):
        order, big = _order(head), head[2:4] in _BIG
        count, entry, offset = (order + form for form in (("Q", "HHQ8s", "Q") if big else ("H", "HHI4s", "I")))
        waiting, visited = [(struct.unpack_from(offset, head, 8 if big else 4)[0], True)], set[int]()
        while waiting and len(visited) < _MAX_DIRECTORIES:
            at, in_chain = waiting.pop()
            if not at or at in visited:
                continue
            visited.add(at)
            file.seek(at)
            (n_entries,) = struct.unpack(count, file.read(struct.calcsize(count)))
            if n_entries > _MAX_ENTRIES:
                yield [_ENDLESS]
                continue
            directory = list(struct.iter_unpack(entry, file.read(n_entries * struct.calcsize(entry))))
            following = file.read(struct.calcsize(offset))
            yield directory
            waiting += [(place, False) for tag in _POINTERS for place in _values(file, directory, tag, order)]
            # What follows a directory of EXIF or GPS is no pointer: some cameras write none there.
            if in_chain and len(following) == struct.calcsize(offset):
                waiting.append((struct.unpack(offset, following)[0], True))


def _values(file: BinaryIO, directory: Directory, wanted: int, order: str) -> tuple[int, ...]:
    """The offsets or lengths of a tag; none where it is absent or absurd."""
    for tag, kind, n, field in directory:
        if tag == wanted and kind in _TYPES:
            form = f"{order}{n}{_TYPES[kind]}"
            size = struct.calcsize(form)
            if size > _MAX_VALUES_BYTES:
                return ()
            if size > len(field):
                file.seek(int.from_bytes(field, "little" if order == "<" else "big"))
                field = file.read(size)
            return struct.unpack(form, field[:size]) if len(field) >= size else ()
    return ()
