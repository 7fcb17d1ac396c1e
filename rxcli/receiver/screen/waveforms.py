"""A grid by what its columns send: each strip's light is a mix of the waveforms of the columns beside it.

The waveforms are estimated from one half of the strips and predict the other half, and the other way round. How a mix
changes with the place is known, so that all strips together correct the grid; and how much of the strips' light the
right grid explains, and how much less with its borders half a column further on, tells it from others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rxcli.receiver.screen.grid import Grid, columns_at, grid_slopes, grid_step
from rxcli.receiver.screen.settings import SETTINGS
from rxcli.receiver.screen.strips import Strips
from rxcli.types import BoolArray, Float32Array, FloatArray

#: Columns of a block that are told apart, at most: a plane seen nearly edge-on counts any number.
_MAX_COLUMNS = 64
_TINY = np.float32(1e-6)
#: Logarithm of the least share of a column: products of smaller numbers would take many times the time.
_MIN_SHARE = np.float32(-30)


@dataclass(frozen=True, slots=True)
class Mixes:
    """What every strip has of the columns beside it under a grid; K columns of a block, counted from its first."""

    #: (B, S, K) shares of the columns in the strips' light, of unit length, and how far off each column's middle lies.
    share: Float32Array
    distance: Float32Array
    #: (B, 1) column of the grid from which a block's are counted.
    first: FloatArray
    sigma: float

    @classmethod
    def of(cls, u: FloatArray, sigma: float, n_columns: int | None = None) -> Mixes:
        """The mixes of strips at columns (B, S); with `n_columns`, of a screen that has so many from column 0 on."""
        first = np.floor(u.min(axis=1, keepdims=True))
        u = u - first
        n = int(min(np.ceil(u.max()), _MAX_COLUMNS))
        distance = np.minimum(u, n).astype(np.float32)[..., None] - (np.arange(n, dtype=np.float32) + np.float32(0.5))
        share = np.square(distance)
        share *= np.float32(-0.5 / sigma**2)
        np.exp(np.maximum(share, _MIN_SHARE, out=share), out=share)
        if n_columns is not None:
            number = first + np.arange(n)
            share *= ((number >= 0) & (number < n_columns))[:, None]
            share *= ((u > -first) & (u < n_columns - first))[..., None]
        share /= np.sqrt(_dot(share, share) + _TINY**2)[..., None]
        return cls(share, distance, first, sigma)

    def slopes(self) -> Float32Array:
        """(B, S, K) derivatives of the shares by the strips' places, columns."""
        slope = self.share * self.distance
        slope *= np.float32(-1 / self.sigma**2)
        slope -= self.share * _dot(slope, self.share)[..., None]
        return slope


def _dot(one: Float32Array, other: Float32Array) -> Float32Array:
    """(B, S) sums of products over the last axis."""
    return np.asarray(np.einsum("bsk,bsk->bs", one, other), np.float32)


def _waveforms(strips: Strips, mixes: Mixes, known: int) -> Float32Array:
    """(B, K, R) waveforms of the columns from the even strips (0) or the odd ones (1)."""
    weight = np.sqrt(strips.lit[:, known::2])[..., None]
    weighted = mixes.share[:, known::2] * weight
    turned = weighted.transpose(0, 2, 1)
    normal = np.matmul(turned, weighted) + np.float32(SETTINGS.ridge) * np.eye(weighted.shape[2], dtype=np.float32)
    return np.asarray(np.matmul(np.linalg.inv(normal), np.matmul(turned, strips.changes[:, known::2])), np.float32)


@dataclass(frozen=True, slots=True)
class _Predicted:
    """The waveforms of one half of the strips against the strips of the other half, as products of columns.

    A strip that is some share of every column is the same share of its products; and there are fewer columns than rows.
    """

    #: (B, K, K) of waveforms with one another, (B, S / 2, K) of strips with waveforms, (B, S / 2) of strips alone.
    waves: Float32Array
    strips: Float32Array
    power: Float32Array

    @classmethod
    def of(cls, waves: Float32Array, changes: Float32Array) -> _Predicted:
        """Waveforms (B, K, R) and the changes of strips (B, S, R) that they predict."""
        turned = waves.transpose(0, 2, 1)
        return cls(np.matmul(waves, turned), np.matmul(changes, turned), _dot(changes, changes))


def predicted_light(strips: Strips, u: FloatArray, sigma: float) -> Float32Array:
    """(B, S, R) products of every strip's changes with what the other strips' waveforms predict at columns (B, S)."""
    out, mixes = np.empty_like(strips.changes), Mixes.of(u, sigma)
    for known, asked in ((0, 1), (1, 0)):
        waves = _waveforms(strips, mixes, known)
        np.multiply(np.matmul(mixes.share[:, asked::2], waves), strips.changes[:, asked::2], out=out[:, asked::2])
    return out


def explained_light(strips: Strips, u: FloatArray, sigma: float) -> float:
    """Log-likelihood that strips at columns (B, S) gain by what the other strips' waveforms predict of them."""
    total, mixes = 0.0, Mixes.of(u, sigma)
    for known, asked in ((0, 1), (1, 0)):
        predicted, own = (
            _Predicted.of(_waveforms(strips, mixes, known), strips.changes[:, asked::2]),
            mixes.share[:, asked::2],
        )
        power = _dot(np.matmul(own, predicted.waves), own) * predicted.power + _TINY
        similarity = np.maximum(_dot(own, predicted.strips), 0) ** 2 / power
        total -= 0.5 * strips.n_rows * float(np.log1p(-np.minimum(similarity, np.float32(0.999))).sum())
    return total


def with_light(strips: Strips, grid: Grid, sigma: float) -> Grid:
    """A grid with how much of the strips' light it explains, and how much more than half a column further on."""
    u = columns_at(grid.numbers, strips.x, strips.y)
    here, between = explained_light(strips, u, sigma), explained_light(strips, u + 0.5, sigma)
    return replace(grid, explained=here, contrast=here - between)


def moved_by_waveforms(
    strips: Strips,
    grid: Grid,
    sigma: float,
    n_steps: int,
    within: BoolArray | None = None,
    n_columns: int | None = None,
) -> Grid:
    """The grid moved to where its columns' waveforms say that the strips lie.

    Args:
        strips: of the picture.
        grid: right to some tenths of a column.
        sigma: light spread of the screen, column pitches.
        n_steps: steps that it takes.
        within: (B, S) strips that count; all by default.
        n_columns: of the screen, where the grid counts from its first: light beyond them is none of its columns'.
    """
    numbers = grid.numbers
    for _ in range(n_steps):
        off, weight = _offsets(strips, Mixes.of(columns_at(numbers, strips.x, strips.y), sigma, n_columns))
        if within is not None:
            weight = weight * within
        if not weight.any():
            break  # A black picture: nothing says where the borders are.
        slopes = grid_slopes(numbers, strips.x, strips.y).reshape(numbers.size, -1)
        numbers = numbers + grid_step(numbers, SETTINGS.step_gain * off.ravel(), weight.ravel(), slopes)
    return replace(grid, numbers=numbers)


def _offsets(strips: Strips, mixes: Mixes) -> tuple[FloatArray, FloatArray]:
    """(B, S) how far each strip lies from where a grid has it, columns, and the precision of that."""
    off, precision = np.zeros(strips.x.shape), np.zeros(strips.x.shape)
    slope, n = mixes.slopes(), strips.changes.shape[2]
    for known, asked in ((0, 1), (1, 0)):
        predicted = _Predicted.of(_waveforms(strips, mixes, known), strips.changes[:, asked::2])
        found = _offsets_of(predicted, mixes.share[:, asked::2], slope[:, asked::2], n)
        off[:, asked::2], precision[:, asked::2] = found
    return off, _robust(off, precision * strips.n_rows / n)


def offsets_of_known(strips: Strips, mixes: Mixes, waves: Float32Array) -> tuple[FloatArray, FloatArray]:
    """(B, S) how far each strip lies from where a grid has it by known waveforms (B, K, R), and the precision."""
    n = strips.changes.shape[2]
    predicted = _Predicted.of(waves, strips.changes)
    off, precision = _offsets_of(predicted, mixes.share, mixes.slopes(), n)
    return np.asarray(off, np.float64), _robust(off, np.asarray(precision * strips.n_rows / n, np.float64))


def _robust(off: FloatArray | Float32Array, precision: FloatArray) -> FloatArray:
    """The precision of offsets, less of those that are large for it."""
    limit = SETTINGS.huber_sd / np.sqrt(np.maximum(precision, 1e-9))
    return np.asarray(precision / np.maximum(np.abs(off) / limit, 1.0))


def _offsets_of(
    predicted: _Predicted, share: Float32Array, slope: Float32Array, n_rows: int
) -> tuple[Float32Array, Float32Array]:
    """Regression of strips on their light and its slope along the screen: how far off they lie, and its precision."""
    model = np.matmul(share, predicted.waves)
    power = _dot(model, share) + _TINY
    gain = _dot(predicted.strips, share) / power
    shared = _dot(model, slope) / power
    slope_power = np.maximum(_dot(np.matmul(slope, predicted.waves), slope) - shared * shared * power, _TINY)
    projection = _dot(predicted.strips, slope) - shared * gain * power
    noise = np.maximum(predicted.power - gain * gain * power, 0) / np.float32(n_rows) + _TINY
    lit = np.maximum(gain, np.float32(0))
    return projection / (np.maximum(lit, np.float32(0.05)) * slope_power), lit * lit * slope_power / noise
