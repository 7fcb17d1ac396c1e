"""Line delay from pictures of a screen that sends data at a known slot rate.

Data have no period, but their edges keep to the slot clock: the squared slope of a profile has a spectral line at the
slot rate (timing recovery by squaring) whatever is sent, and whatever the delay of a column. Symbols and exposure make
weaker or stronger lines at its parts and multiples; the right one is that under which packets recur.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rxcli.calibrate.periodic import whitened_power
from rxcli.calibrate.shutter import Axis, Picture, ShutterCalibration
from rxcli.errors import ReceiverError
from rxcli.types import FloatArray

_Z95 = 1.959964
_STRIPS, _GROUPS = 64, 8
#: Rows per slot that can be told: below two the line is an alias, and many make few slots.
_FASTEST, _SLOWEST = 0.47, 1 / 80
#: How far the line must stand above the continuum, summed over the strips, against what chance gives.
_LINE = 12.0
#: Parts and multiples of the strongest line that may be the slots', and the correlation from which packets recur.
_RATIOS = (
    1 / 5,
    1 / 4,
    1 / 3,
    2 / 5,
    1 / 2,
    3 / 5,
    2 / 3,
    3 / 4,
    4 / 5,
    1,
    5 / 4,
    4 / 3,
    3 / 2,
    5 / 3,
    2,
    5 / 2,
    3,
    4,
    5,
)
_RECURS = 0.15
#: Widest interval, half, relative to the line delay: a scene's hump is no line.
_WIDEST = 3e-3


def calibrate_slots(
    pictures: Sequence[Picture], slot_rate_hz: float, packet_slots: int, axis: Axis = "rows"
) -> ShutterCalibration:
    """Line delay from pictures, of one readout mode, of a sending screen.

    Args:
        pictures: (height, width) each, best proportional to light.
        slot_rate_hz: the screen's slot rate.
        packet_slots: slots of a packet, which the screen repeats.
        axis: the readout axis. It cannot be found as a lamp's is: the screen's columns and the colour filter array
            make lines along the other one, too.

    Raises:
        ReceiverError: no slot clock is seen.
    """
    slopes = [_slopes(picture if axis == "rows" else picture.T) for picture in pictures]
    frequency = _slot_line(slopes, packet_slots)
    if frequency is not None:
        values, weights = _refine([z**2 for part in slopes for z in np.array_split(part, _GROUPS)], frequency)
        mean, sd = _mean_and_sd(values, weights)
        if sd * _Z95 <= _WIDEST * mean:
            return ShutterCalibration(
                axis,
                pictures[0].shape,
                mean / slot_rate_hz,
                sd / slot_rate_hz,
                periods=mean * pictures[0].shape[0 if axis == "rows" else 1],
                exposure_note="not told by data; use a lamp and --frequency",
            )
    raise ReceiverError(
        "no slot clock of a sending screen in the pictures",
        "let the screen fill the frame and use a short exposure; at least two rows a slot are needed",
    )


def _slopes(picture: Picture) -> FloatArray:
    """(strips, n) slopes along time; the root of the light evens out bright and dark parts of the picture."""
    edges = np.linspace(0, picture.shape[1], min(_STRIPS, picture.shape[1]) + 1).astype(int)
    strips = np.add.reduceat(picture, edges[:-1], axis=1, dtype=np.float64).T / np.diff(edges)[:, None]
    return np.asarray(np.diff(np.sqrt(np.maximum(strips, 0) + 1e-3), axis=1))


def _slot_line(slopes: list[FloatArray], packet_slots: int) -> float | None:
    """The slot rate, cycles per row: the line, its part or multiple, under which packets recur best."""
    spectra = [whitened_power(part**2) for part in slopes if part.shape[1] >= 64]
    if not spectra:
        return None
    frequency = spectra[0][0]
    power = np.sum([p.sum(axis=0) for _, p in spectra], axis=0)
    n_strips = sum(len(p) for _, p in spectra)
    power = np.where((frequency >= _SLOWEST) & (frequency <= _FASTEST), power, 0)
    lines = _strongest(power, n_strips + _LINE * float(np.sqrt(n_strips)))
    candidates = [frequency[at] * ratio for at in lines for ratio in _RATIOS]
    candidates = [f for f in candidates if _SLOWEST <= f <= _FASTEST]
    if not candidates:
        return None
    recurrence = [_recurrence(slopes, packet_slots / f) for f in candidates]
    # Two packets later they recur as well: the shortest time counts.
    recurs = [f for f, r in zip(candidates, recurrence, strict=True) if r > max(_RECURS, 0.6 * max(recurrence))]
    return float(max(recurs)) if recurs else None


def _strongest(power: FloatArray, least: float, n: int = 4) -> list[int]:
    """Indices of the `n` strongest peaks above `least`."""
    peaks = np.flatnonzero((power[1:-1] >= power[:-2]) & (power[1:-1] > power[2:]) & (power[1:-1] > least)) + 1
    found: list[int] = []
    for at in peaks[np.argsort(-power[peaks])]:
        # A line's own side lobes lie within a few bins of the spectrum before its oversampling.
        if all(abs(int(at) - other) > 32 for other in found):
            found.append(int(at))
    return found[:n]


def _recurrence(slopes: list[FloatArray], lag: float) -> float:
    """Correlation of the profiles with themselves one packet later, at the best lag near `lag`; over all strips."""
    n = slopes[0].shape[1]
    best = 0.0
    for rows in range(round(lag * 0.998) - 1, round(lag * 1.002) + 2):
        if rows > n - 32:
            break
        early, late = [z[:, : n - rows] for z in slopes], [z[:, rows:] for z in slopes]
        product = sum(float(np.sum(a * b)) for a, b in zip(early, late, strict=True))
        power = sum(float(np.sum(a**2) * np.sum(b**2)) ** 0.5 for a, b in zip(early, late, strict=True))
        best = max(best, product / (power + 1e-300))
    return best


def _refine(groups: list[FloatArray], frequency: float) -> tuple[FloatArray, FloatArray]:
    """Each group's own frequency near the common one, from its lines at the first two harmonics, and its weight."""
    n = groups[0].shape[1]
    rows = np.arange(n) - (n - 1) / 2
    offsets = np.linspace(-1.0, 1.0, 41) / n
    harmonics = [h for h in (1, 2) if h * frequency < 0.49]
    waves = [np.exp(-2j * np.pi * h * np.multiply.outer(rows, frequency + offsets)) for h in harmonics]
    total = np.zeros(offsets.size)
    own = []
    for group in groups:
        tapered = (group - group.mean(axis=1, keepdims=True)) * np.hanning(n)
        power = np.sum([np.sum(np.abs(tapered @ wave) ** 2, axis=0) for wave in waves], axis=0)
        own.append(power / (np.median(power) + 1e-300) * np.sqrt(power.max()))
        total += own[-1]
    centre = int(np.clip(np.argmax(total), 8, offsets.size - 9))
    near = slice(centre - 8, centre + 9)
    peaks = [_peak(frequency + offsets[near], power[near]) for power in own]
    return np.array([p for p, _ in peaks]), np.array([w for _, w in peaks])


def _peak(frequency: FloatArray, power: FloatArray) -> tuple[float, float]:
    """Vertex of the parabola through a peak's logarithm, and the peak's curvature as its weight."""
    a, b, _ = np.polyfit(np.linspace(-1, 1, frequency.size), np.log(power + 1e-300), 2, w=np.sqrt(power / power.max()))
    if a >= 0:
        return float(frequency.mean()), 0.0
    half = (frequency[-1] - frequency[0]) / 2
    return float(frequency.mean() + np.clip(-b / (2 * a), -1, 1) * half), float(-a * power.max())


def _mean_and_sd(values: FloatArray, weights: FloatArray) -> tuple[float, float]:
    """Weighted mean, and its standard deviation by the groups' scatter, widened for their number."""
    share = weights / (weights.sum() + 1e-300)
    mean = float(share @ values)
    groups = 1 / float(np.sum(share**2) + 1e-300)
    variance = float(np.sum(share**2 * (values - mean) ** 2)) * groups / max(groups - 1, 0.5)
    return mean, float(np.sqrt(variance)) * (1 + 1.5 / max(groups - 2, 0.5))
