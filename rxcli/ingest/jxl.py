"""JPEG XL pictures: samples as stored; their turn is in the code itself (ISO/IEC 18181-1, annex D)."""

from contextlib import suppress
from pathlib import Path

import numpy as np

from rxcli.errors import failure_explained
from rxcli.ingest.luma import colour_frame
from rxcli.ingest.metadata import exif_metadata, turned
from rxcli.ingest.sniff import check_size, read_bytes
from rxcli.types import Frame

_CODE = b"\xff\n"
#: D.2, D.3: bits of a length by their kind, and widths as shares of the height; usual bits a sample.
_LENGTH_BITS, _RATIOS = (9, 13, 18, 30), ((1, 1), (12, 10), (4, 3), (3, 2), (16, 9), (5, 4), (2, 1))
_DEPTHS, _HEADER_BYTES = (8, 10, 12), 64
#: More than EXIF and XMP unfold to.
_NOTE_BYTES = 1 << 20
#: What the decoder holds: floats of three colours and of alpha, the samples, and luma.
_BYTES_A_PIXEL = 30


def read_jxl(path: Path) -> Frame:
    """Read samples as stored, and metadata with the orientation that the code asks for.

    Raises:
        InputError: damaged, too large.
    """
    import imagecodecs

    data = read_bytes(path)
    # Of code in parts, each has its number first.
    parts = ((kind, _content(data, kind)) for kind in (b"jxlc", b"jxlp"))
    code = next((content[4 * (kind == b"jxlp") :] for kind, content in parts if content), data)
    width, height, orientation, bits = _header(code)
    check_size(path, width, height, _BYTES_A_PIXEL, len(data))
    with failure_explained(f"{path}: the JPEG XL picture is damaged or cut", "copy the file again"):
        pixels = imagecodecs.jpegxl_decode(data, index=0, keeporientation=True)
    if pixels.dtype.kind == "f":
        pixels = np.rint(np.clip(pixels, 0, 1) * np.float32(65535)).astype(np.uint16)
    elif pixels.dtype == np.uint16:
        pixels <<= max(16 - bits, 0)
    metadata = exif_metadata(*(_metadata_block(data, kind) for kind in (b"Exif", b"xml ")))
    return colour_frame(path, pixels, turned(metadata, orientation))


def _content(data: bytes, kind: bytes) -> bytes:
    """What is in a box of the file (ISO/IEC 18181-2), the rest where its size is not given; empty without the box."""
    at = data.find(kind)
    size = int.from_bytes(data[max(at - 4, 0) : max(at, 0)])
    return data[at + len(kind) : at - 4 + size if size > len(kind) else None] if at >= 0 else b""


def _metadata_block(data: bytes, kind: bytes) -> bytes:
    """EXIF or XMP, which may be packed."""
    import imagecodecs

    with suppress(imagecodecs.BrotliError):
        packed = _content(data, b"brob" + kind)
        return bytes(imagecodecs.brotli_decode(packed, out=_NOTE_BYTES)) if packed else _content(data, kind)
    return b""


def _header(code: bytes) -> tuple[int, int, int, int]:
    """Width, height, EXIF orientation, and bits a sample."""
    bits = int.from_bytes(code.removeprefix(_CODE)[:_HEADER_BYTES], "little")

    def bit_field(n: int) -> int:
        nonlocal bits
        value, bits = bits & (1 << n) - 1, bits >> n
        return value

    def size() -> tuple[int, int]:
        def length() -> int:
            return 8 * (bit_field(5) + 1) if is_small else bit_field(_LENGTH_BITS[bit_field(2)]) + 1

        is_small = bit_field(1)
        height, ratio = length(), bit_field(3)
        above, below = _RATIOS[ratio - 1]
        return (height * above // below if ratio else length()), height

    width, height = size()
    if bit_field(1):  # all the rest is as usual
        return width, height, 1, 8
    has_more = bit_field(1)
    orientation = bit_field(3) + 1 if has_more else 1
    if has_more and bit_field(1):
        size()  # for showing
    if (has_more and bit_field(2)) or bit_field(1):  # a preview, an animation, floats
        return width, height, orientation, 16
    depth = bit_field(2)
    return width, height, orientation, _DEPTHS[depth] if depth < len(_DEPTHS) else bit_field(6) + 1
