"""Numbers of policy of the wiring: which screen, which camera, whether packets show; and of a still's passes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class WiringSettings:
    """Each with its unit and the reason for it."""

    #: Packets, all columns together, which show plainly, nats: with a wrong camera they reach 103. It is right then but
    #: for their length, and other outlines are looked at with the screen that shows them alone.
    clear_packets_llr: float = 200.0
    #: Packets at which there may be some, nats: in a column of light without data, or all together where nothing but a
    #: grid says that there is a screen, or where none is received and an estimated camera is to be told. Wrong ones
    #: show less than 10, right ones 80. And headers and packets under which an initial pass leaves no hope of any: of
    #: 120 hard pictures that show packets, none had less than 74.
    min_packets_llr: float = 20.0

    #: Samples a slot on which columns are compared, and by how many slots they may be apart: slats may slant.
    light_samples: int = 2
    max_column_shift_slots: int = 10
    #: Rows over which light is smoothed where no clock is known, the longest period of switching then, rows, and the
    #: share of the light that it explains.
    smooth_rows: int = 2
    max_period_rows: int = 100
    switched_share: float = 0.7

    #: A column whose symbols have this log probability whatever slots say is not looked at again.
    beyond_doubt_log_prob: float = -1e-3
    #: A column whose slots stand out less than this has no light to speak of.
    dark_snr_db: float = -3.0
    #: Weights that a quick look finds this much less likely than the best are dropped, nats.
    weight_margin: float = 20.0
    #: A column whose slots are so much likelier packets than any slots, nats, has packets whether its header shows or
    #: not: on wrong clocks columns show 74 at most.
    min_headerless_llr: float = 100.0

    #: Of an outline that is given, or of the picture, so much must be shared by both.
    min_overlap: float = 0.002
    #: Fewer rows than those that the waves of an unknown camera are sought on tell nothing.
    min_rows: int = 24
    #: A picture whose mean is below this share of white is called dark where no screen was found in it.
    dark_mean: float = 0.08
    #: An outline so many times as large as the picture shows it less than one column.
    largest_outline: float = 50.0


@dataclass(frozen=True, slots=True)
class StillSettings:
    """Each with its unit and the reason for it."""

    #: Samples a slot: of first looks, and of those at columns that are still in doubt.
    coarse_samples: int = 2
    fine_samples: int = 4
    #: Rows that developing a picture mixes, as the width of a box: with few rows per slot it widens the exposure.
    mixed_rows: float = 1.0
    #: A column with a packet of less confidence, whose symbols are not `beyond_doubt_log_prob`, is looked at again, at
    #: last by the auto-encoder, and symbols of less log probability are weighed as words. Where the gate comes from:
    #: docs/auto_encoder.md. Of 2699 packets of simulated frames an initial pass leaves half so sure.
    doubtful: float = 0.985
    doubtful_word_log_prob: float = -1e-2
    #: A column none of whose packets has symbols of at least this mean log probability on the fine grid is beyond
    #: repair: of 350 such columns of simulated frames further looks made two error-free. Before, it may have a wrong
    #: weight.
    beyond_repair_log_prob: float = -0.8
    #: Words of a symbol in doubt that are weighed; none where even the best has less log probability: there is nothing
    #: to choose from.
    n_candidate_words: int = 4
    hopeless_word_log_prob: float = -1.4
    #: Slots of strips that the network is shown, at most: it takes most of the time. Columns beyond them, the least
    #: sure, have their words weighed alone.
    max_network_slots: int = 58_000


SETTINGS, STILL = WiringSettings(), StillSettings()
