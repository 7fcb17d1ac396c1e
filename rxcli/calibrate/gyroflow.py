"""Lens profiles of the Gyroflow community (JSON, CC0): the lens as OpenCV's pinhole model, the readout as a hint.

Such a profile holds OpenCV's fisheye model, a polynomial of the angle from the axis. The receiver's model starts from
the tangent of the angle, so it is fitted to the rays behind the picture's points. Users type in the readout, often
wrongly.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rxcli.calibrate.fitting import ConvertedLens, fit_distortion, grid_points
from rxcli.errors import InputError, ProfileError
from rxcli.ingest.metadata import positive, text_of
from rxcli.resources import read_limited
from rxcli.types import FloatArray

_MAX_BYTES = 4 << 20
#: Points across and down at which the models are compared.
_GRID = (33, 21)
#: Angle from the axis above which no screen is flat enough to be read.
_MAX_ANGLE_RAD = math.radians(70)
#: Angles at which the fisheye polynomial is tabulated, where OpenCV's iteration misses steep ones.
_ANGLES = 10_000
_HINT = "use `vlc-rx calibrate lens`, or another profile"


@dataclass(frozen=True, slots=True)
class GyroflowProfile(ConvertedLens):
    """The lens and readout of a profile."""

    make: str
    model: str
    #: Readout of the whole frame as typed in by a user, seconds; None where it is missing or impossible.
    readout_s: float | None
    #: True where the rows are read from the bottom to the top.
    reversed: bool
    #: Quality about the readout.
    notes: tuple[str, ...]


def load_gyroflow(path: Path, size: tuple[int, int] | None = None) -> GyroflowProfile:
    """Read a profile.

    Args:
        path: the JSON file.
        size: width and height of the pictures that it is for; None: as calibrated. The picture is scaled by the
            width; rows are cut off or added equally above and below.

    Raises:
        InputError: it cannot be read.
        ProfileError: it holds no lens, an impossible one, or one too wide for a pinhole.
    """
    try:
        raw = json.loads(read_limited(path, _MAX_BYTES))
    except (OSError, ValueError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or "it is no JSON"
        raise InputError(f"{path}: cannot be read as a Gyroflow profile ({reason})", "name a lens profile") from None
    try:
        matrix, coefficients, calibrated = _calibrated(raw)
    except (KeyError, TypeError, ValueError, IndexError, OverflowError):
        raise ProfileError(f"{path}: holds no fisheye lens with its size", _HINT) from None
    size = size or calibrated
    scale = size[0] / calibrated[0]
    matrix[:2] *= scale
    matrix[:2, 2] += (scale - 1) / 2
    matrix[1, 2] += (size[1] - calibrated[1] * scale) / 2
    rays, points = _rays(matrix, coefficients, size, path)
    lens, worst = fit_distortion(rays, points, matrix[[0, 1], [0, 1]], matrix[:2, 2], size)
    make, model, lens_name = (text_of(raw.get(key)) or "" for key in ("camera_brand", "camera_model", "lens_model"))
    return GyroflowProfile(lens, worst, f"{make} {model}".strip(), lens_name, make, model, *_readout(raw))


def _calibrated(raw: dict[str, Any]) -> tuple[FloatArray, FloatArray, tuple[int, int]]:
    """Camera matrix and coefficients for stored pictures, and their size.

    Raises:
        KeyError, TypeError, ValueError, IndexError, OverflowError: the profile lacks one of them, or it is impossible.
    """
    fisheye, dimension = raw["fisheye_params"], raw["calib_dimension"]
    matrix = np.array(fisheye["camera_matrix"], np.float64).reshape(3, 3)
    coefficients = np.array(fisheye["distortion_coeffs"], np.float64).reshape(4)
    # Anamorphic pictures are stored narrower, or lower, than they were calibrated.
    stretch = [positive(raw.get(f"input_{side}_stretch")) or 1.0 for side in ("horizontal", "vertical")]
    width, height = (round(int(dimension[side]) / part) for side, part in zip("wh", stretch, strict=True))
    finite = np.all(np.isfinite(matrix)) and np.all(np.isfinite(coefficients))
    if not (finite and min(matrix[0, 0], matrix[1, 1]) > 0 and 0 < width <= 100_000 and 0 < height <= 100_000):
        raise ValueError
    matrix[:2] /= np.array(stretch)[:, None]
    return matrix, coefficients, (width, height)


def _rays(
    matrix: FloatArray, coefficients: FloatArray, size: tuple[int, int], path: Path
) -> tuple[FloatArray, FloatArray]:
    """Rays (n, 2), x and y at depth 1, of points over the picture, and the points (n, 2) in focal lengths."""
    points = (grid_points(size, _GRID) - matrix[:2, 2]) / matrix[[0, 1], [0, 1]]
    radius = np.linalg.norm(points, axis=1)
    angles = np.linspace(0, _MAX_ANGLE_RAD, _ANGLES)
    radii = angles * np.polynomial.polynomial.polyval(angles**2, [1, *coefficients])
    # Where the polynomial turns back before the corner, a point has two rays or none.
    grows = np.logical_and.accumulate(np.diff(radii, prepend=-1) > 0)
    if radius.max() > radii[grows][-1]:
        raise ProfileError(f"{path}: the lens sees too wide for a screen to look flat", _HINT)
    angle = np.interp(radius, radii[grows], angles[grows])
    return points * (np.tan(angle) / np.maximum(radius, 1e-12))[:, None], points


def _readout(raw: dict[str, Any]) -> tuple[float | None, bool, tuple[str, ...]]:
    """Readout in the profile, seconds, whether it runs upwards, and warnings."""
    if raw.get("global_shutter") is True:
        return None, False, ("the profile states a global shutter, which produces no stripes",)
    stated, direction = raw.get("frame_readout_time"), raw.get("frame_readout_direction")
    rate = positive(raw.get("fps"))
    value = positive(abs(stated)) if isinstance(stated, (int, float)) and not isinstance(stated, bool) else None
    if value is None or stated is None:
        return None, False, ("the profile states no readout",)
    if direction in ("LeftToRight", "RightToLeft"):
        return None, False, ("the profile states a readout by columns, which is not supported",)
    upwards = stated < 0 or direction == "BottomToTop"
    if rate is not None and value > 1.02e3 / rate:
        reason = f"a readout of {stated:g} ms is impossible at {rate:g} frames/s: it is at most {1e3 / rate:.2f} ms"
        return None, upwards, (reason,)
    notes = ["a user typed in the readout, and it may be wrong: check it with --photo, or `calibrate shutter`"]
    if upwards:
        notes.append("the profile states a readout from the bottom to the top")
    return value * 1e-3, upwards, tuple(notes)
