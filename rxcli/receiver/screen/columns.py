"""Where a screen's columns are, by the coherence of their strips alone: no side of the screen has to show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rxcli.receiver.screen.coherence import Coherence, Pixels, measure_coherence
from rxcli.receiver.screen.comb import find_combs
from rxcli.receiver.screen.drive import explained_with_drive
from rxcli.receiver.screen.grid import Grid
from rxcli.receiver.screen.narrow import find_narrow_columns, shows_narrow_columns
from rxcli.receiver.screen.numbering import Numbering, possible_numberings
from rxcli.receiver.screen.picture import MIN_SIZE
from rxcli.receiver.screen.sides import Side
from rxcli.receiver.screen.waveforms import StripLight, refine_by_waveforms, with_light
from rxcli.types import FloatArray, Lens

#: Combs that are looked at, by one of so many windows, and the best that are refined, unless they explain less than
#: this share of the first one.
_COMBS, _EVERY, _FITTED, _HOPELESS = 12, 2, 4, 0.8
#: Steps that these take by some windows, at most, and those near the best then by all.
_FIRST_STEPS, _LAST_STEPS = 4, 6
#: By how much less a grid may explain, a share, that it is still a rival.
_RIVAL = 0.05
#: Contrast, a share of what is explained, from which on columns are not of unlike drive.
_PLAIN_CONTRAST = 0.27
#: Log-odds that drives make the difference, and what each nat adds that is explained more then than by the other grid.
_UNLIKE_DRIVE, _DRIVE_COUNTS = -3.0, 0.025
#: Contrast of a grid, a share of what it explains, from which there may be columns, for one independent row: by chance
#: it is the smaller, the more rows there are.
_LEAST_CONTRAST = 0.95
#: Share of that which one of the combs must show at first sight; those of grids have shown 0.83 and more.
_AT_FIRST_SIGHT = 0.75
#: The same for every strip of a window, nats: in noise it is a third of this.
_LEAST_IN_STRIP = 0.05
#: How much more a lens that nobody knows must explain, a share.
_BENT_GAIN = 0.01
#: Grids that differ less than this over the picture, columns, are one; combs that differ less from a grid lead to it.
_SAME, _WITHIN_REACH = 0.25, 0.4
#: Columns from which on a screen's are narrow.
_MANY_COLUMNS = 50


@dataclass(frozen=True, slots=True)
class ColumnLayout:
    """What is known of a screen's columns."""

    n_columns: int = 20
    #: Light spread, column pitches.
    sigma: float = 0.45
    #: Width over height of the screen.
    aspect: float = 16 / 9

    @property
    def is_narrow(self) -> bool:
        """Whether columns are so many that a picture is searched for them part by part."""
        return self.n_columns >= _MANY_COLUMNS


@dataclass(frozen=True, slots=True)
class ColumnSearch:
    """What a picture's coherence says of its columns."""

    #: None: the picture is too small to ask.
    coherence: Coherence | None
    #: Likeliest first; none where no comb shows.
    numberings: tuple[Numbering, ...]
    #: Whose columns were found.
    layout: ColumnLayout


def find_columns(
    pixels: Pixels,
    *layouts: ColumnLayout,
    mosaic_period: int = 1,
    lens: Lens | None = None,
    lines: Sequence[Side] = (),
) -> ColumnSearch:
    """Find the columns of a screen in a picture.

    Args:
        pixels: (height, width) uint8 or uint16: luma, or a mosaic.
        layouts: that the screen may have: one, or one of wide and one of narrow columns.
        mosaic_period: pixels after which the colours of a mosaic repeat; 1 for luma.
        lens: of the picture, where it is known.
        lines: top, right, bottom, left, where stripes begin; none: nothing is known of them.
    """
    wide, narrow = (next((one for one in layouts if one.is_narrow is many), None) for many in (False, True))
    either = wide or narrow or ColumnLayout()
    if min(pixels.shape) < MIN_SIZE:
        return ColumnSearch(None, (), either)
    coherence = measure_coherence(pixels, mosaic_period=mosaic_period)
    if narrow is not None and shows_narrow_columns(coherence):
        fine, strips, grids = find_narrow_columns(pixels, narrow.sigma, mosaic_period=mosaic_period, lens=lens)
        if grids:
            return ColumnSearch(coherence, _numbered(fine, strips, grids, narrow, lines), narrow)
    if wide is None:
        return ColumnSearch(coherence, (), either)
    strips = StripLight.of(coherence, wide.sigma, lens)
    return ColumnSearch(
        coherence, _numbered(coherence, strips, likely_grids(coherence, strips, lens), wide, lines), wide
    )


def _numbered(
    coherence: Coherence, strips: StripLight, grids: list[Grid], layout: ColumnLayout, lines: Sequence[Side]
) -> tuple[Numbering, ...]:
    """The numberings of all grids."""
    found: list[Numbering] = []
    for grid in grids:
        found += possible_numberings(coherence, strips, grid, layout.n_columns, layout.aspect, lines=lines)
    return tuple(found)


def likely_grids(coherence: Coherence, strips: StripLight, lens: Lens | None) -> list[Grid]:
    """The grids that explain the strips' light best, and rivals that come near, likeliest first."""
    thinned = strips.thinned(_EVERY)
    combs = [Grid.of_comb(comb, coherence, lens) for comb in find_combs(coherence, strips.sigma, _COMBS)]
    combs = sorted((with_light(thinned, grid) for grid in combs), key=lambda one: -one.likelihood)
    least = _LEAST_CONTRAST / np.sqrt(coherence.n_rows * coherence.y.size)
    if not any(grid.contrast > _AT_FIRST_SIGHT * least * grid.explained for grid in combs):
        return []
    hopeful = _near_the_best(_with_likely_by_drive(thinned, combs, _refined(thinned, combs)), 2 * _RIVAL)
    refined = [refine_by_waveforms(strips, grid, _LAST_STEPS) for grid in hopeful]
    refined.sort(key=lambda one: -one.likelihood)
    distinct: list[Grid] = []
    for grid in _near_the_best(refined, _RIVAL):
        new = not any(_apart(grid, known) < _SAME for known in distinct)
        if new and grid.contrast > max(least * grid.explained, _LEAST_IN_STRIP * strips.x.size):
            distinct.append(grid)
    return [_bent(strips, grid) for grid in distinct] if lens is None else distinct


def _refined(strips: StripLight, combs: list[Grid]) -> dict[int, Grid]:
    """The best combs, by number, refined; of those that lead to one grid the first."""
    refined: dict[int, Grid] = {}
    for number, grid in enumerate(combs):
        if len(refined) == _FITTED or (refined and grid.likelihood < _HOPELESS * refined[0].likelihood):
            break
        if not any(_apart(grid, known) < _WITHIN_REACH for known in refined.values()):
            refined[number] = _improved(strips, grid)
    return refined


def _improved(strips: StripLight, comb: Grid) -> Grid:
    """A comb's grid some steps further, where it is better then."""
    grid = refine_by_waveforms(strips, comb, _FIRST_STEPS)
    return grid if grid.likelihood > comb.likelihood else comb


def _near_the_best(grids: list[Grid], less: float) -> list[Grid]:
    """Grids that explain less than the likeliest by no more than a share, and that of columns of unlike drive."""
    best = max((one.likelihood for one in grids), default=0.0)
    return [one for one in grids if one.drive_odds is not None or one.likelihood > (1 - less) * best]


def _with_likely_by_drive(strips: StripLight, combs: list[Grid], fitted: dict[int, Grid]) -> list[Grid]:
    """The fitted grids with the one marked that is likeliest if columns are of unlike drive, where that may be."""
    refined = sorted(fitted.values(), key=lambda one: -one.likelihood)
    if not refined or refined[0].contrast > _PLAIN_CONTRAST * refined[0].explained:
        return refined
    light = np.array([explained_with_drive(strips, comb) for comb in combs])
    best = int(light.argmax())
    grid = fitted[best] if best in fitted else _improved(strips, combs[best])
    if grid.likelihood < (1 - 2 * _RIVAL) * refined[0].likelihood or _apart(grid, refined[0]) < _SAME:
        return refined
    others = [one for one in refined if _apart(grid, one) >= _SAME]
    nearer = [_apart(comb, refined[0]) < _apart(comb, grid) for comb in combs]
    more = float(light[best]) - float(light[nearer].max(initial=float(light.min())))
    return [*others, replace(grid, drive_odds=min(_UNLIKE_DRIVE + _DRIVE_COUNTS * more, 0.0))]


def _bent(strips: StripLight, grid: Grid) -> Grid:
    """The grid with an unknown lens, where that explains much more: such lenses are rare."""
    bent = refine_by_waveforms(strips, replace(grid, bent=True), _LAST_STEPS)
    return bent if bent.likelihood > (1 + _BENT_GAIN) * grid.likelihood else grid


def _apart(one: Grid, other: Grid) -> float:
    """How far two grids differ but in their first column, columns on average."""
    x = np.linspace(0.1, 0.9, 7) * one.width
    y = np.linspace(0.2, 0.8, 5) * one.height
    apart = one.columns_at(_points(x, y)) - other.columns_at(_points(x, y))
    apart -= np.round(np.median(apart))
    return float(np.abs(apart).mean())


def _points(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.stack(np.meshgrid(x, y), axis=-1)
