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
#: The same of all numbers, those of fractions two integers.
_NUMBERS = _TYPES | {5: "II", 6: "b", 8: "h", 9: "i", 10: "ii", 11: "f", 12: "d"}
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


class Directories:
    """The directories of a TIFF-like file, nested ones too, up to the first broken one; none of other files."""

    def __init__(self, file: BinaryIO) -> None:
        file.seek(0)
        head = file.read(16)
        self._file, self._order = file, "<" if head[:2] == b"II" else ">"
        #: By the place in the file.
        self._found: dict[int, Directory] = {}
        if head[:2] in (b"II", b"MM") and head[2:4] in (*_CLASSIC, *_BIG):
            with suppress(struct.error, OSError, OverflowError, ValueError):  # of a cut file, offsets beyond all files
                self._read(head, head[2:4] in _BIG)

    def _read(self, head: bytes, big: bool) -> None:
        count, entry, offset = (self._order + form for form in (("Q", "HHQ8s", "Q") if big else ("H", "HHI4s", "I")))
        waiting = [(struct.unpack_from(offset, head, 8 if big else 4)[0], True)]
        while waiting and len(self._found) < _MAX_DIRECTORIES:
            at, in_chain = waiting.pop(0)
            if not at or at in self._found:
                continue
            self._file.seek(at)
            (n_entries,) = struct.unpack(count, self._file.read(struct.calcsize(count)))
            if n_entries > _MAX_ENTRIES:
                self._found[at] = [_ENDLESS]
                continue
            content = self._file.read(n_entries * struct.calcsize(entry))
            self._found[at] = directory = list(struct.iter_unpack(entry, content))
            following = self._file.read(struct.calcsize(offset))
            waiting += [(place, False) for tag in _POINTERS for place in self._values(directory, tag)]
            # What follows a directory of EXIF or GPS is no pointer: some cameras write none there.
            if in_chain and len(following) == struct.calcsize(offset):
                waiting.append((struct.unpack(offset, following)[0], True))

    @property
    def claims_too_much(self) -> bool:
        """Whether they claim more values than the file can hold."""
        claimed = (n * _SIZES.get(kind, 0) for directory in self._found.values() for _, kind, n, _ in directory)
        return sum(claimed) > self._file.seek(0, 2) + _SHARED_BYTES

    @property
    def end(self) -> int:
        """End of the last strip or tile that they state, bytes; 0 if they state none."""
        values = [[self._values(d, tag) for tag in pair] for d in self._found.values() for pair in _PARTS]
        return max((a + n for at, size in values for a, n in zip(at, size, strict=False)), default=0)

    def tags(self) -> list[tuple[int, Any]]:
        """Tags and values of the EXIF directory of the first one, and of that one; none where they claim too much.

        Numbers, bytes, or tuples of several numbers.
        """
        if self.claims_too_much:
            return []
        main = next(iter(self._found.values()), [])
        exif = [entry for at in self._values(main, _EXIF)[:1] for entry in self._found.get(at, [])]
        found = ((entry[0], self._value(entry)) for entry in (*exif, *main))
        return [(tag, value[0] if len(value) == 1 else value) for tag, value in found]

    def values(self, tag: int) -> set[int]:
        """Values of a tag in all directories."""
        return {value for directory in self._found.values() for value in self._values(directory, tag)}

    def _values(self, directory: Directory, wanted: int) -> tuple[int, ...]:
        """The offsets or lengths of a tag; none where it is absent or absurd."""
        entries = (entry for entry in directory if entry[0] == wanted and entry[1] in _TYPES)
        return next((self._value(entry) for entry in entries), ())

    def _value(self, entry: Entry) -> tuple[Any, ...]:
        """The numbers of an entry, or all its bytes."""
        if entry[1] not in _NUMBERS:
            return (self._content(entry),)
        numbers = struct.iter_unpack(self._order + _NUMBERS[entry[1]], self._content(entry))
        return tuple((above / below[0] if below[0] else nan) if below else above for above, *below in numbers)

    def _content(self, entry: Entry) -> bytes:
        """The bytes of an entry's value; none where they are cut or absurd."""
        _, kind, n, field = entry
        size = n * _SIZES.get(kind, 0)
        if size > _MAX_VALUES_BYTES:
            return b""
        if size > len(field):
            with suppress(OSError, OverflowError):
                self._file.seek(int.from_bytes(field, "little" if self._order == "<" else "big"))
                field = self._file.read(size)
        return field[:size] if len(field) >= size else b""
