"""The comb of column borders: the correlation of two nearby strips is lowest if a border lies between them.

Along the screen, the correlation of strips at a distance of `d` columns oscillates about its mean with a period of one
column, most strongly for `d` of about 0.7. A Fourier sum over all pairs at about that distance finds the period. It
needs no edge of the screen, no light spread and no decoding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.numerics import TINY, waves_of
from rxcli.receiver.screen.grid import Grid, grid_through
from rxcli.receiver.screen.strips import PictureStrips
from rxcli.types import Float32Array, FloatArray

#: Columns across the picture, or across a fifth of it; minimum number of strips per column.
MIN_PITCH, _MAX_PITCH, _MIN_COLUMN_STRIPS = 9.0, 46.0, 4.0
#: Maximum turn and maximum changes of pitch across and along the columns, as shares of the pitch; step of all three at
#: a corner of the picture, and of the columns across it, columns.
_MAX_TURN, _MAX_ACROSS, _MAX_ALONG, _STEP = 0.12, 0.2, 0.3, 0.4
#: Combs that are tried as grids, and minimum height of a comb, standard deviations by chance.
_N_COMBS, _MIN_COMB = 8, 6.0
#: Combs whose pitch and whose position at the picture's ends differ by less lead to the same grid; columns.
_SAME_PITCH, _SAME_SHAPE = 0.7, 0.8


@dataclass(frozen=True, slots=True)
class Comb:
    """Borders of columns in one part of a picture: u = phase + pitch (X + turn Y + across X^2 + along X Y).

    X and Y are offsets from the part's middle over its width.
    """

    #: Height over its standard deviation by chance, if all pairs were independent.
    score: float
    pitch: float
    turn: float
    across: float
    along: float
    phase: float

    def is_like(self, comb: Comb) -> bool:
        """Whether two combs are so similar that a fit from either gives the same grid."""
        shape = abs(self.turn - comb.turn) + (abs(self.across - comb.across) + abs(self.along - comb.along)) / 4
        return abs(self.pitch - comb.pitch) < _SAME_PITCH and shape * self.pitch < _SAME_SHAPE


def find_combs(strips: PictureStrips) -> list[Comb]:
    """The strongest combs of a picture or of a part of it, strongest first; none if the strongest may be chance.

    Args:
        strips: without the light that all columns share.
    """
    chosen: list[Comb] = []
    for comb in sorted(_all_combs(strips), key=lambda comb: -comb.score):
        if not any(comb.is_like(earlier) for earlier in chosen):
            chosen.append(comb)
        if len(chosen) == _N_COMBS or chosen[0].score <= _MIN_COMB:
            break
    return [comb for comb in chosen if chosen[0].score > _MIN_COMB]


def grid_of_comb(comb: Comb, strips: PictureStrips) -> Grid:
    """The grid of the whole picture that is nearest to a comb of some strips."""
    raw_x, raw_y, x, y = (values.ravel() for values in (strips.raw_x, strips.raw_y, strips.x, strips.y))
    middle, course = float(raw_x.mean()), strips.course
    local_x, local_y = course.across(raw_x - middle, raw_y) * strips.n_parts, raw_y * strips.n_parts
    bent = local_x + comb.turn * local_y + comb.across * local_x**2 + comb.along * local_x * local_y
    pitch = comb.pitch * strips.n_parts
    turn = comb.turn + course.turn
    numbers = np.array([comb.phase - pitch * middle, pitch, pitch * turn, course.g, course.h, 0.0])
    grid = Grid(numbers, strips.width, strips.height, strips.lens)
    return grid_through(grid, x, y, comb.phase + comb.pitch * bent)


def _all_combs(strips: PictureStrips) -> list[Comb]:
    """The best comb of each pitch."""
    step = strips.step * strips.n_parts
    max_pitch = min(_MAX_PITCH, 1 / (_MIN_COLUMN_STRIPS * step))
    pitches = np.arange(MIN_PITCH, max_pitch, _STEP)
    y = strips.raw_y.mean(axis=1) * strips.n_parts
    found: list[Comb] = []
    for chosen, pairs, lit_pairs in strips.borders(pitches * strips.n_parts):
        tried, rest = pitches[chosen], pairs[:, 0]
        chance = np.sqrt(float(lit_pairs.sum()) / (2 * strips.n_rows)) + TINY
        # Pairs across a border are less coherent. Combs are scaled to their standard deviation by chance, so that
        # different distances can be compared.
        rest /= np.float32(-chance)
        x = np.broadcast_to((np.arange(rest.shape[1]) - (rest.shape[1] - 1) / 2) * step, rest.shape)
        x = strips.course.across(x, y[:, None])
        found += _best_combs(rest, x, y, tried, strips.n_parts)
    return found


def _range(largest: float, at_corner: float) -> FloatArray:
    """Values from `-largest` to `largest`, including 0, in steps that move a corner by the corner's step at most."""
    n = int(np.ceil(largest * at_corner / _STEP))
    return np.linspace(-largest, largest, 2 * n + 1)


def _best_combs(rest: Float32Array, x: FloatArray, y: FloatArray, pitches: FloatArray, n_parts: int) -> list[Comb]:
    """The best comb of each pitch, from values (W, n) of pairs of strips: sum along the strips, then over windows."""
    largest, half_x, half_y = float(pitches[-1]), 0.5, float(np.abs(y).max())
    is_upright = bool((x == x[0]).all())
    if is_upright and _MAX_TURN * largest * (y[1] - y[0]) < _STEP and len(y) % 2 == 0:
        rest, y, x = rest[::2] + rest[1::2], (y[::2] + y[1::2]) / 2, x[::2]
    turns = _range(_MAX_TURN, largest * half_y)
    across = _range(_MAX_ACROSS / n_parts, largest * half_x**2)
    along = _range(_MAX_ALONG / n_parts, largest * half_x * half_y)
    spacing, reach = _STEP / 2, float(along.max()) * half_y * largest
    start = int(np.floor((float(pitches[0]) - reach) / spacing))
    n_frequencies = int(np.ceil((largest + reach) / spacing)) - start + 1
    own = pitches[:, None, None] * (1 + along[:, None] * y)
    nearest = np.round(own / spacing).astype(np.int64) - start
    bent = rest * waves_of(float(pitches.mean()) * np.multiply.outer(across, x * x))
    frequencies = (start + np.arange(n_frequencies)) * spacing
    if is_upright:
        along_strips = np.matmul(bent, waves_of(np.outer(x[0], frequencies)))
    else:
        waves = waves_of(np.multiply.outer(x, frequencies))
        along_strips = np.matmul(bent.transpose(1, 0, 2), waves).transpose(1, 0, 2)
    over_windows = waves_of(pitches[:, None, None] * np.multiply.outer(y, turns))
    out = []
    for number, pitch in enumerate(pitches.tolist()):  # together they would take gigabytes in tall pictures
        sums = np.matmul(along_strips[:, np.arange(y.size), nearest[number]], over_windows[number])
        power = np.square(sums.real) + np.square(sums.imag)
        i, j, k = np.unravel_index(int(power.argmax()), power.shape)
        phase = -float(np.angle(sums[i, j, k])) / (2 * np.pi)
        shape = float(turns[k]), float(across[i]), float(along[j])
        out.append(Comb(float(np.sqrt(power[i, j, k])), pitch, *shape, phase))
    return out
