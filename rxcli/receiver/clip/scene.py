"""A screen that is followed from frame to frame, and tracked frames received with the picture known of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from operator import itemgetter

import numpy as np

from rxcli.numerics import TINY
from rxcli.receiver.channel import ObservationModel, known_picture, lit_of, llr_of
from rxcli.receiver.channel.known_picture import PlacedPicture, Update
from rxcli.receiver.clip.follow import Follower, Pose
from rxcli.receiver.clip.measure import Measured, Observed, measured_by, shown_slots
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.clip.timeline import Timeline
from rxcli.receiver.clip.views import JointSlots, View, decides_jointly
from rxcli.receiver.frame.acquisition import Acquisition
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.frame.passes import Reception
from rxcli.receiver.frame.settings import STILL
from rxcli.receiver.light import MIN_VARIANCE, Exposure, NoiseModel, SlotLight
from rxcli.receiver.plane import tracked
from rxcli.receiver.still import detect_jointly, detected, in_bursts, lateness
from rxcli.receiver.sync import tracking
from rxcli.types import Clock, Float32Array, FloatArray, Frame, IntArray


class TrackedScreen:
    """A screen that is followed from frame to frame, and the picture on it.

    Args:
        context: the frame that it begins with.
        acquisition: of that frame.
        reception: of that frame.
        film_log_odds: log-odds that the picture moves on the screen.
        has_changed: whether another picture was shown before.
        named: whether the user gave the corners.
        dark_ends: rows at the top and at the bottom of the outline that may not be on the screen; None: unknown.
    """

    def __init__(
        self,
        context: FrameContext,
        acquisition: Acquisition,
        reception: Reception,
        film_log_odds: float,
        has_changed: bool,
        named: bool,
        dark_ends: tuple[int, int] | None,
    ) -> None:
        model = reception.model
        self._acquisition, self._w_log_prob = acquisition, reception.posteriors.w_log_prob
        self._black_level, self._isi_memory = model.black_level, model.exposure.isi_memory
        unsure_rows = None
        if decides_jointly(acquisition.clock):
            unsure_rows = dark_ends or (round(SETTINGS.end_slots * acquisition.clock.rows_per_slot),) * 2
        self._follower = Follower(context, acquisition.screen, model.tails[0], film_log_odds, named, unsure_rows)
        pixels = self.pose.map.pixels
        #: Of a pixel.
        self._noise = NoiseModel(
            max(acquisition.profiles.noise_floor, MIN_VARIANCE * pixels), acquisition.profiles.noise_slope
        )
        #: The frame that was received last.
        self.last: View | None = None
        self._n_updates = 0
        #: Frames for which the picture is taken to change from one to the next, once it was seen to.
        self._n_changed = SETTINGS.look_every if has_changed else 0
        #: (C,) mean light of the columns in the last frame, and its exposure relative to that of the picture.
        self._level, self._gain = np.maximum(self.strips(context.frame).mean(axis=(1, 2)), TINY), 1.0
        self._picture = self._new_picture()

    @property
    def corners(self) -> FloatArray:
        """(4, 2) where the screen was last."""
        return self._follower.place.likelier.corners

    @property
    def film_log_odds(self) -> float:
        """Log-odds that the picture moves on the screen."""
        return self._follower.place.log_odds

    @property
    def pose(self) -> Pose:
        """Where the strips were read last."""
        return self._follower.pose

    @property
    def _changes(self) -> bool:
        """Whether the picture changes from frame to frame."""
        return self._follower.place.is_film or self._n_changed > 0

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
        last, follower = self.last, self._follower
        if last is None:
            return None
        self._n_changed = max(self._n_changed - 1, 0)
        if follower.rests():
            view = self._view(cache, last, timeline, SETTINGS.rest_misfit)
            if view is not None:
                return view
        with cache.timer("geometry"):
            found = follower.find(cache.frame)
        if found is None:
            return None
        was_film, excess = follower.place.is_film, self._picture.excess.copy()
        view = self._view(cache, last, timeline, SETTINGS.misfit)
        if follower.place.is_film != was_film:  # The picture was taken to be elsewhere on the screen.
            self._picture.excess[:] = excess
            follower.move(cache.frame, found)
            view = self._view(cache, last, timeline, SETTINGS.misfit)
        return view

    def _view(self, cache: FrameCache, last: View, timeline: Timeline, max_misfit: float) -> View | None:
        """Receive a frame with the screen at its current pose."""
        pose, frame, timer, own_clock = self.pose, cache.frame, cache.timer, last.acquisition.clock
        with timer("sampling"):
            light, picture = self._scaled(self.strips(frame)), _placed(self._picture, pose)
            likely = picture.adapted(light, None, own_clock.rows_per_slot) if self._changes else picture
            observed = Observed(pose, light, likely)
        with timer("clock"):
            clock = self._clock(frame, observed, own_clock, timeline.time)
        if clock is None:
            return None
        bursts, joint = timeline.assigned(frame, clock), None
        with timer("detect"):
            if decides_jointly(clock):
                measured, joint = self._measured_jointly(observed, clock, bursts, max_misfit)
            else:
                clock = clock.by_copy if bursts is None else replace(clock, burst=bursts)
                measured = self._measured(observed, clock, None, max_misfit)
            if measured is None:
                return None
            self._measure_place(likely if joint else picture, light, measured.expected)
            clock = measured.clock
            shown = shown_slots(pose.map.inside, known_picture.row_positions(pose.rows, clock), clock)
        view = View(
            replace(last.context, cache=cache, sampled_corners=self.corners),
            replace(last.acquisition, clock=clock),
            clock,
            measured.llr,
            shown,
            measured.snr,
            light=light,
            pose=pose,
            tracked=joint is None,
            changed=self._changes,
            joint=joint,
            words=measured.words,
        )
        if joint is not None:
            self.update(view, lambda: clock.on_grid(joint.posteriors.lit))
        return view

    def _measured_jointly(
        self, observed: Observed, clock: Clock, bursts: IntArray | None, max_misfit: float
    ) -> tuple[Measured | None, JointSlots]:
        """Measure a frame whose rows show several slots: slots and what is not known of the picture, jointly.

        `clock` is the predicted one, and `bursts` are those of its copies once they are known.
        """
        pose, picture, model, weights = observed.pose, observed.picture, self._model(clock), self._w_log_prob
        acquisition = self._acquired(observed.light, pose, picture, clock)
        late = lateness(acquisition, model, weights, SETTINGS.long_step)
        clock = replace(clock, row0=clock.row0 - late * clock.rows_per_slot)
        single = replace(acquisition, clock=clock.by_copy)
        found, snr = detect_jointly(single, model, weights, None)
        lit = single.clock.on_grid(found.lit)
        llr = by_copy_llr(lit)
        clock = in_bursts(acquisition, clock, llr) if bursts is None else replace(clock, burst=bursts)
        found, _ = detect_jointly(replace(acquisition, clock=clock), model, weights, lit)
        self._w_log_prob, lit = found.w_log_prob, clock.on_grid(found.lit)
        joint, positions = JointSlots(clock.burst, found), known_picture.row_positions(pose.rows, clock)
        fit = known_picture.fit_response(observed.columns, lit, positions, clock.exposure_slots)
        n_slots = int(np.ceil(clock.exposure_slots))
        expected = known_picture.expected_light(lit, positions, clock.exposure_slots, n_slots, fit).light
        rows_per_slot, share = clock.rows_per_slot, SETTINGS.frame_share
        if picture.judge(observed.columns, expected, max_misfit, share, rows_per_slot) is None:
            return None, joint
        return Measured(clock, llr, snr, expected), joint

    def _measured(
        self, observed: Observed, clock: Clock, lit: Float32Array | None, max_misfit: float
    ) -> Measured | None:
        """Measure a frame by the known picture or, where pictures change, by what the frame shows of it."""
        adapts = self._changes or observed.changed
        found = measured_by(observed, clock, lit, max_misfit, self._isi_memory, adapts)
        if found is None or not adapts:
            return found
        return replace(found, words=None, llr=self._with_doubtful(observed, found.clock, found.llr))

    def _with_doubtful(self, observed: Observed, clock: Clock, llr: Float32Array) -> Float32Array:
        """Slots, those of doubtful columns detected jointly without a picture as well.

        The picture as the frame shows it and no picture at all err unlike, and share the noise: their mean counts.
        """
        found = detected(llr, clock)
        doubtful = np.flatnonzero(found.log_prob.sum(axis=2).min(axis=0) < SETTINGS.doubtful_log_prob)
        if not doubtful.size:
            return llr
        strips = self._acquired(observed.light, observed.pose, None, clock)
        weights, lit = np.maximum(found.w_log_prob, self._w_log_prob), clock.on_grid(found.lit)
        joint, _ = detect_jointly(strips, self._model(clock), weights, lit, doubtful)
        # The copies of a burst were added up already.
        of_copies = llr_of(joint.lit) / np.bincount(clock.burst)[:, None, None]
        of_each = replace(clock, delay_slots=clock.delay_slots[doubtful]).on_grid(of_copies)
        llr[doubtful] = (of_each + llr_of(lit_of(llr[doubtful]))) / 2
        return llr

    def _measure_place(self, picture: PlacedPicture, light: Float32Array, expected: Float32Array) -> None:
        """Correct the screen's place by the columns' light as `expected` from decided slots (C, R)."""
        measured = picture.displacement(light, expected, self._follower.slope())
        if measured is not None:
            self._follower.measured(*measured)

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
        rows, origin = clock.rows_per_slot / STILL.coarse_samples, self._follower.origin
        exposure = Exposure.of(clock.exposure_slots, STILL.coarse_samples)
        return ObservationModel(
            self._black_level, self._noise.of_mean(origin.map.pixels * rows), origin.crosstalk, exposure
        )

    def _scaled(self, light: Float32Array) -> Float32Array:
        """Light (C, S, R) of the strips at the exposure of the picture; a step of it shows in all columns."""
        level = np.maximum(light.mean(axis=(1, 2)), TINY)
        steps = level / self._level
        if np.abs(steps - 1).min() > SETTINGS.exposure_change:
            self._gain *= float(np.median(steps))
        self._level = level
        return light if self._gain == 1 else light / np.float32(self._gain)

    def _clock(self, frame: Frame, observed: Observed, old: Clock, time: tracking.LinkTime) -> Clock | None:
        """The clock of a frame, near where it is predicted; None if headers do not show: another scene, or a hand."""
        rows = self.pose.rows
        n_slots, top_row = int(np.ceil(rows.size / old.rows_per_slot)) + 1, float(rows[0]) - 0.5

        def with_contrast(later_slots: float) -> tuple[float, Clock | None]:
            clock = time.clock_at(frame.index, frame.time_s, old, n_slots, top_row, later_slots)
            return (0.0, None) if clock is None else (observed.header_contrast(clock), clock)

        contrast, clock = with_contrast(0.0)
        # Of long exposures headers are too faint to place the clock; evidence does, see `lateness`.
        is_known = time.is_measured and decides_jointly(old)
        if contrast < SETTINGS.good_header and not is_known:
            slots = np.arange(-time.sure_slots, time.sure_slots + SETTINGS.clock_step, SETTINGS.clock_step)
            best = max(map(with_contrast, slots.tolist()), key=itemgetter(0))
            if best[0] > contrast + SETTINGS.header_lead:  # A sliver of a header fits nearly as well elsewhere.
                contrast, clock = best
        return clock if contrast >= SETTINGS.min_header or is_known else None

    # -- the picture ---------------------------------------------------------------------------------------------------

    def _new_picture(self) -> known_picture.KnownPicture:
        strips, noise = self._follower.origin.map, self._noise
        return known_picture.KnownPicture(
            strips.inside.shape, self._black_level, noise.of_mean(strips.pixels), self._acquisition.clock.exposure_slots
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
        clock, pose = view.clock, view.pose
        positions = known_picture.row_positions(pose.rows, clock)
        slots, doubt = (SlotLight(p).mean_over(positions, clock.exposure_slots) for p in (lit, lit * (1 - lit)))
        trust = np.maximum(1 - SETTINGS.doubt_weight * doubt, 0)
        frame_row = self._follower.frame_row(pose)
        observation = known_picture.Observation(
            view.light, slots, trust, pose.map.inside, pose.crosstalk, frame_row, pose.shift
        )
        return self._picture.learn(observation, forget=forget)

    def can_measure_again(self, view: View) -> bool:
        """Whether a frame can be measured with this picture: its strips are those of the first frame."""
        return view.light is not None and view.pose is not None and view.pose.home is self._follower.origin.map

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
        view.changed |= self._changes
        observed = Observed(pose, view.light, picture, view.changed)
        if observed.header_contrast(clock) < SETTINGS.min_header:
            return
        measured = self._measured(observed, clock, known, SETTINGS.misfit)
        if measured is not None:
            view.clock, view.snr, view.tracked = measured.clock, measured.snr, True
            view.llr, view.words = measured.llr, measured.words


def _placed(picture: known_picture.KnownPicture, pose: Pose) -> PlacedPicture:
    return picture.placed(pose.map.inside, pose.crosstalk, pose.picture_row, pose.shift)


def by_copy_llr(lit: Float32Array) -> Float32Array:
    """Log-likelihood ratios of slots (C, N) of a long exposure: some are wrong, however sure."""
    return llr_of(0.5 + (1 - 2 * np.float32(SETTINGS.wrong_slots)) * (lit - 0.5))
