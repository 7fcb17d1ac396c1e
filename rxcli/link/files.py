"""Files: find announcements, which number the bursts, and add up the bits of every block until all are decoded."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from rxcli.link import ldpc, softbits
from rxcli.link.beacons import gathered, read_words
from rxcli.link.formats import (
    Announcement,
    Container,
    ContainerError,
    unpack_container,
    unprotect,
    unprotect_announcement,
)
from rxcli.link.layout import ANNOUNCEMENT_PERIOD, FileLayout, announcement_layout
from rxcli.link.placement import Placement, possible_placements
from rxcli.link.softbits import MIN_SIMILARITY, TRY_FROM, Float32, information, surprise
from rxcli.types import FILE_MEMORY_MB, FrameSoftBits, ObjectProgress

#: Batch size for announcements whose copies do not decide.
_ANNOUNCEMENTS_AT_ONCE = 32
#: Bursts in which announcements are tried under shifted column numbers.
_MAX_SHIFTED = 96
#: Blocks per batch, the share of the remaining blocks that suffices, and frames after which fewer suffice.
_BLOCKS_AT_ONCE, _SHARE_AT_ONCE, _PATIENT_FRAMES = 32, 0.5, 30
#: Increase of information before the next attempt on a block, relative to its bits.
_RETRY_GAIN = 0.02
#: Share of decoded blocks in a batch below which the required information is raised.
_FEW = 0.25
#: Bytes of bursts that wait for an announcement.
_MAX_OPEN = 32 << 20
#: Largest accepted file, bytes.
MAX_OBJECT_BYTES = 16 << 20
#: Bytes of a file's state beside its sums, and maximum number of notes.
_STATE_BYTES, _MAX_NOTES = 1 << 14, 20


@dataclass(frozen=True, slots=True)
class _Burst:
    """A burst that may have to be reassigned."""

    epoch: int
    number: int
    #: (N, C, 7) int8 in steps of the decoder.
    llr: NDArray[np.int8]


class FileState:
    """Reception state of one file.

    Args:
        announcement: of the file.
        columns: C.
        payload_symbols: N.
    """

    def __init__(self, announcement: Announcement, columns: int, payload_symbols: int) -> None:
        self.announcement = announcement
        self.layout = FileLayout(
            announcement.object_id, announcement.length, announcement.mother, columns, payload_symbols
        )
        n = self.layout.n_blocks
        #: (B, M) int8 sums of log-likelihood ratios in the decoder's steps. The operating system provides memory on
        #: first use, so a false length costs nothing.
        self.total = np.zeros((n, self.layout.n_bits), np.int8)
        #: (B,) bits of information, and the threshold for decoding a block; infinite once it is decoded.
        self.known, self.threshold = np.zeros(n), np.full(n, self.layout.ready)
        self.blocks: dict[int, bytes] = {}
        #: Minimum information for decoding any block, bits.
        self.min_information = 0.0
        self.done = False
        #: Reason why the file can never be complete.
        self.failure: str | None = None
        #: Whether the file was dropped to free memory; it restarts with the next announcement.
        self.dropped = False
        self.frames_waited = 0
        self.first_time_s: float | None = None
        self.last_time_s = 0.0

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
        blocks, places = self.layout.places(bursts)
        used = llr.any(axis=-1) & np.isfinite(self.threshold)[blocks]
        place, turn = np.unique(blocks[used][:, None] * self.layout.n_bits + places[used], return_inverse=True)
        more = sign * np.bincount(turn.ravel(), llr[used].ravel(), place.size)
        flat = self.total.reshape(-1)
        before = flat[place]
        flat[place] = after = np.clip(before + more, -127, 127).astype(np.int8)
        gained, lost = (softbits.INFORMATION_OF_STEPS[steps.view(np.uint8)] for steps in (after, before))
        self.known += np.bincount(place // self.layout.n_bits, gained - lost, self.layout.n_blocks)

    def join(self, continued: FileState) -> None:
        """Add what another clip of the transmission gave, and decode what is ready."""
        self.total = np.clip(self.total.astype(np.int16) + continued.total, -127, 127).astype(np.int8)
        self.known = softbits.INFORMATION_OF_STEPS[self.total.view(np.uint8)].sum(axis=1).astype(np.float64)
        self.blocks |= continued.blocks
        self.threshold[:], self.min_information = self.layout.ready, 0.0
        self.threshold[list(self.blocks)] = np.inf
        self.read_ready(at_last=True)

    def read_ready(self, at_last: bool) -> None:
        """Decode blocks with enough information, several at once unless that takes long."""
        more = _RETRY_GAIN * self.layout.code.k
        threshold = self.threshold - 2 * more if at_last else np.maximum(self.threshold, self.min_information)
        ready = np.flatnonzero(self.known >= threshold)
        enough = min(_BLOCKS_AT_ONCE, _SHARE_AT_ONCE * (self.layout.n_blocks - len(self.blocks)))
        if not at_last and self.frames_waited < _PATIENT_FRAMES and ready.size < enough:
            return
        for start in range(0, ready.size, _BLOCKS_AT_ONCE):
            self._read(ready[start : start + _BLOCKS_AT_ONCE], more)

    def _read(self, which: NDArray[np.int64], more: float) -> None:
        """Decode blocks; where one fails, the next attempt takes `more` bits of information."""
        self.frames_waited, numbers, object_id = 0, which.tolist(), self.layout.object_id
        llr = self.total[which] * np.float32(ldpc.LLR_STEP)
        found = read_words(self.layout.code, llr, lambda place, coded: unprotect(coded, object_id, numbers[place]))
        read = {number: data for number, data in zip(numbers, found, strict=True) if data is not None}
        self.blocks |= read
        self.threshold[which] = self.known[which] + more
        self.threshold[list(read)] = np.inf
        if len(read) < _FEW * which.size:
            self.min_information = float(self.known[which].mean()) + more

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


@dataclass(slots=True, eq=False)
class _Timeline:
    """Mapping from burst numbers of an epoch to those of an object, and from the picture's columns to the screen's."""

    offset: int
    placement: Placement
    file: FileState
    #: The first burst that is certainly of the file, and the last one with a matching announcement.
    since: int
    until: int


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A burst that may be an announcement, under a placement of its columns."""

    epoch: int
    number: int
    placement: Placement
    buffer: Float32


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
        #: By what is equal in all announcements of a file: they differ in their burst.
        self.files: dict[Announcement, FileState] = {}
        #: Latest timeline of every epoch.
        self._timelines: dict[int, _Timeline] = {}
        #: Bursts that no announcement has settled yet: what follows the last one of a file may be of the next file.
        self._open: list[_Burst] = []
        self._candidates: list[_Candidate] = []
        self._n_shifted = 0
        #: Sentences about refused files.
        self.notes: list[str] = []

    def placement(self, epoch: int) -> Placement | None:
        """Placement of the columns by the announcements of this epoch; None if there were none."""
        return self._timelines[epoch].placement if epoch in self._timelines else None

    def add(self, soft: FrameSoftBits, settled: Placement | None) -> list[tuple[FileState, Container]]:
        """Add bursts and return the files that they complete; `settled` is the placement of their columns if known."""
        settled = settled or self.placement(soft.epoch)
        for number, llr in zip(soft.burst, soft.llr, strict=True):
            groups = [[settled]] if settled else possible_placements(llr)[: 2 + (self._n_shifted < _MAX_SHIFTED)]
            self._n_shifted += len(groups) > 2
            for placement in chain(*groups):
                self._look_for_announcement(soft.epoch, int(number), placement, placement.of(llr))
        bursts = [
            _Burst(soft.epoch, *burst) for burst in zip(soft.burst.tolist(), ldpc.quantised(soft.llr), strict=True)
        ]
        self._open += bursts
        del self._open[: -max(1, _MAX_OPEN // max(bursts[0].llr.size, 1))]
        line = self._timelines.get(soft.epoch)
        if line is not None:
            file = line.file
            file.first_time_s = soft.time_s if file.first_time_s is None else file.first_time_s
            file.last_time_s = soft.time_s
            file.frames_waited += 1
            _enter_bursts(line, [burst for burst in bursts if burst.number >= line.since], 1)
        return self._complete(at_last=False)

    def finish(self) -> list[tuple[FileState, Container]]:
        """Decode the remaining announcements and blocks."""
        self._try_candidates()
        return self._complete(at_last=True)

    # -- announcements -------------------------------------------------------------------------------------------------

    def _look_for_announcement(self, epoch: int, number: int, placement: Placement, llr: Float32) -> None:
        buffer = gathered(self._layout, llr)
        similarity = surprise(buffer) - surprise(llr)
        if similarity < MIN_SIMILARITY or information(buffer).sum() < TRY_FROM * self._layout.code.k:
            return
        is_similar = similarity > -MIN_SIMILARITY
        if is_similar or epoch not in self._timelines:
            self._candidates.append(_Candidate(epoch, number, placement, buffer))
        # Others have too few copies to decide. A batch costs little more than a single attempt.
        if is_similar or len(self._candidates) >= _ANNOUNCEMENTS_AT_ONCE:
            self._try_candidates()

    def _try_candidates(self) -> None:
        candidates, self._candidates = self._candidates, []
        if not candidates:
            return
        buffers = np.stack([candidate.buffer for candidate in candidates])
        found = read_words(self._layout.code, buffers, lambda _, word: unprotect_announcement(word))
        for candidate, announcement in zip(candidates, found, strict=True):
            if announcement is not None:
                self._announced(announcement, candidate)

    def _announced(self, announcement: Announcement, candidate: _Candidate) -> None:
        known = self.files.get(replace(announcement, burst=0))
        if known is None or known.dropped:
            known = self._begun(announcement)
            if known is None:
                return
        offset, number, placement = announcement.burst - candidate.number, candidate.number, candidate.placement
        line = self._timelines.get(candidate.epoch)
        if line is None or (line.offset, line.file, line.placement) != (offset, known, placement):
            # A change of files is certain where a file begins; later only its announcements are.
            begins = line is None or -offset > line.until
            before, line = line, _Timeline(offset, placement, known, -offset if begins else number, number)
            self._timelines[candidate.epoch] = line
            doubtful = [b for b in self._open if b.epoch == candidate.epoch and b.number >= -offset]
            if before is not None:
                _enter_bursts(before, [b for b in doubtful if b.number >= before.since], -1)
            _enter_bursts(line, [b for b in doubtful if b.number >= line.since], 1)
        line.until = max(line.until, number)
        self._open = [b for b in self._open if b.epoch != candidate.epoch or b.number > number]

    def _begun(self, announcement: Announcement) -> FileState | None:
        """Start a new file; None if it is too long."""
        if announcement.length > MAX_OBJECT_BYTES:
            self._add_note(
                f"a file of {announcement.length} bytes was announced, more than the accepted {MAX_OBJECT_BYTES}; "
                "it was not received"
            )
            return None
        file = FileState(announcement, self._columns, self._payload_symbols)
        if not self._under_way.admit(file):
            self._add_note(
                f"a file of {announcement.length} bytes was announced, which takes {file.n_bytes >> 20} MB to receive; "
                "it was not received (--file-memory)"
            )
            return None
        self.files = {key: known for key, known in self.files.items() if not known.dropped}
        self.files[replace(announcement, burst=0)] = file
        return file

    def _add_note(self, sentence: str) -> None:
        if sentence not in self.notes and len(self.notes) < _MAX_NOTES:
            self.notes.append(sentence)

    def _complete(self, at_last: bool) -> list[tuple[FileState, Container]]:
        """Read the blocks that are ready, and return the files that are whole by now."""
        found = []
        for file in self.files.values():
            if not file.under_way:
                continue
            file.read_ready(at_last)
            container = file.unpacked()
            if container is not None:
                found.append((file, container))
            elif file.failure:
                self._add_note(
                    f"a file of {file.layout.length} bytes is complete but not what was sent: {file.failure}"
                )
        return found


def _enter_bursts(line: _Timeline, bursts: list[_Burst], sign: int) -> None:
    if not bursts or not line.file.under_way:
        return
    counted = np.array([burst.number + line.offset for burst in bursts], np.int64)
    data = np.flatnonzero(counted % ANNOUNCEMENT_PERIOD)
    if data.size:
        line.file.add(counted[data], line.placement.of(np.stack([bursts[i].llr for i in data])), sign)
