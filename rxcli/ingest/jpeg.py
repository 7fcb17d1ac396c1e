"""JPEG luma by simplejpeg, the fastest reader of it; shared by photos, MJPEG clips and cameras."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import InputError
from rxcli.ingest.sniff import check_size, reason_of

#: What simplejpeg raises; KeyError for a subsampling that it does not know.
_FAULTS = (ValueError, KeyError, MemoryError, OverflowError)
_PADDING = re.compile(r"Corrupt JPEG data: (\d+) extraneous bytes before marker 0xd9")


def decode_luma(data: Any, source: object) -> NDArray[np.uint8]:
    """Luma (height, width) of a JPEG picture, as stored (never turned).

    Args:
        data: bytes-like.
        source: names the picture in messages.

    Raises:
        InputError: cut, damaged, or no JPEG; says how many rows are there.
    """
    import simplejpeg

    try:
        height, width, _, _ = simplejpeg.decode_jpeg_header(data, strict=False)
    except _FAULTS:
        raise InputError(f"{source}: the JPEG header is damaged or cut", "copy the file again") from None
    check_size(source, width, height)
    try:
        return _gray(data)
    except _FAULTS as error:
        return _second_look(data, reason_of(error), source)


def _gray(data: Any, strict: bool = True) -> NDArray[np.uint8]:
    import simplejpeg

    luma: NDArray[np.uint8] = simplejpeg.decode_jpeg(data, colorspace="GRAY", strict=strict)[:, :, 0]
    return luma


def _second_look(data: Any, reason: str, source: object) -> NDArray[np.uint8]:
    """Accept harmless padding; say of anything else what is left of the picture."""
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
