"""The link's time through a clip: it gives every burst of every frame its number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rxcli.receiver.clip.common_clock import Start
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.clip.views import View
from rxcli.receiver.decode import assemble, confidence
from rxcli.receiver.decode.settings import SETTINGS as decode_settings
from rxcli.receiver.search.framing import log_odds
from rxcli.receiver.sync import tracking
from rxcli.receiver.sync.settings import SETTINGS as sync_settings
from rxcli.types import BoolArray, Clock, FloatArray, Frame, IntArray


@dataclass(slots=True, eq=False)
class Timeline:
    """The link's time, as long as it is not lost, and the bursts that it counts."""

    time: tracking.LinkTime
    phase: tracking.BurstPhase
    #: Columns, and slots of a packet; another screen is seen where these differ.
    shape: tuple[int, ...]
    #: Number of burst 0 of this time in the clip, and the lowest number above all bursts so far.
    offset: int = 0
    next_number: int = 0
    #: Counts the starts of the link's time: burst numbers of different ones cannot be compared.
    epoch: int = 1
    last_time_s: float = 0.0
    #: Log-odds that packets have this length.
    length_log_odds: float = 0.0
    #: Whether time stamps were compared with the link's time.
    stamps_judged: bool = False
    #: (1, C) log-likelihood ratio of the headers of all bursts so far; a scalar 0 before any.
    header_llr: FloatArray | float = 0.0
    #: Slot of sensor row 0 from copy 0, and the copies' log-likelihood ratios, of the first frames.
    first_copies: list[tuple[float, FloatArray]] = field(default_factory=list)

    @classmethod
    def begin(cls, view: View, start: Start | None, stretch: float) -> Timeline:
        """Begin with a frame; its time is that of `start` if the first frames agreed on one."""
        screen = view.acquisition.screen
        own = tracking.LinkTime(screen.packet_slots, screen.slot_rate_hz, stretch)
        time = start.time if start and start.time.stretch == stretch else own
        phase = tracking.BurstPhase(view.acquisition.repeats)
        prior = start.certainty if start else view.framing.prior if view.framing else 1.0
        return cls(
            time,
            phase,
            _shape(view),
            length_log_odds=log_odds(prior) if prior < 1 else np.inf,
            stamps_judged=stretch != 1,
        )

    def after(self, before: Timeline, view: View) -> Timeline:
        """Count on from an earlier time, with the bursts that passed until a frame."""
        passed_s = (view.context.frame.time_s - before.last_time_s) / self.time.stretch
        passed = int(passed_s * self.time.slot_rate_hz / (self.time.packet_slots * before.phase.repeats))
        offset = before.next_number + passed
        of_length = self.length_log_odds
        if self.shape == before.shape:
            of_length = before.length_log_odds + (view.framing.gain if view.framing else 0.0)
        return replace(self, offset=offset, next_number=offset, epoch=before.epoch + 1, length_log_odds=of_length)

    def place(self, view: View) -> bool:
        """Find the place of a frame's copies in the link's time; False where its clock contradicts it.

        By chance a clock of packets of another length agrees as often as it falls within the tolerance.
        """
        if self.shape != _shape(view):
            return False
        frame = view.context.frame
        by_chance = 2 * self.time.sure_slots / self.time.packet_slots if self.time.is_measured else None
        first_copy = self.time.update(frame.index, frame.time_s, view.clock)
        if by_chance is not None:
            wrong = SETTINGS.wrong_clocks
            ratio = wrong / (1 - by_chance) if first_copy is None else (1 - wrong) / by_chance
            self.length_log_odds += float(np.log(ratio))
        if first_copy is None:
            return False
        self.length_log_odds += 0.0 if view.framing is None else view.framing.gain
        view.first_copy, self.last_time_s = first_copy, frame.time_s
        is_judged = len(self.first_copies) >= sync_settings.n_judged_clocks
        if not (self.phase.settled and is_judged):
            copies = view.clock.to_copies(view.llr).transpose(1, 0, 2)
            shown = np.asarray(copies * (view.shown > 0), np.float64)
            if not self.phase.settled:  # Bursts that were numbered keep their numbers.
                self.phase.update(first_copy, shown)
            self.first_copies += [] if is_judged else [(tracking.slot_of_row_0(view.clock), shown)]
        return True

    def number(self, view: View) -> None:
        """Number the bursts of a frame."""
        bursts = self.phase.burst_of(view.first_copy + np.arange(view.clock.n_copies))
        numbers = np.unique(bursts)
        view.clock = replace(view.clock, burst=bursts - numbers[0])
        view.numbers = numbers + self.offset
        self.next_number = max(self.next_number, int(view.numbers[-1]) + 1)

    def assigned(self, frame: Frame, clock: Clock) -> IntArray | None:
        """(n_copies,) bursts of the copies of a frame on its predicted clock; None where these are in doubt."""
        slot = self.time.predict(frame.index, frame.time_s)
        if slot is None or not self.phase.settled:
            return None
        bursts = self.phase.burst_of(self.time.first_copy(slot, clock) + np.arange(clock.n_copies))
        return np.asarray(bursts - bursts[0], np.int64)

    def certainty(self, copies: IntArray) -> float:
        """Probability that packets have this length and that some copies of it, by their numbers, are one packet."""
        odds = np.array([self.length_log_odds, self.time.stretch_log_odds])
        return self.phase.certainty(copies) / float(np.prod(1 + np.exp(-odds)))

    def predicted(self, frame: Frame, rows: FloatArray, rows_per_slot: float) -> list[int]:
        """Numbers of the bursts that the rows (R,) of a further frame should show; none if that is not known."""
        slot = self.time.predict(frame.index, frame.time_s)
        if slot is None or not self.phase.settled:
            return []
        top, bottom = ((slot + rows[[0, -1]] / rows_per_slot) // self.time.packet_slots).astype(np.int64)
        numbers: list[int] = (np.unique(self.phase.burst_of(np.arange(top, bottom + 1))) + self.offset).tolist()
        return numbers

    def estimate_stretch(self, view: View) -> float | None:
        """Ratio of time stamps to the link's time by the first clocks; None if no factor explains them.

        Args:
            view: a frame; the next one begins after its readout.
        """
        self.stamps_judged = True
        shown = np.flatnonzero(view.acquisition.profiles.inside.any(axis=(0, 1)))
        readout_slots = float(np.ptp(shown)) / view.clock.rows_per_slot
        packet_slots = self.time.packet_slots

        def packets(slots: FloatArray) -> float:
            phase = tracking.BurstPhase(view.acquisition.repeats)
            for slot, (inside, copies) in zip(slots, self.first_copies, strict=True):
                phase.update(round((slot - inside) / packet_slots), copies)
            return phase.log_evidence

        return self.time.time_stamp_stretch(readout_slots / self.time.slot_rate_hz, packets)

    def headerless(self, closed: Sequence[confidence.BurstInView], n_columns: int) -> BoolArray:
        """Add closed bursts; returns (C,) the columns that have shown no headers."""
        limit = decode_settings.max_llr
        for burst in closed:
            self.header_llr = self.header_llr + np.clip(burst.posteriors.header_llr, -limit, limit)
        return assemble.find_headerless(np.asarray(self.header_llr)) if closed else np.zeros(n_columns, bool)


def _shape(view: View) -> tuple[int, ...]:
    return view.acquisition.screen.columns, view.clock.packet_slots
