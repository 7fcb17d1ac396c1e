"""How sure the number of the first column is, by the packets of the outermost columns.

Outlines of one family share all columns but the outermost. A column of the screen has packets, one beyond it has none.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from rxcli.receiver.frame.passes import Reception
from rxcli.receiver.screen.geometry import picture_to_screen
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.search import evidence
from rxcli.receiver.search.hypothesis import Scored
from rxcli.receiver.search.propose import Proposer
from rxcli.receiver.search.settings import SETTINGS
from rxcli.receiver.still import initial_pass

#: Neighbours further in that show whether columns of the screen would have packets; they are read with them.
_BESIDE = 2
#: Limit of weighted evidence.
_MAX_SHOWN = 30.0


def rated_by_packets(best: Scored, outlines: Sequence[Outline], proposer: Proposer) -> list[Outline]:
    """The outlines, with their log-odds by what those columns show that not all of them have.

    On each side the nearest outline is read, unless a packet shows that the columns exist which it leaves out.

    Args:
        best: the hypothesis that was chosen.
        outlines: all that were proposed.
        proposer: of the frame.
    """
    own, n_columns, out = best.hypothesis.outline, best.hypothesis.screen.columns, list(outlines)
    acquisition = replace(best.acquisition, clock=best.reception.clock)
    shifts = [_columns_between(own, rival, n_columns) if rival.family == own.family else 0 for rival in outlines]
    for side in (-1, 1):
        rivals = [index for index, shift in enumerate(shifts) if shift * side > 0]
        if not rivals:
            continue
        nearest = min(rivals, key=lambda index: abs(shifts[index]))
        gained, n = 0.0, shifts[nearest]
        if _existence(best.reception, n) <= 0:
            moved = replace(best.hypothesis, outline=outlines[nearest], camera=best.context.camera)
            profiles = proposer.context(moved).sample_columns(n_columns)
            read = slice(-n - _BESIDE - 1, None) if n > 0 else slice(0, -n + _BESIDE + 1)
            columns = np.arange(n_columns)[read]
            gained = _existence(initial_pass(replace(acquisition, profiles=profiles).of_columns(columns)), -n)
        for index in rivals:
            log_odds = outlines[index].log_odds + gained - _existence(best.reception, shifts[index])
            out[index] = replace(outlines[index], log_odds=log_odds)
    return out


def _existence(reception: Reception, n: int) -> float:
    """Log-likelihood ratio that the first `n` columns of a reception, or the last `-n`, are columns of the screen.

    Beyond the screen there is no packet but that of a neighbour, whose light spreads. Within it there are packets, or
    there are none because it is dark, by the rule of succession from the columns beside. What is out of the picture
    counts for neither.
    """
    shown = SETTINGS.outer_weight * np.maximum(reception.posteriors.log_evidence, 0.0)
    repeated, in_view = evidence.repeated_share(reception), np.asarray(reception.n_observed.any(axis=(0, 2)))
    if n < 0:
        n, shown, repeated, in_view = -n, shown[::-1], repeated[::-1], in_view[::-1]
    if not in_view[:n].any():
        return 0.0
    shown = shown[:-1] * (1 - repeated / evidence.REPEATED).clip(0, 1)
    with_packets = (np.count_nonzero(shown[n : n + _BESIDE] > 1) + 1) / (_BESIDE + 2)
    return float(np.log1p(with_packets * (np.expm1(min(shown[:n].sum(), _MAX_SHOWN)) - 1)))


def numbered(own: Outline, outlines: Sequence[Outline], score_of: Callable[[int], float | None]) -> Outline:
    """An outline with the probability that its columns are numbered as the screen's.

    Packets do not depend on which column is the first: within a family only the log-odds decide, between families the
    scores as well. An outline with the same columns, as of a film between bars, numbers them equally.

    Args:
        own: the outline that was chosen.
        outlines: all that were proposed.
        score_of: the best score under outlines of a family, without their log-odds, or None if none was tried.
    """
    likeliest = {outline.family: outline for outline in sorted(outlines, key=lambda outline: outline.log_odds)}
    scores = {own.family: score_of(own.family) or 0.0}
    for family, rival in likeliest.items():
        score = score_of(family)
        if family != own.family and score is not None and not _has_columns_of(own, rival):
            scores[family] = score
    odds = [outline.log_odds + scores[outline.family] for outline in outlines if outline.family in scores]
    certainty = own.certainty / float(np.exp(np.sort(odds) - own.log_odds - scores[own.family]).sum())
    is_sure = certainty >= SETTINGS.sure_certainty
    return replace(own, certainty=certainty, column_offset=own.column_offset if is_sure else None)


def _has_columns_of(own: Outline, rival: Outline) -> bool:
    """Whether a rival's columns are where one's own are, on whatever rows."""
    off = picture_to_screen(rival.corners, own.corners, None)[:, 0] - [0, 1, 1, 0]
    return rival.n_columns in (None, own.n_columns) and bool(np.abs(off).max() < SETTINGS.same_sides)


def _columns_between(own: Outline, rival: Outline, n_columns: int) -> int:
    """Columns by which an outline begins further to the viewer's right than one's own."""
    side = own.corners[1] - own.corners[0]
    return round(float((rival.corners[0] - own.corners[0]) @ side / (side @ side)) * n_columns)
