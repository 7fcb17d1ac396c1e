"""Developed pictures -> luma as stored: JPEG, PNG, TIFF, and what else Pillow reads.

Colour is reduced to BT.601 luma, which is what a JPEG of the same picture would hold.
"""

import io
import logging
import re
import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import InputError, failure_explained
from rxcli.ingest import jpeg
from rxcli.ingest.extent import Directories
from rxcli.ingest.luma import THINNED, Luma, colour_frame, colours_of, luma_of
from rxcli.ingest.metadata import ORIENTATION, exif_metadata, jpeg_metadata, orientation_of_tag, tiff_metadata
from rxcli.ingest.quiet import quiet_libraries
from rxcli.ingest.sniff import check_size, read_bytes, start_of_picture
from rxcli.types import Frame


def _picture(path: Path) -> bytes:
    """The bytes of a file from where its picture starts."""
    data = read_bytes(path)
    return data[start_of_picture(data) :]


def read_jpeg(path: Path) -> Frame:
    """Read a JPEG."""
    data = jpeg.with_height(_picture(path))
    metadata = jpeg_metadata(data)
    if jpeg.header_of(data).is_uncommon:
        pixels, white = jpeg.decode_uncommon(data, path)
        return colour_frame(path, pixels, metadata, white=white)
    return Frame(jpeg.decode_luma(data, path), str(path), metadata=metadata, colours=jpeg.colours_of(data))


#: ISO 15948, table 11.1: samples of a pixel as they are decoded, by colour type; others may get an alpha.
_PNG_SAMPLES = {0: 1, 4: 2}
#: Start of Deflate within a chunk, and a block of EXIF or XMP in the hexadecimal digits that programs write as text.
_DEFLATE, _DIGITS = re.compile(rb"x[\x01\x5e\x9c\xda]"), re.compile(rb"\n\w+\s+\d+\n([0-9a-fA-F\s]+)")
_MAX_CHUNK_BYTES = 1 << 20


def read_png(path: Path) -> Frame:
    """Read a PNG by imagecodecs: it keeps 16 bits, and only warns of wrong check sums of what decides no pixel."""
    import imagecodecs

    data = _picture(path)
    width, height, depth, colour = struct.unpack_from(">IIBB", data.ljust(26, b"\0"), 16)
    samples = _PNG_SAMPLES.get(colour, 4)
    held = (2 if depth == 16 else 1) * (samples + (samples > 1))  # and the luma that is made of colour
    check_size(path, width, height, held, 2 * len(data))
    with failure_explained(f"{path}: the PNG is damaged or cut", "copy the file again"), quiet_libraries():
        pixels = imagecodecs.png_decode(data)
    return colour_frame(path, pixels, exif_metadata(*_png_blocks(data)))


def _png_blocks(data: bytes) -> Iterator[bytes]:
    """What the chunks beside the pixels hold, unfolded: EXIF and XMP are known by their content."""
    at = 8
    while at + 8 < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        content, at = data[at + 8 : at + 8 + size], at + 12 + size
        if kind == b"IDAT" or size > _MAX_CHUNK_BYTES:
            continue
        if packed := _DEFLATE.search(content):
            with suppress(zlib.error):
                content = zlib.decompressobj().decompress(content[packed.start() :], _MAX_CHUNK_BYTES)
        digits = _DIGITS.search(content)
        with suppress(ValueError):  # half a byte
            content = bytes.fromhex(digits[1].decode()) if digits else content
        yield content


#: TIFF 6.0 and its supplements: compressions whose libraries write no more than they are given room for, and JPEG.
_COMPRESSIONS, _JPEG = (1, 5, 8, 32773, 32946, 34925, 50000, 7), 7
#: Kinds of samples: white is zero, black is zero, RGB, indices of a palette; of JPEG pictures YCbCr, which become RGB.
_MIN_IS_WHITE, _PALETTE, _PHOTOMETRICS, _YCBCR = 0, 3, (0, 1, 2, 3), 6
#: Samples of fewer bits fill their two bytes, or one, from below.
_PACKED_BITS = 16
#: Thumbnails and masks, as flags of NewSubfileType.
_REDUCED_OR_MASK = 1 | 4
#: Share of the samples that a screen exceeds by far, and how far above the others few samples count.
_FEW, _FAR = 1e-3, 4.0
#: Pages of a file that are looked at, and bytes that are read of one at a time.
_MAX_PAGES, _READ_BYTES = 32, 1 << 20


def read_tiff(path: Path) -> Frame:
    """Read the largest picture of a TIFF."""
    import tifffile

    logging.getLogger("tifffile").setLevel(logging.CRITICAL + 1)  # what matters comes as an exception
    with path.open("rb") as file:
        if Directories(file).claims_too_much:
            raise InputError(f"{path}: the TIFF's directories claim more than the file holds", "copy it again")
        metadata = tiff_metadata(file)
    with failure_explained(f"{path}: the TIFF is damaged or cut", "copy it again"), tifffile.TiffFile(path) as tiff:
        page = _picture_page(tiff)
        _check_page(page, path)
        own = orientation_of_tag(page.tags.valueof(ORIENTATION))
        metadata = replace(metadata, orientation=own or metadata.orientation)
        step = "copy it again" if page.compression == 1 else "copy it again, or save it uncompressed"
        with failure_explained(f"{path}: the TIFF cannot be read", step):
            pixels = page.asarray(maxworkers=1, buffersize=_READ_BYTES)
        if page.axes == "SYX":
            pixels = np.moveaxis(pixels, 0, -1)
        if page.photometric == _PALETTE:
            pixels = (luma_of(page.colormap.T[None])[0] >> 8).astype(np.uint8)[pixels]
        luma, linear = _tiff_luma(pixels, path)
        colours = colours_of(pixels) if pixels.dtype == luma.dtype and page.photometric != _MIN_IS_WHITE else None
        is_packed = page.dtype.kind == "u" and page.photometric != _PALETTE and 1 < page.bitspersample < _PACKED_BITS
    white = (1 << page.bitspersample) - 1 if is_packed else np.iinfo(luma.dtype).max
    luma = white - luma if page.photometric == _MIN_IS_WHITE else luma
    return Frame(luma, str(path), metadata=metadata, white=float(white), linear=linear, colours=colours)


def _picture_page(tiff: Any) -> Any:
    """The largest page of a TIFF that is no thumbnail and no mask; some programs write thumbnails first."""
    pages = []
    for page in islice(tiff.pages, _MAX_PAGES):
        pages.append(page)
        with suppress(Exception):  # nested ones may be broken, or none
            pages += islice(page.pages, _MAX_PAGES)
    whole = [page for page in pages if not page.subfiletype & _REDUCED_OR_MASK]
    return max(whole or pages, key=lambda page: page.imagewidth * page.imagelength)


def _check_page(page: Any, path: Path) -> None:
    """Refuse what is no plain picture, and what would fill the memory: samples, floats, luma, and one part unfolded."""
    photometric, compression = (getattr(tag, "name", tag) for tag in (page.photometric, page.compression))
    is_jpeg, kinds, bits = page.compression == _JPEG, page.axes in ("YX", "YXS", "SYX"), page.bitspersample
    if not (kinds and page.photometric in (*_PHOTOMETRICS, *[_YCBCR] * is_jpeg)) or page.dtype is None:
        reason = f"{path}: the TIFF holds {photometric} samples of {bits} bits (axes {page.axes})"
        raise InputError(reason, "save one plain picture, grey or RGB, with 8 or 16 bits a sample")
    if page.compression not in _COMPRESSIONS:
        reason = f"{path}: the TIFF's compression is {compression} of {bits} bits"
        raise InputError(reason, "save it uncompressed, or with LZW or Deflate")
    size, samples = page.dtype.itemsize, max(page.samplesperpixel, 1)
    held = size * samples + (5 * samples + 6 if size > 2 or page.dtype.kind == "f" else size * (samples > 1))
    held += size * samples * ((page.axes == "SYX") + (page.photometric == _MIN_IS_WHITE) + 2 * (bits % 8 > 0))  # copies
    rows, width = (page.tilelength, page.tilewidth) if page.is_tiled else (page.rowsperstrip, page.imagewidth)
    part = size * samples * width * (rows if page.is_tiled else min(rows, page.imagelength))
    check_size(path, page.imagewidth, page.imagelength, held, part if page.compression != 1 else 0)
    if sum(page.databytecounts) > 2 * path.stat().st_size:
        raise InputError(f"{path}: the TIFF's directories claim more than the file holds", "copy it again")
    if is_jpeg and any(w > width or h > rows for w, h in _jpeg_sizes(page)):
        raise InputError(f"{path}: the TIFF holds a JPEG larger than itself", "the file is damaged or a bomb")


def _jpeg_sizes(page: Any) -> Iterator[tuple[int, int]]:
    """Width and height of the JPEG pictures that the parts of a page are."""
    for at, length in zip(page.dataoffsets, page.databytecounts, strict=False):
        page.parent.filehandle.seek(at)
        header = jpeg.header_of(page.parent.filehandle.read(length))
        yield header.width, header.height


def _tiff_luma(pixels: NDArray[Any], path: Path) -> tuple[Luma, bool]:
    """Luma of TIFF samples, and whether it is linear; float samples are light, scaled to 16 bits."""
    if pixels.dtype == bool:
        pixels = pixels.view(np.uint8) * np.uint8(255)
    if pixels.dtype in (np.uint8, np.uint16):
        return luma_of(pixels), False
    if pixels.dtype == np.uint32:  # software fills either end of 32 bits: take the upper 16 in use
        bits = int(_brightest(pixels)).bit_length()
        shared = np.minimum(pixels, np.uint32((1 << bits) - 1))
        return luma_of((shared >> max(bits - 16, 0) << max(16 - bits, 0)).astype(np.uint16)), False
    if pixels.dtype.kind != "f":
        raise InputError(f"{path}: TIFF samples of type {pixels.dtype}", "save it with 8 or 16 bits a sample")
    light = luma_of(_light_of(pixels))
    return np.rint(np.clip(light, 0, 1, out=light) * 65535).astype(np.uint16), True


def _light_of(pixels: NDArray[Any]) -> NDArray[np.float32]:
    """Float samples as shares of the brightest one; what is no number is dark."""
    light = np.zeros(pixels.shape, np.float32)
    with np.errstate(over="ignore"):
        top = pixels.dtype.type(_brightest(pixels) or 1.0)
        np.divide(pixels, top, out=light, where=np.isfinite(pixels), casting="same_kind")
    return light


def _brightest(pixels: NDArray[Any]) -> float:
    """The largest sample; of few that are far above all others, the largest that leaves the others their levels."""
    thinned = pixels[::THINNED, ::THINNED]
    usual = np.quantile(thinned[np.isfinite(thinned)], 1 - _FEW) if np.isfinite(thinned).any() else 0.0
    top = float(np.max(pixels, initial=0, where=np.isfinite(pixels)))
    return min(top, _FAR * float(usual)) if usual > 0 else top


def read_other(path: Path) -> Frame:
    """Read AVIF, BMP or WebP: messengers send them. AVIF's own turns come as EXIF orientation."""
    from PIL import Image

    data = read_bytes(path)
    with (
        failure_explained(f"{path}: the picture is damaged", "copy the file again"),
        warnings.catch_warnings(action="ignore"),  # sizes are checked here, and broken directories do no harm
        Image.open(io.BytesIO(data), formats=("AVIF", "BMP", "WEBP")) as image,
    ):
        check_size(path, *image.size, 18, len(data))  # measured: WebP without loss takes most
        pixels = np.asarray(image if image.mode in ("L", "RGB") else image.convert("RGB"))
        blocks = (image.info.get(kind) or b"" for kind in ("exif", "xmp"))
        return colour_frame(path, np.asarray(pixels, np.uint8), exif_metadata(*blocks))
