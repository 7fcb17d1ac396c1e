"""Stills as real cameras and programs write them: files that are not as their standards ask, of one picture each."""

import io
import struct
import zlib
from typing import Any

import cv2
import numpy as np
import simplejpeg
import tifffile
from numpy.typing import NDArray
from PIL import Image

EXIF_HEAD = b"Exif\0\0"
_REDUCED, _CAMERA = 1, [(271, "s", 0, "Example", True), (272, "s", 0, "Camera", True)]


def exif_bytes(orientation: int = 1) -> bytes:
    exif = Image.Exif()
    exif[0x010F], exif[0x0112], exif.get_ifd(0x8769)[0x829A] = "Example", orientation, 1 / 24000
    return exif.tobytes()


def segment(marker: int, content: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, marker, len(content) + 2) + content


def odd_jpegs(picture: NDArray[np.uint8]) -> dict[str, tuple[bytes, bytes]]:
    """Odd JPEG files by name, each with the plain file of the same pixels and the same EXIF."""
    written = {}
    for is_progressive in (False, True):
        out = io.BytesIO()
        Image.fromarray(picture).save(out, "JPEG", progressive=is_progressive, exif=exif_bytes(), quality=90)
        written[is_progressive] = out.getvalue()
    plain, progressive = written[False], written[True]
    scan, table, jfif = plain.index(b"\xff\xda"), plain.index(b"\xff\xdb"), segment(0xE0, b"JFIF\0\x02\x01" + bytes(7))
    parameters = scan + 1 + int.from_bytes(plain[scan + 2 : scan + 4]) - 2
    trailer = b"SEFH" + bytes(range(200)) * 2 + b"SEFT"
    icc = segment(0xE2, b"ICC_PROFILE\0\2\1" + bytes(40))

    def with_parameters(*values: int) -> bytes:
        return plain[:parameters] + bytes(values) + plain[parameters + 3 :]

    odd = {
        "spectral_end": with_parameters(0, 0, 0),
        "spectral_all": with_parameters(1, 62, 0x21),
        "no_end": plain[:-2],
        "half_end": plain[:-1],
        "no_end_trailer": plain[:-2] + trailer,
        "no_end_preview": plain[:-2] + plain,
        "no_end_zeros": plain[:-2] + bytes(500),
        "stray_first": plain[:2] + b"stray" + plain[2:],
        "stray": plain[:table] + b"ten stray " + plain[table:],
        "stray_stuffed": plain[:scan] + b"\xff\0\0" + plain[scan:],
        "two_starts": plain[:2] + plain,
        "jfif": plain[:2] + jfif + plain[2:],
        "icc": plain[:2] + icc + plain[2:],
        "adobe": plain[:2] + segment(0xEE, b"Adobe\0\x64\0\0\0\0\x07") + plain[2:],
        "padded_second": plain[:-2] + bytes(4000) + plain[-2:] + plain,
        "scans_one_after_the_other": plain[:-2] + plain[scan:-2] * 200 + plain[-2:],
    }
    late = {
        "tail": progressive + b"\xff\xda" * 101,
        "many_pictures": progressive * 15,
        "comment": progressive[:2] + segment(0xFE, b"\xff\xda" * 101) + progressive[2:],
        "no_end_progressive": progressive[:-2],
        "no_end_trailer_progressive": progressive[:-2] + trailer,
    }
    wide = sampled_4_by_2(picture)
    grey = {
        "sampled": wide,
        "sampled_stray": wide[:2] + b"stray" + wide[2:],
        "sampled_padded": wide[:-2] + bytes(40) + wide[-2:],
    }
    pairs = {name: (data, plain) for name, data in odd.items()} | {
        name: (data, progressive) for name, data in late.items()
    }
    return pairs | {name: (data, grey_jpeg(picture[..., 1])) for name, data in grey.items()}


def grey_jpeg(luma: NDArray[np.uint8]) -> bytes:
    return simplejpeg.encode_jpeg(np.ascontiguousarray(luma)[..., None], colorspace="GRAY", colorsubsampling="Gray")


def sampled_4_by_2(picture: NDArray[np.uint8]) -> bytes:
    """A JPEG with luma of 4 x 2 samples for one of each colour, of three grey JPEGs, a scan each."""
    height, width = picture.shape[:2]
    small = cv2.resize(picture, (-(-width // 4), -(-height // 2)))
    parts = [grey_jpeg(values) for values in (picture[..., 1], small[..., 0], small[..., 2])]
    frame, scan = (parts[0].index(mark) for mark in (b"\xff\xc0", b"\xff\xda"))
    tables = parts[0][frame + 13 : scan]
    header = struct.pack(">BHHB", 8, height, width, 3) + b"\1\x42\0\2\x11\0\3\x11\0"
    scans = [
        segment(0xDA, bytes((1, number, 0, 0, 63, 0))) + part[part.index(b"\xff\xda") + 10 : -2]
        for number, part in enumerate(parts, 1)
    ]
    return parts[0][:frame] + segment(0xC0, header) + tables + b"".join(scans) + b"\xff\xd9"


def odd_pngs(picture: NDArray[np.uint8]) -> dict[str, bytes]:
    """PNG files with wrong check sums of chunks that decide no pixel."""
    good = cv2.imencode(".png", picture[..., ::-1])[1].tobytes()
    contents = {
        "tEXt": b"Comment\0a text",
        "eXIf": exif_bytes(3).removeprefix(EXIF_HEAD),
        "iCCP": b"x\0\0no profile",
        "pHYs": bytes(9),
    }
    chunks = {name: struct.pack(">I", len(data)) + name.encode() + data + b"nope" for name, data in contents.items()}
    return {name: good[:33] + chunk + good[33:] for name, chunk in chunks.items()}


def odd_tiffs(picture: NDArray[np.uint8]) -> dict[str, bytes]:
    """TIFF files by name: of the picture, or of its green as luma, floats as light."""
    luma = np.ascontiguousarray(picture[..., 1])
    deep, light = luma.astype(np.uint16) * 257, luma / np.float32(luma.max())
    planes = np.ascontiguousarray(np.moveaxis(picture, 2, 0))
    grey, rgb = {"photometric": "minisblack"}, {"photometric": "rgb"}
    kinds: dict[str, list[tuple[NDArray[Any], dict[str, Any]]]] = {
        "float_lzw": [(light, grey | {"compression": "lzw"})],
        "float_predicted": [(light, grey | {"compression": "zlib", "predictor": 3})],
        "float16_zstd": [(light.astype(np.float16), grey | {"compression": "zstd", "predictor": 3})],
        "deep_zstd": [(deep, grey | {"compression": "zstd", "predictor": 2})],
        "deep_lzma": [(deep, grey | {"compression": "lzma"})],
        "tiled_lzw": [(deep, grey | {"compression": "lzw", "tile": (32, 48)})],
        "packbits": [(luma, grey | {"compression": "packbits"})],
        "packed12": [((deep >> 4), grey | {"bitspersample": 12})],
        "packed10": [((deep >> 6), grey | {"bitspersample": 10})],
        "planar_lzw": [(planes, rgb | {"compression": "lzw", "planarconfig": "separate"})],
        "white_is_zero": [(255 - luma, {"photometric": "miniswhite"})],
        "white_is_zero_lzw": [(255 - luma, {"photometric": "miniswhite", "compression": "lzw"})],
        "white_is_zero_deep_zlib": [(65535 - deep, {"photometric": "miniswhite", "compression": "zlib"})],
        "thumbnail_first": [(picture[::8, ::8], rgb | {"subfiletype": _REDUCED}), (picture, rgb | {"subfiletype": 0})],
        "thumbnail_of_camera": [
            (picture[::8, ::8], rgb | {"subfiletype": _REDUCED, "extratags": _CAMERA}),
            (picture, rgb | {"subfiletype": 0, "compression": "lzw"}),
        ],
        "nested": [
            (picture[::8, ::8], rgb | {"subfiletype": _REDUCED, "extratags": _CAMERA, "subifds": 1}),
            (picture, rgb | {"subfiletype": 0}),
        ],
        "jpeg": [(luma, grey | {"compression": "jpeg", "compressionargs": {"level": 98}})],
    }
    files = {}
    for name, pages in kinds.items():
        out = io.BytesIO()
        with tifffile.TiffWriter(out) as tiff:
            for pixels, options in pages:
                tiff.write(pixels, metadata=None, **options)
        files[name] = out.getvalue()
    return files


def bomb_tiff(compression: int, part: bytes, n_parts: int = 1, tile_px: int = 0) -> bytes:
    """A TIFF of 1000 x 1000 pixels whose strips, or tiles, are `part`."""
    rows = [(256, 4, 1, 1000), (257, 4, 1, 1000), (258, 3, 1, 8), (259, 3, 1, compression), (262, 3, 1, 1)]
    rows += [(322, 3, 1, tile_px), (323, 3, 1, tile_px)] if tile_px else [(278, 4, 1, -(-1000 // n_parts))]
    start = 8 + 2 + 12 * (len(rows) + 2) + 4
    offsets = range(start + 8 * n_parts, start + 8 * n_parts + len(part) * n_parts, len(part))
    at = (start, start + 4 * n_parts) if n_parts > 1 else (offsets[0], len(part))
    rows += [(tag, 4, n_parts, place) for tag, place in zip((324, 325) if tile_px else (273, 279), at, strict=True)]
    body = (
        b"II*\0\x08\0\0\0" + struct.pack("<H", len(rows)) + b"".join(struct.pack("<HHII", *row) for row in sorted(rows))
    )
    if n_parts == 1:
        return body + bytes(4) + bytes(8) + part
    return body + bytes(4) + struct.pack(f"<{2 * n_parts}I", *offsets, *[len(part)] * n_parts) + part * n_parts


def unfolding(n_mb: int) -> bytes:
    """A Deflate stream that unfolds to `n_mb` times 2^20 bytes."""
    packer = zlib.compressobj(1)
    return b"".join(packer.compress(bytes(1 << 20)) for _ in range(n_mb)) + packer.flush()
