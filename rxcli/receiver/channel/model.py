"""Observation model of a frame (exposure, crosstalk, black level, noise) and the light that it predicts for slots."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rxcli.receiver.light import Crosstalk, Exposure, NoiseModel, sees_dark_header
from rxcli.types import Clock, Float32Array, SlotSamples


@dataclass(frozen=True, slots=True)
class ObservationModel:
    """Parameters of a frame by which slots and picture become the light of samples."""

    #: Light of a dark slot: room light and sensor offset.
    black_level: float
    #: Noise of a sample.
    noise: NoiseModel
    crosstalk: Crosstalk
    exposure: Exposure

    def expected(self, lit: Float32Array, clock: Clock, columns: NDArray[np.int64], slope: bool = False) -> Expected:
        """Predict the light of some columns per unit of picture, given the current estimate of all slots.

        Args:
            lit: (C, N) probability that each slot is lit.
            clock: the clock.
            columns: numbers of the columns.
            slope: whether to compute the derivative by time too.
        """
        ahead = np.diff(clock.delay_slots) * self.exposure.samples_per_slot if clock.delay_slots.any() else None
        shape = self.exposure.mean_light(lit)
        neighbours, own = self.crosstalk.from_neighbours(shape, columns, ahead), self.crosstalk.own
        if not slope:
            return Expected(neighbours, own, shape[columns, None], None)
        change = np.zeros_like(shape)
        change[:, 1:-1] = (shape[:, 2:] - shape[:, :-2]) * np.float32(self.exposure.samples_per_slot / 2)
        changes = self.crosstalk.from_neighbours(change, columns, ahead) + own * change[columns, None]
        return Expected(neighbours, own, shape[columns, None], changes)

    def over_black(self, samples: SlotSamples) -> Float32Array:
        """(C, S, n) light above the black level, 0 where nothing is visible."""
        return (samples.light - np.float32(self.black_level)) * samples.valid


@dataclass(frozen=True, slots=True)
class Expected:
    """Predicted light of C columns per unit of picture; arrays (C, S, n) or broadcastable to it."""

    #: Light of the adjacent columns.
    neighbours: Float32Array
    #: (1, S, 1) light of the column itself when lit, and (C, 1, n) its slots after the exposure, 0..1.
    own: Float32Array
    shape: Float32Array
    #: Derivative of the total by time, per slot; None unless requested.
    slope: Float32Array | None

    @property
    def whole(self) -> Float32Array:
        """(C, S, n) light of all columns."""
        return self.neighbours + self.own * self.shape


def estimate_black_level(samples: SlotSamples, clock: Clock) -> float:
    """Estimate the light of a dark slot: the median over the three dark slots in the middle of headers."""
    q = samples.samples_per_slot
    places = (np.arange(samples.light.shape[-1]) + 0.5) / q + clock.first_slot
    dark = sees_dark_header(places % clock.packet_slots, clock.exposure_slots, min_reach=0.5)
    observed = samples.light[..., dark][samples.valid[..., dark] > 0]
    return float(np.median(observed)) if observed.size else 0.0
