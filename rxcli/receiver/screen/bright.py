"""The outline of a screen in a dark room, from brightness alone.

A checkerboard or a page of text shown on the screen hides the borders of the columns, but not the screen's four sides.
Round dark pictures they still show faintly: a dark panel passes a little light, and reflects the room's.
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
#: The clearest grey level, and the share of a picture's parts at each end of its range.
_WHITE, _TAIL = 255, 0.5
#: Of faint parts: levels that are tried, each among what is below the last; cells across and down that are averaged;
#: width of gaps that are filled, so that a screen's dark frame stays; step of the cells by which a level is found.
_LEVELS, _AVERAGED, _GAP, _SAMPLED = 4, (5, 13), 9, 5
#: Of stripes: rows of the mean that they are taken against, bands of rows and cells side by side in which they are
#: compared, minimum correlation there, and minimum amplitude, of 255 as the clearest.
_STRIPE_ROWS, _BANDS, _NEAR, _MIN_LIKENESS, _STRIPED = 129, 25, 5, 0.5, 80


def bright_quadrilateral(plane: LightPlane) -> FloatArray | None:
    """Corners (4, 2) of the only bright part of a picture, pixels, clockwise from its top left; None if it has none."""
    light, pixels = _cells(plane)
    return _quadrilateral(_grey(_reduced(light, pixels)), pixels)


def faint_quadrilaterals(plane: LightPlane) -> list[FloatArray]:
    """The same of the parts above several levels, brightest first: a window, the film around it, the dark screen."""
    import cv2

    light, pixels = _cells(plane)
    small = cv2.blur(_reduced(light, pixels), _AVERAGED)
    found, rest = [], small[::_SAMPLED, ::_SAMPLED].reshape(-1, 1)
    for _ in range(_LEVELS):
        low, high = np.percentile(rest, (_TAIL, 100 - _TAIL))
        scale = _WHITE / max(float(high - low), TINY)
        level, _ = cv2.threshold(_bytes((rest - low) * scale), 0, _WHITE, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
        found.append(_quadrilateral(_bytes((small - low) * scale), pixels, int(level), _GAP))
        rest = rest[rest <= low + level / scale].reshape(-1, 1)
    return [corners for corners in found if corners is not None]


def _quadrilateral(grey: NDArray[np.uint8], pixels: int, threshold: int = 0, gap: int = _FILLED) -> FloatArray | None:
    """Corners (4, 2) of the largest bright part of a reduced picture, if it is a quadrilateral; None otherwise."""
    import cv2

    hull, shape = _hull(grey, threshold, gap), grey.shape
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
    hull = _hull(_grey(_reduced(np.sqrt(np.maximum(power, 0)), pixels)), _STRIPED)
    (left, top), (right, bottom) = hull.min(axis=(0, 1)) - _FILLED, hull.max(axis=(0, 1)) - _FILLED + 1
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]]) * float(pixels) - 0.5


def _cells(plane: LightPlane) -> tuple[Float32Array, int]:
    """Light of about `_WIDTH` cells across the picture on every row, (n, rows), and the width of a cell in pixels."""
    cells = max((len(plane.sums) - 1) // _WIDTH, 1)
    return np.diff(plane.sums[::cells], axis=0), cells * plane.cell_px


def _reduced(cells: Float32Array, pixels: int) -> Float32Array:
    """A picture (h, w) of about `_WIDTH` square parts across, from cells (w, rows) of `pixels` width."""
    import cv2

    size = max(cells.shape[1] // pixels, 1), len(cells)
    return np.asarray(cv2.resize(cells, size, interpolation=cv2.INTER_AREA).T, np.float32)


def _bytes(values: Float32Array) -> NDArray[np.uint8]:
    return np.clip(values, 0, _WHITE).astype(np.uint8)


def _grey(small: Float32Array) -> NDArray[np.uint8]:
    """Grey levels of a reduced picture, 0 to its brightest hundredth."""
    return _bytes(small * np.float32(_WHITE / max(float(np.percentile(small, 99)), TINY)))


def _hull(grey: NDArray[np.uint8], threshold: int = 0, gap: int = _FILLED) -> NDArray[np.int32]:
    """Hull (n, 1, 2) of the largest bright part of a reduced picture, shifted by a border of `_FILLED`.

    Args:
        grey: the picture.
        threshold: grey level; 0: chosen by the picture.
        gap: width of dark parts that are filled.
    """
    import cv2

    method = cv2.THRESH_BINARY if threshold else cv2.THRESH_OTSU
    _, bright = cv2.threshold(grey, threshold, _WHITE, method)
    padded = cv2.copyMakeBorder(bright, _FILLED, _FILLED, _FILLED, _FILLED, cv2.BORDER_CONSTANT, value=0)
    padded = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((gap, gap), np.uint8))
    contours, _ = cv2.findContours(padded, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    whole = _FILLED + np.array([[[0, 0]], [grey.shape[::-1]]])
    largest = max(contours, key=cv2.contourArea) if contours else whole
    return np.asarray(cv2.convexHull(np.asarray(largest, np.int32)), np.int32)


def _longest_sides(polygon: FloatArray) -> FloatArray | None:
    """Starts and ends (2, 4, 2) of the longest top, right, bottom and left side of a convex polygon (n, 2).

    A dark corner of the picture on the screen cuts off the screen's, so that the longest sides of all may be others.
    """
    ends = np.roll(polygon, -1, axis=0)
    along = ((ends - polygon) @ np.array([1, 1j]))[:, None] * 1j ** -np.arange(4)
    length = np.where(np.abs(np.angle(along)) < _MAX_TURN, np.abs(along), 0.0)
    longest = length.argmax(axis=0)
    return np.stack([polygon[longest], ends[longest]]) if length.any(axis=0).all() else None
