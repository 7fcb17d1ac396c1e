"""Strips of columns: the light of a picture, two strips a column, before anything is known of its camera."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import TINY
from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.light import NoiseModel
from rxcli.types import Float32Array, FloatArray, RowProfiles


@dataclass(frozen=True, slots=True, eq=False)
class ColumnStrips:
    """Light of M strips on R rows; the strips of a column lie side by side."""

    #: (M, R) float32: light; and 1 where it is on the screen, else 0.
    light: Float32Array
    inside: Float32Array
    #: (M, R) float64: picture x of the strips' middles.
    x: FloatArray
    #: (R,) float64: rows, counted from the first one that was read.
    rows: FloatArray
    n_columns: int
    noise: NoiseModel
    #: Size of the picture.
    width: int
    height: int
    #: Whether the camera may have taken a distortion out, as it cannot from a mosaic.
    may_bend: bool = True

    @property
    def pitch(self) -> float:
        """Picture rows from one row of the strips to the next."""
        return float(self.rows[1] - self.rows[0]) if self.rows.size > 1 else 1.0


def strips_of(profiles: RowProfiles, x: FloatArray, width: int, height: int, *, may_bend: bool = True) -> ColumnStrips:
    """Strips from row profiles.

    Args:
        profiles: C columns, S strips, R rows; their sensor rows are not used.
        x: (C * S, R) picture x of the strips' middles.
        width: of the picture, pixels.
        height: of the picture, rows.
        may_bend: whether the camera may have taken a distortion out.
    """
    n_columns, n_strips, n_rows = profiles.light.shape
    join = max(n_strips // SETTINGS.strips_per_column, 1)
    n_used = n_strips // join * join

    def pooled(values: NDArray[Any]) -> NDArray[Any]:
        """(M, join, R), a column's last strip left out where their number is odd."""
        return values.reshape(n_columns, n_strips, n_rows)[:, :n_used].reshape(-1, join, n_rows)

    light = pooled(profiles.light)
    is_inside = (pooled(profiles.inside) & np.isfinite(light)).all(axis=1)
    pixels = max(float(np.median(profiles.count)), 1.0) * join
    return ColumnStrips(
        light=np.where(is_inside[:, None], light, 0).mean(axis=1),
        inside=is_inside.astype(np.float32),
        x=pooled(x).mean(axis=1, dtype=np.float64),
        rows=profiles.rows.astype(np.float64),
        n_columns=n_columns,
        noise=NoiseModel(profiles.noise_floor, profiles.noise_slope).of_mean(pixels),
        width=width,
        height=height,
        may_bend=may_bend,
    )


def joined(strips: ColumnStrips, n: int) -> ColumnStrips:
    """The strips with means of `n` neighbouring rows."""
    if n == 1:
        return strips
    n_rows = strips.rows.size // n

    def mean(values: FloatArray | Float32Array) -> FloatArray:
        return np.asarray(values[..., : n_rows * n].reshape(*values.shape[:-1], n_rows, n).mean(axis=-1))

    return replace(
        strips,
        light=mean(strips.light).astype(np.float32),
        inside=(mean(strips.inside) == 1).astype(np.float32),
        x=mean(strips.x),
        rows=mean(strips.rows),
        noise=strips.noise.of_mean(n),
    )


def levelled(light: Float32Array, inside: Float32Array, window: int) -> Float32Array:
    """Light (M, R) against mean and spread of the `window` rows around it, times the columns' share of it.

    What a strip has in common with a neighbour is the columns' light; the rest is noise and picture.
    """
    import cv2

    # Periods of a row or two leave no window; the smallest one is no use, but no error.
    size = (max(window, 1) | 1, 1)
    share = np.maximum(cv2.blur(inside, size), np.float32(1 / size[0]))
    change = (light - cv2.blur(light, size) / share) * inside
    beside = np.pad(change, ((1, 1), (0, 0)), mode="reflect")
    power, left, right = (cv2.blur(change * factor, size) / share for factor in (change, beside[:-2], beside[2:]))
    signal = np.clip(np.maximum(left, right), 0, power)
    sigmas = np.float32(SETTINGS.bounded_sigmas)
    doubt = signal + sigmas * sigmas * (power - signal) + np.float32(TINY)
    level = np.clip(change / np.sqrt(doubt), -sigmas, sigmas)
    return np.asarray(level * (signal / doubt * inside), np.float32)


def columns_of(level: Float32Array, n_columns: int) -> Float32Array:
    """(C, R) -1 dark to 1 lit: soft sign of the columns, from the levelled light of their strips (M, R).

    Columns are bounded by half of their common root mean square: those without light stay small.
    """
    mean = level.reshape(n_columns, -1, level.shape[1]).mean(axis=1)
    rms = np.sqrt(np.square(mean).mean()) + np.float32(SETTINGS.min_soft_sign)
    return np.asarray(np.clip(2 * mean / rms, -1, 1), np.float32)
