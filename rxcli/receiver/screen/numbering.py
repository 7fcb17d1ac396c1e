"""Which column of a grid is the screen's first: no light may lie outside, little of the screen outside the picture.

Numberings that differ by a shift have all columns in common but the outermost, so these decide. Light is looked for in
eighths of a column: the edge of a screen lies on a border of its columns, the edge of a picture on it by chance only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.numerics import TINY
from rxcli.receiver.screen.grid import Grid, columns_at
from rxcli.receiver.screen.strips import Strips
from rxcli.types import BoolArray, Float32Array, FloatArray, IntArray

#: Parts of a column that are asked for light; and those at which its level is asked.
_PARTS, _LEVEL_PARTS = 8, 16
#: Significance of light off the screen and on it, as scales of exponential distributions; the log-odds that a part
#: without light is off the screen; and how much each counts, neighbouring parts being dark together.
_OFF_SCALE, _LIT_SCALE, _DARK_PART, _PART_COUNTS = 1.2, 6.0, 0.25, 0.5
#: Log-odds that parts of a column must have so that light ends no earlier.
_ENDS = 0.05
#: Log-odds of each column outside the picture; and at least, where light reaches to that end of the picture.
_OUTSIDE, _LARGER = -4.0, -3.0
#: The light's middle is the screen's, but for this, screen widths.
_LIGHT_SD = 0.175
#: So much of the picture, columns, must lie beyond light that ends in it.
_IN_VIEW = 0.4
#: Light on one side of a border, log-odds, from which it begins there, the share of it that may lie beyond, and what it
#: adds.
_BEGINS_ODDS, _BEYOND, _ON_BORDER = 2.0, 0.3, 3.0
#: A film has dark bars beside it. It begins where its level is this share of the way from dark to bright (percentiles
#: over the columns), is dark to this share so far beyond, takes these shares of the screen's width, and lies in its
#: middle to this, columns; what that adds in log-odds with 20 columns: with more it is less likely by chance.
_DARK, _BRIGHT, _BEGINS = 5, 75, 0.25
_LEFT_OVER, _BESIDE, _FILM_WIDTHS, _IN_MIDDLE, _FILM, _USUAL_COLUMNS = 0.12, 0.45, (0.53, 0.95), 0.2, 3.5, 20


@dataclass(frozen=True, slots=True)
class LightProfile:
    """Where across the columns of a grid there is light."""

    #: (P,) middles of the parts of columns, and whether the picture shows them.
    place: FloatArray
    in_picture: BoolArray
    #: (P,) log-odds that a part is on the screen over being off it.
    log_odds: FloatArray
    #: Columns at which a film with dark bars beside it begins and ends; None: there is none.
    film: tuple[float, float] | None

    @property
    def ends(self) -> tuple[float, float]:
        """Columns at which the light begins and ends."""
        gain = np.concatenate([[0.0], np.cumsum(self.log_odds - _ENDS)])
        end = int((gain - np.minimum.accumulate(gain)).argmax())
        start = int(gain[: end + 1].argmin())
        left = float(self.place[0]) - 0.5 / _PARTS
        return left + start / _PARTS, left + end / _PARTS


def light_profile(strips: Strips, light: Float32Array, grid: Grid) -> LightProfile:
    """The light across the columns of a grid.

    Args:
        strips: of the picture.
        light: (B, S, R) what the strips have in common with their neighbours' waveforms, see `predicted_light`.
        grid: of the picture.
    """
    u = columns_at(grid.numbers, strips.x, strips.y)
    first = int(np.floor(u.min())) - 1
    n = (int(np.ceil(u.max())) + 1 - first) * _PARTS
    part = ((u - first) * _PARTS).astype(np.int64).ravel()
    count = np.bincount(part, minlength=n)
    total = np.bincount(part, light.sum(axis=2).ravel(), n)
    power = np.bincount(part, np.einsum("bsr,bsr->bs", light, light).ravel(), n)
    share = total / np.sqrt(np.maximum(power * count * light.shape[2], TINY))
    significance = np.maximum(share, 0.0) * np.sqrt(count * strips.n_rows)
    off = np.exp(-significance / _OFF_SCALE) / _OFF_SCALE + TINY
    lit = np.exp(-significance / _LIT_SCALE) / _LIT_SCALE
    odds = _PART_COUNTS * np.log(np.exp(-_DARK_PART) + (1 - np.exp(-_DARK_PART)) * lit / off)
    place = first + (np.arange(n) + 0.5) / _PARTS
    by_block = np.maximum(light.mean(axis=(1, 2)), 0.0)
    film = _film(np.where(by_block[:, None] > 0, strips.level, 0), u)
    return LightProfile(place, count > 0, np.where(count > 0, odds, 0.0), film)


def _film(level: Float32Array, u: FloatArray) -> tuple[float, float] | None:
    """Columns at which a picture with dark bars on both sides begins and ends, by the level (B, S) of strips."""
    shown = level > 0
    first = float(np.floor(u.min()))
    part = ((u[shown] - first) * _LEVEL_PARTS).astype(np.int64)
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
    return first + ends[0] / _LEVEL_PARTS, first + (ends[1] + 1) / _LEVEL_PARTS


@dataclass(frozen=True, slots=True)
class FirstColumns:
    """How likely each column of a grid is the screen's first."""

    #: (F,) columns of the grid, and their log-odds, comparable between numbers of columns.
    first: IntArray
    log_odds: FloatArray
    #: Whether light reaches to both ends of the picture, so that no side of the screen is in view.
    fills: bool


def first_columns(light: LightProfile, n_columns: int) -> FirstColumns:
    """How likely each column of a grid is the first of a screen with `n_columns`.

    Light outside the screen, columns outside the picture and a film in the screen's middle decide. Where columns are
    dark at both ends and none of these shows, several stay as likely.
    """
    shown = light.place[light.in_picture]
    left, right = float(shown.min()), float(shown.max())
    first = np.arange(int(left) - n_columns + 3, int(right) - 2)
    begin, end_of_light = light.ends
    reaches = (begin < left + _IN_VIEW, end_of_light > right - _IN_VIEW)
    film = _FILM + float(np.log(n_columns / _USUAL_COLUMNS)) if _is_film(light, n_columns) else 0.0
    scores = []
    for start in first.tolist():
        end = start + n_columns
        hidden = max(left - start, 0.0), max(end - right, 0.0)
        off = (begin + end_of_light) / 2 - start - n_columns / 2
        score = _light_within(light, start, end) + _hidden(hidden, reaches) - 0.5 * (off / (_LIGHT_SD * n_columns)) ** 2
        if light.film is not None:
            score += film * (abs(sum(light.film) / 2 - start - n_columns / 2) < _IN_MIDDLE)
        score += _ON_BORDER * (_begins(light, start, 1) + _begins(light, end, -1))
        scores.append(score)
    return FirstColumns(first, np.array(scores), all(reaches))


def _is_film(light: LightProfile, n_columns: int) -> bool:
    film = light.film
    return film is not None and _FILM_WIDTHS[0] < (film[1] - film[0]) / n_columns < _FILM_WIDTHS[1]


def _hidden(columns: tuple[float, float], reaches: tuple[bool, bool]) -> float:
    """Log-odds of columns left and right of the picture, by whether light reaches to its ends."""
    if all(reaches):
        return max(_OUTSIDE * sum(columns), _LARGER)
    odds = [_OUTSIDE * count for count in columns]
    return sum(max(one, _LARGER) if to_the_end else one for one, to_the_end in zip(odds, reaches, strict=True))


def _begins(light: LightProfile, border: int, side: int) -> bool:
    """Whether light begins on a border, to its right (1) or left (-1)."""
    off = side * (light.place - border)
    beyond = (off < -1 / _PARTS) & (off > -0.5)
    inside, outside = light.log_odds[(off > 1 / _PARTS) & (off < 0.5)].sum(), light.log_odds[beyond].sum()
    return bool(light.in_picture[beyond].all() and inside > _BEGINS_ODDS and outside < _BEYOND * inside)


def _light_within(light: LightProfile, start: int, end: int) -> float:
    """Log-odds that the screen lies between two borders; what lies next to them is the screen's if it has light."""
    near = np.minimum(np.abs(light.place - start), np.abs(light.place - end)) < 1 / _PARTS
    inside = (light.place > start) & (light.place < end) & ~near
    return float(light.log_odds[inside].sum() + np.maximum(light.log_odds[near], 0.0).sum())
