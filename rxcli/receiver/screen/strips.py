"""Changes of light along upright strips of a picture, and how coherent neighbouring strips are.

Two strips of one column see the same slots, whatever picture lies before them and however dark it is. Strips some
pixels wide are band-passed along the rows and scaled to unit variance in windows of rows, called blocks here. What the
least coherent strips have in common is row noise of the sensor and is projected off. Where columns are narrow, each
fifth of the picture's width has finer strips and blocks of its own; everything after this module is the same for both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import TINY
from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.settings import SETTINGS
from rxcli.types import Float32Array, FloatArray, Lens, LightPlane

_Real = TypeVar("_Real", np.float32, np.float64)


@dataclass(frozen=True, slots=True)
class Strips:
    """B blocks of S strips of a picture, B = windows of rows x parts of the width, the windows of one part together."""

    #: (B, S, R) float32: band-passed light of mean square one along the rows, row noise taken off.
    changes: Float32Array
    #: (B, S) float32: coherence of each strip's neighbours, 0..1, the share of its variance that is the columns'.
    lit: Float32Array
    #: (B, S) float32: mean light, values of a pixel as they are coded.
    level: Float32Array
    #: (B, S): middles of the strips, offsets from the picture's middle over its width: in the stored picture, and with
    #: a known lens taken off.
    raw_x: FloatArray
    raw_y: FloatArray
    x: FloatArray
    y: FloatArray
    #: Half the height of a block, picture widths.
    half_height: float
    #: (W, R) row noise that was projected off the strips of each window of rows.
    row_noise: Float32Array
    #: Rows that the band pass averages: picture rows from one row of `changes` to the next.
    short_rows: int
    #: Independent rows of a block: an incoherent pair of strips has a variance of one over these.
    n_rows: float
    #: Parts of the picture's width: 1, or more where columns are narrow.
    n_parts: int
    #: Size of the picture, pixels, and the lens that was taken off.
    width: int
    height: int
    lens: Lens | None

    @property
    def n_windows(self) -> int:
        """Windows of rows."""
        return len(self.changes) // self.n_parts

    @property
    def step(self) -> float:
        """Distance of two neighbouring strips, picture widths."""
        return float(self.raw_x[0, 1] - self.raw_x[0, 0])

    def coherence(self, distance: int) -> Float32Array:
        """(B, S - distance) coherence of strips with those `distance` strips to their right."""
        pairs = np.einsum("bsr,bsr->bs", self.changes[:, :-distance], self.changes[:, distance:])
        return np.asarray(pairs / np.float32(self.changes.shape[2]), np.float32)

    def blocks(self, chosen: slice | NDArray[np.int64]) -> Strips:
        """Some of the blocks."""
        arrays = {name: getattr(self, name)[chosen] for name in ("changes", "lit", "level", "raw_x", "raw_y", "x", "y")}
        return replace(self, **arrays)


def read_strips(plane: LightPlane, lens: Lens | None = None, *, n_parts: int = 1) -> Strips:
    """Strips of a picture, from its plane.

    Args:
        plane: of the picture; a tone curve does no harm.
        lens: of the picture, where it is known.
        n_parts: parts of the width with strips of their own.
    """
    width, height, n_windows = plane.width, plane.height, SETTINGS.n_windows
    light, x = _light_of_strips(plane, n_parts)
    short = _short_rows(light)
    band = _band_passed(light, short)
    rows = band.shape[1] // n_windows
    middles = (np.arange(n_windows) * rows + (rows - 1) / 2) * short
    points = np.stack(np.meshgrid(x, middles), axis=-1)
    quiet, lit, noise = _without_row_noise(_windows(band))
    level = light[:, : rows * short * n_windows].reshape(x.size, n_windows, rows * short).mean(axis=2).T

    def parted(values: NDArray[_Real]) -> NDArray[_Real]:
        """(W, S, ...) as (parts x W, S / parts, ...)."""
        split = values.reshape(n_windows, n_parts, -1, *values.shape[2:])
        return np.concatenate(np.moveaxis(split, 1, 0))

    raw_x, raw_y = (parted(values) for values in flat_places(points, width, height, None))
    x_flat, y_flat = (parted(values) for values in flat_places(points, width, height, lens))
    return Strips(
        parted(quiet),
        parted(lit),
        parted(np.asarray(level, np.float32)),
        raw_x,
        raw_y,
        x_flat,
        y_flat,
        half_height=rows * short / 2 / width,
        row_noise=noise,
        short_rows=short,
        n_rows=_independent_rows(quiet, lit),
        n_parts=n_parts,
        width=width,
        height=height,
        lens=lens,
    )


def _light_of_strips(plane: LightPlane, n_parts: int) -> tuple[Float32Array, FloatArray]:
    """(S, R) mean values of strips of equal width, as many in every part, and (S,) the middles of the strips."""
    wanted = SETTINGS.n_strips if n_parts == 1 else n_parts * SETTINGS.n_fifth_strips
    n_cells = len(plane.sums) - 1
    cells = max(1, round(n_cells / wanted))
    n = n_cells // cells // n_parts * n_parts
    first = (n_cells - n * cells) // 2
    light = np.diff(plane.sums[first : first + n * cells + 1 : cells], axis=0)
    light /= np.float32(cells * plane.cell_px)
    return light, np.asarray((first + (np.arange(n) + 0.5) * cells) * plane.cell_px - 0.5)


def flat_places(points: FloatArray, width: int, height: int, lens: Lens | None) -> tuple[FloatArray, FloatArray]:
    """Pixels (..., 2) as offsets from the picture's middle over its width, a lens that bends the picture taken off."""
    if lens is not None and not lens.corrected:
        points = geometry.undistort(points, lens)
    return (points[..., 0] - (width - 1) / 2) / width, (points[..., 1] - (height - 1) / 2) / width


def shows_narrow_columns(strips: Strips) -> bool:
    """Whether light is coherent nearby and no more a little further on, as that of wide columns is."""
    near, far = (_lit_coherence(strips, widths) for widths in (SETTINGS.near_widths, SETTINGS.far_widths))
    return far < SETTINGS.narrow_ratio * near


def _lit_coherence(strips: Strips, widths: float) -> float:
    """Mean coherence of lit strips some picture widths apart, over what it would be in one column."""
    distance = max(round(widths / strips.step), 1)
    share = np.sqrt(strips.lit[:, :-distance] * strips.lit[:, distance:])
    return float((strips.coherence(distance) * share).sum() / (np.square(share).sum() + TINY))


def _band_passed(light: Float32Array, short: int) -> Float32Array:
    """(S, R / short) light averaged over a few rows less its mean over many."""
    import cv2

    whole = light.shape[1] // short * short
    return np.asarray((cv2.blur(light, (short, 1)) - cv2.blur(light, (8 * short, 1)))[:, :whole:short], np.float32)


def _short_rows(light: Float32Array) -> int:
    """Rows that may be averaged without losing the slots, by how far along the rows neighbouring strips are alike."""
    import cv2

    most, every = SETTINGS.max_short_rows, SETTINGS.sampled_strips
    one, other = (light[first::every][: len(light) // every] for first in (0, 1))
    one, other = (part - cv2.blur(part, (8 * most + 1, 1)) for part in (one, other))
    n_lags = 2 * most
    alike = [float(np.einsum("sr,sr->", one[:, :-lag], other[:, lag:])) for lag in range(1, n_lags)]
    # White row noise has no part in lags from 1 on.
    below = [lag for lag, value in enumerate(alike, 1) if value < alike[0] / 2]
    half_lag = below[0] if below else n_lags
    return int(np.clip(round(SETTINGS.short_share * half_lag), SETTINGS.min_short_rows, most))


def _windows(band: Float32Array) -> Float32Array:
    """(W, S, R) windows of rows, each strip scaled to a mean square of one."""
    rows = band.shape[1] // SETTINGS.n_windows
    changes = band[:, : SETTINGS.n_windows * rows].reshape(len(band), SETTINGS.n_windows, rows).swapaxes(0, 1)
    power = np.einsum("wsr,wsr->ws", changes, changes)
    return np.asarray(changes / (np.sqrt(power / np.float32(rows)) + np.float32(TINY))[..., None], np.float32)


def _without_row_noise(changes: Float32Array) -> tuple[Float32Array, Float32Array, Float32Array]:
    """The changes less what the least coherent strips have in common; (W, S) coherence of neighbours; (W, R) noise."""
    n_dark = max(int(SETTINGS.dark_share * changes.shape[1]), 1)
    dark = np.argsort(_smooth(_neighbours(changes), 5, 1), axis=1)[:, :n_dark]
    noise = np.take_along_axis(changes, dark[..., None], axis=1).mean(axis=1)
    power = np.einsum("wr,wr->w", noise, noise) + np.float32(TINY)
    share = np.einsum("wsr,wr->ws", changes, noise) / power[:, None]
    quiet = changes - share[..., None] * noise[:, None]
    return quiet, np.clip(_smooth(_neighbours(quiet), 3, 3), 0, 1), noise


def _neighbours(changes: Float32Array) -> Float32Array:
    """(W, S) coherence of the strips on either side of each strip."""
    beside = np.einsum("wsr,wsr->ws", changes[:, 2:], changes[:, :-2]) / np.float32(changes.shape[2])
    return np.pad(beside, ((0, 0), (1, 1)), mode="edge")


def _smooth(values: Float32Array, strips: int, windows: int) -> Float32Array:
    import cv2

    return np.asarray(cv2.blur(values, (strips, windows), borderType=cv2.BORDER_REFLECT_101), np.float32)


def _independent_rows(quiet: Float32Array, lit: Float32Array) -> float:
    """Rows of a window that count as independent, by the autocorrelation of the strips that show the stripes best."""
    bright = np.argsort(-lit.mean(axis=0))[: max(int(SETTINGS.bright_share * lit.shape[1]), 1)]
    some = quiet[::4, bright]
    rows = some.shape[2]
    lags = range(min(SETTINGS.max_lag, (rows + 1) // 2))
    products = np.array([float(np.einsum("wsr,wsr->", some[..., lag:], some[..., : rows - lag])) for lag in lags])
    alike = products * rows / (rows - np.arange(len(lags))) / (products[0] + TINY)
    return float(rows / (1 + 2 * float(np.square(alike[1:]).sum())))
