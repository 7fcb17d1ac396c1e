"""Pictures whose first look shows neither headers nor packets are not looked at in depth."""

import numpy as np
import pytest
from made_stages import clock_of, posteriors_of

from rxcli.options import SKIPS
from rxcli.receiver import still
from rxcli.receiver.frame.acquisition import Acquisition
from rxcli.receiver.frame.passes import Reception

CLOCK = clock_of(3, packet_slots=130, n_slots=260, burst=np.zeros(2, np.int64))


def _first(headers: float) -> Reception:
    posteriors = posteriors_of(1, 3, 11, log_evidence=np.full(3, -1e4), header_llr=np.full((1, 3), headers / 3))
    nothing = np.zeros((3, 260), np.float32)
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
    headers: float, confidence: float, skip: frozenset[str], looked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    acquisition = Acquisition(None, None, CLOCK, ())  # type: ignore[arg-type]
    monkeypatch.setattr(Reception, "is_complete", np.ones((1, 3), bool))
    monkeypatch.setattr(Reception, "packet_confidence", np.full((1, 3), confidence))
    seen: list[str] = []
    monkeypatch.setattr(still, "decode", lambda *rest: (seen.append("decode"), rest[2])[1])
    reception = still.decode_photograph(acquisition, skip, _first(headers))
    assert bool(seen) == looked
    assert reception.skipped == ({} if looked else {"no_packets": 3})
