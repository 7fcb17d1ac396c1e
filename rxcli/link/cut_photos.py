"""Photographs of a text that show packets in part: which of its symbols each shows is found with the text itself."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rxcli.link.beacons import gathered, read_beacons
from rxcli.link.known_bits import known_bits
from rxcli.link.layout import BEACON_LENGTHS, BeaconLayout, beacon_layout
from rxcli.link.placement import Found, Placement, possible_placements
from rxcli.link.softbits import MIN_SIMILARITY, TRY_FROM, Float32, surprise
from rxcli.types import FrameSoftBits, MessageKind

#: Largest number of sums of photographs that are kept, of ways to read one, and of sums that are decoded at once.
_MAX_SUMS, _MAX_VIEWS, _BATCH = 192, 96, 64
#: Views of a photograph that are decoded by themselves first; and log-likelihood ratio of zeros that ranks views.
_ALONE, _CLEAR_ZEROS = 64, 8.0
#: Log-likelihood ratio from which photographs certainly show the same text; and below which a bit is unknown.
_SAME, _UNKNOWN = 16.0, 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class _Sum:
    """Soft bits of a packet (N, C, 7), of one photograph or of several under one hypothesis of what they show."""

    total: Float32
    #: Log-likelihood ratio of all photographs showing one text; and the sum of `surprise` over all bits.
    similarity: float
    level: float
    #: Of the last photograph.
    placement: Placement
    sources: tuple[str, ...]
    #: Log-likelihood ratio of the zeros after a message, of each photograph by itself.
    zeros: float = 0.0
    #: Whether it is the sum of one photograph's bursts, which the search for beacons has tried.
    is_tried: bool = False

    @property
    def rank(self) -> float:
        """The larger, the likelier."""
        return self.similarity + self.zeros


class CutPhotos:
    """Search for texts that every burst repeats, in photographs of a part of a packet.

    Args:
        columns: C.
        payload_symbols: N.
    """

    def __init__(self, columns: int, payload_symbols: int) -> None:
        layouts = (beacon_layout(length, columns, payload_symbols) for length in BEACON_LENGTHS)
        self._layouts = [layout for layout in layouts if layout.period == 1]
        self._sums: list[_Sum] = []

    def add(self, soft: FrameSoftBits) -> list[Found]:
        """Add a photograph, and return the text that it completes."""
        views = list(_views(soft))
        if not (views and self._layouts):
            return []
        views = self._ranked(views)[:_MAX_VIEWS]
        joined = [pair for known in self._sums for view in views if (pair := _joined(known, view)) is not None]
        joined.sort(key=lambda s: -s.rank)
        # The likeliest alone, then sums of more photographs.
        sums = [*views[:_ALONE], *joined[: 2 * _MAX_SUMS], *views[_ALONE:]]
        certain = [s for s in joined if s.similarity > _SAME]
        self._sums = certain[:_MAX_SUMS] or [*sums[:_MAX_SUMS], *self._sums][: 2 * _MAX_SUMS]
        untried = [s for s in sums[: 2 * _MAX_SUMS] if not s.is_tried]
        for layout in self._layouts:
            found = next(_read(layout, untried), None)
            if found is not None:
                self._sums = [found[1]]
                return [Found(found[0], found[1].placement, found[1].sources)]
        return []

    def _ranked(self, views: list[_Sum]) -> list[_Sum]:
        """Views by the zeros that they show after a message, otherwise in their order."""
        buffers = ((layout, [gathered(layout, view.total[None]) for view in views]) for layout in self._layouts)
        zeros = np.max([known_bits(layout, np.stack(shown)).llr for layout, shown in buffers], axis=0)
        ranked = [replace(view, zeros=float(llr)) for view, llr in zip(views, zeros, strict=True)]
        return sorted(ranked, key=lambda view: -round(view.zeros / _CLEAR_ZEROS))


def _read(layout: BeaconLayout, sums: list[_Sum]) -> Iterator[tuple[tuple[MessageKind, bytes], _Sum]]:
    """Texts of a layout that sums show."""
    for start in range(0, len(sums), _BATCH):
        part = sums[start : start + _BATCH]
        _, found = read_beacons(layout, [s.total[None] for s in part], [s.level for s in part], TRY_FROM)
        yield from ((content, part[place]) for place, content in found)


def _views(soft: FrameSoftBits) -> Iterator[_Sum]:
    """What a photograph may show: every clock, start of its packets and placement of its columns, likeliest first."""
    candidates = (soft, *soft.alternatives)
    of_one_packet = [c for c in candidates if surprise(c.llr.sum(axis=0)) - surprise(c.llr) > MIN_SIMILARITY]
    for group in range(3):
        for candidate in of_one_packet:
            llr = np.where(np.abs(candidate.llr) > _UNKNOWN, candidate.llr, 0).sum(axis=0, dtype=np.float32)
            observed, groups = np.flatnonzero(llr.any(axis=(1, 2))), possible_placements(llr)
            if observed.size == 0 or group >= len(groups):
                continue
            starts = range(-int(observed[0]), len(llr) - int(observed[-1])) if candidate.open_start else (0,)
            for start in starts:
                # Symbols outside those in view are unknown, so that nothing is lost at the ends.
                moved = np.roll(llr, start, axis=0)
                for placement in groups[group]:
                    total = placement.of(moved)
                    is_tried = candidate is soft and not soft.open_start
                    yield _Sum(total, 0.0, float(surprise(total)), placement, (soft.source,), is_tried=is_tried)


def _joined(known: _Sum, view: _Sum) -> _Sum | None:
    """The sum of both, or None if they contradict each other."""
    total = known.total + view.total
    level = float(surprise(total))
    gain = level - known.level - view.level
    if gain < MIN_SIMILARITY:
        return None
    sources = (*known.sources, *view.sources)
    return _Sum(total, known.similarity + gain, level, view.placement, sources, known.zeros + view.zeros)
