"""How sure the number of the first column is, by the packets of the outermost columns.

Outlines of one family share all columns but the outermost. A column of the screen has packets, one beyond it has none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from rxcli.receiver.acquisition import Acquisition, sample_columns
from rxcli.receiver.context import Outline
from rxcli.receiver.search.hypothesis import Scored
from rxcli.receiver.search.propose import Proposer
from rxcli.receiver.search.settings import SETTINGS
from rxcli.receiver.still import initial_pass

#: Columns that are read beside the outermost, because they shed light there.
_BESIDE = 2


def less_likely_outlines(best: Scored, outlines: Sequence[Outline], proposer: Proposer) -> Iterator[Outline]:
    """Yield the outlines, with lower log-odds where they leave out columns with packets.

    Args:
        best: the hypothesis that was chosen.
        outlines: all that were proposed.
        proposer: of the frame.
    """
    own, n_columns = best.hypothesis.outline, best.hypothesis.screen.columns
    acquisition = replace(best.acquisition, clock=best.reception.clock)
    for rival in outlines:
        shift = _columns_between(own, rival, n_columns)
        is_rival = rival.family == own.family and rival.log_odds > own.log_odds - SETTINGS.rival_log_odds
        if not is_rival or not 0 < abs(shift) <= SETTINGS.max_shift:
            yield rival
            continue
        moved = replace(best.hypothesis, outline=rival, rows=0, camera=best.context.camera)
        sampler = sample_columns(proposer.context(moved), n_columns)
        gain = _outer_evidence(replace(acquisition, sampler=sampler), -shift) - _outer_evidence(acquisition, shift)
        yield replace(rival, log_odds=rival.log_odds + SETTINGS.outer_weight * min(gain, 0.0))


def _columns_between(own: Outline, rival: Outline, n_columns: int) -> int:
    """Columns by which an outline begins further to the viewer's right than one's own."""
    side = own.corners[1] - own.corners[0]
    return round(float((rival.corners[0] - own.corners[0]) @ side / (side @ side)) * n_columns)


def _outer_evidence(acquisition: Acquisition, n: int) -> float:
    """Log-likelihood ratio of packets in the first `n` columns, or in the last `-n`."""
    read = slice(0, n + _BESIDE) if n > 0 else slice(n - _BESIDE, None)
    reception = initial_pass(acquisition.of_columns(read))
    outer = np.arange(n) if n > 0 else _BESIDE + np.arange(-n)
    return float(np.maximum(reception.column_llr[outer], 0.0).sum())
