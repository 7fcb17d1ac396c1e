"""Beacons: add up copies, bursts and photos of a message until it can be decoded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rxcli.link import ldpc
from rxcli.link.formats import unprotect_beacon
from rxcli.link.layout import BEACON_LENGTHS, BeaconLayout, beacon_layout
from rxcli.link.softbits import Float32, information, log_likelihood, same_bits_llr, surprise
from rxcli.types import FrameSoftBits, MessageKind

#: Information at which a beacon is first decoded, its increase before the next attempt, and the upper limit; relative
#: to the beacon's bits.
_TRY_FROM, _RETRY_GAIN, _TRY_UP_TO = 1.02, 0.08, 2.5
_ITERATIONS = 25
#: Log-likelihood ratio below which bursts, or copies within one burst, do not carry the same message.
_MIN_SIMILARITY = -8.0
#: Log-likelihood ratio above which bursts are copies of each other.
_COPIES = 8.0
#: Minimum log-likelihood of a decoded word per bit, relative to ln 2: the CRC of a wrong word may fit by chance.
_MIN_LIKELIHOOD = 0.5
#: Maximum number of open rounds; failed attempts on single bursts before attempts are spaced; and the largest spacing,
#: which otherwise equals the number of failed attempts.
_MAX_ROUNDS, _FREE_TRIALS, _MAX_PAUSE = 3, 12, 512


@dataclass(slots=True, eq=False)
class _Round:
    """Sum of the bursts of one candidate message, by their position in a round of P bursts."""

    #: (P, N, C, 7) sums, and (P,) their `surprise` over all bits.
    total: Float32
    levels: NDArray[np.float64]
    #: Sum of `surprise` of everything that was added.
    alone: float
    epoch: int
    #: Position of burst number 0 of the epoch.
    phase: int
    #: Information at the last attempt for (length, phase).
    tried: dict[tuple[int, int], float] = field(default_factory=dict)
    #: The decoded message.
    found: tuple[MessageKind, bytes] | None = None

    def similarity(self) -> float:
        """Log-likelihood ratio of all bursts carrying one message."""
        return float(self.levels.sum()) - self.alone

    def gain(self, frame: _FrameSum, phase: int) -> float:
        """Gain in similarity from a frame, if its burst number 0 has position `place`."""
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

    #: (S,) distinct positions, and (S, N, C, 7) sums.
    slots: NDArray[np.int64]
    total: Float32
    #: Sum of `surprise` of every ratio.
    alone: float

    def similarity(self) -> float:
        """Log-likelihood ratio of bursts at the same position being equal."""
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
    """Search for beacons of every length.

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
        #: Rounds by period, latest last.
        self._rounds: dict[int, list[_Round]] = {period: [] for period in self._layouts}
        self._fruitless = dict.fromkeys(self._layouts, 0)
        self._waited = dict.fromkeys(self._layouts, 0)

    def add(self, soft: FrameSoftBits) -> list[tuple[MessageKind, bytes]]:
        """Add bursts and return the messages found with them, known ones included."""
        found = []
        for period in self._layouts:
            candidate = self._joined(period, soft)
            if candidate is not None:
                self._try(candidate)
                if candidate.found is not None:
                    found.append(candidate.found)
        return found

    def _joined(self, period: int, soft: FrameSoftBits) -> _Round | None:
        """Add the bursts to their round or to a new one; None if they contradict each other."""
        frame = _frame_sum(soft, period)
        if frame.similarity() < _MIN_SIMILARITY:
            return None
        rounds = self._rounds[period]
        choices = [
            (known.gain(frame, phase), place, phase)
            for place, known in enumerate(rounds)
            for phase in ((known.phase,) if known.epoch == soft.epoch else range(period))
        ]
        gain, place, phase = max(choices, default=(-np.inf, 0, 0))
        if gain > _MIN_SIMILARITY:
            candidate = rounds.pop(place)
        else:
            blank = np.zeros((period, *self._shape), np.float32)
            candidate, phase = _Round(blank, np.zeros(period), 0.0, soft.epoch, 0), 0
        candidate.add(frame, phase, soft.epoch)
        rounds.append(candidate)
        del rounds[:-_MAX_ROUNDS]
        return candidate

    def _try(self, candidate: _Round) -> None:
        if candidate.found is not None or not self._worth_while(candidate):
            return
        n_observed = np.count_nonzero(candidate.total)
        for layout in self._layouts[len(candidate.total)]:
            if n_observed < _TRY_FROM * layout.code.k:
                continue
            for phase in range(len(candidate.total)):
                candidate.found = self._tried(candidate, layout, phase)
                if candidate.found is not None:
                    self._fruitless[len(candidate.total)] = 0
                    return

    def _worth_while(self, candidate: _Round) -> bool:
        """Whether to attempt decoding: the bursts of most clips are no beacons and not similar."""
        if candidate.similarity() > _COPIES or self._fruitless[len(candidate.total)] < _FREE_TRIALS:
            return True
        self._waited[len(candidate.total)] += 1
        if self._waited[len(candidate.total)] < min(self._fruitless[len(candidate.total)], _MAX_PAUSE):
            return False
        self._waited[len(candidate.total)] = 0
        return True

    def _tried(self, candidate: _Round, layout: BeaconLayout, phase: int) -> tuple[MessageKind, bytes] | None:
        buffer = gathered(layout, np.roll(candidate.total, phase, axis=0))
        bits = float(information(buffer).sum()) / layout.code.k
        last = candidate.tried.get((layout.length, phase), _TRY_FROM - _RETRY_GAIN)
        if bits < min(last + _RETRY_GAIN, _TRY_UP_TO) or last >= _TRY_UP_TO:
            return None
        if same_bits_llr(buffer, float(candidate.levels.sum())) < _MIN_SIMILARITY:
            return None
        candidate.tried[layout.length, phase] = bits
        self._fruitless[len(candidate.total)] += 1
        words = read_words(layout, buffer[None])
        return None if words[0] is None else unprotect_beacon(words[0])


def gathered(layout: BeaconLayout, llr: Float32) -> Float32:
    """(n_bits,) sums of a round's log-likelihood ratios (P, N, C, 7) for each bit of the buffer."""
    return np.bincount(layout.places.ravel(), llr.ravel(), layout.n_bits).astype(np.float32)


def read_words(
    layout: BeaconLayout, buffers: Float32, check: Callable[[bytes], object] = unprotect_beacon
) -> list[bytes | None]:
    """Decode buffers (n, n_bits) of a layout; None if no sufficiently likely word is found."""
    found: list[bytes | None] = [None] * len(buffers)

    def accepted(places: NDArray[np.int64], bits: NDArray[np.uint8]) -> NDArray[np.bool_]:
        good = np.zeros(places.size, bool)
        for i, (place, coded) in enumerate(zip(places, np.packbits(bits, axis=1), strict=True)):
            if check(coded.tobytes()) is not None and is_likely(layout, bits[i], buffers[place]):
                found[place], good[i] = coded.tobytes(), True
        return good

    ldpc.decode(layout.code, ldpc.quantised(buffers), accepted, _ITERATIONS, gives_up=True)
    return found


def is_likely(layout: BeaconLayout, information_bits: NDArray[np.uint8], buffer: Float32) -> bool:
    """Whether a decoded word agrees with the soft bits."""
    word = ldpc.encode(layout.code, np.asarray(information_bits, np.uint8)[None])[0, : buffer.size]
    return bool(log_likelihood(word, buffer) > _MIN_LIKELIHOOD * layout.code.k * np.log(2.0))
