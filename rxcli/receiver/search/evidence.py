"""Evidence of a hypothesis: the log-likelihood ratio of packets in its initial pass."""

import numpy as np

from rxcli.numerics import TINY
from rxcli.receiver.frame.passes import Reception
from rxcli.receiver.search.hypothesis import Scored
from rxcli.receiver.search.settings import SETTINGS
from rxcli.types import BELIEVABLE, BoolArray, Float32Array

#: Columns of most screens. Evidence is scaled to them: narrower columns show the same light several times.
USUAL_COLUMNS = 20
#: Correlation of the slots of neighbouring columns from which they have the same packet.
REPEATED = 0.7


def log_evidence(reception: Reception) -> float:
    """Log-likelihood ratio of packets over slots of any kind, for a screen of twenty columns.

    A dark or poorly fitting column contributes nothing. In weak light, headers are detected before symbols are.
    """
    llr = reception.posteriors.log_evidence
    headers = max(float(reception.header_llr.sum()), 0.0)
    return USUAL_COLUMNS / llr.size * (float(np.logaddexp(llr, 0.0).sum()) + SETTINGS.header_weight * headers)


def fit(reception: Reception) -> float:
    """How well packets fit, for clocks whose slots are the same: in poor light all columns together show the start."""
    llr = reception.posteriors.log_evidence
    return USUAL_COLUMNS / llr.size * float(np.maximum(llr, -SETTINGS.cut_start).sum())


def believable(reception: Reception) -> BoolArray:
    """(B, C) complete packets that are believable, whatever their column's number."""
    return reception.is_complete & (reception.packet_confidence >= BELIEVABLE)


def is_whole(reception: Reception) -> bool:
    """Whether every column has a believable packet that is not its neighbour's."""
    return bool(believable(reception).any(axis=0).all() and (repeated_share(reception) < REPEATED).all())


def score(reception: Reception, evidence: float, log_prior: float) -> float:
    """Tempered evidence of distinct columns plus log prior.

    Args:
        reception: initial pass, of all columns or of some.
        evidence: see `log_evidence`.
        log_prior: of the hypothesis.
    """
    return tempered(reception, distinct_share(reception) * evidence) + log_prior


def tempered(reception: Reception, evidence: float) -> float:
    """Tempered evidence; a complete packet adds to it."""
    return SETTINGS.temper * (evidence + SETTINGS.complete_packet * bool(reception.is_complete.any()))


def bright_score(scored: Scored) -> float:
    """Score of the brighter half of the columns of a hypothesis."""
    bright = scored.reception.of_columns(scored.acquisition.bright_columns)
    return score(bright, log_evidence(bright), scored.hypothesis.log_prior)


def distinct_share(reception: Reception) -> float:
    """Share of the evidence that columns add to that of their left neighbours: too narrow ones repeat one packet."""
    own = np.logaddexp(reception.posteriors.log_evidence, 0.0)
    return 1 - max(float(own[1:] @ repeated_share(reception)) / (float(own.sum()) + TINY), 0.0)


def repeated_share(reception: Reception) -> Float32Array:
    """(C - 1,) correlation of the slots of neighbouring columns."""
    slots = reception.payload_lit
    slots = slots - slots.mean(axis=1, keepdims=True)
    slots /= np.linalg.norm(slots, axis=1, keepdims=True) + TINY
    return np.asarray((slots[1:] * slots[:-1]).sum(axis=1), np.float32)
