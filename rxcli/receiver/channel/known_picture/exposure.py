"""Slots after the exposure of rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.receiver.channel.known_picture.settings import SETTINGS
from rxcli.receiver.light import exposure_shares
from rxcli.types import Clock, Float32Array, FloatArray, IntArray


def row_positions(rows: FloatArray, clock: Clock) -> FloatArray:
    """Centre of the exposure of each row in grid slots, (C, R), or (1, R) if no column is delayed."""
    common = (rows - clock.row0) / clock.rows_per_slot
    if not clock.delay_slots.any():
        return np.asarray(common)[None]
    return np.asarray(common - clock.delay_slots[:, None])


@dataclass(frozen=True, slots=True)
class Response:
    """Response of camera and compression to the exposed slots m: offset + centre m(g) + side (m(g - h) + m(g + h)).

    h is half a slot. Compression blurs stripes differently in every frame.
    """

    centre: float = 1.0
    side: float = 0.0
    offset: float = 0.0
    #: Lateness of the clock that was fitted with them, slots.
    late: float = 0.0


@dataclass(frozen=True, slots=True)
class SlotView:
    """Weights of the slots around each row, for columns with equal delay."""

    #: (R,) metric that each row belongs to.
    metric: IntArray
    #: (memory + 3, R) share of each of the slots metric - memory - 1 .. metric + 1 in a row's light: the slots of the
    #: metric, and one more on each side for blur.
    share: Float32Array

    @classmethod
    def of(cls, centre: FloatArray, exposure_slots: float, isi_memory: int, response: Response) -> SlotView:
        """Compute the weights for rows with exposures centred at `centre` (R,), slots."""
        metric = np.floor(centre + isi_memory / 2).astype(np.int64)
        place = (centre - metric).astype(np.float32)
        slots = np.arange(-isi_memory - 1, 2, dtype=np.float32)[:, None]
        share = response.centre * exposure_shares(place, slots, exposure_slots)
        if response.side:
            share += response.side * exposure_shares(place - np.float32(SETTINGS.side_slots), slots, exposure_slots)
            share += response.side * exposure_shares(place + np.float32(SETTINGS.side_slots), slots, exposure_slots)
        return cls(metric, np.asarray(share, np.float32))

    def light(self, lit: Float32Array) -> tuple[Float32Array, Float32Array]:
        """(C, R) each: light of the slots `lit` (C, N) inside and outside the metrics of the rows."""
        n_slots, reach = lit.shape[1], len(self.share)
        padded = np.full((len(lit), n_slots + 2 * reach), 0.5, np.float32)
        padded[:, reach : reach + n_slots] = lit
        start = np.clip(self.metric + 2, 0, n_slots + reach)
        parts = [padded.take(start + place, axis=1) * share for place, share in enumerate(self.share)]
        return sum(parts[2:-1], parts[1]), parts[0] + parts[-1]


@dataclass(frozen=True, slots=True)
class ExpectedLight:
    """Predicted light of slots through a response."""

    #: (C, R) total, and part from slots outside the metric of a row.
    light: Float32Array
    beside: Float32Array
    #: Columns with equal delay, and the weights of their rows.
    views: list[tuple[slice, SlotView]]


def expected_light(
    lit: Float32Array, positions: FloatArray, exposure_slots: float, isi_memory: int, response: Response
) -> ExpectedLight:
    """Predict the light of rows from slots.

    Args:
        lit: (C, N) probability that each slot is lit; 0.5 beyond.
        positions: (C, R) or (1, R) exposure's centre in slots.
        exposure_slots: exposure in slots.
        isi_memory: ISI memory of the metrics.
        response: response of camera and compression.
    """
    n_columns = len(lit) if len(positions) == 1 else 1
    groups = [slice(start, start + n_columns) for start in range(0, len(lit), n_columns)]
    views = [
        (group, SlotView.of(centre, exposure_slots, isi_memory, response))
        for group, centre in zip(groups, positions, strict=True)
    ]
    lights = [view.light(lit[group]) for group, view in views]
    own, beside = (np.concatenate(parts) for parts in zip(*lights, strict=True))
    beside += np.float32(response.offset)
    return ExpectedLight(own + beside, beside, views)
