"""A fast image signal processor of our own: from the sensor's numbers to a developed picture.

Like a camera's, it is not linear and not reversible: cheap demosaicing, white balance, noise reduction, distortion
correction, tone curve, sharpening, eight bits.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from rxcli.lab.simulate.optics import Float32Array, View, between_nodes, grid_nodes
from rxcli.lab.simulate.sensor import PATTERNS, Sensor

Tone = Literal["srgb", "bt709", "gamma", "linear", "filmic", "local"]
Subsampling = Literal["444", "422", "420"]

#: Weights of red, green and blue in luma (BT.601).
LUMA_BT601 = (0.299, 0.587, 0.114)
#: Tone curves: exponent, gain (offset gain - 1), end and slope of the straight toe.
_TONES = {
    "srgb": (1 / 2.4, 1.055, 0.0031308, 12.92),
    "bt709": (0.45, 1.099, 0.018, 4.5),
    "gamma": (1 / 2.2, 1.0, 0.0, 0.0),
}
_TONES |= {"filmic": _TONES["srgb"], "local": _TONES["srgb"]}
#: Local tone mapping: how strongly places are brought to a common brightness, which one, up to what gain, and how far a
#: place reaches, in picture widths.
_EVENNESS, _BRIGHTNESS, _MAX_GAIN, _REACH_WIDTHS = 0.4, 0.35, 3.0, 0.04
#: Where a filmic curve (x (a x + b) / (x (c x + d) + e), Narkowicz 2016) has the picture's white.
_FILMIC_WHITE = 1.6
#: Rows of a band of work and of its overlap: multiples of the mosaics' unit cells, for a common phase.
_BAND_ROWS, _HALO_ROWS = 384, 12


@dataclass(frozen=True)
class Isp:
    """Settings of the development."""

    tone: Tone = "srgb"
    #: Light that comes out as white is the sensor's full scale over this.
    gain: float = 1.5
    #: Strength and radius (pixels) of unsharp masking on luma.
    sharpen: float = 0.0
    sharpen_px: float = 1.2
    #: Standard deviation of the smoothing of luma and of colour, pixels.
    denoise_px: float = 0.0
    denoise_colour_px: float = 2.0
    #: Take the lens's distortion out; the camera matrix stays.
    correct_distortion: bool = False
    quality: int = 92
    subsampling: Subsampling = "420"


def tone_curve(light: Float32Array, tone: Tone) -> Float32Array:
    """Picture values 0..1 of linear light 0..1, any shape."""
    x: Float32Array = np.clip(light, np.float32(0), np.float32(1))
    if tone == "linear":
        return x
    if tone == "filmic":
        x = _film(x * np.float32(_FILMIC_WHITE)) / _film(np.float32(_FILMIC_WHITE))
    exponent, gain, toe, slope = _TONES[tone]
    curve = np.asarray(cv2.pow(np.atleast_2d(x), exponent), np.float32).reshape(x.shape)
    curve *= np.float32(gain)
    curve -= np.float32(gain - 1)
    np.copyto(curve, x * np.float32(slope), where=x < np.float32(toe))
    return curve


def _film(x: Any) -> Any:
    return x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)


def local_gain(planes: Float32Array) -> Float32Array:
    """(height, width, 1) gain of every place of a picture (height, width, 3): the darker, the more."""
    small = cv2.resize(
        luma(planes), (128, max(round(128 * planes.shape[0] / planes.shape[1]), 1)), interpolation=cv2.INTER_AREA
    )
    around = cv2.GaussianBlur(np.maximum(small, 1e-3), (0, 0), 128 * _REACH_WIDTHS)
    gain = np.minimum((_BRIGHTNESS / around) ** _EVENNESS, _MAX_GAIN)
    return np.asarray(cv2.resize(gain, planes.shape[1::-1], interpolation=cv2.INTER_LINEAR)[..., None], np.float32)


def demosaic(raw: NDArray[np.uint16], sensor: Sensor) -> Float32Array:
    """Full-colour light from the sensor's numbers, black at 0 and white level at 1; (height, width, 3) float32.

    Bayer is bilinear; X-Trans is a normalised convolution, each colour a weighted mean of its nearest samples.
    """
    scale = np.float32(1 / (sensor.white_level - sensor.black_level))
    if sensor.cfa == "bayer":
        planes = cv2.cvtColor(raw, cv2.COLOR_BayerRGGB2RGB).astype(np.float32)
    elif sensor.cfa == "xtrans":
        planes = _demosaic_xtrans(raw)
    else:
        planes = raw.astype(np.float32)
    planes -= np.float32(sensor.black_level)
    planes *= scale
    return np.asarray(planes, np.float32)


def _demosaic_xtrans(raw: NDArray[np.uint16]) -> Float32Array:
    pattern = PATTERNS["xtrans"]
    values = raw.astype(np.float32)
    planes = np.empty((*raw.shape, 3), np.float32)
    tiles = (-(-raw.shape[0] // 6), -(-raw.shape[1] // 6))
    for colour in range(3):
        mask = np.tile((pattern == colour).astype(np.float32), tiles)[: raw.shape[0], : raw.shape[1]]
        size, sigma = (3, 0.7) if colour == 1 else (5, 1.1)
        total = cv2.GaussianBlur(values * mask, (size, size), sigma, borderType=cv2.BORDER_REFLECT_101)
        total /= cv2.GaussianBlur(mask, (size, size), sigma, borderType=cv2.BORDER_REFLECT_101)
        planes[..., colour] = total
    return planes


def develop(raw: NDArray[np.uint16], sensor: Sensor, isp: Isp, view: View, bits: int = 8) -> NDArray[Any]:
    """Develop a picture.

    Args:
        raw: (height, width) uint16 mosaic, or (height, width, 3).
        sensor: that made it.
        isp: settings.
        view: lens whose distortion is corrected, where the settings ask for it.
        bits: 8 or 16.

    Returns:
        (height, width, 3) uint8 or uint16, red first, full range.
    """
    planes = np.empty((*raw.shape[:2], 3), np.float32)
    _in_bands(raw, lambda part: _panel_light(part, sensor, isp), planes)
    if isp.correct_distortion:
        planes = correct_distortion(planes, view)
    if isp.tone == "local":
        planes *= local_gain(planes)
    picture = np.empty(planes.shape, np.uint8 if bits == 8 else np.uint16)
    _in_bands(planes, lambda part: _finish(part, isp, bits), picture)
    return picture


def _in_bands(source: NDArray[Any], work: Callable[[NDArray[Any]], NDArray[Any]], out: NDArray[Any]) -> None:
    """Fill `out` with `work` of overlapping bands of rows of `source`, two at a time."""

    def fill(top: int) -> None:
        begin = max(top - _HALO_ROWS, 0)
        bottom = min(top + _BAND_ROWS, source.shape[0])
        out[top:bottom] = work(source[begin : bottom + _HALO_ROWS])[top - begin : bottom - begin]

    with ThreadPoolExecutor(max_workers=2) as pool:
        list(pool.map(fill, range(0, source.shape[0], _BAND_ROWS)))


def _panel_light(raw: NDArray[np.uint16], sensor: Sensor, isp: Isp) -> Float32Array:
    """Linear light in the panel's colours, white balanced, noise reduced."""
    to_panel = np.linalg.inv(sensor.colour_matrix) * isp.gain
    return _reduce_noise(cv2.transform(demosaic(raw, sensor), to_panel.astype(np.float32)), isp)


def _finish(planes: Float32Array, isp: Isp, bits: int) -> NDArray[Any]:
    """Tone curve, sharpening, rounding."""
    planes = tone_curve(planes, isp.tone)
    if isp.sharpen > 0:
        grey = luma(planes)
        planes += (np.float32(isp.sharpen) * (grey - cv2.GaussianBlur(grey, (0, 0), isp.sharpen_px)))[..., None]
    top = (1 << bits) - 1
    planes *= np.float32(top)
    planes += np.float32(0.5)
    np.clip(planes, 0, top, out=planes)
    return planes.astype(np.uint8 if bits == 8 else np.uint16)


def _reduce_noise(planes: Float32Array, isp: Isp) -> Float32Array:
    if isp.denoise_colour_px <= 0 and isp.denoise_px <= 0:
        return planes
    grey = luma(planes)
    colour = planes - grey[..., None]
    if isp.denoise_colour_px > 0:
        colour = cv2.blur(colour, (2 * round(isp.denoise_colour_px) + 1,) * 2)
    if isp.denoise_px > 0:
        grey = cv2.GaussianBlur(grey, (0, 0), isp.denoise_px)
    colour += grey[..., None]
    return np.asarray(colour, np.float32)


def correction_map(view: View) -> Float32Array:
    """(height, width, 2) float32 sensor places (x, y) that the pixels of a corrected picture are taken from."""
    pitch = 16
    x, y = grid_nodes(view.width, pitch), grid_nodes(view.height, pitch)
    matrix = view.camera_matrix
    ideal = (np.stack(np.meshgrid(x, y), axis=-1) - matrix[:2, 2]) / matrix[[0, 1], [0, 1]]
    return between_nodes(view.ideal_to_pixels(ideal).astype(np.float32), pitch, view.height, view.width)


def correct_distortion(planes: Float32Array, view: View) -> Float32Array:
    """A picture without the lens's distortion, on the same camera matrix."""
    return np.asarray(cv2.remap(planes, correction_map(view), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT))


def luma(rgb: NDArray[Any]) -> Float32Array:
    """(height, width) float32 luma of a picture (height, width, 3), red first."""
    return np.asarray(cv2.transform(rgb.astype(np.float32), np.array([LUMA_BT601], np.float32)))
