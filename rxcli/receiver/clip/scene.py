"""A screen that is followed from frame to frame, and tracked frames received with the picture known of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np

from rxcli.numerics import TINY
from rxcli.receiver import plane
from rxcli.receiver.channel import ObservationModel, known_picture, llr_of
from rxcli.receiver.channel.known_picture import ColumnLight, PlacedPicture, Update
from rxcli.receiver.clip.place import ScreenPlace
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.clip.timeline import Timeline
from rxcli.receiver.clip.views import JointSlots, Pose, View, decides_jointly
from rxcli.receiver.frame.acquisition import Acquisition
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.frame.settings import STILL
from rxcli.receiver.light import MIN_VARIANCE, Crosstalk, Exposure, NoiseModel, SlotLight
from rxcli.receiver.plane import tracked
from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.registration import Registration, ScreenTexture
from rxcli.receiver.still import (
    decode,
    detect_jointly,
    detected,
    detected_on,
    in_bursts,
    initial_pass,
    lateness,
)
from rxcli.receiver.sync import tracking
from rxcli.types import BoolArray, Clock, Float32Array, FloatArray, Frame, IntArray, Outlines

#: What the photograph of a film's frame need not do: columns that are certain or dark.
_SKIPPED_OF_FILM = frozenset({"certain_columns", "dark_columns"})


class TrackedScreen:
    """A screen that is followed from frame to frame, and the picture on it.

    Args:
        context: the frame that it begins with.
        acquisition: of that frame.
        model: light model of that frame.
        w_log_prob: (C, 9) log probability of the columns' weights in that frame.
        film_log_odds: log-odds that the picture moves on the screen.
        has_changed: whether another picture was shown before.
        named: whether the user gave the corners.
        dark_ends: rows at the top and at the bottom of the outline that may not be on the screen; None: unknown.
    """

    def __init__(
        self,
        context: FrameContext,
        acquisition: Acquisition,
        model: ObservationModel,
        w_log_prob: FloatArray,
        film_log_odds: float,
        has_changed: bool,
        named: bool,
        dark_ends: tuple[int, int] | None,
    ) -> None:
        frame, corners, tone = context.frame, context.sampled_corners, context.camera.tone
        self._lens, self._named, self._acquisition = context.camera.lens, named, acquisition
        self._black_level, self._isi_memory = model.black_level, model.exposure.isi_memory
        column_px = float(np.linalg.norm(corners[1] - corners[0])) / acquisition.screen.columns
        self._n_strips = min(plane.strips_per_column(column_px), SETTINGS.max_strips)
        outlines, self._end_rows = self._outlines(frame, corners), (SETTINGS.end_rows, SETTINGS.end_rows)
        if decides_jointly(acquisition.clock):
            unsure = round(SETTINGS.end_slots * acquisition.clock.rows_per_slot)
            self._end_rows = dark_ends or (unsure, unsure)
            outlines = replace(outlines, inside=_without_ends(outlines.inside, *self._end_rows))
        strips = tracked.map_strips(outlines, frame, lambda coded: plane.tone_to_light(tone, coded))
        noise_floor = max(acquisition.profiles.noise_floor, MIN_VARIANCE * strips.pixels)
        #: Of a pixel.
        self._noise = NoiseModel(noise_floor, acquisition.profiles.noise_slope)
        self._tails, self._w_log_prob = model.tails[0], w_log_prob
        #: Where the screen is, and where the strips are read; the picture is known on the rows where it was first.
        self._place = ScreenPlace.at(corners, acquisition.screen.columns, self._lens, film_log_odds)
        self.pose = self._first_pose = Pose(corners, corners, strips, strips, self._crosstalk_at(0.0))
        #: The frame that was received last.
        self.last: View | None = None
        self._texture = ScreenTexture(frame, corners, self._lens)
        #: Searches in a row that found the screen where it was, and frames since the last one.
        self._n_rested = self._n_unlooked = 0
        self._n_updates = 0
        #: Frames for which the picture is taken to change from one to the next, once it was seen to.
        self._n_changed = SETTINGS.look_every if has_changed else 0
        #: (C,) mean light of the columns in the last frame, and its exposure relative to that of the picture.
        self._level, self._gain = np.maximum(self.strips(frame).mean(axis=(1, 2)), TINY), 1.0
        self._picture = self._new_picture()

    @property
    def corners(self) -> FloatArray:
        """(4, 2) where the screen was last."""
        return self._place.likelier.corners

    @property
    def film_log_odds(self) -> float:
        """Log-odds that the picture moves on the screen."""
        return self._place.log_odds

    @property
    def _changes(self) -> bool:
        """Whether the picture changes from frame to frame."""
        return self._place.is_film or self._n_changed > 0

    @property
    def rows(self) -> FloatArray:
        """(R,) sensor rows that were read last."""
        return self.pose.rows

    def strips(self, frame: Frame) -> Float32Array:
        """(C, S, R) light of the strips in a frame."""
        return tracked.sample_strips(frame, self.pose.map)

    # -- a frame -------------------------------------------------------------------------------------------------------

    def view(self, cache: FrameCache, timeline: Timeline) -> View | None:
        """Receive a frame by what is known; None where that does not fit.

        A screen at rest is searched now and then: if it had moved, the picture would fit worse.

        Args:
            cache: taken with the same camera as those before.
            timeline: the link's time and bursts.
        """
        if self.last is None:
            return None
        self._n_unlooked += 1
        self._n_changed = max(self._n_changed - 1, 0)
        rests = self._n_rested >= SETTINGS.still_looks
        if rests and self._n_unlooked < SETTINGS.look_every:
            view = self._view(cache, self.last, timeline, SETTINGS.rest_misfit)
            if view is not None:
                return view
        with cache.timer("geometry"):
            found = self._follow(cache.frame)
        if found is None:
            return None
        was_film, excess = self._place.is_film, self._picture.excess.copy()
        view = self._view(cache, self.last, timeline, SETTINGS.misfit)
        if self._place.is_film != was_film:  # The picture was taken to be elsewhere on the screen.
            self._picture.excess[:] = excess
            self._move(cache.frame, found)
            view = self._view(cache, self.last, timeline, SETTINGS.misfit)
        return view

    def _view(self, cache: FrameCache, last: View, timeline: Timeline, max_misfit: float) -> View | None:
        """Receive a frame with the screen at its current pose."""
        pose, frame, timer = self.pose, cache.frame, cache.timer
        with timer("sampling"):
            light, picture = self._scaled(self.strips(frame)), _placed(self._picture, pose)
            own_clock = last.acquisition.clock
            likely = picture.adapted(light, None, own_clock.rows_per_slot) if self._changes else picture
            columns = likely.solve(light)
        with timer("clock"):
            clock = self._clock(frame, columns, own_clock, timeline.time)
        if clock is None:
            return None
        context = replace(last.context, cache=cache, sampled_corners=self.corners)
        observed, bursts = _Observed(context, pose, light, likely, columns), timeline.assigned(frame, clock)
        if decides_jointly(clock):
            return self._long_view(cache, observed, likely, clock, bursts, max_misfit)
        with timer("detect"):
            clock = clock.by_copy if bursts is None else replace(clock, burst=bursts)
            measured = self._measured(picture, observed, clock, None, max_misfit)
            if measured is None:
                return None
            clock, llr, snr = measured.clock, measured.llr, measured.snr
            self._measure_place(picture, light, measured.expected)
            shown = _shown(pose.map.inside, known_picture.row_positions(pose.rows, clock), clock)
        return View(
            replace(last.context, cache=cache, sampled_corners=self.corners),
            replace(last.acquisition, clock=clock),
            clock,
            llr,
            shown,
            snr,
            light=light,
            pose=pose,
            tracked=True,
            changed=self._changes,
        )

    def _long_view(
        self,
        cache: FrameCache,
        observed: _Observed,
        picture: PlacedPicture,
        clock: Clock,
        bursts: IntArray | None,
        max_misfit: float,
    ) -> View | None:
        """Receive a frame whose rows show several slots: slots and what is not known of the picture, jointly.

        `clock` is the predicted one, and `bursts` are those of its copies once they are known.
        """
        assert self.last is not None
        pose = self.pose
        with cache.timer("detect"):
            acquisition = self._acquired(observed.light, pose, picture, clock)
            model, weights = self._model(clock), self._w_log_prob
            late = lateness(acquisition, model, weights, SETTINGS.long_step)
            clock = replace(clock, row0=clock.row0 - late * clock.rows_per_slot)
            single = replace(acquisition, clock=clock.by_copy)
            found, snr = detect_jointly(single, model, weights, None)
            lit = single.clock.on_grid(found.lit)
            llr = by_copy_llr(lit)
            clock = in_bursts(acquisition, clock, llr) if bursts is None else replace(clock, burst=bursts)
            found, _ = detect_jointly(replace(acquisition, clock=clock), model, weights, lit)
            if self._changes:  # A picture that is wrong in detail is worse than none.
                free, _ = detect_jointly(self._acquired(observed.light, pose, None, clock), model, weights, lit)
                better = np.flatnonzero(free.log_evidence > found.log_evidence)
                found = found.with_columns(better, free.of_columns(better))
            self._w_log_prob, lit = found.w_log_prob, clock.on_grid(found.lit)
            positions = known_picture.row_positions(pose.rows, clock)
            fit = known_picture.fit_response(observed.columns, lit, positions, clock.exposure_slots)
            n_slots = int(np.ceil(clock.exposure_slots))
            expected = known_picture.expected_light(lit, positions, clock.exposure_slots, n_slots, fit).light
            rows_per_slot, share = clock.rows_per_slot, SETTINGS.frame_share
            if picture.judge(observed.columns, expected, max_misfit, share, rows_per_slot) is None:
                return None
            self._measure_place(picture, observed.light, expected)
            shown = _shown(pose.map.inside, positions, clock)
        view = View(
            replace(self.last.context, cache=cache, sampled_corners=self.corners),
            replace(self.last.acquisition, clock=clock),
            clock,
            llr,
            shown,
            snr,
            light=observed.light,
            pose=pose,
            joint=JointSlots(clock.burst, found),
        )
        self.update(view, lambda: lit)
        return view

    def _measured(
        self, picture: PlacedPicture, observed: _Observed, clock: Clock, lit: Float32Array | None, max_misfit: float
    ) -> _Measured | None:
        """Correct clock, response and noise of a frame by its decided slots `lit` (C, N); then likelihoods.

        Where the picture may have changed, each column counts by the known picture or by what the frame shows of it,
        whichever has more information on the slots. None where the light does not fit the decisions: another scene, or
        something in front of the screen.
        """
        known = None
        if not (self._changes or observed.changed):
            known = self._measured_by(picture, observed, clock, lit, max_misfit)
            # A picture of few frames is not known well.
            may_have_changed = lit is None and self._n_updates >= SETTINGS.first_frames
            if known is None or not may_have_changed or (picture.excess < SETTINGS.changed_misfit).all():
                return known
        shown = observed.picture
        if lit is None and shown is picture:  # Decided slots show more than the mean light of symbols.
            shown = picture.adapted(observed.light, None, clock.rows_per_slot)
        adapted = self._measured_by(shown, observed, clock, lit, max_misfit, adapts=True)
        if adapted is None:
            return known
        found, changed = adapted, np.ones(len(adapted.llr), bool)
        if known is not None:
            changed = (picture.excess >= SETTINGS.changed_misfit) & (adapted.information > known.information)
            found = known.with_columns(changed, adapted)
            if changed.mean() > 0.5:
                self._n_changed = SETTINGS.look_every
        return replace(found, llr=self._with_doubtful(observed, found.clock, found.llr, changed))

    def _measured_by(
        self,
        picture: PlacedPicture,
        observed: _Observed,
        clock: Clock,
        lit: Float32Array | None,
        max_misfit: float,
        *,
        adapts: bool = False,
    ) -> _Measured | None:
        """The same by one picture, which is adapted to the frame by its decided slots if it `adapts`."""
        rows, light, isi_memory = observed.pose.rows, observed.light, self._isi_memory
        positions = known_picture.row_positions(rows, clock)
        columns = observed.columns if picture is observed.picture else picture.solve(light)
        if lit is None:
            lit = known_picture.first_decision(columns, positions, clock)
        fit = known_picture.fit_response(columns, lit, positions, clock.exposure_slots)
        if adapts or fit.centre < SETTINGS.faded:
            expected = known_picture.expected_light(lit, positions, clock.exposure_slots, isi_memory, fit)
            if adapts:
                picture = picture.adapted(light, expected.light, clock.rows_per_slot)
            columns = picture.solve_again(light, expected.light, clock.rows_per_slot)
            if adapts:
                lit = known_picture.first_decision(columns, positions, clock)
            fit = known_picture.fit_response(columns, lit, positions, clock.exposure_slots)
        if abs(fit.late) > SETTINGS.late_slots:
            clock = replace(clock, row0=clock.row0 - fit.late * clock.rows_per_slot)
            positions = known_picture.row_positions(rows, clock)
            fit = known_picture.fit_response(columns, lit, positions, clock.exposure_slots)
        expected = known_picture.expected_light(lit, positions, clock.exposure_slots, isi_memory, fit)
        judged = picture.judge(columns, expected.light, max_misfit, SETTINGS.frame_share, clock.rows_per_slot)
        if judged is None:
            return None
        found = known_picture.slot_likelihoods(judged, expected, clock, isi_memory)
        return _Measured(clock, found.llr, found.snr, expected.light, judged.precision.sum(axis=1))

    def _with_doubtful(self, observed: _Observed, clock: Clock, llr: Float32Array, changed: BoolArray) -> Float32Array:
        """Slots, those of doubtful `changed` (C,) columns by two joint detections without a picture.

        One sees the strips that were read, one those of a photograph. They err unlike, and share the noise: their mean
        counts.
        """
        found = detected(llr, clock)
        doubts = found.log_prob.sum(axis=2).min(axis=0) < SETTINGS.doubtful_log_prob
        doubtful = np.flatnonzero(doubts & changed)
        if not doubtful.size:
            return llr
        strips = self._acquired(observed.light, observed.pose, None, clock)
        weights = np.maximum(found.w_log_prob, self._w_log_prob)
        joint, _ = detect_jointly(strips, self._model(clock), weights, clock.on_grid(found.lit), doubtful)
        profiles = observed.context.sample_columns(self._acquisition.screen.columns)
        acquisition = replace(strips, profiles=profiles)
        initial = initial_pass(acquisition)
        initial = detected_on(initial, replace(initial.clock, burst=clock.burst))
        photograph = decode(acquisition, _SKIPPED_OF_FILM, initial).posteriors.of_columns(doubtful)
        of_each = replace(clock, delay_slots=clock.delay_slots[doubtful])
        # The copies of a burst were added up already.
        mean = (llr_of(joint.lit) + llr_of(photograph.lit)) / 2 / np.bincount(clock.burst)[:, None, None]
        llr[doubtful] = of_each.on_grid(mean)
        return llr

    def _measure_place(self, picture: PlacedPicture, light: Float32Array, expected: Float32Array) -> None:
        """Correct the screen's place by the columns' light as `expected` from decided slots (C, R)."""
        step, offset = 1 / 16 / self._n_strips, self.pose.offset
        near, far = (self._crosstalk_at(offset + each).shares for each in (-step, step))
        slope = ((far - near) / (2 * step)).astype(np.float32)
        measured = picture.displacement(light, expected, slope)
        if measured is not None:
            off, covariance = measured
            self._place = self._place.measured(self.pose.read, offset + off, covariance)

    def _acquired(self, light: Float32Array, pose: Pose, picture: PlacedPicture | None, clock: Clock) -> Acquisition:
        """Light of the strips with the picture as far as it is known, on a clock."""
        profiles = replace(
            self._acquisition.profiles,
            light=light,
            inside=pose.map.inside,
            rows=pose.rows.astype(np.int64),
            count=np.full(light.shape[:2], pose.map.pixels, np.float32),
            level=None if picture is None else picture.picture * np.float32(0.5),
        )
        return replace(self._acquisition, profiles=profiles, clock=clock)

    def _model(self, clock: Clock) -> ObservationModel:
        """The light model of samples of a long exposure."""
        rows = clock.rows_per_slot / STILL.coarse_samples
        noise = self._noise.of_mean(self._first_pose.map.pixels * rows)
        exposure = Exposure.of(clock.exposure_slots, STILL.coarse_samples)
        return ObservationModel(self._black_level, noise, self._first_pose.crosstalk, exposure)

    def _scaled(self, light: Float32Array) -> Float32Array:
        """Light (C, S, R) of the strips at the exposure of the picture; a step of it shows in all columns."""
        level = np.maximum(light.mean(axis=(1, 2)), TINY)
        steps = level / self._level
        if np.abs(steps - 1).min() > SETTINGS.exposure_change:
            self._gain *= float(np.median(steps))
        self._level = level
        return light if self._gain == 1 else light / np.float32(self._gain)

    def _clock(self, frame: Frame, columns: ColumnLight, old: Clock, time: tracking.LinkTime) -> Clock | None:
        """The clock of a frame, near where it is predicted; None if headers do not show: another scene, or a hand."""
        n_slots, top_row = int(np.ceil(self.rows.size / old.rows_per_slot)) + 1, float(self.rows[0]) - 0.5

        def with_contrast(later_slots: float) -> tuple[float, Clock | None]:
            clock = time.clock_at(frame.index, frame.time_s, old, n_slots, top_row, later_slots)
            return (0.0, None) if clock is None else (_header_contrast(columns, self.rows, clock), clock)

        contrast, clock = with_contrast(0.0)
        # Of long exposures headers are too faint to place the clock; evidence does, see `lateness`.
        is_known = time.is_measured and decides_jointly(old)
        if contrast < SETTINGS.good_header and not is_known:
            slots = np.arange(-time.sure_slots, time.sure_slots + SETTINGS.clock_step, SETTINGS.clock_step)
            best = max(map(with_contrast, slots.tolist()), key=itemgetter(0))
            if best[0] > contrast + SETTINGS.header_lead:  # A sliver of a header fits nearly as well elsewhere.
                contrast, clock = best
        return clock if contrast >= SETTINGS.min_header or is_known else None

    # -- where the screen is -------------------------------------------------------------------------------------------

    def _follow(self, frame: Frame) -> Registration | None:
        """Find where the screen is in a frame, by the picture on it; None if it shows another picture."""
        self._n_unlooked = 0
        found = self._texture.find(frame)
        if not found.fits and (self._place.is_film or (found.is_precise and not self._named)):
            return None
        if (self._named and not found.is_precise) or _is_still(found.corners - self.pose.picture, found.sd_px):
            found = replace(found, corners=self.pose.picture)
            self._n_rested += 1
        else:
            self._place = self._place.after(self.pose.picture, found.corners, frame)
            self._move(frame, found)
            self._n_rested = 0
        self._texture.learn(frame, found)
        return found

    def _move(self, frame: Frame, found: Registration) -> None:
        """Move the strips to the screen, near whole strips of the picture on it."""
        home, at = self._first_pose.map, self._place.likelier
        n_columns, n_strips = self._acquisition.screen.columns, self._n_strips
        moved = float(self._place.off(found.corners, at).mean())
        shift = round(moved * n_strips)
        offset = moved - shift / n_strips
        read = geometry.beside(at.corners, offset / n_columns, self._lens)
        outlines = self._outlines(frame, read)
        strips = tracked.moved_map(home, replace(outlines, inside=_without_ends(outlines.inside, *self._end_rows)))
        picture_row = geometry.rows_elsewhere(
            strips.rows, self._middles(found.corners, shift), self._middles(self._first_pose.picture, shift)
        )
        row = picture_row - np.float32(home.first_row)
        self.pose = Pose(read, found.corners, strips, home, self._crosstalk_at(offset), row, offset, shift)

    def _outlines(self, frame: Frame, corners: FloatArray) -> Outlines:
        n_columns = self._acquisition.screen.columns
        return geometry.column_outlines(corners, n_columns, self._n_strips, frame.width, frame.height, self._lens)

    def _middles(self, corners: FloatArray, shift: int) -> FloatArray:
        """Rows down the middles of the columns that a picture at `corners` has under it, moved by some strips."""
        n_columns = self._acquisition.screen.columns
        under = geometry.beside(corners, -shift / (n_columns * self._n_strips), self._lens)
        return geometry.column_middles(under, n_columns, self._lens)

    def _crosstalk_at(self, offset: float) -> Crosstalk:
        """Crosstalk of strips that lie `offset` columns to the right of their places."""
        return Crosstalk.of(self._n_strips, self._acquisition.screen.light_spread, self._tails, offset)

    # -- the picture ---------------------------------------------------------------------------------------------------

    def _new_picture(self) -> known_picture.KnownPicture:
        strips = self._first_pose.map
        return known_picture.KnownPicture(
            strips.inside.shape,
            self._black_level,
            self._noise.of_mean(strips.pixels),
            self._acquisition.clock.exposure_slots,
        )

    def update(self, view: View, lit: Callable[[], Float32Array]) -> None:
        """Set the frame that was received last; learn from the first frames, some later ones, and all of a film.

        Args:
            view: the frame.
            lit: gives the probability (C, N) that each of its slots is lit.
        """
        is_due = self._n_updates < SETTINGS.first_updates or (self._n_updates + 1) % SETTINGS.first_updates == 0
        if is_due or self._changes:
            self.learn(view, lit())
        else:
            self._n_updates += 1
        self.last = view

    def learn(self, view: View, lit: Float32Array, *, forget: bool = True) -> Update | None:
        """Take a frame into the picture; returns the update of the picture.

        See `known_picture.KnownPicture.learn` for `forget`.
        """
        if view.light is None or view.pose is None:
            return None
        self._n_updates += 1
        clock, pose, frame_row = view.clock, view.pose, None
        positions = known_picture.row_positions(pose.rows, clock)
        slots, doubt = (SlotLight(p).mean_over(positions, clock.exposure_slots) for p in (lit, lit * (1 - lit)))
        trust = np.maximum(1 - SETTINGS.doubt_weight * doubt, 0)
        if pose.picture_row is not None:
            frame_row = geometry.rows_elsewhere(
                self._first_pose.rows,
                self._middles(self._first_pose.picture, pose.shift),
                self._middles(pose.picture, pose.shift),
            ) - np.float32(pose.map.first_row)
        observation = known_picture.Observation(
            view.light, slots, trust, pose.map.inside, pose.crosstalk, frame_row, pose.shift
        )
        return self._picture.learn(observation, forget=forget)

    def can_measure_again(self, view: View) -> bool:
        """Whether a frame can be measured with this picture: its strips are those of the first frame."""
        return view.light is not None and view.pose is not None and view.pose.home is self._first_pose.map

    def measure_again(self, views: Sequence[View], known: Sequence[Float32Array], doubtful: Sequence[bool]) -> None:
        """Learn the picture anew from frames, and measure doubtful ones with the picture of the others.

        Args:
            views: the frames.
            known: (C, N) of each, probability that each slot is lit.
            doubtful: of each, whether it is to be measured.
        """
        self._n_updates = 0
        self._picture = self._new_picture()
        updates = [self.learn(view, lit, forget=False) for view, lit in zip(views, known, strict=True)]
        for view, update, lit, needed in zip(views, updates, known, doubtful, strict=True):
            if needed and update is not None:
                self._measure_again(view, update, lit)

    def _measure_again(self, view: View, own: Update, known: Float32Array) -> None:
        """Measure a frame by the picture, less what the frame itself has shown of it."""
        assert view.light is not None
        assert view.pose is not None
        pose, clock = view.pose, view.clock
        picture = _placed(self._picture.without(own), pose)
        if view.joint is not None:
            acquisition = self._acquired(view.light, pose, picture, clock)
            known_better, _ = detect_jointly(acquisition, self._model(clock), view.joint.posteriors.w_log_prob, known)
            view.joint = JointSlots(clock.burst, known_better)
            return
        columns = picture.solve(view.light)
        if _header_contrast(columns, pose.rows, clock) < SETTINGS.min_header:
            return
        view.changed |= self._changes
        observed = _Observed(view.context, pose, view.light, picture, columns, view.changed)
        measured = self._measured(picture, observed, clock, known, SETTINGS.misfit)
        if measured is not None:
            view.clock, view.snr, view.llr, view.tracked = measured.clock, measured.snr, measured.llr, True


@dataclass(frozen=True, slots=True)
class _Observed:
    """Light of a frame."""

    #: The frame, and where it was read; (C, S, R) light of the strips there.
    context: FrameContext
    pose: Pose
    light: Float32Array
    #: The picture as far as it is known before any slot is decided, and the columns' own light by it.
    picture: PlacedPicture
    columns: ColumnLight
    #: Whether the picture was found to have changed.
    changed: bool = False


@dataclass(frozen=True, slots=True)
class _Measured:
    """Slots by the light of a frame."""

    clock: Clock
    #: (C, N) log-likelihood ratio of every slot, and (C, 1) squared contrast over variance of a slot.
    llr: Float32Array
    snr: Float32Array
    #: (C, R) light of the columns by the decided slots; and (C,) information on the slots: its precision.
    expected: Float32Array
    information: Float32Array

    def with_columns(self, which: BoolArray, given: _Measured) -> _Measured:
        """The same with some columns as `given`."""
        fields = {
            name: np.where(
                which[(slice(None), *[None] * (getattr(self, name).ndim - 1))],
                getattr(given, name),
                getattr(self, name),
            )
            for name in ("llr", "snr", "expected", "information")
        }
        return replace(self, **fields)


def _placed(picture: known_picture.KnownPicture, pose: Pose) -> PlacedPicture:
    return picture.placed(pose.map.inside, pose.crosstalk, pose.picture_row, pose.shift)


def by_copy_llr(lit: Float32Array) -> Float32Array:
    """Log-likelihood ratios of slots (C, N) of a long exposure: some are wrong, however sure."""
    return llr_of(0.5 + (1 - 2 * np.float32(SETTINGS.wrong_slots)) * (lit - 0.5))


def _header_contrast(columns: ColumnLight, rows: FloatArray, clock: Clock) -> float:
    return known_picture.header_contrast(columns, known_picture.row_positions(rows, clock), clock)


def _without_ends(inside: BoolArray, top: int, bottom: int) -> BoolArray:
    """(C, S, R) strips on the screen, without some rows at its ends, where the corners' error may reach."""
    left = np.zeros_like(inside)
    left[..., top:-bottom] = inside[..., top + bottom :] & inside[..., : -top - bottom]
    return left


def _shown(inside: BoolArray, positions: FloatArray, clock: Clock) -> IntArray:
    """(n_copies, C, packet) 1 where the middle of a slot is on the screen."""
    on_screen = np.asarray(inside.any(axis=1))
    columns = np.arange(on_screen.shape[0]) % positions.shape[0]
    start = positions[columns, on_screen.argmax(axis=1)][:, None]
    end = positions[columns, on_screen.shape[1] - 1 - on_screen[:, ::-1].argmax(axis=1)][:, None]
    middles = np.arange(clock.n_slots) + 0.5
    shown = (middles >= start) & (middles <= end) & np.asarray(on_screen.any(axis=1))[:, None]
    return np.asarray(clock.to_copies(shown.astype(np.float32)), np.int64).transpose(1, 0, 2)


def _is_still(moved: FloatArray, sd_px: float) -> bool:
    """Whether corners (4, 2) that seem to have moved may be where they were."""
    shift, each = np.abs(moved.mean(axis=0)).max(), float(np.sqrt(np.square(moved).mean()))
    return bool(
        shift < max(SETTINGS.still_px, SETTINGS.still_sds * sd_px / 2)
        and each < max(SETTINGS.still_px, SETTINGS.still_sds * sd_px)
    )
