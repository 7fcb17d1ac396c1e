"""Columns of unlike drive: a lamp in a night picture lights one column and leaves the next one dark.

The light of the brighter column then reaches far into the darker one, and the border between them seems to lie there:
by half a column where one is driven ten times as much. Grids are told apart by their borders, so that a wrong one may
explain more light than the true one does. Here the drive of every column in every window of rows is estimated with the
grid, which makes the true grid the better one again, but leaves others more freedom: whether packets show decides.
"""

from __future__ import annotations

import numpy as np

from rxcli.numerics import TINY
from rxcli.receiver.screen.grid import Grid, columns_at, grid_prior, grid_slopes
from rxcli.receiver.screen.waveforms import LARGEST_STEP, LEAST_SHARE, StripLight, explained_light, strip_offsets
from rxcli.types import Float32Array, FloatArray

#: Steps, and how much longer they are made: waveforms follow the grid; standard deviation of the logarithm of a
#: column's drive.
_ROUNDS, _LONGER, _DRIVE_SD = 2, 2.0, 1.0


def explained_with_drive(strips: StripLight, grid: Grid) -> float:
    """How much of the strips' light a grid near the given one explains, nats, with columns of whatever drive."""
    numbers, prior = grid.numbers, grid_prior(grid.bent)
    u = columns_at(numbers, strips.x, strips.y)
    first, n_columns = int(np.floor(u.min())) - 1, int(np.ceil(u.max()) - np.floor(u.min())) + 3
    if n_columns > strips.x.shape[1]:
        return 0.0  # A plane seen nearly edge-on.
    drive = np.zeros((u.shape[0], n_columns))
    for _ in range(_ROUNDS):
        share, apart = _mixes(u - first, strips.sigma, drive)
        off, weight = strip_offsets(strips, share, apart)
        slopes = grid_slopes(numbers, strips.x, strips.y)
        step, change = _solved(off, weight, slopes, u - first, prior, numbers, drive, strips.sigma)
        numbers = numbers + step
        drive = drive + _LONGER * change
        u = columns_at(numbers, strips.x, strips.y)
    return explained_light(strips, _mixes(u - first, strips.sigma, drive)[0])


def _mixes(u: FloatArray, sigma: float, drive: FloatArray) -> tuple[Float32Array, Float32Array]:
    """(W, S, K) shares of the columns in every strip's light, and how far off its middle each column lies."""
    apart = (u[..., None] - (np.arange(drive.shape[1]) + 0.5)).astype(np.float32)
    spread = np.square(apart)
    spread *= np.float32(-0.5 / sigma**2)
    spread += drive[:, None].astype(np.float32)
    np.exp(np.maximum(spread, LEAST_SHARE, out=spread), out=spread)
    spread /= np.sqrt(np.einsum("wsk,wsk->ws", spread, spread))[..., None]
    return spread, apart


def _solved(
    off: FloatArray,
    weight: FloatArray,
    slopes: FloatArray,
    u: FloatArray,
    prior: FloatArray,
    numbers: FloatArray,
    drive: FloatArray,
    sigma: float,
) -> tuple[FloatArray, FloatArray]:
    """Steps of the grid's numbers (6,) and of the logarithms of the columns' drive (W, K) that the offsets ask for.

    Between two columns light is mixed as if it came from further on by sigma^2 times the logarithm of their drives'
    ratio.
    """
    n_windows, n_columns = drive.shape
    left = np.clip(np.floor(u - 0.5).astype(np.int64), 0, n_columns - 2)
    place = (np.arange(n_windows)[:, None] * n_columns + left).ravel()

    def at_columns(values: FloatArray) -> FloatArray:
        """(W, K) sums of (W, S) values at the columns to the left of the strips' borders."""
        total = np.bincount(place, values.ravel(), n_windows * n_columns)
        return np.asarray(total.reshape(n_windows, n_columns), np.float64)

    def drive_slopes(values: FloatArray) -> FloatArray:
        """(W, K) sums of values at the right columns less those at the left ones, as drives count."""
        total = at_columns(values) * sigma**2
        return np.pad(total[:, :-1], ((0, 0), (1, 0))) - total

    pairs = at_columns(weight) * sigma**4
    own = np.zeros((n_windows, n_columns, n_columns))
    k = np.arange(n_columns)
    own[:, k, k] = pairs + np.pad(pairs[:, :-1], ((0, 0), (1, 0))) + _DRIVE_SD**-2
    own[:, k[:-1], k[1:]] = own[:, k[1:], k[:-1]] = -pairs[:, :-1]
    both = np.stack([drive_slopes(weight * slope) for slope in slopes], axis=1)
    asked = drive_slopes(weight * off) - drive / _DRIVE_SD**2
    inverse = np.linalg.inv(own)
    flat = slopes.reshape(numbers.size, -1)
    normal = (flat * weight.ravel()) @ flat.T
    gradient = flat @ (weight * off).ravel() - prior * numbers
    eliminated = np.matmul(both, inverse)
    reduced = normal - np.matmul(eliminated, both.transpose(0, 2, 1)).sum(axis=0)
    gradient = gradient - np.matmul(eliminated, asked[..., None]).sum(axis=0)[:, 0]
    damped = reduced + np.diag(prior + 1e-3 * np.diag(normal) + TINY)
    step = np.clip(_LONGER * np.linalg.solve(damped, gradient), -LARGEST_STEP, LARGEST_STEP)
    left_over = asked - step @ both
    return step, np.matmul(inverse, left_over[..., None])[..., 0]
