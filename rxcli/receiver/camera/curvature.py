"""The bend of the stripes in a picture whose lens distortion was taken out in the camera."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.strips import Strips, levelled
from rxcli.types import Float32Array, FloatArray

#: Scale of the coefficients k1 k2 p1 p2 for a focal length of one picture width, as a camera may have them.
BEND_SCALE = np.array([0.3, 0.6, 1.5e-3, 1.5e-3])
#: (4, 4) inverse covariance of the coefficients before the picture was seen.
BEND_PRECISION: FloatArray = np.diag(BEND_SCALE**-2 * [1, 0, 1, 1])
BEND_PRECISION[:2, :2] += SETTINGS.bend_back_sd**-2


def reversed_curvature(curvature: FloatArray) -> FloatArray:
    """The coefficients of the same bend with rows counted from the other end."""
    return np.asarray(curvature * np.array([1.0, 1.0, -1.0, 1.0]))


def curvature_terms(x: FloatArray, rows: FloatArray, width: int, height: int) -> FloatArray:
    """Rows that a unit of k1, k2, p1, p2 moves the sensor row of a point, for a focal length of one width.

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


def estimate_curvature(strips: Strips) -> tuple[FloatArray, float]:
    """The bend whose sensor rows make neighbouring strips most alike.

    Returns:
        (4,) k1 k2 p1 p2 for a focal length of one width; and how much better it fits than none, nats.
    """
    level = levelled(strips.light, strips.inside, SETTINGS.bend_level_rows, strips.noise)[0]
    lags = [_lag_correlations(strips, level, distance) for distance in strip_distances(strips)]
    total = sum(float(correlation[SETTINGS.bend_lags].sum()) for correlation, _ in lags)
    if not lags or total <= 0:
        return np.zeros(4), 0.0
    # The sum of correlations is worth about this many nats: rows times strips, many of which say the same.
    weight = 4000.0 / total
    k1, share = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.4, 0.4, 25), [0.0, 0.8, 1.8]))
    guesses = np.stack([k1, -share * k1, 0 * k1, 0 * k1], axis=1)
    correlation, terms = lags[-1]
    along = _at_lag(correlation, np.tensordot(guesses, terms, 1))[0].sum(axis=(1, 2))
    scores = weight * along - 0.5 * ((guesses @ BEND_PRECISION) * guesses).sum(axis=1)
    found = _climb(guesses[int(np.argmax(scores))], lags, weight)
    return found, _likeness(found, lags, weight) - _likeness(np.zeros(4), lags, weight)


def strip_distances(strips: Strips) -> list[int]:
    per_column = strips.light.shape[0] // strips.n_columns
    steps = {max(1, round(distance * per_column)) for distance in SETTINGS.bend_distances}
    n_strips, n_rows = strips.light.shape
    if n_rows < 2 * SETTINGS.bend_lags + SETTINGS.bend_windows:
        return []
    return sorted(step for step in steps if step < n_strips)


def _lag_correlations(strips: Strips, level: Float32Array, distance: int) -> tuple[Float32Array, FloatArray]:
    """Correlation of levelled strips `distance` apart by lag, strip and window of rows; what lag a unit of bend makes.

    Returns:
        (lags, strips, windows) float32; (4, strips, windows) float64 rows.
    """
    n_rows, most = strips.light.shape[1], SETTINGS.bend_lags
    borders = np.linspace(most, n_rows - most, SETTINGS.bend_windows + 1).astype(int)
    middles = (borders[1:] + borders[:-1]) // 2
    terms = curvature_terms(strips.x[:, middles], strips.rows[middles], strips.width, strips.height)
    left, right = level[:-distance], level[distance:]
    out = np.empty((2 * most + 1, left.shape[0], SETTINGS.bend_windows), np.float32)
    for number, (first, end) in enumerate(pairwise(borders.tolist())):
        later = np.lib.stride_tricks.sliding_window_view(right[:, first - most : end + most], end - first, axis=1)
        out[::-1, :, number] = np.einsum("skr,sr->ks", later, left[:, first:end])
    return out, terms[:, distance:] - terms[:, :-distance]


def _at_lag(correlation: Float32Array, lag: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Correlation (lags, strips, windows) at fractional lags (..., strips, windows) with first and second derivative.

    By a Catmull-Rom cubic.
    """
    place = np.clip(lag + (correlation.shape[0] - 1) / 2, 1, correlation.shape[0] - 2.001)
    low = place.astype(np.int64)
    f = place - low
    size = correlation[0].size
    index = low * size + np.arange(size).reshape(correlation.shape[1:])
    flat = correlation.ravel()
    a, b, c, d = (flat.take(index + k * size).astype(np.float64) for k in (-1, 0, 1, 2))
    linear, square, cubic = (c - a) / 2, a - 2.5 * b + 2 * c - 0.5 * d, 1.5 * (b - c) + 0.5 * (d - a)
    value = b + f * (linear + f * (square + f * cubic))
    return value, linear + f * (2 * square + 3 * f * cubic), a - 2 * b + c


def _likeness(curvature: FloatArray, lags: list[tuple[Float32Array, FloatArray]], weight: float) -> float:
    total = sum(float(_at_lag(c, np.tensordot(curvature, terms, 1))[0].sum()) for c, terms in lags)
    return weight * total - 0.5 * float(curvature @ BEND_PRECISION @ curvature)


def _climb(
    curvature: FloatArray, lags: list[tuple[Float32Array, FloatArray]], weight: float, steps: int = 8
) -> FloatArray:
    """Newton's method on the likeness, with the prior of `BEND_PRECISION`; never downhill."""
    best, score = curvature, _likeness(curvature, lags, weight)
    step = 1.0
    for _ in range(steps):
        gradient, hessian = -BEND_PRECISION @ best, BEND_PRECISION.copy()
        for correlation, terms in lags:
            _, slope, curvature = _at_lag(correlation, np.tensordot(best, terms, 1))
            flat = terms.reshape(4, -1)
            gradient = gradient + weight * flat @ slope.ravel()
            hessian = hessian + weight * (flat * np.maximum(-curvature, 0).ravel()) @ flat.T
        trial = best + step * np.linalg.solve(hessian, gradient)
        trial_score = _likeness(trial, lags, weight)
        if trial_score > score:
            gain, best, score = trial_score - score, trial, trial_score
            if gain < SETTINGS.least_gain:
                break
        else:
            step /= 2
    return best


def straightened(strips: Strips, curvature: FloatArray) -> Strips:
    """The strips read along the bent stripes: every row of the result is one sensor row."""
    if not curvature.any():
        return strips
    moved = np.tensordot(curvature, curvature_terms(strips.x, strips.rows, strips.width, strips.height), 1)
    index = np.arange(strips.rows.size)
    # Row r shows sensor row r + moved(r); sensor row s is found at s - moved(s), to first order of a small slope.
    back = np.take_along_axis(moved, np.clip(np.rint(index - moved), 0, index[-1]).astype(np.int64), 1)
    place = np.clip(index - back, 0, index[-1] - 1e-6)
    low = place.astype(np.int64)
    f = (place - low).astype(np.float32)
    light = _between(strips.light, low, f)
    inside = (_between(strips.inside, low, f) > 0.99) & (np.abs(index - back - place) < 0.5)
    return replace(strips, light=light * inside, inside=inside.astype(np.float32))


def _between(values: Float32Array, low: NDArray[np.int64], f: Float32Array) -> Float32Array:
    below, above = (
        np.take_along_axis(values, low, 1),
        np.take_along_axis(values, np.minimum(low + 1, values.shape[1] - 1), 1),
    )
    return np.asarray(below + (above - below) * f, np.float32)
