"""Link time through the frames of a clip, and bursts that continue from one frame to the next.

Row r of frame f begins its exposure at t_f + r * line_delay, so the clock of one frame predicts the next. `LinkTime`
counts slots from the clip's first clock, which numbers every copy of a packet. `BurstPhase` finds the copies that begin
a burst, which numbers every burst, including those in the gaps between frames.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rxcli.receiver.sync.clock import similarity
from rxcli.receiver.sync.settings import SETTINGS
from rxcli.types import Clock, FloatArray, IntArray


@dataclass(slots=True)
class LinkTime:
    """Slots since the start of the first visible copy, counted over the frames."""

    packet_slots: int
    slot_rate_hz: float
    #: Factor by which time stamps are longer than real time, as in slow motion.
    stretch: float = 1.0
    #: Log-odds of that factor against others.
    stretch_log_odds: float = float("inf")
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
            time_s: its time stamp.
            slot: slot of its sensor row 0, from the start of any packet.
            period: slots from frame to frame.
        """
        self._last = (frame, time_s / self.stretch, slot % self.packet_slots)
        self._period = period
        self._frame_s = period / self.slot_rate_hz

    @property
    def sure_slots(self) -> float:
        """Tolerance of the prediction, slots; wide at first, since time stamps may be rounded to milliseconds."""
        return SETTINGS.max_jump_slots if self.is_measured else self.packet_slots / 4

    @property
    def is_measured(self) -> bool:
        """Whether the slots from frame to frame are known, so that a further clock agrees or contradicts."""
        return self._period is not None

    def predict(self, frame: int, time_s: float) -> float | None:
        """Predict the slot of sensor row 0 in a frame from earlier clocks; None before the first."""
        if self._last is None:
            return None
        time_s /= self.stretch
        number, at_s, slot = self._last
        if self._period is not None:
            return slot + self._period * self._frames_since(number, frame, time_s - at_s)
        return slot + (time_s - at_s) * self.slot_rate_hz

    def first_copy(self, slot: float, clock: Clock) -> int:
        """Number of a clock's copy 0 where sensor row 0 is nearest to a predicted `slot`."""
        return round((slot - slot_of_row_0(clock)) / self.packet_slots)

    def update(self, frame: int, time_s: float, clock: Clock) -> int | None:
        """Enter the clock of a frame; return the number of its copy 0, or None if it contradicts the link time.

        `time_s` is the frame's time stamp.
        """
        inside = slot_of_row_0(clock)
        predicted = self.predict(frame, time_s)
        if predicted is None:
            first_copy, slot = 0, inside
        else:
            first_copy = self.first_copy(predicted, clock)
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

    def time_stamp_stretch(self, min_frame_s: float, packets: Callable[[FloatArray], float]) -> float | None:
        """Estimate by how much time stamps are stretched; None if no factor explains them, or several above 1 do.

        Headers show the link's clock up to whole packets, and equal packets show how many of them passed.
        Uneven time stamps are not judged.

        Args:
            min_frame_s: shortest possible time between two frames.
            packets: log-evidence of the frames' packets, by the slot of sensor row 0 of each.
        """
        frames, stamps, slots = np.array(self._first_clocks).T
        if len(frames) < 3 or np.ptp(frames) == 0:
            return self.stretch
        period, slots_off = _line(frames, slots)
        stamp_s, stamps_off = _line(frames, stamps)
        if slots_off > SETTINGS.uneven_slots or stamps_off > SETTINGS.uneven_s or stamp_s <= 0:
            return self.stretch
        uneven = 2 * stamps_off / np.ptp(frames) * self.slot_rate_hz + SETTINGS.rate_slots
        scored = []
        for factor in range(1, SETTINGS.max_stretch + 1):
            expected = stamp_s / factor * self.slot_rate_hz
            passed = self.packet_slots * round((period - expected) / self.packet_slots)
            off, limit = abs(period - passed - expected), uneven / factor + SETTINGS.rate_share * expected
            if off <= limit and stamp_s / factor > min_frame_s:
                score = -SETTINGS.rate_limits * off / limit - np.log(limit) + SETTINGS.slow_log_odds * (factor > 1)
                scored.append((score + packets(slots - passed * (frames - frames[0])), float(factor)))
        if not scored:
            self.stretch_log_odds = np.inf
            return None
        *_, (rival_score, _), (best_score, stretch) = sorted([(-np.inf, 1.0), *scored])
        self.stretch_log_odds = best_score - rival_score
        is_unsure = stretch != 1 and self.stretch_log_odds < SETTINGS.sure_stretch
        return None if is_unsure else stretch

    def clock_at(
        self, frame: int, time_s: float, like: Clock, n_slots: int, top_row: float, later_slots: float = 0.0
    ) -> Clock | None:
        """Predict the clock of a frame from earlier frames.

        Args:
            frame: number of the frame.
            time_s: its time.
            like: a clock of an earlier frame.
            n_slots: slots of the grid.
            top_row: sensor row above which nothing is visible.
            later_slots: slots by which the frame is later than predicted.
        """
        predicted = self.predict(frame, time_s)
        if predicted is None:
            return None
        slot = predicted + later_slots + top_row / like.rows_per_slot
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
        return by_time or frame - number

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


def slot_of_row_0(clock: Clock) -> float:
    """Slot of sensor row 0 on a clock, from the start of copy 0."""
    return clock.first_slot - clock.row0 / clock.rows_per_slot


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
        # Log prior: every phase of a number of copies is equally likely.
        self._score = -np.log(self._hypotheses[:, 0])
        self._copies: dict[int, FloatArray] = {}
        #: Half the log-likelihood ratios of all pairs that were compared being equal.
        self._half = 0.0

    @property
    def log_evidence(self) -> float:
        """Log-likelihood of the bursts against packets that are all different."""
        return float(np.logaddexp.reduce(self._score)) + self._half

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

    def certainty(self, copies: IntArray) -> float:
        """Probability that some copies, by their numbers in the clip, are one packet."""
        repeats, phases = self._hypotheses.T
        bursts = (copies[:, None] + phases) // repeats
        weight = np.exp(self._score - self._score.max())
        return float(weight[(bursts == bursts[:1]).all(axis=0)].sum() / weight.sum())

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
        self._half += llr / 2
