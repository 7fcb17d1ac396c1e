"""Hypotheses tried by reading their slots: whatever packet they hold, and wherever it starts, must show in them.

The scan looks for headers in the light as it is, and a trial slices it. Where long exposures or a dark picture blur
both, slots are read through the exposure first, knowing nothing of packets. The codebook then says where symbols begin
(their first slots are dark more often than lit), headers and dimming symbols say where packets do: every start in
every length of packet is a matter of sums.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rxcli.protocol import HEADER, PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, WEIGHTS, dimming_symbol
from rxcli.receiver.camera.curvature import reversed_curvature
from rxcli.receiver.camera.estimates import BentHypothesis, Hypothesis, distinct, on_one_curvature
from rxcli.receiver.camera.scan import same_slots
from rxcli.receiver.camera.strips import Strips, in_readout_order
from rxcli.receiver.camera.timing import slot_time, thinned, time_terms
from rxcli.receiver.camera.waves import WORD_SHARES, column_waves, free_log_odds
from rxcli.types import FloatArray

#: Exposure that slots are read through while none is known, slots.
_EXPOSURE = 1.2
#: Share of the slots of headers and dimming symbols that may read wrongly, and the most that a slot says, nats.
_WRONG, _MOST = 0.02, 6.0
#: Different clocks that are read; of how many of them the neighbours are read too, and how far those are off by the end
#: of the picture, slots.
_READ, _READ_AROUND = 24, 4
_OFF_SLOTS = (-2.0, -1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0)
#: (9, 20) whether slots of header and dimming symbol are lit, for every weight.
_PREAMBLES = np.array([[*HEADER, *dimming_symbol(w)] for w in WEIGHTS], bool)


def read(strips: Strips, found: Sequence[BentHypothesis], packet_lengths: Sequence[int]) -> list[BentHypothesis]:
    """The hypotheses that stood out in the scan, each with every length of packet, where it starts if it is one.

    Args:
        strips: as the picture has them.
        found: hypotheses and the bends they were found with.
        packet_lengths: slots of a packet, of every screen in question.

    Returns:
        Hypotheses and bends, best first; the evidence is that of headers, dimming symbols and codewords over slots of
        any kind.
    """
    outstanding = sorted(found, key=lambda pair: -pair[0].salience)
    read_once = _read_all(strips, distinct(outstanding, on_one_curvature(same_slots), _READ), packet_lengths)
    best = distinct(sorted(read_once, key=_by_evidence), on_one_curvature(same_slots), _READ_AROUND)
    n_rows = float(strips.rows[-1] - strips.rows[0])
    near = [
        (replace(clock, rows_per_slot=clock.rows_per_slot * (1 + off * clock.rows_per_slot / n_rows)), curvature)
        for clock, curvature in best
        for off in _OFF_SLOTS
    ]
    return sorted(read_once + _read_all(strips, near, packet_lengths), key=_by_evidence)


def _by_evidence(pair: BentHypothesis) -> float:
    return -pair[0].log_evidence


def _read_all(strips: Strips, clocks: Sequence[BentHypothesis], packet_lengths: Sequence[int]) -> list[BentHypothesis]:
    return [(one, curvature) for clock, curvature in clocks for one in _read(strips, clock, curvature, packet_lengths)]


def _read(strips: Strips, clock: Hypothesis, curvature: FloatArray, packet_lengths: Sequence[int]) -> list[Hypothesis]:
    ordered, curvature = (
        (in_readout_order(strips), reversed_curvature(curvature)) if clock.reversed else (strips, curvature)
    )
    ordered = thinned(ordered, clock.rows_per_slot)
    first_row = ordered.rows[0] - 0.5 * (ordered.rows[1] - ordered.rows[0])
    start = clock.start_row % clock.rows_per_slot - 2 * clock.rows_per_slot
    values = np.concatenate([[first_row + start, clock.rows_per_slot], curvature])
    time = slot_time(ordered, time_terms(ordered), values)
    log_odds = free_log_odds(column_waves(ordered, time, clock.rows_per_slot), _EXPOSURE)
    out = []
    for packet_slots, log_evidence in zip(packet_lengths, start_evidence(log_odds, packet_lengths), strict=True):
        at = int(log_evidence.argmax())
        start_row = start + at * clock.rows_per_slot
        out.append(replace(clock, packet_slots=packet_slots, start_row=start_row, log_evidence=float(log_evidence[at])))
    return out


def start_evidence(log_odds: FloatArray, packet_lengths: Sequence[int]) -> list[FloatArray]:
    """Evidence that packets start at a slot and every packet after it, over slots of any kind, nats.

    Args:
        log_odds: (C, N) what the light says for every slot being lit.
        packet_lengths: slots of a packet, several to be compared.

    Returns:
        (packet_slots,) for every length.
    """
    odds = np.exp(np.clip(log_odds, -_MOST, _MOST))[:, None]
    duty = np.array(WEIGHTS)[:, None] / SLOTS_PER_SYMBOL
    free = np.log(1 - duty + duty * odds)
    # (places, C, 9, N): every slot at every place of a codeword, and of header and dimming symbol.
    in_words = np.stack([np.log(1 - share + share * odds) - free for share in WORD_SHARES[1:].T[..., None]])
    dark, lit = (np.log(1 - share + share * odds) - free for share in (_WRONG, 1 - _WRONG))
    in_preamble = np.where(_PREAMBLES.T[:, None, :, None], lit, dark)
    slot = np.arange(log_odds.shape[1])
    # (10, C, 9): words that start at slots 0 to 9, over all slots.
    places = (slot - np.arange(SLOTS_PER_SYMBOL)[:, None]) % SLOTS_PER_SYMBOL
    words = np.stack([in_words[place, :, :, slot].sum(axis=0) for place in places])
    # (C, 9, N + 20): what a preamble says more than words, by where it starts: at most its length before slot 0.
    more = np.zeros((*in_words.shape[1:3], slot.size + PREAMBLE_SLOTS))
    for place in range(PREAMBLE_SLOTS):
        first = PREAMBLE_SLOTS - place
        more[..., first : first + slot.size] += in_preamble[place] - in_words[place % SLOTS_PER_SYMBOL]
    return [_over_columns(words, more, free.sum(axis=2), packet_slots) for packet_slots in packet_lengths]


def _over_columns(words: FloatArray, more: FloatArray, free: FloatArray, packet_slots: int) -> FloatArray:
    """(packet_slots,) evidence of every start from that of words (10, C, 9), preambles (C, 9, n) and slots (C, 9)."""
    start = np.arange(packet_slots)
    padded = np.pad(more, ((0, 0), (0, 0), (0, -more.shape[2] % packet_slots)))
    preambles = padded.reshape(*more.shape[:2], -1, packet_slots).sum(axis=2)
    total = preambles[..., (start + PREAMBLE_SLOTS) % packet_slots] + words[start % SLOTS_PER_SYMBOL].transpose(1, 2, 0)
    over_free = np.logaddexp.reduce(total + free[..., None], axis=1) - np.logaddexp.reduce(free, axis=1)[:, None]
    # A column may be too dark to say anything.
    return np.asarray((np.logaddexp(over_free, 0.0) - np.log(2.0)).sum(axis=0))
