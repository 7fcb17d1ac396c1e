"""Metadata of picture files: exposure, ISO, make, model, lens, focal length, orientation.

EXIF and XMP are parsed from bytes found without opening the picture (RAF included, whose EXIF is that of the JPEG
inside). Missing, broken or absurd values are None and never fail a frame.
"""

import io
import math
import re
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from rxcli.ingest.extent import Directories
from rxcli.ingest.jpeg import segments
from rxcli.ingest.sniff import RAW_SUFFIXES
from rxcli.types import Metadata

# TIFF 6.0, and DNG 1.4; a colour filter array, and linear RAW.
_PHOTOMETRIC, _DNG_VERSION = 0x0106, 0xC612
_RAW_PHOTOMETRICS = (32803, 34892)
# EXIF 2.32, tables 3 to 8.
_MAKE, _MODEL, ORIENTATION = 0x010F, 0x0110, 0x0112
_EXPOSURE, _SENSITIVITY, _RECOMMENDED_INDEX, _ISO_SPEED = 0x829A, 0x8827, 0x8832, 0x8833
_FOCAL_LENGTH, _FOCAL_LENGTH_35MM, _LENS_MODEL = 0x920A, 0xA405, 0xA434
#: Marker of the segments of a JPEG file that hold EXIF or XMP, and the tag of XMP in TIFF files.
_APP1, _XMP = 0xE1, 700
#: Start of EXIF behind its name, if any, and bytes in which it comes.
_TIFF_START, _START_BYTES = re.compile(rb"II\*\0|MM\0\*"), 16
#: Names of properties in XMP, in its namespaces `tiff` and `exif`, and in texts that programs put into PNG files.
_PROPERTIES = {
    b"Make": _MAKE,
    b"Model": _MODEL,
    b"Orientation": ORIENTATION,
    b"ExposureTime": _EXPOSURE,
    b"ISOSpeedRatings": _SENSITIVITY,
    b"PhotographicSensitivity": _SENSITIVITY,
    b"FocalLength": _FOCAL_LENGTH,
}
_PROPERTY = re.compile(rb"(?:^|:)(%s)(?:\0|\s*=\s*[\"']|\s*>(?:\s*<[^<>]*>)*)([^\"'<>]*)" % b"|".join(_PROPERTIES))
#: Value of the 16-bit sensitivity tag if the ISO does not fit; longer tags then hold it.
_ISO_OVERFLOW = 65535
#: Enough of a file for its directories, where they must be copied.
_HEADER_BYTES = 1 << 20
#: An EXIF block that fits into a JPEG file; other files could hold longer ones.
_EXIF_BYTES = 1 << 16
#: Longer names of makers, models and lenses are none.
_MAX_CHARACTERS = 200

#: Plausible ranges: field -> name, minimum, maximum, unit. An exposure of a second is thousands of slots.
_BOUNDS = {
    "exposure_s": ("exposure", 1e-7, 1.0, "s"),
    "readout_s": ("readout", 1e-4, 0.2, "s"),
    "iso": ("ISO", 0.1, 1e8, ""),
    "focal_length_mm": ("focal length", 0.01, 1e5, "mm"),
    "focal_length_35mm": ("focal length", 0.01, 1e5, "mm"),
}

_Value = TypeVar("_Value")


def jpeg_metadata(data: bytes) -> Metadata:
    """Metadata of a JPEG file's bytes."""
    return exif_metadata(*(data[start:end] for marker, start, end in segments(data) if marker == _APP1))


def exif_metadata(*blocks: bytes) -> Metadata:
    """Metadata of EXIF, a TIFF header and its directories, with or without `Exif\\0\\0` before it, and of XMP.

    What several blocks state is that of the first one, and of EXIF before XMP.
    """
    starts = ((block, _TIFF_START.search(block[:_START_BYTES])) for block in blocks)
    exif = [io.BytesIO(block[start.start() :][:_EXIF_BYTES]) for block, start in starts if start]
    return _from_tags([tag for stream in exif for tag in Directories(stream).tags()], blocks)


def tiff_metadata(stream: BinaryIO) -> Metadata:
    """Metadata of a TIFF or TIFF-like RAW file; only its directories are read."""
    tags = Directories(stream).tags()
    return _from_tags(tags, [value for tag, value in tags if tag == _XMP and isinstance(value, bytes)])


def is_raw_tiff(path: Path) -> bool:
    """Whether a TIFF file is a camera's RAW in TIFF clothes: a DNG, a mosaic, or a preview with its RAW further on."""
    has_raw_name = path.suffix.lower() in RAW_SUFFIXES
    with path.open("rb") as file:
        directories = Directories(file)
        tags = dict(directories.tags())
        has_raw_samples = not directories.values(_PHOTOMETRIC).isdisjoint(_RAW_PHOTOMETRICS)
    if not tags:
        return has_raw_name
    return _DNG_VERSION in tags or has_raw_samples or (_MAKE in tags and has_raw_name)


def raw_metadata(path: Path) -> Metadata:
    """Metadata of a RAW file, from its own directories or the JPEG inside."""
    with suppress(OSError, struct.error), path.open("rb") as file:
        head = file.read(HEAD := 128)
        if head.startswith(b"FUJIFILMCCD-RAW"):
            offset, length = struct.unpack_from(">II", head, 84)
            file.seek(offset)
            return jpeg_metadata(file.read(min(length, _HEADER_BYTES)))
        if head[4:8] != b"ftyp":
            return tiff_metadata(file)
        head += file.read(_HEADER_BYTES - HEAD)
        if (found := head.find(b"CMT1")) >= 0:  # the box of IFD0; LibRaw states the exposure
            return exif_metadata(head[found + 4 :])
    return Metadata()


def clip_metadata(tags: Mapping[str, str]) -> Metadata:
    """Metadata of a clip from the tags of its container, which state the camera but not the exposure."""
    lower = {name.lower(): value for name, value in tags.items()}

    def text(*names: str) -> str | None:
        return next((found for name in names if (found := text_of(lower.get(name)))), None)

    return Metadata(
        make=text("make", "com.apple.quicktime.make", "com.android.manufacturer"),
        model=text("model", "com.apple.quicktime.model", "com.android.model"),
    )


def believed(metadata: Metadata) -> Metadata:
    """Remove implausible values and list them in `not_believed`."""
    doubts = {}
    for field, (name, least, most, unit) in _BOUNDS.items():
        value = getattr(metadata, field)
        if value is not None and not least <= value <= most:
            doubts[field] = f"{name} of {value:.4g} {unit}".rstrip()
    if not doubts:
        return metadata
    unknown: dict[str, Any] = dict.fromkeys(doubts)
    return replace(metadata, not_believed=(*metadata.not_believed, *doubts.values()), **unknown)


def orientation_of_tag(value: Any) -> int | None:
    """One of the eight orientations, also as a byte or as a digit; None for anything else."""
    code = value.strip(b"\0") if isinstance(value, bytes) else b""
    number = code[0] if len(code) == 1 and code[0] < ord("0") else positive(value) or 0
    return int(number) if number in range(1, 9) else None


def turned(metadata: Metadata, orientation: int) -> Metadata:
    """Metadata of a file whose format has turns of its own, by which viewers go, and not by EXIF."""
    doubt = f"EXIF orientation {metadata.orientation} (the file has rotations of its own; columns may be reversed)"
    doubts = () if metadata.orientation in (1, orientation) else (doubt,)
    return replace(metadata, orientation=orientation, not_believed=(*metadata.not_believed, *doubts))


def merge(metadata: Metadata, fallback: Metadata) -> Metadata:
    """Fill the unknown fields of `metadata` from `fallback`."""
    unknown = {f.name: getattr(fallback, f.name) for f in fields(metadata) if getattr(metadata, f.name) is None}
    return replace(metadata, **unknown)


def _from_tags(tags: Sequence[tuple[int, Any]], xmp: Iterable[bytes]) -> Metadata:
    """Metadata of tags and their values, and of texts that may be XMP; of each the first value that means something."""
    for text in xmp:  # in UTF-16 there are zeros between the letters
        found = _PROPERTY.findall(text) or _PROPERTY.findall(text.replace(b"\0", b""))
        tags = [*tags, *((_PROPERTIES[name], value) for name, value in found)]

    def stated(meaning: Callable[[Any], _Value | None], *wanted: int) -> _Value | None:
        meanings = (meaning(value) for number in wanted for tag, value in tags if tag == number)
        return next((found for found in meanings if found is not None), None)

    iso = stated(positive, _SENSITIVITY)
    return believed(
        Metadata(
            make=stated(text_of, _MAKE),
            model=stated(text_of, _MODEL),
            lens=stated(text_of, _LENS_MODEL),
            exposure_s=stated(positive, _EXPOSURE),
            iso=stated(positive, _ISO_SPEED, _RECOMMENDED_INDEX, _SENSITIVITY) if iso == _ISO_OVERFLOW else iso,
            focal_length_mm=stated(positive, _FOCAL_LENGTH),
            focal_length_35mm=stated(positive, _FOCAL_LENGTH_35MM),
            orientation=stated(orientation_of_tag, ORIENTATION) or 1,
        )
    )


def text_of(value: Any) -> str | None:
    """What of a name in a file can be printed; None for no name."""
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    text = value.split("\0")[0].strip() if isinstance(value, str) else ""
    return "".join(c for c in text[:_MAX_CHARACTERS] if c.isprintable()) or None


def positive(value: Any) -> float | None:
    """A number above zero in a file, or a text of one or of a fraction; None for anything else."""
    try:
        value = next(iter(value), "") if isinstance(value, tuple) else value
        above, _, below = (text_of(value) or "").partition("/") if isinstance(value, bytes) else (value, "", "")
        number = float(above) / float(below or 1)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0 else None
