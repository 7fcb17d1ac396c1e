"""Lens models from the lensfun database, by camera and lens as EXIF names them (extra `[lensfun]`).

Lensfun's distortion polynomials (ptlens, poly3, poly5) lead, as OpenCV's do, from the undistorted to the distorted
picture. They are converted to k1 k2 k3 by least squares over the picture.
"""

from typing import Any

import numpy as np

from rxcli.calibrate.fitting import ConvertedLens, fit_distortion, grid_points
from rxcli.errors import ProfileError, UsageError, require
from rxcli.types import Metadata

#: Diagonal of the full frame, millimetres, to which crop factors refer.
_FULL_FRAME_DIAGONAL_MM = float(np.hypot(36, 24))
#: Points across and down at which the models are compared.
_GRID = (25, 17)


def lens_from_database(metadata: Metadata, width: int, height: int) -> ConvertedLens:
    """The lens model of a picture's camera, lens and focal length.

    Args:
        metadata: make, model, lens and focal length, from the file or the user.
        width: of the stored picture, pixels.
        height: of the stored picture, pixels.

    Raises:
        UsageError: lensfunpy is not installed, or the metadata lacks something.
        ProfileError: the database does not know camera or lens, or holds no distortion of it.
    """
    require("the lensfun database", "lensfunpy")
    import lensfunpy

    focal_mm = metadata.focal_length_mm
    if not metadata.model or not focal_mm:
        hint = "give --camera-model, --lens and --focal-length"
        raise UsageError("the file states no camera model or no focal length", hint)
    database = lensfunpy.Database()
    camera = _find_camera(database, metadata)
    lens = _find_lens(database, camera, metadata, lensfunpy.LensType.RECTILINEAR)
    if lens.interpolate_distortion(focal_mm) is None:
        raise ProfileError(f"lensfun holds no distortion of {lens.model} at {focal_mm:g} mm", "use `calibrate lens`")
    modifier = lensfunpy.Modifier(lens, camera.crop_factor, width, height)
    modifier.initialize(focal_mm, 8.0, 10.0, scale=1.0, flags=lensfunpy.ModifyFlags.DISTORTION)
    undistorted = grid_points((width, height), _GRID)
    distorted = np.array([modifier.apply_geometry_distortion(*point, 1, 1)[0, 0] for point in undistorted.tolist()])
    focal_px = focal_mm * camera.crop_factor / _FULL_FRAME_DIAGONAL_MM * float(np.hypot(width, height))
    centre = np.array([width - 1, height - 1]) / 2
    rays, points = ((part - centre) / focal_px for part in (undistorted, distorted))
    model, worst = fit_distortion(rays, points, focal_px, centre, (width, height))
    return ConvertedLens(model, worst, f"{camera.maker} {camera.model}", lens.model)


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
        reason = f"lensfun does not know the lens {name} on {camera.model}"
        raise ProfileError(reason, "name it with --lens, or use `calibrate lens`")
    return found[0]
