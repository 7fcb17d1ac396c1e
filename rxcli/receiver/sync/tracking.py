"""Link time through the frames of a clip, and bursts that continue from one frame to the next.

Row r of frame f begins its exposure at t_f + r * line_delay, so the clock of one frame predicts the next. `LinkTime`
counts slots from the clip's first clock, which numbers every copy of a packet. `BurstPhase` finds the copies that begin
a burst, which numbers every burst, including those in the gaps between frames. `Bursts` adds up the metrics of each
burst over the frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rxcli.protocol import WEIGHTS, bits_per_symbol
from rxcli.receiver.sync.clock import similarity
from rxcli.receiver.sync.settings import SETTINGS
from rxcli.types import BoolArray, BurstPosteriors, Clock, Float32Array, FloatArray, IntArray


@dataclass(slots=True)
class LinkTime:
    """Slots since the start of the first visible copy, counted over the frames."""

    packet_slots: int
    slot_rate_hz: float
    #: Factor by which time stamps are longer than real time, as in slow motion.
    stretch: float = 1.0
    #: The first clocks: frame number, time stamp, slot of sensor row 0.
    _first_clocks: list[tuple[int, float, float]] = field(default_factory=list)
    #: The last clock: frame number, time, slot of sensor row 0.
    _last: tuple[int, float, float] | None = None
    #: Measured slots from frame to frame.
    _period: float | None = None
    #: Shortest time between two frames so far.
    _frame_s: float = float("inf")

    def begin(self, frame: int, time_s: float, slot: float, period: float) -> None:
        """Start from a clock and a frame period on which several frames agree.

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
        """Tolerance of the prediction, slots; wide at first, since time stamps may be rounded to milliseconds."""
        return SETTINGS.max_jump_slots if self._period is not None else self.packet_slots / 4

    def predict(self, frame: int, time_s: float) -> float | None:
        """Predict the slot of sensor row 0 in a frame from earlier clocks; None before the first."""
        if self._last is None:
            return None
        time_s /= self.stretch
        number, at_s, slot = self._last
        if self._period is not None:
            return slot + self._period * self._frames_since(number, frame, time_s - at_s)
        return slot + (time_s - at_s) * self.slot_rate_hz

    def update(self, frame: int, time_s: float, clock: Clock) -> int | None:
        """Enter the clock of a frame; return the number of its copy 0, or None if it contradicts the link time.

        `time_s` is the frame's time stamp.
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
        if len(self._first_clocks) < SETTINGS.n_judged_clocks:
            self._first_clocks.append((frame, time_s, slot))
        return first_copy

    @property
    def judged(self) -> bool:
        """Whether enough clocks are known to judge the time stamps."""
        return len(self._first_clocks) >= SETTINGS.n_judged_clocks

    def time_stamp_stretch(self, min_frame_s: float) -> float | None:
        """Estimate by how much time stamps are stretched; None if no factor explains them.

        Headers show the link's clock up to whole packets. Uneven time stamps are not judged.

        Args:
            min_frame_s: shortest possible time between two frames.
        """
        frames, stamps, slots = np.array(self._first_clocks).T
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
        """Whether a frame's clock agrees with the link time, up to whole packets."""
        predicted = self.predict(frame, time_s)
        if predicted is None or self._period is None:
            return True
        error = clock.first_slot - clock.row0 / clock.rows_per_slot - predicted
        return (
            abs((error + self.packet_slots / 2) % self.packet_slots - self.packet_slots / 2) <= SETTINGS.max_jump_slots
        )

    def clock_at(self, frame: int, time_s: float, like: Clock, n_slots: int, top_row: float) -> Clock | None:
        """Predict the clock of a frame from earlier frames.

        Args:
            frame: number of the frame.
            time_s: its time.
            like: a clock of an earlier frame.
            n_slots: slots of the grid.
            top_row: sensor row above which nothing is visible.
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
        """Frame periods between two frames; dropped frames have no number but take time."""
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
    """Slope of a line through points, and their largest distance from it."""
    slope, offset = np.polyfit(x - x[0], y, 1)
    return float(slope), float(np.abs(y - offset - slope * (x - x[0])).max())


class BurstPhase:
    """Find the copies that begin a burst, by the similarity of copies.

    Args:
        repeats: copies of a burst, or the possible numbers.
    """

    def __init__(self, repeats: int | Sequence[int]) -> None:
        candidates = (repeats,) if isinstance(repeats, int) else tuple(repeats)
        #: (n, 2) hypotheses: copies of a burst, and phase.
        self._hypotheses = np.array([(n, phase) for n in candidates for phase in range(n)], np.int64)
        self._max_repeats = max(candidates)
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
        """Likeliest number of copies of a burst."""
        return int(self._hypotheses[int(self._score.argmax()), 0])

    def update(self, first_copy: int, llr: FloatArray) -> None:
        """Compare the copies of a frame with each other and with earlier ones.

        Args:
            first_copy: number of the frame's first copy.
            llr: (n_copies, C, packet) log-likelihood ratios of their slots being lit, 0 where not visible.
        """
        llr = np.clip(llr, -SETTINGS.max_slot_llr, SETTINGS.max_slot_llr)
        for copy, slots in enumerate(llr, first_copy):
            for earlier in range(copy - self._max_repeats + 1, copy):
                if earlier in self._copies:
                    self._compare(earlier, copy, similarity(self._copies[earlier], slots))
            self._copies[copy] = self._copies[copy] + slots if copy in self._copies else slots
        self._copies = {c: s for c, s in self._copies.items() if c > first_copy + len(llr) - 1 - self._max_repeats}

    def _compare(self, copy_a: int, copy_b: int, llr: float) -> None:
        repeats, phases = self._hypotheses.T
        same = (copy_a + phases) // repeats == (copy_b + phases) // repeats
        self._score += np.where(same, llr / 2, -llr / 2)


@dataclass(frozen=True, slots=True)
class FrameBursts:
    """The bursts visible in a frame."""

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
    #: (C,) columns that need no further pass.
    certain: BoolArray
    tracked: bool
    #: Of this burst alone, once detected.
    posteriors: BurstPosteriors | None = None
    #: Whether frames were added since the last detection.
    stale: bool = True


@dataclass(frozen=True, slots=True)
class ClosedBurst:
    """A complete burst, added up over all frames."""

    #: Number in the clip.
    number: int
    #: Of this burst alone.
    posteriors: BurstPosteriors
    #: (C, packet) number of observations of each slot.
    n_observed: IntArray
    frames: tuple[int, ...]
    #: (C, packet + memory, patterns) of all frames together.
    metrics: FloatArray
    #: Whether the picture was known from other frames in any of them.
    tracked: bool


class Bursts:
    """The open bursts, with their metrics added up over the frames."""

    def __init__(self) -> None:
        self._open: dict[int, _Burst] = {}
        self._closed = -1
        #: Certain columns of the last closed bursts.
        self._certain: dict[int, BoolArray] = {}

    def settled(self, number: int, lit: BoolArray) -> bool:
        """Whether all lit columns (C,) of a burst, open or closed, are certain."""
        entry = self._open.get(number)
        certain = entry.certain if entry else self._certain.get(number)
        return certain is not None and bool(certain[lit].all())

    def add(self, view: FrameBursts, numbers: IntArray, metrics: FloatArray) -> None:
        """Add the bursts of a frame.

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
        """Whether frames were added to an open burst since its last detection."""
        return number in self._open and self._open[number].stale

    def mark_detected(self, numbers: IntArray) -> None:
        """Mark open bursts as detected with all frames so far."""
        for number in numbers:
            self._open[int(number)].stale = False

    def metrics(self, numbers: IntArray) -> FloatArray:
        """(B, C, packet + memory, patterns) of open bursts, all frames added."""
        return np.stack(with_common_memory([self._open[int(n)].metrics for n in numbers]))

    def n_observed(self, numbers: IntArray) -> IntArray:
        """(B, C, packet) number of observations of each slot."""
        return np.stack([self._open[int(n)].n_observed for n in numbers])

    @property
    def n_columns(self) -> int:
        """Columns of the open bursts; 0 if there are none."""
        return next((entry.n_observed.shape[0] for entry in self._open.values()), 0)

    def certain(self, numbers: IntArray) -> BoolArray:
        """(B, C) columns that are certain."""
        return np.stack([self._open[int(n)].certain for n in numbers])

    def lit(self, numbers: IntArray) -> Float32Array:
        """(B, C, packet) probability that each slot is lit."""
        entries = [self._open[int(n)] for n in numbers]
        half = np.full(entries[0].n_observed.shape, 0.5, np.float32)
        return np.stack([half if e.posteriors is None else e.posteriors.lit[0] for e in entries])

    def store(self, number: int, columns: IntArray, posteriors: BurstPosteriors, certain: BoolArray) -> None:
        """Store the posteriors of some columns of an open burst; `certain` is (columns,)."""
        entry = self._open[number]
        entry.posteriors = _merged(entry.posteriors, posteriors, columns, entry.n_observed.shape[0])
        entry.certain[columns] = certain

    def known(self, number: int) -> BurstPosteriors | None:
        """The last posteriors of an open burst."""
        return self._open[number].posteriors

    def close(self, numbers: IntArray) -> list[ClosedBurst]:
        """Remove bursts in time order; later frames add nothing to them or to earlier ones."""
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
    """Convert metrics (..., n + memory, patterns) of several frames to the longest ISI memory among them.

    A metric of a shorter memory applies to every longer pattern that ends with its slots.
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


def _unobserved(like: BurstPosteriors, n: int) -> BurstPosteriors:
    """Posteriors of an unobserved burst of `n` columns: all slots, words and weights are equally likely."""
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
    """Replace the posteriors of some of a burst's `n` columns."""
    if columns.size == n:
        return new
    if before is None:
        before = _unobserved(new, n)
    return before.with_columns(columns, new)
