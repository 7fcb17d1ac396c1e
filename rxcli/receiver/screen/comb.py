"""The comb of column borders: strips that are some way apart are least alike where a border lies between them.

With the columns' light spread a Gaussian of `sigma` column pitches, two strips at the places `u` and `u + d` (in
columns) are as alike as the vectors `exp(-(u - k)^2 / 2 sigma^2)` over the columns k, see `Likeness`. Along the screen
this goes up and down once a column, most at a distance of about 0.7. `find_combs` looks for that period by a Fourier
sum over all pairs of about that distance: no edge of the screen, no picture and no decoding is needed for it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import TINY
from rxcli.receiver.screen.coherence import Coherence
from rxcli.types import Float32Array, FloatArray

#: Distance of the pairs that show the comb best, columns.
APART = 0.72
#: Largest distance of two places whose likeness is known, columns.
_FURTHEST = 1.6
#: Combs that differ less than this in pitch and as much elsewhere are one.
_SAME_PITCH, _SAME_SHAPE = 0.7, 0.8


@dataclass(frozen=True, slots=True)
class CombRange:
    """Combs that are tried."""

    #: Columns a picture's width, in steps of this.
    pitches: FloatArray
    step: float
    #: Turns of the borders, change of pitch across and along the picture: as shares of the pitch.
    turns: FloatArray
    across: FloatArray
    along: FloatArray


WHOLE_PICTURE = CombRange(
    np.arange(9.0, 46.0, 0.25),
    0.25,
    np.linspace(-0.12, 0.12, 17),
    np.linspace(-0.2, 0.2, 7),
    np.linspace(-0.3, 0.3, 9),
)
#: A fifth of a picture's width, which is some times as high: there pitches hardly change, and turns tell more. Turned
#: by a column from window to window borders look as if they were not.
FIFTH = CombRange(
    np.arange(14.0, 46.0, 0.25),
    0.25,
    np.linspace(-0.1, 0.1, 33),
    np.linspace(-0.03, 0.03, 3),
    np.linspace(-0.05, 0.05, 7),
)


@dataclass(frozen=True)
class Likeness:
    """How alike two places of the screen are at a distance, columns, over all places of their middle."""

    #: (distances,) mean and first harmonic over the phase, which is 0 at a border.
    mean: Float32Array
    harmonic: Float32Array

    def step(self, distance: FloatArray) -> NDArray[np.int64]:
        """Place in the tables over distances."""
        return (np.abs(distance) * ((self.mean.size - 1) / _FURTHEST) + 0.5).astype(np.int64)


@lru_cache(maxsize=4)
def likeness(sigma: float, phases: int = 128, distances: int = 161) -> Likeness:
    """Tables for a light spread of `sigma` column pitches."""
    middle, distance = np.arange(phases) / phases, np.linspace(0, _FURTHEST, distances)
    centres = np.arange(-6, 8) + 0.5

    def cosine(mid: NDArray[Any], apart: NDArray[Any]) -> FloatArray:
        one, other = (
            np.exp(-(((mid + sign * apart / 2)[..., None] - centres) ** 2) / (2 * sigma**2)) for sign in (-1, 1)
        )
        return np.asarray((one * other).sum(-1) / np.sqrt((one**2).sum(-1) * (other**2).sum(-1)))

    mid, apart = np.meshgrid(middle, distance, indexing="ij")
    table = cosine(mid, apart)
    harmonic = 2 * (table * np.cos(2 * np.pi * middle)[:, None]).mean(axis=0)
    return Likeness(
        mean=table.mean(axis=0).astype(np.float32),
        harmonic=harmonic.astype(np.float32),
    )


@dataclass(frozen=True, slots=True)
class Comb:
    """A comb of column borders, at first sight: u = phase + pitch * (X + turn Y + across X^2 + along X Y).

    X and Y are pixels from the picture's middle over its width.
    """

    #: Height over the standard deviation that it would have by chance, were all pairs independent.
    score: float
    #: Columns a picture's width.
    pitch: float
    turn: float
    across: float
    along: float
    phase: float

    def is_like(self, other: Comb) -> bool:
        """Whether two combs differ so little that one fit finds both."""
        shape = abs(self.turn - other.turn) + (abs(self.across - other.across) + abs(self.along - other.along)) / 4
        return abs(self.pitch - other.pitch) < _SAME_PITCH and shape * self.pitch < _SAME_SHAPE


def find_combs(coherence: Coherence, sigma: float, most: int = 4, tried: CombRange = WHOLE_PICTURE) -> list[Comb]:
    """The combs that show best in the coherence of a picture, best first.

    Args:
        coherence: of its strips.
        sigma: light spread of the screen, column pitches.
        most: so many at most.
        tried: combs that there may be.
    """
    found: list[Comb] = []
    strip = coherence.strip_px / coherence.width
    apart = np.clip(np.round(APART / (tried.pitches * strip)), 1, coherence.widest).astype(np.int64)
    for distance in np.unique(apart):
        found += _combs_at(coherence, sigma, int(distance), replace(tried, pitches=tried.pitches[apart == distance]))
    chosen: list[Comb] = []
    for comb in sorted(found, key=lambda one: -one.score):
        if not any(comb.is_like(other) for other in chosen):
            chosen.append(comb)
        if len(chosen) == most:
            break
    return chosen


def _combs_at(coherence: Coherence, sigma: float, distance: int, tried: CombRange) -> list[Comb]:
    """The best comb of each pitch, by pairs of one distance."""
    pitches = tried.pitches
    tables = likeness(sigma)
    strip = coherence.strip_px / coherence.width
    n = coherence.x.size - distance
    middle = (coherence.x[:n] - (coherence.width - 1) / 2) / coherence.width + distance * strip / 2
    y = (coherence.y - (coherence.height - 1) / 2) / coherence.width
    both = coherence.lit[:, :n] * coherence.lit[:, distance:]
    share, pairs = np.sqrt(both), coherence.pairs[:, :n, distance]
    step = tables.step(pitches * distance * strip)
    step = np.minimum(step, tables.mean.size - 1)
    # The comb is weighed by its own height, so that pitches of unlike distances can be compared.
    mean, harmonic = tables.mean[step].mean(), tables.harmonic[step]
    rest = share * pairs - mean * both
    chance = np.sqrt(float(both.sum()) / (2 * coherence.n_rows)) + TINY
    sums = _fourier(rest, middle, y, tried) / chance * np.sign(harmonic[0])
    height = np.abs(sums)
    out = []
    for number, pitch in enumerate(pitches.tolist()):
        best = np.unravel_index(int(height[number].argmax()), height[number].shape)
        across, along, turn = (float(v[i]) for v, i in zip((tried.across, tried.along, tried.turns), best, strict=True))
        phase = -float(np.angle(sums[number][best])) / (2 * np.pi)
        out.append(Comb(float(height[number][best]), pitch, turn, across, along, phase))
    return out


def _fourier(rest: Float32Array, x: FloatArray, y: FloatArray, tried: CombRange) -> NDArray[np.complex64]:
    """(pitches, across, along, turns) Fourier sums of (W, n) values: along the strips first, then over the windows."""
    pitches, step = tried.pitches, tried.step / 4
    reach = float(np.abs(tried.along).max() * np.abs(y).max() * pitches.max())
    first = pitches.min() - reach
    frequencies = first + step * np.arange(int(np.ceil((pitches.max() + reach - first) / step)) + 1)
    own = pitches[:, None, None] * (1 + tried.along[:, None] * y)
    nearest = np.round((own - first) / step).astype(np.int64)
    wave = np.exp((2j * np.pi) * np.outer(x, frequencies)).astype(np.complex64)
    turns = np.exp((2j * np.pi) * pitches[:, None, None] * np.multiply.outer(y, tried.turns)).astype(np.complex64)
    out = np.empty((pitches.size, tried.across.size, tried.along.size, tried.turns.size), np.complex64)
    for number, across in enumerate(tried.across.tolist()):
        bent = np.exp((2j * np.pi) * float(pitches.mean()) * across * x**2).astype(np.complex64)
        along_strips = (rest * bent) @ wave
        at_pitch = along_strips[np.arange(y.size), nearest]
        out[:, number] = np.matmul(at_pitch, turns)
    return out
