"""The link's time through a clip: by how much time stamps are stretched."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from rxcli.receiver.sync.tracking import BurstPhase, LinkTime
from rxcli.types import Clock, FloatArray

PACKET, RATE_HZ, PERIOD = 130, 17_300.0, 288.62
CLOCK = Clock(4.0, 0.3, PACKET, 0.0, 200, 0, np.zeros(2, np.int64), np.zeros(20), 5.0)


def entered(stretch: float, noise: float = 0.05) -> LinkTime:
    """The link's time after the first frames, whose time stamps are stretched."""
    time, rng = LinkTime(PACKET, RATE_HZ), np.random.default_rng(3)
    for frame in range(5):
        slot = (40 + frame * PERIOD + noise * rng.standard_normal()) % PACKET
        clock = replace(CLOCK, row0=-(slot % 1) * CLOCK.rows_per_slot, first_slot=int(slot))
        assert time.update(frame, stretch * frame * PERIOD / RATE_HZ, clock) is not None
    return time


def favours(period: float, log_evidence: float) -> Callable[[FloatArray], float]:
    """Packets that are equal at some slots from frame to frame alone."""
    return lambda slots: log_evidence * (abs(np.diff(slots).mean() - period) < PACKET / 2)


@pytest.mark.parametrize("stretch", range(1, 41))
def test_packets_decide_among_all_factors(stretch: int) -> None:
    assert entered(stretch).time_stamp_stretch(0.012, favours(PERIOD, 50.0)) == stretch


def test_a_factor_that_stays_open_is_doubted() -> None:
    """At 10, a deviation of the rate of 0.08 % would make it 1."""
    time = entered(10)
    assert time.time_stamp_stretch(0.012, lambda _: 0.0) is None
    assert time.time_stamp_stretch(0.012, favours(PERIOD, 4.0)) is None  # likelier, and not sure
    assert time.time_stamp_stretch(0.012, favours(10 * PERIOD, 2.0)) == 1
    assert 0 < time.stretch_log_odds < 5
    plain = entered(1)
    assert plain.time_stamp_stretch(0.012, lambda _: 0.0) == 1
    assert plain.stretch_log_odds > 20


def test_bursts_are_evidence_where_copies_are_equal() -> None:
    rng = np.random.default_rng(4)
    packets = 2.0 * rng.choice([-1.0, 1.0], (4, 20, PACKET))
    evidence = {}
    for passed in range(1, 8):
        phase = BurstPhase(3)
        for frame in range(6):
            copies = np.stack([packets[(2 * frame + copy) // 3] for copy in range(2)])
            phase.update(passed * frame, copies)
        evidence[passed] = phase.log_evidence
    assert max(evidence, key=evidence.__getitem__) == 2
