"""The clock, the bend and the exposure that fit all light of a picture best."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import local_mean
from rxcli.receiver.camera.curvature import BEND_PRECISION, BEND_SCALE
from rxcli.receiver.camera.estimates import BlindEstimate
from rxcli.receiver.camera.reading import Packets, Reading, read_slots
from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.strips import Correction, Strips
from rxcli.receiver.camera.structure import repeat_evidence
from rxcli.receiver.camera.views import BLOCK_ROWS, View, Views, slot_time
from rxcli.receiver.camera.waves import (
    Grid,
    Moments,
    Slots,
    Surroundings,
    Waves,
    column_shares,
    column_waves,
    decide,
    exposure_of_known,
    packet_llr,
    residual_of,
)
from rxcli.receiver.light import SlotLight
from rxcli.types import Float32Array, FloatArray

#: Of the prior: next to nothing is known of start and period, which slots that tell nothing leave as they are.
_PRECISION: FloatArray = np.diag([1e-6] * 6)
_PRECISION[2:, 2:] = BEND_PRECISION


#: Chi-square of the four coefficients that a bend beyond doubt has, by whether the picture was corrected. Columns share
#: too much for it to be taken at its word: unbent pictures reach 150.
_BENT_CHI_SQUARE: dict[Correction, float] = {"no": np.inf, "likely": 30.0, "unknown": 160.0}

#: Keeps the clock of a row-time map and drops its bend.
FLAT = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, slots=True)
class _Timing:
    """Row-time map: slot position of row s is (s + bend - start) / rows_per_slot."""

    #: start, rows_per_slot, k1, k2, p1, p2.
    values: FloatArray
    #: (6, 6) covariance of the values.
    covariance: FloatArray
    exposure_slots: float
    exposure_sd: float
    #: Share of the strips' local variance that the slots explain.
    explained: float
    slots: Slots
    #: Light by slot position that the slots were decided from.
    waves: Waves


def refine(
    views: Views,
    reading: Reading,
    packet_lengths: Sequence[int],
    exposure_of_length: Callable[[int], float],
    sure: bool = False,
) -> list[BlindEstimate]:
    """The clock, the bend and the exposure that fit all light of the picture best; once for every likely packet.

    Args:
        views: of the picture's strips.
        reading: slots that were read on a clock.
        packet_lengths: slots of a packet, of every screen in question.
        exposure_of_length: exposure that the file tells in slots of a screen with packets of a length, 0 where it
            does not; optics and demosaicing add to it.
        sure: whether the stripes are bent without doubt.
    """
    view = views.at(reading.rows_per_slot, reading.is_reversed)
    least = exposure_of_length(reading.packets[0].packet_slots)
    for _ in range(SETTINGS.most_readings):
        timing, corrected = _fit_timing(view, reading, least, sure)
        moved = _moved(view, reading, timing)
        if moved < SETTINGS.far_slots and reading.log_evidence > SETTINGS.read_surely_nats:
            again = reading
            break
        again = _read_again(views, reading, timing, packet_lengths)
        if again.log_evidence <= reading.log_evidence or moved < SETTINGS.far_slots:
            break
        reading = again
    likely = [
        packets
        for packets in again.packets
        if packets.log_evidence > again.packets[0].log_evidence - SETTINGS.another_length_nats
    ]
    found, sd = timing.values[2:], SETTINGS.understated_spread * np.sqrt(np.diag(timing.covariance))
    return [
        BlindEstimate(
            rows_per_slot=float(timing.values[1]),
            rows_per_slot_sd=float(sd[1]),
            packet_slots=packets.packet_slots,
            reversed=view.reversed,
            exposure_slots=max(timing.exposure_slots, exposure_of_length(packets.packet_slots)),
            exposure_slots_sd=timing.exposure_sd,
            curvature=view.curvature(found),
            curvature_sd=sd[2:],
            corrected=corrected,
            log_evidence=_log_evidence(timing, packets, packets is reading.packets[0]),
            explained=timing.explained,
            least_exposure_slots=exposure_of_length(packets.packet_slots),
            side_curvature=view.strips.side_curvature,
        )
        for packets in likely
    ]


def _read_again(views: Views, reading: Reading, timing: _Timing, packet_lengths: Sequence[int]) -> Reading:
    """The slots read freely on a refined clock."""
    return read_slots(views, reading.rows_per_slot, reading.is_reversed, timing.values, packet_lengths)


def _moved(view: View, reading: Reading, timing: _Timing) -> float:
    """Slots by which the clock moved anywhere on the picture."""
    before, after = (slot_time(view.strips, view.terms, one.values) for one in (reading, timing))
    return float(np.abs(after - before)[:, ::BLOCK_ROWS].max())


def _log_evidence(timing: _Timing, packets: Packets, decided: bool) -> float:
    """Log-likelihood ratio of the slots being packets, at levels that fit them as such; they may be `decided` so."""
    grid, slots = packets.grid, timing.slots
    if not decided:
        slots = decide(timing.waves, timing.exposure_slots, grid, Slots(slots.lit, packets.w))
    position = (np.arange(slots.lit.shape[1]) + grid.first_slot) % grid.packet_slots
    packets_llr = packet_llr(timing.waves, timing.exposure_slots, grid, slots)
    return packets_llr + repeat_evidence(slots.lit > 0.5, position, grid.packet_slots)


def _fit_timing(view: View, reading: Reading, least_exposure_slots: float, sure: bool) -> tuple[_Timing, bool]:
    """The row-time map, with a bend only where it is beyond doubt: one that is free for nothing blurs the period."""
    packets = reading.packets[0]
    slots = Slots(reading.lit, packets.w)
    correction = view.strips.correction
    n_free = 2 if correction == "no" else 6
    first = _descend(view, packets.grid, reading.values, slots, n_free, least_exposure_slots)
    if sure or curvature_chi_square(first.values, first.covariance) > _BENT_CHI_SQUARE[correction]:
        return first, True
    if correction == "no":
        return first, False
    values = (first.values if reading.values[2:].any() else reading.values) * FLAT
    flat = _descend(view, packets.grid, values, first.slots, 2, first.exposure_slots, estimating=False)
    return replace(flat, exposure_sd=first.exposure_sd), False


def _descend(
    view: View,
    grid: Grid,
    values: FloatArray,
    slots: Slots,
    n_free: int,
    exposure_slots: float,
    *,
    estimating: bool = True,
) -> _Timing:
    """Gauss-Newton on the first `n_free` values of the row-time map, deciding the slots anew at every step.

    The exposure is at least the one given, or that one where it is not to be estimated.
    """
    strips, terms = view.strips, view.terms
    exposure, exposure_sd = exposure_slots, 0.0
    change, factor, period = np.zeros(6), 1.0, float(values[1])
    for step in range(SETTINGS.refine_steps):
        time = slot_time(strips, terms, values)
        waves = column_waves(view, time)
        if estimating and step in SETTINGS.exposure_steps:
            exposure, exposure_sd = exposure_of_known(waves, slots.lit, exposure if step else None)
            exposure, exposure_sd = (exposure, exposure_sd) if exposure > exposure_slots else (exposure_slots, 0.0)
        slots = decide(waves, exposure, grid, slots)
        free = n_free if step >= SETTINGS.rigid_steps or values[2:].any() else 2
        observed = seen_by_strips(strips, time, slots.lit, exposure)
        before, (change, covariance, explained) = (
            change,
            gauss_newton(strips, terms, values, time, observed, free),
        )
        factor = _extrapolation(before, change, covariance)
        following = values + factor * change
        moved = float(np.abs(slot_time(strips, terms, following)[:, ::BLOCK_ROWS] - time[:, ::BLOCK_ROWS]).max())
        if not (0.5 < following[1] / period < 2.0 and moved < grid.packet_slots):
            break  # no step of a clock that was read: nothing here looks like slots
        values = following
        if moved < SETTINGS.converged_slots and step >= SETTINGS.least_steps - 1:
            break
    return _Timing(values, covariance, exposure, exposure_sd, explained, slots, waves)


def _extrapolation(before: FloatArray, change: FloatArray, covariance: FloatArray) -> float:
    """How much further than a step to go, where each is some share of the one before: slots follow the clock slowly."""
    metric = np.linalg.pinv(covariance[:2, :2])
    length = float(before[:2] @ metric @ before[:2])
    ratio = float(before[:2] @ metric @ change[:2]) / length if length > 0 else 0.0
    return min(1 / (1 - min(ratio, 0.9)), SETTINGS.most_extrapolated) if ratio > SETTINGS.slow else 1.0


def seen_by_strips(
    strips: Strips, time: Float32Array, lit: Float32Array, exposure_slots: float
) -> tuple[Float32Array, Float32Array]:
    """(M, R) light 0..1 of slots (C, N) in every strip at slot positions; and its change per slot."""
    mixed = np.asarray(column_shares(strips) @ lit, np.float32)
    return SlotLight(mixed, 0.0).seen_with_slope(time, exposure_slots)


def gauss_newton(
    strips: Strips,
    terms: FloatArray,
    values: FloatArray,
    time: Float32Array,
    observed: tuple[Float32Array, Float32Array],
    n_free: int,
    local_slots: float = SETTINGS.local_slots,
    order: int = 0,
) -> tuple[FloatArray, FloatArray, float]:
    """Step of the row-time map, its covariance, and the share of variance explained before the step.

    Args:
        strips: in readout order.
        terms: see `time_terms`.
        values: (6,) the row-time map.
        time: (M, R) its slot positions.
        observed: (M, R) light 0..1 that the slots give, and its change per slot.
        n_free: values that are fitted, the first ones.
        local_slots: slots over which the picture may be taken as constant.
        order: rows by which what is left of a row is foretold; the picture's texture is alike in neighbouring rows.
    """
    wave, slope = observed
    pitch = float(strips.rows[1] - strips.rows[0])
    window = max(round(local_slots * values[1] / pitch), 1)
    inside = strips.inside
    near = Surroundings.of(strips.light, inside, window).moments(wave)
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
    prior = 1 / (np.float32(SETTINGS.gain_sd) * usual + np.float32(1e-6)) ** 2
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
    known = np.array(alike)[lags] + (SETTINGS.own_row_share * alike[0] + 1e-9) * np.eye(order)
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
    least = np.float32(SETTINGS.least_spread * float(square.sum()) / max(float(counted.sum()), 1.0) + 1e-9)
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
    prior = SETTINGS.samples_as_one * _PRECISION[:n_free, :n_free]
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
