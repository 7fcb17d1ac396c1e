"""What is drawn over a picture: a small copy of it, and the outline of every column with what became of it."""

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.receiver.plane.orientation import turned_points
from rxcli.receiver.screen import geometry
from rxcli.results.cameras import Reception
from rxcli.results.undistort import grey_levels
from rxcli.types import Frame, Outlines

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


def outlines_of(turned: Reception) -> Outlines | None:
    """Outlines of the columns of a screen, along the bends of a lens that is known; None where no screen was found.

    Args:
        turned: a frame turned as it was received.
    """
    frame, camera, corners = turned.frame, turned.camera, turned.result.corners
    if corners is None or turned.screen is None:
        return None
    lens = geometry.lens_for(camera.lens, frame.width, frame.height) if camera and camera.lens else None
    return geometry.column_outlines(corners, turned.screen.columns, 1, frame.width, frame.height, lens)


def picture_of(shown: Reception, small: Preview, quality: int = 80) -> dict[str, Any]:
    """The small copy of a frame as JPEG, with the screen's and its columns' outlines in its pixels, as plain data."""
    result, turned, found = shown.result, shown.turned, list[dict[str, Any]]()
    outlines = outlines_of(turned)
    for column in result.columns:
        if outlines is None or not (on_screen := np.flatnonzero(outlines.inside[column.column].any(axis=0))).size:
            continue
        chosen = on_screen[np.linspace(0, on_screen.size - 1, min(_POINTS, on_screen.size)).astype(int)]
        rows = outlines.rows[chosen].astype(np.float64)
        left, right = (outlines.edges_x[column.column + side, chosen].astype(np.float64) for side in (0, 1))
        sides = np.concatenate([np.column_stack([left, rows]), np.column_stack([right, rows])[::-1]])
        points = turned_points(sides, turned.frame, -result.quarter_turns % 4) / small.step
        found.append({"column": column.column, "status": column.status, "points": points.round(1).tolist()})
    corners = [] if result.corners is None else (result.corners / small.step).round(1).tolist()
    return drawing(small.pixels, quality, corners, found)
