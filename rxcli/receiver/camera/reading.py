"""Slots read on a clock before anything is known of packets: whatever packet they hold must show in them.

Light is read through an exposure by forward-backward. The codebook then says where symbols begin (their first slots are
dark more often than lit), headers and dimming symbols say where packets do: every start in every length of packet is a
matter of sums.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import folded
from rxcli.protocol import HEADER, PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, WEIGHTS, dimming_symbol
from rxcli.receiver.camera.estimates import Hypothesis
from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.views import View, Views, slot_time
from rxcli.receiver.camera.waves import WORD_SHARES, Grid, column_waves, read_freely, shared_weights
from rxcli.types import Float32Array, FloatArray

#: (9, 20) whether slots of header and dimming symbol are lit, for every weight.
_PREAMBLES = np.array([[*HEADER, *dimming_symbol(w)] for w in WEIGHTS], bool)


@dataclass(frozen=True, slots=True)
class Packets:
    """Packets of some length among slots that were read."""

    packet_slots: int
    #: Number of the slot where one starts, 0 to `packet_slots`.
    start: int
    #: Log-likelihood ratio of headers, dimming symbols and codewords over slots of any kind.
    log_evidence: float
    #: (C,) likeliest weight of every column.
    w: NDArray[np.int64]

    @property
    def grid(self) -> Grid:
        """Where slot 0 stands in its packet."""
        return Grid(-self.start % self.packet_slots, self.packet_slots)


@dataclass(frozen=True, slots=True)
class Reading:
    """Slots read on a clock."""

    #: (6,) start, rows per slot, k1, k2, p1, p2 of the row-time map, in readout order.
    values: FloatArray
    #: Rows per slot of the view that it was read from.
    rows_per_slot: float
    is_reversed: bool
    #: (C, N) float32: probability that a slot is lit, packets not known.
    lit: Float32Array
    #: Best packets of every length, likeliest first.
    packets: tuple[Packets, ...]

    @property
    def log_evidence(self) -> float:
        return self.packets[0].log_evidence


def read(views: Views, clock: Hypothesis, curvature: FloatArray, packet_lengths: Sequence[int]) -> Reading:
    """The slots of a hypothesis, whatever length and start of packets it came with.

    Args:
        views: of the picture's strips.
        clock: a clock found on strips that were straightened.
        curvature: the bend they were straightened with.
        packet_lengths: slots of a packet, of every screen in question.
    """
    view = views.at(clock.rows_per_slot, clock.reversed)
    rows = view.strips.rows
    first_row = rows[0] - 0.5 * (rows[1] - rows[0])
    start = first_row + clock.start_row % clock.rows_per_slot - SETTINGS.slots_before * clock.rows_per_slot
    values = np.concatenate([[start, clock.rows_per_slot], view.curvature(curvature)])
    return read_slots(views, clock.rows_per_slot, clock.reversed, values, packet_lengths)


def read_slots(
    views: Views, rows_per_slot: float, is_reversed: bool, values: FloatArray, packet_lengths: Sequence[int]
) -> Reading:
    """The slots on a row-time map (6,), read from the view for some rows per slot."""
    view = views.at(rows_per_slot, is_reversed)
    lit, packets = _read_at_levels(view, values, packet_lengths, None)
    if packets[0].log_evidence < SETTINGS.levels_in_doubt:
        even = _read_at_levels(view, values, packet_lengths, SLOTS_PER_SYMBOL // 2)
        lit, packets = max((lit, packets), even, key=lambda pair: pair[1][0].log_evidence)
    return Reading(values, rows_per_slot, is_reversed, lit, packets)


def _read_at_levels(
    view: View, values: FloatArray, packet_lengths: Sequence[int], w: int | None
) -> tuple[Float32Array, tuple[Packets, ...]]:
    waves = column_waves(view, slot_time(view.strips, view.terms, values))
    lit, log_odds = read_freely(waves, SETTINGS.read_exposure_slots, w)
    found = []
    for packet_slots, by_weight in zip(packet_lengths, start_evidence(log_odds, packet_lengths), strict=True):
        log_evidence = over_weights(by_weight)
        at = int(log_evidence.argmax())
        weights = shared_weights(by_weight[:, :, at].T.astype(np.float64)) + 1
        found.append(Packets(packet_slots, at, float(log_evidence[at]), weights))
    return lit, tuple(sorted(found, key=lambda packets: -packets.log_evidence))


def over_weights(by_weight: Float32Array | FloatArray) -> FloatArray:
    """(n,) evidence of all columns together from that of every weight (C, 9, n), weights alike before."""
    top = by_weight.max(axis=1, keepdims=True)
    columns = top[:, 0] + np.log(np.exp(by_weight - top).sum(axis=1))
    # A column may be too dark to say anything.
    return np.asarray((np.logaddexp(columns, 0.0) - np.log(2.0)).sum(axis=0), np.float64)


def start_evidence(
    log_odds: Float32Array | FloatArray, packet_lengths: Sequence[int]
) -> list[Float32Array | FloatArray]:
    """Evidence that packets start at a slot and every packet after it, over slots of any kind, nats.

    Args:
        log_odds: (C, N) what the light says for every slot being lit.
        packet_lengths: slots of a packet, several to be compared.

    Returns:
        (C, 9, packet_slots) for every length: of columns of every weight, over columns of any.
    """
    odds = np.exp(np.clip(log_odds, -SETTINGS.most_slot_nats, SETTINGS.most_slot_nats))[:, None]
    kind = odds.dtype
    duty = (np.array(WEIGHTS)[:, None] / SLOTS_PER_SYMBOL).astype(kind)
    free = np.log(1 - duty + duty * odds)
    n = log_odds.shape[1]
    # (places, C, 9, N): every slot at every place of a codeword, and of header and dimming symbol.
    shares = WORD_SHARES[1:].T[..., None].astype(kind)
    in_words = np.stack([np.log(1 - share + share * odds) - free for share in shares])
    dark, lit = (
        np.log(kind.type(1 - share) + kind.type(share) * odds) - free
        for share in (SETTINGS.wrong_preamble, 1 - SETTINGS.wrong_preamble)
    )
    in_preamble = np.where(_PREAMBLES.T[:, None, :, None], lit, dark)
    # (10, C, 9): words that start at slots 0 to 9, over all slots: slots in tens, by their place in the ten.
    by_place = np.pad(in_words, ((0, 0), (0, 0), (0, 0), (0, -n % SLOTS_PER_SYMBOL)))
    by_place = by_place.reshape(*in_words.shape[:3], -1, SLOTS_PER_SYMBOL).sum(axis=3)
    tens = np.arange(SLOTS_PER_SYMBOL)
    words = np.stack([by_place[(tens - first) % SLOTS_PER_SYMBOL, :, :, tens].sum(axis=0) for first in tens])
    # (C, 9, N + 20): what a preamble says more than words, by where it starts: at most its length before slot 0.
    more = np.zeros((*in_words.shape[1:3], n + PREAMBLE_SLOTS), kind)
    for place in range(PREAMBLE_SLOTS):
        first = PREAMBLE_SLOTS - place
        more[..., first : first + n] += in_preamble[place] - in_words[place % SLOTS_PER_SYMBOL]
    total_free = free.sum(axis=2)
    prior = total_free - np.logaddexp.reduce(total_free, axis=1)[:, None]
    return [_of_length(words, more, packet_slots) + prior[..., None] for packet_slots in packet_lengths]


def _of_length(
    words: Float32Array | FloatArray, more: Float32Array | FloatArray, packet_slots: int
) -> Float32Array | FloatArray:
    """(C, 9, packet_slots) evidence of every start from that of words (10, C, 9) and preambles (C, 9, n)."""
    start = np.arange(packet_slots)
    preambles = folded(more, packet_slots)
    in_words = words[start % SLOTS_PER_SYMBOL].transpose(1, 2, 0)
    return np.asarray(preambles[..., (start + PREAMBLE_SLOTS) % packet_slots] + in_words)
