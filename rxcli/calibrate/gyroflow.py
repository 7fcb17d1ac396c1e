"""Lens profiles of the Gyroflow community (JSON, CC0): the lens as OpenCV's pinhole model, the readout as a hint.

Such a profile holds OpenCV's fisheye model: a ray at the angle t from the axis falls at the distance
`t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)` times the focal length. The receiver's model starts from `tan t` instead, so
it is fitted to the rays that the picture's points come from. Readout times are given by users, who often guess them.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rxcli.errors import InputError, ProfileError
from rxcli.profiles import LensModel
from rxcli.resources import read_limited
from rxcli.types import FloatArray

_MOST_BYTES = 4 << 20
_GRID = (33, 21)
#: A pinhole's picture has no end before 90 degrees; beyond this no screen is flat enough to be read.
_WIDEST_RAD = math.radians(70)
#: Newton steps; an angle is found to 1e-12 in five.
_STEPS = 20
_HINT = "use `vlc-rx calibrate lens`, or another profile"


@dataclass(frozen=True, slots=True)
class GyroflowProfile:
    """What a profile says of a camera."""

    lens: LensModel
    make: str
    model: str
    lens_name: str
    #: Largest distance between the fisheye's and the pinhole model's points over the picture, pixels.
    worst_px: float
    #: Readout of the whole frame as users say, seconds; None where the profile is silent or says what cannot be.
    readout_s: float | None
    #: True where the rows are read from the bottom to the top.
    reversed: bool
    frame_rate_hz: float | None
    #: What should be known before the readout is trusted.
    notes: tuple[str, ...]


def load_gyroflow(path: Path, size: tuple[int, int] | None = None) -> GyroflowProfile:
    """Read a profile.

    Args:
        path: the JSON file.
        size: width and height of the pictures that it is for, where they are not the calibrated ones: scaled by the
            width, rows cut off or added equally above and below.

    Raises:
        InputError: it cannot be read.
        ProfileError: it holds no lens, an impossible one, or one too wide for a pinhole.
    """
    raw = _load(path)
    try:
        matrix, coefficients, width, height = _calibrated(raw)
    except (KeyError, TypeError, ValueError, IndexError, OverflowError):
        raise ProfileError(f"{path}: holds no fisheye lens with its size", _HINT) from None
    if not (np.all(np.isfinite(matrix)) and np.all(np.isfinite(coefficients)) and matrix[0, 0] > 0 < matrix[1, 1]):
        raise ProfileError(f"{path}: camera_matrix or distortion_coeffs are no lens's", _HINT)
    if size is not None:
        matrix, width, height = _resized(matrix, width, height, size)
    lens, worst = _pinhole(matrix, coefficients, width, height, path)
    rate = _positive(raw.get("fps"))
    readout_s, reversed_, notes = _readout(raw, rate)
    return GyroflowProfile(
        lens=lens,
        make=_text(raw, "camera_brand"),
        model=_text(raw, "camera_model"),
        lens_name=_text(raw, "lens_model"),
        worst_px=worst,
        readout_s=readout_s,
        reversed=reversed_,
        frame_rate_hz=rate,
        notes=notes,
    )


def _load(path: Path) -> dict[str, Any]:
    try:
        raw = json.loads(read_limited(path, _MOST_BYTES))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file", "check the name") from None
    except (OSError, ValueError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or "it is no JSON"
        raise InputError(f"{path}: cannot be read as a Gyroflow profile ({reason})", "name a lens profile") from None
    if not isinstance(raw, dict):
        raise ProfileError(f"{path}: is no Gyroflow profile", "name a lens profile (.json)")
    return raw


def _calibrated(raw: dict[str, Any]) -> tuple[FloatArray, FloatArray, int, int]:
    """Camera matrix and coefficients for stored pictures, and their size."""
    width, height = int(raw["calib_dimension"]["w"]), int(raw["calib_dimension"]["h"])
    matrix = np.array(raw["fisheye_params"]["camera_matrix"], np.float64).reshape(3, 3)
    coefficients = np.array(raw["fisheye_params"]["distortion_coeffs"], np.float64).reshape(4)
    # Anamorphic pictures are stored narrower, or lower, than they were calibrated.
    stretch = [_positive(raw.get(f"input_{side}_stretch")) or 1.0 for side in ("horizontal", "vertical")]
    width, height = round(width / stretch[0]), round(height / stretch[1])
    if not (0 < width <= 100_000 and 0 < height <= 100_000):
        raise ValueError
    matrix[0] /= stretch[0]
    matrix[1] /= stretch[1]
    # A crop says how much of the sensor's width the clip shows, which calib_dimension already is.
    return matrix, coefficients, width, height


def _resized(matrix: FloatArray, width: int, height: int, size: tuple[int, int]) -> tuple[FloatArray, int, int]:
    scale = size[0] / width
    resized = matrix.copy()
    resized[:2] *= scale
    resized[0, 2] += (scale - 1) / 2
    resized[1, 2] += (scale - 1) / 2 + (size[1] - height * scale) / 2
    return resized, *size


def _pinhole(
    matrix: FloatArray, coefficients: FloatArray, width: int, height: int, path: Path
) -> tuple[LensModel, float]:
    """The pinhole model with k1 k2 k3 whose points are nearest to the fisheye's, and the largest distance, pixels."""
    x, y = np.meshgrid(np.linspace(0, width - 1, _GRID[0]), np.linspace(0, height - 1, _GRID[1]))
    focal = np.array([matrix[0, 0], matrix[1, 1]])
    seen = (np.column_stack([x.ravel(), y.ravel()]) - matrix[:2, 2]) / focal
    radius = np.linalg.norm(seen, axis=1)
    angle = _angles(radius, coefficients)
    if angle is None or angle.max() > _WIDEST_RAD:
        raise ProfileError(f"{path}: the lens sees too wide for a screen to look flat", _HINT)
    ray = seen * (np.tan(angle) / np.maximum(radius, 1e-12))[:, None]
    ray[radius < 1e-12] = 0
    reach = float(np.max(np.linalg.norm(ray, axis=1)))
    terms = (np.sum(ray**2, axis=1) / reach**2)[:, None] ** np.arange(4)
    design = (ray[:, :, None] * terms[:, None, :]).reshape(-1, 4)
    weights = np.linalg.lstsq(design, seen.ravel(), rcond=None)[0]
    apart = ((design @ weights).reshape(-1, 2) - seen) * focal
    scale = float(weights[0])
    k1, k2, k3 = (float(w) / scale / reach ** (2 * n) for n, w in enumerate(weights[1:], start=1))
    model = LensModel(
        width=width,
        height=height,
        camera_matrix=(
            (scale * float(focal[0]), 0.0, float(matrix[0, 2])),
            (0.0, scale * float(focal[1]), float(matrix[1, 2])),
            (0.0, 0.0, 1.0),
        ),
        dist_coeffs=(k1, k2, 0.0, 0.0, k3),
    )
    return model, float(np.max(np.linalg.norm(apart, axis=1)))


def _angles(radius: FloatArray, coefficients: FloatArray) -> FloatArray | None:
    """Angles (n,) whose fisheye radius is `radius`, None where the model turns back before it reaches them."""
    powers = np.arange(1, 10, 2)
    factors = np.concatenate([[1.0], coefficients])

    def value(angle: FloatArray) -> FloatArray:
        return np.asarray((angle[:, None] ** powers) @ factors)

    def slope(angle: FloatArray) -> FloatArray:
        return np.asarray((angle[:, None] ** (powers - 1)) @ (factors * powers))

    # The model must grow all the way to the corner, or a point would have two rays.
    reach = np.linspace(0, _WIDEST_RAD, 400)
    grows = np.logical_and.accumulate(slope(reach) > 0)
    known = value(reach[grows])
    if radius.max() > known[-1]:
        return None
    angle = np.interp(radius, known, reach[grows])
    for _ in range(_STEPS):
        angle = angle - (value(angle) - radius) / slope(angle)
    return np.asarray(angle)


def _readout(raw: dict[str, Any], rate: float | None) -> tuple[float | None, bool, tuple[str, ...]]:
    """The readout as users say, whether it runs upwards, and what speaks against it."""
    if raw.get("global_shutter") is True:
        return None, False, ("the profile says that the shutter is global: such a camera sees no stripes",)
    told = raw.get("frame_readout_time")
    if not isinstance(told, (int, float)) or isinstance(told, bool) or not math.isfinite(told) or told == 0:
        return None, False, ("the profile tells no readout",)
    readout_s = abs(told) * 1e-3
    upwards = told < 0 or str(raw.get("frame_readout_direction", "")) == "BottomToTop"
    if rate is not None and readout_s > 1.02 / rate:
        reason = f"a readout of {told:g} ms cannot be at {rate:g} frames/s: one takes {1e3 / rate:.2f} ms at most"
        return None, upwards, (reason,)
    notes = ["the readout is as some user told it, and may be wrong: check it with --photo, or `calibrate shutter`"]
    if upwards:
        notes.append("the profile says that rows are read from the bottom to the top")
    if str(raw.get("frame_readout_direction", "")) in ("LeftToRight", "RightToLeft"):
        return None, False, ("the profile says that columns are read one after the other, which is not supported",)
    return readout_s, upwards, tuple(notes)


def _positive(value: Any) -> float | None:
    good = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value) and value > 0
    return float(value) if good else None


def _text(raw: dict[str, Any], key: str) -> str:
    value = raw.get(key)
    return "".join(letter for letter in value if letter.isprintable()).strip() if isinstance(value, str) else ""
