"""The directories of a TIFF or RAW file, or of an EXIF block: their tags, and whether they fit the file's length.

LibRaw fills the missing part of a truncated file with arbitrary values, without an error. Every library reads the data
that directories claim, however often they claim them, so a file of a megabyte can keep it busy for minutes.
"""

import struct
from contextlib import suppress
from math import nan
from typing import Any, BinaryIO

_SUB_DIRECTORIES, _EXIF, _GPS, _INTEROPERABILITY = 330, 34665, 34853, 40965
_POINTERS = (_SUB_DIRECTORIES, _EXIF, _GPS, _INTEROPERABILITY)
#: Offsets and lengths of the picture's strips, and of its tiles.
_PARTS = ((273, 279), (324, 325))
#: TIFF 6.0, section 2, and BigTIFF: bytes of a value by its type; struct codes of types for offsets or lengths.
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
_TYPES = {3: "H", 4: "I", 13: "I", 16: "Q", 18: "Q"}
#: The same of all numbers, and of pairs of integers, which are fractions.
_NUMBERS, _FRACTIONS = _TYPES | {6: "b", 8: "h", 9: "i", 11: "f", 12: "d"}, {5: "I", 10: "i"}
#: No camera writes more; damaged files point in circles.
_MAX_DIRECTORIES, _MAX_ENTRIES, _MAX_VALUES_BYTES = 32, 4096, 1 << 24
#: Directories may share values; not many times over.
_SHARED_BYTES = 1 << 20
#: Magic numbers of TIFF, BigTIFF, and RAW files that differ from them by the magic only.
_CLASSIC, _BIG = (b"*\0", b"\0*", b"RO", b"RS", b"U\0", b"OR"), (b"+\0", b"\0+")

#: Tag, type, number of values, and the field that holds them or their offset.
Entry = tuple[int, int, int, bytes]
Directory = list[Entry]
#: Stands for a directory of more entries than any has: it claims more than any file holds.
_ENDLESS = (0, 1, 1 << 62, b"")


def claims_too_much(file: BinaryIO) -> bool:
    """Whether the directories of a TIFF-like file claim more values than the file can hold; False for other files."""
    try:
        head = file.read(16)
        if head[:2] not in (b"II", b"MM") or head[2:4] not in (*_CLASSIC, *_BIG):
            return False
        length = file.seek(0, 2)
        entries = (entry for directory in _directories(file, head).values() for entry in directory)
        claimed = (n * _SIZES.get(kind, 0) for _, kind, n, _ in entries)
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
        return max((_end(file, directory, _order(head)) for directory in _directories(file, head).values()), default=0)
    return 0


def tags_of(file: BinaryIO) -> tuple[dict[int, Any], dict[int, Any]]:
    """Values of the first directory of a TIFF-like file and of its EXIF directory, by tag; empty where they are broken.

    Numbers, bytes, or tuples of several numbers.
    """
    head = file.read(16)
    if head[:2] not in (b"II", b"MM"):
        return {}, {}
    directories, order = _directories(file, head), _order(head)
    main = next(iter(directories.values()), [])
    exif = [entry for at in _values(file, main, _EXIF, order)[:1] for entry in directories.get(at, [])]
    of_main, of_exif = ({entry[0]: _value(file, entry, order) for entry in part} for part in (main, exif))
    return of_main, of_exif


def values_of(file: BinaryIO, tag: int) -> set[int]:
    """Values of a tag in all directories of a TIFF-like file."""
    head = file.read(16)
    if head[:2] not in (b"II", b"MM"):
        return set()
    directories = _directories(file, head).values()
    return {value for directory in directories for value in _values(file, directory, tag, _order(head))}


def _end(file: BinaryIO, directory: Directory, order: str) -> int:
    """End of the last strip or tile of a directory, bytes."""
    values = {tag: _values(file, directory, tag, order) for pair in _PARTS for tag in pair}
    ends = [a + n for at, size in _PARTS for a, n in zip(values[at], values[size], strict=False)]
    return max(ends, default=0)


def _order(head: bytes) -> str:
    return "<" if head[:2] == b"II" else ">"


def _directories(file: BinaryIO, head: bytes) -> dict[int, Directory]:
    """The directories of a TIFF-like file by their places, including nested ones, up to the first broken one."""
    found: dict[int, Directory] = {}
    with suppress(struct.error):
        order, big = _order(head), head[2:4] in _BIG
        count, entry, offset = (order + form for form in (("Q", "HHQ8s", "Q") if big else ("H", "HHI4s", "I")))
        waiting = [(struct.unpack_from(offset, head, 8 if big else 4)[0], True)]
        while waiting and len(found) < _MAX_DIRECTORIES:
            at, in_chain = waiting.pop(0)
            if not at or at in found:
                continue
            file.seek(at)
            (n_entries,) = struct.unpack(count, file.read(struct.calcsize(count)))
            if n_entries > _MAX_ENTRIES:
                found[at] = [_ENDLESS]
                continue
            found[at] = directory = list(struct.iter_unpack(entry, file.read(n_entries * struct.calcsize(entry))))
            following = file.read(struct.calcsize(offset))
            waiting += [(place, False) for tag in _POINTERS for place in _values(file, directory, tag, order)]
            # What follows a directory of EXIF or GPS is no pointer: some cameras write none there.
            if in_chain and len(following) == struct.calcsize(offset):
                waiting.append((struct.unpack(offset, following)[0], True))
    return found


def _values(file: BinaryIO, directory: Directory, wanted: int, order: str) -> tuple[int, ...]:
    """The offsets or lengths of a tag; none where it is absent or absurd."""
    for entry in directory:
        if entry[0] == wanted and entry[1] in _TYPES:
            return _numbers(_content(file, entry, order), order + _TYPES[entry[1]])
    return ()


def _value(file: BinaryIO, entry: Entry, order: str) -> Any:
    """The value of an entry as `tags_of` gives it."""
    kind, data = entry[1], _content(file, entry, order)
    if kind in _NUMBERS:
        numbers: tuple[float, ...] = _numbers(data, order + _NUMBERS[kind])
    elif kind in _FRACTIONS:
        parts = _numbers(data, order + _FRACTIONS[kind])
        numbers = tuple(above / below if below else nan for above, below in zip(parts[::2], parts[1::2], strict=True))
    else:
        return data
    return numbers[0] if len(numbers) == 1 else numbers


def _numbers(data: bytes, form: str) -> tuple[int, ...]:
    return tuple(number for (number,) in struct.iter_unpack(form, data))


def _content(file: BinaryIO, entry: Entry, order: str) -> bytes:
    """The bytes of an entry's value; none where they are cut or absurd."""
    _, kind, n, field = entry
    size = n * _SIZES.get(kind, 0)
    if size > _MAX_VALUES_BYTES:
        return b""
    if size > len(field):
        file.seek(int.from_bytes(field, "little" if order == "<" else "big"))
        field = file.read(size)
    return field[:size] if len(field) >= size else b""
