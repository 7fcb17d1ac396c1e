"""A small TIFF writer: uncompressed DNG of a mosaic, with a real EXIF IFD, and plain RGB TIFF."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import UsageError
from rxcli.lab.simulate.scenes import Scene

_BYTE, _ASCII, _SHORT, _LONG, _RATIONAL, _UNDEFINED, _SRATIONAL = 1, 2, 3, 4, 5, 7, 10
_SIZES = {_BYTE: 1, _ASCII: 1, _SHORT: 2, _LONG: 4, _RATIONAL: 8, _UNDEFINED: 1, _SRATIONAL: 8}
_FORMATS = {_SHORT: "H", _LONG: "I", _RATIONAL: "II", _SRATIONAL: "ii"}
_STRIP_OFFSETS, _EXIF_IFD = 273, 34665


@dataclass(frozen=True)
class _Tag:
    code: int
    kind: int
    values: bytes | str | Sequence[int] | Sequence[Fraction]

    def encoded(self) -> bytes:
        if isinstance(self.values, str):
            return self.values.encode("ascii", "replace") + b"\0"
        if isinstance(self.values, bytes):
            return self.values
        if self.kind in (_RATIONAL, _SRATIONAL):
            pairs = (Fraction(value).as_integer_ratio() for value in self.values)
            return b"".join(struct.pack("<" + _FORMATS[self.kind], *pair) for pair in pairs)
        return b"".join(struct.pack("<" + _FORMATS[self.kind], int(v)) for v in self.values)


def _directory(tags: list[_Tag], offset: int) -> bytes:
    """An IFD at file position `offset`, its long values behind it."""
    entries, extra = b"", b""
    behind = offset + 2 + 12 * len(tags) + 4
    for tag in sorted(tags, key=lambda t: t.code):
        data = tag.encoded()
        head = struct.pack("<HHI", tag.code, tag.kind, len(data) // _SIZES[tag.kind])
        if len(data) <= 4:
            entries += head + data.ljust(4, b"\0")
        else:
            entries += head + struct.pack("<I", behind + len(extra))
            extra += data + b"\0" * (len(data) % 2)
    return struct.pack("<H", len(tags)) + entries + struct.pack("<I", 0) + extra


def _write(path: Path, tags: list[_Tag], exif: list[_Tag], data: bytes) -> None:
    """One picture in one strip: header, IFD, EXIF IFD, data."""
    tags = [tag for tag in tags if tag.code not in (_STRIP_OFFSETS, _EXIF_IFD)]

    def main(exif_at: int, data_at: int) -> bytes:
        own = [_Tag(_STRIP_OFFSETS, _LONG, [data_at])] + ([_Tag(_EXIF_IFD, _LONG, [exif_at])] if exif else [])
        return _directory(tags + own, 8)

    exif_at = 8 + len(main(0, 0))
    inner = _directory(exif, exif_at) if exif else b""
    data_at = -(-(exif_at + len(inner)) // 16) * 16
    head = struct.pack("<2sHI", b"II", 42, 8) + main(exif_at, data_at) + inner
    with path.open("wb") as file:
        file.write(head.ljust(data_at, b"\0"))
        file.write(data)


def _picture_tags(shape: tuple[int, ...], bits: int, photometric: int, n_bytes: int, scene: Scene) -> list[_Tag]:
    samples = shape[2] if len(shape) == 3 else 1
    return [
        _Tag(256, _LONG, [shape[1]]),
        _Tag(257, _LONG, [shape[0]]),
        _Tag(258, _SHORT, [bits] * samples),
        _Tag(259, _SHORT, [1]),
        _Tag(262, _SHORT, [photometric]),
        _Tag(271, _ASCII, scene.make),
        _Tag(272, _ASCII, scene.model),
        _Tag(274, _SHORT, [scene.orientation]),
        _Tag(277, _SHORT, [samples]),
        _Tag(278, _LONG, [shape[0]]),
        _Tag(279, _LONG, [n_bytes]),
        _Tag(284, _SHORT, [1]),
    ]


def _exif_tags(scene: Scene) -> list[_Tag]:
    return [
        _Tag(33434, _RATIONAL, [Fraction(scene.exposure_s).limit_denominator(1_000_000)]),
        _Tag(34855, _SHORT, [scene.iso]),
        _Tag(36864, _UNDEFINED, b"0231"),
    ]


def pack_14bit(values: NDArray[np.uint16]) -> bytes:
    """Rows of 14-bit numbers, most significant bit first, each row padded to whole bytes."""
    height, width = values.shape
    padded = np.zeros((height, -(-width // 4) * 4), np.uint64)
    padded[:, :width] = values
    quads = padded.reshape(height, -1, 4)
    word = (quads[..., 0] << np.uint64(42)) | (quads[..., 1] << np.uint64(28)) | (quads[..., 2] << np.uint64(14))
    word |= quads[..., 3]
    packed = word.astype(">u8").view(np.uint8).reshape(height, -1, 8)[..., 1:].reshape(height, -1)
    return bytes(packed[:, : -(-width * 14 // 8)].tobytes())


def write_dng(raw: NDArray[np.uint16], scene: Scene, path: Path, bits: int = 16) -> None:
    """Write a mosaic as uncompressed DNG.

    Args:
        raw: (height, width) uint16.
        scene: whose sensor made it.
        path: of the file.
        bits: 16, or 14 for packed numbers.
    """
    pattern = scene.sensor.pattern
    if pattern is None:
        raise UsageError("a DNG holds a mosaic, this sensor has none", "use a Bayer or X-Trans sensor")
    data = raw.astype("<u2").tobytes() if bits == 16 else pack_14bit(raw)
    # The matrix from XYZ to the sensor's colours, for the panel's primaries taken as sRGB's.
    from_xyz = scene.sensor.colour_matrix @ np.array(
        [[3.2405, -1.5371, -0.4985], [-0.9693, 1.8760, 0.0416], [0.0556, -0.2040, 1.0572]]
    )
    tags = [
        *_picture_tags(raw.shape, bits, 32803, len(data), scene),
        _Tag(33421, _SHORT, list(pattern.shape)),
        _Tag(33422, _BYTE, pattern.tobytes()),
        _Tag(50706, _BYTE, bytes([1, 4, 0, 0])),
        _Tag(50707, _BYTE, bytes([1, 3, 0, 0])),
        _Tag(50708, _ASCII, f"{scene.make} {scene.model}"),
        _Tag(50714, _SHORT, [scene.sensor.black_level]),
        _Tag(50717, _SHORT, [scene.sensor.white_level]),
        _Tag(50721, _SRATIONAL, [Fraction(round(v * 10000), 10000) for v in from_xyz.ravel()]),
        _Tag(50728, _RATIONAL, [Fraction(round(v * 10000), 10000) for v in scene.sensor.response]),
        _Tag(50778, _SHORT, [21]),
    ]
    _write(path, tags, _exif_tags(scene), data)


def write_tiff(rgb: NDArray[np.generic], scene: Scene, path: Path) -> None:
    """Write a developed picture of 8 or 16 bits as uncompressed TIFF."""
    bits = rgb.dtype.itemsize * 8
    data = np.ascontiguousarray(rgb, f"<u{bits // 8}").tobytes()
    tags = _picture_tags(rgb.shape, bits, 2, len(data), scene)
    _write(path, tags, _exif_tags(scene), data)
