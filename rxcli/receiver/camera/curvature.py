"""The bend of the stripes in a picture whose lens distortion was taken out in the camera."""

from __future__ import annotations

import numpy as np

from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.strips import Strips
from rxcli.types import Float32Array, FloatArray


def curvature_terms(x: FloatArray, rows: FloatArray, width: int, height: int) -> FloatArray:
    """Rows that a unit of k1, k2, p1, p2 moves the sensor row of a point, for a focal length of one picture width.

    Args:
        x: (...) picture x.
        rows: (...) picture rows, broadcast against `x`.
        width: of the picture.
        height: of the picture.

    Returns:
        (4, ...) float64.
    """
    across, down = np.broadcast_arrays((x - (width - 1) / 2) / width, (rows - (height - 1) / 2) / width)
    square = across**2 + down**2
    return width * np.stack([down * square, down * square**2, square + 2 * down**2, 2 * across * down])


def straightened(strips: Strips, level: Float32Array, curvature: FloatArray) -> Float32Array:
    """(M, R) levelled light read along the bent stripes: every row of the result is one sensor row, 0 out of view."""
    if not curvature.any():
        return level
    terms = curvature_terms(strips.x, strips.rows, strips.width, strips.height)
    moved = np.tensordot(curvature, terms, 1) / strips.pitch
    index = np.arange(strips.rows.size)
    # Row r shows sensor row r + moved(r); sensor row s is found at s - moved(s), to first order of a small slope.
    back = np.take_along_axis(moved, np.clip(np.rint(index - moved), 0, index[-1]).astype(np.int64), 1)
    place = np.clip(index - back, 0, index[-1] - 1e-6)
    low = place.astype(np.int64)
    below, above = np.take_along_axis(level, low, 1), np.take_along_axis(level, low + 1, 1)
    out = below + (above - below) * (place - low).astype(np.float32)
    return np.asarray(out * (np.abs(index - back - place) < 0.5), np.float32)


def likeliest_bend(strips: Strips, level: Float32Array) -> FloatArray:
    """(4,) bend, other than none, under which the levelled light (M, R) of neighbouring columns is most similar."""
    # Lenses bend back further out: k2 is about -k1.
    bends = np.linspace(-SETTINGS.max_bend, SETTINGS.max_bend, 16)[:, None] * np.array([1.0, -1.0, 0.0, 0.0])
    straight = (straightened(strips, level, bend) for bend in bends)
    column = level.shape[0] // strips.n_columns
    return np.asarray(bends[np.argmax([(light[:-column] * light[column:]).sum() for light in straight])])
