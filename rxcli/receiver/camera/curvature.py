"""The bend of the stripes in a picture whose lens distortion was taken out in the camera."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.strips import Strips, soft_sign
from rxcli.types import Float32Array, FloatArray


def reversed_curvature(curvature: FloatArray) -> FloatArray:
    """The coefficients of the same bend with rows counted from the other end."""
    return np.asarray(curvature * np.array([1.0, 1.0, -1.0, 1.0]))


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


def estimate_curvature(strips: Strips, level: Float32Array) -> tuple[FloatArray, float]:
    """The bend whose sensor rows make neighbouring strips most similar.

    Args:
        strips: of the picture.
        level: (M, R) their levelled light.

    Returns:
        (4,) k1 k2 p1 p2 for a focal length of one picture width; and its log-likelihood over that of no bend.
    """
    n_lags = max(SETTINGS.min_bend_lags, round(SETTINGS.bend_lag_rows / strips.pitch))
    per_column = level.shape[0] // strips.n_columns
    distances = sorted({1, per_column})
    if strips.rows.size < 2 * n_lags + SETTINGS.bend_windows or level.shape[0] <= per_column:
        return np.zeros(4), 0.0
    signs = soft_sign(level)
    lags = [_lag_correlations(strips, signs, distance, n_lags) for distance in distances]
    unbent = sum(float(correlation[n_lags].sum()) for correlation, _ in lags)
    if unbent <= 0:
        return np.zeros(4), 0.0
    weight = SETTINGS.bend_weight / unbent
    k1 = np.linspace(-SETTINGS.k1_sd, SETTINGS.k1_sd, SETTINGS.k1_steps)
    best, gain = np.zeros(4), 0.0
    for share in SETTINGS.k2_shares:
        direction = np.array([1.0, -share, 0.0, 0.0])
        likeness = np.zeros(k1.size)
        for correlation, terms in lags:
            likeness += _at_lags(correlation, np.multiply.outer(k1, np.tensordot(direction, terms, 1) / strips.pitch))
        score = weight * (likeness - unbent) - 0.5 * (k1 / SETTINGS.k1_sd) ** 2
        at, highest = _peak(score)
        if highest > gain:
            best, gain = float(np.interp(at, np.arange(k1.size), k1)) * direction, highest
    return best, gain


def _peak(values: FloatArray) -> tuple[float, float]:
    """Place and height of the highest value, by a parabola through its neighbours."""
    at = int(np.clip(values.argmax(), 1, values.size - 2))
    before, here, after = values[at - 1 : at + 2]
    bend = before - 2 * here + after
    if bend >= 0:
        return float(values.argmax()), float(values.max())
    offset = float(np.clip(0.5 * (before - after) / bend, -1, 1))
    return at + offset, float(here - 0.25 * (before - after) * offset)


def _lag_correlations(
    strips: Strips, level: Float32Array, distance: int, n_lags: int
) -> tuple[Float32Array, FloatArray]:
    """Correlation of strips `distance` apart by lag, strip and window of rows; and the lag that a unit of bend makes.

    Returns:
        (2 n_lags + 1, strips, windows) float32; (4, strips, windows) float64 picture rows.
    """
    n_rows = level.shape[1]
    borders = np.linspace(n_lags, n_rows - n_lags, SETTINGS.bend_windows + 1).astype(int)
    middles = (borders[1:] + borders[:-1]) // 2
    terms = curvature_terms(strips.x[:, middles], strips.rows[middles], strips.width, strips.height)
    left, right = level[:-distance], level[distance:]
    out = np.empty((2 * n_lags + 1, left.shape[0], SETTINGS.bend_windows), np.float32)
    for number, (first, end) in enumerate(pairwise(borders.tolist())):
        later = np.lib.stride_tricks.sliding_window_view(right[:, first - n_lags : end + n_lags], end - first, axis=1)
        out[::-1, :, number] = np.einsum("skr,sr->ks", later, left[:, first:end])
    return out, terms[:, distance:] - terms[:, :-distance]


def _at_lags(correlation: Float32Array, lag: FloatArray) -> FloatArray:
    """(K,) sums of a correlation (lags, strips, windows) at fractional lags (K, strips, windows).

    By a Catmull-Rom cubic.
    """
    place = np.clip(lag + (correlation.shape[0] - 1) / 2, 1, correlation.shape[0] - 2.001).astype(np.float32)
    low = place.astype(np.int64)
    f = place - low
    size = correlation[0].size
    index = low * size + np.arange(size).reshape(lag.shape[1:])
    flat = correlation.ravel()
    a, b, c, d = (flat.take(index + k * size) for k in (-1, 0, 1, 2))
    linear, square, cubic = (c - a) / 2, a - 2.5 * b + 2 * c - 0.5 * d, 1.5 * (b - c) + 0.5 * (d - a)
    return np.asarray((b + f * (linear + f * (square + f * cubic))).sum(axis=(1, 2), dtype=np.float64))


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
