"""Numbers of policy of detection and of what is reported."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class DecodeSettings:
    """Each with its unit and the reason for it."""

    #: A packet is reported up to this expected share of wrong bits; at 0.2 some have more than a quarter of them wrong.
    max_ber_hat: float = 0.1
    #: A photograph none of whose packets reaches this confidence shows none.
    min_best_confidence: float = 0.1
    #: A weight is reported, and its soft bits count, from this probability on.
    min_weight_probability: float = 0.99
    #: A column below this signal-to-noise ratio, dB, is too dark to try.
    dark_snr_db: float = 0.0
    #: Headers of a column, all bursts together, less likely than this against slots that are anything, nats, are none.
    min_header_llr: float = -2.0
    #: Together the columns' headers must be this much more likely than slots that are anything, nats; one good header
    #: gives so many, and a bad one takes no more than a good one gives.
    min_total_header_llr: float = 6.0
    max_header_llr: float = 12.0
    #: Light of white, and the share of a column's samples from which on its lit slots are cut off there.
    white_level: float = 0.98
    overexposed_share: float = 0.2

    #: Slots are at most this sure, nats, when weights are compared: one bad slot must not decide.
    max_slot_llr: float = 12.0
    #: No soft bit is surer, nats: of those that look surest in simulated clips 0.05 % are wrong, mostly of symbols that
    #: a picture's border cuts.
    max_bit_llr: float = 7.6
    #: Where a packet's own ratios expect as many wrong bits as its confidence does, this share of them is taken to hide
    #: among bits that look sure.
    hidden_error_share: float = 0.1

    #: Steady light: share of its variance that one period explains, from which on it may be a lamp's; packets reach
    #: 0.5, by repeating. Lines of the period that are added up, and the longest period, packets: a packet sent again
    #: has lines of its own.
    min_periodic_share: float = 0.6
    n_harmonics: int = 24
    max_period_packets: float = 0.5
    #: Slots by which the exposure may move or spread a slot.
    max_shift_slots: int = 2
    #: Columns this far apart, of all and by number, share no light; and correlation, beyond that of the headers which
    #: packets have in common, from which they show the same: packets reach 0.4, one light everywhere 0.65 or more.
    distant_share: float = 1 / 6
    distant_columns: int = 3
    min_similarity: float = 0.59


SETTINGS = DecodeSettings()
