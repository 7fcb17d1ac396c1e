"""RAW files -> the sensor's mosaic, through LibRaw, without demosaicing and without a copy.

Frames are views into LibRaw's memory, which lives as long as an array of it does (rawpy keeps the decoder alive);
so the decoder is never closed here. Pixels are those of the default crop and are never turned.
"""

import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import InputError, failure_explained
from rxcli.ingest.extent import Directories
from rxcli.ingest.metadata import believed, merge, positive, raw_metadata, text_of
from rxcli.ingest.quiet import quiet_libraries
from rxcli.ingest.sniff import check_size
from rxcli.types import Frame, Metadata, Mosaic

#: LibRaw's turns for viewing -> EXIF orientation.
_FLIP_ORIENTATION = {0: 1, 3: 3, 5: 8, 6: 6}
#: Colour filter arrays repeat with one of these periods: Bayer, X-Trans, and what LibRaw calls 16 x 16.
_PERIODS = (2, 4, 6, 8, 16)

#: DNG 1.7: the tag of the compression, and JPEG XL.
_COMPRESSION, _JPEG_XL = 259, 52546
#: LibRaw keeps values of two bytes, and where all colours stand at each pixel, four of them.
_BYTES_A_PIXEL = 2

Window = tuple[int, int, int, int]


def read_raw(path: Path) -> Frame:
    """The mosaic of a RAW file; a RAW that is no mosaic gives its green channel as linear light.

    Raises:
        InputError: damaged, cut, of an unknown camera, or without sensor values.
    """
    import rawpy

    _check_whole(path)
    with failure_explained(f"{path}: the RAW file is damaged or cut", "copy the file again"):
        try:
            raw = rawpy.imread(str(path))  # its directories only; sensor values are decoded when they are asked for
            check_size(path, raw.sizes.raw_width, raw.sizes.raw_height, _BYTES_A_PIXEL)
            with quiet_libraries():
                image = raw.raw_image
        except rawpy.LibRawFileUnsupportedError:
            raise InputError(*_unsupported(path)) from None
    top, left, height, width = default_crop(raw.sizes)
    pixels = image[top : top + height, left : left + width]
    if min(pixels.shape[:2]) < _PERIODS[-1]:
        reason = f"{path}: the picture is {pixels.shape[1]} x {pixels.shape[0]} pixels"
        raise InputError(reason, "the file is damaged; copy it again")
    metadata = _metadata(path, raw)
    if pixels.ndim != 2 or raw.num_colors == 1:
        return _linear_frame(path, pixels, raw, metadata)
    pixels.flags.writeable = False
    return Frame(pixels=pixels, source=str(path), metadata=metadata, mosaic=_mosaic(raw, top, left, path))


def default_crop(sizes: Any) -> Window:
    """Top, left, height and width, on the whole sensor, of the picture that the camera means to show.

    Args:
        sizes: rawpy's ImageSizes. Where its crop is absent or reaches out of the active area, that area is taken.
    """
    top, left, height, width = sizes.top_margin, sizes.left_margin, sizes.height, sizes.width
    crop = (sizes.crop_top_margin, sizes.crop_left_margin, sizes.crop_height, sizes.crop_width)
    inside_rows = top <= crop[0] and crop[0] + crop[2] <= top + height
    inside_columns = left <= crop[1] and crop[1] + crop[3] <= left + width
    if crop[2] > 0 and crop[3] > 0 and inside_rows and inside_columns:
        return crop
    return top, left, height, width


def _check_whole(path: Path) -> None:
    with path.open("rb") as file:
        head, directories = file.read(128), Directories(file)
        if directories.claims_too_much:
            raise InputError(f"{path}: the RAW file's directories claim more than the file holds", "copy it again")
        claimed = 0
        if head.startswith(b"FUJIFILMCCD-RAW"):
            claimed = sum(struct.unpack_from(">II", head.ljust(128, b"\0"), 100))
        elif head.startswith((b"II*\0", b"MM\0*")):
            claimed = directories.end
    if (size := path.stat().st_size) < claimed:
        reason = f"{path}: the RAW file is cut: {size} of at least {claimed} bytes are there"
        raise InputError(reason, "copy it from the camera again")


def _unsupported(path: Path) -> tuple[str, str]:
    """Reason and next step for a file that LibRaw does not know."""
    with path.open("rb") as file:
        if _JPEG_XL in Directories(file).values(_COMPRESSION):
            step = "set the camera's RAW files to lossless JPEG, or use the JPEG"
            return f"{path}: the RAW file is compressed as JPEG XL, which LibRaw does not read", step
    return f"{path}: no RAW format that LibRaw knows", "use the JPEG, or convert it to a plain DNG"


def _mosaic(raw: Any, top: int, left: int, path: Path) -> Mosaic:
    colours = _channel_colours(raw, path)
    levels = np.array(raw.black_level_per_channel[: colours.size], np.float64)
    red, green, blue = (float(levels[colours == colour].mean()) for colour in range(3))
    white = _white(raw, max(red, green, blue), path)
    return Mosaic(_pattern(raw, colours, top, left, path), _gains(raw), (red, green, blue), white)


def _channel_colours(raw: Any, path: Path) -> NDArray[np.uint8]:
    """Colour (0 red, 1 green, 2 blue) of LibRaw's three or four channels; a Bayer mosaic has two green ones."""
    colours = ["RGB".find(chr(letter)) for letter in raw.color_desc[:4]]
    if {*colours} != {0, 1, 2}:
        named = raw.color_desc.decode("ascii", "replace")
        raise InputError(f"{path}: the sensor's colours are {named}, not red, green and blue", "use the JPEG")
    return np.array(colours, np.uint8)


def _pattern(raw: Any, colours: NDArray[np.uint8], top: int, left: int, path: Path) -> NDArray[np.uint8]:
    """The smallest tile whose repetition gives the colours from sensor pixel (top, left) on."""
    side = range(2 * _PERIODS[-1])
    channels = np.array([[raw.raw_color(top + y, left + x) for x in side] for y in side])
    if channels.max() >= colours.size:
        raise InputError(f"{path}: the RAW file's mosaic has colours that it does not name", "copy the file again")
    probe: NDArray[np.uint8] = colours[channels]
    for period in _PERIODS:
        if (probe[period:] == probe[:-period]).all() and (probe[:, period:] == probe[:, :-period]).all():
            return probe[:period, :period].copy()
    return probe


def _gains(raw: Any) -> tuple[float, float, float]:
    """The camera's white balance, else daylight's, else none."""
    for balance in (raw.camera_whitebalance, raw.daylight_whitebalance):
        gains = np.array(balance[:3], np.float64)
        if np.isfinite(gains).all() and (gains > 0).all():
            red, blue = gains[0] / gains[1], gains[2] / gains[1]
            return float(red), 1.0, float(blue)
    return 1.0, 1.0, 1.0


def _white(raw: Any, black: float, path: Path) -> float:
    """The lowest level at which a channel saturates, as far as the file states it."""
    levels = [float(level) for level in (*(raw.camera_white_level_per_channel or ()), raw.white_level) if level > black]
    white = min(levels, default=float(np.iinfo(np.uint16).max))
    if black >= white:
        raise InputError(f"{path}: the RAW file states a black level of {black:g}", "copy the file again")
    return white


def _linear_frame(path: Path, pixels: NDArray[np.uint16], raw: Any, metadata: Metadata) -> Frame:
    """A RAW without colour filters (monochrome sensor) or with all colours at each pixel (sRAW, linear DNG)."""
    plane = pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[:, :, 1 if pixels.shape[2] >= 3 else 0])
    plane.flags.writeable = False
    black = float(raw.black_level_per_channel[1 if pixels.ndim == 3 else 0])
    return Frame(plane, str(path), metadata=metadata, black=black, white=_white(raw, black, path), linear=True)


def _metadata(path: Path, raw: Any) -> Metadata:
    """Metadata from EXIF, completed by LibRaw."""
    exif, capture = raw_metadata(path), raw.other
    libraw = Metadata(
        lens=text_of(raw.lens.model),
        exposure_s=positive(capture.shutter_speed),
        iso=positive(capture.iso_speed),
        focal_length_mm=positive(capture.focal_length),
    )
    orientation = exif.orientation if exif.orientation != 1 else _FLIP_ORIENTATION.get(raw.sizes.flip, 1)
    return replace(merge(exif, believed(libraw)), orientation=orientation)
