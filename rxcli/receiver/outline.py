"""Where the screen is: outlines that the finder proposes, and packets where these leave it open. Part of the wiring.

The finder gives the grid of the columns, which of them may be the screen's first, and on which rows the screen may lie.
Packets choose among the rows; what is left of doubt about the first column goes with the outline: a packet is right in
the right column only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile
from rxcli.receiver.cameras import known_lens
from rxcli.receiver.context import Failure, FrameContext, Timer
from rxcli.receiver.corners import (
    may_fill,
    outside_the_picture,
    reason_for_none,
    turned_pixels,
    unreadable_orientation,
    whole_picture,
)
from rxcli.receiver.reception import column_llr
from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.find import ColumnLayout, find_outlines
from rxcli.receiver.screen_choice import quick_look
from rxcli.receiver.settings import SETTINGS
from rxcli.receiver.still import initial_pass
from rxcli.receiver.unknown_camera import likely_camera
from rxcli.types import FloatArray, Frame


@dataclass(frozen=True, slots=True)
class Outline:
    """Where the screen is."""

    #: (4, 2) pixels of the stored picture, the viewer's top left first.
    corners: FloatArray
    #: Probability that its columns are numbered as the screen's.
    certainty: float = 1.0
    #: Sides of the stored picture that show no light.
    inferred: tuple[str, ...] = ()
    #: Column of the screen that is the first; None where that is not sure, or columns are counted from the left of what
    #: is seen.
    column_offset: int | None = 0
    log_odds: float = 0.0
    #: Outlines of one family are alike but for the first column.
    family: int = 0
    #: Whether light reaches to both ends of the picture.
    fills: bool = False
    #: Corners that it has with other rows, likeliest first.
    other_rows: tuple[FloatArray, ...] = ()
    #: Columns whose borders were found on it; None: not asked, or few, for which many may have been taken.
    n_columns: int | None = None

    @property
    def is_counted_from_left(self) -> bool:
        """Whether no side is in view that tells which column is the first."""
        return self.fills and self.column_offset is None and self.certainty < SETTINGS.likely_certainty

    @property
    def facts(self) -> dict[str, Any]:
        """What a result says of it, by the names of its fields."""
        return {
            "corners": self.corners,
            "column_certainty": self.certainty,
            "inferred_sides": self.inferred,
            "column_offset": self.column_offset,
        }


def with_columns(context: FrameContext, outline: Outline) -> FrameContext:
    """A frame with its camera and the screens that have the columns of an outline."""
    alike = tuple(screen for screen in context.screens if screen.columns == outline.n_columns)
    return replace(context, screens=alike) if alike and len(alike) < len(context.screens) else context


@dataclass(frozen=True, slots=True)
class Located:
    """An outline, and the camera where it had to be asked to tell the outline."""

    outline: Outline
    #: None: nobody asked.
    context: FrameContext | Failure | None = None


def find_outline(
    frame: Frame, options: ReceiverOptions, timer: Timer, known: FrameContext | None = None
) -> Outline | Failure:
    """The outline of the screen in a frame; for `known` see `locate`."""
    located = locate(frame, options, timer, known)
    return located if isinstance(located, Failure) else located.outline


def locate(
    frame: Frame, options: ReceiverOptions, timer: Timer, known: FrameContext | None = None
) -> Located | Failure:
    """The outline of the screen in a frame, and what was learned of the camera on the way.

    Args:
        frame: to be searched.
        options: of the receiver.
        timer: time is counted there.
        known: another frame of the same camera, which need not be asked again.
    """
    refused = unreadable_orientation(frame)
    if refused is not None:
        return refused
    if options.corners is not None:
        with timer("geometry"):
            return outside_the_picture(options.corners, frame) or Located(Outline(options.corners))
    candidates = possible_outlines(frame, options, timer)
    if len({one.family for one in candidates}) > 1 or any(one.other_rows for one in candidates):
        return _by_packets(frame, candidates, options, timer, known)
    if candidates:
        return Located(_likeliest(candidates))
    reason = turned_pixels(frame, layouts_of(options)) or reason_for_none(frame)  # Pixels may lie on their side.
    if "no_screen" in options.skip or not may_fill(frame):
        return Failure("no_screen", f"no screen found: {reason}")
    return Located(Outline(whole_picture(frame), inferred=geometry.SIDE_NAMES, column_offset=None))


def possible_outlines(frame: Frame, options: ReceiverOptions, timer: Timer) -> list[Outline]:
    """Outlines that the screen may have, likeliest first."""
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


def _by_packets(
    frame: Frame,
    candidates: list[Outline],
    options: ReceiverOptions,
    timer: Timer,
    known: FrameContext | None = None,
) -> Located:
    """The likeliest candidate by what they were worth before and by how much their columns look like packets."""
    context: FrameContext | Failure
    if known is not None:
        context = replace(known, frame=frame, timer=timer)
    else:
        context = likely_camera(frame, candidates[0].corners, options, timer)
    if isinstance(context, Failure):
        return Located(_likeliest(candidates), context)
    if len({one.n_columns for one in candidates}) == 1:
        context = with_columns(context, candidates[0])
    candidates, packets, looked_at = _with_likely_rows(context, candidates)
    # Without a column more or less the same packets are seen: those of a family have theirs in common.
    lost = {family: max(max(packets.values()) - own - SETTINGS.same_packets, 0) for family, own in packets.items()}
    least = max(lost.values())
    odds = [one.log_odds - SETTINGS.packets_count * lost.get(one.family, least) for one in candidates]
    best = _likeliest([replace(one, log_odds=score) for one, score in zip(candidates, odds, strict=True)])
    chosen = replace(context, corners=best.corners)
    for other in looked_at:
        if other.corners is best.corners:
            chosen.kept.update(other.kept)
    return Located(best, chosen)


def _with_likely_rows(
    context: FrameContext, candidates: list[Outline]
) -> tuple[list[Outline], dict[int, float], list[FrameContext]]:
    """The candidates, each family with the rows under which most packets show; how many these are, nats; all looks."""
    families: dict[int, Outline] = {}
    for one in candidates:
        families.setdefault(one.family, one)
    corners = {family: (one.corners, *one.other_rows) for family, one in families.items()}
    # Every family has a first look, then the likeliest ones with other rows.
    looks = [
        (family, rows) for rows in range(SETTINGS.most_looks) for family in families if rows < len(corners[family])
    ]
    looks.sort(key=lambda look: look[1] > 0)
    packets: dict[int, float] = {}
    rows_of: dict[int, int] = {}
    looked_at: list[FrameContext] = []
    screens = context.screens
    for family, rows in looks[: SETTINGS.most_looks]:
        there = corners[family][rows]
        if there is not context.corners or screens is not context.screens:
            there_context = replace(context, corners=there, screens=screens)
        else:
            there_context = context
        looked_at.append(there_context)
        shown = _packets(there_context)
        if shown > packets.get(family, -1.0) + (SETTINGS.better_rows if rows else 0):
            packets[family], rows_of[family] = shown, rows
        if shown > SETTINGS.plain_packets:
            # Whatever the outline, the screen sends at one rate.
            screens = _screens_shown(there_context)
    moved = [
        replace(one, corners=(one.corners, *one.other_rows)[rows_of.get(one.family, 0)], other_rows=())
        for one in candidates
    ]
    return moved, packets, looked_at


def _screens_shown(context: FrameContext) -> tuple[ScreenProfile, ...]:
    """The screens that a quick look leaves."""
    acquisition = quick_look(context)
    return context.screens if isinstance(acquisition, Failure) else acquisition.variants or (acquisition.screen,)


def _likeliest(candidates: list[Outline]) -> Outline:
    """The likeliest candidate, with what is left of doubt."""
    odds = np.array([one.log_odds for one in candidates])
    share = np.exp(odds - odds.max())
    best = candidates[int(share.argmax())]
    certainty = float(1 / share.sum())
    if certainty >= SETTINGS.sure_certainty:
        return replace(best, certainty=certainty)
    if best.fills and certainty < SETTINGS.likely_certainty:
        alike = [
            one
            for one in candidates
            if one.family == best.family and one.log_odds > best.log_odds - SETTINGS.may_be_log_odds
        ]
        best = max(alike, key=_leftmost)
    return replace(best, certainty=certainty, column_offset=None)


def _leftmost(outline: Outline) -> float:
    """How far right, for a viewer, an outline begins: of those that leave no light out the furthest begins in view."""
    along = outline.corners[1] - outline.corners[0]
    return float(outline.corners[0] @ along / np.linalg.norm(along))


def _packets(context: FrameContext) -> float:
    """How much the columns of an outline look like packets, nats."""
    acquisition = quick_look(context)
    if isinstance(acquisition, Failure):
        return 0.0
    with context.timer("detect"):
        reception = initial_pass(acquisition)
        # Columns without light say next to nothing, but not the same of every outline.
        headers = reception.posteriors.header_llr.sum(axis=0)
        by_column = column_llr(reception) + np.maximum(headers, 0)
    # Where light is weak or a frame shows little more than a packet, headers come through before symbols do.
    return float(
        np.maximum(by_column - SETTINGS.no_light_nats, 0).sum() + SETTINGS.headers_alone * max(headers.sum(), 0.0)
    )
