"""HEIC pictures through the optional extra `heic`.

libheif rotates and mirrors pixels by the file's `irot` and `imir` properties and offers no alternative. The properties
are read here (ISO/IEC 23008-12, section 6.5) to undo this, because rows must stay in readout order.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import InputError
from rxcli.ingest.luma import BT601, BT709, Luma, luma_of
from rxcli.ingest.metadata import exif_metadata
from rxcli.ingest.orientation import as_stored, orientation_of
from rxcli.ingest.sniff import check_size, reason_of
from rxcli.types import Metadata

#: `matrix_coefficients` of ITU-T H.273 that means BT.709.
_MATRIX_BT709 = 1


def read_heif(data: bytes, path: Path) -> tuple[Luma, Metadata]:
    """Luma as stored, and metadata with the orientation that the file asks for.

    Raises:
        InputError: damaged, or the extra is not installed.
    """
    try:
        import pillow_heif
    except ImportError:
        raise InputError(f"{path}: HEIC needs an extra", "run `pip install '.[web]'`, or save as JPEG") from None
    try:
        file = pillow_heif.open_heif(io.BytesIO(data), convert_hdr_to_8bit=False)
        width, height = file.size
        check_size(path, width, height, 12, len(data))  # planes, interleaved RGB of up to 16 bits, luma
        pixels = np.asarray(file)
    except InputError:
        raise
    except Exception as error:  # libheif's errors come as some five unrelated types
        raise InputError(f"{path}: the HEIC picture is damaged ({reason_of(error)})", "copy the file again") from None
    matrix = (file.info.get("nclx_profile") or {}).get("matrix_coefficients")
    luma = luma_of(pixels, BT709 if matrix == _MATRIX_BT709 else BT601)
    metadata = exif_metadata(file.info.get("exif") or b"")
    turned = heif_orientation(data)
    return as_stored(luma, turned), replace(metadata, orientation=turned) if turned != 1 else metadata


def heif_orientation(data: bytes) -> int:
    """The orientation that `irot` and `imir` of the primary picture give it; 1 where they are absent or unreadable."""
    try:
        turns = list(_primary_turns(data))
    except (IndexError, KeyError, ValueError):
        return 1

    def view(picture: NDArray[np.int64]) -> NDArray[np.int64]:
        for name, value in turns:
            picture = np.rot90(picture, value & 3) if name == b"irot" else np.flip(picture, axis=value & 1)
        return picture

    return orientation_of(view)


def _primary_turns(data: bytes) -> Iterator[tuple[bytes, int]]:
    """Turns and mirrors of the primary picture, in the order of application: (name, angle or axis)."""
    meta = dict(_boxes(data))[b"meta"]
    boxes = dict(_boxes(meta[4:]))
    properties = dict(_boxes(boxes[b"iprp"]))
    container = list(_boxes(properties[b"ipco"]))
    pitm = boxes[b"pitm"]
    primary = int.from_bytes(pitm[4:6] if pitm[0] == 0 else pitm[4:8])
    for index in _associations(properties[b"ipma"]).get(primary, ()):
        name, content = container[index - 1]
        if name in (b"irot", b"imir"):
            yield name, content[0]


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Name and content of the boxes of ISO media (ISO/IEC 14496-12, section 4.2)."""
    at = 0
    while at + 8 <= len(data):
        size, name, start = int.from_bytes(data[at : at + 4]), data[at + 4 : at + 8], at + 8
        if size == 1:
            size, start = int.from_bytes(data[start : start + 8]), start + 8
        end = at + size if size else len(data)
        if end < start:
            raise ValueError("a box ends before it starts")
        yield name, data[start:end]
        at = end


def _associations(ipma: bytes) -> dict[int, list[int]]:
    """Item -> its properties, numbered from 1 (ISO/IEC 23008-12, section 9.3)."""
    stream = io.BytesIO(ipma)

    def unsigned(size: int) -> int:
        data = stream.read(size)
        if len(data) < size:
            raise ValueError("the box is cut")
        return int.from_bytes(data)

    version, flags = unsigned(1), unsigned(3)
    found: dict[int, list[int]] = {}
    for _ in range(unsigned(4)):
        item = unsigned(2 if version == 0 else 4)
        width = 2 if flags & 1 else 1
        mask = 0x7FFF if flags & 1 else 0x7F  # the top bit means "essential"
        found[item] = [unsigned(width) & mask for _ in range(unsigned(1))]
    return found
