"""Steps of the light that does not change, across the columns of a grid.

In a picture whose sides are dark a screen has edges all the same: its panel throws back the light of a room as its
bezel and the wall do not, and black pixels let a little of the backlight through. Such a step lies on a border of the
columns, or it is not the screen's edge. What a screen shows may have edges, too, and anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.numerics import TINY
from rxcli.types import BoolArray, Float32Array, FloatArray, IntArray

#: Places a column at which a step is looked for, and how much on either side is compared.
_PLACES, _BESIDE = 16, 0.3
#: Strips on either side, at least.
_FEWEST_STRIPS = 2
#: Windows, at least; and places over which the spread of the steps is smoothed, columns.
_FEWEST_WINDOWS, _SMOOTH = 4, 0.6
#: Other steps are higher than this, columns apart.
_ALONE = 0.25
#: Probability that edges show, and each of them then; scale of the heights of edges, exponential, standard deviations.
_SHOWS, _EDGE_SCALE = 0.8, 6.0
#: Of other steps that stand out there is one a column: mean and standard deviation of their heights, by chance; and the
#: share of edges in the picture.
_CHANCE_MEAN, _CHANCE_SD, _IN_PICTURE = 1.5, 0.6, 0.05
#: A picture in the picture is lighter than what is beside it, by percentiles of the level across the columns; it begins
#: at this share of the way. Its edge is sharp where, this far beyond it, no more than this share is left, columns.
_DARKER, _LIGHTER, _BEGINS, _BEYOND, _SHARE, _NEAR = 5, 75, 0.25, 0.45, 0.12, 0.5


@dataclass(frozen=True, slots=True)
class StillSteps:
    """Steps of still light across the columns."""

    #: (P,) columns of the places; light there and how much more to the right of them than to the left, values of a
    #: pixel, and that in standard deviations; NaN: not known.
    place: FloatArray
    level: FloatArray
    height: FloatArray
    significance: FloatArray
    #: (K,) columns and significance of the steps that stand out among their neighbours.
    peak: FloatArray
    peak_significance: FloatArray

    def on_borders(self, borders: tuple[float, float], deviation: float) -> float:
        """Log-odds that the screen's left and right edge lie there, known to some columns; 0: nothing can be said."""
        ratios = [self._on(border, deviation) for border in borders]
        shown = np.prod([1 - _SHOWS + _SHOWS * ratio for ratio in ratios if ratio is not None])
        return float(np.log(1 - _SHOWS + _SHOWS * shown))

    def _on(self, border: float, deviation: float) -> float | None:
        """How much likelier a step there is an edge than not; None: nothing can be said."""
        known = np.abs(self.place - border) <= 2 * deviation
        if not np.isfinite(self.significance[known]).any() or not self.peak.size:
            return None
        off, size = (self.peak - border) / deviation, np.abs(self.peak_significance)
        density = np.exp(-0.5 * off**2) / (np.sqrt(2 * np.pi) * deviation)
        ratio = density * np.exp(-size / _EDGE_SCALE) / _EDGE_SCALE / _other_steps(size)
        return float(ratio.max())

    @property
    def sharp_ends(self) -> tuple[float, float] | None:
        """Columns at which a picture with dark bars beside it begins and ends; None where its ends are not sharp."""
        known = np.flatnonzero(np.isfinite(self.level))
        if known.size < 2 * _PLACES:
            return None
        dark, light = np.percentile(self.level[known], [_DARKER, _LIGHTER])
        lit = known[self.level[known] > dark + _BEGINS * (light - dark)]
        ends = [self._sharp_end(int(end), side, float(dark)) for end, side in ((lit[0], 1), (lit[-1], -1))]
        return None if ends[0] is None or ends[1] is None else (ends[0], ends[1])

    def _sharp_end(self, at: int, side: int, dark: float) -> float | None:
        """Column of the sharp edge next to a place, to the right (1) or left (-1) of which it is light."""
        reach, beyond = round(_NEAR * _PLACES), round(_BEYOND * _PLACES)
        first = max(at - reach, 0)
        rise = np.nan_to_num(side * self.height[first : at + reach + 1])
        best = first + int(rise.argmax())
        outside, inside = best - side * beyond, best + side * beyond
        if not (0 <= outside < self.place.size and 0 <= inside < self.place.size):
            return None
        left = (self.level[outside] - dark) / max(self.level[inside] - dark, TINY)
        return float(self.place[best]) if np.isfinite(left) and left < _SHARE else None


def _other_steps(size: FloatArray) -> FloatArray:
    """How many steps of such a height there are in a column, per standard deviation, that are no edge of the screen."""
    by_chance = np.exp(-0.5 * ((size - _CHANCE_MEAN) / _CHANCE_SD) ** 2) / (np.sqrt(2 * np.pi) * _CHANCE_SD)
    in_picture = np.exp(-size / _EDGE_SCALE) / _EDGE_SCALE
    return np.asarray(by_chance + _IN_PICTURE * in_picture + TINY)


def still_steps(level: Float32Array, u: FloatArray, by_window: FloatArray) -> StillSteps:
    """The steps of a picture's still light.

    Args:
        level: (W, S) light of the strips in every window of rows, values of a pixel.
        u: (W, S) columns of the strips.
        by_window: (W,) light of every window that changes as the columns do.
    """
    first, last = int(np.floor(u.min())) - 1, int(np.ceil(u.max())) + 1
    place = first + np.arange((last - first) * _PLACES + 1) / _PLACES
    lit = np.flatnonzero(by_window > 0)
    if lit.size < _FEWEST_WINDOWS:
        nothing = np.full(place.size, np.nan)
        return StillSteps(place, nothing, nothing, nothing, np.zeros(0), np.zeros(0))
    levels, steps = (
        np.stack(values) for values in zip(*(_steps(level[w], u[w], place) for w in lit.tolist()), strict=True)
    )
    mean, (height, deviation) = _over_windows(levels)[0], _over_windows(steps)
    significance = height / deviation
    peak = _peaks(np.abs(significance))
    return StillSteps(place, mean, height, significance, place[peak], significance[peak])


def _steps(level: Float32Array, u: FloatArray, place: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(P,) light of places, and how much more there is to the right of them than to the left; NaN where unknown."""
    shown = level > 0
    total = np.concatenate([[0.0], np.cumsum(np.where(shown, level, 0.0))])
    count = np.concatenate([[0], np.cumsum(shown)])

    def mean(start: FloatArray, end: FloatArray, fewest: int) -> FloatArray:
        i, j = np.searchsorted(u, start), np.searchsorted(u, end)
        n = count[j] - count[i]
        return np.where(n >= fewest, (total[j] - total[i]) / np.maximum(n, 1), np.nan)

    right = mean(place, place + _BESIDE, _FEWEST_STRIPS)
    left = mean(place - _BESIDE, place, _FEWEST_STRIPS)
    return mean(place - _BESIDE / 3, place + _BESIDE / 3, 1), right - left


def _over_windows(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(P,) mean of (W, P) values over the windows, and its standard deviation, smoothed; NaN where too few know it."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    enough: BoolArray = count >= max(_FEWEST_WINDOWS, len(values) // 2)
    mean = np.where(known, values, 0.0).sum(axis=0) / np.maximum(count, 1)
    spread = np.where(known, values - mean, 0.0)
    deviation = np.sqrt((spread**2).sum(axis=0) / np.maximum(count * (count - 1.0), 1))
    box = np.ones(2 * round(_SMOOTH * _PLACES / 2) + 1)
    weight = np.convolve(enough.astype(np.float64), box, "same")
    smooth = np.convolve(np.where(enough, deviation, 0.0), box, "same") / np.maximum(weight, 1) + TINY
    return np.where(enough, mean, np.nan), smooth


def _peaks(height: FloatArray) -> IntArray:
    """Places that are the highest among their neighbours."""
    reach = round(_ALONE * _PLACES)
    filled = np.where(np.isfinite(height), height, 0.0)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(filled, reach), 2 * reach + 1).max(axis=1)
    return np.flatnonzero((filled > 0) & (filled >= around))
