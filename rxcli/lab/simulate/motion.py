"""A camera in a hand: how it turns while it films, and while it reads the rows of a frame.

A hand turns a camera rather than it moves it: slow sway, and tremor of 5 to 12 Hz. Turns about the vertical and about
the horizontal shift the picture, a turn about the line of sight rolls it, and a step towards the screen enlarges it.
The speed is given as it appears: how far the picture's centre goes from frame to frame, in pixels, on average.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: Hz of sway and tremor, and waves of each.
_SWAY_HZ, _TREMOR_HZ, _WAVES = (0.4, 2.0), (5.0, 12.0), 3
#: Mean length of a vector whose two parts are normal with standard deviation 1.
_MEAN_LENGTH = np.sqrt(np.pi / 2)
#: Speed of the picture's sides by roll, and by nearing the screen, against that of its centre.
_ROLL_SHARE, _ZOOM_SHARE = 0.35, 0.1


@dataclass(frozen=True)
class HandMotion:
    """The motion of one clip.

    Args:
        seed: of the motion.
        speed: of the picture's centre on average, in focal lengths per second.
        half_width: of the picture, in focal lengths.
    """

    seed: int
    speed: float
    half_width: float

    @cached_property
    def _waves(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Frequency, phase and amplitude of the waves, (4, 2 * waves) each: yaw, pitch, roll, zoom."""
        rng = np.random.default_rng([self.seed, 23])
        shape = (4, _WAVES)
        frequency = np.concatenate([low * (high / low) ** rng.random(shape) for low, high in (_SWAY_HZ, _TREMOR_HZ)], 1)
        phase = rng.uniform(0, 2 * np.pi, frequency.shape)
        shares = np.array([1, 1, _ROLL_SHARE / self.half_width, _ZOOM_SHARE / self.half_width])
        rate = self.speed / _MEAN_LENGTH * shares
        # Waves of equal speed, whose powers add up.
        amplitude = rate[:, None] * np.sqrt(2 / frequency.shape[1]) / (2 * np.pi * frequency)
        return frequency, phase, amplitude

    def at(self, time_s: FloatArray) -> FloatArray:
        """Yaw, pitch, roll (radians) and relative zoom, (..., 4), at some times; nothing at time 0."""
        frequency, phase, amplitude = self._waves
        angle = 2 * np.pi * frequency * np.asarray(time_s)[..., None, None] + phase
        return np.asarray((amplitude * (np.sin(angle) - np.sin(phase))).sum(axis=-1))


def turned(points: FloatArray, motion: FloatArray) -> FloatArray:
    """Where the camera sees ideal normalised points (..., 2) when it has moved by `motion` (..., 4)."""
    yaw, pitch, roll, zoom = np.moveaxis(motion, -1, 0)
    (cr, sr), (cy, sy), (cp, sp) = ((np.cos(a), np.sin(a)) for a in (roll, yaw, pitch))
    x, y = (1 + zoom) * points[..., 0], (1 + zoom) * points[..., 1]
    x, y = cr * x - sr * y, sr * x + cr * y
    x, z = cy * x + sy, cy - sy * x
    y, z = cp * y + sp * z, cp * z - sp * y
    return np.stack([x / z, y / z], axis=-1)


def turned_back(points: FloatArray, motion: FloatArray) -> FloatArray:
    """The inverse of `turned`."""
    yaw, pitch, roll, zoom = np.moveaxis(motion, -1, 0)
    (cr, sr), (cy, sy), (cp, sp) = ((np.cos(a), np.sin(a)) for a in (roll, yaw, pitch))
    x, y, z = points[..., 0], cp * points[..., 1] - sp, cp + sp * points[..., 1]
    x, z = cy * x - sy * z, cy * z + sy * x
    x, y = x / z, y / z
    x, y = cr * x + sr * y, cr * y - sr * x
    return np.asarray(np.stack([x, y], axis=-1) / (1 + zoom)[..., None])
