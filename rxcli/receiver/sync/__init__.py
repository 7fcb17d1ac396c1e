"""Row profiles to a clock and slot samples (`clock`); the time of the link through a clip (`tracking`)."""

from rxcli.receiver.sync.clock import (
    assign_bursts,
    contrast,
    corrected,
    doubled_strips,
    find_clock,
    find_clocks,
    from_copies,
    halved_strips,
    header_response,
    pooled_strips,
    possible_bursts,
    resample,
    sample_slots,
    to_copies,
)

__all__ = [
    "assign_bursts",
    "contrast",
    "corrected",
    "doubled_strips",
    "find_clock",
    "find_clocks",
    "from_copies",
    "halved_strips",
    "header_response",
    "pooled_strips",
    "possible_bursts",
    "resample",
    "sample_slots",
    "to_copies",
]
