"""The part of the Linux V4L2 interface (linux/videodev2.h) that a capture needs, on 64-bit machines."""

import ctypes
from typing import Any

CAP_VIDEO_CAPTURE, CAP_STREAMING, CAP_DEVICE_CAPS = 0x00000001, 0x04000000, 0x80000000
BUF_TYPE_VIDEO_CAPTURE = 1
MEMORY_MMAP = 1
FIELD_NONE = 1
BUF_FLAG_ERROR = 0x40
FRAME_SIZE_DISCRETE = 1
COLORSPACE_JPEG = 7
QUANTIZATION_FULL_RANGE = 1
CTRL_FLAG_DISABLED, CTRL_FLAG_READ_ONLY = 0x0001, 0x0004

CID_AUTOGAIN, CID_GAIN = 0x00980912, 0x00980913
CID_EXPOSURE_AUTO, CID_EXPOSURE_ABSOLUTE, CID_EXPOSURE_AUTO_PRIORITY = 0x009A0901, 0x009A0902, 0x009A0903
EXPOSURE_MANUAL = 1
#: Unit of CID_EXPOSURE_ABSOLUTE, seconds.
EXPOSURE_UNIT_S = 100e-6

#: Letters of `_structure`, as in the module struct; where there is none, a field is a __u32.
_TYPES: Any = {"": ctypes.c_uint32, "I": ctypes.c_uint32, "i": ctypes.c_int32, "q": ctypes.c_int64}
_TYPES |= {"Q": ctypes.c_uint64, "s": ctypes.c_char, "B": ctypes.c_uint8}


def _structure(name: str, fields: str) -> type[ctypes.Structure]:
    """The structure of that name in linux/videodev2.h; a field is NAME, NAME:i or NAME:32s."""
    found = []
    for field in fields.split():
        label, _, form = field.partition(":")
        kind, count = _TYPES[form[-1:]], form[:-1]
        found.append((label, kind * int(count) if count else kind))
    return type(name, (ctypes.Structure,), {"_fields_": found})


Capability = _structure(
    "v4l2_capability", "driver:16s card:32s bus_info:32s version capabilities device_caps reserved:3I"
)
FormatDescription = _structure("v4l2_fmtdesc", "index type flags description:32s pixelformat mbus_code reserved:3I")
#: `size` holds width and height, or min, max, step of both; `interval` one fraction, or min, max, step.
FrameSize = _structure("v4l2_frmsizeenum", "index pixel_format type size:6I reserved:2I")
FrameInterval = _structure("v4l2_frmivalenum", "index pixel_format width height type interval:6I reserved:2I")
#: With its v4l2_pix_format; the union is aligned to 8 bytes.
Format = _structure(
    "v4l2_format",
    "type padding width height pixelformat field bytesperline sizeimage colorspace priv flags ycbcr_enc quantization "
    "xfer_func rest:152B",
)
#: With its v4l2_captureparm.
StreamParameters = _structure("v4l2_streamparm", "type capability capturemode numerator denominator rest:184B")
RequestBuffers = _structure("v4l2_requestbuffers", "count type memory capabilities flags")
Buffer = _structure(
    "v4l2_buffer",
    "index type bytesused flags field seconds:q microseconds:q timecode:4I sequence memory offset:Q length reserved2 "
    "request_fd",
)
ControlRange = _structure(
    "v4l2_queryctrl", "id type name:32s minimum:i maximum:i step:i default_value:i flags reserved:2I"
)
Control = _structure("v4l2_control", "id value:i")
#: The int that VIDIOC_STREAMON takes.
BufferType = _structure("int", "value:i")


def _request(direction: int, number: int, structure: type[ctypes.Structure]) -> int:
    return direction << 30 | ctypes.sizeof(structure) << 16 | ord("V") << 8 | number


_WRITE, _READ, _READ_WRITE = 1, 2, 3
QUERYCAP = _request(_READ, 0, Capability)
ENUM_FMT = _request(_READ_WRITE, 2, FormatDescription)
S_FMT = _request(_READ_WRITE, 5, Format)
REQBUFS = _request(_READ_WRITE, 8, RequestBuffers)
QUERYBUF = _request(_READ_WRITE, 9, Buffer)
QBUF = _request(_READ_WRITE, 15, Buffer)
DQBUF = _request(_READ_WRITE, 17, Buffer)
STREAMON = _request(_WRITE, 18, BufferType)
S_PARM = _request(_READ_WRITE, 22, StreamParameters)
G_CTRL = _request(_READ_WRITE, 27, Control)
S_CTRL = _request(_READ_WRITE, 28, Control)
QUERYCTRL = _request(_READ_WRITE, 36, ControlRange)
ENUM_FRAMESIZES = _request(_READ_WRITE, 74, FrameSize)
ENUM_FRAMEINTERVALS = _request(_READ_WRITE, 75, FrameInterval)


def fourcc(name: str) -> int:
    """Pixel format code of a four-letter name; shorter names are padded with spaces."""
    return int.from_bytes(name.ljust(4).encode("ascii"), "little")


def fourcc_name(code: int) -> str:
    """Name of a pixel format code, without the padding."""
    return code.to_bytes(4, "little").decode("latin-1").rstrip()
