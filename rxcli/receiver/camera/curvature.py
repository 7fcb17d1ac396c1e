"""The bend of the stripes in a picture whose lens distortion was taken out in the camera."""

import numpy as np

from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.strips import ColumnStrips
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


#: k1 k2 p1 p2 of a unit of bend: lenses bend back further out, k2 is about -k1.
UNIT_BEND: FloatArray = np.array([1.0, -1.0, 0.0, 0.0])
#: Inverse covariance of k1 k2 p1 p2 before the picture is seen.
LENS_PRECISION: FloatArray = np.diag(np.array([0.3, 0.6, 1.5e-3, 1.5e-3]) ** -2.0 * [1, 0, 1, 1])
LENS_PRECISION[:2, :2] += 0.2**-2


def tried_bends(strips: ColumnStrips) -> FloatArray:
    """(B, 1) bends of the stripes that are tried, in units of `UNIT_BEND`; none is in the middle."""
    most = SETTINGS.max_bend
    return (np.linspace(-most, most, SETTINGS.n_bends) if strips.may_bend else np.zeros(1))[:, None]


def straightened(strips: ColumnStrips, level: Float32Array, curvature: FloatArray) -> Float32Array:
    """(M, R) levelled light read along the bent stripes: every row of the result is one sensor row, 0 out of view."""
    return _moved(level, _moved_rows(strips, 1, curvature)) if curvature.any() else level


def likeliest_bend(strips: ColumnStrips, level: Float32Array) -> FloatArray:
    """(4,) bend, other than none, under which the levelled light (M, R) of neighbouring columns is most similar."""
    strips_per_column = level.shape[0] // strips.n_columns
    level = np.ascontiguousarray(level[::strips_per_column])
    moved = _moved_rows(strips, strips_per_column, UNIT_BEND)
    bends = tried_bends(strips)[1::2, 0]
    straight = (_moved(level, np.float32(size) * moved) for size in bends)
    return np.asarray(bends[np.argmax([(light[:-1] * light[1:]).sum() for light in straight])] * UNIT_BEND)


def _moved_rows(strips: ColumnStrips, step: int, curvature: FloatArray) -> Float32Array:
    """(M / step, R) rows by which a bend moves every row of each `step`-th strip."""
    terms = curvature_terms(strips.x[::step], strips.rows, strips.width, strips.height)
    return np.asarray(np.tensordot(curvature, terms, 1) / strips.pitch, np.float32)


def _moved(level: Float32Array, moved: Float32Array) -> Float32Array:
    """Row r shows sensor row r + moved(r); sensor row s is found at s - moved(s), to first order of a small slope."""
    # Flat places: take_along_axis makes as many index arrays as there are axes.
    index, start = np.arange(level.shape[1], dtype=np.float32), level.shape[1] * np.arange(len(level))[:, None]
    nearest = np.rint(index - moved).clip(0, index[-1]).astype(np.intp)
    back = moved.take(nearest + start)
    place = (index - back).clip(0, index[-1])
    low = np.minimum(place.astype(np.intp), level.shape[1] - 2)
    below, above = level.take(low + start), level.take(low + start + 1)
    out = below + (above - below) * (place - low.astype(np.float32))
    return np.asarray(out * (np.abs(index - back - place) < 0.5), np.float32)
