"""Which column of a grid is the screen's first: no light may lie outside, little of the screen outside the picture.

Numberings that differ by a shift have all columns in common but the outermost, so these decide. Light is looked for in
eighths of a column: the edge of a screen lies on a border of its columns, the edge of a picture on it by chance only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rxcli.numerics import TINY
from rxcli.receiver.screen.coherence import Coherence
from rxcli.receiver.screen.grid import Grid, columns_at
from rxcli.receiver.screen.rows import find_rows
from rxcli.receiver.screen.sides import BOTTOM, LEFT, RIGHT, SHOWS, TOP, Side
from rxcli.receiver.screen.still_light import StillSteps, still_steps
from rxcli.receiver.screen.waveforms import StripLight, predicted_light
from rxcli.types import BoolArray, FloatArray, IntArray

#: Log-odds against the likeliest first column down to which another is possible.
LEAST_ODDS = -7.0
#: Parts of a column that are asked for light.
_PARTS = 8
#: Significance of light off the screen and on it, as scales of exponential distributions; the log-odds that a part
#: without light is off the screen; and how much each counts, neighbouring parts being dark together.
_OFF_SCALE, _LIT_SCALE, _DARK_PART, _PART_COUNTS = 1.2, 6.0, 0.25, 0.5
#: Log-odds that parts of a column must have so that light ends no earlier.
_ENDS = 0.05
#: Log-odds of a screen that goes on outside the picture, for every column that is there; and by however much, where
#: light reaches to that end of the picture.
_OUTSIDE, _LARGER = -4.0, -3.0
#: The light's middle is the screen's, but for this, screen widths.
_LIGHT_SD = 0.175
#: Films with bars beside them begin and end sharply, lie in the screen's middle to this, columns, and take these shares
#: of its width: log-odds that this adds where top and bottom are the screen's, or do not show, of so many columns.
_USUAL_COLUMNS, _IN_MIDDLE, _BARS, _FILM = 20, 0.2, (0.53, 0.95), 3.5
#: How far the distance of top and bottom may be off that of a screen's, a share.
_AS_HIGH = 0.05
#: How well a border is known, columns.
_BORDER_SD = 0.08
#: So much of the picture, columns, must lie beyond light that ends in it.
_IN_VIEW = 0.4
#: How near to a border a line where stripes begin lies, columns, and the log-odds that it, or light that begins on a
#: border, adds there.
_NEAR_BORDER, _ON_BORDER = 0.1, 2.0
#: Light on one side of a border, log-odds, from which it begins there, and the share of it that may lie beyond.
_BEGINS, _BEYOND = 2.0, 0.3


@dataclass(frozen=True, slots=True)
class Numbering:
    """A grid with its first column chosen."""

    #: Its columns count from the screen's first.
    grid: Grid
    #: (4, 2) the screen's corners in pixels of the stored picture, clockwise from its top left: with the likeliest rows
    #: first, then with others.
    corners: tuple[FloatArray, ...]
    #: Natural logarithm of its odds against the other numberings of the same grid.
    log_odds: float
    #: Whether light reaches to both ends of the picture, so that no side of the screen is in view.
    fills: bool


def possible_numberings(
    coherence: Coherence,
    strips: StripLight,
    grid: Grid,
    n_columns: int,
    aspect: float,
    lines: Sequence[Side] = (),
) -> list[Numbering]:
    """The columns that may be the screen's first, likeliest first.

    Args:
        coherence: of the picture.
        strips: its strips' light.
        grid: columns of it.
        n_columns: columns of the screen.
        aspect: width over height of the screen.
        lines: top, right, bottom, left, where stripes begin; none: nothing is known of them.
    """
    light = light_profile(strips, grid)
    start = first_columns(light, grid, n_columns, lines, aspect)
    likely: IntArray = np.flatnonzero(start.log_odds > LEAST_ODDS)
    chosen = likely[np.argsort(-start.log_odds[likely], kind="stable")]
    best = int(start.first[chosen[0]])
    # All have their rows in common, so that packets can tell them apart.
    middle = float((light.by_window * coherence.y).sum() / max(light.by_window.sum(), TINY))
    rows = find_rows(strips, grid.shifted(best), n_columns, aspect, middle, tuple(lines[::2]))
    out = []
    for i in chosen:
        number = int(start.first[i])
        corners = tuple(one.corners(number - best) for one in rows)
        out.append(Numbering(grid.shifted(number), corners, float(start.log_odds[i]), start.fills))
    return out


@dataclass(frozen=True, slots=True)
class LightProfile:
    """Where across the columns of a grid there is light."""

    #: (P,) middles of the parts of columns, and whether the picture shows them.
    place: FloatArray
    in_picture: BoolArray
    #: (P,) light in standard deviations, and the log-odds that it is the screen's over being off it.
    significance: FloatArray
    log_odds: FloatArray
    #: (W,) light of every window of rows.
    by_window: FloatArray
    #: Steps of the light that does not change.
    still: StillSteps

    @property
    def ends(self) -> tuple[float, float]:
        """Columns at which the light begins and ends."""
        gain = np.concatenate([[0.0], np.cumsum(self.log_odds - _ENDS)])
        end = int((gain - np.minimum.accumulate(gain)).argmax())
        start = int(gain[: end + 1].argmin())
        left = float(self.place[0]) - 0.5 / _PARTS
        return left + start / _PARTS, left + end / _PARTS


def light_profile(strips: StripLight, grid: Grid) -> LightProfile:
    """The light across the columns of a grid: how alike strips are to what their neighbours' waveforms predict."""
    u = columns_at(grid.numbers, strips.x, strips.y)
    alike = predicted_light(strips, u)
    first = int(np.floor(u.min())) - 1
    n = (int(np.ceil(u.max())) + 1 - first) * _PARTS
    part = ((u - first) * _PARTS).astype(np.int64).ravel()
    count = np.bincount(part, minlength=n)
    total = np.bincount(part, alike.sum(axis=2).ravel(), n)
    power = np.bincount(part, (alike * alike).sum(axis=2).ravel(), n)
    share = total / np.sqrt(np.maximum(power * count * alike.shape[2], TINY))
    shown = count > 0
    light = np.maximum(share, 0.0) * np.sqrt(count * strips.n_rows)
    off = np.exp(-light / _OFF_SCALE) / _OFF_SCALE + TINY
    lit = np.exp(-light / _LIT_SCALE) / _LIT_SCALE
    odds = _PART_COUNTS * np.log(np.exp(-_DARK_PART) + (1 - np.exp(-_DARK_PART)) * lit / off)
    by_window = np.maximum(alike.mean(axis=(1, 2)), 0.0)
    place = first + (np.arange(n) + 0.5) / _PARTS
    still = still_steps(strips.level, u, by_window)
    return LightProfile(place, shown, light, np.where(shown, odds, 0.0), np.asarray(by_window, np.float64), still)


@dataclass(frozen=True, slots=True)
class FirstColumns:
    """What a picture says of the columns that may be the screen's first."""

    #: (F,) such columns of the grid, and the natural logarithm of their odds against the likeliest.
    first: IntArray
    log_odds: FloatArray
    #: Whether light reaches to both ends of the picture, so that no side of the screen is in view.
    fills: bool = False


def first_columns(
    light: LightProfile, grid: Grid, n_columns: int, lines: Sequence[Side] = (), aspect: float = 16 / 9
) -> FirstColumns:
    """How likely each column of a grid is the screen's first.

    Light outside the screen, columns outside the picture, light that begins on a border, a line where stripes begin,
    steps of still light and films in the middle tell. Where columns are dark at both ends and none of these shows the
    numberings stay alike.
    """
    shown = light.place[light.in_picture]
    left, right = float(shown.min()), float(shown.max())
    first = np.arange(int(left) - n_columns + 3, int(right) - 2)
    begin, end_of_light = light.ends
    reaches = (begin < left + _IN_VIEW, end_of_light > right - _IN_VIEW)
    film = _film(light, grid, n_columns, aspect, lines)
    scores = []
    lying = {number: _columns_of_line(grid, lines, number) for number in (LEFT, RIGHT)}
    for start in first.tolist():
        end = start + n_columns
        hidden = max(left - start, 0.0), max(end - right, 0.0)
        off = (begin + end_of_light) / 2 - start - n_columns / 2
        score = _light_within(light, start, end) + _hidden(hidden, reaches) - 0.5 * (off / (_LIGHT_SD * n_columns)) ** 2
        score += film[1] * (abs(film[0] - start - n_columns / 2) < _IN_MIDDLE)
        score += _still_edges(light, (start, end))
        for border, side, number in ((start, 1, LEFT), (end, -1, RIGHT)):
            signs = (_begins(light, border, side), _is_on(lying[number], border))
            score += _ON_BORDER * sum(signs)
        scores.append(score)
    return FirstColumns(first, np.array(scores) - max(scores), all(reaches))


def _hidden(columns: tuple[float, float], reaches: tuple[bool, bool]) -> float:
    """Log-odds of columns left and right of the picture, by whether light reaches to its ends."""
    if all(reaches):
        return max(_OUTSIDE * sum(columns), _LARGER)
    odds = [_OUTSIDE * count for count in columns]
    return sum(max(one, _LARGER) if to_the_end else one for one, to_the_end in zip(odds, reaches, strict=True))


def _light_within(light: LightProfile, start: int, end: int) -> float:
    """Log-odds that the screen lies between two borders; what lies next to them is the screen's if it has light."""
    near = np.minimum(np.abs(light.place - start), np.abs(light.place - end)) < 1 / _PARTS
    inside = (light.place > start) & (light.place < end) & ~near
    return float(light.log_odds[inside].sum() + np.maximum(light.log_odds[near], 0.0).sum())


def _begins(light: LightProfile, border: int, side: int) -> bool:
    """Whether light begins on a border, to its right (1) or left (-1)."""
    off = side * (light.place - border)
    beyond = (off < -1 / _PARTS) & (off > -0.5)
    inside, outside = light.log_odds[(off > 1 / _PARTS) & (off < 0.5)].sum(), light.log_odds[beyond].sum()
    seen = light.in_picture[beyond].all()
    return bool(seen and inside > _BEGINS and outside < _BEYOND * inside)


def _still_edges(light: LightProfile, borders: tuple[int, int]) -> float:
    """Log-odds of the steps of still light on two borders; of light that begins there the own step says no more."""
    places = []
    for border, side in zip(borders, (1, -1), strict=True):
        off = side * (light.place - border)
        is_lit = light.log_odds[(off > 1 / _PARTS) & (off < 0.5)].sum() > _BEGINS
        places.append(np.nan if is_lit else float(border))
    return light.still.on_borders((places[0], places[1]), _BORDER_SD)


def _film(light: LightProfile, grid: Grid, n_columns: int, aspect: float, lines: Sequence[Side]) -> tuple[float, float]:
    """Middle column of a picture that has dark bars left and right, and log-odds that it is the screen's middle."""
    ends = light.still.sharp_ends
    if ends is None or not _BARS[0] < (ends[1] - ends[0]) / n_columns < _BARS[1]:
        return 0.0, 0.0
    middle = (ends[0] + ends[1]) / 2
    # The more columns there are the less likely it lies in their middle by chance.
    by_chance = float(np.log(n_columns / _USUAL_COLUMNS))
    if not lines or min(lines[number].support for number in (TOP, BOTTOM)) < SHOWS:
        return middle, _FILM + by_chance
    x = grid.width / 2
    height = (lines[BOTTOM].at(x) - lines[TOP].at(x)) / grid.pitch_px * aspect / n_columns
    return middle, (_FILM + by_chance) * (abs(height - 1) < _AS_HIGH)


def _columns_of_line(grid: Grid, lines: Sequence[Side], number: int) -> FloatArray | None:
    """Columns on which the line where stripes begin on a side lies, at some places; None where it does not show."""
    if not lines or lines[number].support < SHOWS:
        return None
    line = lines[number]
    y, x = line.some_places
    return grid.columns_at(np.stack([x, y], axis=-1))


def _is_on(columns: FloatArray | None, border: int) -> bool:
    """Whether columns, of a line, are those of a border."""
    return columns is not None and bool(np.median(np.abs(columns - border)) < _NEAR_BORDER)
