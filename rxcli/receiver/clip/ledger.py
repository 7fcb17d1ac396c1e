"""The account of a clip: link time, bursts that go on, and frames whose results wait for them."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.receiver.clip.bursts import Burst, bursts_of, doubts, has_light, lit_slots
from rxcli.receiver.clip.common_clock import Start
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

    def compare(self, view: View) -> None:
        """Update the phase of the bursts with a frame."""
        copies = view.bursts.clock.to_copies(slot_llr(view.bursts.metrics)).transpose(1, 0, 2)
        self.phase.update(view.bursts.first_copy, np.asarray(copies * (view.bursts.shown > 0), np.float64))

    def number(self, view: View) -> None:
        """Number the bursts of a frame."""
        clock = view.bursts.clock
        bursts = self.phase.burst_of(view.bursts.first_copy + np.arange(clock.n_copies))
        numbers = np.unique(bursts)
        view.bursts = replace(view.bursts, clock=replace(clock, burst=bursts - numbers[0]))
        view.numbers = numbers + self.offset

    def predicted(self, frame: Frame, rows: FloatArray, rows_per_slot: float) -> list[int]:
        """Numbers of the bursts that the rows (R,) of a further frame should show; none if that is not known."""
        slot = self.time.predict(frame.index, frame.time_s)
        if slot is None or not self.phase.settled:
            return []
        top, bottom = ((slot + rows[[0, -1]] / rows_per_slot) // self.time.packet_slots).astype(np.int64)
        numbers: list[int] = (np.unique(self.phase.burst_of(np.arange(top, bottom + 1))) + self.offset).tolist()
        return numbers

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
        #: Number of first frames of a scene to hold back; and number that is held back now, 0: none.
        self._n_first = SETTINGS.frames_held if "tracking" in options.skip else 0
        self._n_held = self._n_first

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

    @property
    def _views(self) -> list[View]:
        """The frames that wait and were received."""
        return [waiting.view for waiting in self._waiting if waiting.view is not None]

    def has_certain_bursts(self, frame: Frame, scene: TrackedScreen) -> bool:
        """Whether all bursts that a frame should show are certain in all lit columns."""
        last = scene.last
        if self._link is None or last is None or self._n_held:
            return False
        numbers = self._link.predicted(frame, scene.rows, last.acquisition.clock.rows_per_slot)
        lit = np.median(last.snr, axis=1) >= 1
        bursts = [self._bursts[number] for number in numbers if number in self._bursts]
        certain = len(bursts) == len(numbers) > 0 and all(burst.certain[lit].all() for burst in bursts)
        return certain and bool(lit.any())

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
        frame, link, first_copy, done = view.context.frame, self._link, None, []
        if link is not None:
            if self._stretch is not None and link.shape == _shape(view):
                first_copy = link.time.update(frame.index, frame.time_s, view.bursts.clock)
            if first_copy is None:
                done = self._finish_scene()
        if link is None or first_copy is None:
            link, first_copy = self._begun_link(view, frame)
        link.last_time_s = frame.time_s
        view.bursts = replace(view.bursts, first_copy=first_copy)
        waiting.view, self._scene, self._link = view, scene, link
        self._waiting.append(waiting)
        with view.context.timer("detect"):
            if not link.phase.settled:
                link.compare(view)
            if self._n_held and link.time.judged and not link.stamps_judged:
                done += self._judge_stamps(link)
                link = self._link
            n_unsettled = sum(each.numbers is None for each in self._views)
            if link.phase.settled or n_unsettled > SETTINGS.max_waiting_frames:
                self._settle_bursts()
                if self._n_held and len(self._waiting) >= self._n_held:
                    self._receive_first_again(at_last=False)
        return done + self._ready()

    def _begun_link(self, view: View, frame: Frame) -> tuple[_Link, int]:
        """Begin the link's time anew; also returns the number of the frame's first copy in it."""
        screen, clock = view.acquisition.screen, view.bursts.clock
        offset, stretch = self._next_number, self._stretch or 1.0
        if self._link is not None and offset:
            passed_s = (frame.time_s - self._link.last_time_s) / stretch
            offset += int(passed_s / (screen.packet_s * self._link.phase.repeats))
        fresh = tracking.LinkTime(screen.packet_slots, screen.slot_rate_hz, stretch)
        time = fresh if self.start is None else self.start.time
        first_copy = time.update(frame.index, frame.time_s, clock)
        if first_copy is None:
            # The clock that the first frames seemed to share is not this frame's.
            self.start, time, first_copy = None, fresh, fresh.update(frame.index, frame.time_s, clock)
        assert first_copy is not None
        self._epoch += 1
        self._forget_bursts()
        phase = tracking.BurstPhase(view.acquisition.repeats)
        return _Link(time, phase, _shape(view), offset, frame.time_s, stamps_judged=self._stretch != 1), first_copy

    def _judge_stamps(self, link: _Link) -> list[FrameResult]:
        """Where the stamps of the first frames are not the time, enter these frames anew; returns complete results."""
        link.stamps_judged = True
        view = self._views[0]
        shown = float(np.ptp(np.flatnonzero(view.acquisition.profiles.inside.any(axis=(0, 1)))))
        packet_s = view.acquisition.screen.packet_s / view.bursts.clock.packet_slots
        self._stretch = link.time.time_stamp_stretch(shown / view.bursts.clock.rows_per_slot * packet_s)
        if self._stretch == link.time.stretch:
            return []
        waiting, scene, done = self._waiting, self._scene, []
        self._waiting, self._link = deque(), None
        for each in waiting:
            each.update(message=self.message)
            if each.view is not None:
                each.view.numbers = None
            done += self.add(each) if each.view is None else self.enter(each, each.view, scene)
        return done

    def _settle_bursts(self) -> None:
        """Add all frames that waited for the phase of the bursts, and learn from them."""
        for view in self._views:
            if view.numbers is None:
                self._add(view, dark_too=self._n_held > 0)
                if self._scene is not None and view.flat is not None:
                    self._scene.update(view, partial(lit_slots, view, self._open(view)))

    def _add(self, view: View, *, dark_too: bool) -> None:
        """Add a frame to its bursts; dark columns are detected, too, if `dark_too`."""
        assert self._link is not None
        self._link.number(view)
        tried = has_light(view) | dark_too | ("dark_columns" not in self._options.skip)
        for burst in bursts_of(view, tried):
            if burst.number in self._bursts:
                self._bursts[burst.number] += burst
            elif burst.number > self._last_closed:
                self._bursts[burst.number] = burst
                self._next_number = max(self._next_number, burst.number + 1)

    def _open(self, view: View) -> list[Burst]:
        """The bursts of a frame that are still going on."""
        numbers = [] if view.numbers is None else view.numbers.tolist()
        return [self._bursts[number] for number in numbers if number in self._bursts]

    def _forget_bursts(self) -> None:
        self._bursts, self._last_closed = {}, -1

    def _receive_first_again(self, at_last: bool) -> None:
        """The first frames once more: by then it is known better what is on the screen.

        The picture is learned anew from all of them, and doubtful ones are measured with the picture of the others.
        Where that leaves doubt, more frames are waited for, unless it is `at_last` or results are wanted promptly.
        """
        views, scene = [view for view in self._views if view.numbers is not None], self._scene
        held = [] if scene is None else [view for view in views if scene.can_measure_again(view)]
        may_wait = self._n_held < SETTINGS.frames_held_long and not at_last and not self._options.prompt
        if scene is not None and len(held) > 1:
            lit = [lit_slots(view, self._open(view)) for view in held]
            doubtful = [len(held) <= SETTINGS.frames_held or doubts(view, self._open(view))[0] > 0 for view in held]
            scene.measure_again(held, lit, doubtful)
            self._forget_bursts()
            for view in views:
                self._add(view, dark_too=False)
        doubts_of = [doubts(view, self._open(view)) for view in held]
        in_doubt = sum(n for n, _ in doubts_of) > SETTINGS.much_doubt * sum(n for _, n in doubts_of)
        self._n_held = SETTINGS.frames_held_long if may_wait and in_doubt else 0

    # -- results ---------------------------------------------------------------------------------------------------

    def _finish_scene(self) -> list[FrameResult]:
        """The results of a scene that is over, by what was known of it."""
        done = self.finish()
        self._scene, self._n_held = None, self._n_first
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
            view, views = self._waiting[0].view, self._views
            # Bursts may go on beyond frames that were passed over.
            following = views[1] if view is not None and len(views) > 1 else None
            if view is not None and (view.numbers is None or following is None or following.numbers is None):
                break
            done.append(self._report(self._waiting.popleft(), following))
        return done

    def _report(self, waiting: Waiting, following: View | None) -> FrameResult:
        view = waiting.view
        if view is None or view.numbers is None or self._link is None:
            return waiting.result
        shown = [] if following is None or following.numbers is None else following.numbers.tolist()
        going_on = [burst for burst in self._open(view) if burst.number in shown]
        closed = [burst for burst in self._open(view) if burst.number not in shown]
        for burst in closed:
            self._last_closed = max(self._last_closed, burst.number)
            del self._bursts[burst.number]
            waiting.skip("dark_columns", int((~burst.tried).sum()))
        ended = [burst.ended(view) for burst in closed]
        probabilities = [np.zeros(len(view.snr), np.float32), *(burst.probability for burst in going_on)]
        columns = assemble.clip_results(
            view.bursts.clock,
            ended,
            np.max(probabilities, axis=0),
            view.snr,
            self._link.headerless(ended, len(view.snr)),
            self._options.min_confidence,
            self.certainty,
        )
        if view.denoised:
            columns = tuple(replace(c, denoised=c.column in view.denoised) for c in columns)
        if view.context.camera.reversed:
            columns = tuple(assemble.in_stored_rows(column, view.height) for column in columns)
        if self._options.dump_dir is not None:
            found = _taps(waiting.result, view, ended)
            dump_stages(self._options.dump_dir, waiting.result.source, waiting.result.frame, found)
        name = view.acquisition.variant(self._link.phase.repeats).name
        waiting.update(columns=columns, status=assemble.clip_status(columns), screen_profile=name)
        if self._options.soft_bits:
            waiting.update(soft_bits=self._soft_bits(waiting.result, view, ended))
        return waiting.result

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


def _taps(result: FrameResult, view: View, ended: Sequence[confidence.BurstInClip]) -> dict[str, Any]:
    """What is written of a frame: as of a photograph, but strips as tracking samples them, and bursts that end here."""
    found: dict[str, Any] = {"geometry.corners": result.corners, "clock": view.bursts.clock}
    if view.light is not None and view.pose is not None:
        rows = view.pose.rows.astype(np.int64)
        found |= {"sampling.light": view.light, "sampling.inside": view.pose.map.inside, "sampling.rows": rows}
    else:
        found["sampling"] = view.acquisition.profiles
    numbers: IntArray = np.array([burst.number for burst in ended], np.int64)
    found |= {"channel.metrics": view.bursts.metrics, "bursts.shown": view.bursts.shown}
    found |= {"bursts.number": view.numbers, "bursts.ended": numbers}
    return found | {f"detect.{burst.number}": burst.posteriors for burst in ended}
