"""Samples for the joint detection of slots and picture: light relative to its local mean, copies side by side."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import mean_of_valid
from rxcli.protocol import SLOTS_PER_SYMBOL
from rxcli.receiver.channel.model import ObservationModel
from rxcli.receiver.channel.settings import SETTINGS
from rxcli.receiver.light import Exposure
from rxcli.types import BurstSamples, Clock, Float32Array, IntArray, SlotSamples


def by_start(clock: Clock) -> Clock:
    """The clock whose samples are ordered by the start of their exposure instead of its centre."""
    return replace(clock, row0=clock.row0 + clock.exposure_slots / 2 * clock.rows_per_slot)


def burst_samples(
    samples: SlotSamples, clock: Clock, model: ObservationModel, columns: IntArray, lit: Float32Array | None = None
) -> BurstSamples:
    """Samples of the bursts of some columns.

    Args:
        samples: see `by_start`; of all columns, or of `columns` alone where `lit` is given.
        clock: the clock, its copies assigned to bursts.
        model: of the samples.
        columns: numbers of the columns to detect.
        lit: (C, N) probability that each slot is lit, all columns; None: unknown, the light itself serves.
    """
    q = samples.samples_per_slot
    above = (samples.light - np.float32(model.black_level)) * samples.valid
    mean = mean_of_valid(above, samples.valid, SLOTS_PER_SYMBOL * q) if samples.level is None else samples.level
    mean = np.maximum(mean, np.float32(SETTINGS.min_level_sigmas * model.noise.sigma))
    light = np.asarray(above / mean, np.float32)
    if lit is None:  # Light over its mean lit light, in the middle strips.
        third = light.shape[1] // 3
        own = np.clip(light[:, third : light.shape[1] - third].mean(axis=1) / 2, 0, 1)
    else:
        own = Exposure.by_start(clock.exposure_slots, q).mean_light(lit)
    neighbours = model.crosstalk.from_neighbours(own, columns, clock.delay_slots * q)
    if len(light) > columns.size:
        light, mean, above = light[columns], mean[columns], above[columns]
        samples = samples.of_columns(columns)
    variance = model.noise.variance(above) / np.square(mean)
    variance += np.square(light) * np.float32(SETTINGS.relative_error**2)

    def lanes(values: NDArray[np.floating[Any]]) -> Float32Array:
        return _by_lane(values, clock, q)

    visible = lanes(samples.valid)
    scale = -(lanes(np.log(mean)) * visible).sum(axis=(0, 1, 3), dtype=np.float64) / q
    return BurstSamples(
        light=lanes(light),
        noise=np.where(visible > 0, lanes(variance), np.float32(1)),
        valid=visible,
        neighbours=lanes(neighbours),
        own=np.tile(model.crosstalk.own.ravel(), int(np.bincount(clock.burst).max())),
        exposure_slots=clock.exposure_slots,
        log_scale=scale,
        n_bursts=int(clock.burst.max()) + 1,
    )


def _by_lane(values: NDArray[np.floating[Any]], clock: Clock, q: int) -> Float32Array:
    """(P, Q, B * C, K * S) values of the copies of each burst side by side, from (C, S, N * Q)."""
    by_copy = clock.to_copies(np.moveaxis(values.reshape(*values.shape[:2], -1, q), -1, 0))
    n_bursts, most = int(clock.burst.max()) + 1, int(np.bincount(clock.burst).max())
    n_columns, n_strips = values.shape[:2]
    out = np.zeros((clock.packet_slots, q, n_bursts, n_columns, most, n_strips), np.float32)
    for burst in range(n_bursts):
        for place, copy in enumerate(np.flatnonzero(clock.burst == burst)):
            out[:, :, burst, :, place] = by_copy[:, :, :, copy].transpose(3, 0, 1, 2)
    return out.reshape(clock.packet_slots, q, n_bursts * n_columns, most * n_strips)
