"""Number the columns of a screen: packets do not depend on the first column, so the outlines' prior decides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from rxcli.receiver.context import Outline
from rxcli.receiver.search.settings import SETTINGS


def likeliest_of_family(outlines: Sequence[Outline]) -> Outline:
    """The likeliest outline of a family, under which its packets are sought.

    If no numbering is likely, columns are counted from the left of the visible part.
    """
    odds = np.array([outline.log_odds for outline in outlines])
    best = max(outlines, key=lambda outline: (outline.log_odds, -_left(outline)))
    share = 1 / float(np.exp(odds - odds.max()).sum())
    if best.fills and share < SETTINGS.likely_certainty:
        possible = (outline for outline in outlines if outline.log_odds > best.log_odds - SETTINGS.may_be_log_odds)
        return max(possible, key=_left)
    return best


def numbered(own: Outline, outlines: Sequence[Outline], score_of: Callable[[int], float | None]) -> Outline:
    """An outline with the probability that its columns are numbered as the screen's.

    Packets do not depend on which column is the first, so within a family the prior alone decides; between families
    the scores do.

    Args:
        own: the outline that was chosen.
        outlines: all that were proposed.
        score_of: the best score under outlines of a family, or None if none was tried.
    """
    family_odds = np.array([outline.log_odds for outline in outlines if outline.family == own.family])
    families = {outline.family for outline in outlines}
    scores = np.array([score for family in families if (score := score_of(family)) is not None])
    mine = score_of(own.family)
    certainty = own.certainty / float(np.exp(np.sort(family_odds) - own.log_odds).sum())
    if mine is not None:
        certainty /= float(np.exp(np.sort(scores) - mine).sum())
    return replace(
        own, certainty=certainty, column_offset=own.column_offset if certainty >= SETTINGS.sure_certainty else None
    )


def _left(outline: Outline) -> float:
    """Position of an outline's left side along its top, for a viewer: larger is further right."""
    along = outline.corners[1] - outline.corners[0]
    return float(outline.corners[0] @ along / np.linalg.norm(along))
