"""The bare decode of a file, which the time of a reception is compared with."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from rxcli.ingest.sniff import HEAD_BYTES, read_bytes, sniff


def bare_decode(path: Path) -> Callable[[], int] | None:
    """A function that decodes the file, nothing else, and gives the number of frames; None for other kinds of files."""
    kind = sniff(read_bytes(path, HEAD_BYTES), path.suffix.lower())
    decoder = {"jpeg": _jpeg, "png": _png, "video": _video, "raw": _raw, "tiff": _raw}.get(kind or "")
    return None if decoder is None else partial(decoder, path)


def _jpeg(path: Path) -> int:
    import simplejpeg

    simplejpeg.decode_jpeg(path.read_bytes(), colorspace="GRAY")
    return 1


def _png(path: Path) -> int:
    import cv2

    return int(cv2.imread(str(path), cv2.IMREAD_UNCHANGED) is not None)


def _raw(path: Path) -> int:
    import rawpy

    with rawpy.imread(str(path)) as raw:
        return int(raw.raw_image.ndim > 0)


def _video(path: Path) -> int:
    """Decode every luma plane as a view, on as many threads as FFmpeg takes; returns the number of frames."""
    import av

    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_type, stream.codec_context.thread_count = "FRAME", 0
        return sum(np.frombuffer(frame.planes[0], np.uint8).size > 0 for frame in container.decode(stream))
