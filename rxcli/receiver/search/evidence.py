"""Evidence of a hypothesis: the log-likelihood ratio of packets in its initial pass."""

from __future__ import annotations

import numpy as np

from rxcli.numerics import TINY
from rxcli.receiver.acquisition import Acquisition
from rxcli.receiver.light import slot_llr
from rxcli.receiver.reception import Reception, complete_packets
from rxcli.receiver.search.hypothesis import Scored
from rxcli.receiver.search.settings import SETTINGS
from rxcli.receiver.sync import clock as sync

#: Columns of the screen that evidence is scaled to: narrower columns show the same light several times.
_COLUMNS = 20


def log_evidence(reception: Reception) -> float:
    """Log-likelihood ratio of packets over slots of any kind, for a screen of twenty columns.

    A dark or poorly fitting column contributes nothing. In weak light, headers are detected before symbols are.
    """
    llr = reception.column_llr
    headers = max(float(reception.posteriors.header_llr.sum()), 0.0)
    return _COLUMNS / llr.size * (float(np.logaddexp(llr, 0.0).sum()) + SETTINGS.header_weight * headers)


def score(reception: Reception, acquisition: Acquisition, evidence: float, log_prior: float) -> float:
    """Tempered evidence plus log prior; a complete packet and similar copies add to it.

    Args:
        reception: initial pass, of all columns or of some.
        acquisition: that the pass used.
        evidence: see `log_evidence`.
        log_prior: of the hypothesis.
    """
    packets = distinct_share(reception)
    complete = bool(complete_packets(reception).any())
    similarity = 0.0
    if complete:
        clock = reception.clock
        possible = sync.possible_bursts(clock, slot_llr(reception.metrics), acquisition.repeats)
        own = [likeness for candidate, likeness in possible if np.array_equal(candidate.burst, clock.burst)]
        similarity = (own[0] if own else possible[-1][1]) - possible[0][1]
    gain = SETTINGS.complete_packet * complete + SETTINGS.copies_weight * similarity
    return SETTINGS.temper * (packets * evidence + gain) + log_prior


def middle_score(scored: Scored) -> float:
    """Score of the middle half of the columns of a hypothesis."""
    acquisition, log_prior = scored.acquisition, scored.hypothesis.log_prior
    middle = scored.reception.of_columns(acquisition.middle_columns)
    return score(middle, acquisition, log_evidence(middle), log_prior)


def distinct_share(reception: Reception) -> float:
    """Share of the columns' slots that is independent of the neighbour's: too narrow columns repeat one packet."""
    slots = reception.payload_lit
    if len(slots) < 2:
        return 1.0
    slots = slots - slots.mean(axis=1, keepdims=True)
    slots /= np.linalg.norm(slots, axis=1, keepdims=True) + TINY
    return 1 - max(float((slots[1:] * slots[:-1]).sum(axis=1).mean()), 0.0)
