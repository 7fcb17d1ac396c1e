"""Files: find announcements, which number the bursts, and add up the bits of every block until all are decoded."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rxcli.link import ldpc, softbits
from rxcli.link.beacons import gathered, is_likely, read_words
from rxcli.link.formats import (
    Announcement,
    Container,
    ContainerError,
    block_prefix,
    has_crc,
    unpack_container,
    unprotect_announcement,
)
from rxcli.link.layout import ANNOUNCEMENT_PERIOD, CRC_BYTES, LABEL_BITS, FileLayout, announcement_layout
from rxcli.link.placement import Placement, possible_placements
from rxcli.link.sequences import whiten
from rxcli.link.softbits import MIN_SIMILARITY, TRY_FROM, Float32, information, log_likelihood, same_bits_llr, surprise
from rxcli.types import FILE_MEMORY_MB, FrameSoftBits, ObjectProgress

#: Batch size for announcements whose copies do not decide.
_ANNOUNCEMENTS_AT_ONCE = 32
#: Bursts in which announcements are tried under shifted column numbers.
_MAX_SHIFTED = 96
#: Blocks per batch, the share of the remaining blocks that suffices, and frames after which fewer suffice.
_BLOCKS_AT_ONCE, _SHARE_AT_ONCE, _PATIENT_FRAMES = 32, 0.5, 30
_ITERATIONS = 25
#: Increase of information before the next attempt on a block, relative to its bits.
_RETRY_GAIN = 0.02
#: Files of at least this many blocks estimate the required information from this many first ones; and the share of
#: decoded blocks in a batch below which the required information is raised.
_LEARN_FROM, _PROBES, _FEW = 16, 8, 0.25
#: Minimum log-likelihood of a decoded block, relative to the received information.
_MIN_LIKELIHOOD = 0.5
#: Bytes of bursts that wait for an announcement, and bursts that may be reassigned to a new object.
_MAX_WAITING, _MAX_RECENT = 32 << 20, 96
#: Largest accepted file, bytes.
MAX_OBJECT_BYTES = 16 << 20
#: Bytes of a file's state beside its sums, and maximum numbers of stored timelines and notes.
_STATE_BYTES, _MAX_TIMELINES, _MAX_NOTES = 1 << 14, 16, 20


@dataclass(frozen=True, slots=True)
class _Burst:
    """A burst that may have to be reassigned."""

    epoch: int
    number: int
    #: (N, C, 7) int8 in steps of the decoder.
    llr: NDArray[np.int8]


@dataclass(slots=True, eq=False)
class FileState:
    """Reception state of one file."""

    announcement: Announcement
    layout: FileLayout
    #: (B, M) int8 sums of log-likelihood ratios in the decoder's steps.
    total: NDArray[np.int8]
    #: (B,) bits of information, and the threshold for decoding a block.
    known: NDArray[np.float64]
    threshold: NDArray[np.float64]
    blocks: dict[int, bytes] = field(default_factory=dict)
    #: Information at which blocks were decoded, relative to their bits.
    read_at: list[float] = field(default_factory=list)
    #: Minimum information for decoding any block, relative to its bits.
    min_information: float = 0.0
    done: bool = False
    #: Reason why the file can never be complete.
    failure: str | None = None
    #: Whether the file was dropped to free memory; it restarts with the next announcement.
    dropped: bool = False
    frames_waited: int = 0
    first_time_s: float | None = None
    last_time_s: float = 0.0

    @classmethod
    def begin(cls, announcement: Announcement, columns: int, payload_symbols: int) -> FileState:
        """Start an empty file."""
        layout = FileLayout(announcement.object_id, announcement.length, announcement.mother, columns, payload_symbols)
        n = layout.n_blocks
        # The operating system provides memory on first use, so a false length costs nothing.
        total = np.zeros((n, layout.n_bits), np.int8)
        return cls(announcement, layout, total, np.zeros(n), np.full(n, layout.ready))

    @property
    def under_way(self) -> bool:
        """Whether the file is still incomplete."""
        return not (self.done or self.failure or self.dropped)

    @property
    def n_bytes(self) -> int:
        """Largest memory use."""
        return self.total.nbytes + self.known.nbytes + self.threshold.nbytes + 2 * self.layout.length + _STATE_BYTES

    @property
    def share(self) -> float:
        """Received share of the required information."""
        if self.done:
            return 1.0
        part = np.minimum(self.known / self.layout.ready, 0.999)
        part[list(self.blocks)] = 1.0
        return float(part.mean())

    def progress(self) -> ObjectProgress:
        """Received share, and remaining time at the current rate."""
        passed_s = self.last_time_s - self.first_time_s if self.first_time_s is not None else 0.0
        share, layout = self.share, self.layout
        left_s = passed_s * (1 - share) / share if passed_s > 0 and share > 0 else None
        return ObjectProgress(layout.object_id, layout.length, layout.n_blocks, len(self.blocks), share, left_s)

    def add(self, bursts: NDArray[np.int64], llr: NDArray[np.int8], sign: int = 1) -> None:
        """Add data bursts, numbered from the object's start; `sign` -1 removes them."""
        blocks, labels, passes = (part.ravel() for part in self.layout.labels(bursts))
        ratios = llr.reshape(-1, LABEL_BITS)
        used = np.flatnonzero(ratios.any(axis=1) & self._open()[blocks])
        block = blocks[used]
        place = block[:, None] * self.layout.n_bits + self.layout.bits_of(labels[used], passes[used])
        more = ratios[used].astype(np.int16) * sign
        if not self.layout.all_differ(bursts):
            place, turn = np.unique(place, return_inverse=True)
            more = np.rint(np.bincount(turn.ravel(), more.ravel(), place.size)).astype(np.int16)
            block = place // self.layout.n_bits
        flat = self.total.reshape(-1)
        before = flat[place]
        after = np.clip(before + more, -127, 127).astype(np.int8)
        flat[place] = after
        gain = (
            softbits.INFORMATION_OF_STEPS[after.view(np.uint8)] - softbits.INFORMATION_OF_STEPS[before.view(np.uint8)]
        )
        self.known += np.bincount(block, gain.reshape(block.size, -1).sum(axis=1), self.layout.n_blocks)

    def _open(self) -> NDArray[np.bool_]:
        still = np.ones(self.layout.n_blocks, bool)
        still[list(self.blocks)] = False
        return still

    def ready(self, at_last: bool) -> NDArray[np.int64]:
        """Blocks with enough information to be decoded."""
        ready = np.flatnonzero((self.known >= self._thresholds(at_last)) & self._open())
        left = self.layout.n_blocks - len(self.blocks)
        if (
            at_last
            or self.frames_waited >= _PATIENT_FRAMES
            or ready.size >= min(_BLOCKS_AT_ONCE, _SHARE_AT_ONCE * left)
        ):
            return ready
        return ready[:0]

    def _thresholds(self, at_last: bool) -> NDArray[np.float64]:
        if at_last:
            return self.threshold - 2 * _RETRY_GAIN * self.layout.code.k
        required = self.min_information
        if self.layout.n_blocks >= _LEARN_FROM and len(self.read_at) >= _PROBES:
            required = max(required, float(np.median(self.read_at[-4 * _BLOCKS_AT_ONCE :])) - _RETRY_GAIN)
        return np.maximum(self.threshold, required * self.layout.code.k)

    def read(self, which: NDArray[np.int64]) -> None:
        """Decode blocks; if the first ones fail, the rest waits."""
        self.frames_waited = 0
        if self.layout.n_blocks >= _LEARN_FROM and not self.read_at:
            ordered = which[np.argsort(-self.known[which])]
            self._read_batch(ordered[:_PROBES])
            which = np.sort(ordered[_PROBES:])
            if not self.read_at:
                return
        for start in range(0, which.size, _BLOCKS_AT_ONCE):
            self._read_batch(which[start : start + _BLOCKS_AT_ONCE])

    def _read_batch(self, which: NDArray[np.int64]) -> None:
        layout, object_id = self.layout, self.layout.object_id
        llr = self.total[which]

        masks = [
            np.frombuffer(whiten(bytes(layout.block_bytes + CRC_BYTES), object_id, int(b)), np.uint8) for b in which
        ]
        mask, prefixes = np.stack(masks), [block_prefix(object_id, int(number)) for number in which]

        def accepted(places: NDArray[np.int64], bits: NDArray[np.uint8]) -> NDArray[np.bool_]:
            good = np.zeros(places.size, bool)
            for i, plain in enumerate(np.packbits(bits, axis=1) ^ mask[places]):
                coded = plain.tobytes()
                if has_crc(coded, prefixes[places[i]]) and _is_likely(layout, bits[i], llr[places[i]]):
                    self.blocks[int(which[places[i]])], good[i] = coded[:-CRC_BYTES], True
            return good

        read = ldpc.decode(layout.code, llr, accepted, _ITERATIONS)
        self.read_at += (self.known[which[read]] / layout.code.k).tolist()
        if read.mean() < _FEW:
            self.min_information = float(self.known[which].mean()) / layout.code.k + _RETRY_GAIN
        failed = which[~read]
        self.threshold[failed] = self.known[failed] + _RETRY_GAIN * layout.code.k

    def unpacked(self) -> Container | None:
        """The file, if all blocks are decoded and the hash fits; otherwise sets `failure`."""
        if not self.under_way or len(self.blocks) < self.layout.n_blocks:
            return None
        container = b"".join(self.blocks[number] for number in range(self.layout.n_blocks))[: self.layout.length]
        try:
            if zlib.crc32(container) != self.announcement.container_crc:
                raise ContainerError("its blocks do not give the CRC-32 that was announced")
            found = unpack_container(container, MAX_OBJECT_BYTES)
        except ContainerError as error:
            self.failure = str(error)
            return None
        finally:
            self.release()
        self.done = True
        return found

    def release(self) -> None:
        """Free the memory of sums and blocks."""
        self.total = np.zeros((0, self.layout.n_bits), np.int8)
        self.known = self.threshold = np.zeros(0)
        self.blocks = {}


class FilesUnderWay:
    """Incomplete files of all screens of a source, within a common memory limit.

    Args:
        memory_mb: memory limit, 2^20 bytes.
    """

    def __init__(self, memory_mb: int = FILE_MEMORY_MB) -> None:
        self._max_bytes = memory_mb << 20
        self._files: list[FileState] = []
        self._n_dropped = 0

    def admit(self, file: FileState) -> bool:
        """Free memory for a file by dropping the least complete, oldest first; False if it can never fit."""
        self._files = [known for known in self._files if known.under_way]
        if file.n_bytes > self._max_bytes:
            return False
        while sum(known.n_bytes for known in self._files) + file.n_bytes > self._max_bytes:
            dropped = min(self._files, key=lambda known: round(known.share, 2))
            self._files.remove(dropped)
            dropped.dropped = True
            dropped.release()
            self._n_dropped += 1
        self._files.append(file)
        return True

    @property
    def notes(self) -> list[str]:
        """A sentence about dropped files."""
        if not self._n_dropped:
            return []
        files = "1 incomplete file was" if self._n_dropped == 1 else f"{self._n_dropped} incomplete files were"
        return [f"{files} dropped: together they would take more than {self._max_bytes >> 20} MB (--file-memory)"]


def _is_likely(layout: FileLayout, information_bits: NDArray[np.uint8], llr: NDArray[np.int8]) -> bool:
    """Whether a decoded block agrees with the soft bits of its information part, which every fragment contains."""
    sent = information_bits[layout.code.first_sent :]
    received = llr[: sent.size] * ldpc.LLR_STEP
    return bool(log_likelihood(sent, received) > _MIN_LIKELIHOOD * softbits.LN2 * information(received).sum())


@dataclass(slots=True, eq=False)
class _Timeline:
    """Mapping from burst numbers of an epoch to those of an object, and from the picture's columns to the screen's."""

    epoch: int
    offset: int
    placement: Placement
    file: FileState
    #: The first and the last burst with a matching announcement.
    since: int
    until: int


@dataclass(slots=True, eq=False)
class _Candidate:
    """A burst that may be an announcement, under a placement of its columns."""

    epoch: int
    number: int
    placement: Placement
    buffer: Float32 = field(default_factory=lambda: np.zeros(0, np.float32))


class FileSearch:
    """Find announcements and assign bursts to their files.

    Args:
        columns: C.
        payload_symbols: N.
        under_way: incomplete files, which share a memory limit.
    """

    def __init__(self, columns: int, payload_symbols: int, under_way: FilesUnderWay) -> None:
        self._under_way = under_way
        self._columns, self._payload_symbols = columns, payload_symbols
        self._layout = announcement_layout(columns, payload_symbols)
        self.files: dict[tuple[int, int, int, int], FileState] = {}
        #: Timelines of every epoch, latest last.
        self._timelines: dict[int, list[_Timeline]] = {}
        self._waiting: list[_Burst] = []
        #: Recent bursts with the timeline by which they were added.
        self._recent: list[tuple[_Timeline, _Burst]] = []
        self._candidates: list[_Candidate] = []
        self._n_shifted = 0
        #: Bursts of the current frame.
        self._fresh: list[tuple[_Timeline, _Burst]] = []
        #: Sentences about refused files.
        self.notes: list[str] = []

    def placement(self, epoch: int) -> Placement | None:
        """Placement of the columns by the announcements of this epoch; None if there were none."""
        return self._timelines[epoch][-1].placement if epoch in self._timelines else None

    def add(
        self, soft: FrameSoftBits, settled: Placement | None, at_last: bool = False
    ) -> list[tuple[FileState, Container]]:
        """Add bursts and return the files that they complete; `settled` is the placement of their columns if known."""
        settled = settled or self.placement(soft.epoch)
        for number, llr in zip(soft.burst, soft.llr, strict=True):
            groups = [[settled]] if settled else possible_placements(llr)[: 2 + (self._n_shifted < _MAX_SHIFTED)]
            self._n_shifted += len(groups) > 2
            for placement in (placement for group in groups for placement in group):
                self._look_for_announcement(_Candidate(soft.epoch, int(number), placement), placement.of(llr))
        # These have too few copies to decide. A batch costs little more than a single attempt.
        if len(self._candidates) >= _ANNOUNCEMENTS_AT_ONCE:
            self._try_gathered()
        quantised = ldpc.quantised(soft.llr)
        for number, llr in zip(soft.burst, quantised, strict=True):
            self._enter(_Burst(soft.epoch, int(number), llr), soft.time_s)
        self._flush_entered()
        return self._complete(at_last)

    def finish(self) -> list[tuple[FileState, Container]]:
        """Decode the remaining announcements and blocks."""
        self._try_gathered()
        self._flush_entered()
        return self._complete(at_last=True)

    # -- announcements -------------------------------------------------------------------------------------------------

    def _look_for_announcement(self, candidate: _Candidate, llr: Float32) -> None:
        candidate.buffer = gathered(self._layout, llr)
        similarity = same_bits_llr(candidate.buffer, float(surprise(llr).sum(dtype=np.float64)))
        if similarity < MIN_SIMILARITY:
            return
        if information(candidate.buffer).sum() < TRY_FROM * self._layout.code.k:
            return
        if similarity > -MIN_SIMILARITY:
            if not self._is_expected(candidate):
                self._try_candidates([candidate])
        elif candidate.epoch not in self._timelines:
            self._candidates.append(candidate)

    def _is_expected(self, candidate: _Candidate) -> bool:
        """Whether a burst is the announcement that its timeline predicts."""
        line = _line_of(self._timelines.get(candidate.epoch, []), candidate.number)
        burst = 0 if line is None else candidate.number + line.offset
        if line is None or burst % ANNOUNCEMENT_PERIOD or burst >= 1 << 32:
            return False
        coded = replace(line.file.announcement, burst=burst).protected()
        bits = np.unpackbits(np.frombuffer(coded, np.uint8))
        if line.file.dropped or not is_likely(self._layout, bits, candidate.buffer):
            return False
        line.until = max(line.until, candidate.number)
        return True

    def _try_gathered(self) -> None:
        candidates, self._candidates = self._candidates, []
        if candidates:
            self._try_candidates(candidates)

    def _try_candidates(self, candidates: list[_Candidate]) -> None:
        buffers = np.stack([candidate.buffer for candidate in candidates])
        words = read_words(self._layout, buffers, unprotect_announcement)
        for candidate, word in zip(candidates, words, strict=True):
            announcement = None if word is None else unprotect_announcement(word)
            if announcement is not None:
                self._announced(announcement, candidate)

    def _announced(self, announcement: Announcement, candidate: _Candidate) -> None:
        known = self.files.get(announcement.key)
        if known is None or known.dropped:
            known = self._begun(announcement)
            if known is None:
                return
        offset, number, placement = announcement.burst - candidate.number, candidate.number, candidate.placement
        lines = self._timelines.setdefault(candidate.epoch, [])
        if not lines or (lines[-1].offset, lines[-1].file, lines[-1].placement) != (offset, known, placement):
            lines.append(_Timeline(candidate.epoch, offset, placement, known, number, number))
            self._claim(lines)
            del lines[:-_MAX_TIMELINES]

    def _begun(self, announcement: Announcement) -> FileState | None:
        """Start a new file; None if it is too long."""
        if announcement.length > MAX_OBJECT_BYTES:
            self._add_note(
                f"a file of {announcement.length} bytes was announced, more than the accepted {MAX_OBJECT_BYTES}; "
                "it was not received"
            )
            return None
        file = FileState.begin(announcement, self._columns, self._payload_symbols)
        if not self._under_way.admit(file):
            self._add_note(
                f"a file of {announcement.length} bytes was announced, which takes {file.n_bytes >> 20} MB to receive; "
                "it was not received (--file-memory)"
            )
            return None
        self.files = {key: known for key, known in self.files.items() if not known.dropped}
        self.files[announcement.key] = file
        return file

    def _add_note(self, sentence: str) -> None:
        if sentence not in self.notes and len(self.notes) < _MAX_NOTES:
            self.notes.append(sentence)

    def _claim(self, lines: list[_Timeline]) -> None:
        """Assign waiting bursts, and some of other files, to the newest timeline."""
        line = lines[-1]
        waiting, self._waiting = self._waiting, []
        mine: list[_Burst] = []
        for burst in waiting:
            (mine if burst.epoch == line.epoch and _line_of(lines, burst.number) is line else self._waiting).append(
                burst
            )
        recent, self._recent = self._recent, []
        for before, burst in recent:
            if burst.epoch != line.epoch or _line_of(lines, burst.number) is before:
                self._recent.append((before, burst))
                continue
            _enter_bursts(before, [burst], -1)
            if _line_of(lines, burst.number) is line:
                mine.append(burst)
                self._recent.append((line, burst))
        _enter_bursts(line, mine, 1)

    # -- data ----------------------------------------------------------------------------------------------------------

    def _enter(self, burst: _Burst, time_s: float) -> None:
        line = _line_of(self._timelines.get(burst.epoch, []), burst.number)
        if line is None:
            self._waiting.append(burst)
            capacity = max(1, _MAX_WAITING // max(burst.llr.size, 1))
            del self._waiting[:-capacity]
            return
        file = line.file
        file.first_time_s = time_s if file.first_time_s is None else file.first_time_s
        file.last_time_s = time_s
        self._fresh.append((line, burst))

    def _flush_entered(self) -> None:
        """Add all bursts of a frame together."""
        fresh, self._fresh = self._fresh, []
        for line in dict.fromkeys(line for line, _ in fresh):
            _enter_bursts(line, [burst for owner, burst in fresh if owner is line], 1)
            line.file.frames_waited += 1
        self._recent += fresh
        del self._recent[:-_MAX_RECENT]

    def _complete(self, at_last: bool) -> list[tuple[FileState, Container]]:
        """Read the blocks that are ready, and return the files that are whole by now."""
        found = []
        for file in self.files.values():
            if not file.under_way:
                continue
            which = file.ready(at_last)
            if which.size:
                file.read(which)
            container = file.unpacked()
            if container is not None:
                found.append((file, container))
            elif file.failure:
                self._add_note(
                    f"a file of {file.layout.length} bytes is complete but not what was sent: {file.failure}"
                )
        return found


def _line_of(lines: list[_Timeline], number: int) -> _Timeline | None:
    """The latest timeline that a burst fits; None if there is none or two fit."""
    for place in reversed(range(len(lines))):
        line, earlier = lines[place], lines[place - 1] if place else None
        if number + line.offset < 0 or (earlier is not None and number <= earlier.until):
            continue
        # A change of files is certain where a file begins; later only its announcements are.
        begins = earlier is None or -line.offset > earlier.until
        return line if begins or number >= line.since else None
    return None


def _enter_bursts(line: _Timeline, bursts: list[_Burst], sign: int) -> None:
    if not bursts or not line.file.under_way:
        return
    counted = np.array([burst.number + line.offset for burst in bursts], np.int64)
    data = np.flatnonzero(counted % ANNOUNCEMENT_PERIOD)
    if data.size:
        line.file.add(counted[data], line.placement.of(np.stack([bursts[i].llr for i in data])), sign)
