"""Link layer receiver: soft bits in, messages and files out."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rxcli.link.beacons import BeaconSearch
from rxcli.link.cut_photos import CutPhotos
from rxcli.link.files import FileSearch, FileState, FilesUnderWay
from rxcli.link.formats import Container
from rxcli.link.layout import LABEL_BITS
from rxcli.link.placement import Found, Placement
from rxcli.link.softbits import MAX_LLR, Event
from rxcli.types import FrameResult, FrameSoftBits, Message, ObjectProgress, ReceivedObject


class LinkReceiver:
    """Collect the soft bits of one transmission: a clip, a camera, a photo, or photos of one beacon.

    Args:
        columns: C.
        payload_symbols: N.
        under_way: incomplete files and their memory limit, which several receivers may share.
    """

    def __init__(self, columns: int, payload_symbols: int, under_way: FilesUnderWay | None = None) -> None:
        self._under_way = FilesUnderWay() if under_way is None else under_way
        self._shape = (payload_symbols, columns, LABEL_BITS)
        self._beacons = BeaconSearch(columns, payload_symbols)
        self._cut_photos = CutPhotos(columns, payload_symbols)
        self._files = FileSearch(columns, payload_symbols, self._under_way)
        self._last: FrameSoftBits | None = None
        #: Placement of the source's columns, None until a message or an announcement decides it.
        self.placement: Placement | None = None
        #: All messages, in order.
        self.messages: list[Message] = []

    def add(self, soft: FrameSoftBits) -> list[Event]:
        """Add the soft bits of a frame and return the messages and files that they complete.

        Raises:
            ValueError: the shapes do not fit the screen.
        """
        if soft.llr.shape[1:] != self._shape or soft.burst.shape != soft.llr.shape[:1]:
            raise ValueError(f"llr must be (B, {', '.join(map(str, self._shape))}) of B bursts (got {soft.llr.shape})")
        soft = _cleaned(soft)
        if soft.burst.size == 0:
            return []
        self._last = soft
        events: list[Event] = []
        found: list[Found] = []
        if not soft.open_start:
            events += [received(*complete, soft) for complete in self._files.add(soft, self.placement)]
            announced = self._files.placement(soft.epoch)
            if announced is not None:
                self.placement = announced
                return events
            found = self._beacons.add(soft, self.placement)
        if not found and (soft.source or soft.open_start):  # a photograph
            found = self._cut_photos.add(soft)
        self.placement = found[-1].placement if found else self.placement
        return events + self._new_messages(soft, found)

    def finish(self) -> list[Event]:
        """Decode the rest at the end of the transmission."""
        return [received(*found, self._last) for found in self._files.finish() if self._last is not None]

    def _new_messages(self, soft: FrameSoftBits, found: Sequence[Found]) -> list[Event]:
        known = {(message.kind, message.data) for message in self.messages}
        new = [
            Message(*content, soft.source, soft.frame, soft.time_s, sources if len(sources) > 1 else ())
            for content, sources in {content: sources for content, _, sources in found}.items()
            if content not in known
        ]
        self.messages += new
        return list(new)

    @property
    def incomplete(self) -> list[FileState]:
        """Incomplete files."""
        return [file for file in self._files.files.values() if file.under_way]

    @property
    def progress(self) -> list[ObjectProgress]:
        """Progress of incomplete files."""
        return [file.progress() for file in self.incomplete]

    @property
    def notes(self) -> list[str]:
        """Sentences about refused messages and files."""
        return [*self._files.notes, *self._under_way.notes]


def received(file: FileState, found: Container, where: FrameSoftBits | FrameResult) -> ReceivedObject:
    """A complete file, with the frame that completed it."""
    layout, data, place = file.layout, found.data, (where.source, where.frame, where.time_s)
    return ReceivedObject(found.name, data, len(data), found.sha256, layout.object_id, layout.n_blocks, *place)


def _cleaned(soft: FrameSoftBits) -> FrameSoftBits:
    """Bursts with any information, with limited ratios."""
    llr = np.clip(np.nan_to_num(soft.llr, nan=0.0, posinf=MAX_LLR, neginf=-MAX_LLR), -MAX_LLR, MAX_LLR)
    shown = llr.any(axis=(1, 2, 3))
    return replace(soft, burst=soft.burst[shown], llr=llr[shown].astype(np.float32))
