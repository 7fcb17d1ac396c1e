"""Refine the columns of a screen with decided slots.

The finder estimates waveforms from the same strips that it places. Decided slots are known waveforms. A regression of
each strip on the slots of its columns gives the strip's distance from its place in the grid; all strips together move
the grid. The corners follow the columns; top and bottom turn with them.
"""

from dataclasses import replace

import numpy as np

from rxcli.numerics import TINY
from rxcli.receiver.light import SlotLight
from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.find import ColumnLayout
from rxcli.receiver.screen.grid import Grid, columns_at, grid_between, grid_slopes
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.screen.rows import ScreenAxis
from rxcli.receiver.screen.strips import LONG_ROWS, PictureStrips
from rxcli.receiver.screen.waveforms import Mixes, offsets
from rxcli.types import Clock, Float32Array, FloatArray, Lens

#: Gauss-Newton steps, and prior standard deviations of the finder's columns: shift and widths in screen widths, and
#: perspective.
_STEPS, _POSE_SD, _TILT_SD = 3, 0.005, 0.02
#: Changes of light below which waves are set to zero: products of smaller numbers take many times the time.
_MIN_WAVE = 1e-3


def corners_by_slots(
    outline: Outline,
    layout: ColumnLayout,
    clock: Clock,
    lit: Float32Array,
    lens: Lens | None,
    *,
    is_reversed: bool = False,
) -> FloatArray:
    """Move corners to the column positions that decided slots give; returns (4, 2) pixels.

    Args:
        outline: that was found in the picture, in the viewer's order, right to some tenths of a column.
        layout: of the screen's columns.
        clock: of the slots.
        lit: (C, N) probability that each slot of the clock's grid is lit.
        lens: of the picture, known or estimated.
        is_reversed: whether the stored rows run against the readout.
    """
    strips, corners, n_columns = outline.strips, outline.corners, len(lit)
    assert strips is not None
    start = _start(strips, corners, n_columns, lens)
    column = columns_at(start.coefficients, strips.x, strips.y)
    waves = _waves(strips, column, clock, lit, lens, is_reversed)
    coefficients, sd = start.coefficients, _POSE_SD * n_columns
    # The lens stays fixed: the strips were read through it.
    prior = np.array([sd, sd, sd, _TILT_SD, _TILT_SD, 1e-6]) ** -2.0
    slopes = grid_slopes(coefficients, strips.x, strips.y).reshape(coefficients.size, -1)
    for _ in range(_STEPS):
        mixes = Mixes.of(columns_at(coefficients, strips.x, strips.y), layout.sigma, n_columns)
        columns = np.clip(mixes.first_column.astype(np.int64) + np.arange(mixes.share.shape[2]), 0, n_columns - 1)
        windows = np.tile(np.arange(strips.n_windows), strips.n_parts)
        known = waves[windows[:, None], columns]
        off, weight = offsets(known, strips.changes, mixes.share, mixes.slopes(), strips.n_rows)
        normal = (slopes * weight.ravel()) @ slopes.T + np.diag(prior)
        gradient = slopes @ (weight * off).ravel() - prior * (coefficients - start.coefficients)
        coefficients = coefficients + np.linalg.solve(normal, gradient)
    # The middle of the screen stays on its row, and the screen as high as it was.
    grid, row = replace(start, coefficients=coefficients), float(corners[:, 1].mean())
    axis = ScreenAxis.through(grid, n_columns, layout.aspect, row)
    return axis.corners(axis.ends_of(corners))


def _start(strips: PictureStrips, corners: FloatArray, n_columns: int, lens: Lens | None) -> Grid:
    """Grid between corners, columns in the viewer's order; an estimated lens becomes its radial coefficient."""
    grid = grid_between(corners, n_columns, (strips.width, strips.height), lens)
    if strips.lens is not None or lens is None or lens.corrected:
        return replace(grid, lens=strips.lens)
    return replace(grid, lens=None, coefficients=grid.coefficients - np.array([0, 0, 0, 0, 0, lens.dist_coeffs[0]]))


def _waves(
    strips: PictureStrips, column: FloatArray, clock: Clock, lit: Float32Array, lens: Lens | None, is_reversed: bool
) -> Float32Array:
    """Band-passed light of the columns (W, C, R) on the rows of strips at columns (B, S)."""
    n_windows, n_rows, n_columns = strips.n_windows, strips.changes.shape[2], len(lit)
    places = np.stack([strips.raw_x, strips.raw_y], axis=-1) * strips.width
    places += (np.array([strips.width, strips.height]) - 1) / 2
    sensor_row = (places if lens is None or not lens.corrected else geometry.distort(places, lens))[..., 1]
    rows = ((np.arange(n_windows * n_rows) + 0.5) * strips.short_rows - 0.5).reshape(n_windows, n_rows)
    windows = np.tile(np.arange(n_windows), strips.n_parts)[:, None]
    inside = (column > 0) & (column < n_columns)
    cell = (np.clip(column, 0, n_columns - 1).astype(np.int64) * n_windows + windows)[inside]
    total = np.bincount(cell, (sensor_row - rows.mean(axis=1)[windows])[inside], n_columns * n_windows)
    off = total / np.maximum(np.bincount(cell, minlength=total.size), 1)
    at = (rows + off.reshape(n_columns, n_windows, 1)).reshape(n_columns, -1)
    light = SlotLight(lit)

    row = strips.height - 1 - at if is_reversed else at
    slot = (row - clock.row0) / clock.rows_per_slot - clock.delay_slots[:, None]

    def mean(n_rows: int) -> Float32Array:
        return light.mean_over(slot, float(np.hypot(clock.exposure_slots, n_rows / clock.rows_per_slot)))

    changes = mean(strips.short_rows) - mean(LONG_ROWS * strips.short_rows)
    changes = changes.reshape(n_columns, n_windows, n_rows).transpose(1, 0, 2)
    noise = strips.row_noise / (np.linalg.norm(strips.row_noise, axis=1, keepdims=True) + np.float32(TINY))
    # The row noise is projected off the strips, so it is projected off the waves.
    changes = changes - np.einsum("wcr,wr->wc", changes, noise)[..., None] * noise[:, None]
    return np.asarray(np.where(np.abs(changes) < _MIN_WAVE, 0, changes), np.float32)
