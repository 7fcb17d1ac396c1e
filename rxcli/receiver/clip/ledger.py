"""Bursts that go on from frame to frame, and frames whose results wait for them."""

from collections import deque
from functools import partial

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.receiver.clip.bursts import Burst, bursts_of, doubts, lit_slots
from rxcli.receiver.clip.common_clock import Start
from rxcli.receiver.clip.reporting import completed
from rxcli.receiver.clip.scene import TrackedScreen
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.clip.timeline import Timeline
from rxcli.receiver.clip.views import View, Waiting
from rxcli.types import Frame, FrameResult, OnTaps, Remark


class Ledger:
    """Bursts and results of a clip.

    A frame waits until it is clear which copies begin a burst; then its bursts are numbered and added to those of the
    frames before, and its result is complete once a later frame shows which of them are over. The first frames of a
    scene wait longer, and are measured again when its picture is known better.

    Args:
        options: of the receiver.
        on_taps: is given the arrays of every received frame, or None.
    """

    def __init__(self, options: ReceiverOptions, on_taps: OnTaps | None) -> None:
        self._options, self._on_taps = options, on_taps
        #: Frames without a result, oldest first; all that were received belong to the link's present time.
        self._waiting: deque[Waiting] = deque()
        #: Bursts that are still going on, by number.
        self._bursts: dict[int, Burst] = {}
        #: The link's time that holds now, and the one before.
        self._timeline: Timeline | None = None
        self._earlier_timeline: Timeline | None = None
        #: Ratio of time stamps to the link's time; None if it cannot be estimated, and frames are received alone.
        self._stretch: float | None = 1.0
        #: The scene of the frames that wait; None where they are not tracked.
        self._scene: TrackedScreen | None = None
        #: The clock that the first frames agreed on, where each shows little.
        self.start: Start | None = None
        #: Number of first frames of a scene whose results are held back until its picture is known, at first; and
        #: number that holds now, 0 once the picture is known.
        self._n_first = SETTINGS.first_frames if "tracking" in options.skip else 0
        self._n_held = self._n_first

    @property
    def timeline(self) -> Timeline:
        """The link's time and bursts, once a frame was received."""
        assert self._timeline is not None
        return self._timeline

    @property
    def remarks(self) -> tuple[Remark, ...]:
        """About the clip's time stamps."""
        if self._stretch is None:
            return (Remark("retimed"),)
        return (Remark("slow_motion", {"stretch": self._stretch}),) if self._stretch != 1 else ()

    def has_certain_bursts(self, frame: Frame, scene: TrackedScreen) -> bool:
        """Whether all bursts that a frame should show are certain in all lit columns."""
        if self._timeline is None or scene.last is None or self._n_held:
            return False
        numbers = self._timeline.predicted(frame, scene.pose.rows, scene.last.acquisition.clock.rows_per_slot)
        lit = np.median(scene.last.snr, axis=1) >= 1
        bursts = [self._bursts[number] for number in numbers if number in self._bursts]
        return len(bursts) == len(numbers) > 0 and bool(lit.any()) and all(burst.certain[lit].all() for burst in bursts)

    # -- frames come in ----------------------------------------------------------------------------------------------

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
        timeline, done = self._timeline, []
        if timeline is None or self._stretch is None or not timeline.place(view):
            done = self._finish_scene()
            self._earlier_timeline = timeline or self._earlier_timeline
            timeline = self._timeline = self._begun_timeline(view)
        waiting.view, self._scene = view, scene
        self._waiting.append(waiting)
        with view.context.timer("detect"):
            if self._n_held and self._stretch == 1 and timeline.time.judged and not timeline.stamps_judged:
                stretch = timeline.estimate_stretch(self._views[0])
                if stretch != timeline.time.stretch:
                    return done + self._enter_stretched(stretch)
            if timeline.phase.settled or len(self._views) > SETTINGS.first_frames:
                self._number_frames(timeline)
                if self._n_held and len(self._waiting) >= self._n_held:
                    self._measure_again()
        return done + self._ready()

    def _begun_timeline(self, view: View) -> Timeline:
        """Begin the link's time anew with a frame."""
        before, stretch = self._earlier_timeline, self._stretch or 1.0
        timeline = Timeline.begin(view, self.start, stretch)
        if not timeline.place(view):
            # The clock that the first frames seemed to share is not this frame's.
            self.start, timeline = None, Timeline.begin(view, None, stretch)
            timeline.place(view)
        self._bursts = {}
        return timeline if before is None else timeline.after(before, view)

    def _enter_stretched(self, stretch: float | None) -> list[FrameResult]:
        """Enter all frames anew by another ratio of their time stamps; returns the results that are complete."""
        waiting, scene, done = self._waiting, self._scene, []
        self._stretch, self._waiting, self._timeline = stretch, deque(), None
        for each in waiting:
            each.update(remarks=self.remarks)
            if each.view is not None:
                each.view.numbers = None
            done += self.add(each) if each.view is None else self.enter(each, each.view, scene)
        return done

    # -- bursts --------------------------------------------------------------------------------------------------------

    @property
    def _views(self) -> list[View]:
        """The frames that wait and were received."""
        return [waiting.view for waiting in self._waiting if waiting.view is not None]

    def _open(self, view: View) -> list[Burst]:
        """The bursts of a frame that are still going on."""
        numbers = [] if view.numbers is None else view.numbers.tolist()
        return [self._bursts[number] for number in numbers if number in self._bursts]

    def _number_frames(self, timeline: Timeline) -> None:
        """Number the bursts of the frames that waited for it, add them, and learn the picture from them."""
        for view in self._views:
            if view.numbers is None:
                timeline.number(view)
                self._add_bursts(view)
                scene = self._scene  # The frames of the one before may still wait.
                if scene is not None and view.tracked and scene.can_measure_again(view):
                    scene.update(view, partial(lit_slots, view, self._open(view)))

    def _add_bursts(self, view: View) -> None:
        for burst in bursts_of(view):
            before = self._bursts.get(burst.number)
            self._bursts[burst.number] = burst if before is None else before + burst

    def _measure_again(self, *, at_last: bool = False) -> None:
        """Measure the first frames once more: by then it is known better what is on the screen.

        The picture is learned anew from all of them, and doubtful ones are measured with the picture of the others,
        as are all whose slots were detected jointly with it. Where that leaves doubt, more frames are waited for,
        unless it is `at_last` or results are wanted promptly.
        """
        views, scene = self._views, self._scene
        held = [] if scene is None else [view for view in views if scene.can_measure_again(view)]
        if scene is not None and len(held) > 1:
            lit = [lit_slots(view, self._open(view)) for view in held]
            is_first = self._n_held == self._n_first
            needed = [is_first or bool(view.joint) or doubts(view, self._open(view))[0] > 0 for view in held]
            scene.measure_again(held, lit, needed)
            self._bursts = {}
            for view in views:
                self._add_bursts(view)
        n_doubtful, n_packets = np.sum([(0, 0), *(doubts(view, self._open(view)) for view in held)], axis=0)
        may_wait = self._n_held == self._n_first and not at_last and not self._options.prompt
        # Slots that were detected jointly with a picture of few frames may be wrong, however sure.
        is_open = n_doubtful > SETTINGS.much_doubt * n_packets or any(view.joint for view in held)
        self._n_held = SETTINGS.frames_in_doubt if may_wait and is_open else 0

    # -- results go out ------------------------------------------------------------------------------------------------

    def finish(self) -> list[FrameResult]:
        """The results still held back."""
        if self._timeline is not None:
            self._number_frames(self._timeline)
        if self._n_held:
            self._measure_again(at_last=True)
        done = self._ready()
        done += [self._report(waiting, None) for waiting in self._waiting]
        self._waiting.clear()
        return done

    def _finish_scene(self) -> list[FrameResult]:
        """The results of a scene that is over, by what was known of it."""
        done = self.finish()
        self._scene, self._n_held = None, self._n_first
        return done

    def _ready(self) -> list[FrameResult]:
        """Results of the frames whose bursts all ended, oldest first."""
        done: list[FrameResult] = []
        while self._waiting and not self._n_held:
            # Bursts may go on beyond frames that were passed over.
            views, is_received = self._views, self._waiting[0].view is not None
            if is_received and (len(views) == 1 or views[1].numbers is None):
                break
            done.append(self._report(self._waiting.popleft(), views[1] if is_received else None))
        return done

    def _report(self, waiting: Waiting, following: View | None) -> FrameResult:
        """The result of a frame: the packets of its bursts that the `following` one does not show."""
        if waiting.view is None or self._timeline is None:
            return waiting.result
        shown = set() if following is None else {burst.number for burst in self._open(following)}
        own = self._open(waiting.view)
        closed = [burst for burst in own if burst.number not in shown]
        for burst in closed:
            del self._bursts[burst.number]
        going_on = [burst for burst in own if burst.number in shown]
        return completed(waiting, self._timeline, closed, going_on, self._options, self._on_taps)
