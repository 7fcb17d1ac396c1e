"""Frequency, lit share, depth and waveform of the lamps in a picture: `calibrate shutter` the other way round."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rxcli.calibrate.periodic import fit_periodic
from rxcli.calibrate.shutter import Picture, Stripes
from rxcli.calibrate.waveform import Switched, fit_switched, lamp_wave, light_curve
from rxcli.numerics import Z95
from rxcli.types import FloatArray

#: What an exposure may differ from the file's by, and unknown exposures that are tried, periods.
_STATED, _UNKNOWN = (0.96, 1.0, 1.04), np.geomspace(0.002, 0.25, 40)
#: Widest interval of a lit share that is reported, its least error, and light from which stripes are overexposed.
_MAX_WIDTH, _MIN_ERROR, _WHITE = 0.2, 0.004, 0.98
#: Powers by which tone curves of cameras differ.
_TONES = (0.87, 1.15)
#: Exposures and frame rates that are listed: cameras have such.
_EXPOSURES_S, _RATES_HZ, _MAX_LISTED = (1 / 2000, 1 / 24), (23.0, 121.0), 5
_PANEL_PX, _WIDTH_PX = 150, 1280


@dataclass(frozen=True, slots=True)
class Timing:
    """Time between two lines, its relative standard deviation, and who states it."""

    line_delay_s: float
    relative_sd: float
    source: str


@dataclass(frozen=True, slots=True)
class Lamp:
    """One lamp; intervals hold 95 times in 100."""

    bounds: tuple[int, int, int, int]
    periods: float
    period_px: float
    period_sd_px: float
    #: None without the camera's timing.
    frequency_hz: float | None
    frequency_interval_hz: tuple[float, float] | None
    #: Lit share of the period at half height; None where the stripes leave it open.
    duty: float | None
    duty_interval: tuple[float, float] | None
    #: (brightest - darkest) / (brightest + darkest) of the light, ambient light included.
    depth: float
    depth_interval: tuple[float, float]
    #: Whether the light is switched between two levels.
    is_switched: bool
    #: (POINTS,) light over one period relative to its mean, and half the width of its interval.
    waveform: FloatArray
    waveform_error: float
    notes: tuple[str, ...]

    def exposures_s(self) -> list[float]:
        """Exposures of whole periods, which show no stripes: the shortest that cameras have."""
        return [1 / hz for hz in self._parts_hz(1 / _EXPOSURES_S[0]) if hz >= 1 / _EXPOSURES_S[1]]

    def frame_rates_hz(self) -> list[float]:
        """Frame rates at which the stripes stand still: whole parts of the frequency."""
        return [hz for hz in self._parts_hz(_RATES_HZ[1]) if hz >= _RATES_HZ[0]]

    def _parts_hz(self, highest: float) -> FloatArray:
        """The highest whole parts of the frequency up to one."""
        hz = self.frequency_hz or 0.0
        return np.asarray(hz / (max(np.ceil(hz / highest), 1) + np.arange(_MAX_LISTED)))


def measure_lamp(stripes: Stripes, timing: Timing | None, exposure_s: float | None, tone_known: bool = False) -> Lamp:
    """Measure the lamp of a region.

    Args:
        stripes: the region, of values proportional to light, 1 is white.
        timing: of the lines; None: periods in pixels only.
        exposure_s: of the picture, None where it is not known.
        tone_known: whether the values are surely proportional to light.
    """
    fit, wave = stripes.fit, lamp_wave(stripes.fit, stripes.profile)
    hz, hz_interval, exposures, notes = None, None, _UNKNOWN, list[str]()
    if timing:
        hz = fit.frequency / timing.line_delay_s
        error_hz = Z95 * hz * float(np.hypot(fit.frequency_sd / fit.frequency, timing.relative_sd))
        hz_interval = hz - error_hz, hz + error_hz
    if hz and exposure_s:
        exposures = hz * exposure_s * np.array(_STATED)
    else:
        notes.append("exposure not known: the lamp is taken to be lit, and dark, for longer than it")
    found = fit_switched(wave, exposures)
    curve, error = light_curve(wave, hz * exposure_s if hz and exposure_s else 0.0)
    if found.fits:
        ways = [found] if tone_known else [found, *_other_tones(stripes, exposures)]
        shares, depths = (np.concatenate([getattr(way, name) for way in ways]) for name in ("share", "depth"))
        duty: float | None = float(shares[0])
        interval = float(shares.min()) - _MIN_ERROR, float(shares.max()) + _MIN_ERROR
        depth, depth_interval = float(depths[0]), (float(depths.min()), float(depths.max()))
    else:
        low, high = max(float(curve.min()), 0.0), float(curve.max())
        steepest = float(np.abs(np.diff(curve)).max()) * curve.size
        duty, width = float(np.mean(curve > (low + high) / 2)), 2 * Z95 * error / max(steepest, 1e-9) + 1 / curve.size
        interval, depth = (duty - width, duty + width), (high - low) / (high + low)
        depth_interval = max(depth - Z95 * error, 0.0), min(depth + Z95 * error, 1.0)
    if interval[1] - interval[0] > _MAX_WIDTH:
        duty, notes = None, [*notes, "too few rows a stripe to measure its lit share"]
    if float(np.quantile(stripes.profile, 0.99)) > _WHITE:
        notes.append("overexposed: lit share and depth are not reliable; expose less")
    return Lamp(
        bounds=stripes.bounds,
        periods=fit.periods,
        period_px=stripes.period_px,
        period_sd_px=stripes.period_sd_px,
        frequency_hz=hz,
        frequency_interval_hz=hz_interval,
        duty=duty,
        duty_interval=None if duty is None else (max(interval[0], 0.0), min(interval[1], 1.0)),
        depth=depth,
        depth_interval=depth_interval,
        is_switched=found.fits,
        waveform=curve,
        waveform_error=Z95 * error,
        notes=tuple(notes),
    )


def _other_tones(stripes: Stripes, exposures: FloatArray) -> list[Switched]:
    """What the stripes allow if the picture's tone curve was not the one that was undone."""
    fits = []
    for power in _TONES:
        profile = np.maximum(stripes.profile, 0) ** power
        fit = fit_periodic(profile, stripes.fit.frequency, stripes.fit.first_row)
        found = fit_switched(lamp_wave(fit, profile), exposures) if fit else None
        fits += [found] if found and found.fits else []
    return fits


def draw_lamps(picture: Picture, lamps: list[Lamp], captions: list[str]) -> NDArray[np.uint8]:
    """The picture with every lamp in a colour of its frequency, as strong as its depth, and its waveform below."""
    zoom = _WIDTH_PX / picture.shape[1]
    step = max(int(1 / zoom), 1)
    grey = np.rint(200 * np.power(np.clip(picture[::step, ::step], 0, 1), 1 / 2.2)).astype(np.uint8)
    size = (_WIDTH_PX, max(round(picture.shape[0] * zoom), 1))
    canvas = cv2.cvtColor(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR)
    panel = np.full((_PANEL_PX * len(lamps), _WIDTH_PX, 3), 255, np.uint8)
    for number, (lamp, caption) in enumerate(zip(lamps, captions, strict=True)):
        colour = _colour(lamp, lamps)
        left, top, right, bottom = (round(edge * zoom) for edge in lamp.bounds)
        part = canvas[top:bottom, left:right]
        part[:] = np.rint(part * (1 - 0.5 * lamp.depth) + 0.5 * lamp.depth * np.array(colour)).astype(np.uint8)
        cv2.rectangle(canvas, (left, top), (right - 1, bottom - 1), colour, 3)
        _label(canvas, f"{number + 1}", (left + 10, top + 34), 1.0)
        _draw_wave(panel[number * _PANEL_PX : (number + 1) * _PANEL_PX], lamp, colour)
        _label(panel, f"{number + 1}: {caption}", (540, number * _PANEL_PX + _PANEL_PX // 2), 0.6)
    return np.vstack([canvas, panel])


def _colour(lamp: Lamp, lamps: list[Lamp]) -> tuple[int, int, int]:
    """Red for the slowest lamp to blue for the fastest, BGR."""
    slowest, fastest = (np.log(edge([x.period_px for x in lamps])) for edge in (max, min))
    place = (slowest - np.log(lamp.period_px)) / max(slowest - fastest, 1e-9)
    hue = np.array([[[round(120 * place), 255, 230]]], np.uint8)
    blue, green, red = cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0].tolist()
    return blue, green, red


def _label(canvas: NDArray[np.uint8], text: str, place: tuple[int, int], size: float) -> None:
    for colour, width in (((255, 255, 255), 4), ((0, 0, 0), 1)):
        cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, colour, width, cv2.LINE_AA)


def _draw_wave(panel: NDArray[np.uint8], lamp: Lamp, colour: tuple[int, int, int]) -> None:
    """Two periods of a waveform with its interval, from dark at the bottom line."""
    x = np.linspace(20, 500, 2 * lamp.waveform.size)
    top = max(float(lamp.waveform.max()), 1e-6)

    def line(curve: Any) -> Any:
        heights = (panel.shape[0] - 15) - (panel.shape[0] - 30) * np.clip(np.tile(curve, 2) / top, 0, 1.05)
        return np.rint(np.column_stack([x, heights])).astype(np.int32)

    low, high = (line(lamp.waveform + sign * lamp.waveform_error) for sign in (-1, 1))
    cv2.fillPoly(panel, [np.concatenate([low, high[::-1]])], [int(128 + c / 2) for c in colour])
    cv2.polylines(panel, [line(lamp.waveform)], False, colour, 2, cv2.LINE_AA)
    cv2.line(panel, (20, panel.shape[0] - 15), (500, panel.shape[0] - 15), (0, 0, 0), 1)
