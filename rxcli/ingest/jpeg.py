"""JPEG luma by simplejpeg, the fastest reader of it; shared by photos, MJPEG clips and cameras."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import InputError, reason_of
from rxcli.ingest.sniff import check_size

#: What simplejpeg raises; KeyError for a subsampling that it does not know.
_FAULTS = (ValueError, KeyError, MemoryError, OverflowError)
#: Frames whose coefficients are gathered from several scans; baseline ones may be, too, in separate scans.
_PROGRESSIVE = (0xC2, 0xC6, 0xCA, 0xCE)
#: Start of a scan.
_SCAN = 0xDA
#: Encoders use some ten; every scan goes over the whole picture.
_MAX_SCANS = 100
_PADDING = re.compile(r"Corrupt JPEG data: (\d+) extraneous bytes before marker 0xd9")


def decode_luma(data: Any, source: object, at_once: int = 1) -> NDArray[np.uint8]:
    """Luma (height, width) of a JPEG picture, as stored (never turned).

    Args:
        data: bytes-like.
        source: names the picture in messages.
        at_once: pictures that share the memory.

    Raises:
        InputError: truncated (with the number of rows), damaged, or no JPEG.
    """
    import simplejpeg

    try:
        height, width, _, _ = simplejpeg.decode_jpeg_header(data, strict=False)
    except _FAULTS:
        raise InputError(f"{source}: the JPEG header is damaged or cut", "copy the file again") from None
    held, is_one_scan = _frame_of(data)
    check_size(source, width, height, at_once * held, at_once * len(data))
    if not is_one_scan and bytes(data).count(b"\xff\xda") > _MAX_SCANS:
        raise InputError(f"{source}: the JPEG has more than {_MAX_SCANS} scans", "the file is damaged or a bomb")
    try:
        return _gray(data)
    except _FAULTS as error:
        return _decode_damaged(data, reason_of(error), source)


def _frame_of(data: Any) -> tuple[float, bool]:
    """Bytes a pixel that decoding takes, and whether all of it is one scan.

    Luma, and the coefficients of all components where they come in several scans. ITU-T T.81, B.2.2: the frame header's
    marker identifies the process, its sixth byte is the number of components; B.2.3: the first byte of a scan's header
    is the number of its components.
    """
    held, n_components, is_progressive = 1.0, 0, False
    for marker, start, _ in segments(data):
        if marker == _SCAN:
            return held, not is_progressive and data[start] == n_components
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            n_components, is_progressive = data[start + 5], marker in _PROGRESSIVE
            held = 1.0 + (2 * n_components if is_progressive else 0)
    return held, False


def segments(data: Any) -> Iterator[tuple[int, int, int]]:
    """Marker, and start and end of the content, of the segments up to the first scan (ITU-T T.81, B.1.1.4)."""
    at = 2
    while at + 10 <= len(data) and data[at] == 0xFF:
        if data[at + 1] == 0xFF:  # padding
            at += 1
            continue
        end = at + 2 + max(data[at + 2] << 8 | data[at + 3], 2)
        yield data[at + 1], at + 4, end
        if data[at + 1] == _SCAN:
            return
        at = end


def _gray(data: Any, strict: bool = True) -> NDArray[np.uint8]:
    import simplejpeg

    luma: NDArray[np.uint8] = simplejpeg.decode_jpeg(data, colorspace="GRAY", strict=strict)[:, :, 0]
    return luma


def _decode_damaged(data: Any, reason: str, source: object) -> NDArray[np.uint8]:
    """Accept harmless padding; report any other damage with the number of rows present."""
    try:
        luma = _gray(data, strict=False)
    except _FAULTS:
        raise InputError(f"{source}: cannot be decoded as JPEG ({reason})", "copy the file again") from None
    if _is_padding(bytes(data), reason):
        return luma
    if "end of JPEG" in reason:
        missing = f"the JPEG is cut: {_rows_present(luma)} of {luma.shape[0]} rows are there"
    else:
        missing = f"the JPEG is damaged ({reason})"
    raise InputError(f"{source}: {missing}", "copy the file again")


def _is_padding(data: bytes, reason: str) -> bool:
    """Whether the only fault is a run of one byte before the end marker, as some cameras write it."""
    match = _PADDING.search(reason)
    if match is None:
        return False
    end = data.rfind(b"\xff\xd9")
    return len(set(data[end - int(match[1]) : end])) == 1


def _rows_present(luma: NDArray[np.uint8]) -> int:
    """Rows of a cut picture before the even grey that the decoder puts in for what is missing."""
    present = np.flatnonzero((luma != luma[-1, -1]).any(axis=1))
    return int(present[-1]) + 1 if present.size else 0
