"""Which column is the first: packets do not tell, so the prior of the outlines decides, and says how sure it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from rxcli.receiver.context import Outline
from rxcli.receiver.search.settings import SETTINGS


def likeliest_of_family(outlines: Sequence[Outline]) -> Outline:
    """The outline of a family under which its packets are sought: the likeliest.

    Where no number is likely, columns are counted from the left of what is seen.
    """
    odds = np.array([one.log_odds for one in outlines])
    best = max(outlines, key=lambda one: (one.log_odds, -_left(one)))
    share = 1 / float(np.exp(odds - odds.max()).sum())
    if best.fills and share < SETTINGS.likely_certainty:
        return max((one for one in outlines if one.log_odds > best.log_odds - SETTINGS.may_be_log_odds), key=_left)
    return best


def numbered(own: Outline, outlines: Sequence[Outline], score_of: Callable[[int], float | None]) -> Outline:
    """An outline with the probability that its columns are numbered as the screen's.

    Packets do not depend on which column is the first, so within a family the prior alone decides; between families
    the scores do.

    Args:
        own: the outline that was chosen.
        outlines: all that were proposed.
        score_of: the best score under outlines of a family, None where none was near enough to be tried.
    """
    alike = np.array([one.log_odds for one in outlines if one.family == own.family])
    scores = np.array([score for family in {one.family for one in outlines} if (score := score_of(family)) is not None])
    mine = score_of(own.family)
    certainty = 1 / float(np.exp(np.sort(alike) - own.log_odds).sum())
    if mine is not None:
        certainty /= float(np.exp(np.sort(scores) - mine).sum())
    return replace(
        own, certainty=certainty, column_offset=own.column_offset if certainty >= SETTINGS.sure_certainty else None
    )


def _left(outline: Outline) -> float:
    """How far right, for a viewer, an outline begins: of those that leave no light out the furthest begins in view."""
    along = outline.corners[1] - outline.corners[0]
    return float(outline.corners[0] @ along / np.linalg.norm(along))
