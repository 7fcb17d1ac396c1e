"""Convert the soft bits in frame results to messages and files, and add those to the results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rxcli.link.files import FilesUnderWay
from rxcli.link.receiver import LinkReceiver
from rxcli.link.softbits import Event
from rxcli.profiles import ScreenProfile
from rxcli.types import FILE_MEMORY_MB, FrameResult, FrameSoftBits, Message, ObjectProgress, ReceivedObject


class Collector:
    """Link layer of one source, or of several photos of one transmission.

    Columns are tried in both directions until one gives a text or announces a file, since a picture may be mirrored.

    Args:
        screens: profiles that results may name.
        file_memory_mb: memory limit of all incomplete files, 2^20 bytes.
    """

    def __init__(self, screens: Sequence[ScreenProfile], file_memory_mb: int = FILE_MEMORY_MB) -> None:
        self._under_way = FilesUnderWay(file_memory_mb)
        self._shapes = {screen.name: (screen.columns, screen.payload_symbols) for screen in screens}
        #: Receivers by columns, payload symbols, and whether columns are counted from the opposite side.
        self._receivers: dict[tuple[int, int, bool], LinkReceiver] = {}
        #: Whether columns are counted from the opposite side; None until a message or file decides.
        self._turned: bool | None = None
        self._source = ""

    def add(self, result: FrameResult) -> FrameResult:
        """Replace the soft bits of a result by the messages and files that they complete; mirror it if necessary."""
        soft, result = result.soft_bits, replace(result, soft_bits=None)
        if result.source != self._source:  # the next photo may come from a different camera
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
        """Add the soft bits of a screen with columns counted from one side; return completed messages and files."""
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
        """Add the remaining messages and files, complete or not, to the last result of the source."""
        events = [event for receiver in self._decided for event in receiver.finish()]
        notes = dict.fromkeys(sentence for receiver in self._decided for sentence in receiver.notes)
        return replace(with_events(last, events), progress=tuple(self.progress), link_notes=tuple(notes))

    @property
    def _decided(self) -> list[LinkReceiver]:
        return [receiver for (*_, turned), receiver in self._receivers.items() if turned == bool(self._turned)]

    @property
    def progress(self) -> list[ObjectProgress]:
        """Progress of incomplete files."""
        return [progress for receiver in self._decided for progress in receiver.progress]


class PhotoCollector(Collector):
    """Link layer of several photos of one transmission, which complete each other."""

    #: Number of photos that were incomplete on their own.
    n_photos = 0

    def add(self, result: FrameResult) -> FrameResult:
        """Add the messages and files that a photo completes; a result without soft bits is unchanged."""
        if result.soft_bits is None:
            return result
        self.n_photos += 1
        soft = replace(result.soft_bits, epoch=self.n_photos, source=result.source)
        return super().add(replace(result, soft_bits=soft))


def with_events(result: FrameResult, events: Sequence[Event]) -> FrameResult:
    """Add completed messages and files to a result."""
    if not events:
        return result
    return replace(
        result,
        messages=result.messages + tuple(e for e in events if isinstance(e, Message)),
        objects=result.objects + tuple(e for e in events if isinstance(e, ReceivedObject)),
    )
