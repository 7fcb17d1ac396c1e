"""Which column of a grid is the screen's first: no light may lie outside, little of the screen outside the picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rxcli.receiver.screen.coherence import Coherence
from rxcli.receiver.screen.grid import Grid, LightMap, light_map
from rxcli.receiver.screen.rows import find_rows
from rxcli.receiver.screen.sides import LEFT, RIGHT, Side
from rxcli.types import BoolArray, FloatArray, IntArray

#: Share of a screen's columns that are dark, and significance of columns that have light, about. Off the screen it is
#: spread by this scale, more than by chance: what row noise leaves.
_DARK_COLUMNS, _LIT_SCALE, _OFF_SCALE = 0.3, 30.0, 2.0
#: Log-odds of a screen that goes on outside the picture, for every column that is there.
_OUTSIDE = -2.0
#: The light's middle is the screen's, but for this, columns.
_LIGHT_SD = 3.0
#: Support from which a line where stripes begin counts, how near it lies to a border then, columns, and the log-odds
#: that it adds there.
_LINE_SHOWS, _NEAR_BORDER, _ON_BORDER = 0.2, 0.1, 2.3
#: A column of which this share lies in the picture is in view.
_MOSTLY = 0.5


@dataclass(frozen=True, slots=True)
class Numbering:
    """A grid with its first column chosen."""

    #: Its columns count from the screen's first.
    grid: Grid
    #: (4, 2) the screen's corners in pixels of the stored picture, clockwise from its top left.
    corners: FloatArray
    #: Natural logarithm of its odds against the other numberings of the same grid.
    log_odds: float
    #: Columns that lie in the picture with most of their width: first, and last + 1.
    visible: tuple[int, int]


def possible_numberings(
    coherence: Coherence,
    grid: Grid,
    n_columns: int,
    aspect: float,
    least: float = -7.0,
    lines: Sequence[Side] = (),
) -> list[Numbering]:
    """The columns that may be the screen's first, likeliest first.

    Args:
        coherence: of the picture.
        grid: columns of it.
        n_columns: columns of the screen.
        aspect: width over height of the screen.
        lines: top, right, bottom, left, where stripes begin; none: nothing is known of them.
        least: log-odds against the likeliest down to which they are given.
    """
    start = first_columns(coherence, grid, n_columns, lines)
    likely: IntArray = np.flatnonzero(start.log_odds > least)
    chosen = likely[np.argsort(-start.log_odds[likely], kind="stable")]
    first, odds, k, there, light = start.first, start.log_odds, start.columns, start.in_picture, start.light
    best = int(first[chosen[0]])
    mine = (k >= best) & (k < best + n_columns)
    # All have their rows in common, so that packets can tell them apart.
    rows = find_rows(
        coherence, grid.shifted(best), n_columns, aspect, _middle_row(coherence, light, mine), tuple(lines[::2])
    )
    out = []
    for i in chosen:
        number = int(first[i])
        column = k[(there > _MOSTLY) & (k >= number) & (k < number + n_columns)] - number
        visible = (int(column.min()), int(column.max()) + 1) if column.size else (0, 0)
        out.append(Numbering(grid.shifted(number), rows.corners(number - best), float(odds[i]), visible))
    return out


@dataclass(frozen=True, slots=True)
class FirstColumns:
    """What a picture says of the columns that may be the screen's first."""

    #: (F,) such columns of the grid, and the natural logarithm of their odds against the likeliest.
    first: IntArray
    log_odds: FloatArray
    #: (K,) columns of the grid in the picture, and the share of each that lies in it.
    columns: IntArray
    in_picture: FloatArray
    #: (K,) whether light was seen there.
    lit: BoolArray
    light: LightMap


def first_columns(coherence: Coherence, grid: Grid, n_columns: int, lines: Sequence[Side] = ()) -> FirstColumns:
    """How likely each column of a grid is the screen's first.

    Numberings that differ by a shift have all columns in common but the outermost, so these decide: light outside the
    screen, columns outside the picture and a line where stripes begin tell. Where columns are dark at both ends the
    numberings stay alike.
    """
    light = light_map(coherence, grid)
    evidence = _column_evidence(light)
    there = _share_in_picture(coherence, grid, light)
    k = light.first + np.arange(evidence.size)
    first = np.arange(light.first - n_columns + 3, light.first + evidence.size - 2)
    lit = np.flatnonzero(evidence > 0)
    middle = float(k[lit].mean()) + 0.5 if lit.size else light.first + evidence.size / 2
    scores = []
    for start in first.tolist():
        inside = (k >= start) & (k < start + n_columns)
        hidden = n_columns - float(there[inside].sum())
        score = float(evidence[inside].sum()) + _OUTSIDE * max(hidden - 0.3, 0.0)
        off = (middle - start - n_columns / 2) / _LIGHT_SD
        scores.append(score - 0.5 * off * off + _by_lines(grid, lines, start, n_columns))
    return FirstColumns(first, np.array(scores) - max(scores), k, there, evidence > 0, light)


def _by_lines(grid: Grid, lines: Sequence[Side], first: int, n_columns: int) -> float:
    """Log-odds that the lines where stripes begin at left and right add to a first column.

    A screen's side lies on a border of its columns; the edge of a picture on it lies there by chance only.
    """
    total = 0.0
    for number, border in ((RIGHT, first + n_columns), (LEFT, first)):
        if not lines or lines[number].support < _LINE_SHOWS:
            continue
        line = lines[number]
        y = line.middle + line.half * np.linspace(-0.8, 0.8, 5)
        off = np.abs(grid.columns_at(np.stack([line.at(y), y], axis=-1)) - border)
        total += _ON_BORDER if np.median(off) < _NEAR_BORDER else 0.0
    return total


def _column_evidence(light: LightMap) -> FloatArray:
    """(K,) log-likelihood ratio of each column being the screen's over being off it."""
    seen = np.maximum(light.significance, 0.0)
    off = np.exp(-seen / _OFF_SCALE) / _OFF_SCALE + 1e-12
    lit = np.exp(-seen / (2 * _LIT_SCALE)) / (2 * _LIT_SCALE)
    return np.asarray(np.log(_DARK_COLUMNS + (1 - _DARK_COLUMNS) * lit / off))


def _share_in_picture(coherence: Coherence, grid: Grid, light: LightMap) -> FloatArray:
    """(K,) share of each column of the light map that lies in the picture."""
    points = np.stack(np.meshgrid(coherence.x, coherence.y), axis=-1)
    column = np.floor(grid.columns_at(points)).astype(np.int64) - light.first
    strips = np.bincount(column.ravel(), minlength=light.light.shape[1]) / coherence.y.size
    return np.asarray(np.minimum(strips * coherence.strip_px / grid.pitch_px, 1.0))


def _middle_row(coherence: Coherence, light: LightMap, columns: BoolArray) -> float:
    """The row in the middle of the light under some columns."""
    precision = light.precision[:, columns]
    total = np.maximum((light.light[:, columns] * precision).sum(axis=1), 0.0)
    return float((total * coherence.y).sum() / max(total.sum(), 1e-9)) if total.any() else coherence.height / 2
