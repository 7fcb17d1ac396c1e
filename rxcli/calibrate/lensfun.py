"""Lens models from the lensfun database, by camera and lens as EXIF names them (extra `[lensfun]`).

Lensfun describes distortion by polynomials of the radius (ptlens, poly3, poly5) that lead, as OpenCV's do, from the
undistorted to the distorted picture. They are turned into k1 k2 k3 by least squares over the field. What scale the
undistorted picture has is a convention in both, so the focal length takes it up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rxcli.errors import ProfileError, UsageError
from rxcli.profiles import LensModel
from rxcli.types import FloatArray, Metadata

#: Diagonal of the full frame, millimetres, to which crop factors refer.
_FULL_FRAME_DIAGONAL_MM = float(np.hypot(36, 24))
#: Points of the field across and down at which lensfun is asked.
_GRID = (25, 17)


@dataclass(frozen=True, slots=True)
class LensfunModel:
    """A lens out of the database."""

    lens: LensModel
    #: Names in the database.
    camera_name: str
    lens_name: str
    #: Largest distance between lensfun's and OpenCV's points over the field, pixels.
    worst_px: float


def lens_from_database(metadata: Metadata, width: int, height: int) -> LensfunModel:
    """The lens model of a picture's camera, lens and focal length.

    Args:
        metadata: make, model, lens and focal length, as the file tells them or the user does.
        width: of the stored picture, pixels.
        height: of the stored picture, pixels.

    Raises:
        UsageError: lensfunpy is not installed, or the metadata lacks something.
        ProfileError: the database does not know camera or lens, or holds no distortion of it.
    """
    lensfunpy = _import()
    focal_mm = metadata.focal_length_mm
    if not metadata.model or not focal_mm:
        raise UsageError(
            "the file tells no camera model or no focal length", "give --camera-model, --lens and --focal-length"
        )
    database = lensfunpy.Database()
    camera = _find_camera(database, metadata)
    lens = _find_lens(database, camera, metadata, lensfunpy.LensType.RECTILINEAR)
    if lens.interpolate_distortion(focal_mm) is None:
        raise ProfileError(f"lensfun holds no distortion of {lens.model} at {focal_mm:g} mm", "use `calibrate lens`")
    modifier = lensfunpy.Modifier(lens, camera.crop_factor, width, height)
    modifier.initialize(focal_mm, 8.0, 10.0, scale=1.0, flags=lensfunpy.ModifyFlags.DISTORTION)
    undistorted = _field(width, height)
    distorted = np.array(
        [modifier.apply_geometry_distortion(float(x), float(y), 1, 1)[0, 0] for x, y in undistorted], np.float64
    )
    pitch_mm = _FULL_FRAME_DIAGONAL_MM / camera.crop_factor / float(np.hypot(width, height))
    model, worst = fit_opencv(undistorted, distorted, focal_mm / pitch_mm, width, height)
    return LensfunModel(model, f"{camera.maker} {camera.model}", lens.model, worst)


def _import() -> Any:
    try:
        import lensfunpy
    except ImportError:
        raise UsageError(
            "the lensfun database needs the package lensfunpy", "install it with: pip install '.[lensfun]'"
        ) from None
    return lensfunpy


def _find_camera(database: Any, metadata: Metadata) -> Any:
    found = database.find_cameras(metadata.make, metadata.model) or database.find_cameras(None, metadata.model)
    if not found:
        name = " ".join(part for part in (metadata.make, metadata.model) if part)
        raise ProfileError(f"lensfun does not know the camera {name!r}", "use `calibrate lens`")
    return found[0]


def _find_lens(database: Any, camera: Any, metadata: Metadata, rectilinear: Any) -> Any:
    """The best match by name; a camera with one lens of its own needs none."""
    found = [lens for lens in database.find_lenses(camera, None, metadata.lens) if lens.type == rectilinear]
    if not found or (not metadata.lens and len(found) > 1):
        name = repr(metadata.lens) if metadata.lens else "(the file names none)"
        raise ProfileError(
            f"lensfun does not know the lens {name} on {camera.model}", "name it with --lens, or use `calibrate lens`"
        )
    return found[0]


def _field(width: int, height: int) -> FloatArray:
    """(n, 2) points of a grid over the picture, pixels."""
    x, y = np.meshgrid(np.linspace(0, width - 1, _GRID[0]), np.linspace(0, height - 1, _GRID[1]))
    return np.column_stack([x.ravel(), y.ravel()])


def fit_opencv(
    undistorted: FloatArray, distorted: FloatArray, focal_px: float, width: int, height: int
) -> tuple[LensModel, float]:
    """OpenCV's model that leads from `undistorted` to `distorted` points.

    With `u` the undistorted offset from the centre and `r = |u| / focal_px`, the distorted offset is
    `s * u * (1 + k1 r^2 + k2 r^4 + k3 r^6)`, linear in `s, s k1, s k2, s k3`; `s` goes into the focal length.

    Args:
        undistorted: (n, 2) pixels.
        distorted: (n, 2) pixels.
        focal_px: nominal focal length.
        width: of the picture.
        height: of the picture.

    Returns:
        The model and the largest deviation over the points, pixels.
    """
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    u, d = undistorted - centre, distorted - centre
    reach = float(np.max(np.linalg.norm(u, axis=1)))
    relative = np.sum(u**2, axis=1) / reach**2
    terms = relative[:, None] ** np.arange(4)
    design = (u[:, :, None] * terms[:, None, :]).reshape(-1, 4)
    weights = np.linalg.lstsq(design, d.ravel(), rcond=None)[0]
    worst = float(np.max(np.linalg.norm((design @ weights).reshape(-1, 2) - d, axis=1)))
    scale = float(weights[0])
    k1, k2, k3 = (float(w) / scale * (focal_px / reach) ** (2 * n) for n, w in enumerate(weights[1:], start=1))
    focal = scale * focal_px
    matrix = ((focal, 0.0, float(centre[0])), (0.0, focal, float(centre[1])), (0.0, 0.0, 1.0))
    return LensModel(width=width, height=height, camera_matrix=matrix, dist_coeffs=(k1, k2, 0.0, 0.0, k3)), worst
