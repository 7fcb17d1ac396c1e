"""DNG of a mosaic, and plain RGB TIFF, uncompressed."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import UsageError
from rxcli.lab.simulate.scenes import Scene

#: Tag number, type as tifffile names it, count, value, whether in the first directory alone.
_Tag = tuple[int, str, int, Any, bool]
#: tifffile writes no EXIF directory (34665); a tag of the next number keeps its place.
_PLACEHOLDER = 34666


def _rationals(code: int, kind: str, values: Any, denominator: int) -> _Tag:
    pairs = [Fraction(float(value)).limit_denominator(denominator).as_integer_ratio() for value in np.ravel(values)]
    return code, kind, len(pairs), tuple(number for pair in pairs for number in pair), True


def _camera_tags(scene: Scene) -> list[_Tag]:
    """Make, model, orientation, and a place for that of the EXIF directory."""
    named = [(271, "s", 0, scene.make, True), (272, "s", 0, scene.model, True)]
    return [*named, (274, "H", 1, scene.orientation, True), (_PLACEHOLDER, "I", 1, 0, True)]


def _append_exif(path: Path, scene: Scene) -> None:
    """Write exposure and ISO into an EXIF directory at the end of the file, and its place over the placeholder."""
    import tifffile

    exposure = Fraction(scene.exposure_s).limit_denominator(1_000_000).as_integer_ratio()
    with tifffile.TiffFile(path) as written:
        placeholder = written.pages[0].tags[_PLACEHOLDER].offset
    with path.open("r+b") as file:
        at = file.seek(0, 2)
        file.write(struct.pack("<HHHIIHHIIIII", 2, 33434, 5, 1, at + 30, 34855, 3, 1, scene.iso, 0, *exposure))
        file.seek(placeholder)
        file.write(struct.pack("<HHII", _PLACEHOLDER - 1, 4, 1, at))


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
    import tifffile

    sensor = scene.sensor
    if sensor.pattern is None:
        raise UsageError("a DNG holds a mosaic, this sensor has none", "use a Bayer or X-Trans sensor")
    # The matrix from XYZ to the sensor's colours, for the panel's primaries taken as sRGB's.
    from_xyz = sensor.colour_matrix @ np.array(
        [[3.2405, -1.5371, -0.4985], [-0.9693, 1.8760, 0.0416], [0.0556, -0.2040, 1.0572]]
    )
    tags = [
        *_camera_tags(scene),
        (33421, "H", 2, sensor.pattern.shape, True),
        (33422, "B", sensor.pattern.size, sensor.pattern.tobytes(), True),
        (50706, "B", 4, b"\1\4\0\0", True),
        (50707, "B", 4, b"\1\3\0\0", True),
        (50708, "s", 0, f"{scene.make} {scene.model}", True),
        (50714, "H", 1, sensor.black_level, True),
        (50717, "H", 1, sensor.white_level, True),
        _rationals(50721, "2i", from_xyz, 10_000),
        _rationals(50728, "2I", sensor.response, 10_000),
        (50778, "H", 1, 21, True),
    ]
    layout: dict[str, Any] = {
        "photometric": 32803,
        "rowsperstrip": raw.shape[0],
        "metadata": None,
        "software": False,
        "extratags": tags,
    }
    if bits == 16:
        tifffile.imwrite(path, raw, **layout)
    else:
        packed = iter([pack_14bit(raw)])
        tifffile.imwrite(path, packed, shape=raw.shape, dtype=np.uint16, bitspersample=14, **layout)
    _append_exif(path, scene)


def write_tiff(rgb: NDArray[np.generic], scene: Scene, path: Path) -> None:
    """Write a developed picture of 8 or 16 bits as uncompressed TIFF."""
    import tifffile

    tifffile.imwrite(path, rgb, photometric="rgb", metadata=None, extratags=_camera_tags(scene))
    _append_exif(path, scene)
