"""The bend of the stripes in a picture whose lens distortion was taken out in the camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
    distances = strip_distances(strips)
    if not distances:
        return np.zeros(4), 0.0
    level = levelled(strips.light, strips.inside, SETTINGS.bend_level_rows, strips.noise)[0]
    pairs = [_lag_correlations(strips, level, distance) for distance in distances]
    total = sum(float(one.correlation[SETTINGS.bend_lags].sum()) for one in pairs)
    if total <= 0:
        return np.zeros(4), 0.0
    # The sum of correlations is worth about this many nats: rows times strips, many of which say the same.
    weight = 4000.0 / total
    k1, share = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.4, 0.4, 25), [0.0, 0.8, 1.8]))
    guesses = np.stack([k1, -share * k1, 0 * k1, 0 * k1], axis=1)
    along = pairs[-1].at_lag(np.tensordot(guesses, pairs[-1].terms, 1))[0].sum(axis=(1, 2))
    scores = weight * along - 0.5 * ((guesses @ BEND_PRECISION) * guesses).sum(axis=1)
    every = _Lags(
        np.concatenate([one.correlation for one in pairs], axis=1), np.concatenate([one.terms for one in pairs], axis=1)
    )
    found, likeness = _climb(guesses[int(np.argmax(scores))], every, weight)
    return found, likeness - _likeness(np.zeros(4), every, weight)[0]


def strip_distances(strips: Strips) -> list[int]:
    per_column = strips.light.shape[0] // strips.n_columns
    steps = {max(1, round(distance * per_column)) for distance in SETTINGS.bend_distances}
    n_strips, n_rows = strips.light.shape
    if n_rows < 2 * SETTINGS.bend_lags + SETTINGS.bend_windows:
        return []
    return sorted(step for step in steps if step < n_strips)


@dataclass(frozen=True, slots=True)
class _Lags:
    """How alike pairs of strips are at every lag."""

    #: (lags, pairs, windows) correlation by lag, pair and window of rows.
    correlation: Float32Array
    #: (4, pairs, windows) rows of lag that a unit of bend makes.
    terms: FloatArray

    def at_lag(self, lag: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Correlation at fractional lags (..., pairs, windows) with first and second derivative.

        By a Catmull-Rom cubic.
        """
        n_lags, size = self.correlation.shape[0], self.correlation[0].size
        place = np.clip(lag + (n_lags - 1) / 2, 1, n_lags - 2.001)
        low = place.astype(np.int64)
        f = place - low
        index = low * size + np.arange(size).reshape(self.correlation.shape[1:])
        flat = self.correlation.ravel()
        a, b, c, d = (flat.take(index + k * size).astype(np.float64) for k in (-1, 0, 1, 2))
        linear, square, cubic = (c - a) / 2, a - 2.5 * b + 2 * c - 0.5 * d, 1.5 * (b - c) + 0.5 * (d - a)
        value = b + f * (linear + f * (square + f * cubic))
        return value, linear + f * (2 * square + 3 * f * cubic), a - 2 * b + c


def _lag_correlations(strips: Strips, level: Float32Array, distance: int) -> _Lags:
    """Of strips `distance` apart, by their levelled light (M, R)."""
    most, n_windows = SETTINGS.bend_lags, SETTINGS.bend_windows
    length = (level.shape[1] - 2 * most) // n_windows
    middles = most + length * np.arange(n_windows) + length // 2
    terms = curvature_terms(strips.x[:, middles], strips.rows[middles], strips.width, strips.height)

    def windows(light: Float32Array, lag: int) -> Float32Array:
        return light[:, most - lag :][:, : n_windows * length].reshape(len(light), n_windows, length)

    left, right = windows(level[:-distance], 0), level[distance:]
    out = np.stack([np.einsum("pwr,pwr->pw", left, windows(right, lag)) for lag in range(-most, most + 1)])
    return _Lags(out, terms[:, distance:] - terms[:, :-distance])


def _likeness(curvature: FloatArray, lags: _Lags, weight: float) -> tuple[float, FloatArray, FloatArray]:
    """How well a bend fits, nats, with the prior of `BEND_PRECISION`; its gradient (4,), and (4, 4) minus its slope."""
    value, slope, bend = lags.at_lag(np.tensordot(curvature, lags.terms, 1))
    flat, prior = lags.terms.reshape(4, -1), BEND_PRECISION @ curvature
    hessian = BEND_PRECISION + weight * (flat * np.maximum(-bend, 0).ravel()) @ flat.T
    return weight * float(value.sum()) - 0.5 * float(curvature @ prior), weight * flat @ slope.ravel() - prior, hessian


def _climb(curvature: FloatArray, lags: _Lags, weight: float) -> tuple[FloatArray, float]:
    """The bend that is most likely, by Newton's method, never downhill; and its likeness."""
    best, (score, gradient, hessian) = curvature, _likeness(curvature, lags, weight)
    step = 1.0
    for _ in range(SETTINGS.bend_steps):
        trial = best + step * np.linalg.solve(hessian, gradient)
        there = _likeness(trial, lags, weight)
        if there[0] <= score:
            step /= 2
            continue
        gained = there[0] - score
        best, (score, gradient, hessian) = trial, there
        if gained < SETTINGS.bend_least_gain_nats:
            break
    return best, score


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
