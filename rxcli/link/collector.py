"""Convert the soft bits in frame results to messages and files, and add those to the results."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

from rxcli.link.files import FileState, FilesUnderWay
from rxcli.link.formats import Announcement
from rxcli.link.placement import Placement, placed
from rxcli.link.receiver import LinkReceiver, received
from rxcli.link.softbits import Event
from rxcli.profiles import CameraProfile, ScreenProfile
from rxcli.types import FILE_MEMORY_MB, FrameResult, FrameSoftBits, Message, ObjectProgress, ReceivedObject


class Collector:
    """Link layer of one source, or of several photos of one transmission.

    What decodes shows how the picture's columns lie on the screen: mirrored, or numbered some columns off.

    Args:
        screens: that may be seen.
        file_memory_mb: memory limit of all incomplete files, 2^20 bytes.
    """

    def __init__(self, screens: Sequence[ScreenProfile], file_memory_mb: int = FILE_MEMORY_MB) -> None:
        self._under_way = FilesUnderWay(file_memory_mb)
        self._screens = screens
        self._shapes = {(screen.columns, screen.payload_symbols) for screen in screens}
        #: Receivers by columns and payload symbols.
        self._receivers: dict[tuple[int, int], LinkReceiver] = {}
        #: Placement of the source's columns; None until a message or file decides.
        self._placement: Placement | None = None
        self._source = ""
        #: Incomplete files of clips before, by what is equal in all announcements of a file, and their size.
        self._of_clips: dict[tuple[Announcement, tuple[int, ...]], FileState] = {}
        #: Profile of the screen that sends the source's text, None until there is one.
        self._screen: str | None = None

    def add(self, result: FrameResult) -> FrameResult:
        """Replace the soft bits of a result by what they complete, and number its columns as that shows."""
        soft, result = result.soft_bits, replace(result, soft_bits=None)
        if result.source != self._source:  # the next photo may come from a different camera
            self._source, self._placement, self._screen = result.source, None, None
        events, by_shape = list[Event](), defaultdict[tuple[int, int], list[FrameSoftBits]](list)
        for candidate in () if soft is None else (soft, *soft.alternatives):
            by_shape[candidate.llr.shape[2], candidate.llr.shape[1]].append(candidate)
        for shape, (likeliest, *less_likely) in by_shape.items():
            # The same symbols may give a text with packets of another length.
            if shape not in self._shapes or any(isinstance(event, Message) for event in events):
                continue
            if shape not in self._receivers:
                self._receivers[shape] = LinkReceiver(*shape, self._under_way)
            receiver = self._receivers[shape]
            receiver.placement = self._placement
            came = receiver.add(replace(likeliest, alternatives=tuple(less_likely)))
            if any(isinstance(event, Message) for event in came):
                self._screen = self._sender(likeliest.screen_profile or result.screen_profile)
            events += came
            self._placement = receiver.placement
        if self._placement is not None:
            n_columns = len(result.columns) or (0 if soft is None else soft.llr.shape[2])
            result = placed(result, self._placement, n_columns)
        if self._screen is not None and (events or result.packets):
            result = replace(result, screen_profile=self._screen)
        if events and result.status in ("no_signal", "no_screen"):  # what held no packet was a part of them
            result = replace(result, status="ok", remarks=(), message=None, columns=(), skipped={})
        return with_events(result, events)

    def _sender(self, name: str | None) -> str | None:
        """The screen that sends texts in the packets of the named one: the one with the fewest copies."""
        packets = [screen.packets for screen in self._screens if screen.name == name]
        senders = [screen for screen in self._screens if screen.packets in packets]
        return min(senders, key=lambda screen: screen.repeats).name if senders else None

    def finish(self, last: FrameResult) -> FrameResult:
        """Add the remaining messages and files, complete or not, to the last result of the source."""
        events = [event for receiver in self._receivers.values() for event in receiver.finish()]
        notes = dict.fromkeys(sentence for receiver in self._receivers.values() for sentence in receiver.notes)
        last = replace(with_events(last, events), progress=tuple(self.progress), link_notes=tuple(notes))
        return replace(last, files=tuple(file for receiver in self._receivers.values() for file in receiver.incomplete))

    @property
    def progress(self) -> list[ObjectProgress]:
        """Progress of incomplete files."""
        return [progress for receiver in self._receivers.values() for progress in receiver.progress]


class PhotoCollector(Collector):
    """Link layer of several photos of one transmission, which complete each other, or of several clips.

    The first photo alone was tried before it comes here, so it is added only with the second one. Of clips, the
    incomplete files are joined, as of one that a camera writes in chapters.
    """

    #: Number of photos that were incomplete on their own.
    n_photos = 0
    #: Their camera, where it is known that they are all by one.
    camera: CameraProfile | None = None
    _waiting: FrameResult | None = None

    def add(self, result: FrameResult) -> FrameResult:
        """Add the messages and files that a photo or clip completes; other results are unchanged."""
        if result.files:
            return self._joined(result)
        if result.soft_bits is None:
            return result
        self.n_photos += 1
        result = replace(result, soft_bits=replace(result.soft_bits, epoch=self.n_photos, source=result.source))
        if self.n_photos == 1 and not result.progress:
            self._waiting = result
            return replace(result, soft_bits=None)
        if self._waiting is not None:
            joined, self._waiting = super().add(self._waiting), None
            result = with_events(result, (*joined.messages, *joined.objects))
        return super().add(result)

    def _joined(self, result: FrameResult) -> FrameResult:
        """Add the incomplete files of a clip to those of clips before."""
        complete = []
        for file in result.files:
            key = replace(file.announcement, burst=0), file.total.shape
            known = self._of_clips.get(key)
            if known is None or not known.under_way:
                if self._under_way.admit(file):
                    self._of_clips[key] = file
                continue
            known.join(file)
            if (found := known.unpacked()) is not None:
                complete.append(received(known, found, result))
        done = {file.object_id for file in complete}
        progress = tuple(state for state in result.progress if state.object_id not in done)
        return replace(with_events(result, complete), progress=progress, files=())


def with_events(result: FrameResult, events: Sequence[Event]) -> FrameResult:
    """Add completed messages and files to a result."""
    return replace(
        result,
        messages=result.messages + tuple(e for e in events if isinstance(e, Message)),
        objects=result.objects + tuple(e for e in events if isinstance(e, ReceivedObject)),
    )
