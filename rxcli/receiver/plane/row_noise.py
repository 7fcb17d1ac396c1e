"""Row noise: the light that a sensor row has in common everywhere, because it is read out at once.

Columns send different slots, whose light is a share of the picture's; row noise is as large where the picture is dark.
So on every sensor row, the changes of cells are a common offset plus a common share of their own light, and the offset
is the noise. Slots are wider than rows: each octave of widths is taken by itself, as far as its offset exceeds its
error. Where a camera took its lens's distortion out, sensor rows are bent, as neighbouring cells show.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from rxcli.numerics import NORMAL_MEDIAN, TINY, local_mean, peak_offset
from rxcli.receiver.plane.read import running_sums
from rxcli.receiver.plane.rows import encode, light_of
from rxcli.receiver.plane.settings import ROW_NOISE
from rxcli.types import Float32Array, FloatArray, LightPlane


@dataclass(frozen=True, slots=True)
class RowNoise:
    """Noise of the sensor rows of a picture."""

    #: (R,) linear light.
    light: Float32Array
    #: (5,) rows by which picture rows are bent against sensor rows, see `_bends`.
    curvature: FloatArray

    def removed(self, light: Float32Array, x: FloatArray) -> Float32Array:
        """Light (N, R) of cells without the noise, as far as each of them follows it; fewer rows are means of rows.

        Args:
            light: linear.
            x: (N,) places of the cells in the picture, -0.5 to 0.5.
        """
        import cv2

        rows, out = np.arange(self.light.size), np.empty_like(light)
        for some in (slice(start, start + ROW_NOISE.n_cells) for start in range(0, len(x), ROW_NOISE.n_cells)):
            places, shown = _sensor_rows(x[some], rows.size, self.curvature), light[some]
            noise = np.stack([np.interp(place, rows, self.light) for place in places]).astype(np.float32)
            if noise.shape != shown.shape:
                noise = np.asarray(cv2.resize(noise, shown.shape[::-1], interpolation=cv2.INTER_AREA), np.float32)
            change = shown - local_mean(shown, ROW_NOISE.octaves[-1])
            # Light that is cut off at black does not follow, light that a tone curve raises does more.
            gain = np.einsum("nr,nr->n", change, noise) / np.maximum(np.einsum("nr,nr->n", noise, noise), TINY)
            noise *= np.clip(gain, 0, ROW_NOISE.max_gain)[:, None]
            np.subtract(shown, noise, out=out[some])
        return out


def find_row_noise(plane: LightPlane) -> RowNoise | None:
    """The noise of a picture's rows, if there is so much that cells have it in common."""
    width, n_cells = max(ROW_NOISE.cell_px // plane.cell_px, 1), len(plane.sums) - 1
    if n_cells < width or plane.height < 2 * ROW_NOISE.bands * ROW_NOISE.octaves[-1]:
        return None
    left = np.linspace(0, n_cells - width, ROW_NOISE.n_cells).astype(int)

    def cells(left: FloatArray, rows: slice) -> Float32Array:
        sums = plane.sums[left + width, rows] - plane.sums[left, rows]
        return light_of(plane, sums / np.float32(width * plane.cell_px), "srgb")

    middle = [int(plane.height * (1 + part) / 2) for part in (-ROW_NOISE.middle, ROW_NOISE.middle)]
    some = cells(left[::2], slice(*middle))
    change = some[:, 1:-1] - (some[:, 2:] + some[:, :-2]) / 2
    change /= change.std(axis=1, keepdims=True) + np.float32(TINY)
    common = change.mean(axis=0)
    # Changes of noise are the opposite a row or two on, those of slots that all columns share last.
    if common.var() < ROW_NOISE.noisy or common[:-2] @ (common[1:-1] + common[2:]) > 0:
        return None
    x, light = (left + width / 2) / n_cells - 0.5, cells(left, slice(None))
    curvature = _curvature(light, x)
    light = _straight(light, x, curvature)
    level = np.maximum(local_mean(light, ROW_NOISE.level_rows), 0)
    widths = [light, *(local_mean(light, width) for width in ROW_NOISE.octaves[1:])]
    offset = sum(
        (_offset(fine - coarse, level) for fine, coarse in pairwise(widths)), np.zeros(plane.height, np.float32)
    )
    # Slots that all columns share last for rows; noise does not.
    shared = float(offset[ROW_NOISE.distance :] @ offset[: -ROW_NOISE.distance])
    return RowNoise(offset, curvature) if shared < ROW_NOISE.white * float(offset @ offset) else None


def without_row_noise(plane: LightPlane, noise: RowNoise) -> LightPlane:
    """The plane without the noise of its rows."""
    n_cells, scale = len(plane.sums) - 1, plane.white - plane.black
    light = light_of(plane, np.diff(plane.sums, axis=0) / np.float32(plane.cell_px), "srgb")
    light = noise.removed(light, (np.arange(n_cells) + 0.5) / n_cells - 0.5)
    sums = np.zeros_like(plane.sums)
    sums[1:] = light if plane.is_linear else encode(light)
    sums[1:] *= np.float32(plane.cell_px * scale)
    sums[1:] += np.float32(plane.cell_px * plane.black)
    return replace(plane, sums=running_sums(sums))


def _bends(x: FloatArray, n_rows: int) -> FloatArray:
    """(5, N, R) rows that a unit of k1, k2 (in two parts), p1 and p2 moves cells at x against those in the middle."""
    x, y = x[:, None], (np.arange(n_rows) / n_rows - 0.5)[None]
    return n_rows * np.stack(np.broadcast_arrays(x**2 * y, x**4 * y, x**2 * y**3, x**2, x * y))


def _sensor_rows(x: FloatArray, n_rows: int, curvature: FloatArray) -> FloatArray:
    """(N, R) sensor row of every row of cells at x, up to what all cells of a row have in common."""
    return np.asarray(np.arange(n_rows) + np.tensordot(curvature, _bends(x, n_rows), 1))


def _straight(light: Float32Array, x: FloatArray, curvature: FloatArray) -> Float32Array:
    """Cells (N, R) read along sensor rows."""
    rows = np.arange(light.shape[1])
    places = _sensor_rows(x, rows.size, curvature)
    return np.stack([np.interp(rows, at, cell) for at, cell in zip(places, light, strict=True)]).astype(np.float32)


def _curvature(light: Float32Array, x: FloatArray) -> FloatArray:
    """(5,) bends by which cells (N, R) at x differ in their sensor rows; those under which they have most in common."""
    n_bands, lags = ROW_NOISE.bands, ROW_NOISE.lags
    length = light.shape[1] // n_bands
    terms, curvature = _bends(x, light.shape[1])[..., length // 2 :: length][..., :n_bands], np.zeros(5)
    found = []
    for step in (*ROW_NOISE.steps, 1):
        straight = _straight(light, x, curvature)
        change = straight - local_mean(straight, ROW_NOISE.octaves[-1])
        change /= change.std(axis=1, keepdims=True) + np.float32(TINY)
        found.append((float(change.mean(axis=0).var()), curvature))
        products = (change[:-step] * np.roll(change[step:], lag, axis=1) for lag in range(-lags, lags + 1))
        by_band = [each[:, : length * n_bands].reshape(len(each), n_bands, length).mean(axis=2) for each in products]
        similarity = np.stack(by_band)
        top = similarity[1:-1].argmax(axis=0)[None] + 1
        before, peak, after = (np.take_along_axis(similarity, top + shift, axis=0)[0] for shift in (-1, 0, 1))
        lag = top[0] - lags + peak_offset(before, peak, after)
        weight = (np.maximum(peak - ROW_NOISE.min_correlation, 0) * (peak > np.maximum(before, after))).ravel()
        jacobian = (terms[:, step:] - terms[:, :-step]).reshape(5, -1)
        normal = (jacobian * weight) @ jacobian.T
        curvature = curvature + np.linalg.solve(normal + TINY * np.eye(5), jacobian @ (weight * lag.ravel()))
    return max(found, key=lambda scored: scored[0])[1]


def _offset(change: Float32Array, level: Float32Array) -> Float32Array:
    """(R,) offset that changes (N, R) share beside the share of their own light."""
    bright = np.maximum(np.square(level), np.float32(TINY))
    offset, gain = np.zeros(change.shape[1], np.float32), np.ones((len(change), 1), np.float32)
    for step in range(ROW_NOISE.rounds):
        left = local_mean(np.square(change - gain * offset), ROW_NOISE.level_rows)
        usual = float(np.median(left))
        # Cells without light have no noise of their own to be weighted by.
        power = left + np.float32(ROW_NOISE.min_power * usual + TINY) if step else np.full_like(left, usual + TINY)
        common = 1 / (np.float32(ROW_NOISE.common) * np.quantile(power / bright, 0.1))
        power *= np.float32(ROW_NOISE.cells_a_column)
        weighted, shares = gain / power, level / power
        ones, mixed = (gain * weighted).sum(axis=0), (level * weighted).sum(axis=0)
        second = (shares * level).sum(axis=0) + common
        free = ones * second - mixed * mixed
        offset = ((weighted * change).sum(axis=0) * second - (shares * change).sum(axis=0) * mixed) / free
        error = second / free
        noise = max(float(np.median(offset * offset)) / NORMAL_MEDIAN**2 - float(np.median(error)), 0.0)
        if noise == 0:
            return np.zeros_like(error)
        offset = np.asarray(offset * (noise / (noise + error)), np.float32)
        followed = change @ offset / max(float(offset @ offset), TINY)
        gain = np.maximum(followed, 0)
        # The offset is that of cells which follow it as they are, in every octave.
        gain *= gain.sum() / max(float(gain @ gain), TINY)
        gain = np.asarray(np.minimum(gain, ROW_NOISE.max_gain), np.float32)[:, None]
    return offset
