"""Exposure from the blur of a lamp's edges: a switched lamp through an exposure is a trapezoid in every period."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rxcli.calibrate.fitting import Z95
from rxcli.calibrate.periodic import PeriodicFit, fit_periodic
from rxcli.types import FloatArray

#: A trapezoid explains at least this share of the variance; its edges are at most, its plateaus at least this long,
#: cycles. A sine is fitted best by edges of 0.35 cycles.
_MIN_EXPLAINED, _MAX_EDGE, _MIN_PLATEAU = 0.985, 0.25, 0.1
#: Shortest edge that is not a step, rows.
_MIN_EDGE_ROWS = 0.5
#: Largest ratio of the file's exposure and the one that the edges give.
_EXIF_RATIO = 1.4
#: Bins of a period in which the fit's start is sought.
_BINS = 64


@dataclass(frozen=True, slots=True)
class ExposureEstimate:
    """Exposure, or the reason why there is none."""

    exposure_s: float | None
    #: 95 % confidence interval, from the edges' blur alone.
    interval_s: tuple[float, float] | None
    comment: str


def estimate_exposure(
    fit: PeriodicFit, profile: FloatArray, line_delay_s: float, exif_exposure_s: float | None, tone_known: bool
) -> ExposureEstimate:
    """Exposure from the rise and fall of a switched lamp's stripes.

    A lamp that is on for `on` of every period gives, through an exposure `te`, trapezoids that rise over `min(te, on)`
    and are `max(te, on)` wide at half height. The waveform does not show which is which: the file's exposure decides;
    without it the exposure is taken to be the shorter one.

    Args:
        fit: the region's fit.
        profile: (n,) the values fitted, proportional to light.
        line_delay_s: time between rows.
        exif_exposure_s: exposure in the file, None where it states none.
        tone_known: whether the profile is known to be proportional to light; if not, the interval includes the result
            for a display's tone curve.
    """
    found = _from_wave(fit, profile, line_delay_s, exif_exposure_s)
    if tone_known or found.interval_s is None:
        return found
    encoded = np.clip(profile, 0, None) ** (1 / 2.2)
    linear_fit = fit_periodic(encoded, fit.frequency, fit.first_row)
    linear = _from_wave(linear_fit, encoded, line_delay_s, exif_exposure_s) if linear_fit else found
    low, high = zip(found.interval_s, linear.interval_s or found.interval_s, strict=True)
    comment = f"{found.comment}; the picture's tone curve is not known"
    return replace(found, interval_s=(min(low), max(high)), comment=comment)


def _from_wave(
    fit: PeriodicFit, profile: FloatArray, line_delay_s: float, exif_exposure_s: float | None
) -> ExposureEstimate:
    """Exposure from values assumed proportional to light."""
    from scipy.optimize import least_squares

    usable = fit.envelope > 0.2 * fit.envelope.max()
    wave = ((profile - fit.mean) / np.where(usable, fit.envelope, 1))[usable]
    phase = np.asarray((fit.frequency * (fit.first_row + np.flatnonzero(usable) - fit.origin)) % 1, np.float64)
    start = _start(phase, wave)
    options = {"jac": "3-point", "method": "lm", "x_scale": "jac", "xtol": 1e-10}
    shape: Any = start and least_squares(lambda state: _trapezoid(phase, state) - wave, start, **options)
    total = max(float(np.sum((wave - wave.mean()) ** 2)), 1e-300)
    if shape is None or 1 - float(shape.fun @ shape.fun) / total < _MIN_EXPLAINED:
        return ExposureEstimate(None, None, "the lamp is not switched on and off sharply, or the picture is too noisy")
    rise, fall, edge = (float(value) for value in shape.x[:3])
    edge, lit = abs(edge), (fall - rise) % 1
    variance = float(shape.fun @ shape.fun) / max(wave.size - shape.x.size, 1)
    covariance = np.linalg.pinv(shape.jac.T @ shape.jac) * variance
    edge_sd = float(np.sqrt(covariance[2, 2]))
    lit_sd = float(np.sqrt(max(covariance[0, 0] + covariance[1, 1] - 2 * covariance[0, 1], 0)))
    if edge > _MAX_EDGE or min(lit, 1 - lit) - edge < _MIN_PLATEAU:
        return ExposureEstimate(None, None, "the stripes have no plateaus; use a slower lamp or a shorter exposure")
    period_s = line_delay_s / fit.frequency
    if edge < max(_MIN_EDGE_ROWS * fit.frequency, 3 * edge_sd):
        longest = (edge + Z95 * edge_sd) * period_s
        return ExposureEstimate(None, None, f"edges too sharp to be measured: the exposure is below {longest:.2g} s")
    part, sd, comment = edge, edge_sd, "taken to be shorter than the lamp's flash and pause"
    if exif_exposure_s is not None:
        parts = [(edge, edge_sd), (lit, lit_sd), (1 - lit, lit_sd)]
        nearest = min(parts, key=lambda p: abs(np.log(p[0] * period_s / exif_exposure_s)))
        comment = f"the file states {exif_exposure_s:.4g} s, which the edges contradict"
        if abs(np.log(nearest[0] * period_s / exif_exposure_s)) <= np.log(_EXIF_RATIO):
            (part, sd), comment = nearest, f"agrees with the file's {exif_exposure_s:.4g} s"
    interval = max(part - Z95 * sd, 0.0) * period_s, (part + Z95 * sd) * period_s
    return ExposureEstimate(part * period_s, interval, comment)


def _start(phase: FloatArray, wave: FloatArray) -> list[float] | None:
    """Rise, fall, edge length, low level and height from the half-height crossings of the folded wave."""
    index = np.minimum((phase * _BINS).astype(int), _BINS - 1)
    counts = np.bincount(index, minlength=_BINS)
    filled = np.flatnonzero(counts)
    if 2 * filled.size < _BINS:
        return None
    means = np.bincount(index, wave, _BINS)[filled] / counts[filled]
    folded = np.interp(np.arange(_BINS), filled, means, period=_BINS)
    low, high = np.quantile(folded, [0.02, 0.98])
    steps = np.diff((folded > (low + high) / 2).astype(int), prepend=folded[-1] > (low + high) / 2)
    if np.abs(steps).sum() != 2:
        return None
    share = float(np.mean(np.abs(folded - (low + high) / 2) < 0.35 * (high - low)))
    edge = min(max(share / 1.4, 0.01), 0.5)
    return [int(np.argmax(steps)) / _BINS, int(np.argmin(steps)) / _BINS, edge, float(low), float(high - low)]


def _trapezoid(phase: FloatArray, state: FloatArray) -> FloatArray:
    """Light at `phase`: rise and fall are ramps of one length about their middles."""
    rise, fall, edge, low, height = state
    lit = (fall - rise) % 1
    # About the middle of the lit part every period has one rise on the left and one fall on the right.
    distance = np.abs((phase - rise - lit / 2 + 0.5) % 1 - 0.5)
    return np.asarray(low + height * np.clip(0.5 + (lit / 2 - distance) / max(abs(edge), 1e-4), 0, 1))
