"""Geometry on points: lens model, screen plane, column outlines on the picture, row-time map.

No pixel is warped. The screen's corners give a homography from the screen plane to the undistorted picture, the lens
model carries points on to the stored picture, and each strip's edges become x as a function of the picture row.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rxcli.profiles import LensModel
from rxcli.types import Float32Array, FloatArray, IntArray, Lens, Outlines

_Real = TypeVar("_Real", np.float32, np.float64)

#: EXIF orientation -> order in which the viewer sees the corners of the stored picture (top-left, top-right,
#: bottom-right, bottom-left).
_VIEWER_CORNERS = {1: (0, 1, 2, 3), 2: (1, 0, 3, 2), 3: (2, 3, 0, 1), 4: (3, 2, 1, 0)}
#: Overlap of outlines beyond the screen's corners, as a share of its height, so that no edge row is lost.
_OVERHANG = 0.02
#: Sides of a picture, in the order of its corners: side i goes from corner i to corner i + 1.
SIDE_NAMES = ("top", "right", "bottom", "left")
#: Points down the screen through which edges of strips are drawn.
_N_POINTS = 65
#: Maximum displacement of a point by a lens, in focal lengths.
_LARGEST_MOVE = 10.0
#: Maximum steps of the inverse of a lens, which reach 1e-6 px for ordinary lenses; it has converged when a step moves
#: every point by less than this many pixels.
INVERSE_STEPS, _MIN_STEP = 20, 1e-8
#: Rows over which edges are interpolated linearly: straight to a thousandth of a pixel.
_KNOT_ROWS = 32

#: u and v of a screen's corners.
_SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def viewer_order(corners: FloatArray, orientation: int) -> FloatArray:
    """Corners of the stored picture (top-left first, clockwise) in the viewer's order.

    Args:
        corners: (4, 2) pixels.
        orientation: EXIF orientation 1..8; for 5..8 the readout runs across the columns and 1..4 is taken.
    """
    return corners[list(_VIEWER_CORNERS.get(orientation, _VIEWER_CORNERS[1]))]


def lens_for(model: LensModel, width: int, height: int) -> Lens:
    """The lens model of a profile, scaled to a picture of `width` x `height`."""
    sx, sy = width / model.width, height / model.height
    matrix = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]]) @ np.array(model.camera_matrix)
    return Lens(matrix, np.array(model.dist_coeffs, np.float64), model.distortion_already_corrected)


def bending(lens: Lens | None) -> Lens | None:
    """The lens if it bends straight lines of the picture; None if there is none or the picture was corrected."""
    return None if lens is None or lens.corrected else lens


def distort(points: FloatArray, lens: Lens | None) -> FloatArray:
    """Undistorted pixels to distorted ones: K distort(K^-1 p), OpenCV's forward polynomial.

    Args:
        points: (..., 2) pixels.
        lens: the lens model; None leaves the points alone.

    Returns:
        (..., 2) pixels.
    """
    if lens is None:
        return points
    k1, k2, p1, p2, k3, k4, k5, k6 = (*lens.dist_coeffs, *np.zeros(8))[:8]
    (fx, _, cx), (_, fy, cy), _ = lens.camera_matrix
    x, y = (points[..., 0] - cx) / fx, (points[..., 1] - cy) / fy
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([fx * xd + cx, fy * yd + cy], axis=-1)


def undistort(points: FloatArray, lens: Lens | None) -> FloatArray:
    """Distorted pixels to undistorted ones: the inverse of `distort`, by fixed-point iteration.

    Far outside the picture the polynomial has no inverse and the iteration runs away: such points stay where they are.

    Args:
        points: (..., 2) pixels.
        lens: the lens model; None leaves the points alone.
    """
    if lens is None:
        return points
    reach = _LARGEST_MOVE * np.abs(lens.camera_matrix[0, 0])
    found = points.copy()
    for _ in range(INVERSE_STEPS):
        step = found + points - distort(found, lens)
        before, found = found, np.where((np.abs(step - points) <= reach).all(axis=-1, keepdims=True), step, points)
        if np.abs(found - before).max(initial=0.0) < _MIN_STEP:
            break
    return found


def homography(corners: FloatArray) -> FloatArray:
    """(3, 3) map of screen points (u to the right, v down, both 0..1) to pixels, from the (4, 2) corners."""
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = np.asarray(corners, np.float64).tolist()
    # The deviation of the corners from a parallelogram gives the perspective (Heckbert 1989).
    bent_x, bent_y = x0 - x1 + x2 - x3, y0 - y1 + y2 - y3
    right_x, right_y, left_x, left_y = x1 - x2, y1 - y2, x3 - x2, y3 - y2
    determinant = right_x * left_y - left_x * right_y
    if determinant == 0:
        raise np.linalg.LinAlgError("three of the corners lie on one line")
    g = (bent_x * left_y - left_x * bent_y) / determinant
    h = (right_x * bent_y - bent_x * right_y) / determinant
    return np.array(
        [[x1 - x0 + g * x1, x3 - x0 + h * x3, x0], [y1 - y0 + g * y1, y3 - y0 + h * y3, y0], [g, h, 1.0]], np.float64
    )


def screen_to_picture(points: FloatArray, corners: FloatArray, lens: Lens | None) -> FloatArray:
    """Screen points (u, v in 0..1) to pixels of the stored picture.

    Args:
        points: (..., 2).
        corners: (4, 2) pixels of the stored picture, the viewer's top-left first.
        lens: lens model of the picture; None or corrected: the screen's sides are straight.
    """
    lens = bending(lens)
    return distort(projected(points, homography(undistort(corners, lens))), lens)


def picture_to_screen(points: FloatArray, corners: FloatArray, lens: Lens | None) -> FloatArray:
    """Pixels of the stored picture to screen points, the inverse of `screen_to_picture`."""
    lens = bending(lens)
    to_screen = np.linalg.inv(homography(undistort(corners, lens)))
    return projected(undistort(points, lens), np.asarray(to_screen))


def projected(points: FloatArray, matrix: FloatArray) -> FloatArray:
    """Points (..., 2) under a homography (3, 3)."""
    x, y, scale = np.moveaxis(points @ matrix[:, :2].T + matrix[:, 2], -1, 0)
    return np.stack([x / scale, y / scale], axis=-1)


def beside(corners: FloatArray, shares: FloatArray | float, lens: Lens | None) -> FloatArray:
    """(4, 2) corners whose left and right are moved to the right in the plane of the screen, by shares of its width."""
    moved = _SQUARE.copy()
    moved[:, 0] += np.broadcast_to(shares, 2)[[0, 1, 1, 0]]
    return screen_to_picture(moved, corners, lens)


def sides_off(corners: FloatArray, moved: FloatArray, lens: Lens | None) -> FloatArray:
    """(2,) shares of a screen's width by which left and right of corners `moved` lie to the right of its `corners`."""
    off = picture_to_screen(moved, corners, lens)[:, 0] - _SQUARE[:, 0]
    return np.array([off[[0, 3]].mean(), off[[1, 2]].mean()])


def carried(corners: FloatArray, before: FloatArray, after: FloatArray, lens: Lens | None) -> FloatArray:
    """(4, 2) corners moved as the plane whose corners moved from `before` to `after`, (4, 2) each."""
    return screen_to_picture(picture_to_screen(corners, before, lens), after, lens)


def column_outlines(
    corners: FloatArray, n_columns: int, n_strips: int, width: int, height: int, lens: Lens | None = None
) -> Outlines:
    """Outlines of `n_columns` columns of `n_strips` strips on a picture of `width` x `height`.

    Args:
        corners: (4, 2) pixels of the stored picture, the viewer's top-left first.
        n_columns: columns of the screen.
        n_strips: strips of each column.
        width: pixels a row.
        height: rows.
        lens: lens model of the picture.
    """
    points, v = _down_the_screen(np.linspace(0, 1, n_columns * n_strips + 1), corners, lens)
    top = int(np.clip(np.floor(corners[:, 1].min()), 0, height - 1))
    rows = np.arange(top, int(np.clip(np.ceil(corners[:, 1].max()), top, height - 1)) + 1)
    knots = np.append(rows[:-1:_KNOT_ROWS], rows[-1])
    step = 1 if points[0, -1, 1] > points[0, 0, 1] else -1  # On a screen upside down y falls with v.
    y, x = points[:, ::step, 1], points[:, ::step, 0]
    knot_x, knot_v = _interpolated(knots, y, x), _interpolated(knots, y, np.broadcast_to(v[::step], y.shape))
    edges_x = _between_knots(knot_x.astype(np.float32), knots)
    middle_v = _between_knots(((knot_v[1:] + knot_v[:-1]) / 2).astype(np.float32), knots)
    inside = (middle_v > 0) & (middle_v < 1)
    if knot_x.min() < 0 or knot_x.max() > width - 1:
        in_picture = (edges_x >= 0) & (edges_x <= width - 1)
        inside &= in_picture[1:] & in_picture[:-1]
    shape = (-1, n_strips, rows.size)
    sensor_row = None
    if lens is not None and lens.corrected:
        sensor_row = _between_knots(_sensor_rows(knot_x, knots, lens), knots).reshape(shape)
    return Outlines(rows, edges_x, inside.reshape(shape), sensor_row)


def column_middles(corners: FloatArray, n_columns: int, lens: Lens | None) -> FloatArray:
    """(C, n) rows of the same points down the middle of each column, from a little above the screen to below it."""
    return _down_the_screen((np.arange(n_columns) + 0.5) / n_columns, corners, lens)[0][..., 1]


def _down_the_screen(u: FloatArray, corners: FloatArray, lens: Lens | None) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, m, 2) of points down the screen at each u (n,), from a little above it to below it, and their v."""
    v = np.linspace(-_OVERHANG, 1 + _OVERHANG, _N_POINTS)
    return screen_to_picture(np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1), corners, lens), v


def _interpolated(places: FloatArray | IntArray, known: FloatArray, values: FloatArray) -> FloatArray:
    """(n, K) linear interpolation of `values` (n, P) from ascending `known` (n, P) to the `places` (K,)."""
    return np.stack([np.interp(places, *line) for line in zip(known, values, strict=True)])


def rows_elsewhere(rows: FloatArray, here: FloatArray, there: FloatArray) -> Float32Array:
    """Map successive `rows` (R,) of each column to (C, R) rows, by points `here` (C, n) that map to `there` (C, n).

    Rows beyond the points are extrapolated with the mean slope.
    """
    if here[0, -1] < here[0, 0]:
        here, there = here[:, ::-1], there[:, ::-1]
    knots = np.append(rows[:-1:_KNOT_ROWS], rows[-1])
    start, end = here[:, :1], here[:, -1:]
    slope = (there[:, -1:] - there[:, :1]) / (end - start)
    found = _interpolated(knots, here, there) + slope * (np.minimum(knots - start, 0) + np.maximum(knots - end, 0))
    # Single precision suffices for rows of a picture.
    return _between_knots(found.astype(np.float32), knots)


def _between_knots(values: NDArray[_Real], knots: FloatArray | IntArray) -> NDArray[_Real]:
    """(n, rows) linear interpolation of values (n, knots) from the first knot to the last, in their own precision."""
    # Beyond the last knot the line is level; of its interval, and of the shorter one before, only some rows are used.
    slope = np.diff(values, append=values[:, -1:]) / np.diff(knots, append=knots[-1] + 1).astype(values.dtype)
    between = values[..., None] + slope[..., None] * np.arange(_KNOT_ROWS, dtype=values.dtype)
    return np.asarray(between.reshape(len(values), -1)[:, : int(knots[-1] - knots[0]) + 1], values.dtype)


def _sensor_rows(edges_x: FloatArray, knots: IntArray, lens: Lens) -> FloatArray:
    """(n_edges - 1, knots) sensor row in the middle of each strip of a picture corrected in the camera."""
    middle_x = (edges_x[1:] + edges_x[:-1]) / 2
    pixels = np.stack([middle_x, np.broadcast_to(knots.astype(np.float64), middle_x.shape)], axis=-1)
    return distort(pixels, lens)[..., 1]
