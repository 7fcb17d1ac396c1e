"""Small files of every kind, written for the tests of the readers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import av
import numpy as np
import tifffile
from numpy.typing import NDArray

from rxcli.errors import InputError
from rxcli.ingest import open_source
from rxcli.types import Frame

BAYER = np.array([[0, 1], [1, 2]], np.uint8)
#: The X-Trans pattern of the Fujifilm X-S10, from its first active pixel on.
XTRANS = np.array(["GGRGGB", "GGBGGR", "BRGRBG", "GGBGGR", "GGRGGB", "RBGBRG"])
XTRANS = np.array([["RGB".index(colour) for colour in row] for row in XTRANS], np.uint8)
#: Size, length and rate of the clips.
HEIGHT, WIDTH, N_FRAMES, RATE = 96, 160, 24, 30
QUIET = {"libx265": {"x265-params": "log-level=none"}}


def write_dng(path: Path, mosaic: NDArray[np.uint16], pattern: NDArray[np.uint8], *more: tuple[Any, ...]) -> Path:
    """A minimal DNG, with further tags `more` (tifffile's `extratags`)."""
    tags = [
        (271, "s", 0, "Synthetic", True),
        (272, "s", 0, "cam", True),
        (33421, "H", 2, pattern.shape, True),
        (33422, "B", pattern.size, pattern.tobytes(), True),
        (33434, "2I", 1, (1, 32000), True),
        (50706, "B", 4, b"\x01\x04\0\0", True),
        (50707, "B", 4, b"\x01\x03\0\0", True),
        (50708, "s", 0, "Synthetic cam", True),
        (50714, "H", 1, 100, True),
        (50717, "I", 1, 4000, True),
        (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
        (50728, "2I", 3, (5500, 10000, 10000, 10000, 6500, 10000), True),
        (50778, "H", 1, 21, True),
    ]
    tags = [tag for tag in tags if tag[0] not in {extra[0] for extra in more}] + list(more)
    tifffile.imwrite(path, mosaic, photometric=32803, extratags=sorted(tags), metadata=None)
    return path


def write_clip(path: Path, codec: str = "libx264", form: str = "yuv420p", **options: Any) -> list[NDArray[Any]]:
    """Encode frames with horizontal stripes; the luma planes that went in."""
    rng = np.random.default_rng(5)
    full = form.startswith("yuvj")
    planes = []
    with av.open(str(path), "w", options=options.get("container", {})) as container:
        container.metadata.update(options.get("tags", {}))
        stream = container.add_stream(codec, rate=RATE, options=QUIET.get(codec, {}) | options.get("encoder", {}))
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, form
        if "rotation" in options:
            stream.set_display_rotation(options["rotation"])
        for _ in range(N_FRAMES):
            frame = av.VideoFrame(WIDTH, HEIGHT, form)
            frame.color_range = 2 if full else 1
            bits = frame.format.components[0].bits
            low, high = (0, 255) if full else (16, 235)
            shape = (HEIGHT, WIDTH) if options.get("noise") else (HEIGHT // 8, 1)
            picture = rng.integers(low, high + 1, shape).repeat(HEIGHT // shape[0], 0).repeat(WIDTH // shape[1], 1)
            planes.append(_fill(frame, picture << (bits - 8)))
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return planes


def _fill(frame: av.VideoFrame, luma: NDArray[Any]) -> NDArray[Any]:
    """Put `luma` into plane 0 and grey into the others."""
    bits = frame.format.components[0].bits
    dtype = np.uint8 if bits == 8 else np.uint16
    for number, plane in enumerate(frame.planes):
        samples = np.full((plane.height, plane.line_size // np.dtype(dtype).itemsize), 1 << (bits - 1), dtype)
        if number == 0:
            samples[:, : luma.shape[1]] = luma
        plane.update(samples.tobytes())
    return luma


def read_all(path: Path) -> tuple[list[Frame], InputError | None]:
    """The frames of a file, and the error that it ended with."""
    frames = []
    try:
        for frame in open_source(path):
            frames.append(frame)  # noqa: PERF402 - what came before an error counts
    except InputError as error:
        return frames, error
    return frames, None


def one_frame(path: Path) -> Frame:
    """The frame of a still.

    Raises:
        InputError: it cannot be read.
    """
    (frame,) = open_source(path)
    assert frame.source == str(path)
    return frame
