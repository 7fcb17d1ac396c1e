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

Pixels = NDArray[np.uint8] | NDArray[np.uint16]
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
    #: Rows that the band pass averages, and picture rows from one row of `changes` to the next.
    short_rows: int
    row_step: int
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
    def smear(self) -> float:
        """Height by which the band pass smears light beyond the ends of the screen, both together, picture widths."""
        return 8 * self.short_rows / self.width

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
    width, height = plane.width, plane.height
    light, x = _light_of_strips(plane, n_parts)
    n = x.size
    short = _short_rows(light)
    band, step = _band_passed(light, short)
    rows = len(band) // SETTINGS.n_windows
    flat_rows = (np.arange(SETTINGS.n_windows) * rows + (rows - 1) / 2) * step
    points = np.stack(np.meshgrid(x, flat_rows), axis=-1)
    quiet, lit, noise = _without_row_noise(_windows(band))
    rows_off = _row_offsets(quiet, lit, points, (width, height), step, lens)
    if np.abs(rows_off).max() > SETTINGS.min_bend_rows * step:
        points[..., 1] += rows_off
        quiet, lit, noise = _without_row_noise(_windows(_straightened(band, rows_off / step)))
    level = light[: rows * step * SETTINGS.n_windows].reshape(SETTINGS.n_windows, rows * step, -1).mean(axis=1)

    def parted(values: NDArray[_Real]) -> NDArray[_Real]:
        """(W, ..., S) as (parts x W, ..., S / parts)."""
        split = values.reshape(*values.shape[:-1], n_parts, n // n_parts)
        return np.moveaxis(split, -2, 0).reshape(-1, *values.shape[1:-1], n // n_parts)

    raw_x, raw_y = (parted(values) for values in flat_places(points, width, height, None))
    x_flat, y_flat = (parted(values) for values in flat_places(points, width, height, lens))
    return Strips(
        np.ascontiguousarray(parted(quiet).transpose(0, 2, 1)),
        parted(lit),
        parted(np.asarray(level, np.float32)),
        raw_x,
        raw_y,
        x_flat,
        y_flat,
        half_height=rows * step / 2 / width,
        row_noise=noise,
        short_rows=short,
        row_step=step,
        n_rows=_independent_rows(quiet, lit),
        n_parts=n_parts,
        width=width,
        height=height,
        lens=lens,
    )


def _light_of_strips(plane: LightPlane, n_parts: int) -> tuple[Float32Array, FloatArray]:
    """(R, S) mean values of strips of equal width, as many in every part, and (S,) the middles of the strips."""
    wanted = SETTINGS.n_strips if n_parts == 1 else n_parts * SETTINGS.n_fifth_strips
    n_cells = len(plane.sums) - 1
    cells = max(1, round(n_cells / wanted))
    n = n_cells // cells // n_parts * n_parts
    first = (n_cells - n * cells) // 2
    strip_px = cells * plane.cell_px
    sums = np.diff(plane.sums[first : first + n * cells + 1 : cells], axis=0)
    x = first * plane.cell_px + (np.arange(n) + 0.5) * strip_px - 0.5
    return np.ascontiguousarray(sums.T, np.float32) / np.float32(strip_px), np.asarray(x)


def flat_places(points: FloatArray, width: int, height: int, lens: Lens | None) -> tuple[FloatArray, FloatArray]:
    """Pixels (..., 2) as offsets from the picture's middle over its width, a lens that bends the picture taken off."""
    if lens is not None and not lens.corrected:
        points = geometry.undistort(points, lens)
    return (points[..., 0] - (width - 1) / 2) / width, (points[..., 1] - (height - 1) / 2) / width


def shows_narrow_columns(strips: Strips) -> bool:
    """Whether light is coherent nearby and no more a little further on, as that of wide columns is."""
    if float(strips.lit.mean()) < SETTINGS.min_lit:
        return False
    near, far = (_lit_coherence(strips, widths) for widths in (SETTINGS.near_widths, SETTINGS.far_widths))
    return far < SETTINGS.narrow_ratio * near


def _lit_coherence(strips: Strips, widths: float) -> float:
    """Mean coherence of lit strips some picture widths apart, over what it would be in one column."""
    distance = max(round(widths / strips.step), 1)
    share = np.sqrt(strips.lit[:, :-distance] * strips.lit[:, distance:])
    return float((strips.coherence(distance) * share).sum() / (np.square(share).sum() + TINY))


def _band_passed(light: Float32Array, short: int) -> tuple[Float32Array, int]:
    """Light averaged over a few rows less its mean over many; every how manieth row is kept."""
    import cv2

    step = (short + 1) // 2 if len(light) >= SETTINGS.many_rows else 1
    whole = len(light) // step * step
    band = cv2.blur(light, (1, short)) - cv2.blur(light, (1, 8 * short))
    return np.asarray(band[:whole:step], np.float32), step


def _short_rows(light: Float32Array) -> int:
    """Rows that may be averaged without losing the slots, by how far along the rows neighbouring strips are alike."""
    import cv2

    most, every = SETTINGS.max_short_rows, SETTINGS.sampled_strips
    some = np.stack([light[:, ::every][:, : light.shape[1] // every], light[:, 1::every][:, : light.shape[1] // every]])
    one, other = (part / (part.mean() + np.float32(TINY)) for part in some)
    one, other = (part - cv2.blur(part, (1, 8 * most + 1)) for part in (one, other))
    n_lags = 2 * most
    alike = [float(np.vdot(one[: len(one) - lag], other[lag:])) for lag in range(1, n_lags)]
    # White row noise has no part in lags from 1 on.
    below = [lag for lag, value in enumerate(alike, 1) if value < alike[0] / 2]
    half_lag = below[0] if below else n_lags
    return int(np.clip(round(SETTINGS.short_share * half_lag), SETTINGS.min_short_rows, most))


def _windows(band: Float32Array) -> Float32Array:
    """(W, R, S) windows of rows, each strip clipped and scaled to a mean square of one."""
    rows = len(band) // SETTINGS.n_windows
    changes = band[: SETTINGS.n_windows * rows].reshape(SETTINGS.n_windows, rows, -1)
    rms = np.sqrt(np.einsum("wrs,wrs->ws", changes, changes) / rows)[:, None] + np.float32(TINY)
    changes = np.clip(changes / rms, -SETTINGS.clip_sd, SETTINGS.clip_sd)
    changes /= np.sqrt(np.einsum("wrs,wrs->ws", changes, changes) / rows)[:, None] + np.float32(TINY)
    return np.asarray(changes, np.float32)


def _row_offsets(
    changes: Float32Array,
    lit: Float32Array,
    points: FloatArray,
    size: tuple[int, int],
    step: int,
    lens: Lens | None,
) -> FloatArray:
    """(W, S) rows by which stripes lie below where the middle column of the picture has them.

    A picture that was corrected in the camera has bent stripes: the sensor row of a place is y (1 + bend r^2), offsets
    from the middle over the width. The lag at which strips some way apart are alike tells the bend.
    """
    if lens is not None and not lens.corrected:
        return np.zeros(points.shape[:2])
    x, y = flat_places(points, *size, None)
    if lens is not None:
        return points[..., 1] - geometry.distort(points, lens)[..., 1]
    distance, bends = SETTINGS.bend_strips, np.linspace(-SETTINGS.max_bend, SETTINGS.max_bend, SETTINGS.n_bends)
    some = slice(None, -distance, 2), slice(distance, None, 2)
    mid_x = (x[:, some[0]] + x[:, some[1]]) / 2
    # Strips on the right see the same instant so many kept rows further up for each unit of bend.
    slope = -2 * mid_x * y[:, some[0]] * (x[:, some[1]] - x[:, some[0]]) * size[0] / step
    n_lags = int(np.ceil(np.abs(slope).max() * SETTINGS.max_bend)) + 1
    here, there = changes[:, n_lags:-n_lags, some[0]], np.ascontiguousarray(changes[:, :, some[1]])
    n = here.shape[1]
    alike = np.stack([np.einsum("wrs,wrs->ws", here, there[:, lag : lag + n]) for lag in range(2 * n_lags + 1)])
    lags = slope[..., None] * bends + n_lags
    low = np.floor(lags).astype(np.int64)
    first, second = (np.take_along_axis(alike.transpose(1, 2, 0), low + more, axis=2) for more in (0, 1))
    score = ((first + (second - first) * (lags - low)) * lit[:, some[0], None]).sum(axis=(0, 1))
    bend = float(bends[int(score.argmax())])
    return np.asarray(-bend * y * (x * x + y * y) * size[0])


def _straightened(band: Float32Array, rows_off: FloatArray) -> Float32Array:
    """Band-passed light (rows, S) with each strip read `rows_off` (W, S) kept rows further down."""
    rows = len(band) // SETTINGS.n_windows
    centres = np.arange(SETTINGS.n_windows) * rows + (rows - 1) / 2
    place = np.arange(len(band), dtype=np.float64)
    between = np.clip((place - centres[0]) / rows, 0, SETTINGS.n_windows - 1 - 1e-9)
    low = between.astype(np.int64)
    off = rows_off[low] + (rows_off[low + 1] - rows_off[low]) * (between - low)[:, None]
    at = np.clip(place[:, None] + off, 0, len(band) - 1.001)
    low = at.astype(np.int64)
    first, second = (np.take_along_axis(band, low + more, axis=0) for more in (0, 1))
    return np.asarray(first + (second - first) * (at - low), np.float32)


def _without_row_noise(changes: Float32Array) -> tuple[Float32Array, Float32Array, Float32Array]:
    """The changes less what the least coherent strips have in common; (W, S) coherence of neighbours; (W, R) noise."""
    n_dark = max(int(SETTINGS.dark_share * changes.shape[2]), 1)
    dark = np.argsort(_smooth(_neighbours(changes), 5, 1), axis=1)[:, :n_dark]
    noise = np.take_along_axis(changes, dark[:, None], axis=2).mean(axis=2)
    power = np.einsum("wr,wr->w", noise, noise) + np.float32(TINY)
    share = np.einsum("wrs,wr->ws", changes, noise) / power[:, None]
    quiet = changes - noise[..., None] * share[:, None]
    return quiet, np.clip(_smooth(_neighbours(quiet), 3, 3), 0, 1), noise


def _neighbours(changes: Float32Array) -> Float32Array:
    """(W, S) coherence of the strips on either side of each strip."""
    beside = np.einsum("wrs,wrs->ws", changes[:, :, 2:], changes[:, :, :-2]) / np.float32(changes.shape[1])
    return np.pad(beside, ((0, 0), (1, 1)), mode="edge")


def _smooth(values: Float32Array, strips: int, windows: int) -> Float32Array:
    import cv2

    return np.asarray(cv2.blur(values, (strips, windows), borderType=cv2.BORDER_REFLECT_101), np.float32)


def _independent_rows(quiet: Float32Array, lit: Float32Array) -> float:
    """Rows of a window that count as independent, by the autocorrelation of the strips that show the stripes best."""
    bright = np.argsort(-lit.mean(axis=0))[: max(int(SETTINGS.bright_share * lit.shape[1]), 1)]
    some = np.ascontiguousarray(quiet[::4, :, bright])
    rows = some.shape[1]
    products = [float(np.vdot(some[:, lag:], some[:, : rows - lag])) for lag in range(min(SETTINGS.max_lag, rows // 2))]
    alike = np.array(products) * rows / (rows - np.arange(len(products))) / (products[0] + TINY)
    return float(rows / (1 + 2 * float(np.square(alike[1:]).sum())))
