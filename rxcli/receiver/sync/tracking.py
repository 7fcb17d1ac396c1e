"""The link's time through the frames of a clip, and the bursts that go on from one frame to the next.

Row r of frame f begins its exposure at t_f + r * line_delay, so a clock that is locked in one frame foretells the next:
`LinkTime` counts slots from the clip's first lock. Every copy of a packet then has a number that goes on through the
clip, and with the phase of the bursts (`BurstPhase`) every burst too, those in the gaps between frames included.
`Bursts` adds up what the frames see of each burst.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rxcli.protocol import WEIGHTS, bits_per_symbol
from rxcli.receiver.sync.clock import likeness
from rxcli.receiver.sync.settings import SETTINGS
from rxcli.types import BoolArray, BurstPosteriors, Clock, Float32Array, FloatArray, IntArray


@dataclass(slots=True)
class LinkTime:
    """Slots since the start of the first copy seen, counted over the frames."""

    packet_slots: int
    slot_rate_hz: float
    #: How much longer the clip's time stamps are than the time was, as those of slow motion.
    stretch: float = 1.0
    #: The first locks: frame number, stamp, slot of sensor row 0.
    _first: list[tuple[int, float, float]] = field(default_factory=list)
    #: Frame number, time, and slot of sensor row 0 at the last lock.
    _last: tuple[int, float, float] | None = None
    #: Slots from frame to frame, as measured, and its spread.
    _period: float | None = None
    #: Least time between two frames so far.
    _frame_s: float = float("inf")

    def begin(self, frame: int, time_s: float, slot: float, period: float) -> None:
        """Start from what several frames agreed on.

        Args:
            frame: number of a frame.
            time_s: its time.
            slot: slot of its sensor row 0, from the start of any packet.
            period: slots from frame to frame.
        """
        self._last = (frame, time_s, slot % self.packet_slots)
        self._period = period
        self._frame_s = period / self.slot_rate_hz

    @property
    def sure_slots(self) -> float:
        """How far a clock may be from the foretold one: at first by the times, which may be rounded to milliseconds."""
        return SETTINGS.max_jump_slots if self._period is not None else self.packet_slots / 4

    def predict(self, frame: int, time_s: float) -> float | None:
        """Slot of sensor row 0 in a frame, from the locks before; None before the first."""
        if self._last is None:
            return None
        time_s /= self.stretch
        number, at_s, slot = self._last
        if self._period is not None:
            return slot + self._period * self._frames_since(number, frame, time_s - at_s)
        return slot + (time_s - at_s) * self.slot_rate_hz

    def take(self, frame: int, time_s: float, clock: Clock) -> int | None:
        """Enter a locked clock; returns the number of its copy 0, None where it is not of the time told so far.

        `time_s` is the frame's stamp, here as everywhere.
        """
        inside = clock.first_slot - clock.row0 / clock.rows_per_slot
        predicted = self.predict(frame, time_s)
        if predicted is None:
            first_copy, slot = 0, inside
        else:
            first_copy = round((predicted - inside) / self.packet_slots)
            slot = inside + first_copy * self.packet_slots
            if self._period is not None and abs(slot - predicted) > SETTINGS.max_jump_slots:
                return None
            self._measure(frame, time_s / self.stretch, slot)
        self._last = (frame, time_s / self.stretch, slot)
        if len(self._first) < SETTINGS.n_judged_clocks:
            self._first.append((frame, time_s, slot))
        return first_copy

    @property
    def judged(self) -> bool:
        """Whether as many frames were locked as time stamps are judged by."""
        return len(self._first) >= SETTINGS.n_judged_clocks

    def time_stamp_stretch(self, min_frame_s: float) -> float | None:
        """How much longer the stamps of the first locks are than the time was; None where no factor explains them.

        The link's own clock shows in the headers, whole packets aside. Stamps that are not even are not judged.

        Args:
            min_frame_s: time that passes from frame to frame at least.
        """
        frames, stamps, slots = np.array(self._first).T
        if len(frames) < 3 or np.ptp(frames) == 0:
            return self.stretch
        period, slots_off = _line(frames, slots)
        stamp_s, stamps_off = _line(frames, stamps)
        if slots_off > SETTINGS.uneven_slots or stamps_off > SETTINGS.uneven_s or stamp_s <= 0:
            return self.stretch
        uneven = 2 * stamps_off / np.ptp(frames) * self.slot_rate_hz + SETTINGS.rate_slots
        for stretch in (1, *SETTINGS.stretches):
            expected = stamp_s / stretch * self.slot_rate_hz
            off = abs((period - expected + self.packet_slots / 2) % self.packet_slots - self.packet_slots / 2)
            if off <= uneven / stretch + SETTINGS.rate_share * expected and stamp_s / stretch > min_frame_s:
                return float(stretch)
        return None

    def agrees(self, frame: int, time_s: float, clock: Clock) -> bool:
        """Whether a frame's clock is of the time told so far, whole packets aside."""
        predicted = self.predict(frame, time_s)
        if predicted is None or self._period is None:
            return True
        apart = clock.first_slot - clock.row0 / clock.rows_per_slot - predicted
        return (
            abs((apart + self.packet_slots / 2) % self.packet_slots - self.packet_slots / 2) <= SETTINGS.max_jump_slots
        )

    def clock_at(self, frame: int, time_s: float, like: Clock, n_slots: int, top_row: float) -> Clock | None:
        """The clock that the frames before foretell.

        Args:
            frame: number of the frame.
            time_s: its time.
            like: a clock of an earlier frame.
            n_slots: slots of the grid.
            top_row: sensor row above which nothing is seen.
        """
        predicted = self.predict(frame, time_s)
        if predicted is None:
            return None
        slot = predicted + top_row / like.rows_per_slot
        first_slot = int(np.floor(slot)) % self.packet_slots
        return replace(
            like,
            row0=top_row - (slot - np.floor(slot)) * like.rows_per_slot,
            n_slots=n_slots,
            first_slot=first_slot,
            burst=np.zeros(-(-(first_slot + n_slots) // self.packet_slots), np.int64),
        )

    def _frames_since(self, number: int, frame: int, elapsed_s: float) -> int:
        """Frame lengths between two frames; frames that the camera dropped have no number, but take time."""
        by_time = round(elapsed_s / self._frame_s) if np.isfinite(self._frame_s) and self._frame_s > 0 else 0
        return max(by_time, frame - number)

    def _measure(self, frame: int, time_s: float, slot: float) -> None:
        assert self._last is not None
        number, at_s, before = self._last
        if frame == number:
            return
        if frame - number == 1 and time_s > at_s:
            self._frame_s = min(self._frame_s, time_s - at_s)
        period = (slot - before) / max(self._frames_since(number, frame, time_s - at_s), 1)
        self._period = (
            period if self._period is None else self._period + SETTINGS.period_share * (period - self._period)
        )


def _line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Slope of a line through points, and how far they are from it at most."""
    slope, offset = np.polyfit(x - x[0], y, 1)
    return float(slope), float(np.abs(y - offset - slope * (x - x[0])).max())


class BurstPhase:
    """Which copies begin a burst: copies of one burst are alike, copies of different bursts are not.

    Args:
        repeats: how many copies a burst has, or may have.
    """

    def __init__(self, repeats: int | Sequence[int]) -> None:
        several = (repeats,) if isinstance(repeats, int) else tuple(repeats)
        #: (n, 2) copies of a burst, and phase: what it may be.
        self._hypotheses = np.array([(n, phase) for n in several for phase in range(n)], np.int64)
        self._most = max(several)
        self._score = np.zeros(len(self._hypotheses))
        self._copies: dict[int, FloatArray] = {}

    @property
    def settled(self) -> bool:
        """Whether the phase is beyond doubt."""
        if self._score.size == 1:
            return True
        rival, best = np.sort(self._score)[-2:]
        return bool(best - rival > SETTINGS.settled_llr)

    def burst_of(self, copies: IntArray) -> IntArray:
        """Number of the burst of each copy, by its number in the clip."""
        repeats, phase = self._hypotheses[int(self._score.argmax())]
        return np.asarray((copies + phase) // repeats, np.int64)

    @property
    def repeats(self) -> int:
        """Copies of a burst, as far as is known."""
        return int(self._hypotheses[int(self._score.argmax()), 0])

    def take(self, first_copy: int, llr: FloatArray) -> None:
        """Compare the copies of a frame with one another and with those before.

        Args:
            first_copy: number of the first one.
            llr: (n_copies, C, packet) log-odds of their slots, 0 where not seen.
        """
        llr = np.clip(llr, -SETTINGS.max_slot_llr, SETTINGS.max_slot_llr)
        for copy, slots in enumerate(llr, first_copy):
            for other in range(copy - self._most + 1, copy):
                if other in self._copies:
                    self._compare(other, copy, likeness(self._copies[other], slots))
            self._copies[copy] = self._copies[copy] + slots if copy in self._copies else slots
        self._copies = {c: s for c, s in self._copies.items() if c > first_copy + len(llr) - 1 - self._most}

    def _compare(self, first: int, second: int, alike: float) -> None:
        repeats, phases = self._hypotheses.T
        same = (first + phases) // repeats == (second + phases) // repeats
        self._score += np.where(same, alike / 2, -alike / 2)


@dataclass(frozen=True, slots=True)
class FrameBursts:
    """What a frame sees of its bursts."""

    frame: int
    #: Number of the frame's copy 0 in the clip.
    first_copy: int
    clock: Clock
    #: (C, N + memory, patterns).
    metrics: FloatArray
    #: (n_copies, C, packet) int: 1 where the slot is on the screen and in the picture.
    shown: IntArray
    #: Whether the picture was known from other frames.
    tracked: bool = False


@dataclass(slots=True)
class _Burst:
    metrics: FloatArray
    n_observed: IntArray
    frames: list[int]
    #: (C,) columns that need no further look.
    certain: BoolArray
    tracked: bool
    #: Of this burst alone, once detected.
    posteriors: BurstPosteriors | None = None
    #: Whether frames were added since it was looked at.
    stale: bool = True


@dataclass(frozen=True, slots=True)
class ClosedBurst:
    """A burst with all that the frames saw of it."""

    #: Number in the clip.
    number: int
    #: Of this burst alone.
    posteriors: BurstPosteriors
    #: (C, packet) how often each slot was seen.
    n_observed: IntArray
    frames: tuple[int, ...]
    #: (C, packet + memory, patterns) of all frames together.
    metrics: FloatArray
    #: Whether the picture was known from other frames in any of them.
    tracked: bool


class Bursts:
    """The bursts that are still going on, with what the frames saw of them added up."""

    def __init__(self) -> None:
        self._open: dict[int, _Burst] = {}
        self._closed = -1
        #: Columns of the last closed bursts that were certain.
        self._certain: dict[int, BoolArray] = {}

    def settled(self, number: int, lit: BoolArray) -> bool:
        """Whether all columns that are lit, (C,), are certain of a burst, open or closed."""
        entry = self._open.get(number)
        certain = entry.certain if entry else self._certain.get(number)
        return certain is not None and bool(certain[lit].all())

    def add(self, view: FrameBursts, numbers: IntArray, metrics: FloatArray) -> None:
        """Take what a frame sees.

        Args:
            view: the frame.
            numbers: (B,) numbers of its bursts.
            metrics: (B, C, packet + memory, patterns).
        """
        for burst, number in enumerate(numbers):
            if number <= self._closed:
                continue
            n_observed = view.shown[view.clock.burst == burst].sum(axis=0)
            have = self._open.get(int(number))
            if have is None:
                self._open[int(number)] = _Burst(
                    metrics[burst].copy(), n_observed, [view.frame], np.zeros(n_observed.shape[0], bool), view.tracked
                )
                continue
            have.metrics, added = with_common_memory([have.metrics, metrics[burst]])
            have.metrics += added
            have.n_observed = have.n_observed + n_observed
            have.frames.append(view.frame)
            have.tracked |= view.tracked
            have.stale = True

    def is_open(self, number: int) -> bool:
        """Whether the burst can still be added to."""
        return number in self._open

    def is_stale(self, number: int) -> bool:
        """Whether an open burst was added to since it was looked at."""
        return number in self._open and self._open[number].stale

    def looked_at(self, numbers: IntArray) -> None:
        """All that there is to detect of open bursts is detected."""
        for number in numbers:
            self._open[int(number)].stale = False

    def metrics(self, numbers: IntArray) -> FloatArray:
        """(B, C, packet + memory, patterns) of open bursts, all frames added."""
        return np.stack(with_common_memory([self._open[int(n)].metrics for n in numbers]))

    def n_observed(self, numbers: IntArray) -> IntArray:
        """(B, C, packet) how often each slot was seen."""
        return np.stack([self._open[int(n)].n_observed for n in numbers])

    @property
    def n_columns(self) -> int:
        """Columns of the open bursts; 0 where none is open."""
        return next((entry.n_observed.shape[0] for entry in self._open.values()), 0)

    def certain(self, numbers: IntArray) -> BoolArray:
        """(B, C) columns that are certain."""
        return np.stack([self._open[int(n)].certain for n in numbers])

    def lit(self, numbers: IntArray) -> Float32Array:
        """(B, C, packet) probability that each slot is lit."""
        entries = [self._open[int(n)] for n in numbers]
        half = np.full(entries[0].n_observed.shape, 0.5, np.float32)
        return np.stack([half if e.posteriors is None else e.posteriors.lit[0] for e in entries])

    def note(self, number: int, columns: IntArray, posteriors: BurstPosteriors, certain: BoolArray) -> None:
        """Keep what was detected of some columns of an open burst; `certain` is (columns,)."""
        entry = self._open[number]
        entry.posteriors = _merged(entry.posteriors, posteriors, columns, entry.n_observed.shape[0])
        entry.certain[columns] = certain

    def known(self, number: int) -> BurstPosteriors | None:
        """What was last detected of an open burst."""
        return self._open[number].posteriors

    def close(self, numbers: IntArray) -> list[ClosedBurst]:
        """Take bursts out, in time order; nothing that comes later is added to them, nor to any before."""
        if len(numbers):
            self._closed = max(self._closed, int(numbers.max()))
        entries = [(int(n), self._open.pop(int(n), None)) for n in np.sort(numbers)]
        self._certain |= {number: entry.certain for number, entry in entries if entry is not None}
        self._certain = {n: c for n, c in self._certain.items() if n > self._closed - SETTINGS.remembered_bursts}
        return [
            ClosedBurst(number, entry.posteriors, entry.n_observed, tuple(entry.frames), entry.metrics, entry.tracked)
            for number, entry in entries
            if entry is not None and entry.posteriors is not None
        ]


def with_common_memory(metrics: Sequence[FloatArray]) -> list[FloatArray]:
    """Metrics (..., n + memory, patterns) of several frames, those of shorter memories written as of the longest.

    What a sample says of its last slots it says of every pattern that ends with them.
    """
    n_patterns = max((some.shape[-1] for some in metrics), default=0)
    n_metrics = max((some.shape[-2] for some in metrics), default=0)

    def written(some: FloatArray) -> FloatArray:
        if some.shape[-1] == n_patterns:
            return some
        every = some[..., np.arange(n_patterns) % some.shape[-1]]
        more = [(0, 0)] * (some.ndim - 2)
        return np.pad(every, [*more, (0, n_metrics - some.shape[-2]), (0, 0)])

    return [written(some) for some in metrics]


def _nothing_known(like: BurstPosteriors, n: int) -> BurstPosteriors:
    """Posteriors of a burst of `n` columns that no light tells of: all slots, words and weights are alike."""
    symbols, slots, weights = like.index.shape[2], like.lit.shape[2], like.w_log_prob.shape[1]
    middle = WEIGHTS[len(WEIGHTS) // 2]
    k = bits_per_symbol(middle)
    bit_llr = np.full((1, n, symbols, like.bit_llr.shape[3]), np.nan)
    bit_llr[..., :k] = 0
    return BurstPosteriors(
        w=np.full(n, middle, np.int64),
        w_log_prob=np.full((n, weights), -np.log(weights)),
        log_evidence=np.zeros(n),
        lit=np.full((1, n, slots), 0.5, np.float32),
        index=np.zeros((1, n, symbols), np.int64),
        log_prob=np.full((1, n, symbols), -k * np.log(2)),
        bit_llr=bit_llr,
        header_llr=np.zeros((1, n)),
    )


def _merged(before: BurstPosteriors | None, new: BurstPosteriors, columns: IntArray, n: int) -> BurstPosteriors:
    """One burst's posteriors with some of its `n` columns detected anew."""
    if columns.size == n:
        return new
    if before is None:
        before = _nothing_known(new, n)
    return before.with_columns(columns, new)
