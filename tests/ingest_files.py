"""Small files of every kind, written for the tests of the readers."""

import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
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
#: Pixel formats of codecs whose sizes may change.
FORMS = {"mjpeg": "yuvj420p", "libvpx-vp9": "yuv420p"}
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
        if "payload" in options:
            packet = av.Packet(options["payload"])
            packet.stream, packet.pts, packet.dts = container.add_data_stream("bin_data"), 0, 0
            packet.time_base, packet.duration, packet.is_keyframe = Fraction(1, 1000), 1000, True
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
        if "payload" in options:
            container.mux(packet)
    return planes


def riff_chunk(name: bytes, data: bytes) -> bytes:
    """A chunk of an AVI file."""
    return name + struct.pack("<I", len(data)) + data


def write_palette_clip(path: Path, planes: list[NDArray[Any]], is_bottom_up: bool = True) -> None:
    """Write an uncompressed AVI of 8 bits a pixel, with grey levels in no order."""
    palette = np.random.default_rng(3).permutation(256).astype(np.uint8)
    index, (rows, width) = np.argsort(palette).astype(np.uint8), planes[0].shape
    body = b"".join(riff_chunk(b"00db", index[p[::-1] if is_bottom_up else p].tobytes()) for p in planes)
    height = rows if is_bottom_up else -rows
    form = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 8, 0, width * rows, 0, 0, 256, 0)
    form += np.stack([palette, palette, palette, palette * 0], axis=1).tobytes()
    counts = (0, 0, 0, 0, 1, RATE, 0, len(planes), width * rows, 0, 0)
    header = struct.pack("<4s4s11I4H", b"vids", b"DIB ", *counts, 0, 0, width, rows)
    stream = riff_chunk(b"LIST", b"strl" + riff_chunk(b"strh", header) + riff_chunk(b"strf", form))
    main = struct.pack("<14I", 1_000_000 // RATE, 0, 0, 0, len(planes), 0, 1, 0, width, rows, 0, 0, 0, 0)
    lists = riff_chunk(b"LIST", b"hdrl" + riff_chunk(b"avih", main) + stream) + riff_chunk(b"LIST", b"movi" + body)
    path.write_bytes(riff_chunk(b"RIFF", b"AVI " + lists))


def write_sizes(path: Path, codec: str, sizes: list[tuple[int, int]], picture: NDArray[np.uint8]) -> None:
    """A clip that shows a picture (height, width, 3) in one frame of each size (width, height)."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=RATE)
        (stream.width, stream.height), stream.pix_fmt = sizes[0], FORMS[codec]
        for number, (width, height) in enumerate(sizes):
            encoder = av.CodecContext.create(codec, "w")
            encoder.width, encoder.height, encoder.pix_fmt = width, height, FORMS[codec]
            encoder.framerate, encoder.time_base = RATE, Fraction(1, RATE)
            pixels = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
            frame = av.VideoFrame.from_ndarray(pixels, "rgb24").reformat(format=FORMS[codec])
            for packet in (*encoder.encode(frame), *encoder.encode()):
                packet.stream, packet.pts, packet.dts, packet.time_base = stream, number, number, Fraction(1, RATE)
                container.mux(packet)


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
