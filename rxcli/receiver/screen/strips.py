"""Changes of light along upright strips of a picture, and the coherence of neighbouring strips.

Two strips of one column receive the same slots, whatever the picture on the screen and its brightness. Strips several
pixels wide are band-passed along the rows and scaled to unit variance in windows of rows, called blocks here. The
common part of the least coherent strips is row noise of the sensor and is projected off. With narrow columns, each
fifth of the picture's width has finer strips and its own blocks; everything after this module is the same for both.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import TINY
from rxcli.receiver.screen import geometry
from rxcli.types import BoolArray, Float32Array, FloatArray, Lens, LightPlane

#: Strips across the picture, and across each part of a picture with narrow columns; windows of rows.
_N_STRIPS, _N_PART_STRIPS, _N_WINDOWS = 200, 150, 16
#: Rows that are averaged, as a share of the lag at which the correlation of neighbouring strips falls to half its value
#: at lag one; their minimum and maximum; number of pairs of strips used.
_SHORT_SHARE, _MIN_SHORT_ROWS, _MAX_SHORT_ROWS, _SAMPLED_STRIPS = 0.8, 2, 6, 25
#: Share of the strips, the least coherent, that row noise is estimated from; share with the clearest stripes.
_DARK_SHARE, _BRIGHT_SHARE = 0.3, 0.2
#: Columns are narrow if the coherence at the far distance, picture widths, is below this share of that at the near.
_NEAR_WIDTHS, _FAR_WIDTHS, _NARROW_RATIO = 0.004, 0.01, 0.72
#: Two screens lie apart if strips between them have less than this share of the light, over this many picture widths;
#: share of the light that each has, and mean coherence of all strips, at least.
_GAP_LIGHT, _MIN_GAP_WIDTHS, _MIN_APART, _MIN_APART_LIGHT = 0.25, 0.015, 0.2, 0.1
#: Power of stripes that belong to a box, of the clearest; windows and strips without stripes that it bridges.
_STRIPED, _BRIDGED = 0.1, (3, 21)
#: Distance of the pairs of strips that show borders best, columns.
_PAIR_DISTANCE = 0.72
#: Averaged rows whose mean the band pass takes off.
LONG_ROWS = 8
#: Share of a strip's power that may be due to rounding.
ROUNDING = np.float32(1e-6)
#: Arrays by block and strip.
_OF_STRIPS = ("changes", "coherence", "stripes", "level", "darkest", "raw_x", "raw_y", "x", "y")


@dataclass(frozen=True, slots=True)
class Course:
    """Course of columns through a picture: (X + turn Y) / (1 + g X + h Y) is the same all along a column.

    X and Y are offsets from the picture's middle in picture widths.
    """

    turn: float = 0.0
    g: float = 0.0
    h: float = 0.0

    def across(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """(...) place across the columns, picture widths at its middle."""
        return np.asarray((x + self.turn * y) / (1 + self.g * x + self.h * y))

    def along(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """(...) place along the columns, roughly, picture widths at its middle."""
        return np.asarray((y - self.turn * x) / (1 + self.g * x + self.h * y))

    def slope(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """(...) shift in x of a column per row."""
        above, below = x + self.turn * y, 1 + self.g * x + self.h * y
        return np.asarray((self.h * above - self.turn * below) / (below - self.g * above))


UPRIGHT = Course()


@dataclass(frozen=True, slots=True)
class PictureStrips:
    """B blocks of S strips of a picture, B = windows of rows x parts of the width, the windows of one part together."""

    #: (B, S, R) float32: band-passed light of mean square one along the rows, row noise removed.
    changes: Float32Array
    #: (B, S) float32: coherence of each strip's neighbours, 0..1, the share of its variance that is the columns'.
    coherence: Float32Array
    #: (B, S) float32: power of what a strip's neighbours have in common, row noise included; 0 where that is little.
    stripes: Float32Array
    #: (B, S) float32: mean light and that at the darkest instant, roughly linear, of white.
    level: Float32Array
    darkest: Float32Array
    #: (B, S): middles of the strips, offsets from the picture's middle in picture widths: in the stored picture, and
    #: with the distortion of a known lens removed.
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
    #: Size of the picture, pixels, and the lens whose distortion was removed.
    width: int
    height: int
    lens: Lens | None
    #: Course of the columns that the strips follow within a window.
    course: Course

    @property
    def n_windows(self) -> int:
        """Windows of rows."""
        return len(self.changes) // self.n_parts

    @property
    def picture_rows(self) -> float:
        """Independent rows of the picture."""
        return self.n_rows * self.height / (2 * self.half_height * self.width)

    @property
    def step(self) -> float:
        """Distance of two neighbouring strips, picture widths."""
        return float(self.raw_x[0, 1] - self.raw_x[0, 0])

    def coherence_at(self, distance: int, n_parts: int = 1) -> Float32Array:
        """(B, n_parts, n) coherence of strips with those `distance` strips to their right, in parts of the rows."""
        rows = self.changes.shape[2] // n_parts
        parts = self.changes[..., : rows * n_parts].reshape(*self.changes.shape[:2], n_parts, rows)
        pairs = np.einsum("bskr,bskr->bks", parts[:, :-distance], parts[:, distance:])
        return np.asarray(pairs / np.float32(max(rows, 1)), np.float32)

    def borders(self, pitches: FloatArray, n_parts: int = 1) -> Iterator[tuple[BoolArray, Float32Array, Float32Array]]:
        """Pairs of strips that show borders: how much more coherent than pairs of as much light, and their light.

        Args:
            pitches: (P,) columns per picture width.
            n_parts: parts of the rows of a block.

        Yields:
            Which of the pitches (P,), (B, n_parts, n) of pairs that show those best, and (B, n).
        """
        distances = np.maximum(np.round(_PAIR_DISTANCE / (pitches * self.step)), 1).astype(np.int64)
        for distance in np.unique(distances).tolist():
            lit = self.coherence[:, :-distance] * self.coherence[:, distance:]
            rest = np.sqrt(lit)[:, None] * self.coherence_at(distance, n_parts)
            # Where light spreads far, pairs have more in common; taken off too little, it looks like few wide columns.
            rest -= (np.vdot(rest.mean(axis=1), lit) / (np.vdot(lit, lit) + np.float32(TINY))) * lit[:, None]
            yield distances == distance, rest, lit

    def without_common_light(self) -> PictureStrips:
        """The same without the light that all columns share, as of headers and lamps: it shows no borders."""
        changes = _without(self.changes, np.einsum("bsr,bs->br", self.changes, self.coherence))
        left = _power(changes)
        changes /= np.sqrt(left + ROUNDING)[..., None]
        lit = _lit(changes) * left
        return replace(self, changes=changes, coherence=lit, n_rows=_independent_rows(changes, lit))

    def blocks(self, chosen: Any) -> PictureStrips:
        """Some of the blocks, or of their strips, by an index of the first axis or of the first two."""
        return replace(self, **{name: getattr(self, name)[chosen] for name in _OF_STRIPS})

    def part(self, number: int) -> PictureStrips:
        """The blocks of one part of the width."""
        return self.blocks(slice(number * self.n_windows, (number + 1) * self.n_windows))

    def striped_box(self) -> FloatArray | None:
        """Corners (4, 2), pixels, of the upright rectangle around the largest part with stripes; None without."""
        import cv2

        is_striped = (self.stripes > _STRIPED * float(np.quantile(self.stripes, 0.99))).astype(np.uint8)
        (down, across), bridge = _BRIDGED, np.ones(_BRIDGED, np.uint8)
        padded = np.pad(is_striped, ((down, down), (across, across)))
        is_striped = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, bridge)[down:-down, across:-across]
        parts = cv2.connectedComponentsWithStats(is_striped)[2][1:]
        if not len(parts):
            return None
        left, top, across, down, _ = max(parts.tolist(), key=lambda part: part[-1])
        x = self.raw_x[0, [left, left + across - 1]] + self.step / 2 * np.array([-1, 1])
        y = self.raw_y[[top, top + down - 1], 0] + self.half_height * np.array([-1, 1])
        box = np.array([[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]])
        return np.asarray(box * self.width + (np.array([self.width, self.height]) - 1) / 2)

    def sides_of_gap(self) -> list[PictureStrips]:
        """The strips on either side of the widest gap without coherent light, the gap in both; none without a gap."""
        start, end = self.gap(_MIN_APART)
        if (end - start) * self.step < _MIN_GAP_WIDTHS or self.coherence.mean() < _MIN_APART_LIGHT:
            return []
        return [self.blocks(np.s_[:, :end]), self.blocks(np.s_[:, start:])]

    def gap(self, least: float) -> tuple[int, int]:
        """First and last strip of the widest gap without coherent light, with a share of it of `least` on each side."""
        lit = self.coherence.mean(axis=0)
        is_dark = lit < _GAP_LIGHT * np.quantile(lit, 0.9)
        # What dark strips have in common is noise of rows.
        share = np.cumsum(lit * ~is_dark) / ((lit * ~is_dark).sum() + np.float32(TINY))
        is_dark[(share < least) | (share > 1 - least)] = False
        edges = np.flatnonzero(np.diff(np.concatenate([[False], is_dark, [False]]).astype(np.int8))).reshape(-1, 2)
        start, end = max(edges.tolist(), key=lambda gap: gap[1] - gap[0], default=(0, 0))
        return start, end


def read_strips(
    plane: LightPlane, lens: Lens | None = None, *, n_parts: int = 1, course: Course = UPRIGHT
) -> PictureStrips:
    """Strips of a picture, from its plane.

    Args:
        plane: of the picture; a tone curve need not be undone.
        lens: of the picture, if known.
        n_parts: parts of the width with strips of their own.
        course: of the columns that the strips follow within each window of rows.
    """
    light, x = _light_of_strips(plane, n_parts)
    # Windows show no difference between columns and those turned by one column a window, so narrow ones need more.
    short, n_windows = _short_rows(light), _N_WINDOWS if n_parts == 1 else 2 * _N_WINDOWS
    n_rows = light.shape[1] // (short * n_windows)
    middles = (np.arange(n_windows) + 0.5) * n_rows * short - 0.5
    if course == UPRIGHT:
        means, band = _band_passed(light, short, n_rows * n_windows)
    else:
        margin = LONG_ROWS * short
        windows = _windows_along(plane, x, middles, n_rows * short, margin, course)
        means, band = (part.reshape(len(light), -1) for part in _band_passed(windows, short, n_rows, margin))
    points = np.stack(np.meshgrid(x, middles), axis=-1)
    changes, lit, stripes, noise = _without_row_noise(band.reshape(len(band), n_windows, -1).swapaxes(0, 1))

    def parted(values: NDArray[Any]) -> NDArray[Any]:
        """(W, S, ...) as (parts x W, S / parts, ...)."""
        split = values.reshape(n_windows, n_parts, -1, *values.shape[2:])
        return np.ascontiguousarray(np.moveaxis(split, 1, 0)).reshape(n_parts * n_windows, -1, *values.shape[2:])

    stored, flat = (flat_places(points, plane.width, plane.height, model) for model in (None, lens))
    by_window = means.reshape(x.size, n_windows, n_rows)
    level = _roughly_linear(plane, by_window.mean(axis=2).T)
    darkest = _roughly_linear(plane, by_window.min(axis=2).T)
    of_strips: list[NDArray[Any]] = [changes, lit, stripes, level, darkest, *stored, *flat]
    return PictureStrips(
        **{name: parted(values) for name, values in zip(_OF_STRIPS, of_strips, strict=True)},
        half_height=n_rows * short / 2 / plane.width,
        row_noise=noise,
        short_rows=short,
        n_rows=_independent_rows(changes, lit),
        n_parts=n_parts,
        width=plane.width,
        height=plane.height,
        lens=lens,
        course=course,
    )


def _light_of_strips(plane: LightPlane, n_parts: int) -> tuple[Float32Array, FloatArray]:
    """(S, R) mean values of strips of equal width, equally many per part, and (S,) the middles of the strips."""
    wanted = _N_STRIPS if n_parts == 1 else n_parts * _N_PART_STRIPS
    n_cells = len(plane.sums) - 1
    cells = max(1, round(n_cells / wanted))
    n = n_cells // cells // n_parts * n_parts
    start = (n_cells - n * cells) // 2
    light = np.diff(plane.sums[start : start + n * cells + 1 : cells], axis=0)
    light /= np.float32(cells * plane.cell_px)
    return light, np.asarray((start + (np.arange(n) + 0.5) * cells) * plane.cell_px - 0.5)


def _windows_along(
    plane: LightPlane, x: FloatArray, middles: FloatArray, n_rows: int, margin: int, course: Course
) -> Float32Array:
    """(S * W, n_rows + 2 margin) mean values of strips that follow the columns in windows of rows.

    Args:
        plane: of the picture.
        x: (S,) middles of the strips, pixels.
        middles: (W,) middle rows of the windows, where the strips lie at x.
        n_rows: rows of a window.
        margin: rows before and after it that are read as well.
        course: of the columns.
    """
    height, n_cells, n = plane.sums.shape[1], len(plane.sums) - 1, round((x[1] - x[0]) / plane.cell_px)
    half = np.array([plane.width, height]) / 2 - 0.5
    slope = course.slope((x[:, None] - half[0]) / plane.width, (middles - half[1]) / plane.width)[..., None]
    row = np.rint(middles[:, None] + np.arange(-margin, n_rows + margin) - (n_rows - 1) / 2).clip(0, height - 1)
    left = (x[:, None, None] + slope * (row - middles[:, None]) + 0.5) / plane.cell_px - n / 2
    place = np.rint(left).clip(0, n_cells - n).astype(np.intp) * height + row.astype(np.intp)
    flat = plane.sums.ravel()
    light = (flat.take(place + n * height) - flat.take(place)) / np.float32(n * plane.cell_px)
    return np.asarray(light.reshape(-1, n_rows + 2 * margin), np.float32)


def _roughly_linear(plane: LightPlane, values: Float32Array) -> Float32Array:
    """Light of values of the plane, 0 black to 1 white; any usual tone curve is near a square root."""
    shown = np.clip((values - np.float32(plane.black)) / np.float32(plane.white - plane.black), 0, 1)
    return np.asarray(shown if plane.is_linear else shown * shown, np.float32)


def flat_places(points: FloatArray, width: int, height: int, lens: Lens | None) -> tuple[FloatArray, FloatArray]:
    """Convert pixels (..., 2) to offsets from the picture's middle in picture widths, with lens distortion removed."""
    points = geometry.undistort(points, geometry.bending(lens))
    return (points[..., 0] - (width - 1) / 2) / width, (points[..., 1] - (height - 1) / 2) / width


def shows_narrow_columns(strips: PictureStrips) -> bool:
    """Whether strips are coherent at a short distance only; with wide columns they stay coherent further on."""
    near, far = (_lit_coherence(strips, widths) for widths in (_NEAR_WIDTHS, _FAR_WIDTHS))
    return far < _NARROW_RATIO * near


def _lit_coherence(strips: PictureStrips, widths: float) -> float:
    """Mean coherence of lit strips `widths` picture widths apart, relative to that within one column."""
    distance = max(round(widths / strips.step), 1)
    share = np.sqrt(strips.coherence[:, :-distance] * strips.coherence[:, distance:])
    return float((strips.coherence_at(distance)[:, 0] * share).sum() / (np.square(share).sum() + TINY))


def _band_passed(light: Float32Array, short: int, n: int, margin: int = 0) -> tuple[Float32Array, Float32Array]:
    """(S, n) means over `short` rows of light (S, rows), and those less the means of `LONG_ROWS` times as many rows.

    The first mean begins `margin` rows below the top.
    """
    import cv2

    rows = light[:, margin : margin + n * short]
    means = np.asarray(cv2.resize(rows, (n, len(light)), interpolation=cv2.INTER_AREA), np.float32)
    around = cv2.blur(light, (LONG_ROWS * short, 1))[:, margin + short // 2 :: short]
    return means, np.asarray(means - around[:, :n], np.float32)


def _short_rows(light: Float32Array) -> int:
    """Rows that may be averaged without losing the slots, from the correlation of neighbouring strips over lags."""
    import cv2

    max_rows, every = _MAX_SHORT_ROWS, max(len(light) // _SAMPLED_STRIPS, 2)
    n = len(light) // every
    left, right = (light[start::every][:n] for start in (0, 1))
    left, right = (part - cv2.blur(part, (LONG_ROWS * max_rows + 1, 1)) for part in (left, right))
    n_lags = 2 * max_rows
    correlation = [float(np.einsum("sr,sr->", left[:, :-lag], right[:, lag:])) for lag in range(1, n_lags)]
    # White row noise does not contribute at lags from 1 on.
    below = [lag for lag, value in enumerate(correlation, 1) if value < correlation[0] / 2]
    half_lag = below[0] if below else n_lags
    return int(np.clip(round(_SHORT_SHARE * half_lag), _MIN_SHORT_ROWS, max_rows))


def _without_row_noise(band: Float32Array) -> tuple[Float32Array, ...]:
    """Scale strips (W, S, R) to a mean square of one, without the common part of the least coherent ones.

    Returns:
        changes, (W, S) coherence of neighbours, (W, S) power of stripes, (W, R) noise.
    """
    power = _power(band)
    changes = band / (np.sqrt(power) + np.float32(TINY))[..., None]
    together = _smooth(_neighbours(changes), 5, 1)
    dark = np.argsort(together, axis=1)[:, : max(int(_DARK_SHARE * changes.shape[1]), 1)]
    noise = np.take_along_axis(changes, dark[..., None], axis=1).mean(axis=1)
    quiet = _without(changes, noise)
    return quiet, _lit(quiet), np.where(together > 0.5, power * together, np.float32(0)), noise


def _without(changes: Float32Array, part: Float32Array) -> Float32Array:
    """Project (B, R) off the strips (B, S, R) of each block: the columns change, but not their mixes in the strips."""
    power = np.einsum("br,br->b", part, part) + np.float32(TINY)
    share = np.matmul(changes, part[..., None]) / power[:, None, None]
    return np.asarray(changes - share * part[:, None], np.float32)


def _power(changes: Float32Array) -> Float32Array:
    """(B, S) mean square of strips along the rows."""
    return np.asarray(np.einsum("bsr,bsr->bs", changes, changes) / np.float32(changes.shape[2]), np.float32)


def _lit(changes: Float32Array) -> Float32Array:
    """(B, S) coherence of each strip's neighbours, 0..1."""
    return np.asarray(np.clip(_smooth(_neighbours(changes), 3, 3), 0, 1), np.float32)


def _neighbours(changes: Float32Array) -> Float32Array:
    """(W, S) coherence of the strips on either side of each strip."""
    beside = np.einsum("wsr,wsr->ws", changes[:, 2:], changes[:, :-2]) / np.float32(changes.shape[2])
    return np.pad(beside, ((0, 0), (1, 1)), mode="edge")


def _smooth(values: Float32Array, strips: int, windows: int) -> Float32Array:
    import cv2

    return np.asarray(cv2.blur(values, (strips, windows), borderType=cv2.BORDER_REFLECT_101), np.float32)


def _independent_rows(quiet: Float32Array, lit: Float32Array) -> float:
    """Effective number of independent rows of a window, from the autocorrelation of the most coherent strips."""
    bright = np.argsort(-lit.mean(axis=0))[: max(int(_BRIGHT_SHARE * lit.shape[1]), 1)]
    some = quiet[::4, bright]
    rows = some.shape[2]
    lags = range((rows + 1) // 2)
    products = np.array([float(np.einsum("wsr,wsr->", some[..., lag:], some[..., : rows - lag])) for lag in lags])
    correlation = products * rows / (rows - np.arange(len(lags))) / (products[0] + TINY)
    return float(rows / (1 + 2 * float(np.square(correlation[1:]).sum())))
