"""Numbers of policy of the clock, of bursts, and of the link's time through a clip."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SyncSettings:
    """Each with its unit and the reason for it."""

    #: Strips of a column of which the search, and an initial pass, need but half, and samples a slot while the clock is
    #: sought.
    min_binned_strips: int = 4
    search_samples: int = 4
    #: Contrast that half-convinces, over the noise of a sample.
    contrast_sigmas: float = 8.0
    #: Light beyond this many times white is no measurement.
    max_light: float = 1e3

    #: Slots by which a column may be late against the others, from the air interface.
    max_delay_slots: float = 2.0
    #: Without delays, no more than this share of the columns seems to be off by more than so many slots.
    many_columns: float = 0.25
    same_delay_slots: float = 0.12
    #: Header correlation, added over the copies, that the delay of a single column must win.
    delay_lead: float = 0.3
    #: A lead of the headers below this may be one of columns that are spread in time.
    clear_header_lead: float = 2.5
    #: Columns without delays differ by less than this many slots (root mean square) in the light model's view.
    same_timing_slots: float = 0.03
    #: Weight of the first idea of a column's delay, as information: a standard deviation of a tenth of a slot.
    delay_information: float = 100.0
    #: Largest correction of the clock at a time, slots.
    max_correction_slots: float = 0.25

    #: Slots are at most this sure, nats, when copies are compared: what was seen once may be wrong.
    max_slot_llr: float = 3.0
    #: Log-likelihood ratio, nats, that settles the phase of the bursts.
    settled_llr: float = 12.0
    #: Closed bursts of which it is remembered whether they were certain.
    remembered_bursts: int = 4

    #: A clock that is off by more than this many slots from where the frames before foretell it is of another time.
    max_jump_slots: float = 2.0
    #: Share of a new measurement in the length of a frame.
    period_share: float = 0.2
    #: Locks by which time stamps are judged, and how often slow motion stretches them, likeliest first.
    n_judged_clocks: int = 5
    stretches: tuple[int, ...] = (2, 4, 8, 16, 32, 5, 10, 20, 3, 6)
    #: What a clock may be off by from frame to frame: a share, slots, and the error of stamps, seconds; and slots from
    #: which on locks are not on a line and judge nothing.
    rate_share: float = 0.004
    rate_slots: float = 0.4
    uneven_s: float = 2e-3
    uneven_slots: float = 1.0


SETTINGS = SyncSettings()
