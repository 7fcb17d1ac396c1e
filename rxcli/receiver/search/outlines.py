"""Outlines that the screen of a frame may have, and what is known of its columns' numbers once one was chosen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.receiver.cameras import known_lens
from rxcli.receiver.context import Failure, Outline, Timer
from rxcli.receiver.corners import (
    may_fill,
    outside_the_picture,
    reason_for_none,
    turned_pixels,
    unreadable_orientation,
    whole_picture,
)
from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.find import ColumnLayout, find_outlines
from rxcli.receiver.search.settings import SETTINGS
from rxcli.types import Frame


def proposed_outlines(frame: Frame, options: ReceiverOptions, timer: Timer) -> list[Outline] | Failure:
    """Outlines that the screen of a frame may have, at least one; or why there are none."""
    refused = unreadable_orientation(frame)
    if refused is not None:
        return refused
    if options.corners is not None:
        with timer("geometry"):
            return outside_the_picture(options.corners, frame) or [Outline(options.corners)]
    found = possible_outlines(frame, options, timer)
    if found:
        return found
    reason = turned_pixels(frame, layouts_of(options)) or reason_for_none(frame)  # Pixels may lie on their side.
    if "no_screen" in options.skip or not may_fill(frame):
        return Failure("no_screen", f"no screen found: {reason}")
    return [Outline(whole_picture(frame), inferred=geometry.SIDE_NAMES, column_offset=None)]


def possible_outlines(frame: Frame, options: ReceiverOptions, timer: Timer) -> list[Outline]:
    """Outlines that the finder proposes."""
    layouts = layouts_of(options)
    period = 1 if frame.mosaic is None else frame.mosaic.pattern.shape[1]
    with timer("geometry"):
        found = find_outlines(frame.pixels, layouts, mosaic_period=period, lens=known_lens(frame, options))
    alone = sum(not one.is_narrow for one in layouts) == 1
    outlines = [
        Outline(
            one.corners[0],
            inferred=one.unlit_sides,
            log_odds=one.log_odds,
            family=one.layout.n_columns,
            fills=one.fills,
            other_rows=one.corners[1:],
            n_columns=None if alone and not one.layout.is_narrow else one.layout.n_columns,
        )
        for one in found
    ]
    return [_as_viewed(one, frame.metadata.orientation) for one in outlines]


def layouts_of(options: ReceiverOptions) -> list[ColumnLayout]:
    """The columns that screens may have, few first."""
    layouts = {one.columns: ColumnLayout(one.columns, one.light_spread, one.aspect) for one in options.screens}
    return [layouts[n] for n in sorted(layouts)]


def _as_viewed(outline: Outline, orientation: int) -> Outline:
    """An outline with its corners in the viewer's order."""
    corners, *others = (geometry.viewer_order(one, orientation) for one in (outline.corners, *outline.other_rows))
    return replace(outline, corners=corners, other_rows=tuple(others))


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


def numbered(own: Outline, outlines: Sequence[Outline], evidence_of: Callable[[int], float | None]) -> Outline:
    """An outline with the probability that its columns are numbered as the screen's.

    Packets do not depend on which column is the first, so within a family the prior alone decides.

    Args:
        own: the outline that was chosen.
        outlines: all that were proposed.
        evidence_of: the most evidence seen under outlines of a family, None where none was scored.
    """
    evidence = {one.family: evidence_of(one.family) for one in outlines}
    known = {family: value for family, value in evidence.items() if value is not None}
    most = max(known.values(), default=0.0)
    lost = {family: max(most - value - SETTINGS.same_packets, 0.0) for family, value in known.items()}
    least = max(lost.values(), default=0.0)
    odds = np.array([one.log_odds - SETTINGS.temper * lost.get(one.family, least) for one in outlines])
    mine = own.log_odds - SETTINGS.temper * lost.get(own.family, least)
    certainty = 1 / float(np.exp(np.sort(odds) - mine).sum())
    return replace(
        own, certainty=certainty, column_offset=own.column_offset if certainty >= SETTINGS.sure_certainty else None
    )


def _left(outline: Outline) -> float:
    """How far right, for a viewer, an outline begins: of those that leave no light out the furthest begins in view."""
    along = outline.corners[1] - outline.corners[0]
    return float(outline.corners[0] @ along / np.linalg.norm(along))
