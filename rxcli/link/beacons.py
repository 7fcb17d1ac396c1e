"""Beacons: add up copies, bursts and photos of a message until it can be decoded."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from rxcli.link import ldpc
from rxcli.link.formats import unprotect_beacon
from rxcli.link.known_bits import KnownBits, known_bits
from rxcli.link.layout import BEACON_LENGTHS, BeaconLayout, beacon_layout
from rxcli.link.placement import Placement, possible_placements
from rxcli.link.softbits import LN2, MIN_SIMILARITY, TRY_FROM, Float32, log_likelihood, same_bits_llr, surprise
from rxcli.types import FrameSoftBits, MessageKind

#: Increase of information before the next attempt to decode a beacon, and the upper limit; relative to its bits.
_RETRY_GAIN, _TRY_UP_TO = 0.08, 2.5
#: Bits that must be observed, relative to the beacon's: the others may be known.
_MIN_OBSERVED = 0.5
_ITERATIONS = 40
#: `MIN_SIMILARITY` of bits that a message sends twice within a burst: one symbol may be misread.
MIN_REPEATED = -30.0
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
    #: Position of burst number 0 of the epoch, and how the epoch's columns are placed in the sums.
    phase: int = 0
    placement: Placement = field(default_factory=Placement)
    #: Information at the last attempt for (length, phase, group of placements).
    tried: dict[tuple[int, int, int], float] = field(default_factory=dict)
    #: The decoded message.
    found: tuple[MessageKind, bytes] | None = None

    def similarity(self) -> float:
        """Log-likelihood ratio of all bursts carrying one message."""
        return float(self.levels.sum()) - self.alone

    def gain(self, frame: _FrameSum, phase: int, placement: Placement) -> float:
        """Gain in similarity from a frame, if its burst number 0 has position `phase` and its columns are placed so."""
        slots = (frame.slots + phase) % len(self.total)
        joined = self.total[slots] + placement.of(frame.total)
        return float(surprise(joined).sum(dtype=np.float64) - self.levels[slots].sum()) - frame.alone

    def add(self, frame: _FrameSum, phase: int, placement: Placement, epoch: int) -> None:
        """Add a frame."""
        slots = (frame.slots + phase) % len(self.total)
        self.total[slots] += placement.of(frame.total)
        self.levels[slots] = _levels(self.total[slots])
        self.alone += frame.alone
        self.epoch, self.phase, self.placement = epoch, phase, placement

    def settle(self, found: tuple[MessageKind, bytes], placement: Placement) -> None:
        """Place the sums as the decoded message shows."""
        self.found, self.placement = found, placement.after(self.placement)
        self.total = placement.of(self.total).copy()
        self.levels = _levels(self.total)


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

    def add(self, soft: FrameSoftBits, settled: Placement | None) -> list[tuple[tuple[MessageKind, bytes], Placement]]:
        """Add bursts and return the messages found with them, known ones included, with the placement of the columns.

        Args:
            soft: the bursts.
            settled: placement of their columns, None while it is open.
        """
        found = []
        for period in self._layouts:
            candidate = self._joined(period, soft, settled)
            if candidate is not None:
                self._try(candidate, settled)
                if candidate.found is not None:
                    found.append((candidate.found, candidate.placement))
        return found

    def _joined(self, period: int, soft: FrameSoftBits, settled: Placement | None) -> _Round | None:
        """Add the bursts to their round or to a new one; None if they contradict each other."""
        frame = _frame_sum(soft, period)
        if frame.similarity() < MIN_SIMILARITY:
            return None
        rounds, as_numbered = self._rounds[period], settled or Placement()
        choices = [
            (known.gain(frame, phase, placement), place, phase, placement)
            for place, known in enumerate(rounds)
            for phase, placement in (
                ((known.phase, known.placement),)
                if known.epoch == soft.epoch
                else product(range(period), (as_numbered,))
            )
        ]
        if max((gain for gain, *_ in choices), default=np.inf) < _COPIES and settled is None:
            # Photographs may be numbered otherwise; that they carry the same message must then be certain.
            elsewhere = [placement for group in possible_placements(frame.total)[1:] for placement in group]
            choices += [
                (known.gain(frame, phase, placement) + MIN_SIMILARITY - _COPIES, place, phase, placement)
                for place, known in enumerate(rounds)
                if known.epoch != soft.epoch
                for phase, placement in product(range(period), elsewhere)
            ]
        gain, place, phase, placement = max(choices, key=itemgetter(0), default=(-np.inf, 0, 0, as_numbered))
        if gain > MIN_SIMILARITY:
            candidate = rounds.pop(place)
        else:
            blank = np.zeros((period, *self._shape), np.float32)
            candidate, phase, placement = _Round(blank, np.zeros(period), 0.0, soft.epoch), 0, as_numbered
        candidate.add(frame, phase, placement, soft.epoch)
        rounds.append(candidate)
        del rounds[:-_MAX_ROUNDS]
        return candidate

    def _try(self, candidate: _Round, settled: Placement | None) -> None:
        if candidate.found is not None or not self._worth_while(candidate):
            return
        n_observed, period = np.count_nonzero(candidate.total), len(candidate.total)
        groups = possible_placements(candidate.total)
        if settled is not None:
            groups = [[settled.after(candidate.placement.inverse)]]
        layouts = [layout for layout in self._layouts[period] if n_observed >= _MIN_OBSERVED * layout.code.k]
        for number, layout, phase in product(range(len(groups)), layouts, range(period)):
            for placement, found in self._tried(candidate, layout, phase, number, groups[number]):
                candidate.settle(found, placement)
                self._fruitless[period] = 0
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

    def _tried(
        self, candidate: _Round, layout: BeaconLayout, phase: int, group: int, placements: Sequence[Placement]
    ) -> Iterator[tuple[Placement, tuple[MessageKind, bytes]]]:
        """Decode a candidate under a group of placements, and yield each one that gives a message."""
        total, key = np.roll(candidate.total, phase, axis=0), (layout.length, phase, group)
        last = candidate.tried.get(key, TRY_FROM - _RETRY_GAIN)
        if last >= _TRY_UP_TO:
            return
        buffers = np.stack([gathered(layout, placement.of(total)) for placement in placements])
        alone = float(candidate.levels.sum())
        possible = np.flatnonzero([same_bits_llr(buffer, alone) >= MIN_REPEATED for buffer in buffers])
        if possible.size == 0:
            return
        buffers = buffers[possible]
        known = known_bits(layout, buffers)
        bits = known.information(buffers) / layout.code.k
        which = np.flatnonzero(bits >= min(last + _RETRY_GAIN, _TRY_UP_TO))
        if which.size == 0:
            return
        candidate.tried[key] = float(bits[which].max())
        self._fruitless[len(candidate.total)] += 1
        words = read_words(layout, buffers[which], known=known.of(which))
        for place, word in zip(possible[which].tolist(), words, strict=True):
            found = None if word is None else unprotect_beacon(word)
            if found is not None:
                yield placements[place], found


def gathered(layout: BeaconLayout, llr: Float32) -> Float32:
    """(n_bits,) sums of a round's log-likelihood ratios (P, N, C, 7) for each bit of the buffer."""
    return np.bincount(layout.places.ravel(), llr.ravel(), layout.n_bits).astype(np.float32)


def read_words(
    layout: BeaconLayout,
    buffers: Float32,
    check: Callable[[bytes], object] = unprotect_beacon,
    known: KnownBits | None = None,
) -> list[bytes | None]:
    """Decode buffers (n, n_bits) of a layout; None if no sufficiently likely word is found."""
    n_known = np.zeros(len(buffers)) if known is None else known.n_bits
    llr = buffers if known is None else buffers + known.sent
    unsent = None if known is None else ldpc.quantised(known.unsent)
    found: list[bytes | None] = [None] * len(buffers)

    def accepted(places: NDArray[np.int64], bits: NDArray[np.uint8]) -> NDArray[np.bool_]:
        good = np.zeros(places.size, bool)
        for i, (place, coded) in enumerate(zip(places, np.packbits(bits, axis=1), strict=True)):
            if check(coded.tobytes()) is not None and is_likely(layout, bits[i], buffers[place], n_known[place]):
                found[place], good[i] = coded.tobytes(), True
        return good

    ldpc.decode(layout.code, ldpc.quantised(llr), accepted, _ITERATIONS, gives_up=True, unsent_llr=unsent)
    return found


def is_likely(layout: BeaconLayout, information_bits: NDArray[np.uint8], buffer: Float32, n_known: float = 0.0) -> bool:
    """Whether a decoded word agrees with the soft bits, from which its known bits do not follow."""
    word = ldpc.encode(layout.code, np.asarray(information_bits, np.uint8)[None])[0, : buffer.size]
    return bool(log_likelihood(word, buffer) > _MIN_LIKELIHOOD * (layout.code.k - n_known) * LN2)
