"""The camera once more, from decoded slots: start, period and bend by least squares, and exposure.

The slots, as probabilities seen through the exposure, predict the light of every strip on every row. What is missing
is the derivative with respect to time.
"""

from dataclasses import dataclass, replace

import numpy as np

from rxcli.numerics import TINY, local_mean
from rxcli.receiver.camera.curvature import LENS_PRECISION, curvature_terms
from rxcli.receiver.camera.proposals import CameraHypothesis
from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.strips import ColumnStrips, joined
from rxcli.receiver.light import LONG_EXPOSURE_SLOTS, SlotLight, column_light
from rxcli.types import Clock, Float32Array, FloatArray, IntArray


def settle(
    strips: ColumnStrips,
    hypothesis: CameraHypothesis,
    clock: Clock,
    lit: Float32Array,
    light_spread: float,
) -> tuple[CameraHypothesis, float]:
    """The hypothesis fitted to decoded slots, and how far that moves the clock anywhere on the screen, slots.

    It comes back as it was, moved by nothing, where the slots explain too little.

    Args:
        strips: with rows in readout order.
        hypothesis: the camera that the slots were received with.
        clock: on which the slots stand, rows in readout order.
        lit: (C, N) probability that each slot of the clock's grid is lit.
        light_spread: sigma of the Gaussian that a column's light falls off with, column pitches.
    """
    model = _Model(
        joined(strips, max(1, int(clock.rows_per_slot / SETTINGS.rows_per_width))),
        lit,
        light_spread,
        clock.rows_per_slot,
    )
    start = np.concatenate([[clock.row0, clock.rows_per_slot], _turned(hypothesis.curvature, hypothesis)])
    least = hypothesis.stated_exposure_slots
    exposure, exposure_sd = max(clock.exposure_slots, least), 0.0
    straight, bent = np.array([0, 1]), np.arange(2, start.size)
    # A longer one is known better by the changes of the light, and rows per slot and bend by the line of these.
    is_long = exposure > LONG_EXPOSURE_SLOTS
    may_bend = strips.may_bend and not is_long
    if is_long:
        straight = straight[:1]
    else:
        exposure, exposure_sd = model.exposure(start, exposure)
        exposure = max(exposure, least)
    values, covariance, near = model.fit(start, exposure, np.append(straight, bent) if may_bend else straight)
    # Four coefficients more have to explain more than chance does (Bayesian information criterion).
    n_independent = model.strips.light.size / SETTINGS.samples_per_independent
    chi_square = values[2:] @ np.linalg.solve(covariance[2:, 2:] + TINY * np.eye(bent.size), values[2:])
    if may_bend and chi_square < bent.size * np.log(n_independent):
        values, covariance, near = model.fit(values * (np.arange(values.size) < 2), exposure, straight)
    if near.explained < SETTINGS.min_explained:
        return hypothesis, 0.0
    moved = float((np.abs(model.times(values) - model.times(start)) * model.strips.inside).max())
    sd = np.sqrt(np.diag(covariance))
    found = replace(
        hypothesis,
        rows_per_slot=float(values[1]),
        rows_per_slot_sd=hypothesis.rows_per_slot_sd if is_long else float(sd[1]),
        curvature=_turned(values[2:], hypothesis),
        curvature_sd=hypothesis.curvature_sd if is_long else sd[2:],
        exposure_slots=exposure,
        exposure_slots_sd=exposure_sd if exposure > least else 0.0,
    )
    return found, moved


def _turned(curvature: FloatArray, hypothesis: CameraHypothesis) -> FloatArray:
    """A bend with rows in the order of readout for one with rows as stored, or the other way round."""
    return curvature * np.array([1.0, 1.0, -1.0, 1.0]) if hypothesis.reversed else curvature


@dataclass(frozen=True, slots=True)
class _Near:
    """The light of strips (M, R) as a local level plus a local gain times a wave."""

    gain: Float32Array
    residual: Float32Array
    #: Inverse variance of the residuals thereabouts, noise included; 0 off the screen.
    weight: Float32Array
    #: Share of the light's local variance that the wave explains.
    explained: float


class _Model:
    """Strips in readout order, and the slots (C, N) that explain their light.

    A row-time map is (6,) start, rows per slot, k1, k2, p1, p2.
    """

    def __init__(self, strips: ColumnStrips, lit: Float32Array, light_spread: float, rows_per_slot: float) -> None:
        shares = column_light(strips.light.shape[0], strips.n_columns, light_spread)
        mixed = np.asarray(shares / shares.sum(axis=1, keepdims=True) @ lit, np.float32)
        self.strips = strips
        self._slots = SlotLight(mixed)
        self._window = max(round(SETTINGS.picture_slots * rows_per_slot / strips.pitch), 1)
        self._inside = np.maximum(local_mean(strips.inside, self._window), np.float32(1 / self._window))
        self._mean = self._local(strips.light)
        self._terms = curvature_terms(strips.x, strips.rows, strips.width, strips.height)

    def times(self, values: FloatArray) -> Float32Array:
        """(M, R) slot position of every strip's row."""
        bent = self.strips.rows - values[0] + np.tensordot(values[2:], self._terms, 1)
        return np.asarray(bent / values[1], np.float32)

    def exposure(self, values: FloatArray, exposure_slots: float) -> tuple[float, float]:
        """The exposure near one that leaves least, and its standard deviation, slots."""
        times, tried = self.times(values), exposure_slots * SETTINGS.exposure_ratio ** np.array([1.0, 0.0, -1.0])
        left = [1 - self._near(self._slots.mean_over(times, exposure)).explained for exposure in tried.tolist()]
        misfit = np.log(np.maximum(left, TINY))
        at = int(np.clip(misfit.argmin(), 1, tried.size - 2))
        curve, slope, _ = np.polyfit(tried[at - 1 : at + 2], misfit[at - 1 : at + 2], 2)
        if curve <= 0:
            return float(tried[misfit.argmin()]), exposure_slots / 2
        n_slots = self.strips.n_columns * float(np.ptp(self.strips.rows)) / values[1]
        return float(np.clip(-slope / (2 * curve), tried[0], tried[-1])), float(np.sqrt(1 / (curve * n_slots)))

    def fit(self, values: FloatArray, exposure_slots: float, free: IntArray) -> tuple[FloatArray, FloatArray, _Near]:
        """Gauss-Newton on the values of the numbers `free`: the row-time map, its covariance, the fit."""
        times = self.times(values)
        for _ in range(SETTINGS.settle_steps):
            wave, slope = self._slots.mean_and_slope(times, exposure_slots)
            near = self._near(wave)
            step, covariance = self._step(values, times, near, slope, free)
            values = values + step
            before, times = times, self.times(values)
            if float(np.abs(times - before).max()) < SETTINGS.converged_slots:
                break
        return values, covariance, near

    def _local(self, values: Float32Array) -> Float32Array:
        """Mean of values (M, R) over the screen within the window."""
        return np.asarray(local_mean(values * self.strips.inside, self._window) / self._inside)

    def _near(self, wave: Float32Array) -> _Near:
        light, inside = self.strips.light, self.strips.inside
        mean = self._local(wave)
        covariance = self._local(light * wave) - self._mean * mean
        variance = self._local(wave * wave) - mean * mean
        gain = np.asarray(np.maximum(covariance, 0) / (variance + np.float32(0.02)), np.float32)
        residual = (light - self._mean - gain * (wave - mean)) * inside
        weight = inside / (self._local(residual * residual) + self.strips.noise.variance(self._mean))
        power, left = (float((square * weight).sum()) for square in (gain * gain * variance, residual * residual))
        return _Near(gain, residual, weight, power / max(power + left, TINY))

    def _step(
        self, values: FloatArray, times: Float32Array, near: _Near, slope: Float32Array, free: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Step (6,) of the row-time map and its covariance, by what the columns differ in."""
        power = near.gain * slope
        pull, information = near.weight * power * near.residual, (near.weight * power * power).ravel()
        jacobian = np.concatenate([np.full((1, *times.shape), -1.0), -times[None], self._terms])[free] / values[1]
        flat = jacobian.reshape(free.size, -1)
        prior = np.zeros((values.size, values.size))
        prior[2:, 2:] = SETTINGS.samples_per_independent * LENS_PRECISION
        prior = prior[np.ix_(free, free)]
        inverse = np.linalg.inv((flat * information) @ flat.T + prior + TINY * np.eye(free.size))
        step = np.zeros_like(values)
        step[free] = inverse @ (flat @ pull.ravel() - prior @ values[free])
        n_columns = self.strips.n_columns
        by_column = (jacobian * pull).reshape(free.size, n_columns, -1).sum(axis=2)
        by_column -= by_column.mean(axis=1, keepdims=True)
        scale = SETTINGS.sd_scale**2 * n_columns / max(n_columns - 1, 1)
        covariance = np.zeros((values.size, values.size))
        covariance[np.ix_(free, free)] = scale * inverse @ (by_column @ by_column.T) @ inverse
        return step, covariance
