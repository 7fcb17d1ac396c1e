"""How alike the light of neighbouring strips of pixels changes from row to row: what a modulated backlight leaves.

Two strips of one column see the same slots, whatever picture lies before them and however dark it is. Strips some
pixels wide, their changes over a few rows scaled to unit variance in windows of rows, are compared at every distance up
to some columns. What all rows have in common, the sensor's row noise, is taken off: it is what strips without light
show of one another.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import TINY
from rxcli.types import Float32Array, FloatArray

Pixels = NDArray[np.uint8] | NDArray[np.uint16]

#: Strips that a picture is cut into, about, and windows of rows.
N_STRIPS, _WINDOWS = 250, 16
#: Rows over which light is averaged, and below so many rows of a picture, whose slots have fewer rows; its mean over
#: eight times as many is taken off. Slots have 3 to 20 rows.
_SHORT_ROWS, _LOW_SHORT_ROWS, _LOW_ROWS = 6, 3, 1500
#: Changes beyond so many standard deviations are edges of the picture.
_CLIP = 2.5
#: Share of the strips, the least coherent, that are taken to be without light.
_DARK_SHARE = 0.3
#: Rows apart at which light may still be alike, as so many slots have, in averaged rows; and share of the strips by
#: which that is measured.
_LAGS, _BRIGHT_SHARE = 40, 0.2
#: Strips that are compared at a time with those near them.
_PAIRS_AT_ONCE = 64


@dataclass(frozen=True, slots=True)
class Coherence:
    """Coherence of the strips of a picture, W windows of rows by S strips."""

    #: (W, S, D + 1) float32: of strip i and strip i + d, row noise taken off; 0 where i + d is no strip.
    pairs: Float32Array
    #: (W, S) float32: share of a strip's variance that it has in common with its neighbours.
    lit: Float32Array
    #: (W, rows, S) float32: the strips' changes themselves, row noise taken off, and (W, rows) their rows, pixels.
    changes: Float32Array
    rows: FloatArray
    #: (W, S) float32: mean light of the strips, values of a pixel as they are coded.
    level: Float32Array
    #: (S,) and (W,): middle of the strips and of the windows, pixels.
    x: FloatArray
    y: FloatArray
    #: Independent rows of one window: an incoherent pair has a variance of one over this.
    n_rows: float
    #: Size of the picture, pixels.
    width: int
    height: int

    @property
    def strip_px(self) -> float:
        """Width of a strip, pixels."""
        return float(self.x[1] - self.x[0])

    @property
    def widest(self) -> int:
        """Largest distance of a pair, strips."""
        return int(self.pairs.shape[2]) - 1

    def between(self, first: int, last: int) -> Coherence:
        """The part of the picture that strips from one to before another show."""
        part = slice(first, last)
        width = round((last - first) * self.strip_px)
        pairs = self.pairs[:, part].copy()
        for apart in range(1, pairs.shape[2]):
            pairs[:, max(last - first - apart, 0) :, apart] = 0
        return replace(
            self,
            pairs=pairs,
            lit=self.lit[:, part],
            changes=self.changes[:, :, part],
            level=self.level[:, part],
            x=self.x[part] - self.x[first] + (self.strip_px - 1) / 2,
            width=width,
        )


def measure_coherence(
    pixels: Pixels, *, mosaic_period: int = 1, n_strips: int = N_STRIPS, reach: float = 0.2
) -> Coherence:
    """Coherence of the strips of a picture.

    Args:
        pixels: (height, width): luma or mosaic; a tone curve does no harm.
        mosaic_period: pixels after which the colours of a mosaic repeat; 1 for luma.
        n_strips: strips across the picture, about.
        reach: largest distance of two strips, picture widths.
    """
    scaled, level, x, starts = strip_changes(pixels, mosaic_period=mosaic_period, n_strips=n_strips)
    height, width = pixels.shape
    quiet, lit = _without_row_noise(scaled)
    n_rows = _independent_rows(quiet, lit)
    pairs = _pairs(quiet, int(np.ceil(reach * width / float(x[1] - x[0]))))
    step = _short_rows(height) // 2
    at = starts[:, None] + step * (np.arange(scaled.shape[1], dtype=np.float64) - (scaled.shape[1] - 1) / 2)
    return Coherence(pairs, lit, quiet, at, level, x, starts, n_rows, width, height)


def strip_changes(
    pixels: Pixels, *, mosaic_period: int = 1, n_strips: int = N_STRIPS, part: int = 1
) -> tuple[Float32Array, Float32Array, FloatArray, FloatArray]:
    """Changes of the strips of a picture from row to row.

    Args:
        pixels: (height, width): luma or mosaic.
        mosaic_period: pixels after which the colours of a mosaic repeat; 1 for luma.
        n_strips: strips across the picture, about.
        part: read one of so many equal parts of every window's rows.

    Returns:
        (W, rows, S) float32 of mean square one in every window of rows; (W, S) float32 mean values of a pixel there;
        (S,) and (W,) middles of strips and windows.
    """
    height, width = pixels.shape
    short = _short_rows(height)
    strip_px = mosaic_period * max(1, round(width / n_strips / mosaic_period))
    step = short // 2
    rows = height // _WINDOWS // part
    starts = (np.arange(_WINDOWS) * height + (height - rows * _WINDOWS) // 2) // _WINDOWS
    light = [_light(pixels[start : start + rows], strip_px) for start in starts.tolist()]
    scaled = _scaled(np.stack([_changes(one, short)[::step] for one in light]))
    level = np.stack([one.mean(axis=0) for one in light]) / np.float32(strip_px)
    x = (np.arange(scaled.shape[2]) + 0.5) * strip_px - 0.5
    return scaled, np.asarray(level, np.float32), x, starts + (rows - 1) / 2


def _light(rows: Pixels, strip_px: int) -> Float32Array:
    """(rows, strips) sums of the pixels of each strip."""
    import cv2

    n = rows.shape[1] // strip_px
    whole = np.ascontiguousarray(rows[:, : n * strip_px]).reshape(-1, strip_px)
    # Sums in whole numbers take half the time, but there are none of 16 bits.
    depth = cv2.CV_32S if rows.dtype == np.uint8 else cv2.CV_32F
    return np.asarray(cv2.reduce(whole, 1, cv2.REDUCE_SUM, dtype=depth).reshape(-1, n), np.float32)


def _short_rows(height: int) -> int:
    return _LOW_SHORT_ROWS if height < _LOW_ROWS else _SHORT_ROWS


def _changes(light: Float32Array, short: int) -> Float32Array:
    """(rows, strips) means over a few rows, less those over many."""
    import cv2

    return np.asarray(cv2.blur(light, (1, short)) - cv2.blur(light, (1, 8 * short + 1)), np.float32)


def _scaled(changes: Float32Array) -> Float32Array:
    """(W, rows, S) with every strip of every window clipped and scaled to a mean square of one."""
    rms = np.sqrt(np.mean(changes * changes, axis=1, keepdims=True)) + TINY
    clipped = np.clip(changes / rms, -_CLIP, _CLIP)
    clipped /= np.sqrt(np.mean(clipped * clipped, axis=1, keepdims=True)) + TINY
    return np.asarray(clipped, np.float32)


def _without_row_noise(scaled: Float32Array) -> tuple[Float32Array, Float32Array]:
    """The changes less what the least coherent strips have in common, and (W, S) how coherent neighbours are then."""
    low = np.argsort(_smooth(_neighbours(scaled), 5), axis=1)[:, : max(int(_DARK_SHARE * scaled.shape[2]), 1)]
    noise = np.stack([window[:, strips].mean(axis=1) for window, strips in zip(scaled, low, strict=True)])
    power = np.maximum(np.mean(noise * noise, axis=1), TINY)
    share = np.mean(scaled * noise[..., None], axis=1) / power[:, None]
    quiet = scaled - noise[..., None] * share[:, None]
    lit = np.clip(_smooth(_neighbours(quiet), 3, 3), 0, 1)
    return np.asarray(quiet, np.float32), np.asarray(lit, np.float32)


def _independent_rows(quiet: Float32Array, lit: Float32Array) -> float:
    """Rows of a window that count as independent: two strips' chance coherence has a variance of one over these."""
    bright = np.argsort(-lit.mean(axis=0))[: max(int(_BRIGHT_SHARE * lit.shape[1]), 1)]
    strips, rows = quiet[:, :, bright], quiet.shape[1]
    power = float(np.mean(strips * strips)) + TINY
    alike = [float(np.mean(strips[:, lag:] * strips[:, :-lag])) / power for lag in range(1, min(_LAGS, rows // 2))]
    return float(rows / (1 + 2 * float(np.sum(np.square(alike)))))


def _neighbours(scaled: Float32Array) -> Float32Array:
    """(W, S) coherence of the strips on either side of each strip."""
    beside = np.mean(scaled[:, :, 2:] * scaled[:, :, :-2], axis=1)
    return np.pad(beside, ((0, 0), (1, 1)), mode="edge")


def _smooth(values: Float32Array, strips: int, windows: int = 1) -> Float32Array:
    import cv2

    return np.asarray(cv2.blur(values, (strips, windows), borderType=cv2.BORDER_REFLECT_101), np.float32)


def _pairs(scaled: Float32Array, widest: int) -> Float32Array:
    """(W, S, widest + 1) coherence by strip and distance."""
    n = scaled.shape[2]
    widest = min(widest, n - 1)
    # Strips some way apart are not asked for: strips are taken as many at a time as are.
    size = n if n < 2 * widest + 2 else max(widest, _PAIRS_AT_ONCE)
    parts = [_pairs_of(scaled, start, min(start + size, n), widest) for start in range(0, n, size)]
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)


def _pairs_of(scaled: Float32Array, start: int, end: int, widest: int) -> Float32Array:
    """(W, end - start, widest + 1) coherence of some strips with those to their right, by distance."""
    n_windows, rows, n = scaled.shape
    last = min(end + widest, n)
    every = np.zeros((n_windows, end - start, end - start + widest), np.float32)
    np.matmul(scaled[:, :, start:end].transpose(0, 2, 1), scaled[:, :, start:last], out=every[:, :, : last - start])
    every /= np.float32(rows)
    # Row i of the band begins at the diagonal: one row further is one place further along.
    window, row, along = every.strides
    band = np.lib.stride_tricks.as_strided(
        every, (n_windows, end - start, widest + 1), (window, row + along, along), writeable=False
    )
    return np.ascontiguousarray(band)
