"""The clock, the bend and the exposure that fit all light of a picture best."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import local_mean
from rxcli.receiver.camera.curvature import BEND_PRECISION, BEND_SCALE, curvature_terms, reversed_curvature
from rxcli.receiver.camera.estimates import BlindEstimate, Hypothesis
from rxcli.receiver.camera.strips import Correction, Strips, in_readout_order
from rxcli.receiver.camera.structure import repeat_evidence
from rxcli.receiver.camera.waves import (
    LOCAL_SLOTS,
    Grid,
    Moments,
    Slots,
    column_shares,
    column_waves,
    decide,
    estimate_exposure,
    first_slots,
    local_moments,
    packet_llr,
    residual_of,
    seen_through,
)
from rxcli.types import Float32Array, FloatArray

#: Of the prior: next to nothing is known of start and period, which slots that tell nothing leave as they are.
_PRECISION: FloatArray = np.diag([1e-6] * 6)
_PRECISION[2:, 2:] = BEND_PRECISION

#: Samples of a slot and strips of a column err alike: so many of them say what one would.
ALIKE = 10.0

#: Slots that are wrong are wrong in neighbouring columns alike: the spread between columns says this much too little.
UNDERSTATED = 3.0

_REFINE_STEPS = 10
#: Steps in which the clock alone moves, where no bend is known: slots that are wrong yet would bend it.
_RIGID_STEPS = 3

#: Exposure before any is known, slots; and steps at which it is estimated.
_FIRST_EXPOSURE = 1.2
_EXPOSURE_STEPS = (1, 3)
#: Slots that were read on a clock further off than this are read anew at this step.
_AGAIN_STEP, _FAR = 5, 0.4

#: The descent ends when no row moves by more slots than this.
_CONVERGED = 0.003

#: Chi-square of the four coefficients that a bend beyond doubt has, by whether the picture was corrected. Columns share
#: too much for it to be taken at its word: unbent pictures reach 150.
_BENT_CHI_SQUARE: dict[Correction, float] = {"no": np.inf, "likely": 30.0, "unknown": 160.0}

#: Keeps the clock of a row-time map and drops its bend.
FLAT = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0])

#: Share of what a row leaves that is its own; and the least of the mean spread that is left anywhere.
_WHITE, _LEAST_SPREAD = 1e-3, 0.2

#: How far the light per unit of the wave differs from its usual share of the mean light.
_GAIN_SD = 0.5

#: Rows of one block of the normal equations; the bend is straight within, which in longer ones changes the period.
BLOCK_ROWS = 16


@dataclass(frozen=True, slots=True)
class _Timing:
    """Row-time map: slot position of row s is (s + bend - start) / rows_per_slot."""

    #: start, rows_per_slot, k1, k2, p1, p2.
    values: FloatArray
    #: (6, 6) covariance of the values.
    covariance: FloatArray
    exposure_slots: float
    exposure_sd: float
    #: Log-likelihood ratio of header and weights over chance.
    log_evidence: float
    #: Share of the strips' local variance that the slots explain.
    explained: float
    slots: Slots


def refine(
    strips: Strips, hypothesis: Hypothesis, curvature: FloatArray, least_exposure_slots: float = 0.0, sure: bool = False
) -> BlindEstimate:
    """The clock, the bend and the exposure that fit all light of the picture best.

    Args:
        strips: the strips as the picture has them, not straightened.
        hypothesis: a clock found on the straightened strips.
        bend: the bend they were straightened with.
        least_exposure_slots: exposure that the file tells, 0 where it does not; optics and demosaicing add to it.
        sure: whether the stripes are bent without doubt.
    """
    ordered, curvature = (
        (in_readout_order(strips), reversed_curvature(curvature)) if hypothesis.reversed else (strips, curvature)
    )
    ordered = thinned(ordered, hypothesis.rows_per_slot)
    timing, corrected = _fit_timing(ordered, hypothesis, curvature, least_exposure_slots, sure)
    found, sd = timing.values[2:], UNDERSTATED * np.sqrt(np.diag(timing.covariance))
    return BlindEstimate(
        rows_per_slot=float(timing.values[1]),
        rows_per_slot_sd=float(sd[1]),
        packet_slots=hypothesis.packet_slots,
        reversed=hypothesis.reversed,
        exposure_slots=timing.exposure_slots,
        exposure_slots_sd=timing.exposure_sd,
        curvature=reversed_curvature(found) if hypothesis.reversed else found,
        curvature_sd=sd[2:],
        corrected=corrected,
        log_evidence=timing.log_evidence,
        explained=timing.explained,
        least_exposure_slots=least_exposure_slots,
        side_curvature=strips.side_curvature,
    )


def thinned(strips: Strips, rows_per_slot: float) -> Strips:
    """Neighbouring rows averaged as far as a slot keeps at least four."""
    join = max(1, int(rows_per_slot // 4))
    if join == 1:
        return strips
    n = strips.rows.size // join

    def mean(values: FloatArray | Float32Array) -> FloatArray:
        return np.asarray(values[..., : n * join].reshape(*values.shape[:-1], n, join).mean(axis=-1))

    inside = (mean(strips.inside) > 0.99).astype(np.float32)
    return replace(
        strips,
        light=mean(strips.light).astype(np.float32),
        inside=inside,
        x=mean(strips.x),
        rows=mean(strips.rows),
        noise=strips.noise.over(join),
    )


def _fit_timing(
    strips: Strips, hypothesis: Hypothesis, curvature: FloatArray, least_exposure_slots: float, sure: bool
) -> tuple[_Timing, bool]:
    """The row-time map, with a bend only where it is beyond doubt: one that is free for nothing blurs the period."""
    first_row = strips.rows[0] - 0.5 * (strips.rows[1] - strips.rows[0])
    before = int(hypothesis.start_row // hypothesis.rows_per_slot) + 2
    start = first_row + hypothesis.start_row - before * hypothesis.rows_per_slot
    grid = Grid(-before % hypothesis.packet_slots, hypothesis.packet_slots)
    values = np.concatenate([[start, hypothesis.rows_per_slot], curvature])
    first = _descend(strips, grid, values, least_exposure_slots, n_free=2 if strips.correction == "no" else 6)
    if sure or curvature_chi_square(first.values, first.covariance) > _BENT_CHI_SQUARE[strips.correction]:
        return first, True
    values = (
        np.concatenate([[start, hypothesis.rows_per_slot], np.zeros(4)]) if not curvature.any() else first.values * FLAT
    )
    flat = _descend(strips, grid, values, first.exposure_slots, n_free=2, slots=first.slots)
    return replace(flat, exposure_sd=first.exposure_sd), False


def _descend(
    strips: Strips,
    grid: Grid,
    values: FloatArray,
    exposure_slots: float,
    n_free: int,
    slots: Slots | None = None,
) -> _Timing:
    """Gauss-Newton on the first `n_free` values of the row-time map, deciding the slots anew at every step.

    The exposure is at least the one given, or that one where slots to start from are given too.
    """
    terms = time_terms(strips)
    estimating = slots is None
    exposure, exposure_sd = exposure_slots or _FIRST_EXPOSURE, 0.0
    first_time = slot_time(strips, terms, values)
    if slots is None:
        slots = first_slots(column_waves(strips, first_time, values[1]), exposure, grid)
    for step in range(_REFINE_STEPS):
        time = slot_time(strips, terms, values)
        waves = column_waves(strips, time, values[1])
        again = step == _AGAIN_STEP and float(np.abs(time - first_time).max()) > _FAR
        if again:
            slots = first_slots(waves, exposure, grid)
        if estimating and (again or step in _EXPOSURE_STEPS):
            near = None if again or step == _EXPOSURE_STEPS[0] else exposure
            exposure, exposure_sd, slots = estimate_exposure(waves, grid, slots, near)
            exposure, exposure_sd = (exposure, exposure_sd) if exposure > exposure_slots else (exposure_slots, 0.0)
        slots = decide(waves, exposure, grid, slots)
        free = n_free if step >= _RIGID_STEPS or values[2:].any() else 2
        observed = seen_by_strips(strips, time, slots.lit, exposure)
        change, covariance, explained = gauss_newton(strips, terms, values, time, observed, free)
        values = values + change
        moved = float(np.abs(slot_time(strips, terms, values)[:, ::BLOCK_ROWS] - time[:, ::BLOCK_ROWS]).max())
        if moved < _CONVERGED and step >= _AGAIN_STEP:
            break
    position = (np.arange(slots.lit.shape[1]) + grid.first_slot) % grid.packet_slots
    log_evidence = packet_llr(waves, exposure, grid, slots)
    log_evidence += repeat_evidence(slots.lit > 0.5, position, grid.packet_slots)
    return _Timing(values, covariance, exposure, exposure_sd, log_evidence, explained, slots)


def time_terms(strips: Strips) -> FloatArray:
    """(4, M, blocks + 1) bend terms at the borders of blocks of rows."""
    n = strips.rows.size
    nodes = np.minimum(np.arange(-(-n // BLOCK_ROWS) + 1) * BLOCK_ROWS, n - 1)
    return curvature_terms(strips.x[:, nodes], strips.rows[nodes], strips.width, strips.height)


def slot_time(strips: Strips, terms: FloatArray, values: FloatArray) -> Float32Array:
    """(M, R) slot position of every strip's row; the bend is interpolated between the blocks' borders."""
    n = strips.rows.size
    start, rows_per_slot = values[:2]
    moved = np.tensordot(values[2:], terms, 1)
    index = np.arange(n)
    low = index // BLOCK_ROWS
    width = np.minimum((low + 1) * BLOCK_ROWS, n - 1) - low * BLOCK_ROWS
    f = (index - low * BLOCK_ROWS) / np.maximum(width, 1)
    bent = moved[:, low] + (moved[:, low + 1] - moved[:, low]) * f
    return np.asarray((strips.rows + bent - start) / rows_per_slot, np.float32)


def seen_by_strips(
    strips: Strips, time: Float32Array, lit: Float32Array, exposure_slots: float
) -> tuple[Float32Array, Float32Array]:
    """(M, R) light 0..1 of slots (C, N) in every strip at slot positions; and its change per slot."""
    mixed = np.asarray(column_shares(strips) @ lit, np.float32)
    return seen_through(mixed, time, np.arange(mixed.shape[0]), exposure_slots)


def gauss_newton(
    strips: Strips,
    terms: FloatArray,
    values: FloatArray,
    time: Float32Array,
    observed: tuple[Float32Array, Float32Array],
    n_free: int,
    local_slots: float = LOCAL_SLOTS,
    order: int = 0,
) -> tuple[FloatArray, FloatArray, float]:
    """Step of the row-time map, its covariance, and the share of variance explained before the step.

    Args:
        strips: in readout order.
        terms: see `time_terms`.
        values: (6,) the row-time map.
        time: (M, R) its slot positions.
        seen: (M, R) light 0..1 that the slots give, and its change per slot.
        n_free: values that are fitted, the first ones.
        local_slots: slots over which the picture may be taken as constant.
        order: rows by which what is left of a row is foretold; the picture's texture is alike in neighbouring rows.
    """
    wave, slope = observed
    pitch = float(strips.rows[1] - strips.rows[0])
    window = round(local_slots * values[1] / pitch)
    inside = strips.inside
    near = local_moments(strips.light, wave, inside, window)
    gain = near.gain
    for _ in range(2):
        residual, spread = residual_of(strips, near, gain, wave, window)
        gain = _likely_gain(near, spread, window)
    weight = inside / spread
    light_power = float((gain * gain * near.variance * weight).sum())
    left = float((residual * residual * weight).sum())
    power = gain * slope
    if order:
        residual, power, weight = _whitened(residual, power, weight, order, window)
    fit = residual * weight * power
    blocks = np.arange(0, strips.rows.size, BLOCK_ROWS)
    information = np.add.reduceat(weight * power * power, blocks, axis=1).astype(np.float64)
    pull = np.add.reduceat(fit, blocks, axis=1).astype(np.float64)
    jacobian = _jacobian(terms, values, time, blocks)
    step, covariance_matrix = _solve(jacobian, information, pull, values, strips.n_columns, n_free)
    return step, covariance_matrix, light_power / max(light_power + left, 1e-9)


def _likely_gain(near: Moments, spread: Float32Array, window: int) -> Float32Array:
    """Light per unit of the wave where it is told poorly: as much of the mean light as elsewhere, give or take half."""
    weight = near.share / spread
    light = np.maximum(near.value, 0)
    told = float((weight * light * light * near.variance).sum())
    usual = np.float32(max(float((weight * light * near.covariance).sum()), 0.0) / max(told, 1e-12)) * light
    trust = np.float32(window) * near.share * np.maximum(near.variance, 0) / spread
    prior = 1 / (np.float32(_GAIN_SD) * usual + np.float32(1e-6)) ** 2
    raw = near.covariance / (near.variance + np.float32(0.02))
    return np.asarray(np.maximum((trust * raw + prior * usual) / (trust + prior), 0), np.float32)


def _whitened(
    residual: Float32Array, power: Float32Array, weight: Float32Array, order: int, window: int
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Residuals less what those of the rows before foretell, the derivatives alike, and their weights."""
    scale = np.sqrt(weight)
    inside = (weight > 0).astype(np.float32)
    residual, n = residual * scale, residual.shape[1]
    alike = [float((residual[:, k:] * residual[:, : n - k]).sum()) for k in range(order + 1)]
    lags = np.abs(np.subtract.outer(np.arange(order), np.arange(order)))
    known = np.array(alike)[lags] + (_WHITE * alike[0] + 1e-9) * np.eye(order)
    foretold = np.linalg.solve(known, alike[1:]).astype(np.float32)
    out_residual, out_power, counted = residual.copy(), power * scale, inside.copy()
    power = out_power.copy()
    counted[:, :order] = 0
    for k, share in enumerate(foretold, 1):
        out_residual[:, k:] -= share * residual[:, : n - k]
        out_power[:, k:] -= share * power[:, : n - k]
        counted[:, k:] *= inside[:, : n - k]
    square = out_residual * out_residual * counted
    spread = local_mean(square, window) / (local_mean(counted, window) + np.float32(1e-3))
    least = np.float32(_LEAST_SPREAD * float(square.sum()) / max(float(counted.sum()), 1.0) + 1e-9)
    return out_residual, out_power, np.asarray(counted / np.maximum(spread, least), np.float32)


def _jacobian(terms: FloatArray, values: FloatArray, time: Float32Array, blocks: NDArray[np.int64]) -> FloatArray:
    """(6, M, blocks) change of the slot position with start, rows per slot and bend."""
    rows_per_slot = values[1]
    middle = np.minimum(blocks + BLOCK_ROWS // 2, time.shape[1] - 1)
    out = np.empty((6, terms.shape[1], blocks.size))
    out[0] = -1 / rows_per_slot
    out[1] = -time[:, middle] / rows_per_slot
    out[2:] = (terms[:, :, :-1] + terms[:, :, 1:]) / 2 / rows_per_slot
    return out


def _solve(
    jacobian: FloatArray, information: FloatArray, pull: FloatArray, values: FloatArray, n_columns: int, n_free: int
) -> tuple[FloatArray, FloatArray]:
    """Step and covariance; the spread of the columns' pulls stands for all that makes residuals alike."""
    free = jacobian[:n_free]
    flat = free.reshape(n_free, -1)
    prior = ALIKE * _PRECISION[:n_free, :n_free]
    hessian = (flat * information.ravel()) @ flat.T + prior
    inverse = np.linalg.inv(hessian)
    by_column = (free * pull).reshape(n_free, n_columns, -1).sum(axis=2)
    spread = by_column - by_column.mean(axis=1, keepdims=True)
    step, covariance = np.zeros(6), np.zeros((6, 6))
    towards = prior[:, 2:] @ values[2:n_free]
    step[:n_free] = inverse @ (flat @ pull.ravel() - towards)
    covariance[:n_free, :n_free] = inverse @ (spread @ spread.T) @ inverse * n_columns / max(n_columns - 1, 1)
    return step, covariance


def curvature_chi_square(values: FloatArray, covariance: FloatArray) -> float:
    """Chi-square of a bend against none, from a row-time map (6,) and its covariance."""
    curvature = values[2:]
    return float(curvature @ np.linalg.solve(covariance[2:, 2:] + 1e-8 * np.diag(BEND_SCALE**2), curvature))
