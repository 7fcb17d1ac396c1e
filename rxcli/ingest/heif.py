"""HEIC pictures through the optional extra `heic`.

libheif rotates and mirrors pixels by the file's `irot` and `imir` properties and offers no alternative. This is undone
here, because rows must stay in readout order.
"""

import io
from pathlib import Path
from typing import Any

import numpy as np

from rxcli.errors import InputError, failure_explained
from rxcli.ingest.luma import BT601, BT709, colour_frame
from rxcli.ingest.metadata import exif_metadata, turned
from rxcli.ingest.orientation import PROBE, as_stored, orientation_of
from rxcli.ingest.sniff import check_size, read_bytes
from rxcli.types import Frame

#: Samples a pixel of the planes by their chroma; full ones are held twice.
_PLANES = {420: 1.5, 422: 6.0, 444: 6.0}
#: `matrix_coefficients` of ITU-T H.273 that means BT.709.
_MATRIX_BT709 = 1


def read_heif(path: Path) -> Frame:
    """Read samples as stored, and metadata with the orientation that the file asks for.

    Raises:
        InputError: damaged, or the extra is not installed.
    """
    try:
        import pillow_heif
    except ImportError:
        raise InputError(f"{path}: HEIC needs pillow-heif", "run `pip install pillow-heif`, or save as JPEG") from None
    data = read_bytes(path)
    with failure_explained(f"{path}: the HEIC picture is damaged", "copy the file again"):
        file = pillow_heif.open_heif(io.BytesIO(data), convert_hdr_to_8bit=False)
        orientation = _orientation(file[file.primary_index])
        width, height = file.size
        check_size(path, width, height, _bytes_a_pixel(file, orientation != 1), len(data))
        pixels = np.asarray(file)
    matrix = (file.info.get("nclx_profile") or {}).get("matrix_coefficients")
    metadata = exif_metadata(*(file.info.get(kind) or b"" for kind in ("exif", "xmp")))
    weights = BT709 if matrix == _MATRIX_BT709 else BT601
    return colour_frame(path, as_stored(pixels, orientation), turned(metadata, orientation), weights)


def _bytes_a_pixel(file: Any, is_turned: bool) -> float:
    """What libheif holds: planes, turned ones, and the interleaved samples; measured, luma fits in after the planes."""
    channels, chroma = len(file.mode.partition(";")[0]), file.info.get("chroma")
    planes: float = _PLANES.get(chroma, _PLANES[420]) + file.has_alpha + _PLANES[420] * is_turned
    return (channels + planes) * (1 if file.info["bit_depth"] == 8 else 2)


def _orientation(image: Any) -> int:
    """The orientation that the turns and mirrors applied by libheif amount to.

    Args:
        image: pillow_heif's, which keeps them private: ("irot", degrees counter-clockwise) or ("imir", axis), in order.
    """
    probe = PROBE
    for name, value, *_ in image._c_image.transformations:
        if name == "irot":
            probe = np.rot90(probe, value // 90)
        elif name == "imir":
            probe = np.flip(probe, axis=value)
    return orientation_of(probe)
