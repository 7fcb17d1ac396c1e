"""A V4L2 capture device in plain Python: what a driver answers to each ioctl, with faults on request.

Standard library only, because it runs in the distribution's interpreter, which has umockdev's bindings. The structures
are written down here a second time, as offsets into linux/videodev2.h, so that an error in the receiver's does not
cancel itself.
"""

from __future__ import annotations

import errno
import mmap
import struct
import time
from array import array
from dataclasses import dataclass, field
from pathlib import Path

BUFFER_BYTES = 8 << 20
MAX_BUFFERS = 8
#: Name -> bits per pixel of the frame in memory (0: compressed), bytes per pixel in a row of its first plane.
FORMATS = {"GREY": (8, 1), **dict.fromkeys(("Y10 ", "Y12 ", "Y16 ", "YUYV"), (16, 2)), "NV12": (12, 1), "MJPG": (0, 0)}
_SHIFTS = {"Y10 ": 2, "Y12 ": 4, "Y16 ": 8}
#: Controls: id -> type, name, least and greatest value.
_LIMITS = {
    0x009A0901: (3, b"Auto Exposure", 0, 3),
    0x009A0902: (1, b"Exposure Time, Absolute", 1, 5000),
    0x009A0903: (2, b"Exposure, Dynamic Framerate", 0, 1),
    0x00980913: (1, b"Gain", 0, 255),
    0x00980912: (2, b"Gain, Automatic", 0, 1),
}
_CAPABILITIES = 0x04200001  # streaming, extended pixel format, video capture
_TIMESTAMP_MONOTONIC, _BUFFER_ERROR = 0x2000, 0x40


class DriverError(Exception):
    """An ioctl that fails with an errno."""

    def __init__(self, number: int) -> None:
        super().__init__(errno.errorcode[number])
        self.number = number


@dataclass
class Faults:
    """What goes wrong, and when; None: never."""

    #: S_FMT says EBUSY for so many seconds from the first time it is asked.
    busy_s: float = 0.0
    #: After so many frames the camera is gone ...
    unplug_after: int | None = None
    #: ... and comes back after so many seconds.
    return_s: float = 1e9
    #: After so many frames no more come.
    stall_after: int | None = None
    #: Every so many frames one arrives damaged.
    damage_every: int | None = None
    #: S_FMT answers with this format, whatever is asked for.
    force_format: str | None = None
    #: Time stamps run so many times as fast as time: 0 makes them equal, -1 run backwards.
    stamp_pace: float = 1.0
    #: Every so many frames one has half of its bytes.
    short_every: int | None = None
    #: STREAMON fails with this error.
    stream_error: int | None = None


@dataclass
class FakeCamera:
    """State of the device: a free-running sensor that shows `luma` frames one after the other, again and again.

    Args:
        node: the file that clients open and map; buffers lie in it.
        width, height: the one size that is offered.
        luma: frames of width x height bytes, one after the other.
        jpegs: the same frames, compressed; MJPG is offered where there are any.
    """

    node: Path
    width: int
    height: int
    luma: bytes
    jpegs: list[bytes] = field(default_factory=list)
    fps: float = 60.0
    formats: tuple[str, ...] = tuple(FORMATS)
    faults: Faults = field(default_factory=Faults)

    def __post_init__(self) -> None:
        self.controls = {0x009A0901: 3, 0x009A0902: 156, 0x009A0903: 1, 0x00980913: 16, 0x00980912: 1}
        self.format = self.formats[0]
        self.queue: list[int] = []
        self.n_buffers = 0
        self.sequence = -1
        self.started_s = 0.0
        self.n_frames = 0
        self.gone_s: float | None = None
        self.asked_s: float | None = None
        with self.node.open("wb") as file:
            file.truncate(BUFFER_BYTES * MAX_BUFFERS)
        with self.node.open("r+b") as file:
            self.memory = mmap.mmap(file.fileno(), BUFFER_BYTES * MAX_BUFFERS)
        self._handlers = {
            0: self._query_capabilities,
            2: self._enumerate_formats,
            5: self._set_format,
            8: self._request_buffers,
            9: self._query_buffer,
            15: self._queue_buffer,
            17: self._dequeue_buffer,
            18: self._stream_on,
            22: self._stream_parameters,
            27: self._get_control,
            28: self._set_control,
            36: self._query_control,
            74: self._enumerate_sizes,
            75: self._enumerate_intervals,
        }

    def ioctl(self, request: int, argument: bytearray) -> tuple[int, int]:
        """Answer one call; (return value, errno), `argument` is changed in place."""
        handler = self._handlers.get(request & 0xFF) if (request >> 8) & 0xFF == ord("V") else None
        try:
            if handler is None:
                raise DriverError(errno.ENOTTY)
            self._check_plugged()
            handler(argument)
        except DriverError as error:
            return -1, error.number
        return 0, 0

    # -- identity and controls ----------------------------------------------------------------------------------------

    def _check_plugged(self) -> None:
        if self.gone_s is None:
            return
        if time.monotonic() - self.gone_s < self.faults.return_s:
            raise DriverError(errno.ENODEV)
        self.gone_s, self.faults.unplug_after = None, None

    def _query_capabilities(self, a: bytearray) -> None:
        names = (b"fakev4l2", b"Fake camera", b"platform:fake")
        struct.pack_into("<16s32s32sIII", a, 0, *names, 0x060100, _CAPABILITIES | 0x80000000, _CAPABILITIES)

    def _limits(self, a: bytearray) -> tuple[int, int, bytes, int, int]:
        (control,) = struct.unpack_from("<I", a)
        if control not in _LIMITS:
            raise DriverError(errno.EINVAL)
        return (control, *_LIMITS[control])

    def _query_control(self, a: bytearray) -> None:
        control, kind, name, low, high = self._limits(a)
        struct.pack_into("<II32siiiiI", a, 0, control, kind, name, low, high, 1, low, 0)

    def _get_control(self, a: bytearray) -> None:
        struct.pack_into("<i", a, 4, self.controls[self._limits(a)[0]])

    def _set_control(self, a: bytearray) -> None:
        control, _, _, low, high = self._limits(a)
        (value,) = struct.unpack_from("<i", a, 4)
        if not low <= value <= high:
            raise DriverError(errno.ERANGE)
        self.controls[control] = value

    # -- formats ------------------------------------------------------------------------------------------------------

    def _offered(self) -> list[str]:
        return [name for name in self.formats if FORMATS[name][0] or self.jpegs]

    def _enumerate_formats(self, a: bytearray) -> None:
        index, kind = struct.unpack_from("<II", a)
        if kind != 1 or index >= len(self._offered()):
            raise DriverError(errno.EINVAL)
        name = self._offered()[index]
        compressed = 0 if FORMATS[name][0] else 1
        struct.pack_into("<I32sI", a, 8, compressed, name.encode(), int.from_bytes(name.encode(), "little"))

    def _enumerate_sizes(self, a: bytearray) -> None:
        index, code = struct.unpack_from("<II", a)
        if index or code.to_bytes(4, "little").decode() not in self._offered():
            raise DriverError(errno.EINVAL)
        struct.pack_into("<III", a, 8, 1, self.width, self.height)

    def _enumerate_intervals(self, a: bytearray) -> None:
        if struct.unpack_from("<I", a)[0]:
            raise DriverError(errno.EINVAL)
        struct.pack_into("<III", a, 16, 1, 1000, round(self.fps * 1000))

    def _frame_bytes(self) -> int:
        bits = FORMATS[self.format][0]
        return self.width * self.height * bits // 8 if bits else self.width * self.height * 2

    def _get_format(self, a: bytearray) -> None:
        pitch = self.width * FORMATS[self.format][1]
        code = int.from_bytes(self.format.encode(), "little")
        struct.pack_into("<8I", a, 8, self.width, self.height, code, 1, pitch, self._frame_bytes(), 8, 0)

    def _set_format(self, a: bytearray) -> None:
        if struct.unpack_from("<I", a)[0] != 1:
            raise DriverError(errno.EINVAL)
        self.asked_s = self.asked_s if self.asked_s is not None else time.monotonic()
        if time.monotonic() - self.asked_s < self.faults.busy_s:
            raise DriverError(errno.EBUSY)
        asked = struct.unpack_from("<I", a, 16)[0].to_bytes(4, "little").decode("latin-1")
        asked = self.faults.force_format or asked
        if asked in self._offered():
            self.format = asked
        self._get_format(a)

    def _stream_parameters(self, a: bytearray) -> None:
        struct.pack_into("<IIII", a, 4, 0x1000, 0, 1000, round(self.fps * 1000))

    # -- streaming ----------------------------------------------------------------------------------------------------

    def _request_buffers(self, a: bytearray) -> None:
        count, _, memory = struct.unpack_from("<III", a)
        if memory != 1:
            raise DriverError(errno.EINVAL)
        self.n_buffers, self.queue = min(count, MAX_BUFFERS), []
        struct.pack_into("<I", a, 0, self.n_buffers)

    def _describe(self, a: bytearray, index: int, used: int = 0, flags: int = 0, time_s: float = 0.0) -> None:
        struct.pack_into("<IIIII", a, 0, index, 1, used, flags | 1 | _TIMESTAMP_MONOTONIC, 1)
        struct.pack_into("<qq", a, 24, int(time_s), int(time_s % 1 * 1e6))
        struct.pack_into("<IIQI", a, 56, max(0, self.sequence), 1, index * BUFFER_BYTES, self._frame_bytes())

    def _index(self, a: bytearray) -> int:
        (index,) = struct.unpack_from("<I", a)
        if index >= self.n_buffers:
            raise DriverError(errno.EINVAL)
        return int(index)

    def _query_buffer(self, a: bytearray) -> None:
        self._describe(a, self._index(a))

    def _queue_buffer(self, a: bytearray) -> None:
        index = self._index(a)
        if index in self.queue:
            raise DriverError(errno.EINVAL)
        self.queue.append(index)
        self._describe(a, index, flags=2)

    def _dequeue_buffer(self, a: bytearray) -> None:
        faults = self.faults
        if faults.unplug_after is not None and self.n_frames >= faults.unplug_after:
            self.gone_s = time.monotonic()
            raise DriverError(errno.ENODEV)
        stalled = faults.stall_after is not None and self.n_frames >= faults.stall_after
        early = time.monotonic() < self.started_s + (self.sequence + 1) / self.fps
        if stalled or early or not self.queue:
            raise DriverError(errno.EAGAIN)
        self.sequence = max(self.sequence + 1, int((time.monotonic() - self.started_s) * self.fps))
        self.n_frames += 1
        index = self.queue.pop(0)
        damaged = faults.damage_every is not None and self.n_frames % faults.damage_every == 0
        picture = self._picture(self.sequence)
        self.memory[index * BUFFER_BYTES : index * BUFFER_BYTES + len(picture)] = picture
        time_s = self.started_s + faults.stamp_pace * self.sequence / self.fps
        if faults.short_every is not None and self.n_frames % faults.short_every == 0:
            picture = picture[: len(picture) // 2]
        self._describe(a, index, len(picture), _BUFFER_ERROR if damaged else 0, time_s)

    def _stream_on(self, a: bytearray) -> None:
        if self.faults.stream_error is not None:
            raise DriverError(self.faults.stream_error)
        self.sequence, self.started_s = -1, time.monotonic()

    def _picture(self, sequence: int) -> bytes:
        """Frame `sequence` in the current pixel format."""
        size = self.width * self.height
        number = sequence % (len(self.luma) // size)
        if self.format == "MJPG":
            return self.jpegs[number]
        luma = self.luma[number * size : (number + 1) * size]
        if self.format == "GREY":
            return luma
        if self.format == "NV12":
            return luma + b"\x80" * (size // 2)
        if self.format == "YUYV":
            return bytes(sample for value in luma for sample in (value, 0x80))
        return array("H", (value << _SHIFTS[self.format] for value in luma)).tobytes()
