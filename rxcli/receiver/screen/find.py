"""The finder: propose outlines of the screen in a picture, from the coherence of strips alone.

No side of the screen has to be visible. Strips (`strips`) give combs of borders (`combs`). The combs whose waveforms
explain the light best become grids of columns (`grid`, `waveforms`). Light outside the screen and columns out of view
identify the first column (`numbering`); light along the columns gives the first and last rows (`rows`). The finder
proposes outlines with log-odds and leaves the decision to the search.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.combs import MIN_PITCH, Comb, find_combs, grid_of_comb
from rxcli.receiver.screen.courses import is_upright, tilted_course
from rxcli.receiver.screen.grid import Grid, columns_at, grid_through
from rxcli.receiver.screen.numbering import LightProfile, first_columns, light_profile
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.screen.rows import find_rows
from rxcli.receiver.screen.strips import UPRIGHT, Course, PictureStrips, read_strips, shows_narrow_columns
from rxcli.receiver.screen.waveforms import moved_by_waveforms, predicted_light, with_light
from rxcli.types import Float32Array, FloatArray, Lens, LightPlane, Remark

#: Minimum width and height of a picture, pixels, its maximum height in widths, beyond which a grid in perspective may
#: have columns of no width, and minimum number of strips across it.
MIN_SIZE_PX, MAX_TALL, _MIN_STRIPS = 96, 6, 120
#: Number of columns from which a screen's columns count as narrow, and parts of a picture that are searched for them.
_NARROW_COLUMNS, _PARTS = 50, 5
#: Factor by which the followed width of a grid of narrow columns grows at a time.
_REACH_GAIN = 1.4
#: Steps of a grid on some of the windows, and last steps on all windows; times that the course of columns which lean is
#: followed.
_FIRST_STEPS, _LAST_STEPS, _COURSES = 3, 2, 2
#: Contrast of the strongest comb's grid, as a share of the light it explains, from which no others are tried; number of
#: others that are fitted to all windows.
_PLAIN_CONTRAST, _N_FITTED = 0.15, 2
#: Quantiles of the lit strips between which two grids differ by less than this many columns if they have the same ones.
_MOST, _SAME_COLUMNS = (0.02, 0.98), 0.5
#: Weights of the light that a grid explains and of its perspective in its score, against 1 for its contrast: fitted to
#: the grids of 186 simulated scenes, one in four of a night, such that no bright one loses its own.
_BY_EXPLAINED, _BY_PERSPECTIVE = 7.0, -1.0
#: Score that a screen costs which is seen from the side, however far: one picture in twenty.
_FROM_THE_SIDE = -0.3
#: Contrast of one screen's grid, as a share of that of two, from which there is one: over two it has that of one alone.
_ONE_SCREEN = 0.9
#: Contrast, times what chance gives, from which packets are looked for; of a part of a picture it must be plainer.
_POSSIBLE_CONTRAST = 0.5
#: Log-odds relative to the likeliest first column down to which another one is possible.
_MIN_LOG_ODDS = -12.0
#: The same of a grid, down to which it is a rival.
_NEAR_ODDS = -4.0
#: Number of unlit columns at a side from which the side counts as not visible.
_UNLIT_COLUMNS = 0.5
#: Share of the light on the smaller side of a gap without light, its width from which perspective may miss a column,
#: columns; coherence of lit strips; and log-odds of a unit of a grid's score.
_MIN_BESIDE, _WIDE_GAP, _LIT_STRIP, _SCORE_ODDS = 0.03, 2.0, 0.2, 5.0
#: Strips and a grid of their columns.
_Placed = tuple[PictureStrips, Grid]


@dataclass(frozen=True, slots=True)
class ColumnLayout:
    """Columns of a screen: number, light spread and aspect."""

    n_columns: int
    #: Light spread, column pitches.
    sigma: float
    #: Width over height of the screen.
    aspect: float

    @property
    def is_narrow(self) -> bool:
        """Whether the columns are narrow, so that each fifth of a picture is searched for them."""
        return self.n_columns >= _NARROW_COLUMNS


def find_screens(
    plane: LightPlane, layouts: Sequence[ColumnLayout], lens: Lens | None = None, parts: Sequence[FloatArray] = ()
) -> list[list[Outline]]:
    """Candidate outlines of each screen in a picture, likeliest first; the clearest screen comes first.

    Args:
        plane: of the picture.
        layouts: that the screen may have.
        lens: of the picture, if known.
        parts: corners (4, 2) of bright parts of the picture, clockwise from the top left: one may be the screen.
    """
    strips = _strips_of(plane, lens)
    if strips is None:
        return []
    narrow, wide = ([layout for layout in layouts if layout.is_narrow is many] for many in (True, False))
    screens = _screens_apart(strips, wide) if wide else []
    if screens:
        return screens
    if narrow and shows_narrow_columns(strips.without_common_light()):
        fine = read_strips(plane, lens, n_parts=_PARTS)
        grid = narrow_grid(fine, narrow[0].sigma)
        if grid is not None:
            return [_of_rivals([(fine, grid)], narrow, parts)]
    if not wide:
        return []

    def along(course: Course) -> PictureStrips:
        return read_strips(plane, lens, course=course)

    placed = wide_grids(strips, wide[0].sigma, _POSSIBLE_CONTRAST, along)
    return [_of_rivals(placed, wide, parts)] if placed else []


def _of_rivals(
    placed: Sequence[_Placed], layouts: Sequence[ColumnLayout], parts: Sequence[FloatArray] = ()
) -> list[Outline]:
    """Candidate outlines of grids, the likeliest grid first: outlines of its rivals are families of their own.

    Args:
        placed: grids, the best first.
        layouts: that the screen may have.
        parts: see `find_screens`.
    """
    rivals: list[tuple[float, list[Outline]]] = []
    for own in _distinct([*placed, *_across_gap(*placed[0], layouts[0])]):
        outlines = sorted(_numbered(*own, layouts, parts), key=lambda outline: -outline.log_odds)
        likeliest = outlines[0].log_odds
        relative = [replace(outline, log_odds=outline.log_odds - likeliest) for outline in outlines]
        rivals.append((_SCORE_ODDS * _score(own[1]) + likeliest, relative))
    rivals.sort(key=lambda rival: -rival[0])
    return [
        replace(outline, family=outline.family + number * len(layouts), rival_odds=odds - rivals[0][0])
        for number, (odds, outlines) in enumerate(rivals)
        for outline in outlines
    ]


def shows_narrow(plane: LightPlane) -> bool:
    """Whether the columns in a picture are narrow."""
    strips = _strips_of(plane, None)
    return strips is not None and shows_narrow_columns(strips.without_common_light())


def striped_box(plane: LightPlane) -> FloatArray | None:
    """See `PictureStrips.striped_box`."""
    strips = _strips_of(plane, None)
    return None if strips is None else strips.striped_box()


def _strips_of(plane: LightPlane, lens: Lens | None) -> PictureStrips | None:
    """The strips of a picture, or None if its size shows no screen."""
    if size_refused(plane.width, plane.height):
        return None
    strips = read_strips(plane, lens)
    return strips if strips.coherence.shape[1] >= _MIN_STRIPS else None


def _screens_apart(strips: PictureStrips, layouts: Sequence[ColumnLayout]) -> list[list[Outline]]:
    """Candidate outlines of two screens side by side, or none: together they light more columns than one has."""

    def n_lit(part: PictureStrips, grid: Grid) -> float:
        return float(np.ptp(_light_across(part, grid, layouts[0].sigma)[1].ends))

    sides, too_many = strips.sides_of_gap(), max(layout.n_columns for layout in layouts) + 1
    found = [own for side in sides for own in wide_grids(side, layouts[0].sigma)[:1]]
    if len(found) < 2 or sum(n_lit(side, grid) for side, grid in found) < too_many:
        return []
    together, whole = sum(grid.contrast for _, grid in found), wide_grids(strips, layouts[0].sigma)
    if whole and whole[0][1].contrast > _ONE_SCREEN * together and n_lit(*whole[0]) < too_many:
        return []
    clearest_first = sorted(found, key=lambda side_and_grid: -side_and_grid[1].explained)
    return [_of_rivals([own], layouts) for own in clearest_first]


def size_refused(width: int, height: int) -> Remark | None:
    """Why a picture of a size can show no screen, or None."""
    if min(width, height) < MIN_SIZE_PX:
        return Remark("few_pixels", {"width": width, "height": height, "least": MIN_SIZE_PX})
    if height > MAX_TALL * width:
        return Remark("too_tall", {"width": width, "height": height, "most": MAX_TALL})
    return None


def why_useless(pixels: NDArray[np.uint8] | NDArray[np.uint16], black: float, white: float) -> Remark | None:
    """Why a picture cannot show a screen at all, or None."""
    height, width = pixels.shape
    refused = size_refused(width, height)
    if refused is not None:
        return refused
    sample = thinned(pixels, black, white)
    if np.mean(sample >= 0.004) < 0.005:
        return Remark("black")
    if np.mean(sample > 0.98) > 0.99:
        return Remark("saturated")
    return None


def thinned(pixels: NDArray[np.uint8] | NDArray[np.uint16], black: float, white: float) -> Float32Array:
    """Subsample a picture to a few thousand pixels; 0 is black, 1 is white."""
    steps = (slice(None, None, max(1, size // 64)) for size in pixels.shape)
    return np.asarray((pixels[*steps] - np.float32(black)) / (white - black), np.float32)


def wide_grids(
    strips: PictureStrips,
    sigma: float,
    least: float = 1.0,
    along: Callable[[Course], PictureStrips] | None = None,
) -> list[_Placed]:
    """Grids of wide columns whose borders stand out, each with other columns than those before, the best score first.

    Args:
        strips: of the picture, upright.
        sigma: light spread of the screen, column pitches.
        least: minimum contrast, times what chance gives.
        along: reads the strips of the picture along columns that lean; None if only upright ones are sought.
    """
    quiet = strips.without_common_light()
    combs = find_combs(quiet)
    placed = [_fitted(own, grid, sigma, along) for own, grid in _starts(strips, combs[:1], sigma)]
    if not (placed and _is_plain(placed[0][1])):
        starts, course = _starts(strips, combs[1:], sigma), along and tilted_course(quiet)
        if along and course:
            starts += _leaning_starts(along, course, sigma)
        placed += [_fitted(own, grid, sigma, along) for own, grid in _distinct(starts)[:_N_FITTED]]
    distinct = _distinct([own for own in placed if _stands_out(*own, least)])
    return [own for own in distinct if _SCORE_ODDS * (_score(own[1]) - _score(distinct[0][1])) > _NEAR_ODDS]


def _is_plain(grid: Grid) -> bool:
    """Whether no other grid can be right."""
    return grid.contrast >= _PLAIN_CONTRAST * grid.explained and is_upright(grid.course)


def _starts(strips: PictureStrips, combs: Sequence[Comb], sigma: float) -> list[_Placed]:
    """Grids of combs, moved to their columns, as contrast needs borders that are in their place already."""
    some = strips.blocks(slice(None, None, 2))
    grids = (moved_by_waveforms(some, grid_of_comb(comb, strips), sigma, _FIRST_STEPS) for comb in combs)
    return [(strips, with_light(some, grid, sigma)) for grid in grids]


def _distinct(placed: Sequence[_Placed]) -> list[_Placed]:
    """Grids by their score, the best first, leaving out any with the columns of a better one."""
    out: list[_Placed] = []
    for own in sorted(placed, key=lambda own: -_score(own[1])):
        if not any(_shares_columns(own, better) for better in out):
            out.append(own)
    return out


def _shares_columns(own: _Placed, better: _Placed) -> bool:
    """Whether two grids have the same columns where there is light, however they are counted."""
    (strips, grid), lit = better, better[0].coherence > _LIT_STRIP
    x, y = strips.x[lit], strips.y[lit]
    off = columns_at(own[1].coefficients, x, y) - columns_at(grid.coefficients, x, y)
    return bool(lit.any()) and float(np.ptp(np.quantile(off, _MOST))) < _SAME_COLUMNS


def _leaning_starts(along: Callable[[Course], PictureStrips], course: Course, sigma: float) -> list[_Placed]:
    """Grids of the strongest combs about a course of the columns, and about that of the best of them in turn."""
    found: list[_Placed] = []
    for _ in range(_COURSES):
        strips = along(course)
        found += _starts(strips, find_combs(strips.without_common_light()), sigma)
        course = max(found, key=lambda own: _score(own[1]))[1].course if found else course
    return found


def _fitted(
    strips: PictureStrips, grid: Grid, sigma: float, along: Callable[[Course], PictureStrips] | None
) -> _Placed:
    """A grid moved to its columns; strips that lean are read anew along them."""
    if along and strips.course != UPRIGHT:
        strips = along(grid.course)
    return strips, with_light(strips, moved_by_waveforms(strips, grid, sigma, _LAST_STEPS), sigma)


def _score(grid: Grid) -> float:
    """Score by which grids are compared, a fifth of the log-odds.

    The right grid explains most, but for grids of narrow columns, which lack contrast. Where lamps light columns unlike
    each other, grids of wide columns have the most contrast.
    """
    if min(grid.contrast, grid.explained) <= 0:
        return -np.inf
    perspective = _BY_PERSPECTIVE * float(np.square(grid.coefficients[3:5]).sum())
    return float(np.log(grid.contrast) + _BY_EXPLAINED * np.log(grid.explained)) + max(perspective, _FROM_THE_SIDE)


def narrow_grid(strips: PictureStrips, sigma: float) -> Grid | None:
    """The grid of narrow columns, or None: parts of the picture are searched, and a clear grid is followed outwards."""
    some, few = (strips.blocks(slice(None, None, step)) for step in (2, 4))
    for part in sorted(range(strips.n_parts), key=lambda part: abs(part - strips.n_parts // 2)):
        for comb in find_combs(strips.part(part).without_common_light())[:1]:
            own = few.part(part)
            grid = moved_by_waveforms(own, grid_of_comb(comb, strips.part(part)), sigma, _FIRST_STEPS)
            if not _stands_out(own, with_light(own, grid, sigma)):
                continue
            grid = with_light(some, _followed(some, grid, float(own.raw_x.mean()), sigma), sigma)
            if _stands_out(some, grid):
                return grid
    return None


def _followed(strips: PictureStrips, grid: Grid, middle: float, sigma: float) -> Grid:
    """Extend a grid from the part of a picture around `middle` to the whole width."""
    reach = 0.5 / _PARTS
    while reach < 0.5 + abs(middle):
        reach *= _REACH_GAIN
        within = np.abs(strips.raw_x - middle) < reach
        near = np.flatnonzero(within.any(axis=1))
        grid = moved_by_waveforms(strips.blocks(near), grid, sigma, _LAST_STEPS, within[near])
    return grid


def _stands_out(strips: PictureStrips, grid: Grid, least: float = 1.0) -> bool:
    """Whether columns are possible, and stand out: their borders explain more than half a column further on."""
    by_chance = grid.explained / np.sqrt(strips.picture_rows)
    return bool(grid.contrast > least * by_chance and np.hypot(*grid.coefficients[1:3]) >= MIN_PITCH)


def _numbered(
    strips: PictureStrips, grid: Grid, layouts: Sequence[ColumnLayout], parts: Sequence[FloatArray] = ()
) -> list[Outline]:
    """Candidate outlines of a grid, one per possible first column; outlines of one layout share their rows."""
    light, profile = _light_across(strips, grid, layouts[0].sigma, parts)
    stands_out = _stands_out(strips, grid)
    found: list[Outline] = []
    for family, layout in enumerate(layouts):
        columns, odds, fills = first_columns(profile, layout.n_columns, layout.aspect)
        best, n = int(columns[odds.argmax()]), layout.n_columns
        own = moved_by_waveforms(strips, grid.shifted(best), layout.sigma, _LAST_STEPS, n_columns=n)
        axis, ends, has_bars = find_rows(strips, light, own, n, layout.aspect)
        for number, log_odds in zip(columns.tolist(), odds.tolist(), strict=True):
            if log_odds > odds.max() + _MIN_LOG_ODDS:
                corners, counted = axis.corners(ends, number - best), own.shifted(number - best)
                unlit = (profile.ends[0] - number, number + n - profile.ends[1])
                sides = _unlit_sides(corners, unlit, has_bars, (strips.width, strips.height))
                found.append(
                    Outline(
                        corners,
                        inferred=sides,
                        log_odds=log_odds,
                        family=family,
                        fills=fills,
                        stands_out=stands_out,
                        n_columns=n,
                        strips=strips,
                        grid=counted,
                    )
                )
    return found


def _across_gap(strips: PictureStrips, grid: Grid, layout: ColumnLayout) -> list[_Placed]:
    """The grid with a column less, and one more, in its widest gap without light, as behind a person; none without.

    Each side of a gap has its own columns, and perspective bridges it to about a column.
    """
    start, end = strips.gap(_MIN_BESIDE)
    if layout.is_narrow or (end - start) * strips.step * abs(grid.coefficients[1]) < _WIDE_GAP:
        return []
    number, u = np.arange(strips.x.shape[1]), columns_at(grid.coefficients, strips.x, strips.y)
    is_left = number < start
    beside = (strips.coherence > _LIT_STRIP) & (is_left | (number >= end))
    out: list[_Placed] = []
    for more in (-1, 1):
        rival = grid_through(grid, strips.x[beside], strips.y[beside], (u + more * is_left)[beside])
        rival = moved_by_waveforms(strips, rival, layout.sigma, 2 * _FIRST_STEPS)
        out.append((strips, with_light(strips, rival, layout.sigma)))
    return out


def _light_across(
    strips: PictureStrips, grid: Grid, sigma: float, parts: Sequence[FloatArray] = ()
) -> tuple[Float32Array, LightProfile]:
    """Light of the strips that a grid predicts, and its profile across the columns."""
    light = predicted_light(strips, columns_at(grid.coefficients, strips.x, strips.y), sigma)
    return light, light_profile(strips, light, grid, parts)


def _unlit_sides(
    corners: FloatArray, unlit: tuple[float, float], has_bars: bool, size: tuple[int, int]
) -> tuple[str, ...]:
    """Sides outside the picture, or beside columns or rows without light."""
    middles = (corners + np.roll(corners, -1, axis=0)) / 2
    outside = ((middles < 0) | (middles > np.array(size) - 1)).any(axis=1)
    dark = np.array([has_bars, unlit[1] > _UNLIT_COLUMNS, has_bars, unlit[0] > _UNLIT_COLUMNS])
    return tuple(name for name, hidden in zip(geometry.SIDE_NAMES, outside | dark, strict=True) if hidden)
