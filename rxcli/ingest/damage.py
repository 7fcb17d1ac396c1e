"""Which frames of a decoder are whole: damage spreads to all that is predicted from it, until the next key frame.

A decoder flags the frame that it stumbles over, or gives none for its packet; the frames predicted from it pass as
good. So every frame is traced to its packet, and packets are judged in the order of decoding.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

#: Frames that may be decoded after one and shown before it: the most that H.264 and HEVC allow.
_MAX_REORDER = 16


@dataclass(slots=True, eq=False)
class _Picture:
    """A packet and its frame, which carry it: it must not hold them."""

    number: int
    #: Whether the container lost some of it, and perhaps of the next ones.
    has_gap: bool = False
    is_damaged: bool = False
    is_key: bool = False
    #: In the order of presentation; None before the frame comes, and of a packet that gives none.
    place: int | None = None
    #: None while it is open.
    is_whole: bool | None = None


class WholeFrames:
    """A decoder that gives whole frames, in the order of presentation.

    Args:
        codec: decoder context, not open yet.
        n_threads: its threads.
        max_held: frames for which memory has room while it is open whether they are whole.
    """

    def __init__(self, codec: Any, n_threads: int, max_held: int) -> None:
        codec.thread_type, codec.thread_count, codec.copy_opaque = "FRAME", n_threads, True
        self._codec, self._n_threads, self._max_held = codec, n_threads, max_held
        self._n_sent = self._n_shown = 0
        #: Number of the newest frame that came, and of the first key frame.
        self._newest, self._first = -1, -1
        #: What is not judged yet, in the order of decoding, and what is not given yet, in that of presentation.
        self._sent: deque[_Picture] = deque()
        self._shown: deque[tuple[_Picture, Any]] = deque()
        self._key = _Picture(0)
        #: Whether something is damaged since the last key frame, was when that came, and is for frames shown before it.
        self._is_broken = self._was_broken = self._is_lead_broken = False
        self._is_interlaced = False

    def decode(self, packet: Any, *, has_gap: bool = False) -> Iterator[Any]:
        """Frames that are complete after a packet, None in place of each that is damaged or lost.

        Args:
            packet: the next one; None after the last.
            has_gap: whether some of it was lost in the container.
        """
        import av

        if packet is not None:
            packet.opaque = picture = _Picture(self._n_sent, has_gap, has_gap)
            self._first = 0 if self._n_sent == 0 and packet.is_keyframe else self._first
            # RFC 6386, section 9.1: a bit in the first byte of VP8 frames that are shown.
            if self._codec.name != "vp8" or memoryview(packet)[0] & 0x10:
                self._sent.append(picture)
            self._n_sent += 1
        try:
            for frame in self._codec.decode(packet):
                self._enter(frame.opaque, frame)
        except av.error.FFmpegError:  # of a packet that gives no frame; HEVC's do
            for picture in self._sent if self._codec.name == "hevc" else ():
                picture.is_damaged |= picture.number == self._n_sent - self._n_threads
        yield from self._judge(is_end=packet is None)
        while self._shown and (self._shown[0][0].is_whole is not None or len(self._shown) > self._max_held):
            picture, frame = self._shown.popleft()
            yield None if picture.is_whole is False else frame

    def _enter(self, picture: _Picture, frame: Any) -> None:
        picture.is_key, picture.place = frame.key_frame, self._n_shown
        picture.is_damaged |= frame.is_corrupt
        self._n_shown += 1
        self._newest = max(self._newest, picture.number)
        self._is_interlaced |= frame.interlaced_frame
        if self._first < 0 and picture.is_key:
            self._first = picture.number
        if self._first >= 0:  # else of a clip that begins between two key frames
            self._shown.append((picture, frame))

    def _judge(self, *, is_end: bool) -> Iterator[None]:
        """Settle which pictures are whole, as far as those decoded before are known; None for each lost one.

        A lost or damaged picture breaks all that are decoded after it, up to the next key frame. Leading pictures are
        decoded after a key frame and shown before it: they may need pictures from before it, and none needs them but
        each other.
        """
        reorder = _MAX_REORDER if self._codec.has_b_frames else 0
        while self._sent and (
            self._sent[0].place is not None or is_end or self._sent[0].number + reorder < self._newest
        ):
            picture, key = self._sent.popleft(), self._key
            if picture.place is None:
                is_leading = self._was_broken and picture.number <= key.number + reorder and not picture.has_gap
                is_field = self._is_interlaced and 2 * self._n_shown <= self._newest + 2  # two packets make a frame
                self._is_broken |= not (is_leading or is_field)
                if picture.number >= self._first and not is_field:
                    yield None
            elif picture.is_key:
                self._key, self._was_broken, self._is_broken = picture, self._is_broken, picture.is_damaged
                self._is_lead_broken, picture.is_whole = self._was_broken, not picture.is_damaged
            elif key.place is not None and picture.place < key.place:
                self._is_lead_broken |= picture.is_damaged
                self._is_broken |= picture.has_gap
                picture.is_whole = not (self._is_lead_broken or self._is_broken)
            else:
                self._is_broken |= picture.is_damaged
                picture.is_whole = not self._is_broken
