"""A live V4L2 camera in its own pixel formats, always the newest frame.

The kernel interface is used directly. OpenCV hides why a camera cannot be opened, takes another pixel format unasked,
and gives no times. FFmpeg's input (through PyAV) gives times, but sets neither exposure nor gain, lists modes to its
log alone, and takes YUYV where 10 or 12 bits are asked for.
"""

import ctypes
import errno
import math
import mmap
import os
import select
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from fcntl import ioctl
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import InputError
from rxcli.ingest import v4l2_abi as abi
from rxcli.ingest.times import FrameTimes
from rxcli.types import Frame, Metadata

Luma = NDArray[np.uint8] | NDArray[np.uint16]

_N_BUFFERS = 4
#: Minimum frame rate if none is requested, so that an aimed camera responds at once.
_USUAL_FPS = 24.0
_POLL_S = 0.1
_RETRY_S = 0.5
_NO_DATA_SLEEP_S = 0.002


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


#: In the order of preference, at equal size and sufficient rate: more bits first, compressed last.
PIXEL_FORMATS = {
    "Y16": PixelFormat(np.uint16, white=65535),
    "Y12": PixelFormat(np.uint16, white=4095),
    "Y10": PixelFormat(np.uint16, white=1023),
    "GREY": PixelFormat(),
    "NV12": PixelFormat(ycbcr=True),
    "YUYV": PixelFormat(step=2, ycbcr=True),
    "UYVY": PixelFormat(step=2, start=1, ycbcr=True),
    "MJPG": PixelFormat(),
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
    #: On the driver's clock, which goes on through connections; and of the first frame there.
    times: FrameTimes = field(default_factory=FrameTimes)
    start_s: float | None = None


class CameraLost(InputError):
    """A camera that is missing, busy, silent or unplugged: it may come back."""


class LiveSource:
    """Frames of a camera, over as many connections as it takes; iterate over it once.

    Args:
        path: the device, `/dev/video0`.
        settings: requested mode and controls.
        on_lost: called with the reason when waiting begins.
        duration_s: time limit from the request of the first frame, seconds; None: no limit.
        on_idle: called regularly while no whole frame arrives.
    """

    def __init__(
        self,
        path: Path,
        settings: CameraSettings | None = None,
        on_lost: Callable[[str], None] | None = None,
        duration_s: float | None = None,
        on_idle: Callable[[], None] | None = None,
    ) -> None:
        self.settings = settings or CameraSettings()
        self.counts = CameraCounts()
        #: How the camera is driven, None before it answers.
        self.mode: Mode | None = None
        self._path = path
        self._on_lost = on_lost or (lambda reason: None)
        self._duration_s = math.inf if duration_s is None else duration_s
        self._on_idle = on_idle or (lambda: None)

    def __iter__(self) -> Generator[Frame, None, None]:
        end_s, is_waiting = time.monotonic() + self._duration_s, False
        while time.monotonic() < end_s:
            try:
                with closing(Camera(self._path, self.settings, self.counts)) as camera:
                    self.mode, is_waiting = camera.mode, False
                    for frame in camera:
                        if frame is None:
                            self._on_idle()
                        else:
                            yield frame
                        if time.monotonic() >= end_s:
                            return
            except CameraLost as error:
                if not self.settings.wait:
                    raise
                if not is_waiting:
                    self._on_lost(str(error))
                is_waiting = True
                time.sleep(min(_RETRY_S, max(end_s - time.monotonic(), 0.0)))
                self._on_idle()


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
        with _explained(path):
            self._descriptor = _open(path)
            try:
                self._configure()
            except BaseException:
                self.close()
                raise

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
                elif silent_s > self._settings.stall_s:
                    reason = f"{self._path}: the camera sent nothing for {self._settings.stall_s:g} s"
                    raise CameraLost(reason, "check its cable, or lower size and rate")
                if luma is not None:
                    yield self._frame(luma, buffer.seconds + buffer.microseconds * 1e-6)
                elif silent_s > _POLL_S or self.counts.damaged > n_damaged:
                    yield None

    def close(self) -> None:
        """Hand the device back; may be called again."""
        for view in self._maps:
            view.close()
        if self._descriptor >= 0:
            os.close(self._descriptor)  # stops the stream and frees its buffers, whatever state it is in
        self._descriptor = -1

    # -- setting up ---------------------------------------------------------------------------------------------------

    def _configure(self) -> None:
        self._card = _check_capture(self._descriptor, self._path)
        wanted = _choose(list(_modes(self._descriptor)), self._settings, self._path)
        self._form = _set_format(self._descriptor, wanted, self._path)
        fps = _set_rate(self._descriptor, self._settings.fps or wanted.fps)
        self.mode = Mode(wanted.pixel_format, self._form.width, self._form.height, fps)
        self.exposure_s = _set_exposure(self._descriptor, self._settings.exposure_s, self._path)
        _set_gain(self._descriptor, self._settings.gain, self._path)
        self._map_buffers()
        ioctl(self._descriptor, abi.STREAMON, abi.BufferType(abi.BUF_TYPE_VIDEO_CAPTURE))
        self.counts.connections += 1

    def _map_buffers(self) -> None:
        request = abi.RequestBuffers(count=_N_BUFFERS, type=abi.BUF_TYPE_VIDEO_CAPTURE, memory=abi.MEMORY_MMAP)
        ioctl(self._descriptor, abi.REQBUFS, request)
        for index in range(request.count):
            buffer = _buffer(index)
            ioctl(self._descriptor, abi.QUERYBUF, buffer)
            self._maps.append(mmap.mmap(self._descriptor, buffer.length, offset=buffer.offset))
            self._give_back(buffer)

    # -- taking frames ------------------------------------------------------------------------------------------------

    def _newest(self) -> Any:
        """The newest whole capture; those before it go back to the driver unseen. None where none came for a while."""
        newest, n_captures = None, 0
        while buffer := self._dequeue(0.0 if n_captures else _POLL_S):
            n_captures += 1
            if self._sequence is not None:
                self.counts.dropped += max(0, buffer.sequence - self._sequence - 1)
            self._sequence, self._came_s = buffer.sequence, time.monotonic()
            if buffer.flags & abi.BUF_FLAG_ERROR:
                self.counts.damaged += 1
                self._give_back(buffer)
                continue
            if newest:
                self._pass_over(newest)
            newest = buffer
        # Where every buffer was filled, the driver had none for what came after: the newest is old.
        if newest and n_captures == len(self._maps):
            self._pass_over(newest)
            return None
        return newest

    def _dequeue(self, wait_s: float) -> Any:
        """A filled buffer, None where there is none yet."""
        if not select.select([self._descriptor], [], [], wait_s)[0]:
            return None
        buffer = _buffer(0)
        try:
            ioctl(self._descriptor, abi.DQBUF, buffer)
        except BlockingIOError:
            time.sleep(_NO_DATA_SLEEP_S)
            return None
        return buffer

    def _pass_over(self, buffer: Any) -> None:
        self.counts.dropped += 1
        self._give_back(buffer)

    def _give_back(self, buffer: Any) -> None:
        ioctl(self._descriptor, abi.QBUF, _buffer(buffer.index))

    def _luma(self, buffer: Any) -> Luma | None:
        """A copy (height, width) of the luma in a buffer; None where it is damaged."""
        data = self._maps[buffer.index]
        if self.mode.pixel_format == "MJPG":
            from rxcli.ingest.jpeg import decode_luma

            with suppress(InputError):
                return decode_luma(data[: buffer.bytesused], self._path)
            return None
        pixels, width, height = PIXEL_FORMATS[self.mode.pixel_format], self.mode.width, self.mode.height
        dtype = np.dtype(pixels.dtype)
        row = width * pixels.step * dtype.itemsize
        pitch = max(self._form.bytesperline, row)
        if min(buffer.bytesused, len(data)) < pitch * (height - 1) + row:
            return None
        samples: NDArray[Any] = np.ndarray((height, width * pixels.step), dtype, data, strides=(pitch, dtype.itemsize))
        return samples[:, pixels.start :: pixels.step].copy()

    def _levels(self) -> tuple[float, float]:
        """Values of black and white."""
        pixels, form = PIXEL_FORMATS[self.mode.pixel_format], self._form
        full = form.quantization == abi.QUANTIZATION_FULL_RANGE or form.colorspace == abi.COLORSPACE_JPEG
        return (16, 235) if pixels.ycbcr and not full else (0, pixels.white)

    def _frame(self, luma: Luma, own_s: float) -> Frame:
        """A frame; where the driver's times do not advance, by the time that passed here, in whole frames."""
        step_s, fps = self._came_s - self._given_s, self.mode.fps
        step_s = max(round(step_s * fps), 1) / fps if fps else step_s
        time_s, nominal = self.counts.times.next(own_s, step_s)
        self._given_s = self._came_s
        if self.counts.start_s is None:
            self.counts.start_s = time_s
        self.counts.delivered += 1
        metadata, (black, white) = Metadata(model=self._card, exposure_s=self.exposure_s), self._levels()
        index, time_s = self.counts.delivered - 1, time_s - self.counts.start_s
        return Frame(luma, str(self._path), index, time_s, metadata, black=black, white=white, nominal_time=nominal)


def list_modes(path: Path) -> list[Mode]:
    """The modes of a camera that the receiver can use, best first.

    Raises:
        InputError: no camera, missing or busy.
    """
    with _explained(path):
        descriptor = _open(path)
        try:
            _check_capture(descriptor, path)
            return sorted(_modes(descriptor), key=_merit, reverse=True)
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
        kind, reason, step = _FAILURES.get(
            error.errno or 0, (CameraLost, f"the camera failed ({error.strerror})", _PLUG)
        )
        raise kind(f"{path}: {reason}", step.format(path=path)) from None


_PLUG = "plug it in again; --wait waits for it"
_MISSING = "plug it in, or see `v4l2-ctl --list-devices`; --wait waits for it"
_ROOM = "lower --width, --height or --fps, take --format MJPG, or give it a USB port apart from other cameras"
_REFUSED = "no V4L2 camera, or one that refuses its own mode"
_FAILURES = {
    errno.ENOENT: (CameraLost, "no such camera", _MISSING),
    errno.ENXIO: (CameraLost, "no such camera", _MISSING),
    errno.ENODEV: (CameraLost, "the camera was unplugged", _PLUG),
    errno.EBUSY: (CameraLost, "another program uses the camera", "close it (`fuser -v {path}` names it)"),
    errno.ENOSPC: (CameraLost, "its USB port has no room left for this mode", _ROOM),
    errno.ENOMEM: (CameraLost, "the driver has no memory for this mode", "lower --width and --height"),
    errno.EACCES: (InputError, "permission denied", "add yourself to the group `video` and log in again"),
    errno.ENOTTY: (InputError, _REFUSED, "name another /dev/video device"),
    errno.EINVAL: (InputError, _REFUSED, "name another /dev/video device"),
}


def _check_capture(descriptor: int, path: Path) -> str:
    """The camera's name.

    Raises:
        InputError: the device is none that streams pictures.
    """
    capability = abi.Capability()
    if not _is_known(descriptor, abi.QUERYCAP, capability):
        raise InputError(f"{path}: is no V4L2 device", "name a camera, such as /dev/video0")
    has_own = capability.capabilities & abi.CAP_DEVICE_CAPS
    able = capability.device_caps if has_own else capability.capabilities
    needed = abi.CAP_VIDEO_CAPTURE | abi.CAP_STREAMING
    if able & needed != needed:
        raise InputError(f"{path}: does not stream pictures", "name the camera's other /dev/video device")
    return bytes(capability.card).decode("utf-8", "replace")


def _is_known(descriptor: int, request: int, argument: ctypes.Structure, *refusals: int) -> bool:
    """Make a system call; whether the driver knows it, and refuses it with none of some further error codes."""
    try:
        ioctl(descriptor, request, argument)
    except OSError as error:
        if error.errno in (errno.EINVAL, errno.ENOTTY, *refusals):
            return False
        raise
    return True


def _modes(descriptor: int) -> Iterator[Mode]:
    """Modes of known pixel formats; of a range of sizes or rates the largest."""
    for form in _enumerate(descriptor, abi.ENUM_FMT, lambda i: abi.FormatDescription(i, abi.BUF_TYPE_VIDEO_CAPTURE)):
        code, name = form.pixelformat, abi.fourcc_name(form.pixelformat)
        sizes = partial(abi.FrameSize, pixel_format=code)
        for size in _enumerate(descriptor, abi.ENUM_FRAMESIZES, sizes) if name in PIXEL_FORMATS else ():
            places = (0, 1) if size.type == abi.FRAME_SIZE_DISCRETE else (1, 4)
            width, height = (size.size[place] for place in places)
            intervals = partial(abi.FrameInterval, pixel_format=code, width=width, height=height)
            found = [item.interval for item in _enumerate(descriptor, abi.ENUM_FRAMEINTERVALS, intervals)]
            rates = [interval[1] / interval[0] for interval in found if interval[0]]
            yield Mode(name, width, height, max(rates, default=0.0))


def _enumerate(descriptor: int, request: int, structure: Callable[[int], Any]) -> Iterator[Any]:
    """Enumerate entries of the driver until EINVAL; empty if it cannot enumerate."""
    for index in range(1000):
        item = structure(index)
        if not _is_known(descriptor, request, item):
            return
        yield item


def _merit(mode: Mode, fps: float | None = None) -> tuple[bool, int, int]:
    """Order of modes: fast enough, then large, then by pixel format."""
    is_fast = mode.fps == 0 or mode.fps >= (fps or _USUAL_FPS) * 0.98
    return is_fast, mode.width * mode.height, -list(PIXEL_FORMATS).index(mode.pixel_format)


def _choose(modes: list[Mode], settings: CameraSettings, path: Path) -> Mode:
    """The best mode that fulfils what is asked for.

    Raises:
        InputError: there is none; the message lists the available modes.
    """
    fitting = [mode for mode in modes if settings.pixel_format in (None, mode.pixel_format)]
    fitting = [mode for mode in fitting if settings.width in (None, mode.width)]
    fitting = [mode for mode in fitting if settings.height in (None, mode.height)]
    if fitting:
        return max(fitting, key=partial(_merit, fps=settings.fps))
    if not modes:
        raise InputError(f"{path}: none of its pixel formats can be read", f"known are {', '.join(PIXEL_FORMATS)}")
    asked = f"{settings.pixel_format or 'any format'} {settings.width or 'any'} x {settings.height or 'any'}"
    raise InputError(f"{path}: does not offer {asked}", f"it offers {', '.join(str(mode) for mode in modes)}")


def _set_format(descriptor: int, mode: Mode, path: Path) -> Any:
    """Set the format of a mode; returns the one in effect, with the size and the bytes of a row."""
    code = abi.fourcc(mode.pixel_format)
    form = abi.Format(
        type=abi.BUF_TYPE_VIDEO_CAPTURE, width=mode.width, height=mode.height, pixelformat=code, field=abi.FIELD_NONE
    )
    ioctl(descriptor, abi.S_FMT, form)
    if form.pixelformat != code:  # a driver may answer with the nearest that it has
        got = abi.fourcc_name(form.pixelformat)
        raise InputError(f"{path}: gives {got} instead of {mode.pixel_format}", "ask for another --format")
    return form


def _set_rate(descriptor: int, fps: float) -> float:
    """Ask for a frame rate; returns the actual one, 0 if it is not reported."""
    parameters = abi.StreamParameters(type=abi.BUF_TYPE_VIDEO_CAPTURE)
    if fps > 0:
        parameters.numerator, parameters.denominator = 1000, round(1000 * fps)
    if not _is_known(descriptor, abi.S_PARM, parameters) or not parameters.numerator:
        return 0.0
    return float(parameters.denominator / parameters.numerator)


def _set_exposure(descriptor: int, exposure_s: float | None, path: Path) -> float | None:
    """Fix the exposure, the shortest if none is requested; returns the actual one, or None.

    Raises:
        InputError: one is asked for and the camera has no such control.
    """
    _set(descriptor, abi.CID_EXPOSURE_AUTO, abi.EXPOSURE_MANUAL)
    _set(descriptor, abi.CID_EXPOSURE_AUTO_PRIORITY, 0)  # else the camera lowers its rate in the dark
    units = 0 if exposure_s is None else round(exposure_s / abi.EXPOSURE_UNIT_S)
    taken = _set(descriptor, abi.CID_EXPOSURE_ABSOLUTE, units)
    if taken is None and exposure_s is not None:
        raise InputError(f"{path}: the camera has no exposure control", "leave --exposure out")
    return None if taken is None else taken * abi.EXPOSURE_UNIT_S


def _set_gain(descriptor: int, gain: int | None, path: Path) -> None:
    if gain is None:
        return
    _set(descriptor, abi.CID_AUTOGAIN, 0)
    if _set(descriptor, abi.CID_GAIN, gain) is None:
        raise InputError(f"{path}: the camera has no gain control", "leave --gain out")


def _set(descriptor: int, control: int, value: int) -> int | None:
    """Set a control to the nearest value that it can have; the value in effect, None where there is no such control."""
    limits, refusals = abi.ControlRange(id=control), (errno.EACCES, errno.ERANGE)
    if not _is_known(descriptor, abi.QUERYCTRL, limits, *refusals):
        return None
    state = abi.Control(control, min(max(value, limits.minimum), limits.maximum))
    able = not limits.flags & (abi.CTRL_FLAG_DISABLED | abi.CTRL_FLAG_READ_ONLY)
    known = able and all(_is_known(descriptor, call, state, *refusals) for call in (abi.S_CTRL, abi.G_CTRL))
    return int(state.value) if known else None


def _buffer(index: int) -> ctypes.Structure:
    return abi.Buffer(index=index, type=abi.BUF_TYPE_VIDEO_CAPTURE, memory=abi.MEMORY_MMAP)
