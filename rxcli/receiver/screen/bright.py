"""The outline of a bright screen in a dark room, from brightness alone.

A checkerboard or a page of text shown on the screen hides the borders of the columns, but not the screen's four sides.
"""

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import TINY
from rxcli.types import Float32Array, FloatArray, LightPlane

#: Pixels across the reduced picture, and the width of dark parts inside the screen that are filled, in such pixels.
_WIDTH, _FILLED = 400, 41
#: Area of the bright part: minimum shares of the picture and of the quadrilateral around it.
_MIN_PICTURE, _MIN_FILL = 0.08, 0.93
#: Distance from a straight side, in such pixels; maximum turn of a side, radians.
_STRAIGHT, _MAX_TURN = 1.5, 0.25
#: Distance from the picture's edge, in such pixels, within which a side may be the picture's; maximum number of those.
_AT_EDGE, _MAX_HIDDEN = 2.0, 1
#: The clearest grey level.
_WHITE = 255
#: Of stripes: rows of the mean that they are taken against, bands of rows and cells side by side in which they are
#: compared, minimum correlation there, and minimum amplitude, of 255 as the clearest.
_STRIPE_ROWS, _BANDS, _NEAR, _MIN_LIKENESS, _STRIPED = 129, 25, 5, 0.5, 80


def bright_quadrilateral(plane: LightPlane) -> FloatArray | None:
    """Corners (4, 2) of the only bright part of a picture, pixels, clockwise from its top left; None if it has none."""
    import cv2

    light, pixels = _cells(plane)
    hull, shape = _hull(light, pixels)
    polygon = cv2.approxPolyDP(hull, _STRAIGHT, True).reshape(-1, 2).astype(np.float64)
    sides = _longest_sides(polygon)
    if sides is None or cv2.contourArea(hull) < _MIN_PICTURE * shape[0] * shape[1]:
        return None
    lines = np.cross(*np.concatenate([sides, np.ones((2, 4, 1))], axis=2))
    meets = np.cross(np.roll(lines, 1, axis=0), lines)
    corners = meets[:, :2] / meets[:, 2:]
    top, right, bottom, left = sides.mean(axis=0) - _FILLED
    room = np.array([top[1], shape[1] - 1 - right[0], shape[0] - 1 - bottom[1], left[0]])
    is_whole = cv2.contourArea(hull) >= _MIN_FILL * cv2.contourArea(corners.astype(np.float32))
    if not is_whole or (room < _AT_EDGE).sum() > _MAX_HIDDEN:
        return None
    return np.asarray((corners - _FILLED + 0.5) * pixels - 0.5)


def striped_box(plane: LightPlane) -> FloatArray | None:
    """Corners (4, 2) of the upright rectangle around the largest striped part of a picture; None without stripes."""
    import cv2

    light, pixels = _cells(plane)
    stripes = light - cv2.blur(light, (_STRIPE_ROWS, 1))
    # Stripes are the same a little further on; noise is not.
    near = (max(plane.height // _BANDS, 1), _NEAR)
    power, total = (cv2.blur(stripes[2:] * rest, near) for rest in (stripes[:-2], stripes[2:]))
    if not (power > _MIN_LIKENESS * total).any():
        return None
    hull, _ = _hull(np.sqrt(np.maximum(power, 0)), pixels, _STRIPED)
    (left, top), (right, bottom) = hull.min(axis=(0, 1)) - _FILLED, hull.max(axis=(0, 1)) - _FILLED + 1
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]]) * float(pixels) - 0.5


def _cells(plane: LightPlane) -> tuple[Float32Array, int]:
    """Light of about `_WIDTH` cells across the picture on every row, (n, rows), and the width of a cell in pixels."""
    cells = max((len(plane.sums) - 1) // _WIDTH, 1)
    return np.diff(plane.sums[::cells], axis=0), cells * plane.cell_px


def _hull(cells: Float32Array, pixels: int, threshold: int = 0) -> tuple[NDArray[np.int32], tuple[int, ...]]:
    """Hull (n, 1, 2) of the largest bright part of some cells (n, rows), shifted by a border of `_FILLED`; and the
    height and width of the reduced picture. A threshold of 0 is chosen by the picture.
    """
    import cv2

    small = cv2.resize(cells, (max(cells.shape[1] // pixels, 1), len(cells)), interpolation=cv2.INTER_AREA).T
    small = np.clip(small * np.float32(_WHITE / max(float(np.percentile(small, 99)), TINY)), 0, _WHITE).astype(np.uint8)
    method = cv2.THRESH_BINARY if threshold else cv2.THRESH_OTSU
    _, bright = cv2.threshold(small, threshold, _WHITE, method)
    padded = cv2.copyMakeBorder(bright, _FILLED, _FILLED, _FILLED, _FILLED, cv2.BORDER_CONSTANT, value=0)
    padded = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((_FILLED, _FILLED), np.uint8))
    contours, _ = cv2.findContours(padded, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    largest = max(contours, key=cv2.contourArea) if contours else _FILLED + np.array([[[0, 0]], [small.shape[::-1]]])
    return cv2.convexHull(np.asarray(largest, np.int32)), small.shape


def _longest_sides(polygon: FloatArray) -> FloatArray | None:
    """Starts and ends (2, 4, 2) of the longest top, right, bottom and left side of a convex polygon (n, 2).

    A dark corner of the picture on the screen cuts off the screen's, so that the longest sides of all may be others.
    """
    ends = np.roll(polygon, -1, axis=0)
    along = ((ends - polygon) @ np.array([1, 1j]))[:, None] * 1j ** -np.arange(4)
    length = np.where(np.abs(np.angle(along)) < _MAX_TURN, np.abs(along), 0.0)
    longest = length.argmax(axis=0)
    return np.stack([polygon[longest], ends[longest]]) if length.any(axis=0).all() else None
