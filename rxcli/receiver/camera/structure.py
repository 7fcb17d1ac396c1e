"""How much slots look like packets: headers, dimming symbols, constant weight, repeats."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rxcli.protocol import EXTREMES_SLOTS, HEADER, PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, WEIGHTS
from rxcli.types import BoolArray, Float32Array, FloatArray

#: Most that repeated packets count, nats.
_MOST_FOR_REPEATS = 40.0


def structure_llr(slots: FloatArray | Float32Array, first_slot: int, packet_slots: int) -> float:
    """Log-likelihood ratio of slots being packets, over slots lit at random.

    Headers must read 0011100011, and every other symbol of a column must have the same number of lit slots; a column
    may be too dark to say anything. A packet may come again.

    Args:
        slots: (C, N) light of every slot, any scale.
        first_slot: position of slot 0 in its packet.
        packet_slots: slots of a packet.
    """
    n_columns, n = slots.shape
    if n < EXTREMES_SLOTS:
        return -np.inf
    lit = _sliced(slots)
    position = (np.arange(n) + first_slot) % packet_slots
    in_header = position < SLOTS_PER_SYMBOL
    agree = lit[:, in_header] == np.array(HEADER, bool)[position[in_header]]
    header = agree.sum(axis=1) * np.log(0.9 / 0.1) + in_header.sum() * np.log(0.1 / 0.5)
    starts: NDArray[np.int64] = np.flatnonzero((position % SLOTS_PER_SYMBOL == 0) & ~in_header)
    starts = starts[starts + SLOTS_PER_SYMBOL <= n]
    symbols: BoolArray = lit[:, starts[:, None] + np.arange(SLOTS_PER_SYMBOL)]
    count = np.count_nonzero(symbols, axis=2)
    weight = _weight_evidence(count, lit.mean(axis=1))
    dimming = _dimming_evidence(lit, position)
    best = (weight + dimming).max(axis=1)
    columns = float(np.logaddexp(header + best, 0.0).sum() - n_columns * np.log(2.0))
    return columns + repeat_evidence(lit, position, packet_slots)


def repeat_evidence(lit: BoolArray, position: NDArray[np.int64], packet_slots: int) -> float:
    """Log-likelihood ratio of copies being followed by the same packet, over other packets; bursts may end anywhere."""
    payload: NDArray[np.int64] = np.flatnonzero(position[: max(position.size - packet_slots, 0)] >= PREAMBLE_SLOTS)
    if payload.size == 0:
        return 0.0
    share = np.clip(lit.mean(axis=1, keepdims=True), 0.1, 0.9)
    chance = share**2 + (1 - share) ** 2
    same = lit[:, payload] == lit[:, payload + packet_slots]
    # Errors come in runs and columns share light: a third of the slots' say.
    ratio = np.where(same, np.log(0.92 / chance), np.log(0.08 / (1 - chance))).sum(axis=0) / 3
    copy = np.cumsum(np.diff(position[payload], prepend=position[payload[0]]) < 0)
    by_copy = np.bincount(copy, ratio)
    # Half the rows per slot repeat as well, with twice the slots: this may decide a draw, no more.
    return min(float(np.logaddexp(by_copy + np.log(2 / 3), np.log(1 / 3)).sum()), _MOST_FOR_REPEATS)


def _sliced(slots: FloatArray | Float32Array) -> BoolArray:
    """Whether every slot is nearer to the lightest or to the darkest of those around it."""
    import cv2

    around = np.ones((1, EXTREMES_SLOTS), np.uint8)
    most, least = (extreme(slots, around, borderType=cv2.BORDER_REPLICATE) for extreme in (cv2.dilate, cv2.erode))
    return np.asarray(slots > (most + least) / 2)


def _weight_evidence(count: NDArray[np.int64], share: FloatArray) -> FloatArray:
    """(C, 9) log-likelihood ratio of every weight for the lit slots (C, n) of symbols, over chance."""
    weights = np.arange(SLOTS_PER_SYMBOL + 1)
    off = np.abs(weights[:, None] - np.array(WEIGHTS))
    likely = np.select([off == 0, off == 1, off == 2], [0.72, 0.1, 0.02], 0.005)
    p = np.clip(share, 0.1, 0.9)[:, None]
    ways = np.array([1, 10, 45, 120, 210, 252, 210, 120, 45, 10, 1])
    chance = ways * p**weights * (1 - p) ** (SLOTS_PER_SYMBOL - weights)
    observed = (count[..., None] == weights).sum(axis=1)
    return np.asarray(
        observed @ np.log(likely) - (observed * np.log(chance)).sum(axis=1, keepdims=True) - np.log(len(WEIGHTS))
    )


def _dimming_evidence(lit: BoolArray, position: NDArray[np.int64]) -> FloatArray:
    """(C, 9) log-likelihood ratio of the dimming symbols' slots for every weight, over chance."""
    inside = (position >= SLOTS_PER_SYMBOL) & (position < PREAMBLE_SLOTS)
    expected = position[inside] - SLOTS_PER_SYMBOL < np.array(WEIGHTS)[:, None]
    agree = (lit[:, None, inside] == expected).sum(axis=2)
    n = int(inside.sum())
    return np.asarray(agree * np.log(0.9 / 0.5) + (n - agree) * np.log(0.1 / 0.5))
