"""Wiring of clips: what one frame teaches is used on the next. The stages are those of `rxcli.pipeline`.

The first frame is received like a photograph. From then on outline, clock, picture, light spread and weights are known:
the strips are read where they were (`rxcli.strips`), the picture is taken out (`rxcli.known_picture`), the clock is
foretold and checked against the header (`rxcli.tracking`). Where the check fails, the frame is received like a
photograph again. What frames see of a burst is added up before it is detected; a packet stands in the last frame that
shows its burst, so results come a frame late.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli import assemble, channel, clock, detect, geometry, known_picture, sampling, strips, tracking
from rxcli.clip_start import Start, agree, lock_at, shows_little
from rxcli.dump import dump_stages
from rxcli.locate import Camera, Failure, Lock, Stages, find_camera, find_corners, find_lock, sample_columns
from rxcli.options import ReceiverOptions
from rxcli.protocol import PREAMBLE_SLOTS, WEIGHTS
from rxcli.reception import (
    HOPELESS_WEIGHT,
    Reception,
    decode,
    doubtful_columns,
    of_columns,
    quick_look,
    second_opinion,
)
from rxcli.types import (
    Clock,
    ColumnResult,
    Float32Array,
    FloatArray,
    Frame,
    FrameResult,
    IntArray,
    RowProfiles,
)

#: A burst of a column all of whose symbols have at least this log probability is not decoded again.
_CERTAIN = -1e-4
#: Frames at the start that are looked at once more when the picture is known better; and where many columns that are
#: well lit are still in doubt, for compression has taken much, how many are waited for.
_HELD, _HELD_LONG = 6, 24
#: Squared contrast over variance of a slot that is well lit, log probability of a packet in doubt, and much doubt.
_WELL_LIT_SNR, _DOUBTFUL, _MUCH_DOUBT = 10.0, -0.05, 0.03
#: Squared contrast over variance of a slot, at which all copies of a packet together do not give one.
_DARK_SNR = 0.5
#: Share of columns that a quick look at a first frame may leave in doubt.
_QUICK_DOUBT = 0.5
#: Strips of a column, at most: more tell no more of a picture that is known, and take time.
_STRIPS = 4
#: Frames beyond which each one's share of what is known of the picture does not matter.
_MANY_VIEWS = 12
#: Frames that find their clock together where each shows little.
_TOGETHER = 8
#: Frames that may wait until it is clear which copies begin a burst.
_MAX_WAITING = 8
#: Frames whose corners are averaged at the start; how often they, and dark columns, are looked at from then on.
_FIRST_LOOKS, _LOOK_EVERY = 2, 30
#: Looks whose median is where the corners are.
_LOOKS = 5
#: A screen found anew whose corners are closer than this to where they were, in screen widths, is where it was.
_NEAR = 0.06
#: Movement of a corner that is followed at once, and the one below which nothing is changed, in screen widths.
_JUMP, _STILL = 0.012, 0.0004
#: Frames from which the picture is learned one by one, and how often from then on.
_FIRST_LESSONS, _LESSON_EVERY = 12, 6
#: Frames of which the picture is known so little that strips are compared with what is expected of them.
_FEW_LESSONS = 4
#: Columns decided worse than this many times the foreseen variance do not fit what is known.
_MISFIT = 40.0
#: Slots of lateness that are put right, contrast of headers, against full, below which nothing is known any more, and
#: contrast of a frame below which compression has taken much of it.
_LATE, _LEAST_HEADER, _FADED = 0.03, 0.3, 0.85
#: Share of a frame's noise in what is expected of the next.
_NOISE_SHARE = 0.2
#: Contrast of its headers at which the foretold clock is not doubted.
_GOOD_HEADER = 0.6
#: Every so manieth row tells enough of a column's signal-to-noise ratio.
_SNR_EVERY = 5
#: How much better its headers must show for a clock to be taken instead of the foretold one.
_BETTER = 0.05


def receive_clip(frames: Iterable[Frame], options: ReceiverOptions) -> Iterator[FrameResult]:
    """Receive the frames of a clip; results come a frame or more late. An error of `frames` comes after all results."""
    clip, one_thread = _Clip(options), _one_blas_thread()
    try:
        for frame in frames:
            with one_thread():
                done = clip.take(frame)
            yield from done
    except Exception:
        yield from clip.finish()
        raise
    yield from clip.finish()


def _one_blas_thread() -> Callable[[], AbstractContextManager[object]]:
    """Matrix products on one thread for a while.

    Ours are small: further threads only wait for the next one, busily, and take from the decoder's what they need. So
    they double the time that a clip takes of the processor.
    """
    try:
        from threadpoolctl import ThreadpoolController
    except ImportError:  # nothing but slower without it
        return nullcontext
    controller = ThreadpoolController()
    return lambda: controller.limit(limits=1, user_api="blas")


@dataclass(slots=True, eq=False)
class _View:
    """A frame with a lock."""

    camera: Camera
    lock: Lock
    bursts: tracking.FrameBursts
    memory: int
    height: int
    snr: Float32Array
    #: Columns that the auto-encoder changed.
    denoised: frozenset[int] = frozenset()
    #: (C, S, R) light of the strips as tracking samples them; None where that cannot be done.
    light: Float32Array | None = None
    #: Where the strips were then.
    map: strips.StripMap | None = None
    flat: known_picture.ColumnLight | None = None
    #: Kept only while the frame is held back, of those that came before the screen's place was looked at again.
    frame: Frame | None = None


@dataclass(slots=True, eq=False)
class _Waiting:
    """A frame whose result is held back."""

    result: FrameResult
    view: _View | None = None
    #: (B,) numbers of the frame's bursts, once known.
    numbers: IntArray | None = None


@dataclass(slots=True, eq=False)
class _Place:
    """Where the screen is, and how strips are read there."""

    corners: FloatArray
    map: strips.StripMap
    #: Where it was found at the last looks.
    looks: deque[FloatArray]
    n_frames: int = 0


#: Place, picture, last view, what the picture began with, and how often it was learned.
_Scene = tuple[_Place | None, known_picture.KnownPicture | None, _View | None, tuple[Lock, float] | None, int]


@dataclass(slots=True, eq=False)
class _Link:
    """The link's time, as long as it is not lost."""

    time: tracking.LinkTime
    phase: tracking.BurstPhase
    #: Number of burst 0 of this time in the clip.
    offset: int = 0
    last_time_s: float = 0.0


class _Clip:
    """What is known of a clip so far."""

    def __init__(self, options: ReceiverOptions) -> None:
        self._options = options
        self._waiting: deque[_Waiting] = deque()
        self._bursts = tracking.Bursts()
        self._link: _Link | None = None
        #: The first frames, until they have agreed on a clock; None when that is done, or not needed.
        self._first: list[Frame] | None = [] if "tracking" in options.skip else None
        self._start: Start | None = None
        self._next_number = 0
        #: The camera and the options with the screens that remain, and what they were found for.
        self._camera: tuple[Camera, ReceiverOptions] | None = None
        self._taken_with: tuple[object, ...] = ()
        self._corners: FloatArray | None = None
        #: Number of a frame that is yet to be received, and its corners.
        self._found: tuple[int, FloatArray] | None = None
        self._place: _Place | None = None
        self._picture: known_picture.KnownPicture | None = None
        #: The lock and the light of a dark slot that the picture began with.
        self._model: tuple[Lock, float] | None = None
        self._n_lessons = 0
        #: Frames that are held back at the start, to be looked at once more; 0 from then on.
        self._n_held = _HELD if "tracking" in options.skip else 0
        #: (C, 9) the weight that a column was last certain of, alone; None before any.
        self._weights: NDArray[np.bool_] | None = None
        self._last: _View | None = None
        self._scene_before = self._scene

    # -- one frame ---------------------------------------------------------------------------------------------

    def take(self, frame: Frame) -> list[FrameResult]:
        """Receive the next frame; returns the results that are complete."""
        if self._first is None:
            return self._take(frame)
        if self._first or self._shows_little(frame):
            self._first.append(frame)
            return self._begin() if len(self._first) == _TOGETHER else []
        self._first = None
        return self._take(frame)

    def _shows_little(self, frame: Frame) -> bool:
        """Whether a frame shows so little that it should find its clock with others."""
        try:
            corners = find_corners(frame, self._options)
        except Failure:
            return False
        self._found = frame.index, corners
        return shows_little(frame, corners, self._options)

    def _begin(self) -> list[FrameResult]:
        """The first frames, once they have agreed on a clock."""
        frames, self._first = self._first or [], None
        self._start = agree(frames, self._options) if len(frames) > 1 else None
        return [result for frame in frames for result in self._take(frame)]

    def _take(self, frame: Frame) -> list[FrameResult]:
        stages = Stages()
        waiting = _Waiting(FrameResult(frame.source, frame.index, frame.time_s, "ok"))
        if self._options.stop_when_certain and self._shows_nothing_new(frame):
            waiting.result = replace(waiting.result, message="its bursts are certain from the frames before")
            self._skip(waiting, "certain_frames", 1)
            self._waiting.append(waiting)
            return self._ready()
        try:
            view = self._known(frame, stages)
            if view is not None:
                self._skip(waiting, "tracking", 1)
            else:
                view, waiting.result = self._search(frame, waiting.result, stages)
            waiting.view = view
            waiting.result = replace(waiting.result, **_facts(view), corners=self._corners)
            done = self._enter(waiting, frame, stages)
        except Failure as failure:
            self._forget()
            waiting.result = replace(waiting.result, status=failure.status, message=failure.message)
            self._waiting.append(waiting)
            done = self._finish() if self._n_held else self._ready()
        waiting.result = replace(waiting.result, timing_ms=stages.total())
        return done

    def _shows_nothing_new(self, frame: Frame) -> bool:
        """Whether all bursts that a frame should show are certain already in all columns that are lit."""
        link, last = self._link, self._last
        if link is None or last is None or not link.phase.settled or self._n_held or self._place is None:
            return False
        top, bottom = self._rows[[0, -1]]
        slot, rows_per_slot = link.time.foretell(frame.index, frame.time_s), last.lock.clock.rows_per_slot
        if slot is None:
            return False
        ends = (slot + np.array([top, bottom]) / rows_per_slot) // link.time.packet_slots
        numbers = np.unique(link.phase.burst_of(np.arange(ends[0], ends[1] + 1).astype(np.int64))) + link.offset
        lit = np.median(last.snr, axis=1) >= 1.0
        return bool(lit.any()) and all(self._bursts.settled(int(number), lit) for number in numbers)

    def _skip(self, waiting: _Waiting, name: str, count: int) -> None:
        if count:
            skipped = waiting.result.skipped
            waiting.result = replace(waiting.result, skipped={**skipped, name: skipped.get(name, 0) + count})

    def finish(self) -> list[FrameResult]:
        """The results still held back."""
        done = self._begin() if self._first else []
        return done + self._finish()

    def _finish(self) -> list[FrameResult]:
        if self._n_held:
            self._settle()
            self._look_again(at_last=True)
        done = self._settle()
        done += [self._report(waiting, None) for waiting in self._waiting]
        self._waiting.clear()
        return done

    def _finish_scene_before(self) -> list[FrameResult]:
        """The results of the scene that the last search found to be over, by what was known of it."""
        begun, self._scene = self._scene, self._scene_before
        done = self._finish()
        self._scene = begun
        return done

    @property
    def _scene(self) -> _Scene:
        """What is known of the scene in view."""
        return self._place, self._picture, self._last, self._model, self._n_lessons

    @_scene.setter
    def _scene(self, scene: _Scene) -> None:
        self._place, self._picture, self._last, self._model, self._n_lessons = scene

    def _forget(self) -> None:
        self._place = self._picture = self._last = None

    # -- a frame like a photograph ------------------------------------------------------------------------------

    def _search(self, frame: Frame, result: FrameResult, stages: Stages) -> tuple[_View, FrameResult]:
        """Receive a frame like a photograph; only the camera is taken from the frames before."""
        before = self._place
        self._scene_before = self._scene
        self._forget()
        with stages("geometry"):
            found, self._found = self._found, None
            corners = found[1] if found and found[0] == frame.index else find_corners(frame, self._options)
            if before is not None and np.abs(corners - before.corners).max() < _NEAR * np.ptp(before.corners[:, 0]):
                corners = before.corners
        self._corners = corners
        if self._camera is None or self._taken_with != _taken_with(frame) or "tracking" not in self._options.skip:
            self._camera = find_camera(frame, corners, self._options, stages)
            self._taken_with = _taken_with(frame)
        camera, options = self._camera
        lock = self._foretold(frame, corners, camera, stages) or find_lock(frame, corners, camera, options, stages)
        can_track = self._can_track(frame, camera, lock)
        seen, denoised, report = self._decoded(lock, can_track and self._n_held == _HELD, stages)
        if assemble.all_dark(seen.snr):
            raise Failure("no_signal", "no light of the screen's columns is seen; something may be in front of it")
        view = _View(camera, lock, _bursts_of(frame, seen), seen.model.memory, frame.height, seen.snr, denoised)
        lit = channel.lit_on_grid(seen.posteriors, seen.clock)
        if can_track:
            with stages("sampling"):
                self._start_tracking(frame, corners, camera, lock, seen, before)
                view.light, view.map = self._strips(frame), self._place.map if self._place else None
            self._learn(view, lit)
        self._last = view
        return view, replace(result, denoiser=report)

    def _decoded(
        self, lock: Lock, again: bool, stages: Stages
    ) -> tuple[Reception, frozenset[int], dict[str, Any] | None]:
        """What is received at a lock, columns that the auto-encoder changed, and its report.

        A quick look that leaves little doubt is enough of a frame that is looked at `again` when the picture is known.
        """
        if again and self._options.cae != "always":
            with stages("detect"):
                seen = quick_look(lock)
                if doubtful_columns(seen).size <= _QUICK_DOUBT * seen.snr.shape[0]:
                    return seen, frozenset(), None
        with stages("detect"):
            seen = decode(lock, self._options.skip)
        with stages("denoise"):
            return second_opinion(lock, seen, self._options)

    def _foretold(self, frame: Frame, corners: FloatArray, camera: Camera, stages: Stages) -> Lock | None:
        """The lock by the clock that the first frames agreed on, where a frame cannot find its own."""
        if self._start is None:
            return None
        with stages("sampling"):
            profiles = sample_columns(frame, corners, camera, self._start.screen.columns)
        return lock_at(self._start, frame, profiles, camera)

    def _can_track(self, frame: Frame, camera: Camera, lock: Lock) -> bool:
        """Whether a row of the picture is one instant, in the order of time."""
        return (
            "tracking" in self._options.skip
            and frame.mosaic is None
            and lock.profiles.sensor_row is None
            and not camera.reversed
        )

    def _start_tracking(
        self, frame: Frame, corners: FloatArray, camera: Camera, lock: Lock, seen: Reception, before: _Place | None
    ) -> None:
        """Begin a picture; the strips stay those of the place before, where the screen is still there."""
        n_columns = lock.screen.columns
        there = before is not None and corners is before.corners and before.map.inside.shape[0] == n_columns
        strip_map = before.map if before is not None and there else _map(frame, corners, camera, lock)
        self._place = _Place(corners, strip_map, deque([corners], maxlen=_LOOKS))
        self._model = lock, seen.model.floor
        self._picture = self._new_picture(*self._model)

    def _new_picture(self, lock: Lock, floor: float | Float32Array) -> known_picture.KnownPicture:
        assert self._place is not None
        self._n_lessons = 0
        profiles, strip_map = lock.profiles, self._place.map
        return known_picture.KnownPicture(
            strip_map.inside,
            channel.spread_matrix(strip_map.inside.shape[1], lock.screen.light_spread),
            floor,
            max(profiles.noise_floor / strip_map.pixels, 1e-7),
            profiles.noise_slope / strip_map.pixels,
        )

    # -- a frame whose place and picture are known -------------------------------------------------------------------

    def _known(self, frame: Frame, stages: Stages) -> _View | None:
        """The view of a frame by what is known; None where that does not fit."""
        last, place, picture = self._last, self._place, self._picture
        if last is None or place is None or picture is None or self._link is None:
            return None
        if self._taken_with != _taken_with(frame):
            return None
        with stages("geometry"):
            self._look(frame, last.camera, last.lock)
        with stages("sampling"):
            light = self._strips(frame)
            flat = picture.solve(light)
        with stages("clock"):
            now = self._clock(frame, flat, last)
            if now is None:
                return None
        with stages("detect"):
            refined = self._refined(picture, light, flat, now, last.memory, thorough=self._n_held != _HELD_LONG)
            if refined is None:
                return None
            flat, now, positions, metrics = refined
            shown = _shown(place.map.inside, positions, now)
            snr = _snr(flat, now)
        bursts = tracking.FrameBursts(frame.index, 0, now, metrics, shown, tracked=True)
        return _View(
            last.camera,
            replace(last.lock, clock=now),
            bursts,
            last.memory,
            frame.height,
            snr,
            light=light,
            map=place.map,
            flat=flat,
        )

    def _refined(
        self,
        picture: known_picture.KnownPicture,
        light: Float32Array,
        flat: known_picture.ColumnLight,
        now: Clock,
        memory: int,
        thorough: bool,
    ) -> tuple[known_picture.ColumnLight, Clock, FloatArray, FloatArray] | None:
        """Clock, response and noise put right by a first decision slot by slot; then positions and metrics.

        Not `thorough` is enough of faded frames that will be measured again.
        None where the headers are not where the clock has them: another scene, or something in front of the screen.
        """
        positions, exposure_slots = known_picture.row_positions(self._rows, now), now.exposure_slots
        if known_picture.header_contrast(flat, positions, now) < _LEAST_HEADER:
            return None
        lit = known_picture.first_decision(flat, positions, now)
        slots = known_picture.exposures(lit, positions, exposure_slots)
        fit = known_picture.fit_response(flat, slots)
        if self._n_lessons < _FEW_LESSONS or (thorough and fit.response.centre < _FADED):
            expected = fit.response.expected(lit, positions, exposure_slots)
            flat = picture.solve_again(light, expected, now.rows_per_slot)
            fit = known_picture.fit_response(flat, slots)
        if thorough and fit.response.centre < _FADED:
            flat = known_picture.evened(flat, slots)
            fit = known_picture.fit_response(flat, slots)
        if abs(fit.late) > _LATE:
            now = replace(now, row0=now.row0 - fit.late * now.rows_per_slot)
            positions = known_picture.row_positions(self._rows, now)
            fit = known_picture.fit_response(flat, known_picture.exposures(lit, positions, exposure_slots))
        expected = fit.response.expected(lit, positions, exposure_slots)
        flat, ratio = picture.judge(flat, expected, _NOISE_SHARE)
        if ratio > _MISFIT:
            return None
        metrics = known_picture.pattern_metrics(flat, positions, now, memory, fit.response, expected, lit)
        return flat, now, positions, metrics

    @property
    def _rows(self) -> FloatArray:
        assert self._place is not None
        strip_map = self._place.map
        return strip_map.first_row + np.arange(strip_map.inside.shape[2], dtype=np.float64)

    def _strips(self, frame: Frame) -> Float32Array:
        assert self._place is not None
        return strips.sample_strips(frame, self._place.map)

    def _look(self, frame: Frame, camera: Camera, lock: Lock) -> None:
        """Look where the screen is, now and then."""
        place = self._place
        assert place is not None
        place.n_frames += 1
        if self._options.corners is not None or not (
            place.n_frames < _FIRST_LOOKS or place.n_frames % _LOOK_EVERY == 0
        ):
            return
        from rxcli.find_screen import track_screen

        stored, order = _stored_order(place.corners)
        found = track_screen(frame.pixels, stored, black=frame.black, white=frame.white)
        if found.corners is None:
            return
        seen = found.corners[order]
        width = float(np.linalg.norm(place.corners[1] - place.corners[0]))
        if np.abs(seen - place.corners).max() > _JUMP * width:
            place.looks.clear()
        place.looks.append(seen)
        corners = np.median(place.looks, axis=0)
        if np.abs(corners - place.corners).max() > _STILL * width:
            self._corners = corners
            self._move(frame, camera, lock, corners)

    def _move(self, frame: Frame, camera: Camera, lock: Lock, corners: FloatArray) -> None:
        place, picture = self._place, self._picture
        assert place is not None
        assert picture is not None
        before, before_map = place.corners, place.map
        place.map = _map(frame, corners, camera, lock, before_map.inside.shape[1])
        place.corners = corners
        picture.moved(
            _row_before(self._rows, corners, before, lock.screen.columns) - before_map.first_row, place.map.inside
        )

    def _clock(self, frame: Frame, flat: known_picture.ColumnLight, last: _View) -> Clock | None:
        """The clock of the frame: from its headers where they are about as foretold, else as foretold."""
        assert self._place is not None
        assert self._link is not None
        rows, old, time = self._rows, last.lock.clock, self._link.time
        n_slots = int(np.ceil(rows.size / old.rows_per_slot)) + 1
        foretold = time.clock_at(frame.index, frame.time_s, old, n_slots, float(rows[0]) - 0.5)
        contrast = self._header(flat, foretold) if foretold is not None else 0.0
        if contrast > _GOOD_HEADER:
            return foretold
        profiles = RowProfiles(
            light=flat.shrunk[:, None],
            inside=np.asarray(self._place.map.inside.any(axis=1, keepdims=True)),
            rows=rows.astype(np.int64),
            sensor_row=None,
            count=np.ones((flat.shrunk.shape[0], 1), np.float32),
            noise_floor=1e-4,
            noise_slope=0.0,
        )
        found = clock.find_clock(profiles, old.rows_per_slot, old.exposure_slots, old.packet_slots, 0.03)
        if found is None:
            return foretold
        found = replace(found, delay_slots=old.delay_slots)
        if foretold is not None and _apart(found, foretold) > time.sure_slots:
            return foretold
        return found if self._header(flat, found) > contrast + _BETTER else foretold

    def _header(self, flat: known_picture.ColumnLight, now: Clock) -> float:
        return known_picture.header_contrast(flat, known_picture.row_positions(self._rows, now), now)

    # -- bursts ---------------------------------------------------------------------------------------------------

    def _enter(self, waiting: _Waiting, frame: Frame, stages: Stages) -> list[FrameResult]:
        view = waiting.view
        assert view is not None
        done: list[FrameResult] = []
        first_copy = self._link.time.take(frame.index, frame.time_s, view.bursts.clock) if self._link else None
        if first_copy is None:
            done = self._finish_scene_before() if self._link is not None else []
            self._begin_link(view, frame)
            assert self._link is not None
            first_copy = self._link.time.take(frame.index, frame.time_s, view.bursts.clock)
            assert first_copy is not None
        assert self._link is not None
        self._link.last_time_s = frame.time_s
        view.bursts = replace(view.bursts, first_copy=first_copy)
        self._waiting.append(waiting)
        if self._n_held == _HELD and self._place is not None and self._place.n_frames < _FIRST_LOOKS - 1:
            view.frame = frame
        with stages("detect"):
            if not self._link.phase.settled:
                self._compare(view)
            n_unsettled = sum(w.view is not None and w.numbers is None for w in self._waiting)
            if self._link.phase.settled or n_unsettled > _MAX_WAITING:
                self._settle_bursts()
                if self._n_held and len(self._waiting) >= self._n_held:
                    self._look_again(at_last=False)
        return done + self._ready()

    def _begin_link(self, view: _View, frame: Frame) -> None:
        screen = view.lock.screen
        offset = self._next_number
        if self._link is not None and offset:
            offset += int((frame.time_s - self._link.last_time_s) / (screen.packet_s * screen.repeats))
        time = self._start.time if self._start else tracking.LinkTime(screen.packet_slots, screen.slot_rate_hz)
        self._link = _Link(time, tracking.BurstPhase(screen.repeats), offset)
        self._bursts = tracking.Bursts()

    def _compare(self, view: _View) -> None:
        """What the frame says of the phase of the bursts."""
        assert self._link is not None
        now = view.bursts.clock
        llr = detect.slot_llr(view.bursts.metrics)
        copies = clock.to_copies(llr, now).transpose(1, 0, 2) * (view.bursts.shown > 0)
        self._link.phase.take(view.bursts.first_copy, np.asarray(copies, np.float64))

    def _settle(self) -> list[FrameResult]:
        if self._link is not None:
            self._settle_bursts()
        return self._ready()

    def _settle_bursts(self) -> None:
        """Enter all frames that waited for the phase of the bursts."""
        for waiting in self._waiting:
            if waiting.view is not None and waiting.numbers is None:
                self._detect(waiting)

    def _detect(self, waiting: _Waiting) -> None:
        """Add a frame to its bursts, and learn from it; they are detected when somebody asks what they say."""
        numbers, view = self._add(waiting), waiting.view
        if "certain_columns" not in self._options.skip or self._options.stop_when_certain:
            self._freshen(waiting)
        if view is not None and view.flat is not None and self._bursts.is_open(int(numbers[-1])):
            if self._n_lessons < _FIRST_LESSONS or (self._n_lessons + 1) % _LESSON_EVERY == 0:
                self._learn(view, self._grid(waiting))
            else:
                self._n_lessons += 1
            self._last = view

    def _add(self, waiting: _Waiting) -> IntArray:
        """Add a frame to its bursts; returns their numbers."""
        view, link = waiting.view, self._link
        assert view is not None
        assert link is not None
        now = view.bursts.clock
        copies = view.bursts.first_copy + np.arange(now.n_copies)
        bursts = link.phase.burst_of(copies)
        numbers = np.unique(bursts)
        now = replace(now, burst=bursts - numbers[0])
        view.bursts = replace(view.bursts, clock=now)
        waiting.numbers = numbers + link.offset
        self._next_number = max(self._next_number, int(waiting.numbers[-1]) + 1)
        self._bursts.add(view.bursts, waiting.numbers, channel.by_burst(view.bursts.metrics, now, view.memory))
        return waiting.numbers

    def _freshen(self, *frames: _Waiting) -> None:
        """Detect the bursts of frames that were added to since they were looked at."""
        asked: list[tuple[_Waiting, IntArray]] = []
        stale: set[int] = set()
        for waiting in frames:
            assert waiting.numbers is not None
            numbers = [int(n) for n in waiting.numbers if self._bursts.is_stale(int(n)) and int(n) not in stale]
            stale.update(numbers)
            asked.append((waiting, np.array(numbers, np.int64)))
        self._detect_bursts(asked, dark_too=bool(self._n_held))

    def _detect_bursts(self, asked: list[tuple[_Waiting, IntArray]], dark_too: bool) -> None:
        """Detect bursts of frames as far as they are open, in columns that are neither certain nor, unless they are to
        be tried too, dark."""
        found: list[tuple[IntArray, NDArray[np.bool_]]] = []
        for waiting, numbers in asked:
            assert waiting.view is not None
            still_open = np.array([n for n in numbers if self._bursts.is_open(int(n))], np.int64)
            if still_open.size == 0:
                continue
            certain = self._bursts.certain(still_open)
            if "certain_columns" not in self._options.skip:
                certain[:] = False
            dark = ~certain & (self._dark(waiting.view) & (not dark_too))
            self._skip(waiting, "certain_columns", int(certain.sum()))
            self._skip(waiting, "dark_columns", int(dark.sum()))
            self._bursts.looked_at(still_open)
            if not (certain | dark).all():
                found.append((still_open, ~certain & ~dark))
        if found:
            self._detect_open(found)

    def _dark(self, view: _View) -> NDArray[np.bool_]:
        """(C,) columns of a tracked frame with too little light to try; now and then they are tried all the same."""
        tried = (view.bursts.frame + 1) % _LOOK_EVERY == 0
        if view.flat is None or "dark_columns" not in self._options.skip or tried:
            return np.zeros(view.snr.shape[0], bool)
        return np.asarray(np.median(view.snr, axis=1) < _DARK_SNR)

    def _detect_open(self, found: list[tuple[IntArray, NDArray[np.bool_]]]) -> None:
        """Detect the columns wanted, (B, C), of the open bursts of some frames.

        All at once, for each symbol's turn costs the same; only the weights are settled frame by frame.
        """
        if self._weights is None or self._weights.shape[0] != self._bursts.n_columns:
            self._weights = np.zeros((self._bursts.n_columns, len(WEIGHTS)), bool)
        places = [np.nonzero(wanted) for _, wanted in found]
        metrics = [self._bursts.metrics(numbers) for numbers, _ in found]
        weights = [self._settled_weights(m, wanted) for m, (_, wanted) in zip(metrics, found, strict=True)]
        number = np.concatenate([numbers[burst] for (numbers, _), (burst, _) in zip(found, places, strict=True)])
        column = np.concatenate([c for _, c in places])
        posteriors = detect.detect(
            np.concatenate([m[place] for m, place in zip(metrics, places, strict=True)])[None],
            np.concatenate([w[c] for w, (_, c) in zip(weights, places, strict=True)]),
        )
        certain = posteriors.log_prob[0].min(axis=1) >= _CERTAIN
        for one in np.unique(number):
            mine = np.flatnonzero(number == one)
            self._bursts.note(int(one), column[mine], of_columns(posteriors, mine), certain[mine])
        # Weights of columns that were certain are the only ones tried next, until they are not certain any more.
        self._weights[column] = False
        self._weights[column[certain], posteriors.w[certain] - 1] = True

    def _settled_weights(self, metrics: FloatArray, wanted: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(C, 9) the weight of each column, by all bursts (B, C, ...) of a frame; only of those wanted, (B, C)."""
        assert self._weights is not None
        bursts, columns = np.flatnonzero(wanted.any(axis=1)), np.flatnonzero(wanted.any(axis=0))
        weights = self._weights.copy()
        unknown = columns[~weights[columns].any(axis=1)]
        if unknown.size:
            weights[unknown] = detect.plausible_weights(metrics[bursts][:, unknown], HOPELESS_WEIGHT)
        several = columns[weights[columns].sum(axis=1) > 1]
        if several.size:
            evidence = detect.weight_evidence(metrics[bursts][:, several], weights[several])
            weights[several] = np.arange(len(WEIGHTS)) == evidence.argmax(axis=1)[:, None]
        return weights

    def _learn(
        self, view: _View, lit: Float32Array, keep: float = known_picture.MEMORY
    ) -> tuple[Float32Array, Float32Array] | None:
        """Take a frame into the picture; returns what it showed.

        See `known_picture.KnownPicture.learn` for `keep`, and for what is returned: slots and trust.
        """
        picture = self._picture
        if picture is None or view.light is None or view.light.shape[2] != self._rows.size:
            return None
        self._n_lessons += 1
        now = view.bursts.clock
        positions = known_picture.row_positions(self._rows, now)
        slots = known_picture.exposed(lit, positions, now.exposure_slots)
        trust = known_picture.trusted(lit, positions, now.exposure_slots)
        picture.learn(view.light, slots, trust, keep)
        return slots, trust

    def _look_again(self, at_last: bool) -> None:
        """The first frames once more: by then it is known better where the screen is, and what is on it.

        Where that leaves doubt, more frames are waited for, unless it is `at_last`.
        """
        held = [w for w in self._waiting if w.view is not None and w.numbers is not None]
        held = [w for w in held if w.view is not None and self._can_look_again(w.view)]
        if len(held) > 1:
            self._learn_again(held)
            self._detect_again()
        for waiting in held:
            assert waiting.view is not None
            waiting.view.frame = None
        doubtful, whole = np.sum([self._doubts(waiting) for waiting in held], axis=0) if held else (0, 0)
        wait = self._n_held < _HELD_LONG and not at_last and doubtful > _MUCH_DOUBT * whole
        self._n_held = _HELD_LONG if wait else 0

    def _can_look_again(self, view: _View) -> bool:
        if self._place is None or self._model is None:
            return False
        return view.frame is not None or (view.light is not None and view.map is self._place.map)

    def _learn_again(self, held: list[_Waiting]) -> None:
        """Learn the picture anew from all frames held, and measure those in doubt by what the others say of it."""
        assert self._place is not None
        assert self._model is not None
        self._freshen(*held)
        known = [self._grid(waiting) for waiting in held]
        doubtful = [self._doubts(waiting)[0] > 0 for waiting in held]
        views = [waiting.view for waiting in held if waiting.view is not None]
        for view in views:
            if view.frame is not None and view.map is not self._place.map:
                view.light, view.map = self._strips(view.frame), self._place.map
        lock, floor = self._model
        self._picture = self._new_picture(lock, self._dark_light(views, floor))
        lessons = [self._learn(view, lit, keep=1.0) for view, lit in zip(views, known, strict=True)]
        alone = len(held) <= _MANY_VIEWS
        for view, lesson, needed in zip(views, lessons, doubtful, strict=True):
            if needed:
                self._measure_again(view, lesson if alone else None)

    def _detect_again(self) -> None:
        """The bursts of all frames that wait, each once: in the last frame that shows it."""
        self._bursts = tracking.Bursts()
        waiting = [w for w in self._waiting if w.view is not None and w.numbers is not None]
        numbers = [self._add(w) for w in waiting]
        after = [*numbers[1:], numbers[0][:0]]
        ended = [np.setdiff1d(mine, following) for mine, following in zip(numbers, after, strict=True)]
        self._detect_bursts(list(zip(waiting, ended, strict=True)), dark_too=False)
        tracked = [w.view for w in waiting if w.view is not None and w.view.flat is not None]
        self._last = tracked[-1] if tracked else self._last

    def _dark_light(self, views: list[_View], usual: float) -> Float32Array:
        """(C, S) light of the strips where nothing is lit."""
        assert self._place is not None
        lights = [view.light for view in views if view.light is not None]
        clocks = [view.bursts.clock for view in views if view.light is not None]
        dark = [known_picture.header_dark(known_picture.row_positions(self._rows, now), now) for now in clocks]
        return known_picture.dark_light(lights, dark, self._place.map.inside, usual)

    def _measure_again(self, view: _View, lesson: tuple[Float32Array, Float32Array] | None) -> None:
        """Measure a frame by the picture, less what the frame itself has shown of it where that is given."""
        assert self._picture is not None
        assert view.light is not None
        picture = self._picture if lesson is None else self._picture.without(view.light, *lesson)
        flat = picture.solve(view.light)
        refined = self._refined(picture, view.light, flat, view.bursts.clock, view.memory, thorough=True)
        if refined is not None:
            burst = view.bursts.clock.burst
            view.flat, now, _, metrics = refined
            view.snr = _snr(view.flat, now)
            view.bursts = replace(view.bursts, clock=replace(now, burst=burst), metrics=metrics, tracked=True)

    def _doubts(self, waiting: _Waiting) -> tuple[int, int]:
        """Packets of a frame in columns that are well lit and of which all was seen: those in doubt, and all."""
        assert waiting.view is not None
        assert waiting.numbers is not None
        self._freshen(waiting)
        lit = np.median(waiting.view.snr, axis=1) >= _WELL_LIT_SNR
        doubtful = total = 0
        for number in waiting.numbers:
            known = self._bursts.known(int(number)) if self._bursts.is_open(int(number)) else None
            if known is not None:
                whole = assemble.complete(self._bursts.seen(np.array([number])))[0] & lit
                doubtful += int((known.log_prob[0].sum(axis=1) < _DOUBTFUL)[whole].sum())
                total += int(whole.sum())
        return doubtful, total

    def _grid(self, waiting: _Waiting) -> Float32Array:
        """(C, N) probability that each slot of a frame is lit, by all that is known of its bursts."""
        assert waiting.view is not None
        assert waiting.numbers is not None
        self._freshen(waiting)
        now = waiting.view.bursts.clock
        lit = np.full((waiting.numbers.size, self._bursts.n_columns, now.packet_slots), 0.5, np.float32)
        for place, number in enumerate(waiting.numbers):
            if self._bursts.is_open(int(number)):
                lit[place] = self._bursts.lit(waiting.numbers[place : place + 1])[0]
        return clock.from_copies(lit[now.burst].transpose(1, 0, 2), now)

    # -- results ---------------------------------------------------------------------------------------------------

    def _ready(self) -> list[FrameResult]:
        """Results of the frames whose bursts all ended, oldest first."""
        done: list[FrameResult] = []
        if self._n_held:
            return done
        while self._waiting:
            first = self._waiting[0]
            if first.view is not None:
                if first.numbers is None or len(self._waiting) < 2:
                    break
                if self._waiting[1].view is not None and self._waiting[1].numbers is None:
                    break
            self._waiting.popleft()
            done.append(self._report(first, self._waiting[0] if self._waiting else None))
        return done

    def _report(self, waiting: _Waiting, following: _Waiting | None) -> FrameResult:
        view = waiting.view
        if view is None or waiting.numbers is None:
            return waiting.result
        self._freshen(waiting)
        going_on = waiting.numbers[:0]
        if following is not None and following.numbers is not None:
            going_on = np.intersect1d(waiting.numbers, following.numbers)
        first = waiting.numbers[0]
        ended = [
            assemble.BurstInClip(
                b.number, int(b.number - first), b.posteriors, b.seen, b.frames, _evidence(b), _against(b)
            )
            for b in self._bursts.close(np.setdiff1d(waiting.numbers, going_on))
        ]
        known = [p for p in (self._bursts.known(int(n)) for n in going_on if self._bursts.is_open(int(n))) if p]
        later = np.max([np.exp(p.log_prob.sum(axis=2)).max(axis=0) for p in known], axis=0) if known else None
        sure = np.zeros(view.snr.shape[0], np.float32) if later is None else later.astype(np.float32)
        columns = self._columns(view, ended, sure, view.height)
        if self._options.dump_dir is not None:
            dump_stages(self._options.dump_dir, waiting.result.source, waiting.result.frame, _taps(waiting, ended))
        return replace(waiting.result, columns=columns, status=assemble.clip_status(columns))

    def _columns(
        self, view: _View, ended: list[assemble.BurstInClip], sure: Float32Array, height: int
    ) -> tuple[ColumnResult, ...]:
        columns = assemble.clip_results(view.bursts.clock, ended, sure, view.snr, self._options.min_confidence)
        if view.denoised:
            columns = tuple(replace(c, denoised=c.column in view.denoised) for c in columns)
        return tuple(assemble.in_stored_rows(c, height) for c in columns) if view.camera.reversed else columns


def _taken_with(frame: Frame) -> tuple[object, ...]:
    """What the camera and the place of the picture hang on."""
    return frame.width, frame.height, frame.pixels.dtype.str, frame.black, frame.white, frame.metadata


def _taps(waiting: _Waiting, ended: list[assemble.BurstInClip]) -> dict[str, Any]:
    """What is written of a frame: as of a photograph, but strips as tracking samples them, and bursts that end here."""
    view = waiting.view
    assert view is not None
    taps: dict[str, Any] = {"geometry.corners": waiting.result.corners, "clock": view.bursts.clock}
    if view.light is not None and view.map is not None:
        rows = view.map.first_row + np.arange(view.light.shape[2])
        taps |= {"sampling.light": view.light, "sampling.inside": view.map.inside, "sampling.rows": rows}
    else:
        taps["sampling"] = view.lock.profiles
    taps |= {"channel.metrics": view.bursts.metrics, "bursts.shown": view.bursts.shown}
    taps |= {"bursts.number": waiting.numbers, "bursts.ended": np.array([burst.number for burst in ended], np.int64)}
    return taps | {f"detect.{burst.number}": burst.posteriors for burst in ended}


def _facts(view: _View) -> dict[str, Any]:
    """What a result says of camera and screen."""
    camera = view.camera
    return {
        "camera_profile": camera.profile,
        "line_delay_s": camera.line_delay_s,
        "exposure_s": camera.exposure_s,
        "estimated": camera.estimated,
        "screen_profile": view.lock.screen.name,
    }


def _map(frame: Frame, corners: FloatArray, camera: Camera, lock: Lock, n_strips: int | None = None) -> strips.StripMap:
    """Where the strips lie; as many as before where `n_strips` says so, for a picture known by strips cannot follow."""
    n_columns = lock.screen.columns
    if n_strips is None:
        column_px = float(np.linalg.norm(corners[1] - corners[0])) / n_columns
        n_strips = min(sampling.strips_per_column(column_px), _STRIPS)
    outlines = geometry.column_outlines(corners, n_columns, n_strips, frame.width, frame.height, camera.lens)
    return strips.map_strips(outlines, frame, lambda coded: sampling.tone_to_light(camera.tone, coded))


def _bursts_of(frame: Frame, seen: Reception) -> tracking.FrameBursts:
    by_copy = replace(seen.clock, burst=np.arange(seen.clock.n_copies))
    shown = np.minimum(assemble.slots_seen(seen.samples, by_copy), 1)
    return tracking.FrameBursts(frame.index, 0, seen.clock, seen.metrics, shown)


def _evidence(burst: tracking.ClosedBurst) -> FloatArray:
    """(C, 7) what the confidence of packets is made of, all copies and frames together."""
    support = detect.slot_support(burst.metrics[None], burst.posteriors.lit > 0.5)[:, :, PREAMBLE_SLOTS:]
    evidence: FloatArray = assemble.evidence(burst.posteriors, support, np.zeros(support.shape[1], bool))[0]
    return evidence


def _against(burst: tracking.ClosedBurst) -> Float32Array | None:
    """(C,) log-likelihood against what was decided of the payload slot that says so most; None for photographs."""
    if not burst.tracked:
        return None
    llr = detect.slot_llr(burst.metrics[None])[0, :, PREAMBLE_SLOTS:]
    decided = np.sign(burst.posteriors.lit[0, :, PREAMBLE_SLOTS:] - 0.5)
    return np.asarray(np.maximum(-llr * decided, 0).max(axis=1), np.float32)


def _shown(inside: NDArray[np.bool_], positions: FloatArray, now: Clock) -> IntArray:
    """(n_copies, C, packet) 1 where the middle of a slot is on the screen."""
    on_screen = np.asarray(inside.any(axis=1))
    columns = np.arange(on_screen.shape[0]) % positions.shape[0]
    first = positions[columns, on_screen.argmax(axis=1)][:, None]
    last = positions[columns, on_screen.shape[1] - 1 - on_screen[:, ::-1].argmax(axis=1)][:, None]
    middles = np.arange(now.n_slots) + 0.5
    shown = (middles >= first) & (middles <= last) & np.asarray(on_screen.any(axis=1))[:, None]
    return np.asarray(clock.to_copies(shown.astype(np.float32), now), np.int64).transpose(1, 0, 2)


def _snr(flat: known_picture.ColumnLight, now: Clock) -> Float32Array:
    """(C, N) squared contrast over variance of a slot: the mean of the rows around."""
    mean = np.median(flat.precision[:, ::_SNR_EVERY], axis=1) * np.float32(now.rows_per_slot)
    return np.repeat(mean[:, None], now.n_slots, axis=1).astype(np.float32)


def _apart(first: Clock, second: Clock) -> float:
    """Slots between two clocks, whole packets aside."""
    length = first.packet_slots
    difference = first.first_slot - second.first_slot - (first.row0 - second.row0) / first.rows_per_slot
    return float(abs((difference + length / 2) % length - length / 2))


def _stored_order(corners: FloatArray) -> tuple[FloatArray, IntArray]:
    """Corners clockwise from the one of smallest x + y, and the order that turns such ones back."""
    following = np.roll(corners, -1, axis=0)
    area = float((corners[:, 0] * following[:, 1] - following[:, 0] * corners[:, 1]).sum())
    order = np.arange(4) if area > 0 else np.arange(4)[::-1]
    order = np.roll(order, -int(corners[order].sum(axis=1).argmin()))
    return corners[order], np.argsort(order)


def _row_before(rows: FloatArray, corners: FloatArray, before: FloatArray, n_columns: int) -> FloatArray:
    """(C, R) row that showed, before the screen moved, what `rows` show now; columns as straight lines."""
    across = ((np.arange(n_columns) + 0.5) / n_columns)[:, None]

    def ends(c: FloatArray) -> tuple[FloatArray, FloatArray]:
        return c[0, 1] + across * (c[1, 1] - c[0, 1]), c[3, 1] + across * (c[2, 1] - c[3, 1])

    (top, bottom), (old_top, old_bottom) = ends(corners), ends(before)
    return np.asarray(old_top + (rows - top) * (old_bottom - old_top) / (bottom - top))
