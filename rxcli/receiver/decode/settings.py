"""Settings of detection and reporting."""

import msgspec


class DecodeSettings(msgspec.Struct, frozen=True):
    """Thresholds, each with its unit and its reason."""

    #: Maximum number of slots that a symbol of a photograph's packet may miss.
    max_missing_slots: int = 2
    #: Largest expected share of wrong bits of a reported packet.
    max_ber_hat: float = 0.1
    #: If no packet of a photograph reaches this confidence, none is reported.
    min_best_confidence: float = 0.1
    #: Minimum probability of a weight at which its soft bits are used.
    min_weight_probability: float = 0.99
    #: Weight of the evidence for weights that columns have in common, because errors of samples are correlated.
    weight_temper: float = 0.08
    #: A column below this signal-to-noise ratio, dB, is too dark to try.
    dark_snr_db: float = 0.0
    #: Minimum log-likelihood ratio of a column's headers, all bursts together, against arbitrary slots.
    min_header_llr: float = -2.0
    #: Minimum log-likelihood ratio of the headers of all columns together, and the largest contribution, positive or
    #: negative, of one header; and limit of a slot's log-likelihood ratio when weights are compared: one bad slot must
    #: not decide.
    max_llr: float = 10.0

    #: Limit of a soft bit's log-likelihood ratio: about 0.05 % of the surest bits of simulated clips are wrong, mostly
    #: in symbols at the picture's border.
    max_bit_llr: float = 7.6
    #: Minimum share of a packet's expected wrong bits that is attributed to bits with large log-likelihood ratios.
    hidden_error_share: float = 0.1

    #: Minimum share of the variance that one period must explain for light to count as periodic (repeated packets reach
    #: 0.5), harmonics that are added up, and the longest period, packets.
    min_periodic_share: float = 0.6
    n_harmonics: int = 24
    max_period_packets: float = 0.5
    #: Slots by which the exposure may shift or widen a slot.
    max_shift_slots: int = 2
    #: Columns whose halves share no light; and the correlation of columns, beyond that of the common headers, from
    #: which they show one light: packets reach 0.4, a lamp at least 0.65.
    min_compared_columns: int = 6
    min_similarity: float = 0.6


class SurvivorSettings(msgspec.Struct, frozen=True):
    """Joint detection of slots and picture."""

    #: Most paths that are kept.
    max_paths: int = 48
    #: Effective number of independent samples per slot and strip, whose errors are correlated: of a slot, and more for
    #: each of its samples.
    information: float = 0.3
    sample_information: float = 0.1
    #: Change of the picture per slot, its deviation at the start, both relative; degrees of freedom of its errors.
    drift_per_slot: float = 0.06
    first_deviation: float = 0.3
    degrees: float = 1.5
    #: Limits: variance of the picture relative to its square; the picture against the level, more or less.
    max_variance: float = 4.0
    max_picture: float = 1e3

    def information_of(self, samples_per_slot: int) -> float:
        """Effective number of independent samples per slot and strip."""
        return self.information + self.sample_information * samples_per_slot


SETTINGS, SURVIVORS, QUICK_SURVIVORS = DecodeSettings(), SurvivorSettings(), SurvivorSettings(max_paths=12)
