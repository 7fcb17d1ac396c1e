"""Settings of clock recovery, burst assignment and the link time of a clip."""

import msgspec


class SyncSettings(msgspec.Struct, frozen=True):
    """Thresholds, each with its unit and its reason."""

    #: Samples per slot of the clock search.
    search_samples: int = 4
    #: Contrast, in standard deviations of a sample, at which a strip has half its full weight.
    contrast_sigmas: float = 8.0
    #: Largest valid light, in units of white.
    max_light: float = 1e3

    #: Largest delay of a column against the common clock, slots (air interface).
    max_delay_slots: float = 2.0
    #: Share of the columns that may appear delayed by more than the second number of slots when none is.
    many_columns: float = 0.25
    same_delay_slots: float = 0.12
    #: Header lead (peak over rival) below which delayed columns are tried.
    clear_header_lead: float = 2.5
    #: Root-mean-square deviation, slots, below which columns count as undelayed in the light model.
    same_timing_slots: float = 0.03
    #: Fisher information of the prior of a column's delay: a standard deviation of a tenth of a slot.
    delay_information: float = 100.0
    #: Largest single correction of the clock, slots.
    max_correction_slots: float = 0.25

    #: Limit of a slot's log-likelihood ratio when copies are compared.
    max_slot_llr: float = 3.0
    #: Reliability of a slot, mean of the columns, as a share of the most reliable one's, below which it shows no light.
    min_slot_light: float = 0.3
    #: Share of the slots that are misread in all columns of a copy.
    misread_slots: float = 0.1
    #: Lead, log-likelihood ratio, at which the assignment of copies to bursts is settled.
    settled_llr: float = 24.0

    #: Largest deviation, slots, of a clock from the prediction of earlier frames; beyond it the link time is lost.
    max_jump_slots: float = 2.0
    #: Weight of a new measurement in the running mean of the frame period.
    period_share: float = 0.2
    #: Clocks from which the stretch of time stamps is estimated, the largest one, and log-odds of any before them.
    n_judged_clocks: int = 5
    max_stretch: int = 40
    slow_log_odds: float = -3.0
    #: Log-odds by which one stretch must lead.
    sure_stretch: float = 4.6
    #: Deviations, of a mean rate, at which a stretch is no longer considered.
    rate_limits: float = 4.0
    #: Tolerances from frame to frame: relative rate error, slots, error of time stamps in seconds; and the largest
    #: deviation of the clocks from a line, slots.
    rate_share: float = 0.004
    rate_slots: float = 0.4
    uneven_s: float = 2e-3
    uneven_slots: float = 1.0


SETTINGS = SyncSettings()
