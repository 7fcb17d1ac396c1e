"""The course of tilted columns: how their borders lean, and run together, in a picture.

Columns that lean smear strips that stand upright, and the finder's combs reach some degrees only. Where borders lie,
strips are less coherent over a few rows already. A spectrum of that in each part of the picture shows how far apart
borders are there, and how they lean. One course through all parts is where their spectra add up to most.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rxcli.numerics import TINY
from rxcli.receiver.screen.strips import Course, PictureStrips
from rxcli.types import BoolArray, Float32Array, FloatArray

#: Parts of a window of rows, in which columns hardly lean; parts of the picture across and down, and standard deviation
#: of a part's Gaussian weight, in widths of a part.
_SUBWINDOWS, _TILES, _TILE_SD = 4, 4, 0.5
#: Borders per picture width across and down.
_ACROSS, _DOWN = np.arange(5.0, 63.0, 2.0), np.arange(-60.0, 61.0, 2.0)
#: Columns that are tried, and steps and largest values of turn and perspective: 50 degrees of roll, and 45 of yaw.
_PITCHES = np.geomspace(9.0, 40.0, 20)
_TURNS, _PERSPECTIVES, _MAX_PERSPECTIVE = np.linspace(-1.2, 1.2, 17), np.linspace(-1.4, 1.4, 11), 1.41
#: Turn and perspective up to which upright strips show a course; log-likelihood that noise does not reach, and lead
#: over upright courses.
_UPRIGHT_TURN, _UPRIGHT_PERSPECTIVE, _MIN_SCORE, _LEAD = 0.16, 0.3, 27.0, 0.5


def tilted_course(strips: PictureStrips) -> Course | None:
    """The likeliest course of the columns in a picture; None if upright strips show it, or noise may.

    Args:
        strips: upright, without the light that all columns share.
    """
    spectra, middles = _spectra(strips)
    pitch, turn, g, h = _tried()
    score = np.zeros((pitch.size, turn.size, g.size), np.float32)
    # Nothing is known beyond the spectra: one place on each side has what is usual.
    padded = np.pad(spectra, ((0, 0), (1, 1), (1, 1)), constant_values=float(spectra.mean()))
    for spectrum, (x, y) in zip(padded, middles, strict=True):
        below = np.maximum(1 + g * x + h * y, 0.2) ** 2
        across = pitch * (1 + (h - g * turn) * y) / below
        down = pitch * (turn + (turn * g - h) * x) / below
        score += spectrum[_nearest(across, _ACROSS), _nearest(down, _DOWN)]
    best = np.unravel_index(int(score.argmax()), score.shape)
    if score[best] < max(_MIN_SCORE, float(score[:, _is_upright(turn, g, h)].max()) + _LEAD):
        return None
    return Course(*(float(np.broadcast_to(values, score.shape)[best]) for values in (turn, g, h)))


def is_upright(course: Course) -> bool:
    """Whether upright strips show columns of this course."""
    return bool(_is_upright(course.turn, course.g, course.h))


def _is_upright(turn: ArrayLike, g: ArrayLike, h: ArrayLike) -> BoolArray:
    return np.asarray((np.abs(turn) < _UPRIGHT_TURN) & (np.hypot(g, h) < _UPRIGHT_PERSPECTIVE))


def _nearest(values: FloatArray, places: FloatArray) -> NDArray[np.intp]:
    """Index of the nearest of evenly spaced places, counted from 1; beyond them 0, or one more than there are."""
    index = np.rint((values - places[0]) / (places[1] - places[0]) + 1)
    return np.asarray(index.clip(0, places.size + 1), np.intp)


@lru_cache(maxsize=1)
def _tried() -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Pitches (n, 1, 1), turns (m, 1), and perspectives (k,) and (k,)."""
    g, h = (values.ravel() for values in np.meshgrid(_PERSPECTIVES, _PERSPECTIVES))
    possible = np.hypot(g, h) < _MAX_PERSPECTIVE
    return _PITCHES[:, None, None], _TURNS[:, None], g[possible], h[possible]


def _spectra(strips: PictureStrips) -> tuple[Float32Array, FloatArray]:
    """Spectra (T, across, down) of the borders in parts of a picture, over noise, and the parts' middles (T, 2)."""
    start = ((np.arange(_SUBWINDOWS) + 0.5) / _SUBWINDOWS * 2 - 1) * strips.half_height
    y = (strips.raw_y[:, :1] + start).ravel()
    middles_y, down = _waves(y, y[-1] - y[0] + y[1] - y[0], _DOWN)
    spectra = np.empty((_TILES, _TILES, _ACROSS.size, _DOWN.size), np.float32)
    for chosen, rest, _ in strips.borders(_ACROSS, _SUBWINDOWS):
        x = (np.arange(rest.shape[2]) - (rest.shape[2] - 1) / 2) * strips.step
        middles_x, across = _waves(x, 1.0, _ACROSS[chosen])
        in_rows = np.tensordot(rest.reshape(y.size, -1), across, (1, 1))
        spectra[:, :, chosen] = np.abs(np.einsum("yta,syd->stad", in_rows, down, optimize=True))
    spectra /= np.median(spectra, axis=(0, 1, 3), keepdims=True) + np.float32(TINY)
    # A border stands out by that much against noise of unknown power.
    spectra = np.log1p(np.square(spectra, out=spectra))
    middles = np.stack(np.meshgrid(middles_x, middles_y), axis=-1).reshape(-1, 2)
    return spectra.reshape(-1, _ACROSS.size, _DOWN.size), middles


def _waves(places: FloatArray, extent: float, frequencies: FloatArray) -> tuple[FloatArray, NDArray[np.complex64]]:
    """Middles (T,) of the parts of an extent, and waves (T, n, F) about them at places (n,), weighted by part."""
    middles = ((np.arange(_TILES) + 0.5) / _TILES - 0.5) * extent
    off = places - middles[:, None]
    weight = np.exp(-0.5 * np.square(off / (_TILE_SD * extent / _TILES)))
    waves = weight[..., None] * np.exp(2j * np.pi * off[..., None] * frequencies)
    return middles, waves.astype(np.complex64)
