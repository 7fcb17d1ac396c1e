"""How much slots look like packets: headers, dimming symbols, constant weight, repeats."""

from __future__ import annotations

from math import comb

import numpy as np
from numpy.typing import NDArray

from rxcli.protocol import EXTREMES_SLOTS, HEADER, PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, WEIGHTS
from rxcli.receiver.camera.settings import SETTINGS
from rxcli.types import BoolArray, Float32Array, FloatArray


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
    header = _agreement_llr(agree.sum(axis=1), int(in_header.sum()))
    starts: NDArray[np.int64] = np.flatnonzero((position % SLOTS_PER_SYMBOL == 0) & ~in_header)
    starts = starts[starts + SLOTS_PER_SYMBOL <= n]
    symbols: BoolArray = lit[:, starts[:, None] + np.arange(SLOTS_PER_SYMBOL)]
    count = np.count_nonzero(symbols, axis=2)
    weight = _weight_evidence(count, _share_of(lit))
    dimming = _dimming_evidence(lit, position)
    best = (weight + dimming).max(axis=1)
    columns = float(np.logaddexp(header + best, 0.0).sum() - n_columns * np.log(2.0))
    return columns + repeat_evidence(lit, position, packet_slots)


def repeat_evidence(lit: BoolArray, position: NDArray[np.int64], packet_slots: int) -> float:
    """Log-likelihood ratio of copies being followed by the same packet, over other packets; bursts may end anywhere."""
    payload: NDArray[np.int64] = np.flatnonzero(position[: max(position.size - packet_slots, 0)] >= PREAMBLE_SLOTS)
    if payload.size == 0:
        return 0.0
    share = _share_of(lit)[:, None]
    alike, chance = (one**2 + (1 - one) ** 2 for one in (SETTINGS.wrong_slots, share))
    same = lit[:, payload] == lit[:, payload + packet_slots]
    ratio = (
        np.where(same, np.log(alike / chance), np.log((1 - alike) / (1 - chance))).sum(axis=0) / SETTINGS.slots_as_one
    )
    copy = np.cumsum(np.diff(position[payload], prepend=position[payload[0]]) < 0)
    by_copy = np.bincount(copy, ratio)
    # Half the rows per slot repeat as well, with twice the slots: this may decide a draw, no more.
    return min(float(np.logaddexp(by_copy + np.log(2 / 3), np.log(1 / 3)).sum()), SETTINGS.max_repeats)


def _sliced(slots: FloatArray | Float32Array) -> BoolArray:
    """Whether every slot is nearer to the lightest or to the darkest of those around it."""
    import cv2

    around = np.ones((1, EXTREMES_SLOTS), np.uint8)
    most, least = (extreme(slots, around, borderType=cv2.BORDER_REPLICATE) for extreme in (cv2.dilate, cv2.erode))
    return np.asarray(slots > (most + least) / 2)


def _weight_evidence(count: NDArray[np.int64], share: FloatArray) -> FloatArray:
    """(C, 9) log-likelihood ratio of every weight for the lit slots (C, n) of symbols, over chance."""
    weights = np.arange(SLOTS_PER_SYMBOL + 1)
    ways = np.array([comb(SLOTS_PER_SYMBOL, n) for n in weights])
    # Slots may be wrong either way.
    off = np.abs(weights[:, None] - np.array(WEIGHTS))
    likely = (ways * SETTINGS.wrong_slots**weights * (1 - SETTINGS.wrong_slots) ** weights[::-1])[off] / np.where(
        off, 2, 1
    )
    likely = (1 - SETTINGS.spoiled_symbols) * likely + SETTINGS.spoiled_symbols / weights.size
    p = share[:, None]
    chance = ways * p**weights * (1 - p) ** weights[::-1]
    observed = (count[..., None] == weights).sum(axis=1)
    return np.asarray(
        observed @ np.log(likely) - (observed * np.log(chance)).sum(axis=1, keepdims=True) - np.log(len(WEIGHTS))
    )


def _dimming_evidence(lit: BoolArray, position: NDArray[np.int64]) -> FloatArray:
    """(C, 9) log-likelihood ratio of the dimming symbols' slots for every weight, over chance."""
    inside = (position >= SLOTS_PER_SYMBOL) & (position < PREAMBLE_SLOTS)
    expected = position[inside] - SLOTS_PER_SYMBOL < np.array(WEIGHTS)[:, None]
    agree = (lit[:, None, inside] == expected).sum(axis=2)
    return _agreement_llr(agree, int(inside.sum()))


def _agreement_llr(agree: NDArray[np.int64], n: int) -> FloatArray:
    """Log-likelihood ratio of n slots that are known, of which so many agree, over slots of equal chance."""
    return np.asarray(agree * np.log(2 * (1 - SETTINGS.wrong_slots)) + (n - agree) * np.log(2 * SETTINGS.wrong_slots))


def _share_of(lit: BoolArray) -> FloatArray:
    """(C,) share of slots that are lit."""
    return np.asarray(np.clip(lit.mean(axis=1), SETTINGS.min_share, 1 - SETTINGS.min_share))
