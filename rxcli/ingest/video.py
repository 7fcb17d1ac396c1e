"""Clips -> luma planes as the decoder leaves them, through PyAV: no colour conversion, no turning, no copy.

FFmpeg decodes several frames at a time in threads of its own, except MJPEG, which it does not thread: there the packets
go to simplejpeg in a few threads here (2.3 to 2.6 times faster). Some frames are read ahead (`rxcli.ingest.ahead`).
"""

import errno
import os
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import InputError, failure_explained, reason_of
from rxcli.ingest.ahead import in_order, read_ahead
from rxcli.ingest.damage import WholeFrames
from rxcli.ingest.ends import is_cut
from rxcli.ingest.gpmf import stated_readout_s
from rxcli.ingest.luma import BT601, BT709, THINNED
from rxcli.ingest.metadata import believed, clip_metadata
from rxcli.ingest.orientation import orientation_of_turn
from rxcli.ingest.sniff import MAX_BYTES, check_size
from rxcli.ingest.times import FrameTimes
from rxcli.types import Colours, Float32Array, Frame, Metadata

#: ITU-T H.273: samples use 16..235 of 8 bits, or all of them (FFmpeg's AVCOL_RANGE_JPEG).
_FULL_RANGE = 2
_LIMITED_BLACK, _LIMITED_WHITE = 16, 235
#: Range of chroma over that of luma there, and the number of BT.709 among matrices.
_CHROMA_RANGE, _BT709 = 224 / 219, 1
#: FFmpeg's orders of fields whose lower one is taken first (AV_FIELD_BB, AV_FIELD_TB).
_LOWER_FIRST = (3, 4)
#: Columns whose rows are compared to see whether a frame is two fields.
_N_COMPARED = 64
#: Units of HEVC that hold notes (ITU-T H.265, table 7-1), as FFmpeg leaves them out.
_NO_SEI = "filter_units=remove_types=39|40"
#: Frame rates that a stream may state, and the one that is taken where it states none.
_RATES_HZ, _USUAL_RATE_HZ = (1.0, 1000.0), 30.0
#: Pictures of MJPEG that are decoded or wait at most, one in each thread and as many before it.
_MJPEG_AT_ONCE = 8
_MJPEG_THREADS = min(_MJPEG_AT_ONCE // 2, os.cpu_count() or 1)
#: Threads of the other decoders: one more than FFmpeg takes, for theirs wait for one another.
_DECODER_THREADS = min((os.cpu_count() or 1) + 2, 16)
#: Frames that a decoder of large pictures and the receiver hold, besides one in each thread but the first.
_N_HELD = 8
#: Decoders make rows and columns up to multiples of it.
_ALIGNED = 64
#: Packets whose times are so far from those before, in seconds, are those of another clip that was joined.
_JOINT_S = 1.0
#: Times of a clip, from its first frame, that are believed: a claim of more would be years.
_MAX_S = 1e6
#: Bytes of a file in which FFmpeg may look for the next packet, and that it asks for at a time.
_SEARCHED_BYTES, _BUFFER_BYTES = 1 << 27, 1 << 20
#: FFmpeg reads this one file and nothing that it names: no protocol, and containers only, no lists of files.
_OPTIONS = {
    "protocol_whitelist": "none",
    "format_whitelist": "mov,matroska,webm,avi,mpegts,mpeg,mpegvideo,m4v,h264,hevc,mjpeg,mpjpeg,jpeg_pipe,asf,flv",
    # Times that step back where clips were joined are no counter that ran over.
    "correct_ts_overflow": "0",
    # What is stored is read, at its own time, whatever a player would leave out, repeat or slow down.
    "ignore_editlist": "1",
}


@dataclass(slots=True)
class _Progress:
    """Progress of reading, which shows at the end whether the clip was complete."""

    times: FrameTimes = field(default_factory=FrameTimes)
    #: Stamp that times are counted from: they may begin at the time of day.
    origin: int | None = None
    last_time_s: float = 0.0
    #: Time of the last whole frame before the first fault.
    broken_at_s: float | None = None
    n_damaged: int = 0
    #: Why the first damaged frame is, where that is known.
    reason: str = ""
    #: Whether the file ends within a packet.
    cut: bool = False
    #: What the file claims of its frames and is not believed.
    doubt: str | None = None
    #: Whether the container has times of its own.
    has_times: bool = True
    #: Whether frames are two fields, one after the other.
    has_fields: bool = False
    #: Bytes in which the next packet is looked for.
    n_left: int = 0

    def damage(self, reason: str = "") -> None:
        """Count a damaged frame; of the first one, time and reason are kept."""
        self.n_damaged += 1
        if self.broken_at_s is None:
            self.broken_at_s, self.reason = self.last_time_s, reason


class _ClipFile(FileIO):
    """A clip as FFmpeg reads it, which ends where too much of it holds nothing: zeros, for instance."""

    def __init__(self, path: Path, progress: _Progress) -> None:
        super().__init__(str(path))
        self.name = ""  # FFmpeg would take some for patterns of other names
        self._progress, progress.n_left = progress, _SEARCHED_BYTES

    def read(self, size: int | None = 0) -> bytes:
        data = super().read(min(size or 0, self._progress.n_left)) or b""
        self._progress.n_left -= len(data)
        return data


def read_video(path: Path) -> Iterator[Frame]:
    """The whole frames of a clip, in order of presentation; read ahead of the one that is looked at.

    Raises:
        InputError: no clip, no picture in it; after its whole frames: it breaks off, or frames of it are damaged.
    """
    yield from read_ahead(_read(path))


def _read(path: Path) -> Generator[Frame, None, None]:
    import av
    from av.format import Flags

    progress = _Progress()
    with ExitStack() as opened:
        try:
            file = opened.enter_context(_ClipFile(path, progress))
            container = av.open(file, options=_OPTIONS, metadata_errors="replace", buffer_size=_BUFFER_BYTES)
            opened.enter_context(container)
        except (av.error.FFmpegError, ValueError, UnicodeError, OSError) as error:
            raise InputError(*_open_failure(path, error)) from None
        stream = _stream_of(container)
        if stream is None:
            raise InputError(f"{path}: no video in it", "name a clip with pictures")
        if stream.codec_context is None:
            raise InputError(f"{path}: its codec is unknown", "save it as H.264, HEVC or MJPEG")
        progress.has_times = not container.format.flags & Flags.no_timestamps.value
        check_size(path, stream.codec_context.width, stream.codec_context.height, _N_HELD * _pixel_bytes(stream))
        yield from _frames(path, container, stream, progress)
        _check_whole(path, container, stream, progress)


def _stream_of(container: Any) -> Any:
    """The stream of the clip's pictures: no cover, no preview; None where there is none."""
    from av.stream import Disposition

    def merit(stream: Any) -> tuple[bool, int]:
        codec = stream.codec_context
        return stream.frames != 1, codec.width * codec.height if codec else 0

    stills = Disposition.attached_pic | Disposition.still_image | Disposition.timed_thumbnails
    moving = (stream for stream in container.streams.video if not stream.disposition & stills)
    return max(moving, key=merit, default=None)


def _pixel_bytes(stream: Any) -> float:
    """Bytes a pixel of decoded frames."""
    form = stream.codec_context.format
    return float(form.padded_bits_per_pixel) / 8 if form else 1.5


def _frames(path: Path, container: Any, stream: Any, progress: _Progress) -> Iterator[Frame]:
    metadata = clip_metadata(dict(container.metadata) | dict(stream.metadata))
    metadata = believed(replace(metadata, readout_s=stated_readout_s(path, container)))
    decode = _decode_mjpeg if stream.codec_context.name == "mjpeg" else _decode
    for n_whole, frame in enumerate(decode(path, container, stream, progress)):
        progress.last_time_s = frame.time_s
        if progress.doubt and not metadata.not_believed:
            metadata = replace(metadata, not_believed=(progress.doubt,))
        index = n_whole + progress.n_damaged
        yield replace(frame, index=index, metadata=replace(metadata, orientation=frame.metadata.orientation))


def _packets(container: Any, stream: Any, progress: _Progress) -> Iterator[tuple[Any, bool]]:
    """Packets with content, and whether some of it is lost; then None, which asks the decoder for its last frames."""
    before, has_gap = None, False
    for packet in _content(container, stream, progress):
        if before is not None:
            times = (before.dts, packet.dts)
            is_joint = None not in times and not 0 <= (times[1] - times[0]) * packet.time_base <= _JOINT_S
            yield before, has_gap and not is_joint
        # A parser ends a packet where it finds the next one, and flags the packet before the one that has the gap.
        flagged = before if container.format.name == "mpegts" else packet
        before, has_gap = packet, flagged is not None and flagged.is_corrupt
    if before is not None:
        progress.cut |= has_gap
        yield before, has_gap
    yield None, False


def _content(container: Any, stream: Any, progress: _Progress) -> Iterator[Any]:
    """Packets up to the end or a fault, but for empty ones, which stand for frames that a camera dropped."""
    import av

    is_on = True
    while is_on:
        try:
            for packet in container.demux(stream):
                progress.n_left = _SEARCHED_BYTES if progress.n_left else 0
                if packet.size:
                    yield packet
            is_on = False
        except IndexError:  # a packet of a stream that begins within the file, which PyAV does not know
            continue
        except av.error.FFmpegError:
            progress.cut, is_on = True, False


def _decode(path: Path, container: Any, stream: Any, progress: _Progress) -> Iterator[Frame]:
    codec = stream.codec_context
    n_frames = int(MAX_BYTES / (_pixel_bytes(stream) * (codec.width + _ALIGNED) * (codec.height + _ALIGNED)))
    n_threads = max(min(n_frames - _N_HELD + 1, _DECODER_THREADS), 1)
    max_pixels = int(MAX_BYTES / (_pixel_bytes(stream) * (_N_HELD - 1 + n_threads)))
    # HEVC's decoder passes over faults otherwise.
    codec.options = {"max_pixels": str(max_pixels)} | ({"err_detect": "explode"} if codec.name == "hevc" else {})
    without_notes = _without_notes(stream) if codec.name == "hevc" else lambda packet: packet
    whole = WholeFrames(codec, n_threads, n_frames - _N_HELD - n_threads)
    try:
        for packet, has_gap in _packets(container, stream, progress):
            for frame in whole.decode(packet and without_notes(packet), has_gap=has_gap):
                if frame is None:
                    progress.damage()
                else:
                    yield from _fields(_frame(path, frame, stream, progress), frame, stream, progress)
    finally:
        # Threads at work may wait for this one, which would wait for them when it frees the decoder.
        codec.flush_buffers()


def _without_notes(stream: Any) -> Callable[[Any], Any]:
    """Takes the notes (SEI) out of packets of HEVC, and now out of the header: one that cannot be read is no fault."""
    import av
    from av.bitstream import BitStreamFilterContext

    notes = BitStreamFilterContext(_NO_SEI, stream, stream)

    def strip(packet: Any) -> Any:
        with suppress(av.error.FFmpegError, IndexError):
            return notes.filter(packet)[0]
        return av.Packet(b"\0")  # damaged

    return strip


def _decode_mjpeg(path: Path, container: Any, stream: Any, progress: _Progress) -> Iterator[Frame]:
    from rxcli.ingest.jpeg import colours_of, decode_luma

    limited = stream.codec_context.color_range not in (0, _FULL_RANGE)
    black, white = (_LIMITED_BLACK, _LIMITED_WHITE) if limited else (0, 255)
    packets = (packet for packet, _ in _packets(container, stream, progress) if packet is not None)
    with ThreadPoolExecutor(_MJPEG_THREADS) as pool:
        decode = partial(decode_luma, source=path, at_once=_MJPEG_AT_ONCE)
        for packet, picture in in_order(packets, lambda packet: pool.submit(decode, packet), _MJPEG_THREADS + 1):
            time_s, nominal = _time_s(packet, stream, progress)
            try:
                frame = Frame(picture.result(), str(path), 0, time_s, black=black, white=white, nominal_time=nominal)
                yield replace(frame, colours=colours_of(bytes(packet)))
            except InputError as error:
                progress.damage(str(error).removeprefix(f"{path}: "))


def _time_s(stamped: Any, stream: Any, progress: _Progress) -> tuple[float, bool]:
    """Presentation time of a frame or packet, and whether it is by the nominal frame rate.

    That is taken where a file gives no time, or one that does not advance: zeros, or times that run backwards.
    """
    own = None
    if stamped.pts is not None and stream.time_base and progress.has_times:
        progress.origin = stamped.pts if progress.origin is None else progress.origin
        own = float((stamped.pts - progress.origin) * stream.time_base)
        if abs(own) >= _MAX_S:
            progress.doubt = progress.doubt or f"a frame's time of {own:.6g} s"
            progress.origin, own = stamped.pts, 0.0
    return progress.times.next(own, _frame_s(stream))


def _frame_s(stream: Any) -> float:
    """Nominal time from frame to frame: by the codec, by the container, or by default."""
    for rate in (stream.codec_context.framerate, stream.guessed_rate, stream.average_rate):
        if rate and _RATES_HZ[0] <= float(rate) <= _RATES_HZ[1]:
            return 1 / float(rate)
    return 1 / _USUAL_RATE_HZ


def _frame(path: Path, frame: Any, stream: Any, progress: _Progress) -> Frame:
    """Convert a frame of FFmpeg, without its number and the metadata of the clip."""
    time_s, nominal = _time_s(frame, stream, progress)
    metadata = Metadata(orientation=orientation_of_turn(frame.rotation))
    if not _has_luma_plane(frame.format):
        with failure_explained(f"{path}: pixels of {frame.format.name} cannot be read", "save it as H.264 or HEVC"):
            frame = frame.reformat(format="bgr24") if frame.format.has_palette else frame  # else grey is rounded
            frame = frame.reformat(format="gray")
    bits = frame.format.components[0].bits
    black, white = _levels(frame, bits)
    pixels = _plane(frame.planes[0], frame.width, frame.height, np.uint8 if bits == 8 else np.uint16)
    colours = _colours(frame, pixels, black, white)
    return Frame(
        pixels, str(path), 0, time_s, metadata, black=black, white=white, nominal_time=nominal, colours=colours
    )


def _colours(frame: Any, luma: NDArray[Any], black: float, white: float) -> Colours | None:
    """The colours of a frame with planes of chroma (ITU-T H.273, equations 38 to 40); None of others."""
    if not frame.format.name.startswith(("yuv4", "yuvj4")) or len(frame.planes) != 3:
        return None
    blue, red = (_plane(plane, plane.width, plane.height, luma.dtype.type) for plane in frame.planes[1:])
    of_red, of_green, of_blue = BT709 if frame.colorspace == _BT709 else BT601
    full, middle = white - black, 1 << (frame.format.components[0].bits - 1)
    chroma = full * _CHROMA_RANGE if black else full

    def thinned() -> Float32Array:
        import cv2

        size = (luma.shape[1] // THINNED, luma.shape[0] // THINNED)
        small = (cv2.resize(plane, size, interpolation=cv2.INTER_AREA) for plane in (luma, blue, red))
        y, b, r = (plane.astype(np.float32) for plane in small)
        y = (y - black) / full
        r, b = y + (r - middle) * (2 * (1 - of_red) / chroma), y + (b - middle) * (2 * (1 - of_blue) / chroma)
        return np.asarray(np.stack([r, (y - of_red * r - of_blue * b) / of_green, b], axis=-1), np.float32)

    def without_red() -> NDArray[Any]:
        import cv2

        share = 2 * of_red * full / chroma
        return np.asarray(cv2.addWeighted(luma, 1, cv2.resize(red, luma.shape[::-1]), -share, share * middle))

    return Colours(thinned, without_red)


def _fields(frame: Frame, decoded: Any, stream: Any, progress: _Progress) -> Iterator[Frame]:
    """The fields of a frame that is two, taken one after the other; else the frame.

    Some cameras mark frames so whose rows are one picture: there, neighbouring rows differ less than every other.
    """
    if decoded.interlaced_frame and not progress.has_fields:
        some = frame.pixels[:, :: max(frame.width // _N_COMPARED, 1)].astype(np.int32)
        progress.has_fields = bool(np.abs(some[1:] - some[:-1]).mean() > np.abs(some[2:] - some[:-2]).mean())
        if not progress.has_fields:
            progress.doubt = progress.doubt or "interlaced frames, since both fields of them show one instant"
    if not (decoded.interlaced_frame and progress.has_fields):
        yield frame
        return
    lower = int(stream.codec_context.field_order in _LOWER_FIRST)
    frame = replace(frame, colours=None)
    yield replace(frame, pixels=frame.pixels[lower::2])
    yield replace(frame, pixels=frame.pixels[1 - lower :: 2], time_s=frame.time_s + _frame_s(stream) / 2)


def _levels(frame: Any, bits: int) -> tuple[float, float]:
    """Values of black and white in plane 0."""
    unit = 1 << (16 - bits) if frame.format.name.startswith("p0") else 1  # P010 and its like use the upper bits
    if frame.color_range == _FULL_RANGE or frame.format.name.startswith(("yuvj", "gray")):
        return 0, ((1 << bits) - 1) * unit
    return (_LIMITED_BLACK << (bits - 8)) * unit, (_LIMITED_WHITE << (bits - 8)) * unit


def _has_luma_plane(form: Any) -> bool:
    """Whether plane 0 is luma alone, in samples of the machine's own byte order."""
    is_luma = not form.is_rgb and not form.has_palette and (form.is_planar or len(form.components) == 1)
    return is_luma and not form.is_big_endian and 8 <= form.components[0].bits <= 16


def _plane(plane: Any, width: int, height: int, dtype: type[np.uint8] | type[np.uint16]) -> NDArray[Any]:
    """A read-only view (height, width) of a decoder's plane, which lives as long as the view."""
    samples = np.frombuffer(plane, dtype)
    pitch = abs(plane.line_size) // samples.itemsize
    pixels = samples[: pitch * height].reshape(height, pitch)[:: 1 if plane.line_size > 0 else -1, :width]
    pixels.flags.writeable = False
    return pixels


def _check_whole(path: Path, container: Any, stream: Any, progress: _Progress) -> None:
    """Raise where the clip ended before it should, or frames of it were left out."""
    indexed = stream.index_entries if "mp4" in container.format.name else ()
    lacks_samples = any(entry.pos + entry.size > container.size for entry in indexed)
    if progress.cut or lacks_samples or is_cut(path, container.format.name):
        reason = f"{path}: the clip breaks off at {progress.last_time_s:.3f} s"
        raise InputError(reason, "the frames before were read; copy the file from the camera again")
    if progress.n_damaged:
        cause = f" ({progress.reason})" if progress.reason else ""
        reason = f"{path}: {progress.n_damaged} frames are damaged, the first after {progress.broken_at_s:.3f} s{cause}"
        raise InputError(reason, "copy the file again")


def _open_failure(path: Path, error: Exception) -> tuple[str, str]:
    if "Invalid data" in str(error):
        return f"{path}: no clip, or its index is missing because it is cut", "copy the file from the camera again"
    if getattr(error, "errno", None) == errno.EINVAL:  # not on the list of containers
        return f"{path}: no container of a clip that is read", "save it as MP4, MOV, MKV or AVI"
    return f"{path}: cannot be opened as a clip ({reason_of(error)})", "copy the file from the camera again"
