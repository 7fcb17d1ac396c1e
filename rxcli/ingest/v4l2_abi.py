"""The part of the Linux V4L2 interface (linux/videodev2.h) that a capture needs, on 64-bit machines."""

from __future__ import annotations

import ctypes
import fcntl

CAP_VIDEO_CAPTURE, CAP_STREAMING, CAP_DEVICE_CAPS = 0x00000001, 0x04000000, 0x80000000
BUF_TYPE_VIDEO_CAPTURE = 1
MEMORY_MMAP = 1
FIELD_NONE = 1
BUF_FLAG_ERROR = 0x40
FRAME_SIZE_DISCRETE = FRAME_INTERVAL_DISCRETE = 1
COLORSPACE_JPEG = 7
QUANTIZATION_FULL_RANGE = 1
CTRL_FLAG_DISABLED, CTRL_FLAG_READ_ONLY = 0x0001, 0x0004

CID_AUTOGAIN, CID_GAIN = 0x00980912, 0x00980913
CID_EXPOSURE_AUTO, CID_EXPOSURE_ABSOLUTE, CID_EXPOSURE_AUTO_PRIORITY = 0x009A0901, 0x009A0902, 0x009A0903
EXPOSURE_MANUAL = 1
#: Unit of CID_EXPOSURE_ABSOLUTE, seconds.
EXPOSURE_UNIT_S = 100e-6

_u32, _i32 = ctypes.c_uint32, ctypes.c_int32


class Capability(ctypes.Structure):
    """struct v4l2_capability"""

    _fields_ = [
        ("driver", ctypes.c_char * 16),
        ("card", ctypes.c_char * 32),
        ("bus_info", ctypes.c_char * 32),
        ("version", _u32),
        ("capabilities", _u32),
        ("device_caps", _u32),
        ("reserved", _u32 * 3),
    ]


class FormatDescription(ctypes.Structure):
    """struct v4l2_fmtdesc"""

    _fields_ = [
        ("index", _u32),
        ("type", _u32),
        ("flags", _u32),
        ("description", ctypes.c_char * 32),
        ("pixelformat", _u32),
        ("mbus_code", _u32),
        ("reserved", _u32 * 3),
    ]


class FrameSize(ctypes.Structure):
    """struct v4l2_frmsizeenum; the union holds width and height, or min, max, step of both."""

    _fields_ = [("index", _u32), ("pixel_format", _u32), ("type", _u32), ("size", _u32 * 6), ("reserved", _u32 * 2)]


class FrameInterval(ctypes.Structure):
    """struct v4l2_frmivalenum; the union holds one fraction, or min, max, step."""

    _fields_ = [
        ("index", _u32),
        ("pixel_format", _u32),
        ("width", _u32),
        ("height", _u32),
        ("type", _u32),
        ("interval", _u32 * 6),
        ("reserved", _u32 * 2),
    ]


class Format(ctypes.Structure):
    """struct v4l2_format with its v4l2_pix_format; the union is aligned to 8 bytes."""

    _fields_ = [
        ("type", _u32),
        ("padding", _u32),
        ("width", _u32),
        ("height", _u32),
        ("pixelformat", _u32),
        ("field", _u32),
        ("bytesperline", _u32),
        ("sizeimage", _u32),
        ("colorspace", _u32),
        ("priv", _u32),
        ("flags", _u32),
        ("ycbcr_enc", _u32),
        ("quantization", _u32),
        ("xfer_func", _u32),
        ("rest", ctypes.c_uint8 * 152),
    ]


class StreamParameters(ctypes.Structure):
    """struct v4l2_streamparm with its v4l2_captureparm."""

    _fields_ = [
        ("type", _u32),
        ("capability", _u32),
        ("capturemode", _u32),
        ("numerator", _u32),
        ("denominator", _u32),
        ("rest", ctypes.c_uint8 * 184),
    ]


class RequestBuffers(ctypes.Structure):
    """struct v4l2_requestbuffers"""

    _fields_ = [("count", _u32), ("type", _u32), ("memory", _u32), ("capabilities", _u32), ("flags", _u32)]


class Buffer(ctypes.Structure):
    """struct v4l2_buffer"""

    _fields_ = [
        ("index", _u32),
        ("type", _u32),
        ("bytesused", _u32),
        ("flags", _u32),
        ("field", _u32),
        ("seconds", ctypes.c_int64),
        ("microseconds", ctypes.c_int64),
        ("timecode", _u32 * 4),
        ("sequence", _u32),
        ("memory", _u32),
        ("offset", ctypes.c_uint64),
        ("length", _u32),
        ("reserved2", _u32),
        ("request_fd", _u32),
    ]


class ControlRange(ctypes.Structure):
    """struct v4l2_queryctrl"""

    _fields_ = [
        ("id", _u32),
        ("type", _u32),
        ("name", ctypes.c_char * 32),
        ("minimum", _i32),
        ("maximum", _i32),
        ("step", _i32),
        ("default_value", _i32),
        ("flags", _u32),
        ("reserved", _u32 * 2),
    ]


class Control(ctypes.Structure):
    """struct v4l2_control"""

    _fields_ = [("id", _u32), ("value", _i32)]


class BufferType(ctypes.Structure):
    """The int that VIDIOC_STREAMON takes."""

    _fields_ = [("value", _i32)]


def _request(direction: int, number: int, structure: type[ctypes.Structure]) -> int:
    return direction << 30 | ctypes.sizeof(structure) << 16 | ord("V") << 8 | number


_WRITE, _READ, _BOTH = 1, 2, 3
QUERYCAP = _request(_READ, 0, Capability)
ENUM_FMT = _request(_BOTH, 2, FormatDescription)
S_FMT = _request(_BOTH, 5, Format)
REQBUFS = _request(_BOTH, 8, RequestBuffers)
QUERYBUF = _request(_BOTH, 9, Buffer)
QBUF = _request(_BOTH, 15, Buffer)
DQBUF = _request(_BOTH, 17, Buffer)
STREAMON = _request(_WRITE, 18, BufferType)
S_PARM = _request(_BOTH, 22, StreamParameters)
G_CTRL = _request(_BOTH, 27, Control)
S_CTRL = _request(_BOTH, 28, Control)
QUERYCTRL = _request(_BOTH, 36, ControlRange)
ENUM_FRAMESIZES = _request(_BOTH, 74, FrameSize)
ENUM_FRAMEINTERVALS = _request(_BOTH, 75, FrameInterval)


def ioctl(descriptor: int, request: int, argument: ctypes.Structure) -> None:
    """One V4L2 system call; `argument` is changed in place.

    Raises:
        OSError: with the driver's errno.
    """
    fcntl.ioctl(descriptor, request, argument, True)


def fourcc(name: str) -> int:
    """Pixel format code of a four-letter name; shorter names are padded with spaces."""
    return int.from_bytes(name.ljust(4).encode("ascii"), "little")


def fourcc_name(code: int) -> str:
    """Name of a pixel format code, without the padding."""
    return code.to_bytes(4, "little").decode("latin-1").rstrip()
