"""The frames of a clip, one after the other: what is known is checked and used, or the frame received anew."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import one_blas_thread
from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile
from rxcli.receiver.acquisition import Acquisition
from rxcli.receiver.cameras import has_profile
from rxcli.receiver.clip import results
from rxcli.receiver.clip.bursts import BurstReader
from rxcli.receiver.clip.outline import FirstOutline
from rxcli.receiver.clip.scene import TrackedScreen
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.clip.start import Start, acquisition_at, agree, shows_little
from rxcli.receiver.clip.views import View, Waiting
from rxcli.receiver.context import Failure, FrameContext, Outline, Timer
from rxcli.receiver.decode import assemble, confidence, detect
from rxcli.receiver.decode.settings import SETTINGS as decode_settings
from rxcli.receiver.decode.soft_bits import clip_soft_bits
from rxcli.receiver.reception import Reception, complete_packets, has_clear_packets, shows_steady_light
from rxcli.receiver.search import Found, search
from rxcli.receiver.search.nulls import STEADY_LIGHT, light_without_data
from rxcli.receiver.still import apply_autoencoder, decode, decode_photograph, doubtful_columns, initial_pass
from rxcli.receiver.sync import tracking
from rxcli.receiver.unknown_camera import settle
from rxcli.results.dump import dump_stages
from rxcli.types import BoolArray, FloatArray, Frame, FrameResult, FrameSoftBits, IntArray

_SAME = "it shows the frame before once more, so that its time is not that of its rows; it was left out"
_NOMINAL_TIME = "the clip's time stamps do not advance here; its nominal frame rate was taken"
_SLOW_MOTION = "slow motion: time stamps are {:g} times as long as the link's time, which was taken"
_UNLIKE = (
    "rows are {:.3f} times as quick as the named camera's, as in clips that were stabilised or cropped: the camera was "
    "estimated instead; switch stabilisation off for the best"
)
_RETIMED = (
    "the clip's time stamps do not fit the link's time, as after a change of its speed: each frame is received alone; "
    "give the clip as the camera recorded it"
)
#: Copies between two frames that have none in common.
_FAR_APART = 1 << 12


def receive_clip(frames: Iterable[Frame], options: ReceiverOptions) -> Iterator[FrameResult]:
    """Receive the frames of a clip; results come a frame or more late. An error of `frames` comes after all results."""
    clip = _Clip(options)
    try:
        for frame in frames:
            with one_blas_thread():
                done = clip.take(frame)
            yield from done
    except Exception:
        yield from clip.finish()
        raise
    yield from clip.finish()


@dataclass(slots=True, eq=False)
class _Link:
    """The link's time, as long as it is not lost."""

    time: tracking.LinkTime
    phase: tracking.BurstPhase
    #: Columns and slots of a packet.
    shape: tuple[int, int]
    #: Number of burst 0 of this time in the clip.
    offset: int = 0
    last_time_s: float = 0.0
    #: Whether it was looked whether time stamps are the time.
    judged: bool = False
    #: (1, C) log-likelihood of the headers of all bursts so far; None before any.
    header_llr: FloatArray | None = None

    def headerless(self, closed: Sequence[tracking.ClosedBurst], n_columns: int) -> BoolArray:
        """(C,) columns that show no headers, in all bursts up to some that are closed."""
        header_llr = np.zeros((1, n_columns)) if self.header_llr is None else self.header_llr
        most = decode_settings.max_header_llr
        for burst in closed:
            header_llr = header_llr + np.clip(burst.posteriors.header_llr, -most, most)
        self.header_llr = header_llr
        return assemble.find_headerless(header_llr) if closed else np.zeros(n_columns, bool)


@dataclass(frozen=True, slots=True, eq=False)
class _Settled:
    """A frame whose clock and camera are known."""

    context: FrameContext
    acquisition: Acquisition
    #: Its initial pass, where there was one; what was decoded to refine its camera, where that was estimated.
    first: Reception | None = None
    reception: Reception | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Located:
    """Where the screen is in a frame, and what the search found there."""

    outline: Outline
    context: FrameContext
    #: None where the screen was moved since, or the camera is another one.
    found: Found | Failure | None = None


class _Clip:
    """What is known of a clip so far."""

    def __init__(self, options: ReceiverOptions) -> None:
        self._options = options
        self._waiting: deque[Waiting] = deque()
        self._bursts = BurstReader(options.skip)
        self._link: _Link | None = None
        #: The first frames that show screen and camera, until they have agreed on a clock; None when that is done, or
        #: not needed.
        self._first: list[Frame] | None = [] if "tracking" in options.skip else None
        self._outline: FirstOutline | None = None
        #: Probability that the screen's columns are numbered right.
        self._certainty = 1.0
        #: Whether a frame shows so little that it should find its clock with others.
        self._little = False
        self._start: Start | None = None
        self._next_number = 0
        #: How much longer time stamps are than the time was; None where that cannot be told, and frames stand alone.
        self._stretch: float | None = 1.0
        #: Counts the times that the link's time was begun anew: burst numbers of different ones cannot be compared.
        self._epoch = 0
        #: A frame with the camera and the screens that remain, and what they were found for.
        self._context: FrameContext | None = None
        self._taken_with: tuple[object, ...] = ()
        #: Whether it was looked whether the camera's profile explains the clip; what there is to say of it.
        self._tried_profile = False
        self._camera_note: str | None = None
        self._corners: FloatArray | None = None
        #: Some pixels of the last frame.
        self._some: NDArray[np.float32] | None = None
        #: Number of a frame that is yet to be received, and where its screen is.
        self._found: tuple[int, _Located | Failure] | None = None
        #: None where nothing is known, or frames cannot be tracked; and the one before the last search.
        self._scene: TrackedScreen | None = None
        self._scene_before: TrackedScreen | None = None
        #: Frames in a row that were received like photographs, and that showed no screen.
        self._n_unknown = 0
        self._hold_first()

    def _hold_first(self) -> None:
        """Hold back the first frames of a scene, to be looked at once more."""
        self._hold(SETTINGS.frames_held if "tracking" in self._options.skip else 0)

    def _hold(self, n_frames: int) -> None:
        """Hold back so many frames; 0 from then on."""
        self._n_held = n_frames
        self._bursts.dark_too = n_frames > 0

    # -- one frame ---------------------------------------------------------------------------------------------

    def take(self, frame: Frame) -> list[FrameResult]:
        """Receive the next frame; returns the results that are complete."""
        if self._first is None:
            return self._take(frame)
        if not self._first and not self._opens(frame):
            return self._take(frame)
        assert self._outline is not None
        if self._first:
            self._outline.take(frame)
        self._first.append(frame)
        enough = len(self._first) == SETTINGS.frames_together or not self._little
        return self._begin() if self._outline.settled and enough else []

    def _opens(self, frame: Frame) -> bool:
        """Whether a frame shows screen and camera; the outline, and perhaps the clock, is then found with the next."""
        located = self._locate(frame, Timer())
        self._found = frame.index, located
        if isinstance(located, Failure):
            return False
        self._outline = FirstOutline(frame, located.outline.corners, self._options, located.context)
        self._little = shows_little(located.context)
        return True

    def _begin(self) -> list[FrameResult]:
        """The first frames, once they have agreed on an outline and, where each shows little, on a clock."""
        frames, self._first = self._first or [], None
        if self._outline is not None and self._found is not None and isinstance(self._found[1], _Located):
            located = _moved_to(self._found[1], self._outline.corners)
            located = self._read_in_time(located, frames)
            if self._little and len(frames) > 1:
                located = self._with_common_clock(located, frames)
            self._found = self._found[0], located
        return [result for frame in frames for result in self._take(frame)]

    def _read_in_time(self, located: _Located, frames: Sequence[Frame]) -> _Located:
        """The same with another camera, where the one estimated would need more than a frame's time to read it.

        An estimate tells rows per slot; with a slower screen than the right one the camera seems slower, too.
        """
        context, period_s = located.context, _shortest_period_s(frames)
        if context.camera.hypothesis is None or period_s is None:
            return located
        too_long = context.camera.line_delay_s * context.frame.height / (period_s * SETTINGS.readout_slack)
        if too_long <= 1 and not self._little:
            return located
        slowest_hz = too_long * max(screen.slot_rate_hz for screen in context.screens)
        screens = tuple(screen for screen in self._options.screens if screen.slot_rate_hz >= slowest_hz)
        options, found = replace(self._options, screens=screens), None
        if too_long > 1 and screens:
            found = self._search_at(context, options)
        if screens and (self._little or isinstance(found, Found)):
            self._options = options
        if not isinstance(found, Found):
            return located
        self._little = shows_little(found.best.context)
        return replace(located, context=found.best.context, found=found)

    def _search_at(
        self, context: FrameContext, options: ReceiverOptions, known: FrameContext | None = None
    ) -> Found | Failure:
        """Search a frame whose corners are known."""
        at = replace(options, corners=context.corners)
        return search(context.frame, at, context.timer, known)

    def _with_common_clock(self, located: _Located, frames: Sequence[Frame]) -> _Located:
        """Find the clock that the first frames share, with the reading of the first frame's camera that leads.

        Less than a packet tells rows per slot, but perhaps another screen, or the wrong direction of the readout.
        """
        first = located.context
        readings = [first]
        if first.camera.hypothesis is not None:
            readings += _readings_of(first, self._options.screens)
        starts = [(agree(frames, reading), reading) for reading in readings]
        agreed = [(start.lead, start, reading) for start, reading in starts if start is not None]
        if not agreed:
            return located
        _, self._start, chosen = max(agreed, key=lambda one: one[0])
        return located if chosen is first else replace(located, context=chosen, found=None)

    def _take(self, frame: Frame) -> list[FrameResult]:
        timer = Timer()
        message = _NOMINAL_TIME if frame.nominal_time else self._about_time()
        waiting = Waiting(FrameResult(frame.source, frame.index, frame.time_s, "ok", message=message))
        if self._shows_the_same(frame):
            waiting.result = replace(waiting.result, message=_SAME)
            waiting.skip("doubled_frames", 1)
            self._waiting.append(waiting)
            return self._ready()
        if self._options.stop_when_certain and self._shows_nothing_new(frame):
            waiting.result = replace(waiting.result, message="its bursts are certain from the frames before")
            waiting.skip("certain_frames", 1)
            self._waiting.append(waiting)
            return self._ready()
        view: View | Failure | None = self._known(frame, timer)
        if view is not None:
            waiting.skip("tracking", 1)
            self._n_unknown = 0
        else:
            view, report = self._search(frame, timer)
            waiting.result = replace(waiting.result, denoiser=report)
            if not isinstance(view, Failure):
                self._go_on(view, frame)
        if self._camera_note and not waiting.result.message:
            waiting.result = replace(waiting.result, message=self._camera_note)
        if isinstance(view, Failure):
            self._scene = None
            waiting.result = replace(waiting.result, status=view.status, message=view.message)
            self._waiting.append(waiting)
            done = self._finish_scene_before()
        else:
            waiting.view = view
            waiting.result = replace(
                waiting.result,
                **view.context.camera.result_fields,
                screen_profile=view.acquisition.screen.name,
                corners=self._corners,
            )
            done = self._enter(waiting, frame, timer)
        waiting.result = replace(waiting.result, timing_ms=timer.total())
        return done

    def _shows_the_same(self, frame: Frame) -> bool:
        """Whether a frame is the one before once more, as a change of the frame rate makes them: its time is wrong."""
        if "tracking" not in self._options.skip or self._corners is None:
            return False
        some = frame.pixels[:: SETTINGS.same_step, :: SETTINGS.same_step].astype(np.float32)
        before, self._some = self._some, some
        if before is None or before.shape != some.shape:
            return False
        (left, top), (right, bottom) = (self._corners[[0, 2]] / SETTINGS.same_step).astype(int).clip(0)
        screen = np.s_[min(top, bottom) : max(top, bottom), min(left, right) : max(left, right)]
        some, before = some[screen], before[screen]
        if min(some.shape) < 2:
            return False
        # Stripes are elsewhere in every other frame.
        unit = (frame.white - frame.black) / 255
        contrast = float(np.abs(np.diff(some, axis=0)).mean())
        changed = float(np.abs(some - before).mean())
        return contrast > SETTINGS.same_contrast * unit and changed < SETTINGS.same_share * contrast

    def _shows_nothing_new(self, frame: Frame) -> bool:
        """Whether all bursts that a frame should show are certain already in all columns that are lit."""
        link, scene = self._link, self._scene
        if link is None or scene is None or scene.last is None or not link.phase.settled or self._n_held:
            return False
        last, (top, bottom) = scene.last, scene.rows[[0, -1]]
        slot, rows_per_slot = link.time.predict(frame.index, frame.time_s), last.acquisition.clock.rows_per_slot
        if slot is None:
            return False
        ends = (slot + np.array([top, bottom]) / rows_per_slot) // link.time.packet_slots
        numbers = np.unique(link.phase.burst_of(np.arange(ends[0], ends[1] + 1).astype(np.int64))) + link.offset
        lit = np.median(last.snr, axis=1) >= 1.0
        return bool(lit.any()) and all(self._bursts.open.settled(int(number), lit) for number in numbers)

    def finish(self) -> list[FrameResult]:
        """The results still held back."""
        done = self._begin() if self._first else []
        return done + self._finish()

    def _finish(self) -> list[FrameResult]:
        if self._link is not None:
            self._settle_bursts()
        if self._n_held:
            self._receive_first_again(at_last=True)
        done = self._ready(at_last=True)
        done += [self._report(waiting, None) for waiting in self._waiting]
        self._waiting.clear()
        return done

    def _finish_scene_before(self) -> list[FrameResult]:
        """The results of the scene that the last search found to be over, by what was known of it."""
        begun, self._scene = self._scene, self._scene_before
        done = self._finish()
        self._scene = begun
        self._hold_first()
        return done

    # -- a frame like a photograph ------------------------------------------------------------------------------

    def _search(self, frame: Frame, timer: Timer) -> tuple[View | Failure, dict[str, Any] | None]:
        """Receive a frame like a photograph, only the camera taken from before; and what the auto-encoder reports."""
        self._scene_before, self._scene = self._scene, None
        located = self._context_of(frame, timer)
        if isinstance(located, Failure):
            return located, None
        received = self._with_settled_camera(located)
        if isinstance(received, Failure):
            return received, None
        context, acquisition = received.context, received.acquisition
        can_track = self._can_track(context, acquisition)
        again = can_track and self._n_held == SETTINGS.frames_held
        reception, denoised, report = self._decoded(received, again, timer)
        estimated = self._with_estimated_camera(context, reception)
        if estimated is not None:
            context, acquisition = estimated.context, estimated.acquisition
            can_track = self._can_track(context, acquisition)
            again = can_track and self._n_held == SETTINGS.frames_held
            reception, denoised, report = self._decoded(estimated, again, timer)
        if self._start is None and shows_steady_light(reception):
            return Failure("no_signal", STEADY_LIGHT), None
        if assemble.all_dark(reception.snr):
            message = "no light of the screen's columns is seen; something may be in front of it"
            return Failure("no_signal", message), None
        view = View(
            context,
            acquisition,
            _bursts_of(frame, reception),
            reception.model.exposure.isi_memory,
            frame.height,
            reception.snr,
            denoised,
        )
        if can_track:
            with timer("sampling"):
                named = self._options.corners is not None
                black_level = reception.model.black_level
                scene = TrackedScreen.of_frame(context, acquisition, black_level, self._scene_before, named)
                view.light, view.pose = scene.strips(frame), scene.pose
            scene.take(view, lambda: reception.clock.on_grid(reception.posteriors.lit))
            self._scene = scene
        return view, report

    def _context_of(self, frame: Frame, timer: Timer) -> _Located | Failure:
        """Where the screen is in a frame, and the camera, known from the frames before where nothing changed."""
        if self._taken_with != _taken_with(frame) or "tracking" not in self._options.skip:
            self._context = None
        found, self._found = self._found, None
        located = found[1] if found is not None and found[0] == frame.index else self._locate(frame, timer)
        if isinstance(located, Failure):
            return located
        self._certainty = located.outline.certainty
        corners = located.outline.corners
        if self._scene_before is not None and self._scene_before.is_at(corners):
            corners = self._scene_before.corners
            located = _moved_to(located, corners)
        self._corners = corners
        if self._context is None:
            self._context, self._taken_with = located.context, _taken_with(frame)
        return replace(located, context=replace(self._context, frame=frame, corners=corners, timer=timer))

    def _locate(self, frame: Frame, timer: Timer) -> _Located | Failure:
        """The screen in a frame, with the camera that is known or one that is found with it."""
        return _located(search(frame, self._options, timer, self._context))

    def _with_settled_camera(self, located: _Located) -> _Settled | Failure:
        """The frame's clock; and where its camera was estimated, the camera that its slots tell, from then on."""
        context, options = located.context, self._options
        predicted = self._predicted(context)
        if predicted is not None:
            return light_without_data(context, predicted) or _Settled(context, predicted)
        found = located.found or self._search_at(context, options, context)
        if isinstance(found, Failure):
            return found
        best = found.best
        if context.camera.hypothesis is None:
            return _Settled(context, best.acquisition, best.reception)
        with context.timer("detect"):
            reception = decode_photograph(best.acquisition, options.skip, best.reception)
        camera, _ = settle(best.context, best.acquisition, reception)
        self._context = replace(context, camera=replace(camera, hypothesis=None))
        return _Settled(self._context, best.acquisition, best.reception, reception)

    def _with_estimated_camera(self, context: FrameContext, reception: Reception) -> _Settled | None:
        """A clip's first frame by a camera estimated from it, where that of the profile explains nothing of it.

        Stabilisation crops and enlarges what was read, so that rows are no longer those of the profile.
        """
        tried, self._tried_profile = self._tried_profile, True
        if tried or not has_profile(context.frame, self._options) or _shows_packets(reception, SETTINGS.unlike_doubt):
            return None
        before = self._options, self._context
        self._options = replace(self._options, cameras=(), force_camera=False)
        located = _located(self._search_at(context, self._options))
        found = located if isinstance(located, Failure) else self._with_settled_camera(located)
        if isinstance(found, Failure) or not _shows_packets(
            found.reception or initial_pass(found.acquisition), SETTINGS.like_doubt
        ):
            self._options, self._context = before
            return None
        self._context = found.context
        stretch = context.camera.line_delay_s / found.context.camera.line_delay_s
        self._camera_note = _UNLIKE.format(stretch)
        return found

    def _go_on(self, view: View, frame: Frame) -> None:
        """After a frame received like a photograph: with the scene before, as long as such frames are few.

        A hand before the screen, or a frame too quick to be followed, is no reason to learn the picture anew.
        """
        before, begun = self._scene_before, self._scene
        self._n_unknown += 1
        if before is None or begun is None or self._link is None or self._n_unknown > SETTINGS.max_unknown_frames:
            return
        screen, was = view.acquisition.screen, before.last and before.last.acquisition.screen
        if (
            screen is was
            and before.near(begun.corners)
            and self._link.time.agrees(frame.index, frame.time_s, view.bursts.clock)
        ):
            before.seek(begun.corners)
            self._scene, view.light, view.pose = before, None, None

    def _decoded(
        self, settled: _Settled, again: bool, timer: Timer
    ) -> tuple[Reception, frozenset[int], dict[str, Any] | None]:
        """What is received at a lock, columns that the auto-encoder changed, and its report.

        A quick look that leaves little doubt is enough of a frame that is looked at `again` when the picture is known.
        A reception that there is already needs no other.
        """
        acquisition, reception = settled.acquisition, settled.reception
        if reception is None:
            with timer("detect"):
                first = settled.first or initial_pass(acquisition)
                few_doubtful = doubtful_columns(first).size <= SETTINGS.quick_doubt * first.snr.shape[0]
                if again and self._options.cae != "always" and few_doubtful:
                    return first, frozenset(), None
                reception = decode(acquisition, self._options.skip, first)
        with timer("denoise"):
            return apply_autoencoder(acquisition, reception, self._options)

    def _predicted(self, context: FrameContext) -> Acquisition | None:
        """By the clock that the first frames agreed on, where a frame cannot find its own."""
        return None if self._start is None else acquisition_at(self._start, context)

    def _can_track(self, context: FrameContext, acquisition: Acquisition) -> bool:
        """Whether a row of the picture is one instant, in the order of time."""
        return (
            "tracking" in self._options.skip
            and context.frame.mosaic is None
            and acquisition.profiles.sensor_row is None
            and not context.camera.reversed
        )

    # -- a frame whose place and picture are known ---------------------------------------------------------------

    def _known(self, frame: Frame, timer: Timer) -> View | None:
        """The view of a frame by what is known; None where that does not fit."""
        scene = self._scene
        if scene is None or self._link is None or self._taken_with != _taken_with(frame):
            return None
        view = scene.view(frame, self._link.time, self._n_held != SETTINGS.frames_held_long, timer)
        self._corners = scene.corners
        return view

    # -- bursts ---------------------------------------------------------------------------------------------------

    def _enter(self, waiting: Waiting, frame: Frame, timer: Timer) -> list[FrameResult]:
        view = waiting.view
        assert view is not None
        done: list[FrameResult] = []
        known, first_copy = self._link if self._stretch is not None else None, None
        if known is not None and known.shape == _shape(view):
            first_copy = known.time.update(frame.index, frame.time_s, view.bursts.clock)
        if first_copy is None:
            done = self._finish_scene_before() if self._link is not None else []
            first_copy = self._begin_link(view, frame)
            if first_copy is None:
                # The clock that the first frames seemed to share is not this frame's.
                self._start = None
                first_copy = self._begin_link(view, frame)
            assert first_copy is not None
        assert self._link is not None
        self._link.last_time_s = frame.time_s
        view.bursts = replace(view.bursts, first_copy=first_copy)
        self._waiting.append(waiting)
        with timer("detect"):
            if not self._link.phase.settled:
                self._compare(view)
            n_unsettled = sum(w.view is not None and w.numbers is None for w in self._waiting)
            if self._n_held and self._link.time.judged and not self._link.judged:
                self._judge_stamps()
            if self._link.phase.settled or n_unsettled > SETTINGS.max_waiting_frames:
                self._settle_bursts()
                if self._n_held and len(self._waiting) >= self._n_held:
                    self._receive_first_again(at_last=False)
        return done + self._ready()

    def _begin_link(self, view: View, frame: Frame) -> int | None:
        """Begin the link's time anew; returns the number of the frame's first copy in it, None where it fits none."""
        screen = view.acquisition.screen
        offset = self._next_number
        stretch = self._stretch or 1.0
        if self._link is not None and offset:
            passed_s = (frame.time_s - self._link.last_time_s) / stretch
            offset += int(passed_s / (screen.packet_s * self._link.phase.repeats))
        time = tracking.LinkTime(screen.packet_slots, screen.slot_rate_hz, stretch)
        time = self._start.time if self._start else time
        self._link = _Link(time, tracking.BurstPhase(view.acquisition.repeats), _shape(view), offset)
        self._epoch += 1
        self._bursts.begin()
        return time.update(frame.index, frame.time_s, view.bursts.clock)

    # -- time stamps that are not the time -------------------------------------------------------------------------

    def _about_time(self) -> str | None:
        """What there is to say of the clip's time stamps."""
        if self._stretch is None:
            return _RETIMED
        return _SLOW_MOTION.format(self._stretch) if self._stretch != 1 else None

    def _judge_stamps(self) -> None:
        """Whether the stamps of the first frames are the time; where they are not, those frames are entered anew."""
        link, waiting = self._link, [w for w in self._waiting if w.view is not None]
        assert link is not None
        link.judged = True
        first = waiting[0].view
        assert first is not None
        shown = np.ptp(np.flatnonzero(first.acquisition.profiles.inside.any(axis=(0, 1))))
        rate_hz = first.acquisition.screen.slot_rate_hz
        self._stretch = link.time.time_stamp_stretch(float(shown) / first.bursts.clock.rows_per_slot / rate_hz)
        if self._stretch == link.time.stretch:
            return
        link.time = tracking.LinkTime(link.time.packet_slots, rate_hz, self._stretch or 1.0)
        link.phase = tracking.BurstPhase(first.acquisition.repeats)
        link.judged = True
        self._bursts.begin()
        for each in waiting:
            self._enter_anew(each)

    def _enter_anew(self, waiting: Waiting) -> None:
        view, link = waiting.view, self._link
        assert view is not None
        assert link is not None
        clock = view.bursts.clock
        first_copy = link.time.update(waiting.result.frame, waiting.result.time_s, clock)
        if first_copy is None or self._stretch is None:
            # Frames that stand alone: no copy of one is near any of another.
            first_copy = waiting.result.frame * _FAR_APART
        clock = replace(clock, burst=np.arange(clock.n_copies))
        view.bursts = replace(view.bursts, first_copy=first_copy, clock=clock)
        waiting.numbers = None
        waiting.result = replace(waiting.result, message=self._about_time())
        self._compare(view)

    def _compare(self, view: View) -> None:
        """What the frame says of the phase of the bursts."""
        assert self._link is not None
        clock = view.bursts.clock
        llr = detect.slot_llr(view.bursts.metrics)
        copies = clock.to_copies(llr).transpose(1, 0, 2) * (view.bursts.shown > 0)
        self._link.phase.update(view.bursts.first_copy, np.asarray(copies, np.float64))

    def _settle_bursts(self) -> None:
        """Enter all frames that waited for the phase of the bursts."""
        for waiting in self._waiting:
            if waiting.view is not None and waiting.numbers is None:
                self._detect(waiting)

    def _detect(self, waiting: Waiting) -> None:
        """Add a frame to its bursts, and learn from it; they are detected when somebody asks what they say."""
        numbers, view = self._add(waiting), waiting.view
        if "certain_columns" not in self._options.skip or self._options.stop_when_certain:
            self._bursts.detect_stale(waiting)
        tracked = view is not None and view.flat is not None and self._bursts.open.is_open(int(numbers[-1]))
        if self._scene is not None and view is not None and tracked:
            self._scene.take(view, lambda: self._bursts.lit(waiting))

    def _add(self, waiting: Waiting) -> IntArray:
        """Add a frame to its bursts; returns their numbers."""
        view, link = waiting.view, self._link
        assert view is not None
        assert link is not None
        clock = view.bursts.clock
        bursts = link.phase.burst_of(view.bursts.first_copy + np.arange(clock.n_copies))
        numbers = np.unique(bursts)
        view.bursts = replace(view.bursts, clock=replace(clock, burst=bursts - numbers[0]))
        waiting.numbers = numbers + link.offset
        self._next_number = max(self._next_number, int(waiting.numbers[-1]) + 1)
        self._bursts.add(view, waiting.numbers)
        return waiting.numbers

    # -- a second look at the first frames ---------------------------------------------------------------------------

    def _receive_first_again(self, at_last: bool) -> None:
        """The first frames once more: by then it is known better what is on the screen.

        Where that leaves doubt, more frames are waited for, unless it is `at_last` or results are wanted promptly.
        """
        held = [
            w for w in self._waiting if w.view is not None and w.numbers is not None and self._can_receive_again(w.view)
        ]
        may_wait = self._n_held < SETTINGS.frames_held_long and not at_last and not self._options.prompt
        if len(held) > 1 and not (may_wait and self._doubt(held) > SETTINGS.too_much_doubt):
            for _ in range(SETTINGS.looks_again if len(held) <= SETTINGS.frames_held else 1):
                self._measure_again(held)
                self._detect_again()
        self._hold(SETTINGS.frames_held_long if may_wait and self._doubt(held) > SETTINGS.much_doubt else 0)

    def _doubt(self, held: list[Waiting]) -> float:
        """Share of the well lit packets of some frames that is in doubt."""
        doubtful, whole = np.sum([self._bursts.doubts(waiting) for waiting in held], axis=0) if held else (0, 0)
        return float(doubtful / max(whole, 1))

    def _can_receive_again(self, view: View) -> bool:
        return self._scene is not None and self._scene.can_measure_again(view)

    def _measure_again(self, held: list[Waiting]) -> None:
        """Learn the picture anew from all frames held, and measure those in doubt by what the others say of it."""
        assert self._scene is not None
        self._bursts.detect_stale(*held)
        known = [self._bursts.lit(waiting) for waiting in held]
        doubtful = [len(held) <= SETTINGS.frames_held or self._bursts.doubts(waiting)[0] > 0 for waiting in held]
        numbers = [w.numbers for w in held if w.numbers is not None]
        self._scene.measure_again([w.view for w in held if w.view is not None], known, numbers, doubtful)

    def _detect_again(self) -> None:
        """The bursts of all frames that wait, each once: in the last frame that shows it."""
        self._bursts.begin()
        waiting = [w for w in self._waiting if w.view is not None and w.numbers is not None]
        numbers = [self._add(w) for w in waiting]
        after = [*numbers[1:], numbers[0][:0]]
        ended = [np.setdiff1d(mine, following) for mine, following in zip(numbers, after, strict=True)]
        self._bursts.detect(list(zip(waiting, ended, strict=True)), dark_too=False)
        tracked = [w.view for w in waiting if w.view is not None and w.view.flat is not None]
        if self._scene is not None and tracked:
            self._scene.last = tracked[-1]

    # -- results ---------------------------------------------------------------------------------------------------

    def _ready(self, at_last: bool = False) -> list[FrameResult]:
        """Results of the frames whose bursts all ended, oldest first: of some together, for that takes less time each,
        unless it is `at_last` or results are wanted promptly."""
        n_ended = 0 if self._n_held else self._n_ended()
        if n_ended < (1 if at_last or self._options.prompt else SETTINGS.reports_together):
            return []
        seen = [w for w in islice(self._waiting, n_ended) if w.view is not None]
        self._bursts.detect_stale(*seen)
        done = []
        for _ in range(n_ended):
            first = self._waiting.popleft()
            done.append(self._report(first, self._waiting[0] if self._waiting else None))
        return done

    def _n_ended(self) -> int:
        """How many of the frames that wait, from the oldest on, can be reported."""
        for place, first in enumerate(self._waiting):
            if first.view is not None:
                following = self._waiting[place + 1] if place + 1 < len(self._waiting) else None
                if following is None or first.numbers is None:
                    return place
                if following.view is not None and following.numbers is None:
                    return place
        return len(self._waiting)

    def _report(self, waiting: Waiting, following: Waiting | None) -> FrameResult:
        view, bursts = waiting.view, self._bursts
        if view is None or waiting.numbers is None:
            return waiting.result
        bursts.detect_stale(waiting)
        going_on = waiting.numbers[:0]
        if following is not None and following.numbers is not None:
            going_on = np.intersect1d(waiting.numbers, following.numbers)
        closed = bursts.open.close(np.setdiff1d(waiting.numbers, going_on))
        ended = results.bursts_of(closed, int(waiting.numbers[0]), view)
        columns = results.columns_of(view, ended, bursts.confidence(going_on), self._options.min_confidence)
        columns = assemble.with_certainty(columns, self._certainty, self._options.min_confidence)
        if self._link is not None:
            columns = assemble.drop_headerless_packets(columns, self._link.headerless(closed, len(columns)))
        if self._options.dump_dir is not None:
            found = results.taps(waiting, view, ended)
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


def _readings_of(context: FrameContext, screens: Sequence[ScreenProfile]) -> Iterator[FrameContext]:
    """A frame whose camera was estimated, for every screen and direction of readout that its rows may be of."""
    camera, rate_hz = context.camera, context.screens[0].slot_rate_hz
    for slot_rate_hz in dict.fromkeys(screen.slot_rate_hz for screen in screens):
        scale = rate_hz / slot_rate_hz
        delay_s, exposure_s = scale * camera.line_delay_s, scale * camera.exposure_s
        alike = tuple(screen for screen in screens if screen.slot_rate_hz == slot_rate_hz)
        for reverse in (False, True):
            estimated = {**camera.estimated, "line_delay_s": (delay_s, scale * camera.estimated["line_delay_s"][1])}
            reading = replace(
                camera, line_delay_s=delay_s, exposure_s=exposure_s, reversed=reverse, estimated=estimated
            )
            yield replace(context, camera=reading, screens=alike)


def _shortest_period_s(frames: Sequence[Frame]) -> float | None:
    """The shortest time from one frame to the next, by their time stamps; None where these do not tell."""
    passed = [
        after.time_s - before.time_s
        for before, after in pairwise(frames)
        if not after.nominal_time and after.time_s > before.time_s
    ]
    return min(passed, default=None)


def _located(found: Found | Failure) -> _Located | Failure:
    """Where a search found the screen; a failure where it found no camera."""
    if isinstance(found, Found):
        return _Located(found.outline, found.best.context, found)
    if found.outline is None or found.context is None:
        return found
    return _Located(found.outline, found.context, found)


def _moved_to(located: _Located, corners: FloatArray) -> _Located:
    """The same with the corners elsewhere."""
    if corners is located.context.corners:
        return located
    outline = replace(located.outline, corners=corners)
    return _Located(outline, replace(located.context, corners=corners))


def _doubt_of(reception: Reception) -> float:
    """Share of the columns of a frame that are in doubt."""
    return float(doubtful_columns(reception).size / reception.snr.shape[0])


def _shows_packets(reception: Reception, doubt: float) -> bool:
    """Whether a camera explains a frame: less than a share of the columns is in `doubt` where packets are whole, and
    the slots look like packets where none is."""
    return _doubt_of(reception) < doubt if complete_packets(reception).any() else has_clear_packets(reception)


def _taken_with(frame: Frame) -> tuple[object, ...]:
    """What the camera and the place of the picture hang on."""
    return frame.width, frame.height, frame.pixels.dtype.str, frame.black, frame.white, frame.metadata


def _bursts_of(frame: Frame, reception: Reception) -> tracking.FrameBursts:
    by_copy = replace(reception.clock, burst=np.arange(reception.clock.n_copies))
    shown = np.minimum(assemble.slots_observed(reception.samples, by_copy), 1)
    return tracking.FrameBursts(frame.index, 0, reception.clock, reception.metrics, shown)
