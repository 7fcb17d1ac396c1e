"""Refine a grid by its columns' waveforms: each strip's light is a mix of the waveforms of the columns nearby.

The waveforms are estimated from one half of the strips and predict the other half, and vice versa. The mix depends on
the strip's position in a known way, so all strips together correct the grid. Two measures identify the right grid: the
light of the strips that it explains, and the loss if its borders lie half a column further on.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rxcli.receiver.screen.grid import Grid, columns_at, grid_slopes, grid_step
from rxcli.receiver.screen.strips import ROUNDING, PictureStrips
from rxcli.types import BoolArray, Float32Array, FloatArray

#: Ridge regularisation of the waveforms of faint columns, in strips.
_RIDGE = 0.5
#: Gain of a fit's steps: they are too short because the waveforms were estimated with the same grid.
_STEP_GAIN = 2.5
#: Maximum number of columns of a block: on a plane viewed nearly edge-on the grid counts any number.
_MAX_COLUMNS = 64
#: Logarithm of the minimum share of a column: products of smaller numbers take many times the time.
_MIN_SHARE = np.float32(-30)


@dataclass(frozen=True, slots=True)
class Mixes:
    """Shares of nearby columns in each strip's light under a grid; K columns of a block, counted from its first."""

    #: (B, S, K) shares of the columns in the strips' light, of unit length, and offset from each column's middle.
    share: Float32Array
    distance: Float32Array
    #: (B, 1) column of the grid from which a block's are counted.
    first_column: FloatArray
    sigma: float

    @classmethod
    def of(cls, u: FloatArray, sigma: float, n_columns: int | None = None) -> Mixes:
        """Mixes of strips at columns (B, S); with `n_columns`, columns outside 0 to `n_columns` contribute nothing."""
        first_column = np.floor(u.min(axis=1, keepdims=True))
        u = u - first_column
        n = int(min(np.ceil(u.max()), _MAX_COLUMNS))
        distance = np.minimum(u, n).astype(np.float32)[..., None] - (np.arange(n, dtype=np.float32) + np.float32(0.5))
        share = np.square(distance)
        share *= np.float32(-0.5 / sigma**2)
        np.exp(np.maximum(share, _MIN_SHARE, out=share), out=share)
        if n_columns is not None:
            number = first_column + np.arange(n)
            share *= ((number >= 0) & (number < n_columns))[:, None]
            share *= ((u > -first_column) & (u < n_columns - first_column))[..., None]
        share /= np.sqrt(_dot(share, share) + ROUNDING**2)[..., None]
        return cls(share, distance, first_column, sigma)

    def slopes(self) -> Float32Array:
        """(B, S, K) derivatives of the shares by the strips' positions, columns."""
        slope = self.share * self.distance
        slope *= np.float32(-1 / self.sigma**2)
        slope -= self.share * _dot(slope, self.share)[..., None]
        return slope


def _dot(left: Float32Array, right: Float32Array) -> Float32Array:
    """(B, S) sums of products over the last axis."""
    return np.asarray(np.einsum("bsk,bsk->bs", left, right), np.float32)


def _halves(strips: PictureStrips, mixes: Mixes) -> Iterator[tuple[slice, Float32Array]]:
    """The odd strips, with the waveforms (B, K, R) of the columns estimated from the even ones; and vice versa."""
    weighted = mixes.share * np.sqrt(strips.coherence)[..., None]
    turned = weighted.transpose(0, 2, 1)
    # Neighbouring strips have nearly the same mix, so half the normal matrix serves either half of them.
    normal = np.matmul(turned, weighted) / 2 + np.float32(_RIDGE) * np.eye(len(turned[0]), dtype=np.float32)
    inverse = np.linalg.inv(normal)
    for known, predicted in ((slice(0, None, 2), slice(1, None, 2)), (slice(1, None, 2), slice(0, None, 2))):
        yield predicted, np.matmul(inverse, np.matmul(turned[..., known], strips.changes[:, known]))


@dataclass(frozen=True, slots=True)
class _Predicted:
    """Inner products of the waveforms of one half of the strips with the strips of the other half.

    A mix of columns has the same mix of their products, and there are fewer columns than rows.
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


def predicted_light(strips: PictureStrips, u: FloatArray, sigma: float) -> Float32Array:
    """(B, S, R) products of each strip's changes with their prediction by the other half, at columns (B, S)."""
    out, mixes = np.empty_like(strips.changes), Mixes.of(u, sigma)
    for half, waves in _halves(strips, mixes):
        np.multiply(np.matmul(mixes.share[:, half], waves), strips.changes[:, half], out=out[:, half])
    return out


def explained_light(strips: PictureStrips, u: FloatArray, sigma: float) -> float:
    """Log-likelihood gain of strips at columns (B, S) from their prediction by the other half of the strips."""
    total, mixes = 0.0, Mixes.of(u, sigma)
    for half, waves in _halves(strips, mixes):
        predicted, own = _Predicted.of(waves, strips.changes[:, half]), mixes.share[:, half]
        power = _dot(np.matmul(own, predicted.waves), own) * predicted.power + ROUNDING
        similarity = np.maximum(_dot(own, predicted.strips), 0) ** 2 / power
        total -= 0.5 * strips.n_rows * float(np.log1p(-np.minimum(similarity, np.float32(0.999))).sum())
    return total


def with_light(strips: PictureStrips, grid: Grid, sigma: float) -> Grid:
    """Add to a grid the strips' light that it explains, and the excess over the same half a column further on."""
    u = columns_at(grid.coefficients, strips.x, strips.y)
    here, between = explained_light(strips, u, sigma), explained_light(strips, u + 0.5, sigma)
    return replace(grid, explained=here, contrast=here - between)


def moved_by_waveforms(
    strips: PictureStrips,
    grid: Grid,
    sigma: float,
    n_steps: int,
    within: BoolArray | None = None,
    n_columns: int | None = None,
) -> Grid:
    """Move a grid to the strip positions that its columns' waveforms indicate.

    Args:
        strips: of the picture.
        grid: right to some tenths of a column.
        sigma: light spread of the screen, column pitches.
        n_steps: number of Gauss-Newton steps.
        within: (B, S) strips to use; all by default.
        n_columns: of the screen, if the grid is numbered from its first column: light beyond is not from a column.
    """
    coefficients = grid.coefficients
    for _ in range(n_steps):
        off, weight = _offsets(strips, Mixes.of(columns_at(coefficients, strips.x, strips.y), sigma, n_columns))
        if within is not None:
            weight = weight * within
        if not weight.any():
            break  # A black picture has no borders.
        slopes = grid_slopes(coefficients, strips.x, strips.y).reshape(coefficients.size, -1)
        coefficients = coefficients + grid_step(coefficients, _STEP_GAIN * off.ravel(), weight.ravel(), slopes)
    return replace(grid, coefficients=coefficients)


def _offsets(strips: PictureStrips, mixes: Mixes) -> tuple[FloatArray, FloatArray]:
    """(B, S) offset of each strip from its position in a grid, columns, and the precision of the offset."""
    off, precision, slope = np.zeros(strips.x.shape), np.zeros(strips.x.shape), mixes.slopes()
    for half, waves in _halves(strips, mixes):
        found = offsets(waves, strips.changes[:, half], mixes.share[:, half], slope[:, half], strips.n_rows)
        off[:, half], precision[:, half] = found
    return off, precision


def offsets(
    waves: Float32Array, changes: Float32Array, share: Float32Array, slope: Float32Array, n_rows: float
) -> tuple[Float32Array, Float32Array]:
    """Regress strips on their light and its slope along the screen: (B, S) offset, columns, and its precision.

    Args:
        waves: (B, K, R) waveforms of the columns.
        changes: (B, S, R) of the strips.
        share: (B, S, K) of the columns in their light.
        slope: (B, S, K) of the shares.
        n_rows: independent rows of a block.
    """
    predicted = _Predicted.of(waves, changes)
    model = np.matmul(share, predicted.waves)
    power = _dot(model, share) + ROUNDING
    gain = _dot(predicted.strips, share) / power
    shared = _dot(model, slope) / power
    slope_power = np.maximum(_dot(np.matmul(slope, predicted.waves), slope) - shared * shared * power, ROUNDING)
    projection = _dot(predicted.strips, slope) - shared * gain * power
    noise = np.maximum(predicted.power - gain * gain * power, 0) / np.float32(n_rows) + ROUNDING
    lit = np.maximum(gain, np.float32(0))
    off, precision = projection / (np.maximum(lit, np.float32(0.05)) * slope_power), lit * lit * slope_power / noise
    # Huber weights: offsets beyond one standard deviation count less.
    return off, precision / np.maximum(np.abs(off) * np.sqrt(precision), 1)
