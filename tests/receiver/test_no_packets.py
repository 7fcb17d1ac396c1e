"""Pictures whose first look shows neither headers nor packets are not looked at in depth."""

from __future__ import annotations

import numpy as np
import pytest

from rxcli.options import SKIPS
from rxcli.receiver import still
from rxcli.receiver.frame.acquisition import Acquisition
from rxcli.receiver.frame.passes import Reception
from rxcli.types import BurstPosteriors, Clock

CLOCK = Clock(
    row0=0.0,
    rows_per_slot=8.0,
    exposure_slots=0.5,
    packet_slots=130,
    first_slot=0,
    n_slots=260,
    header_peak_ratio=3.0,
    burst=np.zeros(2, np.int64),
    delay_slots=np.zeros(3),
)


def _first(headers: float) -> Reception:
    posteriors = BurstPosteriors(
        w=np.full(3, 5),
        w_log_prob=np.zeros((3, 9)),
        log_evidence=np.full(3, -1e4),
        lit=np.zeros((1, 3, 130), np.float32),
        index=np.zeros((1, 3, 11), np.int64),
        log_prob=np.zeros((1, 3, 11)),
        bit_llr=np.zeros((1, 3, 11, 7)),
        header_llr=np.full((1, 3), headers / 3),
    )
    nothing = np.zeros((3, 261, 4))
    snr = np.zeros((3, 260), np.float32)
    return Reception(CLOCK, None, (snr, snr), posteriors, snr, None, nothing, np.zeros(3, bool))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("headers", "confidence", "skip", "looked"),
    [
        (5.0, 0.1, frozenset(SKIPS), False),
        (90.0, 0.1, frozenset(SKIPS), True),
        (5.0, 0.999, frozenset(SKIPS), True),
        (5.0, 0.1, frozenset(SKIPS) - {"no_packets"}, True),
    ],
)
def test_only_what_may_show_packets_is_looked_at_in_depth(
    headers: float,
    confidence: float,
    skip: frozenset[str],
    looked: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    acquisition = Acquisition(None, None, CLOCK, ())  # type: ignore[arg-type]
    monkeypatch.setattr(Reception, "is_complete", np.ones((1, 3), bool))
    monkeypatch.setattr(Reception, "packet_confidence", np.full((1, 3), confidence))
    seen: list[str] = []
    monkeypatch.setattr(still, "decode", lambda *rest: (seen.append("decode"), rest[2])[1])
    reception = still.decode_photograph(acquisition, skip, _first(headers))
    assert bool(seen) == looked
    assert reception.skipped == ({} if looked else {"no_packets": 3})
