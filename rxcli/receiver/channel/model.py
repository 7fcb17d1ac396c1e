"""Observation model of a frame (exposure, crosstalk, black level, noise) and the light that it predicts for slots."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import TINY, mean_of_valid
from rxcli.protocol import SLOTS_PER_SYMBOL
from rxcli.receiver.channel.settings import SETTINGS
from rxcli.receiver.light import Crosstalk, Exposure, NoiseModel, sees_dark_header
from rxcli.types import Clock, Float32Array, FloatArray, SlotSamples

#: Columns whose differences give a standard deviation of two parameters.
_MIN_COLUMNS = 3


@dataclass(frozen=True, slots=True)
class ObservationModel:
    """Parameters of a frame by which slots and picture become the light of samples."""

    #: Light of a dark slot: room light and sensor offset.
    black_level: float
    #: Noise of a sample.
    noise: NoiseModel
    crosstalk: Crosstalk
    exposure: Exposure
    #: Tails of the crosstalk, see `Crosstalk.of`, with their standard deviation.
    tails: tuple[float, float] = (0.0, 0.0)

    def with_tails(self, light_spread: float, tails: tuple[float, float]) -> ObservationModel:
        """The model with other tails of a column's light, whose standard deviation is `light_spread` pitches."""
        return replace(self, tails=tails, crosstalk=Crosstalk.of(len(self.crosstalk.shares), light_spread, tails[0]))

    def expected(self, lit: Float32Array, clock: Clock, columns: NDArray[np.int64], slope: bool = False) -> Expected:
        """Predict the light of some columns per unit of picture, given the current estimate of all slots.

        Args:
            lit: (C, N) probability that each slot is lit.
            clock: the clock.
            columns: numbers of the columns.
            slope: whether to compute the derivative by time too.
        """
        shape, delays = self.exposure.mean_light(lit), clock.delay_slots * self.exposure.samples_per_slot
        neighbours, own = self.crosstalk.from_neighbours(shape, columns, delays), self.crosstalk.own
        if not slope:
            return Expected(neighbours, own, shape[columns, None], None)
        change = np.zeros_like(shape)
        change[:, 1:-1] = (shape[:, 2:] - shape[:, :-2]) * np.float32(self.exposure.samples_per_slot / 2)
        changes = self.crosstalk.from_neighbours(change, columns, delays) + own * change[columns, None]
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


def estimate_black_level(samples: SlotSamples, clock: Clock) -> float | None:
    """The light of a dark slot: the median over the three dark slots in the middle of headers; None without any."""
    q = samples.samples_per_slot
    places = (np.arange(samples.light.shape[-1]) + 0.5) / q + clock.first_slot
    dark = sees_dark_header(places % clock.packet_slots, clock.exposure_slots)
    observed = samples.light[..., dark][samples.valid[..., dark] > 0]
    return float(np.median(observed)) if observed.size else None


def estimate_tails(
    samples: SlotSamples,
    clock: Clock,
    model: ObservationModel,
    lit: Float32Array,
    trust: FloatArray,
    light_spread: float,
) -> tuple[float, float]:
    """Tails of the crosstalk by which the light of columns follows the slots of their neighbours.

    Light over its local mean is compared with what crosstalk without and with tails gives for the decided slots. A
    priori there are none.

    Args:
        samples: of all columns.
        clock: the clock.
        model: the light model.
        lit: (C, N) probability that each slot is lit.
        trust: (C,) probability that the slots of a column are right.
        light_spread: standard deviation of the profile's light, column pitches.

    Returns:
        Tails and their standard deviation; zeros where they do not differ from none.
    """
    columns = np.flatnonzero(trust > SETTINGS.min_trust)
    if columns.size < _MIN_COLUMNS:
        return 0.0, 0.0
    around, valid = SLOTS_PER_SYMBOL * samples.samples_per_slot, samples.valid[columns]

    def over_mean(light: Float32Array) -> tuple[Float32Array, Float32Array]:
        mean = mean_of_valid(light * valid, valid, around)
        return np.asarray(light / np.maximum(mean, np.float32(TINY)), np.float32), mean

    shown, mean = over_mean(model.over_black(samples)[columns])
    near, wide = (
        model.with_tails(light_spread, (tails, 0.0)).expected(lit, clock, columns).whole for tails in (0.0, 1.0)
    )
    plain = over_mean(near)[0]
    # A tone or an exposure that is not quite the stated one bends the light between dark and lit, as tails do.
    bent = over_mean(np.maximum(near, np.float32(TINY)) ** np.float32(SETTINGS.bent))[0]
    changes = np.stack([over_mean(wide)[0] - plain, bent - plain])
    noise = model.noise.variance(mean * shown) / np.maximum(np.square(mean), np.float32(TINY))
    weight = valid * (mean > model.noise.sigma) / (noise + np.float32(SETTINGS.tails_texture**2))
    weighted = changes * weight * trust[columns, None, None].astype(np.float32)
    power = np.einsum("icsn,jcsn->cij", weighted, changes, dtype=np.float64)
    error = np.einsum("icsn,csn->ci", weighted, shown - plain, dtype=np.float64)
    inverse = np.linalg.inv(power.sum(axis=0) + TINY * np.eye(2))
    fitted = inverse @ error.sum(axis=0)
    scores = (error - power @ fitted) @ inverse
    tails, variance = float(fitted[0]), float(np.square(scores[:, 0]).sum())
    shrink = SETTINGS.tails_sd**2 / (SETTINGS.tails_sd**2 + variance)
    tails, sd = shrink * tails, float(np.sqrt(shrink * variance))
    return (tails, sd) if tails > SETTINGS.sure_tails * sd else (0.0, 0.0)
