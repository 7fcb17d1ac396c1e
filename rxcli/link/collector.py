"""From frames' results to messages and files: soft bits are taken out of them, what they complete is put in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rxcli.link.files import MAX_OBJECT_BYTES
from rxcli.link.receiver import LinkReceiver
from rxcli.link.softbits import Event
from rxcli.profiles import ScreenProfile
from rxcli.types import FrameResult, FrameSoftBits, Message, ObjectProgress, ReceivedObject


class Collector:
    """The link layer of one source, or of photos that are to be combined.

    Args:
        screens: profiles that results may name.
        max_object_bytes: longer files are refused.
    """

    def __init__(self, screens: Sequence[ScreenProfile], max_object_bytes: int = MAX_OBJECT_BYTES) -> None:
        self._shapes = {screen.name: (screen.columns, screen.payload_symbols) for screen in screens}
        self._max_bytes = max_object_bytes
        self._receivers: dict[tuple[int, int], LinkReceiver] = {}

    def add(self, result: FrameResult) -> FrameResult:
        """The result with what it completes, and without its soft bits."""
        soft, result = result.soft_bits, replace(result, soft_bits=None)
        if soft is None:
            return result
        return with_events(result, self.add_bits(soft, result.screen_profile))

    def add_bits(self, soft: FrameSoftBits, screen_profile: str | None) -> list[Event]:
        """Add the soft bits of a screen; returns what they complete."""
        shape = self._shapes.get(screen_profile or "")
        if shape is None or soft.llr.shape[1:3] != shape[::-1]:
            return []
        if shape not in self._receivers:
            self._receivers[shape] = LinkReceiver(*shape, self._max_bytes)
        return self._receivers[shape].add(soft)

    def finish(self, last: FrameResult) -> FrameResult:
        """The last result of the source with what is left, complete or not."""
        events = [event for receiver in self._receivers.values() for event in receiver.finish()]
        return replace(with_events(last, events), progress=tuple(self.progress), link_notes=tuple(self.notes))

    @property
    def progress(self) -> list[ObjectProgress]:
        """Files under way."""
        return [progress for receiver in self._receivers.values() for progress in receiver.progress]

    @property
    def notes(self) -> list[str]:
        """Sentences about what was seen and refused."""
        return [note for receiver in self._receivers.values() for note in receiver.notes]


def with_events(result: FrameResult, events: Sequence[Event]) -> FrameResult:
    """The result with messages and files that are complete with it."""
    if not events:
        return result
    return replace(
        result,
        messages=result.messages + tuple(e for e in events if isinstance(e, Message)),
        objects=result.objects + tuple(e for e in events if isinstance(e, ReceivedObject)),
    )
