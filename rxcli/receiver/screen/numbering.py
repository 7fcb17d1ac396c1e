"""Number the columns of a grid: no light may lie outside the screen, and little of the screen outside the picture.

Numberings that differ by a shift share all columns but the outermost, so these decide. Light is measured in eighths of
a column: the edge of a screen lies on a column border, whereas that of a picture shown on it does so by chance only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.numerics import TINY
from rxcli.receiver.screen.grid import Grid, columns_at
from rxcli.receiver.screen.strips import PictureStrips
from rxcli.types import BoolArray, Float32Array, FloatArray, IntArray

#: Parts of a column in which light is measured, and those in which its level is measured.
_PARTS, _LEVEL_PARTS = 8, 16
#: Scales of the exponential distributions of the light's significance, off the screen and on it; log-odds that a part
#: without light is off the screen; weight of a part, as neighbouring parts are not independent.
_OFF_SCALE, _LIT_SCALE, _DARK_PART, _PART_COUNTS = 1.2, 6.0, 0.25, 0.5
#: Light of one grey level of 255; log-odds from which the light of a part is steady, and their maximum.
_GREY_LEVEL, _STEADY, _MAX_STEADY = 255.0**-2, 1.0, 3.0
#: Minimum mean log-odds of parts of a column that belong to the light.
_ENDS = 0.05
#: Log-odds of each column outside the picture, and their minimum at ends of the picture that light reaches.
_OUTSIDE, _LARGER = -4.0, -3.0
#: Standard deviations of the light's middle and of the picture's about the screen's middle, screen widths.
_LIGHT_SD, _AIM_SD = 0.175, 0.12
#: Columns of the picture that must lie beyond light which ends in the picture.
_IN_VIEW = 0.3
#: Light begins at a border if the log-odds inside exceed this and those beyond stay below this share of them; log-odds
#: that this adds.
_BEGINS_ODDS, _BEYOND, _ON_BORDER = 2.0, 0.3, 3.0
#: A bright picture has dark on both sides. It begins where its level exceeds this share between dark and bright
#: (percentiles over the columns). The level left over at this distance beside it, columns.
_DARK, _BRIGHT, _BEGINS, _LEFT_OVER, _BESIDE = 5, 75, 0.25, 0.12, 0.45
#: Maximum width, screen widths, and maximum offset from the screen's middle, columns, of what lies in the middle of a
#: screen, and the log-odds that it adds.
_MAX_SPAN, _IN_MIDDLE, _CENTRED = 1.15, 0.2, 3.5


@dataclass(frozen=True, slots=True)
class LightProfile:
    """Light across the columns of a grid."""

    #: (P,) middles of the parts of columns, and whether they are in the picture.
    place: FloatArray
    in_picture: BoolArray
    #: (P,) log-odds that a part is on the screen.
    log_odds: FloatArray
    #: Column at the picture's middle.
    picture_middle: float
    #: First and last column of what probably has its middle at the screen's, or None: a bright picture with dark on
    #: both sides, if it is as high as the screen; and the screen with its frame in a lighted room.
    film: tuple[float, float] | None
    frame: tuple[float, float] | None

    @property
    def ends(self) -> tuple[float, float]:
        """Columns at which the light begins and ends."""
        gain = np.concatenate([[0.0], np.cumsum(self.log_odds - _ENDS)])
        end = int((gain - np.minimum.accumulate(gain)).argmax())
        start = int(gain[: end + 1].argmin())
        left = float(self.place[0]) - 0.5 / _PARTS
        return left + start / _PARTS, left + end / _PARTS


def light_profile(strips: PictureStrips, light: Float32Array, grid: Grid) -> LightProfile:
    """Measure the light across the columns of a grid.

    Args:
        strips: of the picture.
        light: (B, S, R) products of the strips with the waveforms predicted from their neighbours, `predicted_light`.
        grid: of the picture.
    """
    u = columns_at(grid.coefficients, strips.x, strips.y)
    origin = int(np.floor(u.min())) - 1
    n = (int(np.ceil(u.max())) + 1 - origin) * _PARTS
    part = ((u - origin) * _PARTS).astype(np.int64).ravel()
    count = np.bincount(part, minlength=n)
    total = np.bincount(part, light.sum(axis=2).ravel(), n)
    power = np.bincount(part, np.einsum("bsr,bsr->bs", light, light).ravel(), n)
    share = total / np.sqrt(np.maximum(power * count * light.shape[2], TINY))
    significance = np.maximum(share, 0.0) * np.sqrt(count * strips.n_rows)
    off = np.exp(-significance / _OFF_SCALE) / _OFF_SCALE + TINY
    lit = np.exp(-significance / _LIT_SCALE) / _LIT_SCALE
    odds = _PART_COUNTS * np.log(np.exp(-_DARK_PART) + (1 - np.exp(-_DARK_PART)) * lit / off)
    steady = _steady_light(strips, part, odds)
    odds -= _PART_COUNTS * steady
    place = origin + (np.arange(n) + 0.5) / _PARTS
    by_block = np.maximum(light.mean(axis=(1, 2)), 0.0)
    film, frame = _film(np.where(by_block[:, None] > 0, strips.level, 0), u), _framed(place, odds, steady)
    return LightProfile(place, count > 0, np.where(count > 0, odds, 0.0), float(grid.coefficients[0]), film, frame)


def _steady_light(strips: PictureStrips, part: IntArray, odds: FloatArray) -> FloatArray:
    """(P,) log-odds that a part without light of the columns is off the screen, by the light that never goes out there.

    The screen is dark whenever all its columns are; a room is not.
    """
    darkest = np.full(odds.size, np.inf)
    np.minimum.at(darkest, part, strips.darkest.ravel())
    of_columns = darkest[odds > 0]
    if of_columns.size == 0:
        return np.zeros(odds.size)
    ratio = (darkest + _GREY_LEVEL) / (float(np.median(of_columns)) + _GREY_LEVEL)
    return np.where((odds < 0) & np.isfinite(darkest), np.clip(np.log(ratio), 0, _MAX_STEADY), 0.0)


def _framed(place: FloatArray, odds: FloatArray, steady: FloatArray) -> tuple[float, float] | None:
    """Columns between which no light is steady around that of the columns, or None where it is not on both sides."""
    if not (odds > 0).any():
        return None
    middle = np.median(place[odds > 0])
    beside = place[steady > _STEADY]
    left, right = beside[beside < middle], beside[beside > middle]
    return (float(left.max()), float(right.min())) if left.size and right.size else None


def _film(level: Float32Array, u: FloatArray) -> tuple[float, float] | None:
    """Columns at which a picture with dark bars on both sides begins and ends, by the level (B, S) of strips."""
    shown = level > 0
    origin = float(np.floor(u.min()))
    part = ((u[shown] - origin) * _LEVEL_PARTS).astype(np.int64)
    if part.size == 0:
        return None
    count = np.bincount(part)
    known = np.flatnonzero(count)
    profile = np.interp(np.arange(count.size), known, (np.bincount(part, level[shown]) / np.maximum(count, 1))[known])
    dark, bright = np.percentile(profile, [_DARK, _BRIGHT])
    is_bright = np.flatnonzero(profile > dark + _BEGINS * (bright - dark))
    if is_bright.size == 0:
        return None
    beside, ends = round(_BESIDE * _LEVEL_PARTS), (int(is_bright[0]), int(is_bright[-1]))
    for end, side in zip(ends, (1, -1), strict=True):
        outside, inside = end - side * beside, end + side * beside
        if not (0 <= outside < profile.size and 0 <= inside < profile.size):
            return None
        if profile[outside] - dark > _LEFT_OVER * (profile[inside] - dark):
            return None
    return origin + ends[0] / _LEVEL_PARTS, origin + (ends[1] + 1) / _LEVEL_PARTS


def first_columns(light: LightProfile, n_columns: int) -> tuple[IntArray, FloatArray, bool]:
    """Columns (F,) of a grid, the log-odds of each to be the screen's first, and whether no side of it is in view.

    Light outside the screen, columns outside the picture and a bright picture in the middle decide. If columns are dark
    at both ends and no such evidence exists, several candidates remain equally likely. Log-odds are comparable between
    numbers of columns.
    """
    shown = light.place[light.in_picture]
    left, right = float(shown.min()), float(shown.max())
    starts = np.arange(int(left) - n_columns + 3, int(right) - 2)
    ends, middles = starts + n_columns, starts + n_columns / 2
    begin, end_of_light = light.ends
    reaches = np.array([begin < left + _IN_VIEW, end_of_light > right - _IN_VIEW])
    off = (begin + end_of_light) / 2 - middles
    odds = _light_within(light, starts, ends) - 0.5 * np.square(off / (_LIGHT_SD * n_columns))
    if not reaches.any():
        odds -= 0.5 * np.square((light.picture_middle - middles) / (_AIM_SD * n_columns))
    hidden = np.maximum(np.stack([left - starts, ends - right]), 0.0)
    odds += _OUTSIDE * (~reaches @ hidden) + np.maximum(_OUTSIDE * (reaches @ hidden), _LARGER)
    odds += _ON_BORDER * (_begins(light, starts, 1) + 1.0 * _begins(light, ends, -1))
    return starts, odds + centred(light.frame, starts, n_columns), bool(reaches.all())


def centred(span: tuple[float, float] | None, starts: IntArray, n_columns: int) -> FloatArray:
    """Log-odds (F,) that a span of columns adds to those first columns that have its middle at the screen's."""
    if span is None or span[1] - span[0] >= _MAX_SPAN * n_columns:
        return np.zeros(starts.size)
    is_centred = np.abs(sum(span) / 2 - starts - n_columns / 2) < _IN_MIDDLE
    return np.where(is_centred, _CENTRED, 0.0)


def _begins(light: LightProfile, borders: IntArray, side: int) -> BoolArray:
    """(F,) whether light begins on each border, to its right (1) or left (-1)."""
    off = side * (light.place - borders[:, None])
    beyond = (off < -1 / _PARTS) & (off > -0.5)
    inside, outside = ((off > 1 / _PARTS) & (off < 0.5)) @ light.log_odds, beyond @ light.log_odds
    is_shown = (light.in_picture | ~beyond).all(axis=1)
    return np.asarray(is_shown & (inside > _BEGINS_ODDS) & (outside < _BEYOND * inside))


def _light_within(light: LightProfile, starts: IntArray, ends: IntArray) -> FloatArray:
    """(F,) log-odds that the screen lies between two borders; parts next to a border count only if they have light."""
    start, end = (light.place - borders[:, None] for borders in (starts, ends))
    near = np.minimum(np.abs(start), np.abs(end)) < 1 / _PARTS
    inside = (start > 0) & (end < 0) & ~near
    return np.asarray(inside @ light.log_odds + near @ np.maximum(light.log_odds, 0.0))
