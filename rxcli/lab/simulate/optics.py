"""Pose and lens: where a place of the screen falls on the sensor, and back.

Screen places are (u, v), 0..1 from the top-left corner as a viewer sees the screen. Sensor places are pixels, integers
at pixel centres. The lens is the pinhole model with OpenCV's k1 k2 p1 p2 k3, written out here on its own.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from rxcli.profiles import ScreenProfile

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
#: Of the screen (u, v): top-left first, clockwise for a viewer.
CORNERS = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])


@dataclass(frozen=True)
class Lens:
    """Focal length in picture widths, and distortion."""

    #: Focal length over the picture's width.
    focal_widths: float = 1.5
    #: k1 k2 p1 p2 k3.
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Pose:
    """Where the screen stands before the camera."""

    #: Share of the picture's width that the screen would fill, seen straight on; sets the distance.
    fill: float = 0.93
    roll_deg: float = 0.0
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    #: Shift of the screen's centre on the sensor, in picture widths and heights.
    shift_x: float = 0.0
    shift_y: float = 0.0
    #: Four sensor corners (top-left first, clockwise as a viewer sees the screen); where given, they rule alone.
    corners: tuple[tuple[float, float], ...] | None = None


def distort(points: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Where the lens moves ideal normalised points (n, 2); Brown's model, OpenCV's order of coefficients."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y],
        axis=-1,
    )


def undistort(points: FloatArray, coefficients: FloatArray, iterations: int = 12) -> FloatArray:
    """The inverse of `distort`, by Newton's method with a numeric Jacobian.

    Far outside the picture a lens polynomial may fold back, where the determinant vanishes: there it counts as
    positive and steps are short, so that places stay finite.
    """
    ideal = np.array(points, np.float64)
    if not np.any(coefficients):
        return ideal
    step = 1e-6
    along_x, along_y = np.array([step, 0.0]), np.array([0.0, step])
    for _ in range(iterations):
        here = distort(ideal, coefficients)
        jx = (distort(ideal + along_x, coefficients) - here) / step
        jy = (distort(ideal + along_y, coefficients) - here) / step
        missing = points - here
        if np.abs(missing).max() < 1e-13:
            break
        det = jx[..., 0] * jy[..., 1] - jx[..., 1] * jy[..., 0]
        det = np.where(np.abs(det) < 0.05, 0.05, det)
        dx = (missing[..., 0] * jy[..., 1] - missing[..., 1] * jy[..., 0]) / det
        dy = (missing[..., 1] * jx[..., 0] - missing[..., 0] * jx[..., 1]) / det
        ideal += np.clip(np.stack([dx, dy], axis=-1), -0.5, 0.5)
    return ideal


def rotation(roll_deg: float, yaw_deg: float, pitch_deg: float) -> FloatArray:
    """Rotation matrix: yaw about the vertical, then pitch about the horizontal, then roll about the line of sight."""
    (cr, sr), (cy, sy), (cp, sp) = ((np.cos(a), np.sin(a)) for a in np.deg2rad([roll_deg, yaw_deg, pitch_deg]))
    about_z = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return np.asarray(about_z @ about_x @ about_y)


def homography(source: FloatArray, target: FloatArray) -> FloatArray:
    """(3, 3) projective map that takes four points (4, 2) onto four others."""
    rows = []
    for (x, y), (a, b) in zip(source, target, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -a * x, -a * y], [0, 0, 0, x, y, 1, -b * x, -b * y]]
    solution = np.linalg.solve(np.array(rows), np.asarray(target).ravel())
    return np.append(solution, 1.0).reshape(3, 3)


def project(matrix: FloatArray, points: FloatArray) -> FloatArray:
    """Apply a projective map (3, 3) to points (..., 2)."""
    homogeneous = points @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(homogeneous[..., :2] / homogeneous[..., 2:])


def grid_nodes(width: int, pitch: int) -> FloatArray:
    """Nodes that `cv2.resize` by `pitch` lays on pixel centres, with one cell to spare on either side."""
    return np.arange(-1, -(-width // pitch) + 1, dtype=np.float64) * pitch + (pitch - 1) / 2


def between_nodes(nodes: Float32Array, pitch: int, height: int, width: int) -> Float32Array:
    """(height, width[, k]) values at all pixels, from those at `grid_nodes` down and across."""
    size = (nodes.shape[1] * pitch, nodes.shape[0] * pitch)
    full = cv2.resize(nodes, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(full[pitch : pitch + height, pitch : pitch + width])


@dataclass(frozen=True)
class View:
    """The screen as one camera sees it."""

    screen: ScreenProfile
    lens: Lens
    pose: Pose
    width: int
    height: int
    #: Height of a pixel over its width.
    pixel_aspect: float = 1.0

    @cached_property
    def camera_matrix(self) -> FloatArray:
        """(3, 3) pinhole camera matrix, pixels."""
        focal = self.lens.focal_widths * self.width
        x, y = (self.width - 1) / 2, (self.height - 1) / 2
        return np.array([[focal, 0, x], [0, focal / self.pixel_aspect, y], [0, 0, 1.0]])

    @cached_property
    def coefficients(self) -> FloatArray:
        """(5,) k1 k2 p1 p2 k3."""
        return np.array(self.lens.distortion, np.float64)

    @cached_property
    def to_normalised(self) -> FloatArray:
        """(3, 3) projective map from screen places (u, v) to ideal normalised camera coordinates."""
        if self.pose.corners is not None:
            ideal = self.pixels_to_ideal(np.array(self.pose.corners, np.float64))
            return homography(CORNERS, ideal)
        size = np.array([self.screen.width_mm, self.screen.height_mm])
        matrix = self.camera_matrix
        distance = matrix[0, 0] * size[0] / (self.pose.fill * self.width)
        shift_px = np.array([self.pose.shift_x * self.width, self.pose.shift_y * self.height])
        shift = shift_px / matrix[[0, 1], [0, 1]]
        axes = rotation(self.pose.roll_deg, self.pose.yaw_deg, self.pose.pitch_deg)[:, :2] * size
        centre = np.append(shift * distance, distance) - axes.sum(axis=1) / 2
        return np.column_stack([axes, centre])

    def pixels_to_ideal(self, pixels: FloatArray) -> FloatArray:
        """Ideal normalised coordinates of sensor places (..., 2)."""
        matrix = self.camera_matrix
        return undistort((pixels - matrix[:2, 2]) / matrix[[0, 1], [0, 1]], self.coefficients)

    def ideal_to_pixels(self, points: FloatArray) -> FloatArray:
        """Sensor places of ideal normalised points (..., 2)."""
        matrix = self.camera_matrix
        return np.asarray(distort(points, self.coefficients) * matrix[[0, 1], [0, 1]] + matrix[:2, 2])

    def screen_to_pixels(self, places: FloatArray) -> FloatArray:
        """Sensor places (..., 2) of screen places (u, v)."""
        return self.ideal_to_pixels(project(self.to_normalised, places))

    def pixels_to_screen(self, pixels: FloatArray) -> FloatArray:
        """Screen places (u, v) of sensor places (..., 2); the inverse of `screen_to_pixels`."""
        inverse = np.asarray(np.linalg.inv(self.to_normalised), np.float64)
        return project(inverse, self.pixels_to_ideal(pixels))

    @cached_property
    def corners(self) -> FloatArray:
        """(4, 2) sensor places of the screen's corners, top-left first, clockwise for a viewer."""
        return self.screen_to_pixels(CORNERS)

    @cached_property
    def pixels_per_width(self) -> float:
        """Sensor pixels across the screen, along its middle."""
        ends = self.screen_to_pixels(np.array([[0.0, 0.5], [1, 0.5]]))
        return float(np.hypot(*(ends[1] - ends[0])))

    @cached_property
    def pixels_per_height(self) -> float:
        """Sensor pixels along the screen's height, through its middle."""
        ends = self.screen_to_pixels(np.array([[0.5, 0.0], [0.5, 1.0]]))
        return float(np.hypot(*(ends[1] - ends[0])))
