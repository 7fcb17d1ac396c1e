"""Initial slot decisions, and the contrast of headers."""

import numpy as np

from rxcli.protocol import HEADER, SLOTS_PER_SYMBOL
from rxcli.receiver.channel.known_picture.picture import ColumnLight
from rxcli.receiver.channel.known_picture.settings import SETTINGS
from rxcli.receiver.channel.patterns import lit_of
from rxcli.receiver.light import take_places
from rxcli.types import Clock, Float32Array, FloatArray


def first_decision(observed: ColumnLight, positions: FloatArray, clock: Clock) -> Float32Array:
    """(C, N) probability that each slot is lit, from the rows around its middle alone.

    Args:
        observed: the columns' light.
        positions: (C, R) or (1, R) exposure's centre of the rows, in slots.
        clock: the clock.
    """
    n_rows, reach = positions.shape[1], SETTINGS.decision_reach * clock.rows_per_slot
    steepness = (n_rows - 1) / (positions[:, -1:] - positions[:, :1])
    middle = (np.arange(clock.n_slots) + 0.5 - positions[:, :1]) * steepness
    top = np.ceil(middle - reach).astype(np.intp)
    # One more row, without light, for rows beyond the ends and for slots of one row less.
    weighted = np.zeros((len(observed.value), n_rows + 1), np.float32)
    np.multiply(observed.value - np.float32(0.5), observed.precision, out=weighted[:, :-1])
    llr = np.zeros((len(weighted), clock.n_slots), np.float32)
    for rows in (top + place for place in range(int(2 * reach) + 1)):
        is_near = (rows <= middle + reach) & (rows >= 0) & (rows < n_rows)
        llr += take_places(weighted, np.where(is_near, rows, n_rows))
    return lit_of(llr)


def header_contrast(observed: ColumnLight, positions: FloatArray, clock: Clock) -> float:
    """Contrast of the headers at the positions of the clock, 1 full, 0 none; 1 if no header is visible.

    Args:
        observed: the columns' light.
        positions: (C, R) or (1, R) exposure's centre of the rows, in slots.
        clock: the clock.
    """
    place = (positions + clock.first_slot + SLOTS_PER_SYMBOL) % clock.packet_slots - SLOTS_PER_SYMBOL
    rows = np.flatnonzero(
        (np.abs(place - SLOTS_PER_SYMBOL / 2) < (SLOTS_PER_SYMBOL + clock.exposure_slots) / 2).any(axis=0)
    )
    half, total = clock.exposure_slots / 2, np.concatenate([[0.0], np.cumsum(2.0 * np.array(HEADER) - 1)])
    late, early = (np.interp(place[:, rows] + end, np.arange(total.size), total) for end in (half, -half))
    shape = (late - early) / clock.exposure_slots
    value, precision = (values.take(rows, axis=1) for values in (observed.value, observed.precision))
    weight = np.abs(shape) * np.minimum(precision, np.float32(SETTINGS.prior_precision))
    if weight.sum() < SETTINGS.prior_precision * SETTINGS.min_header_rows:
        return 1.0
    weight = weight * np.sign(shape)
    return float((weight * np.clip(2 * value - 1, -2, 2)).sum() / (weight * shape).sum())
