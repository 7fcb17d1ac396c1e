"""Strips: the light of a picture in the order of its readout."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.light import NoiseModel
from rxcli.types import Float32Array, FloatArray, RowProfiles

#: Samples a slot while the clock is sought.
SAMPLES = 4
#: Whether the camera took the distortion out of a picture.
Correction = Literal["no", "likely", "unknown"]


@dataclass(frozen=True, slots=True)
class Strips:
    """Light of M strips on R rows in readout order; the columns' strips lie side by side."""

    #: (M, R) float32: light; and 1 where it is on the screen, else 0.
    light: Float32Array
    inside: Float32Array
    #: (M, R) float64: picture x of the strip's middle.
    x: FloatArray
    #: (R,) float64: rows counted in readout order from the picture's first one read.
    rows: FloatArray
    n_columns: int
    noise: NoiseModel
    #: Size of the picture.
    width: int
    height: int
    #: k1 of the lens that would bow the screen's sides as they are seen (focal length of one width, k2 = -k1) and its
    #: standard deviation; None where they do not show.
    sides: tuple[float, float] | None = None
    #: Whether the picture is a mosaic, which no camera corrects.
    mosaic: bool = False
    #: Sigma of the Gaussian that a column's light falls off with, column pitches.
    light_spread: float = 0.45
    #: The tone curve that was undone; None where values are known to follow light.
    tone: str | None = None

    @property
    def side_curvature(self) -> tuple[float, float] | None:
        """k1 and its standard deviation where the sides are bowed without doubt."""
        return side_curvature_of(self.sides)

    @property
    def correction(self) -> Correction:
        """Whether the camera took the distortion out of the picture, which straightens sides and bends stripes."""
        if self.mosaic or self.side_curvature:
            return "no"
        straight = (
            self.sides
            and abs(self.sides[0]) < SETTINGS.straight_sds * self.sides[1]
            and self.sides[1] < SETTINGS.telling_sd
        )
        return "likely" if straight else "unknown"


def side_curvature_of(sides: tuple[float, float] | None) -> tuple[float, float] | None:
    """k1 that sides show and its standard deviation, None where they may be straight."""
    return sides if sides and abs(sides[0]) > SETTINGS.bowed_sds * sides[1] else None


def strips_of(
    profiles: RowProfiles,
    centre_x: FloatArray,
    width: int,
    height: int,
    light_spread: float,
    sides: tuple[float, float] | None = None,
    mosaic: bool = False,
    tone: str | None = None,
) -> Strips:
    """Strips for the functions below, from row profiles that were sampled without a lens or with one that bows sides.

    Args:
        profiles: C columns, S strips, R rows; `sensor_row` None.
        centre_x: (C*S, R) picture x of the strips' middles.
        width: of the picture, pixels.
        height: of the picture, rows.
        light_spread: of the screen, column pitches.
        sides: k1 that the screen's sides show, and its standard deviation.
        mosaic: whether the picture is a mosaic.
        tone: the curve that was undone; None where values are known to follow light.
    """
    n_columns, n_strips, n_rows = profiles.light.shape
    join = n_strips // SETTINGS.most_strips if n_strips % SETTINGS.most_strips == 0 else 1
    shape = (n_columns * n_strips // join, join, n_rows)
    inside = profiles.inside.reshape(shape).astype(np.float32).min(axis=1)
    pixels = max(float(np.median(profiles.count)), 1.0) * join
    return Strips(
        light=profiles.light.reshape(shape).mean(axis=1) * inside,
        inside=inside,
        x=centre_x.reshape(shape).mean(axis=1),
        rows=profiles.rows.astype(np.float64),
        n_columns=n_columns,
        noise=NoiseModel(profiles.noise_floor / pixels, profiles.noise_slope / pixels),
        width=width,
        height=height,
        light_spread=light_spread,
        sides=sides,
        mosaic=mosaic,
        tone=tone,
    )


def in_readout_order(strips: Strips) -> Strips:
    """The strips of a picture whose rows run against the readout, in readout order; its own inverse."""
    return replace(
        strips,
        light=np.ascontiguousarray(strips.light[:, ::-1]),
        inside=np.ascontiguousarray(strips.inside[:, ::-1]),
        x=np.ascontiguousarray(strips.x[:, ::-1]),
        rows=strips.height - 1 - strips.rows[::-1],
    )


def levelled(
    light: Float32Array, inside: Float32Array, window: int, noise: NoiseModel
) -> tuple[Float32Array, Float32Array]:
    """Light against mean and spread of the `window` rows around it; and the weight behind it, 0..1."""
    import cv2

    # Periods of a row or two leave no window; the smallest one is no use, but no error.
    size = (max(window, 1) | 1, 1)
    share = cv2.blur(inside, size) + np.float32(1e-3)
    mean = cv2.blur(light, size) / share
    random = noise.variance(mean) + np.float32(SETTINGS.least_variance)
    signal = np.maximum(cv2.blur(light * light, size) / share - mean * mean - random, 0)
    level = np.clip((light - mean) / np.sqrt(signal + 9 * random), -3, 3) * inside
    return level, signal / (signal + 16 * random) * inside
