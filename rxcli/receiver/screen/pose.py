"""The screen as a flat rectangle of known aspect before a camera: what the sides say of one another.

A pose has eight numbers: tilt, yaw, roll (rad), the centre's offset from the picture's middle (right, down, picture
widths), log of the width (picture widths), log of the focal length (picture widths), and one coefficient of radial
distortion, which bends all four sides. A quadrilateral has eight too, so that the assumptions on turn, focal length and
lens decide only where the sides leave a question open: a black side, or one that shows on a part of its length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.receiver.screen.sides import across
from rxcli.types import FloatArray

#: Typical tilt and yaw (rad), log of the focal length in picture widths with its spread, and distortion.
_TURN_SD = np.deg2rad(5)
_LOG_FOCAL, _LOG_FOCAL_SD = float(np.log(1.6)), 0.5
_DISTORTION_SD = 0.03
#: Neighbouring places of a side err together: this many count as one observation each, more add nothing.
INDEPENDENT = 30
_N, _TILT, _YAW, _FOCAL, _DISTORTION = 8, 0, 1, 6, 7
_EPSILON = 1e-6
#: Weight against a step of what the sides say little of: turn, focal length and distortion make up for one another.
_DAMPING = np.diag([1 / 0.05, 1 / 0.05, 0.0, 0.0, 0.0, 0.0, 1 / 0.15, 1 / 0.01]) ** 2
#: Largest step of one iteration in any of the eight; a step that moves no corner by this much is the last, pixels.
_LARGEST_STEP, _SMALLEST_MOVE = 0.25, 0.1


@dataclass(frozen=True, slots=True)
class Places:
    """Places of one side: (n,) along it and across it, pixels, and how well one is known."""

    t: FloatArray
    place: FloatArray
    sd: float


@dataclass(frozen=True, slots=True)
class Rectangle:
    """Size of the picture and aspect of the screen in it."""

    width: int
    height: int
    aspect: float

    @property
    def middle(self) -> FloatArray:
        """(2,) the picture's middle, pixels."""
        return np.array([(self.width - 1) / 2, (self.height - 1) / 2])

    def project(self, pose: FloatArray) -> FloatArray:
        """(..., 4, 2) corners of (..., 8) poses, pixels, before distortion."""
        tilt, yaw, roll, right, down, width, focal, _ = (pose[..., i, None] for i in range(_N))
        x = np.array([-0.5, 0.5, 0.5, -0.5])
        y = np.array([-0.5, -0.5, 0.5, 0.5]) / self.aspect
        x, y = x * np.cos(roll) - y * np.sin(roll), x * np.sin(roll) + y * np.cos(roll)
        x, z = x * np.cos(yaw), x * np.sin(yaw)
        y, z = y * np.cos(tilt) - z * np.sin(tilt), y * np.sin(tilt) + z * np.cos(tilt)
        scale = np.exp(width)
        near = (1 + z * scale * np.exp(-focal)) / self.width
        corners = np.empty((*near.shape, 2))
        corners[..., 0], corners[..., 1] = (x * scale + right) / near, (y * scale + down) / near
        return corners + self.middle

    def side_at(self, corners: FloatArray, distortion: FloatArray, side: int, t: FloatArray) -> FloatArray:
        """(..., n) places of a side at (n,) `t`, for (..., 4, 2) corners and (...,) distortions."""
        along = 0 if across(side) else 1
        a, b = corners[..., side, :], corners[..., (side + 1) % 4, :]
        slope = ((b - a)[..., 1 - along] / (b - a)[..., along])[..., None]
        place = a[..., 1 - along, None] + slope * (t - a[..., along, None])
        dt, dp = (t - self.middle[along]) / self.width, (place - self.middle[1 - along]) / self.width
        bend = np.asarray(distortion)[..., None] * (dt * dt + dp * dp) * (dp - slope * dt)
        return np.asarray(place + self.width * bend)


def _prior(pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals of a pose against what is usual, and their slopes."""
    index = [_TILT, _YAW, _FOCAL, _DISTORTION]
    sd = np.array([_TURN_SD, _TURN_SD, _LOG_FOCAL_SD, _DISTORTION_SD])
    residual = (pose[index] - [0.0, 0.0, _LOG_FOCAL, 0.0]) / sd
    return residual, np.eye(_N)[index] / sd[:, None]


def pose_of(corners: FloatArray, rectangle: Rectangle) -> FloatArray:
    """The pose whose corners are nearest to (4, 2) given ones."""
    edge = corners[1] - corners[0] + corners[2] - corners[3]
    offset = (corners.mean(axis=0) - rectangle.middle) / rectangle.width
    size = float(np.linalg.norm(edge)) / 2
    width = np.log(size / rectangle.width)
    start = np.array([0.0, 0.0, np.arctan2(edge[1], edge[0]), *offset, width, _LOG_FOCAL, 0.0])
    return fit_pose([None] * 4, corners, 0.004 * size, start, rectangle, 4)


def misfit(places: list[Places | None], pose: FloatArray, rectangle: Rectangle) -> float:
    """Sum of squares of what a pose leaves of the places and of what is usual, in standard deviations."""
    total = float((_prior(pose)[0] ** 2).sum())
    corners = rectangle.project(pose)
    for side, observed in enumerate(places):
        if observed is not None:
            left = observed.place - rectangle.side_at(corners, pose[_DISTORTION], side, observed.t)
            total += float((left**2).mean()) * min(observed.t.size, INDEPENDENT) / observed.sd**2
    return total


def fit_pose(
    places: list[Places | None], corners: FloatArray, sd: float, start: FloatArray, rectangle: Rectangle, steps: int
) -> FloatArray:
    """The likeliest pose, by Gauss-Newton.

    Args:
        places: places of each side; None: not seen.
        corners: (4, 2) where the corners are expected, pixels.
        sd: how well that is known, pixels.
        start: (8,) first guess.
        rectangle: picture and screen.
        steps: iterations, at most.
    """
    pose = start
    for _ in range(steps):
        residual, slopes = _prior(pose)
        normal, gradient = slopes.T @ slopes, slopes.T @ residual
        poses = np.vstack([pose, pose + _EPSILON * np.eye(_N)])
        projected = rectangle.project(poses)
        terms = [(projected.reshape(_N + 1, -1), corners.ravel(), sd**-2.0)]
        for side, seen in enumerate(places):
            if seen is not None:
                weight = seen.sd**-2.0 / (1 + seen.t.size / INDEPENDENT)
                terms.append((rectangle.side_at(projected, poses[:, _DISTORTION], side, seen.t), seen.place, weight))
        for model, observed, weight in terms:
            slopes = (model[1:] - model[0]) / _EPSILON
            normal = normal + weight * (slopes @ slopes.T)
            gradient = gradient - weight * (slopes @ (observed - model[0]))
        try:
            step = np.linalg.solve(normal + _DAMPING, gradient)
        except np.linalg.LinAlgError:
            # Sides that are no screen's led the pose astray; whether it has the shape of one is judged later.
            break
        step = np.clip(step, -_LARGEST_STEP, _LARGEST_STEP)
        pose = pose - step
        if np.abs(step @ (terms[0][0][1:] - terms[0][0][0])).max() < _SMALLEST_MOVE * _EPSILON:
            break
    return np.asarray(pose, np.float64)
