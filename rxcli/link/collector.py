"""From frames' results to messages and files: soft bits are taken out of them, what they complete is put in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rxcli.link.files import FilesUnderWay
from rxcli.link.receiver import LinkReceiver
from rxcli.link.softbits import Event
from rxcli.profiles import ScreenProfile
from rxcli.types import FILE_MEMORY_MB, FrameResult, FrameSoftBits, Message, ObjectProgress, ReceivedObject


class Collector:
    """The link layer of one source, or of photos that are to be combined.

    Columns are tried in both directions until one of them gives a text or announces a file: a picture may be mirrored.

    Args:
        screens: profiles that results may name.
        file_memory_mb: bound of all files under way, 2^20 bytes.
    """

    def __init__(self, screens: Sequence[ScreenProfile], file_memory_mb: int = FILE_MEMORY_MB) -> None:
        self._under_way = FilesUnderWay(file_memory_mb)
        self._shapes = {screen.name: (screen.columns, screen.payload_symbols) for screen in screens}
        #: By the columns and symbols of a packet, and whether columns are counted from the other side.
        self._receivers: dict[tuple[int, int, bool], LinkReceiver] = {}
        #: Whether columns are counted from the other side; None: nothing has come that would say so.
        self._turned: bool | None = None
        self._source = ""

    def add(self, result: FrameResult) -> FrameResult:
        """The result with what it completes, and without its soft bits; turned round where the picture is mirrored."""
        soft, result = result.soft_bits, replace(result, soft_bits=None)
        if result.source != self._source:  # another photo may be of another camera
            self._source, self._turned = result.source, None
        events: list[Event] = []
        if soft is not None:
            for turned in (False, True) if self._turned is None else (self._turned,):
                events = self._add_bits(soft, result.screen_profile, turned)
                if self._turned is not None:
                    break
        if self._turned is not None:
            result = result.with_columns_mirrored() if self._turned else replace(result, mirrored=bool(result.mirrored))
        return with_events(result, events)

    def _add_bits(self, soft: FrameSoftBits, screen_profile: str | None, turned: bool) -> list[Event]:
        """Add the soft bits of a screen, columns counted from one side; returns what they complete."""
        shape = self._shapes.get(screen_profile or "")
        if shape is None or soft.llr.shape[1:3] != shape[::-1]:
            return []
        if (*shape, turned) not in self._receivers:
            self._receivers[*shape, turned] = LinkReceiver(*shape, self._under_way)
        receiver = self._receivers[*shape, turned]
        events = receiver.add(replace(soft, llr=soft.llr[:, :, ::-1]) if turned else soft)
        if self._turned is None and (events or receiver.progress):
            self._turned = turned
        return events

    def finish(self, last: FrameResult) -> FrameResult:
        """The last result of the source with what is left, complete or not."""
        events = [event for receiver in self._decided for event in receiver.finish()]
        return replace(with_events(last, events), progress=tuple(self.progress), link_notes=tuple(self.notes))

    @property
    def _decided(self) -> list[LinkReceiver]:
        return [receiver for (*_, turned), receiver in self._receivers.items() if turned == bool(self._turned)]

    @property
    def progress(self) -> list[ObjectProgress]:
        """Files under way."""
        return [progress for receiver in self._decided for progress in receiver.progress]

    @property
    def notes(self) -> list[str]:
        """Sentences about what was seen and refused."""
        return list(dict.fromkeys(note for receiver in self._decided for note in receiver.notes))


def with_events(result: FrameResult, events: Sequence[Event]) -> FrameResult:
    """The result with messages and files that are complete with it."""
    if not events:
        return result
    return replace(
        result,
        messages=result.messages + tuple(e for e in events if isinstance(e, Message)),
        objects=result.objects + tuple(e for e in events if isinstance(e, ReceivedObject)),
    )
