"""The outline of a screen in a dark room, from brightness alone.

A checkerboard or a page of text shown on the screen hides the borders of the columns, but not the screen's four sides.
Round dark pictures they still show faintly: a dark panel passes a little light, and reflects the room's.
"""

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import TINY
from rxcli.types import BoolArray, Float32Array, FloatArray, LightPlane

#: Pixels across the reduced picture, and the width of dark parts inside the screen that are filled, in such pixels.
_WIDTH, _FILLED = 400, 41
#: Area of the bright part: minimum shares of the picture and of the quadrilateral around it.
_MIN_PICTURE, _MIN_FILL = 0.08, 0.93
#: Distance from a straight side, in such pixels; maximum turn of a side, radians.
_STRAIGHT, _MAX_TURN = 1.5, 0.25
#: Distance from the picture's edge, in such pixels, within which a side may be the picture's; maximum number of those.
_AT_EDGE, _MAX_HIDDEN = 2.0, 1
#: The brightest grey level, and the percentile of a picture's parts at each end of its range.
_WHITE, _TAIL = 255, 0.5
#: Levels below the first, each among what is below the last: cells across and down that are averaged there, and width
#: of gaps that are filled, so that a screen's dark frame stays; step of the cells by which a level is found.
_FAINT_LEVELS, _AVERAGED, _GAP, _SAMPLED = 3, (5, 13), 9, 5


def bright_parts(plane: LightPlane) -> list[FloatArray | None]:
    """What is above each of several levels, brightest first: a window, the film around it, the dark screen.

    Corners (4, 2), pixels, clockwise from the top left; None where the largest such part has no four straight sides.
    """
    import cv2

    cells = max((len(plane.sums) - 1) // _WIDTH, 1)
    light, pixels = np.diff(plane.sums[::cells], axis=0), cells * plane.cell_px
    size = max(light.shape[1] // pixels, 1), len(light)
    fine = cv2.resize(light, size, interpolation=cv2.INTER_AREA).T
    found: list[FloatArray | None] = []
    least = np.inf
    for small, gap in ((fine, _FILLED), *((cv2.blur(fine, _AVERAGED), _GAP),) * _FAINT_LEVELS):
        rest = small[::_SAMPLED, ::_SAMPLED]
        rest = rest[rest <= least]
        if not rest.size:  # A picture of few pixels.
            found.append(None)
            continue
        low, high = np.percentile(rest, (_TAIL, 100 - _TAIL))
        scale = _WHITE / max(float(high - low), TINY)
        level, _ = cv2.threshold(_bytes((rest - low) * scale), 0, _WHITE, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
        corners = _quadrilateral(_bytes((small - low) * scale) > level, gap)
        found.append(None if corners is None else (corners + 0.5) * pixels - 0.5)
        least = low + level / scale
    return found


def _bytes(values: Float32Array) -> NDArray[np.uint8]:
    return np.clip(values, 0, _WHITE).astype(np.uint8)


def _quadrilateral(is_bright: BoolArray, gap: int) -> FloatArray | None:
    """Corners (4, 2) of the largest bright part of a reduced picture, if it is a quadrilateral; None otherwise.

    Args:
        is_bright: (h, w).
        gap: width of dark parts that are filled.
    """
    import cv2

    height, width = is_bright.shape
    padded = np.pad(is_bright.astype(np.uint8), _FILLED)
    padded = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((gap, gap), np.uint8))
    contours, _ = cv2.findContours(padded, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return None
    hull = cv2.convexHull(max(contours, key=cv2.contourArea)) - _FILLED
    sides = _longest_sides(cv2.approxPolyDP(hull, _STRAIGHT, True).reshape(-1, 2).astype(np.float64))
    if sides is None or cv2.contourArea(hull) < _MIN_PICTURE * height * width:
        return None
    lines = np.cross(*np.concatenate([sides, np.ones((2, 4, 1))], axis=2))
    meets = np.cross(np.roll(lines, 1, axis=0), lines)
    corners = meets[:, :2] / meets[:, 2:]
    top, right, bottom, left = sides.mean(axis=0)
    room = np.array([top[1], width - 1 - right[0], height - 1 - bottom[1], left[0]])
    is_whole = cv2.contourArea(hull) >= _MIN_FILL * cv2.contourArea(corners.astype(np.float32))
    return corners if is_whole and (room < _AT_EDGE).sum() <= _MAX_HIDDEN else None


def _longest_sides(polygon: FloatArray) -> FloatArray | None:
    """Starts and ends (2, 4, 2) of the longest top, right, bottom and left side of a convex polygon (n, 2).

    A dark corner of the picture on the screen cuts off the screen's, so that the longest sides of all may be others.
    """
    ends = np.roll(polygon, -1, axis=0)
    along = ((ends - polygon) @ np.array([1, 1j]))[:, None] * 1j ** -np.arange(4)
    length = np.where(np.abs(np.angle(along)) < _MAX_TURN, np.abs(along), 0.0)
    longest = length.argmax(axis=0)
    return np.stack([polygon[longest], ends[longest]]) if length.any(axis=0).all() else None
