"""The account of a clip: link time, bursts that go on, and frames whose results wait for them."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.receiver.clip.acquiring import Start
from rxcli.receiver.clip.bursts import Burst, bursts_of, doubts, has_light, lit_slots
from rxcli.receiver.clip.scene import TrackedScreen
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.clip.views import View, Waiting
from rxcli.receiver.decode import assemble, confidence
from rxcli.receiver.decode.settings import SETTINGS as decode_settings
from rxcli.receiver.decode.soft_bits import clip_soft_bits
from rxcli.receiver.light import slot_llr
from rxcli.receiver.sync import tracking
from rxcli.results.dump import dump_stages
from rxcli.types import (
    BoolArray,
    Float32Array,
    FloatArray,
    Frame,
    FrameResult,
    FrameSoftBits,
    IntArray,
)

_SLOW_MOTION = "slow motion: time stamps are {:g} times as long as the link's time, which was taken"
_RETIMED = (
    "the clip's time stamps do not fit the link's time, as after a change of its speed: each frame is received alone; "
    "give the clip as the camera recorded it"
)


@dataclass(slots=True, eq=False)
class _Link:
    """The link's time, as long as it is not lost."""

    time: tracking.LinkTime
    phase: tracking.BurstPhase
    #: Columns and slots of a packet.
    shape: tuple[int, int]
    #: Number of burst 0 of this time in the clip.
    offset: int
    last_time_s: float
    #: Whether time stamps were compared with the link's time.
    stamps_judged: bool = False
    #: (1, C) log-likelihood ratio of the headers of all bursts so far; None before any.
    header_llr: FloatArray | None = None

    def headerless(self, closed: Sequence[confidence.BurstInClip], n_columns: int) -> BoolArray:
        """Add closed bursts; returns (C,) the columns that have shown no headers."""
        header_llr = np.zeros((1, n_columns)) if self.header_llr is None else self.header_llr
        limit = decode_settings.max_llr
        for burst in closed:
            header_llr = header_llr + np.clip(burst.posteriors.header_llr, -limit, limit)
        self.header_llr = header_llr
        return assemble.find_headerless(header_llr) if closed else np.zeros(n_columns, bool)


class Ledger:
    """Bursts and results of a clip.

    The first frames of a scene are held back and measured again when its picture is known better; other results wait
    for the end of their bursts.

    Args:
        options: of the receiver.
    """

    def __init__(self, options: ReceiverOptions) -> None:
        self._options = options
        self._waiting: deque[Waiting] = deque()
        #: Bursts that are still going on, by number; later frames add nothing to those up to `_last_closed`.
        self._bursts: dict[int, Burst] = {}
        self._last_closed = -1
        self._link: _Link | None = None
        self._next_number = 0
        #: Ratio of time stamps to the link's time; None if it cannot be estimated, and frames are received alone.
        self._stretch: float | None = 1.0
        #: Counts the starts of the link's time: burst numbers of different ones cannot be compared.
        self._epoch = 0
        #: The scene of the frames that wait; None where they are not tracked.
        self._scene: TrackedScreen | None = None
        #: The clock that the first frames agreed on, where each shows little.
        self.start: Start | None = None
        #: Probability that the screen's columns are numbered right.
        self.certainty = 1.0
        #: Number of first frames of a scene that are held back; 0: none.
        self._n_held = self._n_first

    @property
    def _n_first(self) -> int:
        return SETTINGS.frames_held if "tracking" in self._options.skip else 0

    @property
    def holds_more(self) -> bool:
        """Whether further frames are held back, because compression has taken much of the first ones."""
        return self._n_held == SETTINGS.frames_held_long

    @property
    def time(self) -> tracking.LinkTime | None:
        """The link's time; None before the first frame."""
        return self._link.time if self._link is not None else None

    @property
    def message(self) -> str | None:
        """Message about the clip's time stamps, or None."""
        if self._stretch is None:
            return _RETIMED
        return _SLOW_MOTION.format(self._stretch) if self._stretch != 1 else None

    def has_certain_bursts(self, frame: Frame, scene: TrackedScreen) -> bool:
        """Whether all bursts that a frame should show are certain in all lit columns."""
        link = self._link
        if link is None or scene.last is None or not link.phase.settled or self._n_held:
            return False
        last, (top, bottom) = scene.last, scene.rows[[0, -1]]
        slot, rows_per_slot = link.time.predict(frame.index, frame.time_s), last.acquisition.clock.rows_per_slot
        if slot is None:
            return False
        ends = (slot + np.array([top, bottom]) / rows_per_slot) // link.time.packet_slots
        numbers = np.unique(link.phase.burst_of(np.arange(ends[0], ends[1] + 1).astype(np.int64))) + link.offset
        lit = np.median(last.snr, axis=1) >= 1.0
        return bool(lit.any()) and all(
            number in self._bursts and self._bursts[number].certain[lit].all() for number in numbers.tolist()
        )

    def add(self, waiting: Waiting, *, scene_ends: bool = False) -> list[FrameResult]:
        """Add a frame without packets; returns the results that are complete, all of them where the scene ends."""
        self._waiting.append(waiting)
        return self._finish_scene() if scene_ends else self._ready()

    def enter(self, waiting: Waiting, view: View, scene: TrackedScreen | None) -> list[FrameResult]:
        """Enter a received frame; returns the results that are complete.

        Args:
            waiting: the frame, to which the view is given.
            view: what was received of it.
            scene: that the frame belongs to; None where it is not tracked.
        """
        frame = view.context.frame
        done, first_copy = self._first_copy(view, frame)
        waiting.view = view
        self._scene = scene
        assert self._link is not None
        self._link.last_time_s = frame.time_s
        view.bursts = replace(view.bursts, first_copy=first_copy)
        self._waiting.append(waiting)
        with view.context.timer("detect"):
            if not self._link.phase.settled:
                self._compare(view)
            n_unsettled = sum(w.view is not None and w.numbers is None for w in self._waiting)
            if self._n_held and self._link.time.judged and not self._link.stamps_judged:
                done += self._enter_anew()
            if self._link.phase.settled or n_unsettled > SETTINGS.max_waiting_frames:
                self._settle_bursts()
                if self._n_held and len(self._waiting) >= self._n_held:
                    self._receive_first_again(at_last=False)
        return done + self._ready()

    def _first_copy(self, view: View, frame: Frame) -> tuple[list[FrameResult], int]:
        """Number of the frame's first copy; where it does not fit the link's time, that ends, with the results of its
        scene, and begins anew."""
        done: list[FrameResult] = []
        if self._link is not None:
            if self._stretch is not None and self._link.shape == _shape(view):
                first_copy = self._link.time.update(frame.index, frame.time_s, view.bursts.clock)
                if first_copy is not None:
                    return [], first_copy
            done = self._finish_scene()
        return done, self._begin_link(view, frame)

    def _begin_link(self, view: View, frame: Frame) -> int:
        """Begin the link's time anew; returns the number of the frame's first copy in it."""
        screen, clock = view.acquisition.screen, view.bursts.clock
        offset, stretch = self._next_number, self._stretch or 1.0
        if self._link is not None and offset:
            passed_s = (frame.time_s - self._link.last_time_s) / stretch
            offset += int(passed_s / (screen.packet_s * self._link.phase.repeats))
        time, first_copy = tracking.LinkTime(screen.packet_slots, screen.slot_rate_hz, stretch), None
        if self.start is not None:
            first_copy = self.start.time.update(frame.index, frame.time_s, clock)
        if self.start is None or first_copy is None:
            # The clock that the first frames seemed to share, if any, is not this frame's.
            self.start, first_copy = None, time.update(frame.index, frame.time_s, clock)
        else:
            time = self.start.time
        assert first_copy is not None
        phase = tracking.BurstPhase(view.acquisition.repeats)
        self._link = _Link(time, phase, _shape(view), offset, frame.time_s, stamps_judged=self._stretch != 1)
        self._epoch += 1
        self._forget_bursts()
        return first_copy

    def _enter_anew(self) -> list[FrameResult]:
        """Where the stamps of the first frames are not the time, enter these frames anew; returns complete results."""
        link, waiting = self._link, self._waiting
        assert link is not None
        link.stamps_judged = True
        view = next(each.view for each in waiting if each.view is not None)
        shown = float(np.ptp(np.flatnonzero(view.acquisition.profiles.inside.any(axis=(0, 1)))))
        packet_s = view.acquisition.screen.packet_s / view.bursts.clock.packet_slots
        self._stretch = link.time.time_stamp_stretch(shown / view.bursts.clock.rows_per_slot * packet_s)
        if self._stretch == link.time.stretch:
            return []
        self._waiting, self._link, scene, done = deque(), None, self._scene, []
        for each in waiting:
            each.numbers, each.result = None, replace(each.result, message=self.message)
            done += self.add(each) if each.view is None else self.enter(each, each.view, scene)
        return done

    def _compare(self, view: View) -> None:
        """Update the phase of the bursts with a frame."""
        assert self._link is not None
        clock = view.bursts.clock
        llr = slot_llr(view.bursts.metrics)
        copies = clock.to_copies(llr).transpose(1, 0, 2) * (view.bursts.shown > 0)
        self._link.phase.update(view.bursts.first_copy, np.asarray(copies, np.float64))

    def _settle_bursts(self) -> None:
        """Enter all frames that waited for the phase of the bursts."""
        for waiting in self._waiting:
            if waiting.view is not None and waiting.numbers is None:
                self._detect(waiting)

    def _detect(self, waiting: Waiting) -> None:
        """Add a frame to its bursts, which are detected when their result is needed, and learn from it."""
        self._add(waiting, dark_too=self._n_held > 0)
        view, bursts = waiting.view, self._open(waiting)
        if self._scene is not None and view is not None and view.flat is not None and bursts:
            self._scene.update(view, lambda: self._lit(waiting))

    def _add(self, waiting: Waiting, *, dark_too: bool) -> None:
        """Add a frame to its bursts; dark columns are detected, too, if `dark_too`."""
        view, link = waiting.view, self._link
        assert view is not None
        assert link is not None
        clock = view.bursts.clock
        bursts = link.phase.burst_of(view.bursts.first_copy + np.arange(clock.n_copies))
        numbers = np.unique(bursts)
        view.bursts = replace(view.bursts, clock=replace(clock, burst=bursts - numbers[0]))
        waiting.numbers = numbers + link.offset
        self._next_number = max(self._next_number, int(waiting.numbers[-1]) + 1)
        dark_too |= "dark_columns" not in self._options.skip
        tried = np.ones(len(view.snr), bool) if dark_too else has_light(view)
        for burst in bursts_of(view, waiting.numbers, tried):
            if burst.number in self._bursts:
                self._bursts[burst.number] += burst
            elif burst.number > self._last_closed:
                self._bursts[burst.number] = burst

    def _open(self, waiting: Waiting) -> list[Burst]:
        """The bursts of a frame that are still going on."""
        numbers = [] if waiting.numbers is None else waiting.numbers.tolist()
        return [self._bursts[number] for number in numbers if number in self._bursts]

    def _lit(self, waiting: Waiting) -> Float32Array:
        """(C, N) probability that each slot of a frame is lit."""
        assert waiting.view is not None
        assert waiting.numbers is not None
        return lit_slots(waiting.view, waiting.numbers, self._open(waiting))

    def _doubts(self, waiting: Waiting) -> tuple[int, int]:
        """Numbers of doubtful packets and of all packets in well-lit columns of a frame."""
        return (0, 0) if waiting.view is None else doubts(waiting.view, self._open(waiting))

    def _forget_bursts(self) -> None:
        self._bursts, self._last_closed = {}, -1

    # -- a second pass over the first frames -------------------------------------------------------------------------

    def _receive_first_again(self, at_last: bool) -> None:
        """The first frames once more: by then it is known better what is on the screen.

        Where that leaves doubt, more frames are waited for, unless it is `at_last` or results are wanted promptly.
        """
        held = [each for each in self._waiting if self._can_receive_again(each)]
        may_wait = self._n_held < SETTINGS.frames_held_long and not at_last and not self._options.prompt
        if len(held) > 1:
            self._measure_again(held)
            self._forget_bursts()
            for waiting in self._waiting:
                if waiting.numbers is not None:
                    self._add(waiting, dark_too=False)
        doubtful, whole = np.sum([(0, 1), *map(self._doubts, held)], axis=0)
        in_doubt = doubtful / whole > SETTINGS.much_doubt
        self._n_held = SETTINGS.frames_held_long if may_wait and in_doubt else 0

    def _can_receive_again(self, waiting: Waiting) -> bool:
        view, scene = waiting.view, self._scene
        return waiting.numbers is not None and view is not None and scene is not None and scene.can_measure_again(view)

    def _measure_again(self, held: list[Waiting]) -> None:
        """Learn the picture anew from all held frames, and measure doubtful frames with the picture of the others."""
        assert self._scene is not None
        known = [self._lit(waiting) for waiting in held]
        doubtful = [len(held) <= SETTINGS.frames_held or self._doubts(waiting)[0] > 0 for waiting in held]
        self._scene.measure_again([w.view for w in held if w.view is not None], known, doubtful)

    # -- results ---------------------------------------------------------------------------------------------------

    def _finish_scene(self) -> list[FrameResult]:
        """The results of a scene that is over, by what was known of it."""
        done = self.finish()
        self._scene = None
        self._n_held = self._n_first
        return done

    def finish(self) -> list[FrameResult]:
        """The results still held back."""
        if self._link is not None:
            self._settle_bursts()
        if self._n_held:
            self._receive_first_again(at_last=True)
        done = self._ready()
        done += [self._report(waiting, None) for waiting in self._waiting]
        self._waiting.clear()
        return done

    def _ready(self) -> list[FrameResult]:
        """Results of the frames whose bursts all ended, oldest first."""
        done: list[FrameResult] = []
        while self._waiting and not self._n_held:
            # Bursts may go on beyond frames that were passed over.
            oldest, *later = (each for n, each in enumerate(self._waiting) if n == 0 or each.view is not None)
            following = later[0] if later else None
            unsettled = following is None or following.numbers is None
            if oldest.view is not None and (oldest.numbers is None or unsettled):
                break
            done.append(self._report(self._waiting.popleft(), following))
        return done

    def _report(self, waiting: Waiting, following: Waiting | None) -> FrameResult:
        view = waiting.view
        if view is None or waiting.numbers is None:
            return waiting.result
        shown = [] if following is None or following.numbers is None else following.numbers.tolist()
        going_on = [burst for burst in self._open(waiting) if burst.number in shown]
        closed = [burst for burst in self._open(waiting) if burst.number not in shown]
        for burst in closed:
            self._last_closed = max(self._last_closed, burst.number)
            del self._bursts[burst.number]
            waiting.skip("dark_columns", int((~burst.tried).sum()))
        n_strips = view.acquisition.binned.light.shape[1]
        ended = [burst.ended(int(waiting.numbers[0]), n_strips) for burst in closed]
        headerless = np.zeros(len(view.snr), bool)
        if self._link is not None:
            headerless = self._link.headerless(ended, headerless.size)
        sure = [np.zeros(headerless.size, np.float32), *(burst.probability for burst in going_on)]
        columns = assemble.clip_results(
            view.bursts.clock,
            ended,
            np.max(sure, axis=0),
            view.snr,
            headerless,
            self._options.min_confidence,
            self.certainty,
        )
        if view.denoised:
            columns = tuple(replace(c, denoised=c.column in view.denoised) for c in columns)
        if view.context.camera.reversed:
            columns = tuple(assemble.in_stored_rows(column, view.height) for column in columns)
        if self._options.dump_dir is not None:
            found = _taps(waiting, view, ended)
            dump_stages(self._options.dump_dir, waiting.result.source, waiting.result.frame, found)
        result = replace(waiting.result, columns=columns, status=assemble.clip_status(columns))
        if self._link is not None:
            result = replace(result, screen_profile=view.acquisition.variant(self._link.phase.repeats).name)
        return replace(result, soft_bits=self._soft_bits(result, view, ended)) if self._options.soft_bits else result

    def _soft_bits(
        self, result: FrameResult, view: View, ended: Sequence[confidence.BurstInClip]
    ) -> FrameSoftBits | None:
        soft = clip_soft_bits(ended, assemble.snr_db_of_columns(view.snr), self._epoch)
        if soft is None:
            return None
        return replace(soft, source=result.source, frame=result.frame, time_s=result.time_s)


def _shape(view: View) -> tuple[int, int]:
    """Columns and slots of a packet: where these differ, another screen is seen."""
    return view.acquisition.screen.columns, view.bursts.clock.packet_slots


def _taps(waiting: Waiting, view: View, ended: Sequence[confidence.BurstInClip]) -> dict[str, Any]:
    """What is written of a frame: as of a photograph, but strips as tracking samples them, and bursts that end here."""
    found: dict[str, Any] = {"geometry.corners": waiting.result.corners, "clock": view.bursts.clock}
    if view.light is not None and view.pose is not None:
        rows = view.pose.rows.astype(np.int64)
        found |= {"sampling.light": view.light, "sampling.inside": view.pose.map.inside, "sampling.rows": rows}
    else:
        found["sampling"] = view.acquisition.profiles
    numbers: IntArray = np.array([burst.number for burst in ended], np.int64)
    found |= {"channel.metrics": view.bursts.metrics, "bursts.shown": view.bursts.shown}
    found |= {"bursts.number": waiting.numbers, "bursts.ended": numbers}
    return found | {f"detect.{burst.number}": burst.posteriors for burst in ended}
