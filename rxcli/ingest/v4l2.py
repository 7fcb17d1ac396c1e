"""A live V4L2 camera in its own pixel formats, always the newest frame.

The kernel is asked directly, in the structures of videodev2. OpenCV hides why a camera cannot be opened, takes another
pixel format unasked, and gives no times. FFmpeg's input (through PyAV) gives times, but sets neither exposure nor gain,
lists modes to its log alone, and takes YUYV where 10 or 12 bits are asked for.
"""

import ctypes
import errno
import math
import mmap
import os
import select
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from fcntl import ioctl
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import videodev2 as api
from numpy.typing import NDArray

from rxcli.errors import InputError
from rxcli.ingest.luma import Luma
from rxcli.ingest.times import FrameTimes
from rxcli.types import Frame, Metadata

_CAPTURE, _MAPPED = api.V4L2_BUF_TYPE_VIDEO_CAPTURE, api.V4L2_MEMORY_MMAP
#: Buffers in several planes, as those of cameras on phones and boards are, and how many at most.
_PLANES, _N_PLANES = api.V4L2_BUF_TYPE_VIDEO_CAPTURE_MPLANE, 8
#: Requests of linux/videodev2.h that the package lacks, whose structures are numbers of 32 bits, and how many.
_FRAME_SIZES, _N_SIZE, _FRAME_INTERVALS, _N_INTERVAL = 0xC02C564A, 11, 0xC034564B, 13
#: Unit of the usual control of the exposure, seconds, and the exposure if none is requested.
_EXPOSURE_UNIT_S = _SHORT_S = 100e-6
_N_BUFFERS = 4
#: Minimum frame rate if none is requested, so that an aimed camera responds at once.
_USUAL_FPS = 24.0
_POLL_S = 0.1
_RETRY_S = 0.5
_NO_DATA_SLEEP_S = 0.002
#: Some cameras take seconds to their first frame.
_START_S = 10.0
#: Attempts at a call that fails now and then.
_ATTEMPTS = 3


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """How luma lies in a buffer of one pixel format."""

    dtype: type[np.uint8] | type[np.uint16] = np.uint8
    #: Samples from one luma sample to the next, and before the first.
    step: int = 1
    start: int = 0
    white: int = 255
    #: Whether the samples are luma of YCbCr, whose levels the driver reports.
    ycbcr: bool = False


_COMPRESSED = ("MJPG", "JPEG")
#: In the order of preference, at equal size and sufficient rate: more bits first, compressed last.
PIXEL_FORMATS = {
    "Y16": PixelFormat(np.uint16, white=65535),
    "Y12": PixelFormat(np.uint16, white=4095),
    "Y10": PixelFormat(np.uint16, white=1023),
    "GREY": PixelFormat(),
    **dict.fromkeys(("NV12", "NV21", "NV16", "YU12", "YV12", "NM12", "NM21", "YM12"), PixelFormat(ycbcr=True)),
    **dict.fromkeys(("YUYV", "YVYU"), PixelFormat(step=2, ycbcr=True)),
    **dict.fromkeys(("UYVY", "VYUY"), PixelFormat(step=2, start=1, ycbcr=True)),
    **dict.fromkeys(_COMPRESSED, PixelFormat()),
}


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Requested mode and controls of a camera; None: the best available."""

    width: int | None = None
    height: int | None = None
    fps: float | None = None
    #: One of `PIXEL_FORMATS`.
    pixel_format: str | None = None
    #: None: as short as the camera can.
    exposure_s: float | None = None
    #: In the driver's units.
    gain: int | None = None
    #: Wait for a camera that is missing, busy or unplugged, instead of giving up.
    wait: bool = False
    #: A camera that is silent for so long is taken for lost.
    stall_s: float = 3.0


@dataclass(frozen=True, slots=True)
class Mode:
    """One way in which a camera delivers frames."""

    pixel_format: str
    width: int
    height: int
    #: Highest rate, 0 if the driver does not report it.
    fps: float

    def __str__(self) -> str:
        rate = f" at {self.fps:g} frames/s" if self.fps else ""
        return f"{self.pixel_format} {self.width} x {self.height}{rate}"


@dataclass(slots=True)
class CameraCounts:
    """Counts of captured, dropped and damaged frames over all connections."""

    delivered: int = 0
    #: Passed over because the receiver was still busy, here or in the driver.
    dropped: int = 0
    damaged: int = 0
    connections: int = 0
    #: Since the first frame, which came then by the driver's clock; that goes on through connections.
    times: FrameTimes = field(default_factory=FrameTimes)
    start_s: float | None = None


class CameraLost(InputError):
    """A camera that is missing, busy, silent or unplugged: it may come back."""


@dataclass(slots=True, eq=False)
class LiveSource:
    """Frames of a camera, over as many connections as it takes; iterate over it once."""

    #: The device, `/dev/video0`.
    path: Path
    #: Requested mode and controls.
    settings: CameraSettings = CameraSettings()
    #: Called with the reason when waiting begins.
    on_lost: Callable[[str], None] = lambda reason: None
    #: Time limit from the request of the first frame; None: no limit.
    duration_s: float | None = None
    #: Called regularly while no whole frame arrives.
    on_idle: Callable[[], None] = lambda: None
    #: How the camera is driven, None before it answers.
    mode: Mode | None = None
    counts: CameraCounts = field(default_factory=CameraCounts)

    def __iter__(self) -> Generator[Frame, None, None]:
        is_waiting, end_s = False, time.monotonic() + (math.inf if self.duration_s is None else self.duration_s)
        while time.monotonic() < end_s:
            try:
                with closing(Camera(self.path, self.settings, self.counts)) as camera:
                    self.mode, is_waiting = camera.mode, False
                    for frame in camera:
                        if frame is None:
                            self.on_idle()
                        else:
                            yield frame
                        if time.monotonic() >= end_s:
                            return
            except CameraLost as error:
                if not self.settings.wait:
                    raise
                if not is_waiting:
                    self.on_lost(str(error))
                is_waiting = True
                time.sleep(min(_RETRY_S, max(end_s - time.monotonic(), 0.0)))
                self.on_idle()


class Camera:
    """One connection to a camera, which is to be closed, and an iterator over its newest frames.

    None stands between frames where no whole one came for a while.

    Raises:
        CameraLost: missing, busy, silent or unplugged.
        InputError: no camera, or not in the mode that is asked for.
    """

    def __init__(self, path: Path, settings: CameraSettings, counts: CameraCounts) -> None:
        self.counts, self._path, self._settings = counts, path, settings
        self._maps: list[mmap.mmap] = []
        #: Number of the last frame that the driver gave, and when it came.
        self._sequence: int | None = None
        self._came_s = self._given_s = time.monotonic()
        with _explained(path), ExitStack() as opened:
            self._descriptor = _open(path)
            opened.callback(os.close, self._descriptor)  # stops the stream and frees its buffers, whatever its state
            self._configure(opened)
            #: Hand the device back; may be called again.
            self.close = opened.pop_all().close

    def __iter__(self) -> Iterator[Frame | None]:
        with _explained(self._path):
            while True:
                n_damaged = self.counts.damaged
                buffer = self._newest()
                silent_s = time.monotonic() - self._came_s
                luma = None if buffer is None else self._luma(buffer)
                if buffer is not None:
                    self._give_back(buffer)
                    self.counts.damaged += luma is None
                elif silent_s > (limit_s := self._settings.stall_s if self._sequence is not None else _START_S):
                    reason = f"{self._path}: the camera sent nothing for {limit_s:g} s"
                    raise CameraLost(reason, "check its cable, or lower size and rate")
                if luma is not None:
                    yield self._frame(luma, buffer.timestamp.tv_sec + buffer.timestamp.tv_usec * 1e-6)
                elif silent_s > _POLL_S or self.counts.damaged > n_damaged:
                    yield None

    # -- setting up ---------------------------------------------------------------------------------------------------

    def _configure(self, opened: ExitStack) -> None:
        self._card, self._kind = _check_capture(self._descriptor, self._path)
        wanted = _choose(list(_modes(self._descriptor, self._kind, self._settings)), self._settings, self._path)
        self._form, self._pitch = _set_format(self._descriptor, self._kind, wanted, self._settings, self._path)
        fps = _set_rate(self._descriptor, self._kind, self._settings.fps or wanted.fps)
        self.mode = Mode(wanted.pixel_format, self._form.width, self._form.height, fps)
        set_controls = partial(_set_controls, self._descriptor, self._settings, self._form.width, self._path)
        set_controls()
        request = api.v4l2_requestbuffers(count=_N_BUFFERS, type=self._kind, memory=_MAPPED)
        _ask(self._descriptor, api.VIDIOC_REQBUFS, request)
        for index in range(request.count):
            buffer = _buffer(self._kind, index)
            _ask(self._descriptor, api.VIDIOC_QUERYBUF, buffer)
            place = buffer.m.offset if self._kind == _CAPTURE else _luma_plane(buffer).m.mem_offset
            length = _luma_plane(buffer).length
            self._maps.append(opened.enter_context(mmap.mmap(self._descriptor, length, offset=place)))
            self._give_back(buffer)
        _ask(self._descriptor, api.VIDIOC_STREAMON, ctypes.c_int(self._kind))
        self.exposure_s = set_controls()  # again, for some cameras forget them when the stream begins
        self.counts.connections += 1

    # -- taking frames ------------------------------------------------------------------------------------------------

    def _newest(self) -> Any:
        """The newest whole capture; those before it go back to the driver unseen. None where none came for a while."""
        newest, n_captures = None, 0
        while select.select([self._descriptor], [], [], 0.0 if n_captures else _POLL_S)[0]:
            buffer = _buffer(self._kind)
            try:
                ioctl(self._descriptor, api.VIDIOC_DQBUF, buffer)
            except OSError as error:
                if error.errno not in (errno.EAGAIN, errno.EIO):
                    raise
                self.counts.damaged += error.errno == errno.EIO  # which may pass; if not, nothing comes any more
                time.sleep(_NO_DATA_SLEEP_S)
                break
            n_captures += 1
            if self._sequence is not None:
                self.counts.dropped += max(0, buffer.sequence - self._sequence - 1)
            self._sequence, self._came_s = buffer.sequence, time.monotonic()
            if buffer.flags & api.V4L2_BUF_FLAG_ERROR:
                self.counts.damaged += 1
                self._give_back(buffer)
                continue
            self._pass_over(newest)
            newest = buffer
        # Where every buffer was filled, the driver had none for what came after: the newest is old.
        if n_captures == len(self._maps):
            self._pass_over(newest)
            return None
        return newest

    def _pass_over(self, buffer: Any) -> None:
        if buffer is not None:
            self.counts.dropped += 1
            self._give_back(buffer)

    def _give_back(self, buffer: Any) -> None:
        _ask(self._descriptor, api.VIDIOC_QBUF, _buffer(self._kind, buffer.index))

    def _luma(self, buffer: Any) -> Luma | None:
        """A copy (height, width) of the luma in a buffer; None where it is damaged."""
        data, used = self._maps[buffer.index], _luma_plane(buffer).bytesused
        if self.mode.pixel_format in _COMPRESSED:
            from rxcli.ingest.jpeg import decode_luma

            with suppress(InputError):
                return decode_luma(data[:used], self._path)
            return None
        pixels, width, height = PIXEL_FORMATS[self.mode.pixel_format], self.mode.width, self.mode.height
        dtype = np.dtype(pixels.dtype)
        row = width * pixels.step * dtype.itemsize
        pitch = max(self._pitch, row)
        if min(used, len(data)) < pitch * (height - 1) + row:
            return None
        samples: NDArray[Any] = np.ndarray((height, width * pixels.step), dtype, data, strides=(pitch, dtype.itemsize))
        return samples[:, pixels.start :: pixels.step].copy()

    def _levels(self) -> tuple[float, float]:
        """Values of black and white."""
        pixels, form = PIXEL_FORMATS[self.mode.pixel_format], self._form
        full = form.quantization == api.V4L2_QUANTIZATION_FULL_RANGE or form.colorspace == api.V4L2_COLORSPACE_JPEG
        return (16, 235) if pixels.ycbcr and not full else (0, pixels.white)

    def _frame(self, luma: Luma, own_s: float) -> Frame:
        """A frame; where the driver's times do not advance, by the time that passed here, in whole frames."""
        step_s, fps = self._came_s - self._given_s, self.mode.fps
        step_s = max(round(step_s * fps), 1) / fps if fps else step_s
        self.counts.start_s = own_s if self.counts.start_s is None else self.counts.start_s
        time_s, nominal = self.counts.times.next(own_s - self.counts.start_s, step_s)
        self._given_s, index = self._came_s, self.counts.delivered
        self.counts.delivered += 1
        metadata, (black, white) = Metadata(model=self._card, exposure_s=self.exposure_s), self._levels()
        return Frame(luma, str(self._path), index, time_s, metadata, black=black, white=white, nominal_time=nominal)


def list_modes(path: Path) -> list[Mode]:
    """The modes of a camera that the receiver can use, best first.

    Raises:
        InputError: no camera, missing or busy.
    """
    with _explained(path):
        descriptor = _open(path)
        try:
            _, kind = _check_capture(descriptor, path)
            return sorted(_modes(descriptor, kind, CameraSettings()), key=_merit, reverse=True)
        finally:
            os.close(descriptor)


def _open(path: Path) -> int:
    return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Raise errors of system calls as what they mean to a user."""
    try:
        yield
    except OSError as error:
        unknown = (CameraLost, f"the camera failed ({error.strerror})", _PLUG)
        kind, reason, step = _FAILURES.get(error.errno or 0, unknown)
        raise kind(f"{path}: {reason}", step.format(path=path)) from None


_PLUG = "plug it in again; --wait waits for it"
_MISSING = "plug it in, or see `v4l2-ctl --list-devices`; --wait waits for it"
_ROOM = "lower --width, --height or --fps, take --format MJPG, or give it a USB port apart from other cameras"
_REFUSED = "no V4L2 camera, or one that refuses its own mode"
_FAILURES = {
    **dict.fromkeys((errno.ENOENT, errno.ENXIO), (CameraLost, "no such camera", _MISSING)),
    errno.ENODEV: (CameraLost, "the camera was unplugged", _PLUG),
    errno.EBUSY: (CameraLost, "another program uses the camera", "close it (`fuser -v {path}` names it)"),
    errno.ENOSPC: (CameraLost, "its USB port has no room left for this mode", _ROOM),
    errno.ENOMEM: (CameraLost, "the driver has no memory for this mode", "lower --width and --height"),
    errno.EPERM: (InputError, "this process may not use it", "give its container the device, or lift the rule"),
    errno.EACCES: (InputError, "permission denied", "add yourself to the group `video` and log in again"),
    **dict.fromkeys((errno.ENOTTY, errno.EINVAL), (InputError, _REFUSED, "name another /dev/video device")),
}


def _check_capture(descriptor: int, path: Path) -> tuple[str, int]:
    """The camera's name, and its type of buffers.

    Raises:
        InputError: the device is none that streams pictures.
    """
    capability = api.v4l2_capability()
    if not _is_known(descriptor, api.VIDIOC_QUERYCAP, capability):
        raise InputError(f"{path}: is no V4L2 device", "name a camera, such as /dev/video0")
    able = capability.capabilities
    able = capability.device_caps if able & api.V4L2_CAP_DEVICE_CAPS else able
    captures = able & (api.V4L2_CAP_VIDEO_CAPTURE | api.V4L2_CAP_VIDEO_CAPTURE_MPLANE)
    if not (captures and able & api.V4L2_CAP_STREAMING):
        raise InputError(f"{path}: does not stream pictures", "name the camera's other /dev/video device")
    card = bytes(capability.card).partition(b"\0")[0].decode("utf-8", "replace")
    return card, _CAPTURE if captures & api.V4L2_CAP_VIDEO_CAPTURE else _PLANES


def _is_known(descriptor: int, request: int, argument: Any) -> bool:
    """Make a system call; whether the driver knows it and does not refuse its argument."""
    try:
        _ask(descriptor, request, argument)
    except OSError as error:
        if error.errno in (errno.EINVAL, errno.ENOTTY, errno.EACCES, errno.EPERM, errno.ERANGE):
            return False
        raise
    return True


def _ask(descriptor: int, request: int, argument: Any) -> None:
    """Make a system call, again where it fails as transfers on USB do now and then."""
    for attempt in range(1, _ATTEMPTS + 1):
        try:
            ioctl(descriptor, request, argument)
        except OSError as error:
            if error.errno != errno.EIO or attempt == _ATTEMPTS:
                raise
        else:
            return


def _modes(descriptor: int, kind: int, settings: CameraSettings) -> Iterator[Mode]:
    """Modes of known pixel formats; of a range of sizes the one that is asked for, or the largest."""
    for form in _enumerate(descriptor, api.VIDIOC_ENUM_FMT, api.v4l2_fmtdesc, kind):
        code, name = form.pixelformat, _name_of(form.pixelformat)
        for width, height in _sizes(descriptor, kind, code, settings) if name in PIXEL_FORMATS else ():
            intervals = _enumerate(descriptor, _FRAME_INTERVALS, ctypes.c_uint32 * _N_INTERVAL, code, width, height)
            rates = (denominator / numerator for *_, numerator, denominator in (i[5:7] for i in intervals) if numerator)
            yield Mode(name, width, height, max(rates, default=0.0))


def _sizes(descriptor: int, kind: int, code: int, settings: CameraSettings) -> Iterator[tuple[int, int]]:
    """Sizes of a pixel format; if the driver lists none, the one that is asked for, or the one that is set."""
    sizes = list(_enumerate(descriptor, _FRAME_SIZES, ctypes.c_uint32 * _N_SIZE, code))
    for _, _, listed, *sides in sizes:
        if listed == api.V4L2_FRMSIZE_TYPE_DISCRETE:
            yield sides[0], sides[1]
            continue
        ranges = zip((settings.width, settings.height), (sides[:2], sides[3:5]), strict=True)
        width, height = (asked if asked and low <= asked <= high else high for asked, (low, high) in ranges)
        yield width, height
    form = api.v4l2_format(type=kind)
    if not sizes and _is_known(descriptor, api.VIDIOC_G_FMT, form):
        yield settings.width or form.fmt.pix.width, settings.height or form.fmt.pix.height


def _enumerate(descriptor: int, request: int, structure: Callable[..., Any], *fields: int) -> Iterator[Any]:
    """Enumerate entries of the driver until EINVAL; empty if it cannot enumerate. `fields` follow the index."""
    for index in range(1000):
        item = structure(index, *fields)
        if not _is_known(descriptor, request, item):
            return
        yield item


def _name_of(code: int) -> str:
    """Name of a pixel format code, without the padding to four letters."""
    return code.to_bytes(4, "little").decode("latin-1").rstrip()


def _merit(mode: Mode, fps: float | None = None) -> tuple[bool, int, int]:
    """Order of modes: fast enough, then large, then by pixel format."""
    is_fast = mode.fps == 0 or mode.fps >= (fps or _USUAL_FPS) * 0.98
    return is_fast, mode.width * mode.height, -list(PIXEL_FORMATS).index(mode.pixel_format)


def _choose(modes: list[Mode], settings: CameraSettings, path: Path) -> Mode:
    """The best mode that fulfils what is asked for.

    Raises:
        InputError: there is none; the message lists the available modes.
    """
    asked_for = [(name, getattr(settings, name)) for name in ("pixel_format", "width", "height")]
    fitting = [mode for mode in modes if all(value in (None, getattr(mode, name)) for name, value in asked_for)]
    if fitting:
        return max(fitting, key=partial(_merit, fps=settings.fps))
    if not modes:
        raise InputError(f"{path}: none of its pixel formats can be read", f"known are {', '.join(PIXEL_FORMATS)}")
    asked = f"{settings.pixel_format or 'any format'} {settings.width or 'any'} x {settings.height or 'any'}"
    raise InputError(f"{path}: does not offer {asked}", f"it offers {', '.join(str(mode) for mode in modes)}")


def _set_format(descriptor: int, kind: int, mode: Mode, settings: CameraSettings, path: Path) -> tuple[Any, int]:
    """Set the format of a mode; returns the one in effect, and the bytes of a row of luma."""
    code = api.v4l2_fourcc(*mode.pixel_format.ljust(4))
    form = api.v4l2_format(type=kind)
    got = form.fmt.pix if kind == _CAPTURE else form.fmt.pix_mp
    got.width, got.height, got.pixelformat, got.field = mode.width, mode.height, code, api.V4L2_FIELD_NONE
    _ask(descriptor, api.VIDIOC_S_FMT, form)
    if got.pixelformat != code:  # a driver may answer with the nearest that it has
        given = _name_of(got.pixelformat)
        raise InputError(f"{path}: gives {given} instead of {mode.pixel_format}", "ask for another --format")
    if (settings.width or got.width, settings.height or got.height) != (got.width, got.height):
        reason = f"{path}: gives {got.width} x {got.height} instead of {mode.width} x {mode.height}"
        raise InputError(reason, "ask for that --width and --height")
    return got, (got if kind == _CAPTURE else got.plane_fmt[0]).bytesperline


def _set_rate(descriptor: int, kind: int, fps: float) -> float:
    """Ask for a frame rate; returns the actual one, 0 if it is not reported."""
    parameters = api.v4l2_streamparm(type=kind)
    interval = parameters.parm.capture.timeperframe
    if fps > 0:
        interval.numerator, interval.denominator = 1000, round(1000 * fps)
    if not _is_known(descriptor, api.VIDIOC_S_PARM, parameters) or not interval.numerator:
        return 0.0
    return float(interval.denominator / interval.numerator)


def _set_controls(descriptor: int, settings: CameraSettings, width: int, path: Path) -> float | None:
    """Fix the exposure, a short one if none is requested, and a requested gain; returns the actual exposure, or None.

    Raises:
        InputError: one is asked for and the camera has no such control.
    """
    _set(descriptor, api.V4L2_CID_EXPOSURE_AUTO, api.V4L2_EXPOSURE_MANUAL)
    _set(descriptor, api.V4L2_CID_EXPOSURE_AUTO_PRIORITY, 0)  # else the camera lowers its rate in the dark
    unit_s: float | None = _EXPOSURE_UNIT_S
    wanted_s = settings.exposure_s or _SHORT_S
    units = _set(descriptor, api.V4L2_CID_EXPOSURE_ABSOLUTE, round(wanted_s / _EXPOSURE_UNIT_S))
    if units is None:  # sensors on a board count lines
        unit_s = _line_s(descriptor, width)
        units = _set(descriptor, api.V4L2_CID_EXPOSURE, round(wanted_s / unit_s) if unit_s else 0)
    if settings.exposure_s is not None and (units is None or unit_s is None):
        lacks = "has no exposure control" if units is None else "counts its exposure in lines of unknown duration"
        raise InputError(f"{path}: the camera {lacks}", "leave --exposure out")
    if settings.gain is not None:
        _set(descriptor, api.V4L2_CID_AUTOGAIN, 0)
        controls = api.V4L2_CID_GAIN, api.V4L2_CID_ANALOGUE_GAIN
        if all(_set(descriptor, control, settings.gain) is None for control in controls):
            raise InputError(f"{path}: the camera has no gain control", "leave --gain out")
    return None if units is None or unit_s is None else units * unit_s


def _line_s(descriptor: int, width: int) -> float | None:
    """Time from line to line of a sensor, by its pixels a line and a second; None if the driver does not state it."""
    values = (api.v4l2_ext_control * 2)()
    values[0].id, values[1].id = api.V4L2_CID_HBLANK, api.V4L2_CID_PIXEL_RATE
    request = api.v4l2_ext_controls(count=2, controls=values)
    if not _is_known(descriptor, api.VIDIOC_G_EXT_CTRLS, request) or values[1].value64 <= 0:
        return None
    return float((width + values[0].value) / values[1].value64)


def _set(descriptor: int, control: int, value: int) -> int | None:
    """Set a control to the nearest value that it can have; the value in effect, None where there is no such control."""
    limits = api.v4l2_queryctrl(id=control)
    if not _is_known(descriptor, api.VIDIOC_QUERYCTRL, limits):
        return None
    state = api.v4l2_control(control, min(max(value, limits.minimum), limits.maximum))
    able = not limits.flags & (api.V4L2_CTRL_FLAG_DISABLED | api.V4L2_CTRL_FLAG_READ_ONLY)
    known = able and all(_is_known(descriptor, call, state) for call in (api.VIDIOC_S_CTRL, api.VIDIOC_G_CTRL))
    return int(state.value) if known else None


def _buffer(kind: int, index: int = 0) -> Any:
    buffer = api.v4l2_buffer(index=index, type=kind, memory=_MAPPED)
    if kind == _PLANES:
        # One more, because the package's structure lacks four bytes behind the fields that are read here.
        buffer.m.planes, buffer.length = (api.v4l2_plane * (_N_PLANES + 1))(), _N_PLANES
    return buffer


def _luma_plane(buffer: Any) -> Any:
    """What states length and used bytes of a buffer's luma."""
    return buffer.m.planes[0] if buffer.type == _PLANES else buffer
