"""A grid refined by what its columns send: each strip's light is a mix of the waveforms of the columns beside it.

The coherence of pairs takes columns for independent of one another, which some ten slots in a window of rows are not.
Here the waveforms themselves are estimated from one half of the strips, and tell of the other half's mixes, and the
other way round; how a mix changes with the place is known, so that all strips together correct the grid.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rxcli.receiver.screen.coherence import Coherence
from rxcli.receiver.screen.grid import Grid, columns_of_strips, gain_of, grid_prior, grid_slopes
from rxcli.types import Float32Array, FloatArray

_ROUNDS = 16
#: Waveforms have noise in them, so that steps come out too short.
_LONGER = 1.5
#: Weight against waveforms of columns that hardly show, strips.
_RIDGE = 0.5
#: Strips whose mixes are further off than so many standard deviations count less.
_ROBUST = 2.0
_LARGEST = np.array([0.1, 0.3, 0.3, 0.04, 0.04, 0.02])


def refine_by_waveforms(coherence: Coherence, grid: Grid, sigma: float) -> Grid:
    """The grid that explains the strips' light best as mixes of their columns' waveforms.

    Args:
        coherence: of the picture.
        grid: right to some tenths of a column.
        sigma: light spread of the screen, column pitches.
    """
    numbers = grid.numbers
    for _ in range(_ROUNDS):
        u = columns_of_strips(coherence, replace(grid, numbers=numbers))
        slopes = grid_slopes(coherence, replace(grid, numbers=numbers))
        off, precision = _off(coherence, u, sigma)
        limit = _ROBUST / np.sqrt(np.maximum(precision, 1e-9))
        weight = precision / np.maximum(np.abs(off) / limit, 1.0)
        flat = slopes.reshape(slopes.shape[0], -1)
        prior = grid_prior(grid.bent)
        normal = (flat * weight.ravel()) @ flat.T + np.diag(prior)
        gradient = flat @ (weight * off).ravel() - prior * numbers
        step = np.linalg.solve(normal + 1e-3 * np.diag(np.diag(normal)), gradient)
        numbers = numbers + np.clip(_LONGER * step, -_LARGEST, _LARGEST)
        if np.abs(step[:3]).max() < 2e-3:
            break
    refined = replace(grid, numbers=numbers)
    before, after = explained(coherence, grid, sigma), explained(coherence, refined, sigma)
    if after < before:
        return replace(grid, explained=before)
    return replace(refined, gain=gain_of(coherence, refined, sigma), explained=after)


def _off(coherence: Coherence, u: FloatArray, sigma: float) -> tuple[FloatArray, FloatArray]:
    """(W, S) how far each strip lies from where the grid has it, columns, and the precision of that."""
    off, precision = np.zeros(u.shape), np.zeros(u.shape)
    for window, half, strips, mix, turned in _by_halves(coherence, u, sigma):
        told, asked = slice(half, None, 2), slice(1 - half, None, 2)
        waves = _waveforms(strips[:, told], mix[told], np.sqrt(coherence.lit[window, told]))
        off[window, asked], precision[window, asked] = _asked(
            strips[:, asked], waves @ mix[asked].T, waves @ turned[asked].T
        )
    return off, precision / coherence_rows(coherence)


def _by_halves(
    coherence: Coherence, u: FloatArray, sigma: float
) -> Iterator[tuple[int, int, Float32Array, Float32Array, Float32Array]]:
    """Every window twice: its number, which half of the strips tells, its changes, mixes and their slopes (S, K)."""
    centres = np.arange(int(np.floor(u.min())), int(np.ceil(u.max())) + 1) + 0.5
    for window, (own, strips) in enumerate(zip(u, coherence.changes, strict=True)):
        apart = own[:, None] - centres
        spread = np.exp(-(apart**2) / (2 * sigma**2))
        norm = np.sqrt((spread**2).sum(axis=1, keepdims=True))
        mix = spread / norm
        slope = -spread * apart / sigma**2
        turned = (slope - mix * (slope * mix).sum(axis=1, keepdims=True)) / norm
        for half in (0, 1):
            yield window, half, strips, mix.astype(np.float32), turned.astype(np.float32)


def explained(coherence: Coherence, grid: Grid, sigma: float) -> float:
    """How much of the strips' light the other strips' waveforms explain, nats."""
    u = columns_of_strips(coherence, grid)
    total = 0.0
    for window, half, strips, mix, _ in _by_halves(coherence, u, sigma):
        told, asked = slice(half, None, 2), slice(1 - half, None, 2)
        model = _waveforms(strips[:, told], mix[told], np.sqrt(coherence.lit[window, told])) @ mix[asked].T
        own = strips[:, asked]
        power = (model * model).sum(axis=0) + 1e-6
        shared = np.maximum((model * own).sum(axis=0), 0) ** 2 / power / np.maximum((own * own).sum(axis=0), 1e-6)
        total -= 0.5 * coherence.n_rows * float(np.log1p(-np.minimum(shared, 0.999)).sum())
    return total


def coherence_rows(coherence: Coherence) -> float:
    """Rows of a window for each independent one."""
    return float(coherence.changes.shape[1]) / coherence.n_rows


def _waveforms(strips: Float32Array, mix: Float32Array, lit: Float32Array) -> Float32Array:
    """(rows, K) waveforms of the columns from some of the strips."""
    weighted = mix * lit[:, None]
    normal = weighted.T @ weighted + _RIDGE * np.eye(mix.shape[1], dtype=np.float32)
    return np.asarray(np.linalg.solve(normal, (strips @ weighted).T).T, np.float32)


def _asked(strips: Float32Array, model: Float32Array, slope: Float32Array) -> tuple[FloatArray, FloatArray]:
    """How far some strips lie off, and the precision of that: by light and its slope, its strength left open."""
    power = (model * model).sum(axis=0) + 1e-6
    gain = (model * strips).sum(axis=0) / power
    slope = slope - model * ((model * slope).sum(axis=0) / power)
    left = strips - gain * model
    told = (slope * slope).sum(axis=0)
    noise = (left * left).mean(axis=0) + 1e-6
    lit = np.maximum(gain, 0.0)
    off = (slope * left).sum(axis=0) / (np.maximum(lit, 0.05) * told + 1e-6)
    return np.asarray(off, np.float64), np.asarray(lit * lit * told / noise, np.float64)
