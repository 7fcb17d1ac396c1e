"""The data that were sent, from `NAME.truth.json`, and the score of a reception against them.

A packet is *expected*, once per source and column, when some frame shows its burst for at least 1.02 packet lengths. It
is *lost* when nothing was reported for it or more than a quarter of its bits are wrong. A reported packet is *false*
when it differs in more than a quarter of its bits from every burst of its frame and of the frame before.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from string import hexdigits
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from rxcli.errors import InputError
from rxcli.protocol import WEIGHTS, packet_slots
from rxcli.resources import read_limited
from rxcli.types import ColumnResult, FrameResult, PacketResult

TRUTH_SUFFIX = ".truth.json"
#: A burst seen for fewer packet lengths than this is not expected to be received.
EXPECTED_LENGTHS = 1.02
#: Above this share of wrong bits a packet is lost or false.
MAX_WRONG_SHARE = 0.25

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
    frames: tuple[TruthFrame, ...]
    #: Burst number -> one hex string per column, first bit most significant.
    payload: dict[int, tuple[str, ...]]
    capture: str = ""
    screen: str | None = None
    slot_rate_hz: float | None = None
    repeats: int | None = None
    camera: dict[str, Any] | None = None

    @property
    def expected_bursts(self) -> frozenset[int]:
        """Bursts that some frame shows sufficiently."""
        enough = EXPECTED_LENGTHS * packet_slots(self.payload_symbols)
        return frozenset(b.burst for f in self.frames for b in f.bursts if b.visible_slots >= enough)


def truth_path(capture: str | Path) -> Path:
    """Where the truth of `capture` lies: `a.jpg` -> `a.truth.json`."""
    path = Path(capture)
    return path.with_name(path.stem + TRUTH_SUFFIX)


def find_truth(capture: str | Path) -> Path | None:
    """The truth file beside `capture`, None where there is none."""
    path = truth_path(capture)
    return path if path.is_file() else None


def truth_for(capture: str | Path, asked: str | Path | None) -> Path | None:
    """The truth of `capture` where a file is asked for, or "auto" for the one beside it; None where there is none."""
    if asked == "auto":
        return find_truth(capture)
    return None if asked is None else Path(asked)


def load_truth(path: str | Path) -> Truth:
    """Load and check a truth file.

    Raises:
        InputError: it cannot be read, is no JSON, lacks a key, or contradicts itself.
    """
    try:
        truth = msgspec.json.decode(read_limited(Path(path), _MAX_BYTES), type=Truth)
    except (OSError, ValueError, RecursionError) as error:  # msgspec's own errors are ValueErrors
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{path}: cannot be read as truth ({reason})", "name a NAME.truth.json file") from None
    problem = _contradiction(truth)
    if problem:
        raise InputError(f"{path}: {problem}", "correct the truth file")
    return truth


def _contradiction(truth: Truth) -> str | None:
    """What is inconsistent in `truth`, None where nothing is."""
    for name in ("w", "payload_bits"):
        if len(getattr(truth, name)) != truth.columns:
            return f"{name} must have one entry per column, {truth.columns} (got {len(getattr(truth, name))})"
    if not set(truth.w) <= set(WEIGHTS):
        return f"w must be in 1..9 (got {sorted(set(truth.w) - set(WEIGHTS))[0]})"
    shown = {b.burst for f in truth.frames for b in f.bursts}
    if shown - truth.payload.keys():
        return (
            f"payload must hold every burst that a frame shows (burst {min(shown - truth.payload.keys())} is missing)"
        )
    return next(filter(None, (_payload_problem(b, row, truth) for b, row in truth.payload.items())), None)


def _payload_problem(burst: int, row: tuple[str, ...], truth: Truth) -> str | None:
    if len(row) != truth.columns:
        return f"payload of burst {burst} must have one entry per column, {truth.columns} (got {len(row)})"
    for column, (text, n_bits) in enumerate(zip(row, truth.payload_bits, strict=True)):
        if 4 * len(text) < n_bits or not set(text) <= set(hexdigits):
            return (
                f"payload of burst {burst}, column {column}, must be hex of at least {n_bits} bits (got {text!r:.60})"
            )
    return None


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
    surplus = 4 * len(text) - n_bits
    value = int(text, 16) if text else 0
    return value >> surplus if surplus >= 0 else value << -surplus


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
        self._fewest: dict[tuple[int, int], int] = {}
        self._false = 0
        self._wrong_w = 0

    def add(self, result: FrameResult) -> FrameResult:
        """Take the next frame into account; returns it with `bit_errors` filled in."""
        candidates = self._bursts.get(result.frame - 1, ()) + self._bursts.get(result.frame, ())
        columns = tuple(self._add_column(column, candidates) for column in result.columns)
        return replace(result, columns=columns)

    def _add_column(self, column: ColumnResult, bursts: tuple[int, ...]) -> ColumnResult:
        known = column.column < self._truth.columns
        if column.w is not None and not (known and column.w == self._truth.w[column.column]):
            self._wrong_w += 1
        candidates = bursts if known else ()
        return replace(column, packets=tuple(self._add_packet(p, column.column, candidates) for p in column.packets))

    def _add_packet(self, packet: PacketResult, column: int, bursts: tuple[int, ...]) -> PacketResult:
        if not bursts:
            self._false += 1
            return replace(packet, bit_errors=None)
        n_sent = self._truth.payload_bits[column]
        errors = {
            burst: wrong_bits(packet.payload, packet.payload_bits, self._truth.payload[burst][column], n_sent)
            for burst in bursts
        }
        burst = min(errors, key=errors.__getitem__)
        if errors[burst] > MAX_WRONG_SHARE * max(n_sent, packet.payload_bits):
            self._false += 1
        else:
            key = (burst, column)
            self._fewest[key] = min(self._fewest.get(key, errors[burst]), errors[burst])
        return replace(packet, bit_errors=errors[burst])

    def faults(self) -> list[Fault]:
        """Expected packets of the frames so far that were lost or have wrong bits."""
        expected = [(c, b) for c in range(self._truth.columns) for b in sorted(self._truth.expected_bursts)]
        found = (Fault(column, burst, self._fewest.get((burst, column))) for column, burst in expected)
        return [fault for fault in found if fault.wrong_bits != 0]

    def score(self) -> Score:
        """The score over the frames so far."""
        truth, expected = self._truth, self._truth.expected_bursts
        received = {key: errors for key, errors in self._fewest.items() if key[0] in expected}
        extra = [errors for key, errors in self._fewest.items() if key[0] not in expected]
        received_bits = sum(truth.payload_bits[column] for _, column in received)
        bits = len(expected) * sum(truth.payload_bits)
        return Score(
            expected=len(expected) * truth.columns,
            bits=bits,
            error_free=sum(errors == 0 for errors in received.values()),
            bit_errors=sum(received.values()),
            lost=len(expected) * truth.columns - len(received),
            lost_bits=bits - received_bits,
            false=self._false,
            extra=len(extra),
            extra_error_free=sum(errors == 0 for errors in extra),
            wrong_w=self._wrong_w,
        )
