"""The data that were sent, from `NAME.truth.json`, and the score of a reception against them.

A packet is *expected*, once per source and column, when some frame shows its burst for at least 1.02 packet lengths. It
is *lost* when nothing was reported for it or more than a quarter of its bits are wrong. A reported packet is *false*
when it differs in more than a quarter of its bits from every burst of its frame and of the frame before. A packet that
several bursts send is received in all of them.

The truth of a transmission (`vlc-rx encode --truth`) knows no frames. The packets of all columns of a frame then find
its bursts together, and the bursts that were found are expected; where none was, one.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sized
from dataclasses import dataclass, fields, replace
from pathlib import Path
from string import hexdigits
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from rxcli.errors import InputError, failure_explained
from rxcli.protocol import WEIGHTS, packet_slots, payload_bits
from rxcli.resources import read_limited
from rxcli.types import ColumnResult, FrameResult, PacketResult

TRUTH_SUFFIX = ".truth.json"
#: A burst seen for fewer packet lengths than this is not expected to be received.
EXPECTED_LENGTHS = 1.02
#: Above this share of wrong bits a packet is lost or false.
MAX_WRONG_SHARE = 0.25
#: Share of the best burst's agreement from which a frame shows another burst of a transmission, too.
_ALSO_SHOWN = 0.3

#: Longer truths than those of hours of video are none.
_MAX_BYTES = 1 << 28

Count = Annotated[int, Meta(ge=0, lt=1 << 40)]


class TruthBurst(msgspec.Struct, frozen=True):
    """How much of one burst one frame shows."""

    burst: Count
    visible_slots: Annotated[float, Meta(ge=0, le=1e9)]


class TruthFrame(msgspec.Struct, frozen=True):
    """The bursts that one frame shows."""

    frame: Count
    bursts: tuple[TruthBurst, ...]


class Truth(msgspec.Struct, frozen=True, kw_only=True):
    """What was sent. Unlike profiles, truth files may hold further keys, which are passed over."""

    columns: Annotated[int, Meta(ge=1, le=1000)]
    payload_symbols: Annotated[int, Meta(ge=1, le=1000)]
    #: Lit slots per symbol, per column.
    w: tuple[int, ...]
    #: Payload bits of one packet, per column.
    payload_bits: tuple[Annotated[int, Meta(ge=0, le=7000)], ...]
    #: Empty for a transmission: photographs may show any part of it.
    frames: tuple[TruthFrame, ...] = ()
    #: Burst number -> one hex string per column, first bit most significant.
    payload: dict[int, tuple[str, ...]]
    #: Burst number -> `w` per column, of a film whose picture dims the columns; others have `w` all the time.
    w_of_burst: dict[int, tuple[int, ...]] = {}
    screen: str | None = None
    camera: dict[str, Any] | None = None

    def bits(self, burst: int, column: int) -> int:
        """Payload bits of a packet."""
        weights = self.w_of_burst.get(burst)
        return self.payload_bits[column] if weights is None else payload_bits(weights[column], self.payload_symbols)

    @property
    def expected_bursts(self) -> frozenset[int]:
        """Bursts that some frame shows sufficiently."""
        enough = EXPECTED_LENGTHS * packet_slots(self.payload_symbols)
        return frozenset(b.burst for f in self.frames for b in f.bursts if b.visible_slots >= enough)


def truth_path(capture: str | Path) -> Path:
    """Where the truth of `capture` lies: `a.jpg` -> `a.truth.json`."""
    path = Path(capture)
    return path.with_name(path.stem + TRUTH_SUFFIX)


def truth_for(capture: str | Path, asked: str | Path | None) -> Path | None:
    """The truth of `capture` where a file is asked for, or "auto" for the one beside it; None where there is none."""
    path = truth_path(capture) if asked == "auto" else asked and Path(asked)
    return path if path and (asked != "auto" or os.path.isfile(path)) else None


def load_truth(path: str | Path) -> Truth:
    """Load and check a truth file.

    Raises:
        InputError: it cannot be read, is no JSON, lacks a key, or contradicts itself.
    """
    with failure_explained(f"{path}: cannot be read as truth", "name a NAME.truth.json file"):
        truth = msgspec.json.decode(read_limited(Path(path), _MAX_BYTES), type=Truth)
    for problem in _contradictions(truth):
        raise InputError(f"{path}: {problem}", "correct the truth file")
    return truth


def _contradictions(truth: Truth) -> Iterator[str]:
    """What is inconsistent in `truth`."""
    per_column: dict[str, Sized] = {"w": truth.w, "payload_bits": truth.payload_bits}
    per_column |= {f"payload of burst {burst}": row for burst, row in truth.payload.items()}
    per_column |= {f"w of burst {burst}": row for burst, row in truth.w_of_burst.items()}
    for name, values in per_column.items():
        if len(values) != truth.columns:
            yield f"{name} must have one entry per column, {truth.columns} (got {len(values)})"
    for w in sorted(set(truth.w).union(*truth.w_of_burst.values()) - set(WEIGHTS)):
        yield f"w must be in 1..9 (got {w})"
    if not truth.payload:
        yield "no payload is known; name the file that vlc-rx encode --truth wrote of these slots"
    for burst in sorted({b.burst for f in truth.frames for b in f.bursts} - truth.payload.keys()):
        yield f"payload must hold every burst that a frame shows (burst {burst} is missing)"
    for burst, row in truth.payload.items():
        for column, text in enumerate(row):
            n = truth.bits(burst, column)
            if 4 * len(text) < n or not set(text) <= set(hexdigits):
                yield f"payload of burst {burst}, column {column}, must be hex of at least {n} bits (got {text!r:.60})"


def wrong_bits(received: str, n_received: int, sent: str, n_sent: int) -> int:
    """Bits in which two payloads differ; where one is longer, each bit that the other lacks counts as wrong.

    Args:
        received: hex, first bit most significant.
        n_received: bits of it that count.
        sent: hex, likewise.
        n_sent: bits of it that count.
    """
    common = min(n_received, n_sent)
    difference = _leading_bits(received, common) ^ _leading_bits(sent, common)
    return difference.bit_count() + abs(n_received - n_sent)


def _leading_bits(text: str, n_bits: int) -> int:
    return int(text or "0", 16) >> 4 * len(text) - n_bits


@dataclass(frozen=True, slots=True)
class Score:
    """How well the reception of one or more sources agrees with the truth; scores can be added."""

    #: Packets that should have been received, and their bits.
    expected: int = 0
    bits: int = 0
    #: Expected packets received without a wrong bit.
    error_free: int = 0
    #: Wrong bits of the expected packets that are not lost.
    bit_errors: int = 0
    lost: int = 0
    lost_bits: int = 0
    #: Reported packets that nobody sent.
    false: int = 0
    #: Packets received though no single frame shows enough of their burst, and those of them without a wrong bit.
    extra: int = 0
    extra_error_free: int = 0
    #: Columns (of each frame) whose reported `w` is wrong.
    wrong_w: int = 0

    @property
    def ber(self) -> float | None:
        """Bit error rate in which half the bits of a lost packet count as wrong; None where nothing was expected."""
        return (self.bit_errors + self.lost_bits / 2) / self.bits if self.bits else None

    def __add__(self, score: Score) -> Score:
        return Score(*(getattr(self, f.name) + getattr(score, f.name) for f in fields(Score)))


@dataclass(frozen=True, slots=True, order=True)
class Fault:
    """An expected packet that did not come as it was sent."""

    column: int
    burst: int
    #: None: lost.
    wrong_bits: int | None

    def __str__(self) -> str:
        what = "lost" if self.wrong_bits is None else f"{self.wrong_bits} wrong bits"
        return f"column {self.column} burst {self.burst} ({what})"


class Scorer:
    """Scores the frames of one source as they come.

    Args:
        truth: what was sent.
    """

    def __init__(self, truth: Truth) -> None:
        self._truth = truth
        self._bursts = {f.frame: tuple(b.burst for b in f.bursts) for f in truth.frames}
        #: Of a transmission: one burst of each content; bursts that frames were found to show.
        self._distinct = tuple({row: burst for burst, row in sorted(truth.payload.items(), reverse=True)}.values())
        self._located: set[int] = set()
        self._fewest: dict[tuple[int, int], int] = {}
        self._false = 0
        self._wrong_w = 0

    def add(self, result: FrameResult) -> FrameResult:
        """Take the next frame into account; returns it with `bit_errors` filled in."""
        if not self._truth.frames:
            candidates = self._shown(result)
            self._located.update(candidates)
        else:
            candidates = self._bursts.get(result.frame - 1, ()) + self._bursts.get(result.frame, ())
        columns = tuple(self._add_column(column, candidates) for column in result.columns)
        return replace(result, columns=columns)

    def _shown(self, result: FrameResult) -> tuple[int, ...]:
        """Bursts of a transmission with which the packets of a frame agree, all columns together."""
        agreement, packets = dict.fromkeys(self._distinct, 0.0), []
        for column in result.columns:
            for packet in column.packets if column.column < self._truth.columns else ():
                bits = {}
                for burst in self._distinct:
                    errors, n_bits = self._errors(packet, column.column, burst)
                    if errors <= MAX_WRONG_SHARE * n_bits:
                        bits[burst] = n_bits - errors
                        agreement[burst] += MAX_WRONG_SHARE * n_bits - errors
                packets.append(bits)
        enough = _ALSO_SHOWN * max(agreement.values(), default=0.0)
        # Each packet is of one burst: those of a counter differ in few bits.
        likely = [{burst: n for burst, n in bits.items() if agreement[burst] >= enough} for bits in packets]
        return tuple({max(bits, key=lambda burst: (bits[burst], agreement[burst])) for bits in likely if bits})

    def _errors(self, packet: PacketResult, column: int, burst: int) -> tuple[int, int]:
        """Wrong bits of a packet if it is that of a burst, and the bits of the longer of both."""
        sent, n_sent = self._truth.payload[burst][column], self._truth.bits(burst, column)
        errors = wrong_bits(packet.payload, packet.payload_bits, sent, n_sent)
        return errors, max(n_sent, packet.payload_bits)

    def _add_column(self, column: ColumnResult, bursts: tuple[int, ...]) -> ColumnResult:
        sent = [self._truth.w, *filter(None, map(self._truth.w_of_burst.get, bursts))]
        is_known = column.column < self._truth.columns
        self._wrong_w += column.w not in (None, *(weights[column.column] for weights in sent if is_known))
        candidates = bursts if is_known else ()
        return replace(column, packets=tuple(self._add_packet(p, column.column, candidates) for p in column.packets))

    def _add_packet(self, packet: PacketResult, column: int, bursts: tuple[int, ...]) -> PacketResult:
        if not bursts:
            self._false += 1
            return replace(packet, bit_errors=None)
        found = {burst: self._errors(packet, column, burst) for burst in bursts}
        errors, n_bits = min(found.values())
        if errors > MAX_WRONG_SHARE * n_bits:
            self._false += 1
        for burst, (wrong, _) in found.items():
            if wrong == errors <= MAX_WRONG_SHARE * n_bits:
                self._fewest[burst, column] = min(self._fewest.get((burst, column), errors), errors)
        return replace(packet, bit_errors=errors)

    def _expected(self) -> dict[tuple[int, int], int]:
        """Bits of every packet that should have been received, by burst and column."""
        bursts: Iterable[int] = self._truth.expected_bursts
        if not self._truth.frames:
            bursts = self._located or self._distinct[:1]
        places = [(burst, column) for column in range(self._truth.columns) for burst in sorted(bursts)]
        return {place: n for place in places if (n := self._truth.bits(*place))}

    def faults(self) -> list[Fault]:
        """Expected packets of the frames so far that were lost or have wrong bits."""
        found = (Fault(column, burst, self._fewest.get((burst, column))) for burst, column in self._expected())
        return [fault for fault in found if fault.wrong_bits != 0]

    def score(self) -> Score:
        """The score over the frames so far."""
        expected = self._expected()
        received = {key: errors for key, errors in self._fewest.items() if key in expected}
        extra = [errors for key, errors in self._fewest.items() if key not in expected]
        return Score(
            expected=len(expected),
            bits=sum(expected.values()),
            error_free=sum(errors == 0 for errors in received.values()),
            bit_errors=sum(received.values()),
            lost=len(expected) - len(received),
            lost_bits=sum(bits for key, bits in expected.items() if key not in received),
            false=self._false,
            extra=len(extra),
            extra_error_free=sum(errors == 0 for errors in extra),
            wrong_w=self._wrong_w,
        )
