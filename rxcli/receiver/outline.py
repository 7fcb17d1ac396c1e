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
from rxcli.profiles import ScreenProfile
from rxcli.receiver.cameras import known_lens
from rxcli.receiver.context import Failure, FrameContext, Timer
from rxcli.receiver.corners import (
    levels_of,
    may_fill,
    outside_the_picture,
    turned_pixels,
    unreadable_orientation,
    whole_picture,
)
from rxcli.receiver.reception import column_llr
from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.sides import LEFT, RIGHT, SIDE_NAMES
from rxcli.receiver.screen_choice import quick_look
from rxcli.receiver.settings import SETTINGS
from rxcli.receiver.still import initial_pass
from rxcli.receiver.unknown_camera import likely_camera
from rxcli.types import FloatArray, Frame, Lens

if TYPE_CHECKING:
    from rxcli.receiver.screen.columns import ColumnLayout, ColumnSearch
    from rxcli.receiver.screen.find import ScreenSearch
    from rxcli.receiver.screen.numbering import Numbering


@dataclass(frozen=True, slots=True)
class Outline:
    """Where the screen is."""

    #: (4, 2) pixels of the stored picture, the viewer's top left first.
    corners: FloatArray
    #: Probability that its columns are numbered as the screen's.
    certainty: float = 1.0
    #: Sides of the stored picture that were inferred, not seen.
    inferred: tuple[str, ...] = ()
    #: Column of the screen that is the first; None where that is not sure, or columns are counted from the left of what
    #: is seen.
    column_offset: int | None = 0
    log_odds: float = 0.0
    #: The most that its certainty may be.
    trust: float = 1.0
    #: Whether nothing but the grid says that there is a screen.
    by_grid_alone: bool = False
    #: Outlines of one family are alike but for the first column.
    family: int = 0
    #: Whether light reaches to both ends of the picture.
    fills: bool = False
    #: Corners that it has with other rows, likeliest first.
    other_rows: tuple[FloatArray, ...] = ()
    #: Columns whose borders were found on it, many of them; None: not asked, or few, of which many may have been taken.
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
    frame: Frame,
    options: ReceiverOptions,
    timer: Timer,
    known: FrameContext | None = None,
    *,
    by_columns: bool = True,
) -> Located | Failure:
    """The outline of the screen in a frame, and what was learned of the camera on the way.

    Args:
        frame: to be searched.
        options: of the receiver.
        timer: time is counted there.
        known: another frame of the same camera, which need not be asked again.
        by_columns: search for columns where the sides do not tell, which takes most of the time.
    """
    refused = unreadable_orientation(frame)
    if refused is not None:
        return refused
    if options.corners is not None:
        with timer("geometry"):
            return outside_the_picture(options.corners, frame) or Located(Outline(options.corners))
    candidates, reason = possible_outlines(frame, options, timer, by_columns=by_columns)
    best = _likeliest(candidates[:1])
    located = Located(best) if best else None
    if len(candidates) > 1 or (candidates and candidates[0].by_grid_alone):
        located = _by_packets(frame, candidates, options, timer, known)
    if located:
        return located
    reason = turned_pixels(frame) or reason  # Pixels may lie on their side.
    if "no_screen" in options.skip or not may_fill(frame):
        return Failure("no_screen", f"no screen found: {reason}")
    return Located(Outline(whole_picture(frame), inferred=SIDE_NAMES, column_offset=None))


def possible_outlines(
    frame: Frame, options: ReceiverOptions, timer: Timer, *, by_columns: bool = True
) -> tuple[list[Outline], str]:
    """Outlines that the screen may have, likeliest first; why there are none, and what to do; see `locate`."""
    from rxcli.receiver.screen.columns import ColumnLayout, ColumnSearch, find_columns
    from rxcli.receiver.screen.find import find_screen

    levels = levels_of(frame)
    with timer("geometry"):
        sides = find_screen(frame.pixels, **levels)
        layouts = {one.columns: ColumnLayout(one.columns, one.light_spread, one.aspect) for one in options.screens}
        layout = layouts[min(layouts)]
        period, lens = int(levels.get("mosaic_period", 1)), known_lens(frame, options)
        found = _by_sides(frame, sides, [layouts[n] for n in sorted(layouts)], period, lens)
        if not found:
            columns = ColumnSearch(None, (), layout)
            if by_columns:
                all_layouts = [layouts[n] for n in sorted(layouts)]
                columns = find_columns(frame.pixels, *all_layouts, mosaic_period=period, lens=lens, lines=sides.lines)
                layout = columns.layout
            found = _joined(sides, columns.numberings, layout)
            # Sides that no grid bears out may be a column off like any others.
            unsure = [replace(one, log_odds=0.0) for one in found if not columns.numberings or one.family < 0]
            if unsure:
                shifted = _with_shifts(frame, unsure, sides, layout, period, lens)
                less = SETTINGS.contradicted_log_odds if columns.numberings else 0.0
                rest = [one for one in found if one.family >= 0] if columns.numberings else []
                trust = _trust_in_sides(columns)
                found = rest + [replace(one, log_odds=one.log_odds + less, trust=trust) for one in shifted]
                found.sort(key=lambda one: -one.log_odds)
    return [_as_viewed(one, frame.metadata.orientation) for one in found], f"{sides.reason}; {sides.advice}"


def _trust_in_sides(columns: ColumnSearch) -> float:
    """How sure the columns' numbers can be between sides that no grid of columns bears out."""
    return 1.0 if columns.coherence is None else SETTINGS.trust_in_sides_alone  # None: nobody asked.


def _as_viewed(outline: Outline, orientation: int) -> Outline:
    """An outline with its corners in the viewer's order."""
    corners, *others = (geometry.viewer_order(one, orientation) for one in (outline.corners, *outline.other_rows))
    return replace(outline, corners=corners, other_rows=tuple(others))


def _by_sides(
    frame: Frame, sides: ScreenSearch, layouts: list[ColumnLayout], period: int, lens: Lens | None
) -> list[Outline]:
    """The outline by the sides, where the borders of the columns stand between them as they should."""
    from rxcli.receiver.screen.agreement import sides_agree

    if sides.corners is None:
        return []
    # A part of the rows tells most of the time.
    for part in SETTINGS.row_parts:
        for layout in layouts:
            if sides_agree(frame.pixels, sides.corners, layout, mosaic_period=period, lens=lens, part=part):
                n_columns = layout.n_columns if layout.is_narrow else None
                own = Outline(sides.corners, inferred=sides.inferred, n_columns=n_columns)
                return _with_shifts(frame, [own], sides, layout, period, lens)
    return []


def _both_show(sides: ScreenSearch) -> bool:
    """Whether left and right were seen both: then columns that fit between them are all there are."""
    shown = sum(sides.lines[number].support for number in (LEFT, RIGHT))
    return shown >= SETTINGS.both_show and not {"left", "right"} & set(sides.inferred)


def _with_shifts(
    frame: Frame, outlines: list[Outline], sides: ScreenSearch, layout: ColumnLayout, period: int, lens: Lens | None
) -> list[Outline]:
    """The outline by the sides, and where they leave it open those with another first column.

    The borders of columns are where they are with each of them, and the packets are the same.
    """
    if not outlines or _both_show(sides):
        return outlines
    from rxcli.receiver.screen.coherence import N_STRIPS, measure_coherence
    from rxcli.receiver.screen.grid import grid_between
    from rxcli.receiver.screen.numbering import LEAST_ODDS, first_columns, light_profile
    from rxcli.receiver.screen.waveforms import StripLight

    own = outlines[0]
    grid = grid_between(own.corners, layout.n_columns, (frame.width, frame.height), lens)
    n_strips = max(N_STRIPS, round(SETTINGS.strips_a_column * frame.width / grid.pitch_px))
    coherence = measure_coherence(frame.pixels, mosaic_period=period, n_strips=n_strips)
    strips = StripLight.of(coherence, layout.sigma, lens)
    start = first_columns(light_profile(strips, grid), grid, layout.n_columns, sides.lines, layout.aspect)
    shifted = [
        _moved(replace(own, fills=start.fills), int(first), float(odds), layout.n_columns, lens)
        for first, odds in zip(start.first, start.log_odds, strict=True)
        if odds > LEAST_ODDS
    ]
    return _without_hopeless(shifted)


def _moved(own: Outline, columns: int, log_odds: float, n_columns: int, lens: Lens | None) -> Outline:
    """An outline some columns further to the right, of the same rows."""
    if not columns:
        return replace(own, log_odds=log_odds)
    unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) + np.array([columns / n_columns, 0.0])
    corners = geometry.screen_to_picture(unit, own.corners, lens)
    inferred = tuple(side for side in SIDE_NAMES if side in (*own.inferred, "left", "right"))
    return replace(own, corners=corners, inferred=inferred, log_odds=log_odds)


def _without_hopeless(outlines: list[Outline]) -> list[Outline]:
    """Outlines, likeliest first; the first alone where it is beyond doubt."""
    outlines = sorted(outlines, key=lambda one: -one.log_odds)
    clear = len(outlines) == 1 or outlines[1].log_odds < outlines[0].log_odds - SETTINGS.clear_log_odds
    return outlines[:1] if clear else outlines


def _joined(sides: ScreenSearch, numberings: tuple[Numbering, ...], layout: ColumnLayout) -> list[Outline]:
    """Outlines by the sides and by grids, likeliest first."""
    by_sides = None if sides.corners is None else Outline(sides.corners, inferred=sides.inferred)
    if not numberings:
        return [by_sides] if by_sides else []
    outlines, agreed, alone = [], False, by_sides is None
    families: dict[bytes, int] = {}
    for numbering in numberings:
        own = Outline(
            numbering.corners[0],
            inferred=SIDE_NAMES,
            other_rows=numbering.corners[1:],
            log_odds=_odds_of(numbering, numberings),
            fills=numbering.fills,
            by_grid_alone=alone,
            family=families.setdefault(numbering.grid.numbers[1:].tobytes(), len(families)),
            n_columns=layout.n_columns if layout.is_narrow else None,
        )
        if by_sides and _agree(by_sides.corners, numbering, layout.n_columns):
            agreed = True
            odds = own.log_odds + _bonus(by_sides)
            own = replace(by_sides, log_odds=odds, family=own.family, n_columns=own.n_columns)
        outlines.append(own)
    if by_sides and not agreed:
        outlines.append(replace(by_sides, log_odds=SETTINGS.contradicted_log_odds, family=-1))
    return _without_hopeless(outlines)


def _bonus(by_sides: Outline) -> float:
    """Log-odds that sides add to the numbering that they agree with."""
    if {"left", "right"} & set(by_sides.inferred):
        return 0.0
    return SETTINGS.inferred_log_odds if by_sides.inferred else SETTINGS.confirmed_log_odds


def _odds_of(numbering: Numbering, numberings: tuple[Numbering, ...]) -> float:
    """Log-odds of a numbering, grids that explain less counting less."""
    less = max(one.grid.likelihood for one in numberings) - numbering.grid.likelihood
    by_drive = numbering.grid.drive_odds
    return numbering.log_odds + (-SETTINGS.likelihood_counts * less if by_drive is None else by_drive)


def _agree(corners: FloatArray, numbering: Numbering, n_columns: int) -> bool:
    """Whether sides say the same of the columns as a grid."""
    u, v = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0.1, 0.9, 5), indexing="ij")
    points = geometry.screen_to_picture(np.stack([u, v], axis=-1), corners, numbering.grid.lens)
    apart = np.abs(numbering.grid.columns_at(points) - n_columns * u)
    return bool(apart.mean() < SETTINGS.sides_agree and apart.max() < SETTINGS.sides_agree_anywhere)


def _by_packets(
    frame: Frame,
    candidates: list[Outline],
    options: ReceiverOptions,
    timer: Timer,
    known: FrameContext | None = None,
) -> Located | None:
    """The likeliest candidate by what they were worth before and by how much their columns look like packets."""
    context: FrameContext | Failure
    if known is not None:
        context = replace(known, frame=frame, timer=timer)
    else:
        context = likely_camera(frame, candidates[0].corners, options, timer)
    if isinstance(context, Failure):
        best = _likeliest([one for one in candidates if not one.by_grid_alone])
        return Located(best, context) if best else None
    if len({one.n_columns for one in candidates}) == 1:
        context = with_columns(context, candidates[0])
    candidates, packets, looked_at = _with_likely_rows(context, candidates)
    if max(packets.values()) < SETTINGS.some_packets:
        best = _likeliest([one for one in candidates if not one.by_grid_alone])
    else:
        # Without a column more or less the same packets are seen: those of a family have theirs in common.
        lost = {family: max(max(packets.values()) - own - SETTINGS.same_packets, 0) for family, own in packets.items()}
        least = max(lost.values())
        odds = [one.log_odds - SETTINGS.packets_count * lost.get(one.family, least) for one in candidates]
        best = _likeliest([replace(one, log_odds=score) for one, score in zip(candidates, odds, strict=True)])
    if best is None:
        return None
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


def _likeliest(candidates: list[Outline]) -> Outline | None:
    """The likeliest candidate, with what is left of doubt."""
    if not candidates:
        return None
    odds = np.array([one.log_odds for one in candidates])
    share = np.exp(odds - odds.max())
    best = candidates[int(share.argmax())]
    certainty = min(float(1 / share.sum()), best.trust)
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
