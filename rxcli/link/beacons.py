"""Beacons: add up copies, bursts and photos of a message until it can be decoded."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import chain, product
from operator import itemgetter
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rxcli.link import ldpc
from rxcli.link.formats import unprotect_beacon
from rxcli.link.known_bits import KnownBits, known_bits
from rxcli.link.layout import BEACON_LENGTHS, BeaconLayout, beacon_layout
from rxcli.link.placement import Found, Placement, possible_placements
from rxcli.link.softbits import LN2, MIN_SIMILARITY, TRY_FROM, Float32, log_likelihood, surprise
from rxcli.types import FrameSoftBits, MessageKind

_T = TypeVar("_T")
#: Increase of information before the next attempt to decode a beacon, and the upper limit; relative to its bits.
_RETRY_GAIN, _TRY_UP_TO = 0.08, 2.5
#: Bits that must be observed, relative to the beacon's: the others may be known.
_MIN_OBSERVED = 0.5
#: `MIN_SIMILARITY` of bits that a message sends twice within a burst: one symbol may be misread.
_MIN_REPEATED = -30.0
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
    #: What was added.
    sources: tuple[str, ...] = ()

    def similarity(self) -> float:
        """Log-likelihood ratio of all bursts carrying one message."""
        return float(self.levels.sum()) - self.alone

    def gain(self, frame: _FrameSum, phase: int, placement: Placement) -> float:
        """Gain in similarity from a frame, if its burst number 0 has position `phase` and its columns are placed so."""
        slots = (frame.slots + phase) % len(self.total)
        joined = self.total[slots] + placement.of(frame.total)
        return float(surprise(joined) - self.levels[slots].sum()) - frame.alone

    def add(self, frame: _FrameSum, phase: int, placement: Placement, epoch: int) -> None:
        """Add a frame."""
        slots = (frame.slots + phase) % len(self.total)
        self.total[slots] += placement.of(frame.total)
        self.levels[slots] = surprise(self.total[slots], (1, 2, 3))
        self.alone += frame.alone
        self.epoch, self.phase, self.placement = epoch, phase, placement

    def settle(self, found: tuple[MessageKind, bytes], placement: Placement) -> None:
        """Place the sums as the decoded message shows."""
        self.found, self.placement = found, placement.after(self.placement)
        self.total = placement.of(self.total).copy()
        self.levels = surprise(self.total, (1, 2, 3))


class _FrameSum:
    """The bursts of a frame, added up by their number modulo P."""

    def __init__(self, soft: FrameSoftBits, period: int) -> None:
        #: (S,) distinct positions, and (S, N, C, 7) sums.
        self.slots, place = np.unique(soft.burst % period, return_inverse=True)
        self.total = np.zeros((self.slots.size, *soft.llr.shape[1:]), np.float32)
        np.add.at(self.total, place, soft.llr)
        #: Sum of `surprise` of every ratio; and log-likelihood ratio of bursts at the same position being equal.
        self.alone = float(surprise(soft.llr))
        self.similarity = float(surprise(self.total)) - self.alone


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
        #: Failed attempts in a row, and bursts since the last attempt.
        self._fruitless = self._waited = 0

    def add(self, soft: FrameSoftBits, settled: Placement | None) -> list[Found]:
        """Add bursts and return the messages found with them, known ones included.

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
                    found.append(Found(candidate.found, candidate.placement, candidate.sources))
        return found

    def _joined(self, period: int, soft: FrameSoftBits, settled: Placement | None) -> _Round | None:
        """Add the bursts to their round or to a new one; None if they contradict each other."""
        frame, rounds, as_numbered = _FrameSum(soft, period), self._rounds[period], settled or Placement()
        if frame.similarity < MIN_SIMILARITY:
            return None

        def scored(
            places: Iterable[tuple[_Round, int, Placement]], less: float = 0.0
        ) -> list[tuple[float, _Round, int, Placement]]:
            return [(known.gain(frame, phase, at) - less, known, phase, at) for known, phase, at in places]

        earlier = [known for known in rounds if known.epoch != soft.epoch]
        choices = scored((known, known.phase, known.placement) for known in rounds if known.epoch == soft.epoch)
        choices += scored(product(earlier, range(period), (as_numbered,)))
        if max((gain for gain, *_ in choices), default=np.inf) < _COPIES and settled is None:
            # Photographs may be numbered otherwise; that they carry the same message must then be certain.
            renumbered = product(earlier, range(period), chain(*possible_placements(frame.total)[1:]))
            choices += scored(renumbered, _COPIES - MIN_SIMILARITY)
        blank = _Round(np.zeros((period, *self._shape), np.float32), np.zeros(period), 0.0, soft.epoch)
        choices.insert(0, (MIN_SIMILARITY, blank, 0, as_numbered))
        _, candidate, phase, placement = max(choices, key=itemgetter(0))
        candidate.add(frame, phase, placement, soft.epoch)
        candidate.sources = tuple(dict.fromkeys((*candidate.sources, soft.source)))
        self._rounds[period] = [*(known for known in rounds if known is not candidate), candidate][-_MAX_ROUNDS:]
        return candidate

    def _try(self, candidate: _Round, settled: Placement | None) -> None:
        self._waited += 1
        # The bursts of most clips are no beacons and not similar.
        is_late = self._fruitless < _FREE_TRIALS or self._waited >= min(self._fruitless, _MAX_PAUSE)
        if candidate.found is not None or not (is_late or candidate.similarity() > _COPIES):
            return
        self._waited = 0
        n_observed, level = np.count_nonzero(candidate.total), float(candidate.levels.sum())
        groups = possible_placements(candidate.total)
        if settled is not None:
            groups = [[settled.after(candidate.placement.inverse)]]
        layouts = [each for each in self._layouts[len(candidate.total)] if n_observed >= _MIN_OBSERVED * each.code.k]
        for number, layout, phase in product(range(len(groups)), layouts, range(len(candidate.total))):
            key, total = (layout.length, phase, number), np.roll(candidate.total, phase, axis=0)
            last = candidate.tried.get(key, TRY_FROM - _RETRY_GAIN)
            if last >= _TRY_UP_TO:
                continue
            totals = [placement.of(total) for placement in groups[number]]
            bits, found = read_beacons(layout, totals, [level] * len(totals), min(last + _RETRY_GAIN, _TRY_UP_TO))
            if bits:
                candidate.tried[key] = bits
                self._fruitless += 1
            for place, content in found[:1]:
                candidate.settle(content, groups[number][place])
                self._fruitless = 0
                return


def gathered(layout: BeaconLayout, llr: Float32) -> Float32:
    """(n_bits,) sums of a round's log-likelihood ratios (P, N, C, 7) for each bit of the buffer."""
    return np.bincount(layout.places.ravel(), llr.ravel(), layout.n_bits).astype(np.float32)


def read_beacons(
    layout: BeaconLayout, totals: Sequence[Float32], levels: Sequence[float], min_information: float
) -> tuple[float, list[tuple[int, tuple[MessageKind, bytes]]]]:
    """Decode sums of soft bits as beacons of a layout, where bits that are sent twice agree.

    Args:
        layout: of the beacons.
        totals: (P, N, C, 7) log-likelihood ratios of each.
        levels: `surprise` of each, over all bits.
        min_information: from which one is tried, relative to its bits.

    Returns:
        Largest information at an attempt, relative to the bits, 0 without any; and place and content of
        each that is a message.
    """
    buffers = np.stack([gathered(layout, total) for total in totals])
    possible = np.flatnonzero(surprise(buffers, (1,)) - levels >= _MIN_REPEATED)
    buffers = buffers[possible]
    known = known_bits(layout, buffers)
    bits = known.information(buffers) / layout.code.k
    which = np.flatnonzero(bits >= min_information)
    if which.size == 0:
        return 0.0, []
    words = read_words(layout.code, buffers[which], lambda _, word: unprotect_beacon(word), known.of(which))
    found = [(place, word) for place, word in zip(possible[which].tolist(), words, strict=True) if word is not None]
    return float(bits[which].max()), found


def read_words(
    code: ldpc.Code, buffers: Float32, check: Callable[[int, bytes], _T | None], known: KnownBits | None = None
) -> list[_T | None]:
    """Decode codewords.

    Args:
        code: the code.
        buffers: (n, M) log-likelihood ratios of the first bits of the buffers.
        check: returns the content of information bytes, given their place in the batch, or None if they are wrong.
        known: what is known of their bits before.

    Returns:
        Content of each one; None if no sufficiently likely word is found.
    """
    n_known = np.zeros(len(buffers)) if known is None else known.n_bits
    llr = buffers if known is None else buffers + known.sent
    unsent = None if known is None else ldpc.quantised(known.unsent)
    found: list[_T | None] = [None] * len(buffers)

    def accepted(place: int, bits: NDArray[np.uint8]) -> bool:
        content = check(place, np.packbits(bits).tobytes())
        if content is not None and is_likely(code, bits, buffers[place], n_known[place]):
            found[place] = content
        return found[place] is not None

    ldpc.decode(code, ldpc.quantised(llr), accepted, unsent_llr=unsent)
    return found


def is_likely(code: ldpc.Code, information_bits: NDArray[np.uint8], buffer: Float32, n_known: float = 0.0) -> bool:
    """Whether a decoded word agrees with the soft bits, from which its known bits do not follow."""
    word = ldpc.encode(code, information_bits[None])[0, : buffer.size]
    return bool(log_likelihood(word, buffer) > _MIN_LIKELIHOOD * (code.k - n_known) * LN2)
