"""What is drawn over a picture: a small copy of it, and the outline of every column with what became of it."""

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.profiles import CameraProfile, ScreenProfile
from rxcli.receiver.plane.orientation import as_received, turned_points
from rxcli.receiver.screen import geometry
from rxcli.results.undistort import grey_levels
from rxcli.types import FloatArray, Frame, FrameResult, Outlines

#: Points on each side of an outline: a bent side looks smooth.
_POINTS = 17


@dataclass(frozen=True, slots=True)
class Preview:
    """A small grey copy of a frame."""

    #: (height, width) uint8.
    pixels: NDArray[np.uint8]
    #: Pixels of the frame for one of these.
    step: int


def drawing(
    pixels: NDArray[np.uint8], quality: int, corners: Any = (), outlines: Sequence[dict[str, Any]] = ()
) -> dict[str, Any]:
    """A picture and what is drawn over it, as plain data.

    Args:
        pixels: (height, width) grey values.
        quality: of the JPEG.
        corners: of the screen, pixels of the picture.
        outlines: of columns, likewise; see `picture_of`.
    """
    import simplejpeg

    plane, (height, width) = np.ascontiguousarray(pixels)[:, :, None], pixels.shape
    jpeg = base64.b64encode(simplejpeg.encode_jpeg(plane, quality, colorspace="GRAY", colorsubsampling="Gray"))
    return {"jpeg": jpeg.decode(), "width": width, "height": height, "corners": corners, "outlines": outlines}


def preview(frame: Frame, width_px: int = 1000) -> Preview:
    """A copy of `frame` at most about `width_px` wide: by decimation, so that stripes remain."""
    step = max(1, math.ceil(max(frame.width, frame.height) / width_px))
    return Preview(grey_levels(frame, step), step)


def outlines_of(corners: FloatArray, n_columns: int, frame: Frame, camera: CameraProfile | None) -> Outlines:
    """Outlines of the columns of a screen, along the bends of a lens that is known or estimated."""
    lens = geometry.lens_for(camera.lens, frame.width, frame.height) if camera and camera.lens else None
    return geometry.column_outlines(corners, n_columns, 1, frame.width, frame.height, lens)


def column_polygons(
    result: FrameResult, frame: Frame, screen: ScreenProfile | None, camera: CameraProfile | None
) -> list[tuple[int, str, FloatArray]]:
    """Number, status and outline (n, 2), in pixels of the frame, of every column; none where no screen was found."""
    if result.corners is None or screen is None or not result.columns:
        return []
    frame, received = as_received(frame, result)
    assert received.corners is not None
    outlines = outlines_of(received.corners, screen.columns, frame, camera)
    found: list[tuple[int, str, FloatArray]] = []
    for column in result.columns:
        on_screen = np.flatnonzero(outlines.inside[column.column].any(axis=0))
        if not on_screen.size:
            continue
        chosen = on_screen[np.linspace(0, on_screen.size - 1, min(_POINTS, on_screen.size)).astype(int)]
        rows = outlines.rows[chosen].astype(np.float64)
        left, right = (outlines.edges_x[column.column + side, chosen].astype(np.float64) for side in (0, 1))
        sides = np.concatenate([np.column_stack([left, rows]), np.column_stack([right, rows])[::-1]])
        found.append((column.column, column.status, turned_points(sides, frame, -result.quarter_turns % 4)))
    return found


def picture_of(
    result: FrameResult,
    frame: Frame,
    small: Preview,
    screen: ScreenProfile | None,
    camera: CameraProfile | None,
    quality: int = 80,
) -> dict[str, Any]:
    """The small copy of a frame as JPEG, with the screen's and its columns' outlines in its pixels, as plain data."""
    corners = [] if result.corners is None else (result.corners / small.step).round(1).tolist()
    outlines = [
        {"column": number, "status": status, "points": (points / small.step).round(1).tolist()}
        for number, status, points in column_polygons(result, frame, screen, camera)
    ]
    return drawing(small.pixels, quality, corners, outlines)
