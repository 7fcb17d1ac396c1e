"""Captures as files: JPEG with metadata, DNG, PNG, TIFF, and clips through real encoders."""

import struct
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import av
import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from rxcli.errors import UsageError, failure_explained
from rxcli.lab.simulate.scenes import Scene


def exif_block(scene: Scene) -> bytes:
    """EXIF data of a JPEG: make, model, orientation, exposure, ISO; begins with "Exif"."""
    from PIL import Image
    from PIL.TiffImagePlugin import IFDRational

    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0112] = scene.make, scene.model, scene.orientation
    inner = exif.get_ifd(0x8769)
    inner[0x829A] = IFDRational(Fraction(scene.exposure_s).limit_denominator(1_000_000))
    inner[0x8827] = scene.iso
    return exif.tobytes()


def encode_jpeg(rgb: NDArray[np.uint8], scene: Scene) -> bytes:
    """A JPEG file of a developed picture.

    Args:
        rgb: (height, width, 3) uint8.
        scene: whose quality, subsampling and metadata are written.
    """
    import simplejpeg

    isp = scene.isp
    body = simplejpeg.encode_jpeg(np.ascontiguousarray(rgb), isp.quality, "RGB", isp.subsampling, False)
    exif = exif_block(scene)
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    return bytes(body[:2] + segment + body[2:])


def write_png(rgb: NDArray[np.generic], path: Path) -> None:
    """Write a developed picture of 8 or 16 bits as PNG."""
    ok, data = cv2.imencode(".png", np.ascontiguousarray(rgb[..., ::-1]))
    assert ok, "PNG takes any picture of 8 or 16 bits"
    path.write_bytes(data.tobytes())


#: Tag number, type as tifffile names it, count, value, whether in the first directory alone.
_Tag = tuple[int, str, int, Any, bool]
_SRGB_FROM_XYZ = np.array([[3.2405, -1.5371, -0.4985], [-0.9693, 1.8760, 0.0416], [0.0556, -0.2040, 1.0572]])
#: tifffile writes no EXIF directory (34665); a tag of the next number keeps its place.
_PLACEHOLDER = 34666


def _rationals(code: int, kind: str, values: Any, denominator: int) -> _Tag:
    pairs = [Fraction(float(value)).limit_denominator(denominator).as_integer_ratio() for value in np.ravel(values)]
    return code, kind, len(pairs), tuple(number for pair in pairs for number in pair), True


def _camera_tags(scene: Scene) -> list[_Tag]:
    """Make, model, orientation, and a place for that of the EXIF directory."""
    named = [(271, "s", 0, scene.make, True), (272, "s", 0, scene.model, True)]
    return [*named, (274, "H", 1, scene.orientation, True), (_PLACEHOLDER, "I", 1, 0, True)]


def _append_exif(path: Path, scene: Scene) -> None:
    """Write exposure and ISO into an EXIF directory at the end of the file, and its place over the placeholder."""
    exposure = Fraction(scene.exposure_s).limit_denominator(1_000_000).as_integer_ratio()
    with tifffile.TiffFile(path) as written:
        placeholder = written.pages[0].tags[_PLACEHOLDER].offset
    with path.open("r+b") as file:
        at = file.seek(0, 2)
        file.write(struct.pack("<HHHIIHHIIIII", 2, 33434, 5, 1, at + 30, 34855, 3, 1, scene.iso, 0, *exposure))
        file.seek(placeholder)
        file.write(struct.pack("<HHII", _PLACEHOLDER - 1, 4, 1, at))


def pack_14bit(values: NDArray[np.uint16]) -> bytes:
    """Rows of 14-bit numbers, most significant bit first, each row padded to whole bytes."""
    bits = np.unpackbits(values.astype(">u2")[..., None].view(np.uint8), axis=-1)[..., 2:]
    return np.packbits(bits.reshape(len(values), -1), axis=-1).tobytes()


def write_dng(raw: NDArray[np.uint16], scene: Scene, path: Path, bits: int = 16) -> None:
    """Write a mosaic as uncompressed DNG.

    Args:
        raw: (height, width) uint16.
        scene: whose sensor made it.
        path: of the file.
        bits: 16, or 14 for packed numbers.
    """
    sensor = scene.sensor
    if sensor.pattern is None:
        raise UsageError("a DNG holds a mosaic, this sensor has none", "use a Bayer or X-Trans sensor")
    # The matrix from XYZ to the sensor's colours, for the panel's primaries taken as sRGB's.
    from_xyz = sensor.colour_matrix @ _SRGB_FROM_XYZ
    tags = [
        *_camera_tags(scene),
        (33421, "H", 2, sensor.pattern.shape, True),
        (33422, "B", sensor.pattern.size, sensor.pattern.tobytes(), True),
        (50706, "B", 4, b"\1\4\0\0", True),
        (50707, "B", 4, b"\1\3\0\0", True),
        (50708, "s", 0, f"{scene.make} {scene.model}", True),
        (50714, "H", 1, sensor.black_level, True),
        (50717, "H", 1, sensor.white_level, True),
        _rationals(50721, "2i", from_xyz, 10_000),
        _rationals(50728, "2I", sensor.response, 10_000),
        (50778, "H", 1, 21, True),
    ]
    pixels: dict[str, Any] = {"data": raw}
    if bits == 14:
        packed = iter([pack_14bit(raw)])
        pixels = {"data": packed, "shape": raw.shape, "dtype": np.uint16, "bitspersample": 14}
    layout: dict[str, Any] = {"photometric": 32803, "rowsperstrip": raw.shape[0], "software": False}
    tifffile.imwrite(path, **pixels, **layout, metadata=None, extratags=tags)
    _append_exif(path, scene)


def write_tiff(rgb: NDArray[np.generic], scene: Scene, path: Path) -> None:
    """Write a developed picture of 8 or 16 bits as uncompressed TIFF."""
    tifffile.imwrite(path, rgb, photometric="rgb", metadata=None, extratags=_camera_tags(scene))
    _append_exif(path, scene)


#: FFmpeg's numbers of a colour space and of ranges of luma: a part of its numbers, or all of them.
_BT709, _MPEG_RANGE, _JPEG_RANGE = 1, 1, 2
#: Name of a codec -> FFmpeg's encoder, pixel format and range of luma.
CODECS = {
    "h264": ("libx264", "yuv420p", _MPEG_RANGE),
    "h264-10": ("libx264", "yuv420p10le", _MPEG_RANGE),
    "hevc": ("libx265", "yuv420p", _MPEG_RANGE),
    "hevc-10": ("libx265", "yuv420p10le", _MPEG_RANGE),
    "mjpeg": ("mjpeg", "yuvj420p", _JPEG_RANGE),
}
#: EXIF orientation of a camera held upside down.
_UPSIDE_DOWN = 3


class Encoding(NamedTuple):
    """How a clip is compressed."""

    #: One of `CODECS`.
    codec: str
    #: Bits per second; None for the encoder's constant quality.
    bit_rate: int | None = None
    #: How much work the encoder does; see x264 and x265.
    preset: str = "veryfast"


def write_video(
    frames: Iterable[NDArray[np.generic]], path: Path, encoding: Encoding, frame_rate_hz: float, orientation: int = 1
) -> None:
    """Compress developed pictures into a clip.

    Args:
        frames: each (height, width, 3), red first, uint8, or uint16 for the codecs of ten bits.
        path: of the file; its suffix chooses the container.
        encoding: how it is compressed.
        frame_rate_hz: of the clip.
        orientation: EXIF orientation of a camera held upright or upside down, 1 or 3, which the container notes.

    Raises:
        UsageError: this machine's FFmpeg lacks the codec, or a side is odd.
    """
    rate, (_, pixel_format, colour_range) = Fraction(frame_rate_hz).limit_denominator(1001), CODECS[encoding.codec]
    ranges: dict[str, Any] = {"src_color_range": _JPEG_RANGE, "dst_color_range": colour_range}
    with av.open(str(path), "w") as container:
        stream = None
        for number, rgb in enumerate(frames):
            if stream is None:
                stream = _add_stream(container, encoding, rate, rgb.shape)
                if orientation == _UPSIDE_DOWN:
                    stream.set_display_rotation(180)
            pixels = "rgb24" if rgb.dtype == np.uint8 else "rgb48le"
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), pixels)
            converted = frame.reformat(format=pixel_format, dst_colorspace=_BT709, **ranges)
            converted.pts, converted.time_base = number, 1 / rate
            container.mux(stream.encode(converted))
        if stream is not None:
            container.mux(stream.encode(None))


def _add_stream(container: Any, encoding: Encoding, rate: Fraction, shape: tuple[int, ...]) -> Any:
    encoder, pixel_format, colour_range = CODECS[encoding.codec]
    if shape[0] % 2 or shape[1] % 2:
        reason = f"{encoding.codec}: width and height must be even (got {shape[1]} x {shape[0]})"
        raise UsageError(reason, "choose another scale or size")
    with failure_explained(f"{encoder}: this FFmpeg cannot encode it", "choose another codec", UsageError):
        stream = container.add_stream(encoder, rate=rate)
    stream.height, stream.width = shape[:2]
    stream.pix_fmt = pixel_format
    context = stream.codec_context
    context.color_range = colour_range
    context.colorspace = context.color_trc = context.color_primaries = _BT709
    if encoding.bit_rate is not None:
        stream.bit_rate = encoding.bit_rate
    if encoder != "mjpeg":
        stream.options = {"preset": encoding.preset} | ({} if encoding.bit_rate else {"crf": "23"})
        if encoder == "libx265":
            # Reordered frames of a clip shorter than the encoder's delay get times that no container takes; and the
            # encoders in cameras do not reorder either.
            stream.options = stream.options | {"x265-params": "log-level=error:bframes=0"}
    return stream
