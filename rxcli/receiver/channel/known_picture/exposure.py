"""Slots seen through the exposure of rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.receiver.channel.known_picture.settings import SETTINGS
from rxcli.receiver.light import SlotLight, exposure_shares, taken
from rxcli.types import Clock, Float32Array, FloatArray, IntArray

#: Slots beyond the grid that a position may reach.
_BEYOND_SLOTS = 8


def exposed(slots: Float32Array, positions: FloatArray, exposure_slots: float) -> Float32Array:
    """Mean of the slots over the exposure, (C, R).

    Args:
        slots: (C, N) values; half lit beyond.
        positions: (C, R) or (1, R) exposure's centre in slots.
        exposure_slots: exposure in slots.
    """
    return SlotLight(slots).seen(positions, exposure_slots)


def trusted(lit: Float32Array, positions: FloatArray, exposure_slots: float) -> Float32Array:
    """(C, R) 0..1 how far rows can be learned from whose slots are lit with probability `lit`; see `exposed`."""
    doubt = lit * (1 - lit)
    each: IntArray = np.arange(len(lit))
    if len(positions) == 1:  # columns without doubt are alike
        unsure = np.flatnonzero(doubt.max(axis=1) > SETTINGS.sure_probability)
        each = np.zeros(len(lit), np.int64)
        each[unsure] = 1 + np.arange(unsure.size)
        doubt = np.concatenate([np.zeros_like(doubt[:1]), doubt[unsure]])
    trust = np.clip(1 - 8 * exposed(doubt, positions, exposure_slots), 0, 1)
    return np.asarray(trust[each], np.float32)


def read_between(values: FloatArray, place: FloatArray) -> FloatArray:
    """`values` (C, n) at the places (C, R) or (1, R), linearly between."""
    place = np.clip(place, 0, values.shape[1] - 1.001)
    left = place.astype(np.intp)
    low = taken(values, left)
    return np.asarray(low + (taken(values, left + 1) - low) * (place - left))


def row_positions(rows: FloatArray, clock: Clock) -> FloatArray:
    """Exposure's centre of each row in slots of the grid, (C, R), or (1, R) where no column is delayed."""
    common = (rows - clock.row0) / clock.rows_per_slot
    if not clock.delay_slots.any():
        return np.asarray(common)[None]
    return np.asarray(common - clock.delay_slots[:, None])


@dataclass(frozen=True, slots=True)
class Response:
    """What a camera and its compression make of the exposed slots m: offset + centre m(g) + side (m(g - h) + m(g + h)),
    h being half a slot. Compression blurs stripes, frame by frame as its bits last."""

    centre: float = 1.0
    side: float = 0.0
    offset: float = 0.0

    def expected(self, lit: Float32Array, positions: FloatArray, exposure_slots: float) -> Float32Array:
        """(C, R) light that slots give; arguments as for `exposed`."""
        groups = alike_columns(positions)
        return np.concatenate(
            [self._of_rows(lit[g], at, exposure_slots) for g, at in zip(groups, positions, strict=True)]
        )

    def _of_rows(self, lit: Float32Array, centre: FloatArray, exposure_slots: float) -> Float32Array:
        """(C, R) light that slots give to rows at `centre` (R,)."""
        reach = exposure_slots / 2 + (SETTINGS.side_slots if self.side else 0)
        slots = np.floor(centre - reach).astype(np.intp)[:, None] + np.arange(int(np.ceil(2 * reach)) + 1)
        share = shares_of_slots(centre, slots, exposure_slots, self)
        beyond = _BEYOND_SLOTS
        padded = np.pad(lit, ((0, 0), (beyond, beyond)), constant_values=np.float32(0.5))
        slots = np.clip(slots + beyond, 0, padded.shape[1] - 1)
        out = np.full((lit.shape[0], centre.size), self.offset, np.float32)
        for place in range(slots.shape[1]):
            out += share[:, place] * padded.take(slots[:, place], axis=1)
        return out


def alike_columns(positions: FloatArray) -> list[slice]:
    """The columns that each row of `positions`, (C, R) or (1, R), is for."""
    return [slice(None)] if len(positions) == 1 else [slice(c, c + 1) for c in range(len(positions))]


def shares_of_slots(centre: FloatArray, slots: IntArray, exposure_slots: float, response: Response) -> Float32Array:
    """(R, n) share of each of the `slots` (R, n) in what a row at `centre` (R,) sees."""
    share = response.centre * exposure_shares(centre[:, None], slots, exposure_slots)
    if response.side:
        share += response.side * exposure_shares((centre - SETTINGS.side_slots)[:, None], slots, exposure_slots)
        share += response.side * exposure_shares((centre + SETTINGS.side_slots)[:, None], slots, exposure_slots)
    return np.asarray(share, np.float32)
