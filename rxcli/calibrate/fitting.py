"""Means, grids and lens models that several calibrations need."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rxcli.profiles import LensModel
from rxcli.types import FloatArray

#: Residual, in standard deviations, from which values weigh less (Huber).
_HUBER = 1.5


@dataclass(frozen=True, slots=True)
class ConvertedLens:
    """The receiver's lens model, from a model of another kind."""

    lens: LensModel
    #: Largest distance between the points of both models over the picture, pixels.
    worst_px: float
    #: Names there; empty where there are none.
    camera: str
    lens_name: str


def weighted_mean(values: ArrayLike, sds: ArrayLike) -> tuple[float, float]:
    """Mean of values (n,) with standard deviations (n,), with Huber's weights, and its standard deviation.

    The latter is enlarged where the values scatter more than their standard deviations allow.
    """
    y = np.asarray(values, np.float64)
    sd = np.maximum(np.asarray(sds, np.float64), 1e-12 * np.abs(y))
    mean = float(np.median(y))
    for _ in range(20):
        weights = sd**-2.0 * np.minimum(1, _HUBER * sd / np.maximum(np.abs(y - mean), 1e-300))
        mean = float(weights @ y / weights.sum())
    scatter = float(weights @ (y - mean) ** 2) / max(y.size - 1, 1)
    return mean, float(np.sqrt(max(scatter, 1.0) / weights.sum()))


def grid_points(size: tuple[int, int], counts: tuple[int, int]) -> FloatArray:
    """(n, 2) positions all over a picture of width and height `size`, pixels; `counts` across and down."""
    x, y = np.meshgrid(*(np.linspace(0, side - 1, n) for side, n in zip(size, counts, strict=True)))
    return np.column_stack([x.ravel(), y.ravel()])


def fit_distortion(
    rays: FloatArray, points: FloatArray, focal: ArrayLike, centre: ArrayLike, size: tuple[int, int]
) -> tuple[LensModel, float]:
    """OpenCV's radial model that leads from rays to distorted points.

    With `r = |ray|`, a point is `s * ray * (1 + k1 r^2 + k2 r^4 + k3 r^6)`: linear in `s, s k1, s k2, s k3`. The scale
    `s` goes into the focal length.

    Args:
        rays: (n, 2) directions, x and y at depth 1.
        points: (n, 2) the same for the distorted points.
        focal: focal lengths along x and y, pixels.
        centre: x and y of the optical axis, pixels.
        size: width and height of the picture, pixels.

    Returns:
        The model and the largest deviation over the points, pixels.
    """
    fx, fy = np.broadcast_to(np.asarray(focal, np.float64), 2).tolist()
    cx, cy = np.asarray(centre, np.float64).tolist()
    radius = np.linalg.norm(rays, axis=1, keepdims=True)
    reach = float(radius.max())
    design = (rays[:, :, None] * (radius[:, :, None] / reach) ** [0, 2, 4, 6]).reshape(-1, 4)
    weights = np.linalg.lstsq(design, points.ravel(), rcond=None)[0]
    deviation = ((design @ weights).reshape(-1, 2) - points) * [fx, fy]
    scale, k1, k2, k3 = (weights / reach ** np.array([0, 2, 4, 6]) / [1, *weights[[0, 0, 0]]]).tolist()
    matrix = ((scale * fx, 0.0, cx), (0.0, scale * fy, cy), (0.0, 0.0, 1.0))
    lens = LensModel(width=size[0], height=size[1], camera_matrix=matrix, dist_coeffs=(k1, k2, 0.0, 0.0, k3))
    return lens, float(np.linalg.norm(deviation, axis=1).max())
