"""Where a screen's columns are, by the coherence of their strips alone: no side of the screen has to show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rxcli.receiver.screen.coherence import Coherence, Pixels, measure_coherence
from rxcli.receiver.screen.comb import find_combs
from rxcli.receiver.screen.grid import Grid, fit_grid
from rxcli.receiver.screen.numbering import Numbering, possible_numberings
from rxcli.receiver.screen.sides import Side
from rxcli.receiver.screen.waveforms import refine_by_waveforms
from rxcli.types import FloatArray, Lens

#: Score of a comb below which there is none, and share of the best one's gain from which another one is a rival.
_LEAST_SCORE, _RIVAL_GAIN, _RIVAL_NATS = 7.0, 0.75, 15.0
#: How much better columns must explain the pairs than none, nats: pictures without data seldom reach it.
_LEAST_GAIN = 5.0
#: By how much less a grid's waveforms may explain that it is still a rival, nats.
_RIVAL_EXPLAINED = 120.0
#: Combs that are fitted: more where the best does not stand out.
_FITTED, _CLEAR = 4, 0.7
#: Grids that differ less than this over the picture, columns, are one.
_SAME = 0.25
_MIN_SIZE = 96


@dataclass(frozen=True, slots=True)
class ColumnLayout:
    """What is known of a screen's columns."""

    n_columns: int = 20
    #: Light spread, column pitches.
    sigma: float = 0.45
    #: Width over height of the screen.
    aspect: float = 16 / 9


@dataclass(frozen=True, slots=True)
class ColumnSearch:
    """What a picture's coherence says of its columns."""

    #: None: the picture is too small to ask.
    coherence: Coherence | None
    #: Likeliest first; none where no comb shows.
    numberings: tuple[Numbering, ...]


def find_columns(
    pixels: Pixels,
    layout: ColumnLayout,
    *,
    mosaic_period: int = 1,
    lens: Lens | None = None,
    lines: Sequence[Side] = (),
) -> ColumnSearch:
    """Find the columns of a screen in a picture.

    Args:
        pixels: (height, width) uint8 or uint16: luma, or a mosaic.
        layout: of the screen.
        mosaic_period: pixels after which the colours of a mosaic repeat; 1 for luma.
        lens: of the picture, where it is known.
        lines: top, right, bottom, left, where stripes begin; none: nothing is known of them.
    """
    if min(pixels.shape) < _MIN_SIZE:
        return ColumnSearch(None, ())
    coherence = measure_coherence(pixels, mosaic_period=mosaic_period)
    found = []
    for grid in _grids(coherence, layout.sigma, lens):
        found += possible_numberings(coherence, grid, layout.n_columns, layout.aspect, lines=lines)
    return ColumnSearch(coherence, tuple(found))


def _grids(coherence: Coherence, sigma: float, lens: Lens | None) -> list[Grid]:
    """The grids that explain the coherence best, and rivals that come near."""
    combs = [comb for comb in find_combs(coherence, sigma, _FITTED) if comb.score > _LEAST_SCORE]
    if not combs:
        return []
    clear = len(combs) == 1 or combs[1].score < _CLEAR * combs[0].score
    fitted = [fit_grid(coherence, comb, sigma, lens) for comb in combs[: 1 if clear else _FITTED]]
    distinct: list[Grid] = []
    for grid in sorted(fitted, key=lambda one: -one.gain):
        if not any(_same(grid, other) for other in distinct):
            distinct.append(grid)
    least = min(_RIVAL_GAIN * distinct[0].gain, distinct[0].gain - _RIVAL_NATS)
    refined = [refine_by_waveforms(coherence, grid, sigma) for grid in distinct if grid.gain > least]
    refined.sort(key=lambda one: -one.explained)
    likely = [grid for grid in refined if grid.explained > refined[0].explained - _RIVAL_EXPLAINED]
    return [grid for grid in likely if grid.gain > _LEAST_GAIN]


def _same(one: Grid, other: Grid) -> bool:
    """Whether two grids differ next to nowhere but in their first column."""
    x = np.linspace(0.1, 0.9, 7) * one.width
    y = np.linspace(0.2, 0.8, 5) * one.height
    apart = one.columns_at(_points(x, y)) - other.columns_at(_points(x, y))
    apart -= np.round(np.median(apart))
    return bool(np.abs(apart).mean() < _SAME)


def _points(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.stack(np.meshgrid(x, y), axis=-1)
