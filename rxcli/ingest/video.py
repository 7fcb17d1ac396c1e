"""Clips -> luma planes as the decoder leaves them, through PyAV: no colour conversion, no turning, no copy.

FFmpeg decodes several frames at a time in threads of its own, except MJPEG, which it does not thread: there the packets
go to simplejpeg in a few threads here (2.3 to 2.6 times faster). Some frames are read ahead (`rxcli.ingest.ahead`).
"""

from __future__ import annotations

import errno
import os
from collections import deque
from collections.abc import Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import InputError, reason_of
from rxcli.ingest.ahead import read_ahead
from rxcli.ingest.metadata import clip_metadata
from rxcli.ingest.orientation import orientation_of_turn
from rxcli.ingest.sniff import check_size
from rxcli.types import Frame, Metadata

#: ITU-T H.273: samples use 16..235 of 8 bits, or all of them (FFmpeg's AVCOL_RANGE_JPEG).
_FULL_RANGE = 2
_LIMITED_BLACK, _LIMITED_WHITE = 16, 235
#: A clip is cut where its last frame starts more than this many frames before its stated end; times are rounded.
_END_TOLERANCE = 1.5
#: Frame rates that a stream may state, and the one that is taken where it states none.
_RATES_HZ, _USUAL_RATE_HZ = (1.0, 1000.0), 30.0
_MJPEG_THREADS = min(4, os.cpu_count() or 1)
#: Threads of the other decoders: one more than FFmpeg takes, for theirs wait for one another.
_DECODER_THREADS = min((os.cpu_count() or 1) + 2, 16)
#: Decoders hold some ten frames for others to refer to, and one in every thread.
_BYTES_A_PIXEL = 1.5 * (10 + _DECODER_THREADS)
_TS_SYNC = 0x47
#: Times of a clip that are believed: a claim of more would be years.
_MAX_S = 1e6
#: FFmpeg opens this one file and nothing that it names: no other protocol, and containers only, no lists of files.
_FILES_ONLY = {
    "protocol_whitelist": "file",
    "format_whitelist": "mov,matroska,webm,avi,mpegts,mpeg,mpegvideo,m4v,h264,hevc,mjpeg,asf,flv",
}


@dataclass(slots=True)
class _Progress:
    """Progress of reading, which shows at the end whether the clip was complete."""

    n_packets: int = 0
    last_time_s: float = 0.0
    #: Time of the last frame that was given one; None before any.
    stamp_s: float | None = None
    #: Time of the last whole frame before the first fault.
    broken_at_s: float | None = None
    n_damaged: int = 0
    #: Whether the file ends within a packet.
    cut: bool = False
    #: What a frame's time claims to be, where that is not believed.
    doubt: str | None = None

    def damage(self) -> None:
        self.n_damaged += 1
        if self.broken_at_s is None:
            self.broken_at_s = self.last_time_s


def read_video(path: Path) -> Iterator[Frame]:
    """The whole frames of a clip, in order of presentation; read ahead of the one that is looked at.

    Raises:
        InputError: no clip, no picture in it; after its whole frames: it breaks off, or frames of it are damaged.
    """
    yield from read_ahead(_read(path))


def _read(path: Path) -> Generator[Frame, None, None]:
    import av

    progress = _Progress()
    try:
        # Without a protocol, FFmpeg takes what stands before a colon for one.
        container = av.open(f"file:{os.path.abspath(path)}", options=_FILES_ONLY)
    except (av.error.FFmpegError, ValueError, UnicodeError, OSError) as error:
        raise InputError(*_open_failure(path, error)) from None
    with container:
        if not container.streams.video:
            raise InputError(f"{path}: no video in it", "name a clip with pictures")
        stream = container.streams.video[0]
        if stream.codec_context is None:
            raise InputError(f"{path}: its codec is unknown", "save it as H.264, HEVC or MJPEG")
        check_size(path, stream.codec_context.width, stream.codec_context.height, _BYTES_A_PIXEL)
        yield from _frames(path, container, stream, progress)
        _check_whole(path, container, stream, progress)


def _frames(path: Path, container: Any, stream: Any, progress: _Progress) -> Iterator[Frame]:
    metadata = clip_metadata(dict(container.metadata) | dict(stream.metadata))
    decode = _decode_mjpeg if stream.codec_context.name == "mjpeg" else _decode
    for index, frame in enumerate(decode(path, container, stream, progress)):
        progress.last_time_s = frame.time_s
        if progress.doubt and not metadata.not_believed:
            metadata = replace(metadata, not_believed=(progress.doubt,))
        yield replace(frame, index=index, metadata=replace(metadata, orientation=frame.metadata.orientation))


def _packets(container: Any, stream: Any, progress: _Progress) -> Iterator[Any]:
    """Whole packets with content, then one empty packet that asks the decoder for its last frames."""
    import av

    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets, None)
        except av.error.FFmpegError:
            progress.cut, packet = True, None
        if packet is None or not packet.size:
            yield None
            return
        if packet.is_corrupt:
            progress.cut = True
            continue
        progress.n_packets += 1
        yield packet


def _decode(path: Path, container: Any, stream: Any, progress: _Progress) -> Iterator[Frame]:
    import av

    codec = stream.codec_context
    codec.thread_type, codec.thread_count = "FRAME", _DECODER_THREADS
    for packet in _packets(container, stream, progress):
        try:
            frames = codec.decode(packet)
        except av.error.FFmpegError:
            progress.damage()
            continue
        for frame in frames:
            if frame.is_corrupt:
                progress.damage()
            else:
                yield _frame(path, frame, *_time_s(frame, stream, progress))


def _decode_mjpeg(path: Path, container: Any, stream: Any, progress: _Progress) -> Iterator[Frame]:
    from rxcli.ingest.jpeg import decode_luma

    limited = stream.codec_context.color_range not in (0, _FULL_RANGE)
    black, white = (_LIMITED_BLACK, _LIMITED_WHITE) if limited else (0, 255)
    waiting: deque[tuple[tuple[float, bool], Future[NDArray[np.uint8]]]] = deque()
    with ThreadPoolExecutor(_MJPEG_THREADS) as pool:
        for packet in _packets(container, stream, progress):
            if packet is not None:
                waiting.append((_time_s(packet, stream, progress), pool.submit(decode_luma, bytes(packet), path)))
            while len(waiting) > (_MJPEG_THREADS if packet is not None else 0):
                (time_s, nominal), picture = waiting.popleft()
                try:
                    pixels = picture.result()
                    yield Frame(pixels, str(path), 0, time_s, black=black, white=white, nominal_time=nominal)
                except InputError:
                    progress.damage()


def _time_s(stamped: Any, stream: Any, progress: _Progress) -> tuple[float, bool]:
    """Presentation time of a frame or packet, and whether it is by the nominal frame rate.

    That is taken where a file gives no time, or one that does not advance: zeros, or times that run backwards.
    """
    own = float(stamped.pts * stream.time_base) if stamped.pts is not None and stream.time_base else None
    if own is not None and abs(own) >= _MAX_S:
        progress.doubt = progress.doubt or f"a frame's time of {own:.6g} s"
        own = None
    before = progress.stamp_s
    nominal = before is not None and (own is None or own <= before)
    progress.stamp_s = before + _frame_s(stream) if before is not None and nominal else (own or 0.0)
    return progress.stamp_s, nominal


def _frame_s(stream: Any) -> float:
    """Nominal time from frame to frame: by the codec, by the container, or by default."""
    for rate in (stream.codec_context.framerate, stream.guessed_rate, stream.average_rate):
        if rate and _RATES_HZ[0] <= float(rate) <= _RATES_HZ[1]:
            return 1 / float(rate)
    return 1 / _USUAL_RATE_HZ


def _frame(path: Path, frame: Any, time_s: float, nominal: bool) -> Frame:
    """Convert a frame of FFmpeg, without its number and the metadata of the clip."""
    if not _has_luma_plane(frame.format):
        frame = frame.reformat(format="gray")
    bits = frame.format.components[0].bits
    black, white = _levels(frame, bits)
    pixels = _plane(frame.planes[0], frame.width, frame.height, np.uint8 if bits == 8 else np.uint16)
    metadata = Metadata(orientation=orientation_of_turn(frame.rotation))
    return Frame(pixels, str(path), 0, time_s, metadata, black=black, white=white, nominal_time=nominal)


def _levels(frame: Any, bits: int) -> tuple[float, float]:
    """Values of black and white in plane 0."""
    unit = 1 << (16 - bits) if frame.format.name.startswith("p0") else 1  # P010 and its like use the upper bits
    if frame.color_range == _FULL_RANGE or frame.format.name.startswith(("yuvj", "gray")):
        return 0, ((1 << bits) - 1) * unit
    return (_LIMITED_BLACK << (bits - 8)) * unit, (_LIMITED_WHITE << (bits - 8)) * unit


def _has_luma_plane(form: Any) -> bool:
    """Whether plane 0 is luma alone, in samples of the machine's own byte order."""
    return not form.is_rgb and not form.is_big_endian and (form.is_planar or len(form.components) == 1)


def _plane(plane: Any, width: int, height: int, dtype: type[np.uint8] | type[np.uint16]) -> NDArray[Any]:
    """A read-only view (height, width) of a decoder's plane, which lives as long as the view."""
    samples = np.frombuffer(plane, dtype)
    pitch = plane.line_size // samples.itemsize
    pixels = samples[: pitch * height].reshape(height, pitch)[:, :width]
    pixels.flags.writeable = False
    return pixels


def _check_whole(path: Path, container: Any, stream: Any, progress: _Progress) -> None:
    """Raise where the clip ended before it should, or frames of it were left out."""
    if progress.cut or _ends_early(path, container, stream, progress):
        reason = f"{path}: the clip breaks off at {progress.last_time_s:.3f} s"
        raise InputError(reason, "the frames before were read; copy the file from the camera again")
    if progress.n_damaged:
        after = f"the first after {progress.broken_at_s:.3f} s"
        raise InputError(f"{path}: {progress.n_damaged} frames are damaged, {after}", "copy the file again")


def _ends_early(path: Path, container: Any, stream: Any, progress: _Progress) -> bool:
    """Whether the container's own index, frame count or duration asks for more than there was."""
    if container.format.name == "avi":
        return bool(stream.frames > progress.n_packets)
    if container.format.name == "mpegts":
        return _ends_within_packet(path)
    entries = stream.index_entries
    if "mp4" in container.format.name:
        return _boxes_end(path) > container.size or any(entry.pos + entry.size > container.size for entry in entries)
    frame_s = 1 / float(stream.average_rate or 30)
    return progress.last_time_s + _END_TOLERANCE * frame_s < _stated_end_s(container, stream) < _MAX_S


def _ends_within_packet(path: Path) -> bool:
    """Whether a transport stream ends within one of its packets (ISO/IEC 13818-1, 2.4.3.2), which begin with 0x47.

    On discs a time of four bytes stands before each, in broadcasts sixteen of correction after it.
    """
    with path.open("rb") as file:
        head, length = file.read(1024), file.seek(0, os.SEEK_END)
    for size, offset in ((188, 0), (192, 4), (204, 0)):
        if len(head) > offset + size and head[offset] == head[offset + size] == _TS_SYNC:
            return length % size != 0
    return False


def _boxes_end(path: Path) -> int:
    """Where the last top-level box of an MP4 or MOV file ends by its own size (ISO/IEC 14496-12, section 4.2)."""
    end = 0
    with path.open("rb") as file:
        while len(head := file.read(16)) >= 8:
            size = int.from_bytes(head[:4])
            size = int.from_bytes(head[8:]) if size == 1 else size
            if size < 8 or not head[4:8].isalnum():  # 0: to the end of the file; no name: some camera's trailer
                break
            end += size
            file.seek(end)
    return end


def _stated_end_s(container: Any, stream: Any) -> float:
    """End of the last frame as the container states it; 0 if it states none, or possibly only that of the sound."""
    if stream.duration is not None:
        return float(stream.duration * stream.time_base)
    sole = container.duration is not None and len(container.streams) == 1
    return container.duration / 1e6 if sole else 0.0


def _open_failure(path: Path, error: Exception) -> tuple[str, str]:
    if "Invalid data" in str(error):
        return f"{path}: no clip, or its index is missing because it is cut", "copy the file from the camera again"
    if getattr(error, "errno", None) == errno.EINVAL:  # not on the list of containers
        return f"{path}: no container of a clip that is read", "save it as MP4, MOV, MKV or AVI"
    return f"{path}: cannot be opened as a clip ({reason_of(error)})", "copy the file from the camera again"
