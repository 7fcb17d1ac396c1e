"""The observation model: exposure, crosstalk, black level and noise of a frame; what it expects of slots."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rxcli.receiver.channel.settings import SETTINGS
from rxcli.receiver.light import Crosstalk, Exposure, NoiseModel, sees_dark_header
from rxcli.types import Clock, Float32Array, SlotSamples


@dataclass(frozen=True, slots=True)
class ObservationModel:
    """What is the same all over the frame: how slots and picture become the light of samples."""

    #: Light of a dark slot: room light, sensor floor.
    black_level: float
    #: Of a sample.
    noise: NoiseModel
    crosstalk: Crosstalk
    exposure: Exposure

    def expected(self, lit: Float32Array, clock: Clock, columns: NDArray[np.int64], slope: bool = False) -> Expected:
        """What some columns should show per unit of picture, by the present idea (C, N) of all slots.

        Args:
            lit: (C, N) probability that each slot is lit.
            clock: the clock.
            columns: those that are asked for.
            slope: whether to tell the change with time as well.
        """
        ahead = np.diff(clock.delay_slots) * self.exposure.samples_per_slot if clock.delay_slots.any() else None
        shape = self.exposure.mean_light(lit)
        others, own = self.crosstalk.from_neighbours(shape, columns, ahead), self.crosstalk.own
        if not slope:
            return Expected(others, own, shape[columns, None], None)
        change = np.zeros_like(shape)
        change[:, 1:-1] = (shape[:, 2:] - shape[:, :-2]) * np.float32(self.exposure.samples_per_slot / 2)
        changes = self.crosstalk.from_neighbours(change, columns, ahead) + own * change[columns, None]
        return Expected(others, own, shape[columns, None], changes)

    def over_black(self, samples: SlotSamples) -> Float32Array:
        """(C, S, n) light over that of a dark slot, 0 where nothing is seen."""
        return (samples.light - np.float32(self.black_level)) * samples.valid


@dataclass(frozen=True, slots=True)
class Expected:
    """What C columns should show, per unit of picture; arrays (C, S, n) or broadcasting to it."""

    #: Light of the columns beside.
    others: Float32Array
    #: (1, S, 1) light of the column itself where its slots are lit, and (C, 1, n) how far they are.
    own: Float32Array
    shape: Float32Array
    #: Change of the whole by a slot of time; None where it was not asked for.
    slope: Float32Array | None

    @property
    def whole(self) -> Float32Array:
        """(C, S, n) light of all columns."""
        return self.others + self.own * self.shape

    def of(self, columns: NDArray[np.int64]) -> Expected:
        """That of some of the columns."""
        slope = None if self.slope is None else self.slope[columns]
        return Expected(self.others[columns], self.own, self.shape[columns], slope)


def estimate_black_level(samples: SlotSamples, clock: Clock) -> float:
    """Light of a dark slot: the median of what is seen in the middle of the headers' three dark slots."""
    q = samples.samples_per_slot
    places = (np.arange(samples.light.shape[-1]) + 0.5) / q + clock.first_slot
    dark = sees_dark_header(places % clock.packet_slots, clock.exposure_slots, least=0.5)
    observed = samples.light[..., dark][samples.valid[..., dark] > 0]
    return float(np.median(observed)) if observed.size else 0.0


def estimate_sigma(samples: SlotSamples, black_level: float, least: float) -> float:
    """Noise of a dark sample, from second differences where it is dark; at least `least`."""
    light = samples.light
    mean = (light[..., 2:] + light[..., 1:-1] + light[..., :-2]) / 3
    dark = (mean < black_level + SETTINGS.dark_light) & (samples.valid[..., 2:] * samples.valid[..., :-2] > 0)
    bend = (light[..., 2:] - 2 * light[..., 1:-1] + light[..., :-2])[dark]
    if bend.size < 50:
        return least
    return max(float(np.median(np.abs(bend)) / (0.6745 * np.sqrt(6.0))), least)
