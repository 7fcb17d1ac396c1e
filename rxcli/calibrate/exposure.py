"""Exposure from the blur of a lamp's edges: a switched lamp through an exposure is a trapezoid in every period."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.calibrate.periodic import PeriodicFit, fit_periodic
from rxcli.types import FloatArray

#: What a trapezoid must explain, how long its edges may be and its plateaus must be (cycles), to be one: a sine is
#: met best by edges of 0.35.
_MIN_EXPLAINED, _MAX_EDGE, _MIN_PLATEAU = 0.985, 0.25, 0.1
#: Shortest edge that can be told from a step, rows.
_MIN_EDGE_ROWS = 0.5
#: How near the file's exposure must be to one that the edges allow.
_EXIF_RATIO = 1.4
_Z95 = 1.959964


@dataclass(frozen=True, slots=True)
class ExposureEstimate:
    """Exposure, or why there is none."""

    exposure_s: float | None
    #: 95 % confidence interval, of the edges' blur alone.
    interval_s: tuple[float, float] | None
    note: str


@dataclass(frozen=True, slots=True)
class _Trapezoid:
    """Edge length, lit width at half height, in cycles, and how well it fits."""

    edge: float
    edge_sd: float
    lit: float
    lit_sd: float
    explained: float


def estimate_exposure(
    fit: PeriodicFit,
    profile: FloatArray,
    line_delay_s: float,
    exif_exposure_s: float | None = None,
    tone_known: bool = True,
) -> ExposureEstimate:
    """Exposure from the rise and fall of a switched lamp's stripes.

    A lamp that is on for `on` of every period, through an exposure `te`, gives trapezoids that rise over
    `min(te, on)` and are `max(te, on)` wide at half height; its dark part does the same. Which is which the waveform
    cannot tell. The file's own exposure does; without it the exposure is taken to be the shorter.

    Args:
        fit: the region's fit.
        profile: (n,) the values fitted, proportional to light.
        line_delay_s: time between rows.
        exif_exposure_s: exposure as the file says.
        tone_known: whether the profile is surely proportional to light; if not, the interval is widened to what a
            display's tone curve, left in, would give.
    """
    found = _from_wave(fit, profile, line_delay_s, exif_exposure_s)
    if tone_known or found.exposure_s is None or found.interval_s is None:
        return found
    encoded = np.clip(profile, 0, None) ** (1 / 2.2)
    other_fit = fit_periodic(encoded, fit.frequency, fit.first_row)
    other = _from_wave(other_fit, encoded, line_delay_s, exif_exposure_s) if other_fit else found
    low, high = other.interval_s or found.interval_s
    widened = (min(low, found.interval_s[0]), max(high, found.interval_s[1]))
    return ExposureEstimate(found.exposure_s, widened, f"{found.note}; the picture's tone curve is not known")


def _from_wave(
    fit: PeriodicFit, profile: FloatArray, line_delay_s: float, exif_exposure_s: float | None
) -> ExposureEstimate:
    """Exposure from values taken to be light."""
    rows = fit.first_row + np.arange(profile.size) - fit.origin
    usable = fit.envelope > 0.2 * fit.envelope.max()
    wave = ((profile - fit.mean) / np.where(usable, fit.envelope, 1))[usable]
    shape = _fit_trapezoid((fit.frequency * rows[usable]) % 1, wave)
    if shape is None or shape.explained < _MIN_EXPLAINED:
        return ExposureEstimate(None, None, "the lamp is not switched on and off sharply, or the picture is too noisy")
    plateau = min(shape.lit, 1 - shape.lit) - shape.edge
    if shape.edge > _MAX_EDGE or plateau < _MIN_PLATEAU:
        return ExposureEstimate(None, None, "the stripes have no plateaus; use a slower lamp or a shorter exposure")
    if shape.edge < max(_MIN_EDGE_ROWS * fit.frequency, 3 * shape.edge_sd):
        longest = (shape.edge + _Z95 * shape.edge_sd) / fit.frequency * line_delay_s
        return ExposureEstimate(None, None, f"edges too sharp to be measured: the exposure is below {longest:.2g} s")
    period_s = line_delay_s / fit.frequency
    return _assign(shape, period_s, exif_exposure_s)


def _assign(shape: _Trapezoid, period_s: float, exif_exposure_s: float | None) -> ExposureEstimate:
    """Which part of the trapezoid is the exposure."""
    parts = [(shape.edge, shape.edge_sd), (shape.lit, shape.lit_sd), (1 - shape.lit, shape.lit_sd)]
    if exif_exposure_s is None:
        return _estimate(*parts[0], period_s, "taken to be shorter than the lamp's flash and pause")
    apart = [abs(float(np.log(part * period_s / exif_exposure_s))) for part, _ in parts]
    nearest = int(np.argmin(apart))
    if apart[nearest] > np.log(_EXIF_RATIO):
        note = f"the file says {exif_exposure_s:.4g} s, which the edges do not bear out"
        return _estimate(*parts[0], period_s, note)
    return _estimate(*parts[nearest], period_s, f"agrees with the file's {exif_exposure_s:.4g} s")


def _estimate(part: float, sd: float, period_s: float, note: str) -> ExposureEstimate:
    low, high = max(part - _Z95 * sd, 0.0), part + _Z95 * sd
    return ExposureEstimate(part * period_s, (low * period_s, high * period_s), note)


def _fit_trapezoid(phase: FloatArray, wave: FloatArray) -> _Trapezoid | None:
    """Levenberg-Marquardt on rise and fall (their middles) and edge length; the two levels are linear."""
    start = _start(phase, wave)
    if start is None:
        return None
    state, damping = start, 1e-3
    residual, jacobian = _residual(phase, wave, state)
    for _ in range(40):
        normal = jacobian.T @ jacobian
        step = np.linalg.lstsq(normal + damping * np.diag(np.diag(normal)), -jacobian.T @ residual, rcond=None)[0]
        trial = state + np.clip(step, -0.05, 0.05)
        trial[2] = float(np.clip(trial[2], 1e-4, 0.6))
        new_residual, new_jacobian = _residual(phase, wave, trial)
        if new_residual @ new_residual < residual @ residual:
            state, residual, jacobian, damping = trial, new_residual, new_jacobian, damping / 4
        else:
            damping *= 6
    # Neighbouring rows of one edge err together, by about as many as an edge has.
    variance = float(residual @ residual) / max(wave.size - 5, 1)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * variance
    lit_sd = float(np.sqrt(max(covariance[0, 0] + covariance[1, 1] - 2 * covariance[0, 1], 0)))
    explained = 1 - float(residual @ residual) / max(float(np.sum((wave - wave.mean()) ** 2)), 1e-300)
    lit = float((state[1] - state[0]) % 1)
    return _Trapezoid(float(state[2]), float(np.sqrt(covariance[2, 2])), lit, lit_sd, explained)


def _start(phase: FloatArray, wave: FloatArray) -> FloatArray | None:
    """Rise, fall and edge length from the half-height crossings of the folded wave."""
    bins = 64
    index = np.minimum((phase * bins).astype(int), bins - 1)
    counts = np.bincount(index, minlength=bins)
    if (counts == 0).sum() > bins // 2:
        return None
    centres = (np.arange(bins) + 0.5) / bins
    filled = counts > 0
    means = np.bincount(index, wave, bins)[filled] / counts[filled]
    folded = np.interp(centres, centres[filled], means, period=1)
    low, high = np.quantile(folded, [0.02, 0.98])
    lit = folded > (low + high) / 2
    rises = np.flatnonzero(lit & ~np.roll(lit, 1))
    falls = np.flatnonzero(~lit & np.roll(lit, 1))
    if len(rises) != 1 or len(falls) != 1:
        return None
    between = float(np.mean((folded > low + 0.15 * (high - low)) & (folded < high - 0.15 * (high - low))))
    return np.array([rises[0] / bins, falls[0] / bins, float(np.clip(between / 1.4, 0.01, 0.5))])


def _shape(phase: FloatArray, state: FloatArray) -> FloatArray:
    """Trapezoid of height 1: rise and fall are ramps of one length about their middles."""
    rise, fall, edge = state
    lit = (fall - rise) % 1
    # Measured from the middle of the lit part every period has one rise on the left and one fall on the right.
    distance = np.abs((phase - rise - lit / 2 + 0.5) % 1 - 0.5)
    return np.asarray(np.clip(0.5 + (lit / 2 - distance) / edge, 0, 1))


def _residual(phase: FloatArray, wave: FloatArray, state: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n,) residual with the best levels, and its (n, 3) numerical Jacobian."""

    def at(values: FloatArray) -> FloatArray:
        design = np.column_stack([np.ones_like(wave), _shape(phase, values)])
        return np.asarray(design @ np.linalg.lstsq(design, wave, rcond=None)[0] - wave)

    step = 1e-5
    shifts = np.eye(3) * step
    jacobian = np.column_stack([(at(state + shift) - at(state - shift)) / (2 * step) for shift in shifts])
    return at(state), jacobian
