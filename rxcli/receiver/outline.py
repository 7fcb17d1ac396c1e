"""Where the screen is: its sides, the grid of its columns, and packets where these leave it open. Part of the wiring.

Two searches look at a picture. The sides are found where stripes begin and end; the grid by how alike neighbouring
strips are, which needs no side. Where all sides agree with the grid, the sides are it. Otherwise every outline that may
be is a candidate, and the one under which most packets show is it. What is left of doubt goes with it: a packet is
right in the right column only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.receiver.acquisition import sample_columns
from rxcli.receiver.cameras import known_lens
from rxcli.receiver.context import Failure, FrameContext, Timer
from rxcli.receiver.corners import (
    levels_of,
    outside_the_picture,
    turned_pixels,
    unreadable_orientation,
    whole_picture,
)
from rxcli.receiver.screen import geometry
from rxcli.receiver.screen_choice import acquire
from rxcli.receiver.still import column_llr, initial_pass
from rxcli.receiver.unknown_camera import likely_camera
from rxcli.types import FloatArray, Frame, Lens

if TYPE_CHECKING:
    from rxcli.receiver.screen.columns import ColumnLayout
    from rxcli.receiver.screen.find import ScreenSearch
    from rxcli.receiver.screen.numbering import Numbering

SIDE_NAMES = ("top", "right", "bottom", "left")
#: Shares of the rows, one of so many, by which sides are held against the columns' borders.
_PARTS = (3, 1)
#: Sides agree with a grid where columns differ less than this on average and anywhere, columns.
_AGREE, _AGREE_ANYWHERE = 0.12, 0.45
#: Log-odds of an outline by sides that contradict the grid; what sides that agree with a numbering add to it; what
#: sides add that were found for one side less.
_CONTRADICTED, _CONFIRMED, _INFERRED = -3.0, 4.0, 1.0
#: What a grid's waveforms explain less counts so much: strips err together.
_EXPLAINED_COUNTS = 0.05
#: Log-odds by which an outline must lead so that packets are not asked.
_CLEAR = 6.0
#: What packets say counts so much: the light model is surer than it should be. At most so many outlines are received.
_PACKETS_COUNT, _MOST_LOOKS = 0.08, 6
#: Outlines whose packets differ by less than this, nats, show the same; and the certainty from which one is likely.
_SAME_PACKETS, _LIKELY = 40.0, 0.5
#: Columns that look less like packets than this have no light, nats.
_NO_LIGHT = 25.0
#: Packets that must show where nothing but the grid says that there is a screen, nats.
_SOME_PACKETS = 40.0


@dataclass(frozen=True, slots=True)
class Outline:
    """Where the screen is."""

    #: (4, 2) pixels of the stored picture, the viewer's top left first.
    corners: FloatArray
    #: Probability that its columns are numbered as the screen's.
    certainty: float = 1.0
    #: Sides of the stored picture that were inferred, not seen.
    inferred: tuple[str, ...] = ()
    #: Column of the screen that is the first; None where columns are counted from the left of what is seen.
    column_offset: int | None = 0
    log_odds: float = 0.0
    #: Whether nothing but the grid says that there is a screen.
    by_grid_alone: bool = False

    @property
    def facts(self) -> dict[str, Any]:
        """What a result says of it, by the names of its fields."""
        return {
            "corners": self.corners,
            "column_certainty": self.certainty,
            "inferred_sides": self.inferred,
            "column_offset": self.column_offset,
        }


def find_outline(frame: Frame, options: ReceiverOptions, timer: Timer) -> Outline | Failure:
    """The outline of the screen in a frame."""
    refused = unreadable_orientation(frame)
    if refused is not None:
        return refused
    if options.corners is not None:
        with timer("geometry"):
            return outside_the_picture(options.corners, frame) or Outline(options.corners)
    candidates, reason = possible_outlines(frame, options, timer)
    if len(candidates) > 1 or (candidates and candidates[0].by_grid_alone):
        candidates = _by_packets(frame, candidates, options, timer)
    if candidates:
        return candidates[0]
    if "no_screen" in options.skip:
        return Failure("no_screen", f"no screen found: {reason}")
    return Outline(whole_picture(frame), inferred=SIDE_NAMES, column_offset=None)


def possible_outlines(frame: Frame, options: ReceiverOptions, timer: Timer) -> tuple[list[Outline], str]:
    """Outlines that the screen may have, likeliest first; why there are none, and what to do."""
    from rxcli.receiver.screen.columns import ColumnLayout, find_columns
    from rxcli.receiver.screen.find import find_screen

    levels = levels_of(frame)
    with timer("geometry"):
        sides = find_screen(frame.pixels, **levels)
        if sides.corners is None and (turned := turned_pixels(frame)):
            return [], turned
        by_columns = {one.columns: ColumnLayout(one.columns, one.light_spread, one.aspect) for one in options.screens}
        layout = by_columns[min(by_columns)]
        period, lens = int(levels.get("mosaic_period", 1)), known_lens(frame, options)
        found = _by_sides(frame, sides, [by_columns[n] for n in sorted(by_columns)], period, lens)
        if not found:
            columns = find_columns(frame.pixels, layout, mosaic_period=period, lens=lens, lines=sides.lines)
            found = _joined(sides, columns.numberings, layout.n_columns)
    orientation = frame.metadata.orientation
    return [
        replace(one, corners=geometry.viewer_order(one.corners, orientation)) for one in found
    ], f"{sides.reason}; {sides.advice}"


def _by_sides(
    frame: Frame, sides: ScreenSearch, layouts: list[ColumnLayout], period: int, lens: Lens | None
) -> list[Outline]:
    """The outline by the sides, where the borders of the columns stand between them as they should."""
    from rxcli.receiver.screen.agreement import sides_agree

    if sides.corners is None:
        return []
    # A part of the rows tells most of the time.
    for part in _PARTS:
        for layout in layouts:
            if sides_agree(frame.pixels, sides.corners, layout, mosaic_period=period, lens=lens, part=part):
                return [Outline(sides.corners, inferred=sides.inferred)]
    return []


def _joined(sides: ScreenSearch, numberings: tuple[Numbering, ...], n_columns: int) -> list[Outline]:
    """Outlines by the sides and by grids, likeliest first."""
    by_sides = None if sides.corners is None else Outline(sides.corners, inferred=sides.inferred)
    if not numberings:
        return [by_sides] if by_sides else []
    outlines, agreed, alone = [], False, by_sides is None
    for numbering in numberings:
        own = Outline(
            numbering.corners, inferred=SIDE_NAMES, log_odds=_odds_of(numbering, numberings), by_grid_alone=alone
        )
        if by_sides and _agree(by_sides.corners, numbering, n_columns):
            agreed = True
            bonus = _INFERRED if by_sides.inferred else _CONFIRMED
            own = replace(by_sides, log_odds=own.log_odds + bonus)
        outlines.append(own)
    if by_sides and not agreed:
        outlines.append(replace(by_sides, log_odds=_CONTRADICTED))
    outlines.sort(key=lambda one: -one.log_odds)
    clear = len(outlines) == 1 or outlines[1].log_odds < outlines[0].log_odds - _CLEAR
    return outlines[:1] if clear else outlines


def _odds_of(numbering: Numbering, numberings: tuple[Numbering, ...]) -> float:
    """Log-odds of a numbering, grids that explain less counting less."""
    best = max(one.grid.explained for one in numberings)
    return numbering.log_odds - _EXPLAINED_COUNTS * (best - numbering.grid.explained)


def _agree(corners: FloatArray, numbering: Numbering, n_columns: int) -> bool:
    """Whether sides say the same of the columns as a grid."""
    u, v = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0.1, 0.9, 5), indexing="ij")
    points = geometry.screen_to_picture(np.stack([u, v], axis=-1), corners, numbering.grid.lens)
    apart = np.abs(numbering.grid.columns_at(points) - n_columns * u)
    return bool(apart.mean() < _AGREE and apart.max() < _AGREE_ANYWHERE)


def _by_packets(frame: Frame, candidates: list[Outline], options: ReceiverOptions, timer: Timer) -> list[Outline]:
    """Candidates by what they were worth before and by how much their columns look like packets."""
    context = _context_of_any(frame, candidates, options, timer)
    if context is None:
        return [one for one in candidates if not one.by_grid_alone]
    packets = np.array([_packets(replace(context, corners=one.corners)) for one in candidates[:_MOST_LOOKS]])
    if packets.max() < _SOME_PACKETS:
        return [one for one in candidates if not one.by_grid_alone]
    # Without a column more or less the same packets are seen a little better or worse, by chance.
    lost = np.maximum(packets.max() - packets - _SAME_PACKETS, 0)
    # Those that nobody looked at may show as many.
    odds = np.array([one.log_odds for one in candidates])
    odds[: lost.size] -= _PACKETS_COUNT * lost
    share = np.exp(odds - odds.max())
    share /= share.sum()
    judged = [
        replace(one, log_odds=float(score), certainty=float(p), column_offset=0 if p >= _LIKELY else None)
        for one, score, p in zip(candidates, odds, share, strict=True)
    ]
    return sorted(judged, key=lambda one: -one.certainty)


def _context_of_any(
    frame: Frame, candidates: list[Outline], options: ReceiverOptions, timer: Timer
) -> FrameContext | None:
    """The camera by the first candidate that shows one: it hardly depends on which columns are whose."""
    for candidate in candidates:
        context = likely_camera(frame, candidate.corners, options, timer)
        if not isinstance(context, Failure):
            return context
    return None


def _packets(context: FrameContext) -> float:
    """How much the columns of an outline look like packets, nats."""
    acquisition = acquire(context, sample_columns(context, context.n_columns, quick=True))
    if isinstance(acquisition, Failure):
        return 0.0
    with context.timer("detect"):
        reception = initial_pass(acquisition)
        # Columns without light say next to nothing, but not the same of every outline.
        by_column = column_llr(reception) + np.maximum(reception.posteriors.header_llr.sum(axis=0), 0)
    return float(np.maximum(by_column - _NO_LIGHT, 0).sum())
