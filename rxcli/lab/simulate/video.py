"""Clips through real encoders."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import UsageError


@dataclass(frozen=True)
class Codec:
    """How a clip is compressed."""

    #: FFmpeg's encoder and pixel format.
    encoder: str
    pixel_format: str
    #: True where luma uses the whole range of its numbers.
    full_range: bool = False

    @property
    def bits(self) -> int:
        """Bits of a sample."""
        return 10 if self.pixel_format.endswith("10le") else 8


CODECS = {
    "h264": Codec("libx264", "yuv420p"),
    "h264-10": Codec("libx264", "yuv420p10le"),
    "hevc": Codec("libx265", "yuv420p"),
    "hevc-10": Codec("libx265", "yuv420p10le"),
    "mjpeg": Codec("mjpeg", "yuvj420p", full_range=True),
}
_BT709, _MPEG_RANGE, _JPEG_RANGE = 1, 1, 2


def write_video(
    frames: Iterable[NDArray[np.generic]],
    path: Path,
    codec: str,
    frame_rate_hz: float,
    bit_rate: int | None = None,
    preset: str = "veryfast",
) -> None:
    """Compress developed pictures into a clip.

    Args:
        frames: each (height, width, 3), red first, uint8, or uint16 for the codecs of ten bits.
        path: of the file; its suffix chooses the container.
        codec: one of `CODECS`.
        frame_rate_hz: of the clip.
        bit_rate: bits per second; None for the encoder's constant quality.
        preset: how much work the encoder does; see x264 and x265.

    Raises:
        UsageError: unknown codec, or one that this machine's FFmpeg lacks.
    """
    import av

    if codec not in CODECS:
        raise UsageError(f"no codec {codec!r}", f"choose from: {', '.join(CODECS)}")
    settings = CODECS[codec]
    rate = Fraction(frame_rate_hz).limit_denominator(1001)
    with av.open(str(path), "w") as container:
        stream = None
        for number, rgb in enumerate(frames):
            if stream is None:
                stream = _add_stream(container, settings, rate, rgb.shape, bit_rate, preset)
            frame = av.VideoFrame.from_ndarray(
                np.ascontiguousarray(rgb), "rgb24" if rgb.dtype == np.uint8 else "rgb48le"
            )
            target_range = _JPEG_RANGE if settings.full_range else _MPEG_RANGE
            converted = frame.reformat(
                format=settings.pixel_format,
                dst_colorspace=_BT709,
                src_color_range=_JPEG_RANGE,
                dst_color_range=target_range,
            )
            converted.pts, converted.time_base = number, 1 / rate
            container.mux(stream.encode(converted))
        if stream is not None:
            container.mux(stream.encode(None))


def _add_stream(
    container: Any, settings: Codec, rate: Fraction, shape: tuple[int, ...], bit_rate: int | None, preset: str
) -> Any:
    import av

    try:
        stream = container.add_stream(settings.encoder, rate=rate)
    except (av.error.FFmpegError, ValueError) as error:
        raise UsageError(
            f"{settings.encoder}: this FFmpeg cannot encode it ({error})", "choose another codec"
        ) from None
    stream.height, stream.width = shape[:2]
    stream.pix_fmt = settings.pixel_format
    context = stream.codec_context
    context.color_range = _JPEG_RANGE if settings.full_range else _MPEG_RANGE
    context.colorspace = context.color_trc = context.color_primaries = _BT709
    if bit_rate is not None:
        stream.bit_rate = bit_rate
    if settings.encoder != "mjpeg":
        stream.options = {"preset": preset} | ({} if bit_rate else {"crf": "23"})
        if settings.encoder == "libx265":
            # Reordered frames of a clip shorter than the encoder's delay get times that no container takes; and the
            # encoders in cameras do not reorder either.
            stream.options = stream.options | {"x265-params": "log-level=error:bframes=0"}
    return stream
