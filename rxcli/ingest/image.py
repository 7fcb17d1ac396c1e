"""Developed pictures -> luma as stored: JPEG, PNG, TIFF, HEIC, and what else Pillow reads.

Colour is reduced to BT.601 luma, which is what a JPEG of the same picture would hold.
"""

from __future__ import annotations

import io
import logging
import warnings
import zlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import InputError
from rxcli.ingest.extent import claims_too_much
from rxcli.ingest.luma import Luma, luma_of
from rxcli.ingest.metadata import exif_metadata, jpeg_metadata, tiff_metadata
from rxcli.ingest.quiet import quiet_libraries
from rxcli.ingest.sniff import Kind, check_size, damage_explained, read_bytes
from rxcli.types import Frame, Metadata

#: Pillow's are left out: sizes are checked here, and broken directories do no harm.
_no_warnings = partial(warnings.catch_warnings, action="ignore")


def read_image(path: Path, kind: Kind) -> Frame:
    """Read the frame of a developed picture; `kind` is that of `rxcli.ingest.sniff`.

    Raises:
        InputError: cut, damaged, too large, of a kind that needs an extra, or no picture.
    """
    if kind == "tiff":
        return _read_tiff(path)
    data = read_bytes(path)
    if kind == "jpeg":
        from rxcli.ingest.jpeg import decode_luma

        return _frame(path, decode_luma(data, path), jpeg_metadata(data))
    if kind == "png":
        return _read_png(data, path)
    if kind == "heif":
        from rxcli.ingest.heif import read_heif

        return _frame(path, *read_heif(data, path))
    return _frame(path, _read_with_pillow(data, path), Metadata())


def _frame(path: Path, luma: Luma, metadata: Metadata, linear: bool = False) -> Frame:
    white = float(np.iinfo(luma.dtype).max)
    return Frame(pixels=luma, source=str(path), metadata=metadata, white=white, linear=linear)


def _read_png(data: bytes, path: Path) -> Frame:
    """By OpenCV, which keeps 16-bit colour; checked before, because libpng writes complaints to stderr."""
    import cv2

    chunks = dict(_png_chunks(data, path))
    header = chunks.get(b"IHDR", b"").ljust(13, b"\0")
    depth, samples = (2 if header[8] == 16 else 1), _PNG_SAMPLES.get(header[9], 4)
    held = depth * (samples + (samples > 1))  # and the luma that is made of colour
    check_size(path, int.from_bytes(header[:4]), int.from_bytes(header[4:8]), held, len(data))
    try:
        with quiet_libraries():
            bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        bgr = None
    if bgr is None:
        raise InputError(f"{path}: the PNG is damaged", "copy the file again")
    rgb = bgr if bgr.ndim == 2 else bgr[:, :, 2::-1]
    return _frame(path, luma_of(rgb), exif_metadata(chunks.get(b"eXIf", b"")))


#: ISO 15948, table 11.1: samples of a pixel as OpenCV decodes it, by colour type; some may get an alpha.
_PNG_SAMPLES = {0: 1, 2: 4, 3: 4, 4: 4, 6: 4}


def _png_chunks(data: bytes, path: Path) -> Iterator[tuple[bytes, bytes]]:
    """Name and content of the chunks of a PNG (ISO 15948, section 5.3), checked; image data without its content."""
    at = 8
    while True:
        length, name = int.from_bytes(data[at : at + 4]), data[at + 4 : at + 8]
        end = at + 8 + length
        if end + 4 > len(data):
            raise InputError(f"{path}: the PNG is cut after {len(data)} bytes", "copy the file again")
        if zlib.crc32(memoryview(data)[at + 4 : end]) != int.from_bytes(data[end : end + 4]):
            raise InputError(f"{path}: the PNG is damaged at byte {at}", "copy the file again")
        yield name, b"" if name == b"IDAT" else data[at + 8 : end]
        if name == b"IEND":
            return
        at = end + 4


def _read_tiff(path: Path) -> Frame:
    import tifffile

    logging.getLogger("tifffile").setLevel(logging.CRITICAL + 1)  # what matters comes as an exception
    with path.open("rb") as file:
        if claims_too_much(file):
            raise InputError(f"{path}: the TIFF's directories claim more than the file holds", "copy it again")
        metadata = tiff_metadata(file)
    step = "save it uncompressed, or copy it again"
    with damage_explained(f"{path}: the TIFF cannot be read", step), tifffile.TiffFile(path) as tiff:
        page = tiff.pages[0]
        _check_page(page, path)
        pixels, min_is_white = _tiff_pixels(page, path), page.photometric == tifffile.PHOTOMETRIC.MINISWHITE
    if pixels.ndim not in (2, 3):
        raise InputError(f"{path}: the TIFF is damaged", "copy it again")
    luma, linear = _tiff_luma(pixels, path)
    return _frame(path, np.iinfo(luma.dtype).max - luma if min_is_white else luma, metadata, linear)


def _check_page(page: Any, path: Path) -> None:
    """Refuse what would fill the memory: samples as they are, as float32 or 16 bits, and luma."""
    size, samples = page.bitspersample // 8 or 1, max(page.samplesperpixel, 1)
    held = size * samples + (4 * samples if size > 2 else 0) + (size if samples > 1 else 0)
    check_size(path, page.imagewidth, page.imagelength, held, page.rowsperstrip * page.imagewidth * size * samples)


def _tiff_pixels(page: Any, path: Path) -> NDArray[Any]:
    """Pixels (height, width[, samples]) of a TIFF page, by Pillow where tifffile has no codec; neither turns them."""
    if page.axes == "SYX":
        return np.moveaxis(page.asarray(), 0, -1)
    if page.axes not in ("YX", "YXS"):
        raise InputError(f"{path}: the TIFF's axes are {page.axes}", "save one plain picture")
    if page.compression in (5, 6, 7) or page.colormap is not None:  # LZW, JPEG: tifffile needs imagecodecs for them
        return _pillow_tiff(path, page)
    return np.asarray(page.asarray())


def _pillow_tiff(path: Path, page: Any) -> NDArray[Any]:
    from PIL import Image

    from rxcli.ingest.orientation import as_stored

    tag = page.tags.get("Orientation")
    orientation = int(tag.value) if tag is not None and tag.value in range(1, 9) else 1
    with _no_warnings(), quiet_libraries(), Image.open(path, formats=("TIFF",)) as image:
        return as_stored(_pillow_pixels(image), orientation)  # Pillow turns TIFFs for viewing


def _tiff_luma(pixels: NDArray[Any], path: Path) -> tuple[Luma, bool]:
    """Luma of TIFF samples, and whether it is linear; float samples are light, scaled to 16 bits."""
    if pixels.dtype == bool:
        pixels = pixels.view(np.uint8) * np.uint8(255)
    if pixels.dtype in (np.uint8, np.uint16):
        return luma_of(pixels), False
    if pixels.dtype == np.uint32:
        return luma_of(_fewer_bits(pixels)), False
    if pixels.dtype.kind != "f":
        raise InputError(f"{path}: TIFF samples of type {pixels.dtype}", "save it with 8 or 16 bits a sample")
    light = luma_of(_light_of(pixels))
    return np.rint(np.clip(light, 0, 1, out=light) * 65535).astype(np.uint16), True


def _fewer_bits(pixels: NDArray[np.uint32]) -> NDArray[Any]:
    """The upper 16 bits that are used, or the lower 8 where no more are: software fills either end of 32 bits."""
    bits = int(pixels.max(initial=0)).bit_length()
    if bits <= 8:
        return pixels.astype(np.uint8)
    return ((pixels >> (bits - 16)) if bits > 16 else (pixels << (16 - bits))).astype(np.uint16)


def _light_of(pixels: NDArray[Any]) -> NDArray[np.float32]:
    """Float samples as shares of the brightest one; what is no number is dark."""
    finite = np.isfinite(pixels)
    top = float(np.max(pixels, initial=0.0, where=finite)) or 1.0
    light = np.zeros(pixels.shape, np.float32)
    np.divide(pixels, pixels.dtype.type(top), out=light, where=finite, casting="same_kind")
    return light


def _read_with_pillow(data: bytes, path: Path) -> NDArray[np.uint8]:
    """BMP, WebP: rare for a camera, but messengers send them."""
    from PIL import Image

    with (
        damage_explained(f"{path}: the picture is damaged", "copy the file again"),
        _no_warnings(),
        Image.open(io.BytesIO(data), formats=("BMP", "WEBP")) as image,
    ):
        check_size(path, *image.size, 8, len(data))  # as it is stored, as RGB twice, luma
        return np.asarray(luma_of(_pillow_pixels(image)), np.uint8)


def _pillow_pixels(image: Any) -> NDArray[Any]:
    """Grey or RGB pixels of a Pillow image; 16 bits stay 16."""
    plain = image.mode in ("L", "RGB", "I;16", "I;16B", "F")
    pixels = np.asarray(image if plain else image.convert("RGB"))
    return pixels.astype(pixels.dtype.newbyteorder("="))
