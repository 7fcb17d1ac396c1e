"""JPEG luma by simplejpeg, the fastest reader of it; shared by photos, MJPEG clips and cameras."""

import re
import struct
import tempfile
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import InputError, failure_explained, reason_of
from rxcli.ingest.luma import BT601, as_shares, luma_of, without_red
from rxcli.ingest.quiet import quiet_libraries
from rxcli.ingest.sniff import check_size
from rxcli.types import Colours, Float32Array

#: What simplejpeg raises.
_FAULTS = (ValueError, KeyError, MemoryError, OverflowError)
#: ITU-T T.81, table B.1: starts of frames (sequential ones, and progressive ones, whose coefficients come in several
#: scans), of the picture and of a scan; its end; notes of programs, and Adobe's. T.87: start of a JPEG-LS frame.
_SEQUENTIAL, _PROGRESSIVE = (0xC0, 0xC1, 0xC9), (0xC2, 0xC6, 0xCA, 0xCE)
_JPEG_LS = 0xF7
_FRAMES = (*_SEQUENTIAL, *_PROGRESSIVE, 0xC3, 0xC5, 0xC7, 0xCB, 0xCD, 0xCF, _JPEG_LS)
#: B.2.5: the segment behind the first scan that states the height where the frame's header states none.
_HEIGHT = re.compile(rb"\xff\xdc\x00\x04(..)", re.DOTALL)
_START, _END, _SCAN, _NOTES, _ADOBE = 0xD8, 0xD9, 0xDA, (*range(0xE0, 0xF0), 0xFE), 0xEE
#: A marker; no padding, no stuffed byte, and no restart within a scan.
_MARKER = re.compile(rb"\xff[^\x00\x01\xff\xd0-\xd7]")
#: Where one picture follows another, as streamers write them; cameras list further pictures of a photo (CIPA DC-007).
_NEXT, _LISTED = re.compile(rb"\xff\xd9[\0\r\n]*\xff\xd8\xff"), b"MPF\0"
#: Frames from here on are coded arithmetically, which shows no missing end.
_ARITHMETIC = 0xC9
#: Bits a sample of photographs.
_BITS = 8
#: Coefficients of a block.
_BLOCK = 64
#: OpenCV's flags for a picture in colour: the means of blocks of eight by eight pixels, and all of it.
_EIGHTH, _WHOLE = 65, 1
#: Rows of an eighth of a picture in which its last block may end.
_BLOCK_ROWS = 4
#: Encoders use some ten scans, each over the whole picture, and notes some hundred segments.
_MAX_SCANS, _MAX_SEGMENTS = 100, 1 << 14
_SURPLUS = re.compile(r"Corrupt JPEG data: (\d+) extraneous bytes before marker 0xd9")
#: Bytes that the decoder may have read ahead when it counts the surplus.
_READ_AHEAD = 16


class Header(NamedTuple):
    """What the headers of a JPEG state; width and height are zero where there is no scan."""

    width: int
    height: int
    #: Bits a sample.
    precision: int = _BITS
    #: Marker of the frame.
    marker: int = 0
    #: Bytes a pixel that decoding takes.
    held: float = 1.0
    is_one_scan: bool = False

    @property
    def is_uncommon(self) -> bool:
        """Whether it is JPEG-LS, or of another number of bits than photographs."""
        return self.precision != _BITS or self.marker == _JPEG_LS


def decode_luma(data: Any, source: object, at_once: int = 1) -> NDArray[np.uint8]:
    """Luma (height, width) of a JPEG picture, as stored (never turned).

    Args:
        data: bytes-like.
        source: names the picture in messages.
        at_once: pictures that share the memory.

    Raises:
        InputError: truncated (with the number of rows), damaged, or no JPEG.
    """
    data = bytes(data)
    header = _checked_header(data, source, at_once)
    # What follows the picture, as in motion photos, may hold more.
    may_have_many = not header.is_one_scan and data.count(bytes((0xFF, _SCAN))) > _MAX_SCANS
    if may_have_many and sum(part[0] == _SCAN for part in segments(data, beyond_scan=True)) > _MAX_SCANS:
        raise InputError(f"{source}: the JPEG has more than {_MAX_SCANS} scans", "the file is damaged or a bomb")
    try:
        return _gray(data)
    except _FAULTS:
        return _decode_odd(*_picture_of(data), source)


def decode_uncommon(data: bytes, source: object) -> tuple[NDArray[Any], float]:
    """Samples, (height, width) or RGB, of a picture that is `Header.is_uncommon`, and their level of white.

    Raises:
        InputError: truncated, damaged.
    """
    import imagecodecs

    header = _checked_header(data, source)
    with failure_explained(f"{source}: cannot be decoded as JPEG", "copy the file again"):
        if header.marker == _JPEG_LS:
            pixels = imagecodecs.jpegls_decode(data)
        else:
            pixels = imagecodecs.jpeg8_decode(data)
            if not _picture_of(data)[1]:
                raise InputError(f"{source}: the JPEG is cut: its last part is missing", "copy the file again")
    return pixels, float((1 << header.precision) - 1)


def with_height(data: bytes) -> bytes:
    """The picture with its height in its header, where it has 0 there and the height behind the first scan (DNL)."""
    frame = next((start for marker, start, _ in segments(data) if marker in _FRAMES), 0)
    found = _HEIGHT.search(data, frame) if frame and data[frame + 1 : frame + 3] == b"\0\0" else None
    if found is None:
        return data
    return data[: frame + 1] + found[1] + data[frame + 3 : found.start()] + data[found.end() :]


def _checked_header(data: bytes, source: object, at_once: int = 1) -> Header:
    header = header_of(data)
    if not header.width:
        raise InputError(f"{source}: the JPEG header is damaged or cut", "copy the file again")
    check_size(source, header.width, header.height, at_once * header.held, at_once * len(data))
    return header


def colours_of(data: bytes) -> Colours:
    """The colours of a JPEG picture whose luma was decoded, as stored."""

    def decoded(data: bytes, size: int) -> NDArray[np.uint8]:
        import cv2

        with quiet_libraries():
            bgr = cv2.imdecode(np.frombuffer(data, np.uint8), size | cv2.IMREAD_IGNORE_ORIENTATION)
        return np.zeros((1, 1, 3), np.uint8) if bgr is None else np.asarray(bgr[:, :, ::-1], np.uint8)

    def first_rows(share: float) -> Float32Array:
        part = decoded(data[: int(share * len(data))] + bytes((0xFF, _END)), _EIGHTH)
        read = np.flatnonzero((part != part[-1]).any(axis=(1, 2)))  # Rows of blocks that are missing are level.
        return as_shares(part[: max(read.size and int(read[-1]) + 1 - _BLOCK_ROWS, 0)])

    return Colours(
        lambda: as_shares(decoded(data, _EIGHTH)),
        lambda: luma_of(decoded(data, _WHOLE), without_red(BT601)),
        first_rows if header_of(data).is_one_scan else None,
    )


def header_of(data: bytes) -> Header:
    """The header of a JPEG picture.

    Luma is held, and the coefficients of all components where they come in several scans, or their deep samples. ITU-T
    T.81, B.2.2: a frame's header holds precision, height, width and number of components; B.2.3: a scan's begins with
    the number of its components.
    """
    header, n_components = Header(0, 0), 0
    for marker, start, end in segments(data):
        content = data[start:end]
        if marker == _SCAN:
            is_one_scan = header.marker not in _PROGRESSIVE and content[:1] == bytes([n_components])
            return header._replace(is_one_scan=is_one_scan)
        if marker in _FRAMES and len(content) >= 6:
            precision, height, width, n_components = struct.unpack_from(">BHHB", content)
            header = Header(width, height, precision, marker)
            if marker in _PROGRESSIVE or header.is_uncommon:
                header = header._replace(held=3.0 + 2 * n_components)
    return Header(0, 0)


def is_row(data: bytes) -> bool:
    """Whether bytes that begin with a JPEG picture are three or more in a row: a clip, no photo with a second view."""
    has_joints = data.count(bytes((0xFF, _END))) > 1 and len(_NEXT.findall(data)) > 1
    return has_joints and not any(data.startswith(_LISTED, at) for _, at, _ in segments(data))


def segments(data: bytes, beyond_scan: bool = False) -> Iterator[tuple[int, int, int]]:
    """Marker, and start and end of the content, of the segments up to the first scan (ITU-T T.81, B.1.1.4).

    Stray bytes are passed over. With `beyond_scan` the segments between scans and the end marker follow.
    """
    at, is_header = 2, True
    for _ in range(_MAX_SEGMENTS):
        found = _MARKER.search(data, at)
        if found is None:
            return
        marker, at = data[found.end() - 1], found.end()
        if marker == _START and is_header:  # written twice
            continue
        end = at if marker in (_START, _END) else at + max(int.from_bytes(data[at : at + 2]), 2)
        yield marker, at + 2, end
        is_header = is_header and marker != _SCAN
        if marker == _END or not (is_header or beyond_scan):
            return
        at = end


def _gray(data: Any, strict: bool = True) -> NDArray[np.uint8]:
    import simplejpeg

    luma: NDArray[np.uint8] = simplejpeg.decode_jpeg(data, colorspace="GRAY", strict=strict)[:, :, 0]
    return luma


def _decode_odd(picture: bytes, has_end: bool, is_complete: bool, source: object) -> NDArray[np.uint8]:
    """Decode what is left of a file that is not as the standard asks; report damage, and the rows of a cut picture."""
    with failure_explained(f"{source}: cannot be decoded as JPEG", "copy the file again"):
        luma, fault = _with_fault(picture)
    if (has_end or is_complete) and (not fault or _is_surplus(picture, fault, has_end)):
        return luma
    rows, height = _rows_present(luma), len(luma)
    missing = f"{rows} of {height} rows are there" if rows < height else "its last part is missing"
    reason = f"is damaged ({fault})" if has_end else f"is cut: {missing}"
    raise InputError(f"{source}: the JPEG {reason}", "copy the file again")


def _with_fault(picture: bytes) -> tuple[NDArray[np.uint8], str]:
    """Luma, and the first fault that the decoder met; by OpenCV where simplejpeg does not know the sampling."""
    import cv2

    try:
        return _gray(picture), ""
    except _FAULTS as error:
        fault = reason_of(error)
    if "subsampling" not in fault:
        return _gray(picture, strict=False), fault
    with tempfile.TemporaryFile() as messages:
        with quiet_libraries(messages):
            luma = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        messages.seek(0)
        fault = messages.readline().decode("ascii", "replace").strip()
    if luma is None:
        raise ValueError(fault or "no picture in it")
    return np.asarray(luma, np.uint8), fault


def _picture_of(data: bytes) -> tuple[bytes, bool, bool]:
    """The picture alone, whether its end marker was there, and whether its scans are complete.

    Stray bytes, notes of programs and what follows the picture are left out. The last three bytes of a scan's header
    mean nothing in a sequential picture, and are set as ITU-T T.81, table B.3, asks.
    """
    # Coefficients that no scan has given yet are counted over the blocks of all components.
    parts, scan_at, n_missing, frame_marker = [b"\xff\xd8"], 0, 1, 0
    for marker, start, end in segments(data, beyond_scan=True):
        if scan_at:
            parts.append(data[scan_at : start - 4])
        if marker == _END or (scan_at and n_missing <= 0):
            break
        content = data[start:end]
        if marker in _FRAMES:
            frame_marker, n_missing = marker, _BLOCK * (content + bytes(6))[5]
        elif marker == _SCAN and len(content) > 3:
            content = content[:-3] + b"\0\x3f\0" if frame_marker in _SEQUENTIAL else content
            start_k, end_k, precision = content[-3:]
            is_last_bit = precision & 15 == 0
            n_of_block = (end_k + 1 - start_k) * is_last_bit if frame_marker in _PROGRESSIVE else _BLOCK
            n_missing -= content[0] * n_of_block
        if marker not in _NOTES or (marker == _ADOBE and content[11:12] in (b"\0", b"\1", b"\2")):
            parts.append(struct.pack(">BBH", 0xFF, marker, len(content) + 2) + content)
        scan_at = end if scan_at or marker == _SCAN else 0
    else:
        marker = 0
        parts.append(data[scan_at:] if scan_at else b"")
    return b"".join([*parts, b"\xff\xd9"]), marker == _END, n_missing <= 0 and frame_marker < _ARITHMETIC


def _is_surplus(picture: bytes, reason: str, has_end: bool) -> bool:
    """Whether the only fault is what stands between the last scan and the end: padding, or a trailer without a marker.

    A run of one byte, as some cameras write it, that begins within the scan is what a lost part was filled with.
    """
    match = _SURPLUS.search(reason)
    if match is None:
        return False
    start = len(picture) - 2 - int(match[1])
    is_run = len(set(picture[start:-2])) == 1
    return len(set(picture[start - _READ_AHEAD : -2])) > 1 if is_run else not has_end


def _rows_present(luma: NDArray[np.uint8]) -> int:
    """Rows of a cut picture before the even grey that the decoder puts in for what is missing."""
    present = np.flatnonzero((luma != luma[-1, -1]).any(axis=1))
    return int(present[-1]) + 1 if present.size else 0
