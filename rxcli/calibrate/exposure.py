"""Exposure from the blur of a lamp's edges: a switched lamp through an exposure is a trapezoid in every period."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.calibrate.periodic import PeriodicFit
from rxcli.types import FloatArray

#: Values (0 dark, 1 lit) between which an edge is measured: clear of rounding, ringing and clipping.
_LOW, _HIGH = 0.1, 0.9
_BINS_PER_ROW = 4


@dataclass(frozen=True, slots=True)
class ExposureEstimate:
    """Exposure, or why there is none."""

    exposure_s: float | None
    interval_s: tuple[float, float] | None
    note: str


def estimate_exposure(
    fit: PeriodicFit,
    profile: FloatArray,
    line_delay_s: float,
    frequency_hz: float,
    exif_exposure_s: float | None = None,
    linear: bool = False,
) -> ExposureEstimate:
    """Exposure from the rise and fall of a switched lamp's stripes.

    A lamp that is on for `on` and an exposure `te` give trapezoids that rise over `min(te, on)` and are
    `max(te, on)` wide at half height. Which is which the waveform cannot tell; the file's own exposure does, and
    without it the lamp is taken to be on for longer than the exposure.

    Args:
        fit: the region's fit.
        profile: (n,) the values fitted.
        line_delay_s: time between rows.
        frequency_hz: the lamp's frequency.
        exif_exposure_s: exposure as the file says.
        linear: whether the values are proportional to light; if not, an sRGB-like tone curve is undone.
    """
    phase, level = _normalised(fit, profile, linear)
    if level is None:
        return ExposureEstimate(None, None, "the stripes are too faint for an edge to be measured")
    return ExposureEstimate(None, None, "todo")


def _normalised(fit, profile, linear):
    return None, None
