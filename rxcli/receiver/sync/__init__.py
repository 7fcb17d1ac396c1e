"""Row profiles to a clock and slot samples (`clock`); the time of the link through a clip (`tracking`)."""

from rxcli.receiver.sync.clock import (
    binned_strips,
    contrast,
    corrected,
    find_clock,
    header_comb,
    header_response,
    likely_repeats,
    pooled_strips,
    possible_bursts,
    resample,
    sample_slots,
)

__all__ = [
    "binned_strips",
    "contrast",
    "corrected",
    "find_clock",
    "header_comb",
    "header_response",
    "likely_repeats",
    "pooled_strips",
    "possible_bursts",
    "resample",
    "sample_slots",
]
