"""A V4L2 camera in plain Python that answers the system calls of the receiver's reader, with faults on request.

The structures are written down here a second time, as offsets into linux/videodev2.h: an error in the receiver's must
not cancel itself.
"""

import ctypes
import errno
import os
import signal
import struct
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import simplejpeg
from numpy.typing import NDArray

from rxcli.errors import InputError
from rxcli.ingest import v4l2
from rxcli.types import Frame

DEVICE = Path("/dev/video0")
BUFFER_BYTES, MAX_BUFFERS = 8 << 20, 8
#: Name -> bits per pixel of the frame in memory, bytes per pixel in a row of its first plane; MJPG is compressed.
FORMATS = {"GREY": (8, 1), **dict.fromkeys(("Y10 ", "Y12 ", "Y16 ", "YUYV"), (16, 2)), "NV12": (12, 1), "MJPG": (16, 0)}
#: Further ones: with chroma in the other order or in planes of its own, of which two are in buffers of their own.
OTHERS = {**dict.fromkeys(("NV21", "YU12", "YV12", "NM12", "YM12"), (12, 1)), "YVYU": (16, 2), "JPEG": (16, 0)}
_SHIFTS = {"Y10 ": 2, "Y12 ": 4, "Y16 ": 8}
#: Controls: id -> type, name, least and greatest value, and value at first.
_CONTROLS = {
    0x009A0901: (3, b"Auto Exposure", 0, 3, 3),
    0x009A0902: (1, b"Exposure Time, Absolute", 1, 5000, 156),
    0x009A0903: (2, b"Exposure, Dynamic Framerate", 0, 1, 1),
    0x00980913: (1, b"Gain", 0, 255, 16),
    0x00980912: (2, b"Gain, Automatic", 0, 1, 1),
}
#: Of a sensor on a board: exposure in lines, gain; blank pixels in a line, and pixels a second, which are only read.
_BOARD_CONTROLS = {0x00980911: (1, b"Exposure", 4, 1000, 600), 0x009E0903: (1, b"Analogue Gain", 0, 978, 16)}
_BLANK, _PIXEL_RATE = 0x009E0902, 0x009F0902
_CAPABILITIES = 0x04200000  # streaming, extended pixel format
_CAPTURE, _PLANES = {1: 0x1, 9: 0x1000}, 9  # capability by type of buffers
_TIMESTAMP_MONOTONIC, _BUFFER_ERROR = 0x2000, 0x40
_NEVER = 1 << 60


def _fail_unless(is_right: bool, number: int = errno.EINVAL) -> None:
    if not is_right:
        raise OSError(number, os.strerror(number))


class FakeCamera:
    """A free-running sensor that shows `luma` (n, height, width) frames one after the other, again and again.

    Args:
        node: the file that the reader opens and maps; buffers lie in it.
        luma: what it sees.
        fps: its rate.
        formats: what it offers.
        faults: `busy_s`: S_FMT says EBUSY for so many seconds from the first time it is asked; `unplug_after` so many
            frames the camera is gone, and comes back after `return_s`; `stall_after`: no more come; `damage_every`,
            `short_every`: one of so many is damaged, or has half of its bytes; `force_format`: what S_FMT answers;
            `stamp_pace`: time stamps run so many times as fast as time; `stream_error`: of STREAMON;
            `interrupt_after`: the user presses Ctrl-C; `start_s`: the first frame comes so late; `sizes`: "none" are
            listed, or a "range" of them; `planes`: buffers are in several; `reset`: STREAMON forgets the controls;
            `board`: controls of a sensor on a board, with pixels a second where it is a number; `fail_every`: one of so
            many calls fails with EIO.
    """

    def __init__(
        self,
        node: Path,
        luma: NDArray[np.uint8],
        fps: float = 60.0,
        formats: Sequence[str] = tuple(FORMATS),
        faults: dict[str, Any] | None = None,
    ) -> None:
        self.node, self.luma, self.fps, self.formats = node, luma, fps, formats
        self.height, self.width = luma.shape[1:]
        self.faults = dict.fromkeys(("unplug_after", "stall_after", "damage_every", "short_every"), _NEVER)
        self.faults |= {"interrupt_after": _NEVER, **(faults or {})}
        self.offered = _BOARD_CONTROLS if "board" in self.faults else _CONTROLS
        self.controls = {control: value for control, (*_, value) in self.offered.items()}
        self.kind, self.n_calls, self.size = _PLANES if "planes" in self.faults else 1, 0, (self.width, self.height)
        self.format, self.queue = formats[0], list[int]()
        self.n_buffers = self.n_frames = 0
        self.sequence, self.started_s = -1, 0.0
        self.gone_s: float | None = None
        self.asked_s: float | None = None
        self.memory = np.memmap(node, np.uint8, "w+", shape=(MAX_BUFFERS, BUFFER_BYTES))
        self._handlers = {
            0x80685600: self._query_capabilities,
            0xC0405602: self._enumerate_formats,
            0xC0D05604: self._get_format,
            0xC0D05605: self._set_format,
            0xC0205647: self._get_long_controls,
            0xC0145608: self._request_buffers,
            0xC0585609: lambda a: self._describe(a, self._index(a)),
            0xC058560F: self._queue_buffer,
            0xC0585611: self._dequeue_buffer,
            0x40045612: self._stream_on,
            0xC0CC5616: lambda a: struct.pack_into("<IIII", a, 4, 0x1000, 0, 1000, round(self.fps * 1000)),
            0xC008561B: lambda a: struct.pack_into("<i", a, 4, self.controls[self._limits(a)[0]]),
            0xC008561C: self._set_control,
            0xC0445624: lambda a: struct.pack_into("<II32siiiiI", a, 0, *self._limits(a), 1, 0, 0),
            0xC02C564A: self._enumerate_sizes,
            0xC034564B: self._enumerate_intervals,
        }

    def ioctl(self, _descriptor: int, request: int, argument: Any) -> None:
        """Answer one call, whose argument is changed in place."""
        data, request, self.n_calls = bytearray(argument), request & 0xFFFFFFFF, self.n_calls + 1
        _fail_unless(bool(self.n_calls % self.faults.get("fail_every", _NEVER)), errno.EIO)
        _fail_unless(request in self._handlers, errno.ENOTTY)
        if self.gone_s is not None:
            _fail_unless(time.monotonic() - self.gone_s > self.faults.get("return_s", _NEVER), errno.ENODEV)
            self.gone_s, self.faults["unplug_after"] = None, _NEVER
        self._handlers[request](data)
        ctypes.memmove(ctypes.addressof(argument), bytes(data), len(data))

    # -- identity, controls and formats -------------------------------------------------------------------------------

    def _query_capabilities(self, a: bytearray) -> None:
        names = (b"fakev4l2", b"Fake camera", b"platform:fake")
        able = _CAPABILITIES | _CAPTURE[self.kind]
        struct.pack_into("<16s32s32sIII", a, 0, *names, 0x060100, able | 0x80000000, able)

    def _limits(self, a: bytearray) -> tuple[Any, ...]:
        (control,) = struct.unpack_from("<I", a)
        _fail_unless(control in self.offered)
        return (control, *self.offered[control][:4])

    def _set_control(self, a: bytearray) -> None:
        (control, _, _, low, high), (value,) = self._limits(a), struct.unpack_from("<i", a, 4)
        _fail_unless(low <= value <= high, errno.ERANGE)
        self.controls[control] = value

    def _get_long_controls(self, a: bytearray) -> None:
        (count,), (place,) = struct.unpack_from("<I", a, 4), struct.unpack_from("<Q", a, 24)
        known = {_BLANK: 32, _PIXEL_RATE: self.faults.get("board")}
        for entry in (memoryview((ctypes.c_ubyte * 20).from_address(place + 20 * i)).cast("B") for i in range(count)):
            value = known.get(struct.unpack_from("<I", entry)[0])
            _fail_unless(isinstance(value, int))
            struct.pack_into("<q", entry, 12, value)

    def _enumerate_formats(self, a: bytearray) -> None:
        index, kind = struct.unpack_from("<II", a)
        _fail_unless(kind == self.kind and index < len(self.formats))
        name = self.formats[index].encode()
        struct.pack_into("<I32sI", a, 8, name == b"MJPG", name, int.from_bytes(name, "little"))

    def _enumerate_sizes(self, a: bytearray) -> None:
        index, code = struct.unpack_from("<II", a)
        _fail_unless(not index and code.to_bytes(4, "little").decode() in self.formats)
        _fail_unless(self.faults.get("sizes") != "none", errno.ENOTTY)
        if "sizes" in self.faults:
            struct.pack_into("<I6I", a, 8, 3, 32, self.width, 2, 32, self.height, 2)
        else:
            struct.pack_into("<III", a, 8, 1, self.width, self.height)

    def _enumerate_intervals(self, a: bytearray) -> None:
        _fail_unless(not struct.unpack_from("<I", a)[0])
        struct.pack_into("<III", a, 16, 1, 1000, round(self.fps * 1000))

    def _frame_bytes(self) -> int:
        return self.size[0] * self.size[1] * (FORMATS | OTHERS)[self.format][0] // 8

    def _set_format(self, a: bytearray) -> None:
        _fail_unless(struct.unpack_from("<I", a)[0] == self.kind)
        self.asked_s = self.asked_s or time.monotonic()
        _fail_unless(time.monotonic() - self.asked_s >= self.faults.get("busy_s", 0.0), errno.EBUSY)
        width, height, asked = struct.unpack_from("<II4s", a, 8)
        asked = self.faults.get("force_format", asked.decode("latin-1"))
        self.format = asked if asked in self.formats else self.format
        if "sizes" in self.faults:
            self.size = min(width, self.width) // 2 * 2, min(height, self.height) // 2 * 2
        self._get_format(a)

    def _get_format(self, a: bytearray) -> None:
        code, pitch = int.from_bytes(self.format.encode(), "little"), self.size[0] * (FORMATS | OTHERS)[self.format][1]
        if self.kind == _PLANES:
            struct.pack_into("<5III", a, 8, *self.size, code, 1, 8, self._frame_bytes(), pitch)
            struct.pack_into("<B", a, 8 + 20 + 8 * 20, 1)
        else:
            struct.pack_into("<8I", a, 8, *self.size, code, 1, pitch, self._frame_bytes(), 8, 0)

    # -- streaming ----------------------------------------------------------------------------------------------------

    def _request_buffers(self, a: bytearray) -> None:
        count, _, memory = struct.unpack_from("<III", a)
        _fail_unless(memory == 1)
        self.n_buffers, self.queue = min(count, MAX_BUFFERS), []
        struct.pack_into("<I", a, 0, self.n_buffers)

    def _describe(self, a: bytearray, index: int, used: int = 0, flags: int = 0, time_s: float = 0.0) -> None:
        place, length = index * BUFFER_BYTES, self._frame_bytes()
        if self.kind == _PLANES:
            at, n_planes = struct.unpack_from("<QI", a, 64)
            plane = memoryview((ctypes.c_ubyte * (64 * n_planes)).from_address(at)).cast("B")
            struct.pack_into("<IIQ", plane, 0, used, length, place)
            used, place, length = 0, at, 1
        struct.pack_into("<IIIII", a, 0, index, self.kind, used, flags | 1 | _TIMESTAMP_MONOTONIC, 1)
        struct.pack_into("<qq", a, 24, int(time_s), int(time_s % 1 * 1e6))
        struct.pack_into("<IIQI", a, 56, max(0, self.sequence), 1, place, length)

    def _index(self, a: bytearray) -> int:
        (index,) = struct.unpack_from("<I", a)
        _fail_unless(index < self.n_buffers)
        return int(index)

    def _queue_buffer(self, a: bytearray) -> None:
        index = self._index(a)
        _fail_unless(index not in self.queue)
        self.queue.append(index)
        self._describe(a, index, flags=2)

    def _dequeue_buffer(self, a: bytearray) -> None:
        if self.n_frames >= self.faults["unplug_after"]:
            self.gone_s = time.monotonic()
            _fail_unless(False, errno.ENODEV)
        if self.n_frames >= self.faults["interrupt_after"]:
            signal.raise_signal(signal.SIGINT)
        is_early = time.monotonic() < self.started_s + max(
            (self.sequence + 1) / self.fps, self.faults.get("start_s", 0)
        )
        is_stalled = self.n_frames >= self.faults["stall_after"]
        _fail_unless(not (is_stalled or is_early) and bool(self.queue), errno.EAGAIN)
        self.sequence = max(self.sequence + 1, int((time.monotonic() - self.started_s) * self.fps))
        self.n_frames += 1
        seen = self.luma[self.sequence % len(self.luma), : self.size[1], : self.size[0]]
        index, picture = self.queue.pop(0), self._picture(seen)
        self.memory[index, : picture.size] = picture
        used = picture.size // (1 if self.n_frames % self.faults["short_every"] else 2)
        flags = 0 if self.n_frames % self.faults["damage_every"] else _BUFFER_ERROR
        pace = self.faults.get("stamp_pace", 1.0)
        self._describe(a, index, used, flags, self.started_s + pace * self.sequence / self.fps)

    def _stream_on(self, a: bytearray) -> None:
        _fail_unless("stream_error" not in self.faults, self.faults.get("stream_error", 0))
        self.sequence, self.started_s = -1, time.monotonic()
        if "reset" in self.faults:
            self.controls = {control: value for control, (*_, value) in self.offered.items()}

    def _picture(self, luma: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A frame in the current pixel format, as it lies in memory."""
        if self.format in ("MJPG", "JPEG"):
            form = {"quality": 100, "colorspace": "GRAY", "colorsubsampling": "Gray"}
            return np.frombuffer(simplejpeg.encode_jpeg(luma[:, :, None].copy(), **form), np.uint8)
        if self.format[:2] in ("NV", "NM", "YU", "YV", "YM") and self.format[2:].isdigit():
            return np.append(luma, np.full(luma.size // 2, 0x80, np.uint8))
        if self.format in ("YUYV", "YVYU"):
            return np.stack([luma, np.full_like(luma, 0x80)], axis=-1).ravel()
        return (
            luma.ravel() if self.format == "GREY" else (luma.astype("<u2") << _SHIFTS[self.format]).view("u1").ravel()
        )


class Bench:
    """A place where fake cameras of one scene are plugged in, each to be read in this process."""

    def __init__(self, folder: Path, luma: NDArray[np.uint8], monkeypatch: pytest.MonkeyPatch, **options: Any) -> None:
        self.luma, self._node, self._patch, self._options = luma, folder / "video0", monkeypatch, options
        self.camera = self.plug_in()

    def plug_in(self, **options: Any) -> FakeCamera:
        """A new camera at /dev/video0."""
        self.camera = FakeCamera(self._node, self.luma, **(self._options | options))
        self._patch.setattr(v4l2, "ioctl", self.camera.ioctl)
        self._patch.setattr(v4l2, "_open", lambda _path: os.open(self._node, os.O_RDWR))
        return self.camera

    def read(self, settings: dict[str, Any], n_frames: int = 10, pause_s: float = 0.0, **options: Any) -> Any:
        """What the receiver's reader gets of a new camera: frames, the error that ended them, and its own state."""
        self.plug_in(**options)
        waited, frames, error = list[str](), list[Frame](), None
        source = v4l2.LiveSource(DEVICE, v4l2.CameraSettings(**settings), on_lost=waited.append)
        try:
            for frame in source:
                frames.append(frame)
                if len(frames) == n_frames:
                    break
                time.sleep(pause_s)
        except InputError as failure:
            error = str(failure)
        return SimpleNamespace(frames=frames, error=error, waited=waited, mode=str(source.mode), counts=source.counts)
