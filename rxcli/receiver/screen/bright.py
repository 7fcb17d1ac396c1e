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
#: Distance from a straight side, in such pixels.
_STRAIGHT = 1.5


def bright_quadrilateral(plane: LightPlane) -> FloatArray | None:
    """Corners (4, 2) of the only bright part of a picture, pixels, clockwise from its top left; None if it has none."""
    import cv2

    cells = max((len(plane.sums) - 1) // _WIDTH, 1)
    pixels = cells * plane.cell_px
    light = np.diff(plane.sums[::cells], axis=0).T
    small = cv2.resize(light, (light.shape[1], max(plane.height // pixels, 1)), interpolation=cv2.INTER_AREA)
    small = np.clip(small * np.float32(255 / max(float(np.percentile(small, 99)), 1e-6)), 0, 255).astype(np.uint8)
    _, bright = cv2.threshold(small, 0, 255, cv2.THRESH_OTSU)
    padded = cv2.copyMakeBorder(bright, _FILLED, _FILLED, _FILLED, _FILLED, cv2.BORDER_CONSTANT, value=0)
    padded = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((_FILLED, _FILLED), np.uint8))
    contours, _ = cv2.findContours(padded, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = cv2.convexHull(max(contours, key=cv2.contourArea))
    polygon = cv2.approxPolyDP(hull, _STRAIGHT, True).reshape(-1, 2).astype(np.float64)
    if len(polygon) < 4 or cv2.contourArea(hull) < _MIN_PICTURE * small.size:
        return None
    corners = _longest_sides(polygon)
    if cv2.contourArea(hull) < _MIN_FILL * cv2.contourArea(corners.astype(np.float32)):
        return None
    by_angle = np.arctan2(*(corners - corners.mean(axis=0)).T[::-1]).argsort()
    return np.asarray((corners[by_angle] - _FILLED + 0.5) * pixels - 0.5)


def _longest_sides(polygon: FloatArray) -> FloatArray:
    """Corners (4, 2) at which the four longest sides of a convex polygon (n, 2) meet."""
    sides = np.roll(polygon, -1, axis=0) - polygon
    longest = np.sort(np.argsort(-np.hypot(*sides.T))[:4])
    normals = sides[longest][:, ::-1] * np.array([1.0, -1.0])
    offsets = (normals * polygon[longest]).sum(axis=1)
    pairs = [[k, (k + 1) % len(longest)] for k in range(len(longest))]
    return np.stack([np.linalg.lstsq(normals[pair], offsets[pair], rcond=None)[0] for pair in pairs])
