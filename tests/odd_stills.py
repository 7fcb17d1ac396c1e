"""Stills as real cameras and programs write them: files that are not as their standards ask, of one picture each."""

import io
import struct
import zlib
from typing import Any

import cv2
import imagecodecs
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
        "many_pictures": (progressive + b"x") * 15,
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


def tiff_header(*entries: tuple[int, int, int, bytes], order: str = "<") -> bytes:
    """A TIFF header and one directory of `entries`: tag, type, number, and the field of four bytes."""
    rows = [struct.pack(order + "HHI4s", *entry) for entry in entries]
    head = struct.pack(order + "2sHI", b"II" if order == "<" else b"MM", 42, 8)
    return head + struct.pack(order + "H", len(rows)) + b"".join(rows) + bytes(4)


def xmp(body: str) -> str:
    names = 'xmlns:tiff="http://ns.adobe.com/tiff/1.0/" xmlns:exif="http://ns.adobe.com/exif/1.0/"'
    start = '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    return f"{start}<rdf:Description {names} {body}</rdf:RDF></x:xmpmeta>"


#: XMP that states orientation 3, by the way in which it does.
XMP = {
    "attribute": xmp('tiff:Orientation="3"/>'),
    "single_quotes": xmp("tiff:Orientation = '3'/>"),
    "element": xmp("><tiff:Orientation>3</tiff:Orientation></rdf:Description>"),
}


def orientations(picture: NDArray[np.uint8]) -> dict[str, bytes]:
    """Files of orientation 3 by name: JPEGs, PNGs and TIFFs that state it as few programs do."""
    short, software = (0x0112, 3, 1, b"\3\0\0\0"), tiff_header((0x0131, 2, 4, b"abc\0"))
    exif = {
        "byte": [tiff_header((0x0112, 1, 1, b"\3\0\0\0"))],
        "ascii": [tiff_header((0x0112, 2, 2, b"3\0\0\0"))],
        "undefined": [tiff_header((0x0112, 7, 1, b"\3\0\0\0"))],
        "long": [tiff_header((0x0112, 4, 1, b"\0\0\0\3"), order=">")],
        "two_values": [tiff_header((0x0112, 3, 2, b"\3\0\3\0"))],
        "twice": [tiff_header(short, (0x0112, 3, 1, b"\1\0\0\0"))],
        "once_nonsense": [tiff_header((0x0112, 3, 1, b"\x63\0\0\0"), short)],
        "byte_order_mark": [b"\xef\xbb\xbf" + tiff_header(short)],
        "of_program_first": [software, tiff_header(short)],
        "of_program_last": [tiff_header(short), software],
    }
    blocks = {name: [EXIF_HEAD + part for part in parts] for name, parts in exif.items()}
    blocks |= {f"xmp_{name}": [b"http://ns.adobe.com/xap/1.0/\0" + text.encode()] for name, text in XMP.items()}
    blocks["xmp_utf_16"] = [XMP["element"].encode("utf-16")]
    blocks["xmp_after_exif"] = [EXIF_HEAD + software, *blocks["xmp_attribute"]]
    jpeg = grey_jpeg(picture[..., 1])
    files = {
        f"{name}.jpg": jpeg[:2] + b"".join(segment(0xE1, part) for part in parts) + jpeg[2:]
        for name, parts in blocks.items()
    }
    good, block = cv2.imencode(".png", picture[..., ::-1])[1].tobytes(), tiff_header(short)
    hexadecimal = b"\nexif\n%8d\n%s\n" % (len(EXIF_HEAD + block), (EXIF_HEAD + block).hex("\n", 36).encode())
    text, profile = XMP["attribute"].encode(), b"Raw profile type exif\0"
    chunks = {
        "raw_profile": (b"zTXt", profile + b"\0" + zlib.compress(hexadecimal)),
        "raw_profile_plain": (b"tEXt", profile + hexadecimal),
        "raw_profile_international": (b"iTXt", profile + b"\1\0\0\0" + zlib.compress(hexadecimal)),
        "xmp": (b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + text),
        "xmp_packed": (b"iTXt", b"XML:com.adobe.xmp\0\1\0\0\0" + zlib.compress(text)),
        "property": (b"tEXt", b"exif:Orientation\x003"),
        "named": (b"eXIf", EXIF_HEAD + block),
        "other_kind": (b"exIf", block),
    }
    for name, (kind, data) in chunks.items():
        chunk = struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for place, at in (("", 33), ("_last", len(good) - 12)):
            files[f"{name}{place}.png"] = good[:at] + chunk + good[at:]
    out = io.BytesIO()
    with tifffile.TiffWriter(out) as tiff:
        tiff.write(picture[::8, ::8], subfiletype=_REDUCED, metadata=None)
        tiff.write(picture, metadata=None, photometric="rgb", extratags=[(274, "H", 1, 3, True)])
    files["second_page.tif"] = out.getvalue()
    out = io.BytesIO()
    tifffile.imwrite(out, picture, metadata=None, photometric="rgb", extratags=[(700, "B", len(text), text, True)])
    return files | {"xmp.tif": out.getvalue()}


def uncommon_jpegs(luma: NDArray[np.uint8]) -> dict[str, bytes]:
    """JPEG files of more than 8 bits, or without loss, or whose height stands at their end."""
    deep, plain = luma.astype(np.uint16) * 16, grey_jpeg(luma)
    height, scan_end = plain.index(b"\xff\xc0") + 5, len(plain) - 2
    kinds = {"deep": {}, "lossless": {"lossless": True}}
    files = {
        f"{name}_{pixels.ndim}": imagecodecs.jpeg8_encode(pixels, bitspersample=12, **options)
        for name, options in kinds.items()
        for pixels in (deep, np.repeat(deep[..., None], 3, axis=2))
    }
    files |= {"jpeg_ls": imagecodecs.jpegls_encode(luma), "lossless_8": imagecodecs.jpeg8_encode(luma, lossless=True)}
    files["jpeg_ls_deep"] = imagecodecs.jpegls_encode(luma.astype(np.uint16) * 257)
    number = struct.pack(">HHH", 0xFFDC, 4, len(luma))
    files["height_last"] = plain[:height] + bytes(2) + plain[height + 2 : scan_end] + number + plain[scan_end:]
    return files


def tiled_avif(luma: NDArray[np.uint8]) -> bytes:
    """An AVIF of two by two tiles, each a picture of its own (ISO/IEC 23008-12, 6.6.2.3)."""

    def box(kind: bytes, *parts: bytes, full: bool = False) -> bytes:
        content = bytes(4 * full) + b"".join(parts)
        return struct.pack(">I4s", 8 + len(content), kind) + content

    height, width = (side // 2 for side in luma.shape)
    tiles, configuration = [], b""
    for top, left in ((0, 0), (0, width), (height, 0), (height, width)):
        out = io.BytesIO()
        Image.fromarray(luma[top : top + height, left : left + width]).save(out, "AVIF", quality=95)
        data = out.getvalue()
        tiles.append(data[data.index(b"mdat") + 4 :])
        at = data.index(b"av1C")
        configuration = data[at - 4 : at - 4 + int.from_bytes(data[at - 4 : at])]
    grid = struct.pack(">BBBBHH", 0, 0, 1, 1, 2 * width, 2 * height)
    parts, numbers = [grid, *tiles], range(1, 6)
    kinds = [box(b"infe", b"\2\0\0\0" + struct.pack(">HH4sx", n, 0, b"grid" if n == 1 else b"av01")) for n in numbers]
    sizes = [box(b"ispe", struct.pack(">II", w, h), full=True) for w, h in ((2 * width, 2 * height), (width, height))]
    depth = box(b"pixi", b"\1\x08", full=True)
    owned = [struct.pack(">HB", n, 2) + (b"\1\4" if n == 1 else b"\2\x83") for n in numbers]
    properties = box(b"ipco", sizes[0], sizes[1], configuration, depth)
    linked = box(b"ipma", struct.pack(">I", 5), *owned, full=True)

    def meta(start: int) -> bytes:
        places, at = [], start
        for number, part in zip(numbers, parts, strict=True):
            places.append(struct.pack(">HHHII", number, 0, 1, at, len(part)))
            at += len(part)
        handler = box(b"hdlr", bytes(4), b"pict", bytes(13), full=True)
        found = box(b"iloc", b"\x44\0", struct.pack(">H", 5), *places, full=True)
        named = box(b"iinf", struct.pack(">H", 5), *kinds, full=True)
        of_grid = box(b"iref", box(b"dimg", struct.pack(">HH4H", 1, 4, 2, 3, 4, 5)), full=True)
        first = box(b"pitm", struct.pack(">H", 1), full=True)
        return box(b"meta", handler, first, found, named, of_grid, box(b"iprp", properties, linked), full=True)

    head = box(b"ftyp", b"mif1", bytes(4), b"avifmif1miaf")
    return head + meta(len(head) + len(meta(0)) + 8) + box(b"mdat", *parts)


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
