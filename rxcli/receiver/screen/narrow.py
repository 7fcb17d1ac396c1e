"""The grid of columns that are narrow: found in a part of the picture, and followed from there to both sides.

Where a hundred columns stand side by side a comb over the whole picture has too many shapes to be tried. Over a fifth
of it there are some twenty columns, as on other screens. A grid that is right there is right a little further out, too,
and waveforms correct it before it goes on.
"""

from __future__ import annotations

from itertools import count

import numpy as np

from rxcli.receiver.screen.coherence import Coherence, Pixels, measure_coherence
from rxcli.receiver.screen.comb import FIFTH, Comb, find_combs
from rxcli.receiver.screen.grid import Grid, strip_places
from rxcli.receiver.screen.waveforms import StripLight, moved_by_waveforms, with_light
from rxcli.types import Lens

#: Strips across the picture, and the largest distance at which they are compared, picture widths.
_STRIPS, _REACH = 1000, 0.02
#: Parts of the picture, each a fifth of it; the best combs of so many of them are followed.
_PARTS, _SHARE, _FOLLOWED = 7, 0.2, 3
#: By how much further a grid is followed at a time; one of so many windows tells then.
_FURTHER, _EVERY = 1.6, 2
#: Light of wide columns is alike, picture widths apart, to this share of what it is next to it.
_NEAR, _FAR, _WIDE_ALIKE = 0.004, 0.018, 0.45
#: A grid's contrast, a share of what it explains: right ones of simulated pictures have 0.06 and more in any part of
#: the picture, wrong ones 0.06 by chance in a fifth of it, 0.04 in more and 0.03 in all of it.
_CONTRAST = 0.04
#: In so many parts, one further than the other, a grid's contrast is asked before it is followed on.
_ASKED = 2
#: A grid that is followed moves with every step, so that it need settle no better than this, columns.
_SETTLED = 0.01
#: Strips with light, a share, without which there is nothing to follow.
_LEAST_LIT = 0.02


def shows_narrow_columns(coherence: Coherence) -> bool:
    """Whether strips have light that is alike near by and no more a little further on, as that of wide columns is."""
    if float(coherence.lit.mean()) < _LEAST_LIT:
        return False
    near, far = (max(round(apart * coherence.width / coherence.strip_px), 1) for apart in (_NEAR, _FAR))
    if far > coherence.widest:
        return False
    alike, less = (float(coherence.pairs[:, :-apart, apart].mean()) for apart in (near, far))
    return less < _WIDE_ALIKE * alike


def find_narrow_columns(
    pixels: Pixels, sigma: float, *, mosaic_period: int = 1, lens: Lens | None = None
) -> tuple[Coherence, StripLight, list[Grid]]:
    """The grid of narrow columns that a picture shows; none where none stands out.

    Args:
        pixels: (height, width) uint8 or uint16: luma, or a mosaic.
        sigma: light spread of the screen, column pitches.
        mosaic_period: pixels after which the colours of a mosaic repeat; 1 for luma.
        lens: of the picture, where it is known.
    """
    coherence = measure_coherence(pixels, mosaic_period=mosaic_period, n_strips=_STRIPS, reach=_REACH)
    strips = StripLight.of(coherence, sigma, lens)
    for comb, first, last in _combs_of_parts(coherence, sigma):
        grid = _followed(strips, _whole(comb, coherence, first, last, lens), first, last)
        if grid is not None:
            return coherence, strips, [grid]
    return coherence, strips, []


def _combs_of_parts(coherence: Coherence, sigma: float) -> list[tuple[Comb, int, int]]:
    """The best comb of each of the parts that show one best, with the part's first strip and the one after its last."""
    n = coherence.x.size
    size = 2 * round(_SHARE * n / 2)
    found = []
    for start in np.linspace(0, n - size, _PARTS).tolist():
        first = 2 * min(round(start / 2), (n - size) // 2)
        combs = find_combs(coherence.between(first, first + size), sigma, 1, FIFTH)
        found += [(comb, first, first + size) for comb in combs]
    return sorted(found, key=lambda one: -one[0].score)[:_FOLLOWED]


def _whole(comb: Comb, coherence: Coherence, first: int, last: int, lens: Lens | None) -> Grid:
    """A comb of a part as a grid of the whole picture."""
    part = coherence.between(first, last)
    x = (part.x - (part.width - 1) / 2) / part.width
    y = (part.y[:, None] - (part.height - 1) / 2) / part.width
    u = comb.phase + comb.pitch * (x + comb.turn * y + comb.across * x * x + comb.along * x * y)
    at_x, at_y = (places[:, first:last].ravel() for places in strip_places(coherence, lens))
    flat = np.stack([np.ones_like(at_x), at_x, at_y], axis=-1)
    u0, a, b = np.linalg.lstsq(flat, u.ravel(), rcond=None)[0].tolist()
    return Grid(np.array([u0, a, b, 0.0, 0.0, 0.0]), coherence.width, coherence.height, lens)


def _followed(strips: StripLight, grid: Grid, first: int, last: int) -> Grid | None:
    """A grid of a part of the strips, followed from there to both ends; None where it turns out to be none."""
    n = strips.x.shape[1]
    thinned = strips.thinned(_EVERY)
    for step in count():
        part = thinned.between(first, last)
        grid = moved_by_waveforms(part, grid, settled=_SETTLED)
        if step < _ASKED:
            grid = with_light(part, grid)
            if _is_none(grid):
                return None
        if last - first >= n:
            break
        more = (_FURTHER - 1) * (last - first) / 2
        first, last = 2 * int(max(first - more, 0) / 2), min(int(last + more) + 2, n)
    grid = with_light(strips, moved_by_waveforms(strips, grid))
    return None if _is_none(grid) else grid


def _is_none(grid: Grid) -> bool:
    """Whether a grid explains nearly as much with its borders anywhere else."""
    return grid.contrast < _CONTRAST * grid.explained
