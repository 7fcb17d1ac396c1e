"""Beacons: copies, bursts and photos of one message are added until it can be read."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rxcli.link import ldpc
from rxcli.link.formats import unprotect_beacon
from rxcli.link.layout import BEACON_LENGTHS, BeaconLayout, beacon_layout
from rxcli.link.softbits import Float32, alike, information, log_likelihood, surprise
from rxcli.types import FrameSoftBits, MessageKind

#: Information from which on a beacon is tried, and by how much it must have grown to be tried again, in its bits.
_TRY_FROM, _TRY_AGAIN, _TRY_UP_TO = 1.02, 0.08, 2.5
_ITERATIONS, _PATIENCE = 25, ldpc.Patience(6, 0.95)
#: Information per sent bit from which parity alone shows that there is no codeword, and share of unsatisfied checks
#: that shows it: half of them are by chance, a quarter of those of a codeword seen so well.
_WELL_SEEN, _NO_CODEWORD = 0.9, 0.4
#: Bursts less alike than this, a log-likelihood, are not of one message; so are copies within one.
_NOT_ALIKE = -8.0
#: A first look takes only every so manieth column and bit.
_COARSE_STEP = 3
#: Bursts at least so much alike are copies of each other.
_COPIES = 8.0
#: A decoded word must be at least so likely, as a share of its bits' ln 2: by chance the CRC of one fits that is not.
_MIN_LIKELIHOOD = 0.5
#: Rounds that may be under way at a time, and fruitless trials of single bursts that are made at once; after these a
#: burst is tried only every so many as were fruitless, up to a limit.
_MAX_ROUNDS, _FREE_TRIALS, _MAX_PAUSE = 3, 12, 512


@dataclass(slots=True, eq=False)
class _Round:
    """Bursts that are taken to be of one message, added up by their place in a round of P."""

    #: (P, N, C, 7) sums, and (P,) their `surprise` over all bits.
    total: Float32
    levels: NDArray[np.float64]
    #: Sum of `surprise` of everything that was added.
    alone: float
    epoch: int
    #: Place of burst number 0 of the epoch.
    phase: int
    #: Information at the last trial of (length, phase).
    tried: dict[tuple[int, int], float] = field(default_factory=dict)
    #: What it turned out to be.
    found: tuple[MessageKind, bytes] | None = None

    def likeness(self) -> float:
        """Log-likelihood that all bursts are of one message."""
        return float(self.levels.sum()) - self.alone

    def gain(self, frame: _FrameSum, phase: int) -> float:
        """What a frame adds to the likeness if its burst number 0 has a place."""
        slots = (frame.slots + phase) % len(self.total)
        joined = self.total[slots] + frame.total
        return float(surprise(joined).sum(dtype=np.float64) - self.levels[slots].sum()) - frame.alone

    def add(self, frame: _FrameSum, phase: int, epoch: int) -> None:
        """Add a frame."""
        slots = (frame.slots + phase) % len(self.total)
        self.total[slots] += frame.total
        self.levels[slots] = _levels(self.total[slots])
        self.alone += frame.alone
        self.epoch, self.phase = epoch, phase


@dataclass(frozen=True, slots=True)
class _FrameSum:
    """The bursts of a frame, added up by their number modulo P."""

    #: (S,) different places, and (S, N, C, 7) sums.
    slots: NDArray[np.int64]
    total: Float32
    #: Sum of `surprise` of every ratio.
    alone: float

    def likeness(self) -> float:
        """Log-likelihood that bursts at the same place are alike."""
        return float(_levels(self.total).sum()) - self.alone


def _levels(total: Float32) -> NDArray[np.float64]:
    return np.asarray(surprise(total).sum(axis=(1, 2, 3), dtype=np.float64))


def _frame_sum(soft: FrameSoftBits, period: int) -> _FrameSum:
    slots, place = np.unique(soft.burst % period, return_inverse=True)
    total = np.zeros((slots.size, *soft.llr.shape[1:]), np.float32)
    for burst, slot in enumerate(place):
        total[slot] += soft.llr[burst]
    return _FrameSum(slots, total, float(surprise(soft.llr).sum(dtype=np.float64)))


class BeaconSearch:
    """Looks for beacons of every length.

    Args:
        columns: C.
        payload_symbols: N.
    """

    def __init__(self, columns: int, payload_symbols: int) -> None:
        layouts = [beacon_layout(length, columns, payload_symbols) for length in BEACON_LENGTHS]
        self._layouts = {
            period: [layout for layout in layouts if layout.period == period]
            for period in {layout.period for layout in layouts}
        }
        self._shape = (payload_symbols, columns, 7)
        #: By period, latest last.
        self._rounds: dict[int, list[_Round]] = {period: [] for period in self._layouts}
        self._fruitless = dict.fromkeys(self._layouts, 0)
        self._waited = dict.fromkeys(self._layouts, 0)

    def add(self, soft: FrameSoftBits) -> list[tuple[MessageKind, bytes]]:
        """Add bursts; returns the messages that they show, known ones too."""
        found = []
        for period in self._layouts:
            now = self._joined(period, soft)
            if now is not None:
                self._try(now)
                if now.found is not None:
                    found.append(now.found)
        return found

    def _joined(self, period: int, soft: FrameSoftBits) -> _Round | None:
        """The round that the bursts belong to, with them, or a new one; None where they contradict each other."""
        if len(soft.burst) > period and _contradicts(soft, period):
            return None
        frame = _frame_sum(soft, period)
        if frame.likeness() < _NOT_ALIKE:
            return None
        rounds = self._rounds[period]
        choices = [
            (known.gain(frame, phase), place, phase)
            for place, known in enumerate(rounds)
            for phase in ((known.phase,) if known.epoch == soft.epoch else range(period))
        ]
        gain, place, phase = max(choices, default=(-np.inf, 0, 0))
        if gain > _NOT_ALIKE:
            now = rounds.pop(place)
        else:
            blank = np.zeros((period, *self._shape), np.float32)
            now, phase = _Round(blank, np.zeros(period), 0.0, soft.epoch, 0), 0
        now.add(frame, phase, soft.epoch)
        rounds.append(now)
        del rounds[:-_MAX_ROUNDS]
        return now

    def _try(self, now: _Round) -> None:
        if now.found is not None or not self._worth_while(now):
            return
        n_seen = np.count_nonzero(now.total)
        for layout in self._layouts[len(now.total)]:
            if n_seen < _TRY_FROM * layout.code.k:
                continue
            for phase in range(len(now.total)):
                now.found = self._tried(now, layout, phase)
                if now.found is not None:
                    self._fruitless[len(now.total)] = 0
                    return

    def _worth_while(self, now: _Round) -> bool:
        """Whether to try at all: most clips send something else, and their bursts are not alike."""
        if now.likeness() > _COPIES or self._fruitless[len(now.total)] < _FREE_TRIALS:
            return True
        self._waited[len(now.total)] += 1
        if self._waited[len(now.total)] < min(self._fruitless[len(now.total)], _MAX_PAUSE):
            return False
        self._waited[len(now.total)] = 0
        return True

    def _tried(self, now: _Round, layout: BeaconLayout, phase: int) -> tuple[MessageKind, bytes] | None:
        buffer = gathered(layout, np.roll(now.total, phase, axis=0))
        bits = float(information(buffer).sum()) / layout.code.k
        last = now.tried.get((layout.length, phase), _TRY_FROM - _TRY_AGAIN)
        if bits < min(last + _TRY_AGAIN, _TRY_UP_TO) or last >= _TRY_UP_TO:
            return None
        if alike(buffer, float(now.levels.sum())) < _NOT_ALIKE:
            return None
        now.tried[layout.length, phase] = bits
        self._fruitless[len(now.total)] += 1
        words = read_words(layout, buffer[None])
        return None if words[0] is None else unprotect_beacon(words[0])


def _contradicts(soft: FrameSoftBits, period: int) -> bool:
    """Whether bursts of a frame that have the same place differ plainly, by a few of their bits."""
    some = FrameSoftBits(soft.burst, soft.llr[:, :, ::_COARSE_STEP, ::_COARSE_STEP])
    return _frame_sum(some, period).likeness() < 2 * _NOT_ALIKE


def gathered(layout: BeaconLayout, llr: Float32) -> Float32:
    """(n_bits,) sums of a round's ratios (P, N, C, 7) by the bit of the buffer that they are of."""
    return np.bincount(layout.places.ravel(), llr.ravel(), layout.n_bits).astype(np.float32)


def read_words(layout: BeaconLayout, buffers: Float32, accept: object = None) -> list[bytes | None]:
    """Decode buffers (n, n_bits) of a layout; None where nothing is found that is as likely as it should be."""
    found: list[bytes | None] = [None] * len(buffers)
    check = unprotect_beacon if accept is None else accept
    well_seen = information(buffers).mean(axis=1) > _WELL_SEEN
    unsatisfied = ldpc.sent_parity(layout.code, (buffers > 0).astype(np.uint8))
    tried = np.flatnonzero(~well_seen | (unsatisfied < _NO_CODEWORD))

    def accepted(places: NDArray[np.int64], bits: NDArray[np.uint8]) -> NDArray[np.bool_]:
        good = np.zeros(places.size, bool)
        for i, (place, coded) in enumerate(zip(tried[places], np.packbits(bits, axis=1), strict=True)):
            if check(coded.tobytes()) is not None and is_likely(layout, bits[i], buffers[place]):  # type: ignore[operator]
                found[place], good[i] = coded.tobytes(), True
        return good

    if tried.size:
        ldpc.decode(layout.code, ldpc.quantised(buffers[tried]), accepted, _ITERATIONS, _PATIENCE)
    return found


def is_likely(layout: BeaconLayout, information_bits: NDArray[np.uint8], buffer: Float32) -> bool:
    """Whether a decoded word agrees with what was seen."""
    word = ldpc.encode(layout.code, np.asarray(information_bits, np.uint8)[None])[0, : buffer.size]
    return bool(log_likelihood(word, buffer) > _MIN_LIKELIHOOD * layout.code.k * np.log(2.0))
