"""Exposure from the blur of a lamp's edges."""

from dataclasses import dataclass, replace

import numpy as np

from rxcli.calibrate.periodic import PeriodicFit, fit_periodic
from rxcli.calibrate.waveform import BLURS_ROWS, fit_switched, lamp_wave
from rxcli.types import FloatArray

#: Exposures that are tried: shortest in rows, longest in periods, how many.
_SHORTEST_ROWS, _LONGEST, _N_TRIED = 0.2, 0.25, 60
#: Shortest edge that is not a step, rows.
_MIN_EDGE_ROWS = 0.5
#: Largest ratio of the file's exposure and the one that the edges give.
_EXIF_RATIO = 1.4


@dataclass(frozen=True, slots=True)
class ExposureEstimate:
    """Exposure, or the reason why there is none."""

    exposure_s: float | None
    #: 95 % confidence interval; the blur of the picture may be a part of the edges.
    interval_s: tuple[float, float] | None
    comment: str


def estimate_exposure(
    fit: PeriodicFit, profile: FloatArray, line_delay_s: float, exif_exposure_s: float | None, tone_known: bool
) -> ExposureEstimate:
    """Exposure from the rise and fall of a switched lamp's stripes.

    A lamp that is on for `on` of every period gives, through an exposure `te`, trapezoids that rise over `min(te, on)`
    and are `max(te, on)` wide at half height. The waveform does not show which is which: the file's exposure decides;
    without it the exposure is taken to be the shorter one. Blur of the picture widens the edges, too.

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
    period_s, shortest = line_delay_s / fit.frequency, min(_SHORTEST_ROWS * fit.frequency, _LONGEST / 2)
    wave, tried = lamp_wave(fit, profile), np.geomspace(shortest, _LONGEST, _N_TRIED)
    # The picture's blur is a part of the edges that is not known: the estimate is without, the interval with it.
    found = fit_switched(wave, tried, BLURS_ROWS[:1])
    blurred = fit_switched(wave, tried)
    if not found.fits:
        return ExposureEstimate(None, None, "the lamp is not switched on and off sharply, or the picture is too noisy")
    short, share, comment = found.exposure, found.share, "taken to be shorter than the lamp's flash and pause"
    exposures = short
    if exif_exposure_s is not None:
        # A flash through an exposure looks like its reverse, and dark stripes look like bright ones.
        ways = (short, share, 1 - share)
        exposures = min(ways, key=lambda way: abs(np.log(way[0] * period_s / exif_exposure_s)))
        comment = f"agrees with the file's {exif_exposure_s:.4g} s"
        if abs(np.log(exposures[0] * period_s / exif_exposure_s)) > np.log(_EXIF_RATIO):
            exposures, comment = ways[0], f"the file states {exif_exposure_s:.4g} s, which the edges contradict"
    is_edge = exposures[0] <= _LONGEST
    low, high = 0.99 * float(exposures.min() * period_s), 1.01 * float(exposures.max() * period_s)
    low = min(low, float(blurred.exposure.min() * period_s)) if is_edge else low
    if exposures[0] < _MIN_EDGE_ROWS * fit.frequency:
        return ExposureEstimate(
            None, (0.0, high), f"edges too sharp to be measured: the exposure is below {high:.2g} s"
        )
    return ExposureEstimate(float(exposures[0] * period_s), (low, high), comment)
