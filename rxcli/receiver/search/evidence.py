"""One measure for every hypothesis: how much its initial pass looks like packets."""

from __future__ import annotations

import numpy as np

from rxcli.receiver import sync
from rxcli.receiver.decode import detect
from rxcli.receiver.reception import Reception, complete_packets
from rxcli.receiver.search.settings import SETTINGS

#: Columns of the screen that evidence is scaled to: narrower columns show the same light several times.
_COLUMNS = 20


def log_evidence(reception: Reception) -> float:
    """Log-likelihood ratio of packets over slots of any kind, for a screen of twenty columns.

    A column that fits poorly, or is dark, says nothing. Where light is weak, headers come through before symbols do.
    """
    llr = reception.column_llr
    headers = max(float(reception.posteriors.header_llr.sum()), 0.0)
    return _COLUMNS / llr.size * (float(np.logaddexp(llr, 0.0).sum()) + SETTINGS.header_weight * headers)


def score(reception: Reception, repeats: tuple[int, ...], evidence: float, log_prior: float) -> float:
    """Tempered evidence plus log prior; a complete packet and similar copies add to it.

    Args:
        reception: initial pass.
        repeats: copies that a burst may have.
        evidence: see `log_evidence`.
        log_prior: of the hypothesis.
    """
    complete = bool(complete_packets(reception).any())
    similarity = 0.0
    if complete:
        clock = reception.clock
        possible = sync.possible_bursts(clock, detect.slot_llr(reception.metrics), repeats)
        own = [likeness for other, likeness in possible if np.array_equal(other.burst, clock.burst)]
        similarity = (own[0] if own else possible[-1][1]) - possible[0][1]
    gain = SETTINGS.complete_packet * complete + SETTINGS.copies_weight * similarity
    return SETTINGS.temper * (evidence + gain) + log_prior
