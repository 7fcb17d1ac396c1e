"""The sensor: colour filter array, electrons, noise, and the numbers that leave it."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]
Cfa = Literal["bayer", "xtrans", "rgb"]

#: Unit cells of the colour filter arrays, row by row; "rgb" senses all three colours in every pixel.
_CELLS = {"bayer": ("RG", "GB"), "xtrans": ("GGRGGB", "GGBGGR", "BRGRBG", "GGBGGR", "GGRGGB", "RBGBRG")}
#: The same as numbers: 0 red, 1 green, 2 blue.
PATTERNS = {name: np.array([["RGB".index(c) for c in row] for row in rows], np.uint8) for name, rows in _CELLS.items()}

#: Below this mean, shot noise is drawn from the Poisson distribution itself; above, a Gaussian differs from it by less
#: than the read noise.
POISSON_BELOW_E = 16.0
#: Side of the tile of pixel gains that is repeated over the sensor; prime, so that it meets no other period.
_GAIN_TILE = 1021


@dataclass(frozen=True)
class Sensor:
    """Size, readout, and noise of a sensor."""

    width: int = 6240
    height: int = 4160
    #: Time between the exposure starts of adjacent rows.
    line_delay_s: float = 24.098e-3 / 4160
    cfa: Cfa = "xtrans"
    #: Red, green and blue sensitivity to the panel's white; green is 1.
    response: tuple[float, float, float] = (0.55, 1.0, 0.65)
    #: Share of each colour's light that its filter passes to the other two.
    colour_mixing: float = 0.06
    read_noise_e: float = 2.3
    row_noise_e: float = 0.3
    #: Standard deviation of the pixels' gains.
    prnu: float = 0.008
    #: Electrons from black level to white level.
    full_scale_e: float = 130.0
    black_level: int = 1022
    white_level: int = 16383
    #: Rows that are read at the same time.
    rows_at_once: int = 1
    #: Height of a pixel over its width; other than 1 where a scene was scaled unevenly.
    pixel_aspect: float = 1.0

    def row_times_s(self) -> NDArray[np.float64]:
        """(height,) time from the exposure start of row 0 to that of every row."""
        rows = np.arange(self.height)
        return np.asarray((rows - rows % self.rows_at_once) * self.line_delay_s, np.float64)

    @property
    def raw_per_e(self) -> float:
        """Raw units per electron."""
        return (self.white_level - self.black_level) / self.full_scale_e

    @property
    def colour_matrix(self) -> NDArray[np.float64]:
        """(3, 3) electrons of the sensor's colours from light of the panel's; its rows sum to `response`."""
        mixing = np.full((3, 3), self.colour_mixing) + np.eye(3) * (1 - 3 * self.colour_mixing)
        return np.asarray(mixing * np.array(self.response)[:, None], np.float64)

    @property
    def pattern(self) -> NDArray[np.uint8] | None:
        """Unit cell of the colour filter array, None for "rgb"."""
        return PATTERNS.get(self.cfa)

    def pixel_gains(self, first_row: int, shape: tuple[int, ...]) -> Float32Array:
        """Gains of the pixels of `shape[0]` rows from `first_row` on; the same for every picture of this sensor."""
        gains = 1 + np.float32(self.prnu) * _gain_tile()[(first_row + np.arange(shape[0])) % _GAIN_TILE]
        wide = np.tile(gains, (1, -(-shape[1] // _GAIN_TILE)))[:, : shape[1]]
        return wide if len(shape) == 2 else wide[..., None]


@lru_cache(maxsize=1)
def _gain_tile() -> Float32Array:
    """(tile, tile) standard normal numbers, drawn once: small frames would take longer over them than over the rest."""
    rng = np.random.Generator(np.random.SFC64(20240814))
    tile: Float32Array = rng.standard_normal((_GAIN_TILE, _GAIN_TILE), dtype=np.float32)
    tile.flags.writeable = False
    return tile


def pick_colours(planes: Float32Array, pattern: NDArray[np.uint8] | None, first_row: int) -> Float32Array:
    """What the colour filter array leaves of full-colour rows.

    Args:
        planes: (rows, width, 3) colours at every pixel.
        pattern: unit cell, None to keep all three.
        first_row: number of the first row on the sensor.

    Returns:
        (rows, width) float32, or (rows, width, 3) where the sensor has no filter array.
    """
    if pattern is None:
        return planes
    height, width = pattern.shape
    mosaic = np.empty(planes.shape[:2], np.float32)
    for y in range(height):
        for x in range(width):
            mosaic[y::height, x::width] = planes[y::height, x::width, pattern[(y + first_row) % height, x]]
    return mosaic


def count_electrons(mean_e: Float32Array, sensor: Sensor, rng: np.random.Generator) -> Float32Array:
    """Electrons as read: shot, read and row noise about their mean.

    Args:
        mean_e: (rows, width) or (rows, width, 3) expected electrons, not negative.
        sensor: noise figures.
        rng: source of randomness.

    Returns:
        Same shape, float32, black level at 0.
    """
    noise = rng.standard_normal(mean_e.shape, dtype=np.float32)
    low = mean_e < POISSON_BELOW_E
    deviation = np.sqrt(np.where(low, np.float32(0), mean_e) + np.float32(sensor.read_noise_e**2))
    noise *= deviation
    noise += mean_e
    few = mean_e[low]
    noise[low] += rng.poisson(few).astype(np.float32) - few
    row_noise = rng.standard_normal(mean_e.shape[0], dtype=np.float32) * np.float32(sensor.row_noise_e)
    noise += row_noise.reshape((-1,) + (1,) * (mean_e.ndim - 1))
    return noise


def to_raw(electrons: Float32Array, sensor: Sensor) -> NDArray[np.uint16]:
    """Raw numbers of electrons: gain, black level, rounding, white level."""
    raw = electrons * np.float32(sensor.raw_per_e)
    raw += np.float32(sensor.black_level + 0.5)
    return np.clip(raw, 0, sensor.white_level, out=raw).astype(np.uint16)
