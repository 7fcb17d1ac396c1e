"""The outline of a bright screen in a dark room, from brightness alone.

A checkerboard or a page of text shown on the screen hides the borders of the columns, but not the screen's four sides.
"""

from __future__ import annotations

import numpy as np

from rxcli.types import FloatArray, LightPlane

#: Pixels across the reduced picture, and the width of dark parts inside the screen that are filled, in such pixels.
_WIDTH, _FILLED = 400, 41
#: Area of the bright part: minimum shares of the picture and of the quadrilateral around it.
_MIN_PICTURE, _MIN_FILL = 0.08, 0.93
#: Distance from a straight side, in such pixels; maximum turn of a side, radians.
_STRAIGHT, _MAX_TURN = 1.5, 0.25
#: Distance from the picture's edge, in such pixels, within which a side may be the picture's; maximum number of those.
_AT_EDGE, _MAX_HIDDEN = 2.0, 1


def bright_quadrilateral(plane: LightPlane) -> FloatArray | None:
    """Corners (4, 2) of the only bright part of a picture, pixels, clockwise from its top left; None if it has none."""
    import cv2

    cells = max((len(plane.sums) - 1) // _WIDTH, 1)
    pixels = cells * plane.cell_px
    light = np.diff(plane.sums[::cells], axis=0)
    small = cv2.resize(light, (max(plane.height // pixels, 1), len(light)), interpolation=cv2.INTER_AREA).T
    small = np.clip(small * np.float32(255 / max(float(np.percentile(small, 99)), 1e-6)), 0, 255).astype(np.uint8)
    _, bright = cv2.threshold(small, 0, 255, cv2.THRESH_OTSU)
    padded = cv2.copyMakeBorder(bright, _FILLED, _FILLED, _FILLED, _FILLED, cv2.BORDER_CONSTANT, value=0)
    padded = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((_FILLED, _FILLED), np.uint8))
    contours, _ = cv2.findContours(padded, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return None
    hull = cv2.convexHull(max(contours, key=cv2.contourArea))
    polygon = cv2.approxPolyDP(hull, _STRAIGHT, True).reshape(-1, 2).astype(np.float64)
    sides = _longest_sides(polygon)
    if sides is None or cv2.contourArea(hull) < _MIN_PICTURE * small.size:
        return None
    lines = np.cross(*np.concatenate([sides, np.ones((2, 4, 1))], axis=2))
    meets = np.cross(np.roll(lines, 1, axis=0), lines)
    corners = meets[:, :2] / meets[:, 2:]
    top, right, bottom, left = sides.mean(axis=0) - _FILLED
    room = np.array([top[1], small.shape[1] - 1 - right[0], small.shape[0] - 1 - bottom[1], left[0]])
    is_whole = cv2.contourArea(hull) >= _MIN_FILL * cv2.contourArea(corners.astype(np.float32))
    if not is_whole or (room < _AT_EDGE).sum() > _MAX_HIDDEN:
        return None
    return np.asarray((corners - _FILLED + 0.5) * pixels - 0.5)


def _longest_sides(polygon: FloatArray) -> FloatArray | None:
    """Starts and ends (2, 4, 2) of the longest top, right, bottom and left side of a convex polygon (n, 2).

    A dark corner of the picture on the screen cuts off the screen's, so that the longest sides of all may be others.
    """
    ends = np.roll(polygon, -1, axis=0)
    along = ((ends - polygon) @ np.array([1, 1j]))[:, None] * 1j ** -np.arange(4)
    length = np.where(np.abs(np.angle(along)) < _MAX_TURN, np.abs(along), 0.0)
    longest = length.argmax(axis=0)
    return np.stack([polygon[longest], ends[longest]]) if length.any(axis=0).all() else None
