"""What frames of a clip have taught of the scene in view: where the screen is, and the picture on it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rxcli.profiles import ScreenProfile
from rxcli.receiver import plane
from rxcli.receiver.acquisition import Acquisition
from rxcli.receiver.channel import SlotLikelihoods, known_picture
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.clip.views import Pose, View
from rxcli.receiver.context import Camera, FrameContext, Timer
from rxcli.receiver.light import Crosstalk, NoiseModel, SlotLight
from rxcli.receiver.plane import tracked
from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.registration import Registration, ScreenTexture
from rxcli.receiver.sync import clock as sync
from rxcli.receiver.sync import tracking
from rxcli.types import BoolArray, Clock, Float32Array, FloatArray, Frame, IntArray, RowProfiles


class TrackedScreen:
    """A screen that is followed from frame to frame, and the picture on it.

    Args:
        context: the frame that it begins with.
        acquisition: of that frame.
        black_level: light of a dark slot there.
        named: whether the user gave the corners.
    """

    def __init__(self, context: FrameContext, acquisition: Acquisition, black_level: float, named: bool) -> None:
        frame, lens = context.frame, context.camera.lens
        #: Where the screen is; the picture is known on the rows where it was first.
        self.pose = Pose(context.corners, _map(frame, context.corners, context.camera, acquisition))
        self._first_pose = pose = self.pose
        #: The frame that was received last.
        self.last: View | None = None
        self._lens, self._named = lens, named
        self._first_middles = geometry.column_middles(pose.corners, pose.map.inside.shape[0], lens)
        self._texture = ScreenTexture(frame, pose.corners, lens)
        #: Frames whose picture did not locate the screen, and consecutive outlines equal to the first of them.
        self._n_imprecise = self._n_still = 0
        #: Looks in a row that found it where it was, and frames since the last one.
        self._n_rested = self._n_unlooked = 0
        self._still_outline: FloatArray | None = None
        self._begun_with = acquisition, black_level
        self._n_updates = 0
        #: Exposure of the last frame relative to that of the picture.
        self._gain = 1.0
        self._picture = self._new_picture(black_level)

    def _new_picture(self, black_level: float | Float32Array) -> known_picture.KnownPicture:
        acquisition, strips = self._begun_with[0], self._first_pose.map
        profiles = acquisition.profiles
        return known_picture.KnownPicture(
            strips.inside,
            Crosstalk.of(strips.inside.shape[1], acquisition.screen.light_spread),
            black_level,
            NoiseModel(max(profiles.noise_floor, SETTINGS.min_variance * strips.pixels), profiles.noise_slope).of_mean(
                strips.pixels
            ),
        )

    @property
    def corners(self) -> FloatArray:
        """(4, 2) where the screen was last."""
        return self.pose.corners

    @property
    def rows(self) -> FloatArray:
        """(R,) sensor rows that were read last."""
        return self.pose.rows

    def strips(self, frame: Frame) -> Float32Array:
        """(C, S, R) light of the strips in a frame."""
        return tracked.sample_strips(frame, self.pose.map)

    # -- where the screen is -----------------------------------------------------------------------------------

    def _follow(self, frame: Frame) -> bool:
        """Find where the screen is in a frame, by the picture on it; returns whether that is certain."""
        self._n_unlooked = 0
        found = self._texture.find(frame)
        confirmed = found.fits
        if not found.is_precise:
            possible = _is_possible(self.corners - found.corners, found.covariance)
            outline = self._outline_near(frame, surprised=not possible)
            confirmed = confirmed or outline is not None or self._named
            found = self._by_outline(found, outline)
        if not confirmed:
            return False
        if (found.is_precise or self._rests) and _is_still(found.corners - self.corners, found.sd_px):
            found = replace(found, corners=self.corners)
            self._n_rested += 1
        else:
            self._move(frame, found)
            self._n_rested = 0
        self._texture.learn(frame, found)
        return True

    def _by_outline(self, found: Registration, outline: FloatArray | None) -> Registration:
        """Position of a screen with too little texture: at rest, unless its outline indicates a motion."""
        at_rest = self._texture.with_outline(found, self.corners, SETTINGS.rest_sd)
        if self._rests or _is_possible(self.corners - found.corners, found.covariance):
            at_rest = replace(at_rest, corners=self.corners)
        if self._rests:
            return at_rest
        # It may have moved since the last look as far as the outline errs.
        corners = at_rest.corners
        if outline is not None:
            far = np.abs(outline - corners).max() > SETTINGS.same_outline * self._width
            corners = outline if far else (corners + outline) / 2
        return replace(at_rest, corners=corners, covariance=np.eye(8) * (SETTINGS.moving_sd * self._width) ** 2)

    @property
    def _rests(self) -> bool:
        """Whether a screen that its picture does not locate is taken to rest."""
        return self._named or self._n_still >= SETTINGS.still_looks

    def _outline_near(self, frame: Frame, surprised: bool) -> FloatArray | None:
        """Corners (4, 2) by the outline, for a screen that its picture does not locate, or None.

        It is looked for in every other frame, and less often as long as it stays where it is and nothing is a surprise.
        """
        self._n_imprecise += 1
        if self._n_imprecise % (SETTINGS.look_every if self._n_still >= SETTINGS.still_looks and not surprised else 2):
            return None
        outline = followed_outline(frame, self.corners, self._begun_with[0].screen)
        if outline is None:
            return None
        if np.abs(outline - self.corners).max() > 2 * SETTINGS.outline_reach * self._width:
            return None
        before = self._still_outline
        if before is None or np.abs(outline - before).max() > SETTINGS.same_outline * self._width:
            self._n_still, self._still_outline = 0, outline
        self._n_still += 1
        return outline

    @property
    def _width(self) -> float:
        return float(np.ptp(self.corners[:, 0]))

    def _move(self, frame: Frame, found: Registration) -> None:
        n_columns, n_strips, _ = self._first_pose.map.inside.shape
        corners = found.corners
        outlines = geometry.column_outlines(corners, n_columns, n_strips, frame.width, frame.height, self._lens)
        middles = geometry.column_middles(corners, n_columns, self._lens)
        sd = float(np.sqrt(np.diag(found.covariance)[1::2].max()))
        outlines = replace(outlines, inside=_less_ends(outlines.inside, SETTINGS.min_end_rows + sd))
        strips = tracked.moved_map(self._first_pose.map, outlines)
        picture_row = geometry.rows_elsewhere(strips.rows, middles, self._first_middles)
        picture_row -= np.float32(self._first_pose.map.first_row)
        placement = known_picture.Placement(picture_row, strips.inside)
        self.pose = Pose(corners, strips, placement, self._first_pose.map, middles)

    # -- a frame ------------------------------------------------------------------------------------------------

    def view(self, frame: Frame, time: tracking.LinkTime, timer: Timer) -> View | None:
        """A frame by what is known; None where that does not fit.

        A screen that rests is looked for now and then: had it moved, the picture would not fit as it did.

        Args:
            frame: taken with the same camera as those before.
            time: the link's time.
            timer: time is counted there.
        """
        if self.last is None:
            return None
        self._n_unlooked += 1
        rests = self._n_rested >= SETTINGS.still_looks and self._n_updates >= SETTINGS.first_updates
        if rests and self._n_unlooked < SETTINGS.look_every:
            view = self._view(frame, self.last, time, SETTINGS.rest_misfit, timer)
            if view is not None:
                return view
        with timer("geometry"):
            if not self._follow(frame):
                return None
        return self._view(frame, self.last, time, SETTINGS.misfit, timer)

    def _view(self, frame: Frame, last: View, time: tracking.LinkTime, max_misfit: float, timer: Timer) -> View | None:
        """A frame, the screen being where it is thought to be."""
        with timer("sampling"):
            light, pose = self.strips(frame), self.pose
            picture = self._picture.placed(pose.placement)
            gain = picture.gain(light)
            if abs(gain / self._gain - 1) > SETTINGS.exposure_change:
                self._gain = gain
            light /= np.float32(self._gain)
            flat = picture.solve(light)
        with timer("clock"):
            clock = self._clock(frame, flat, last.acquisition.clock, time)
            if clock is None:
                return None
        with timer("detect"):
            refined = self._refined(picture, pose.rows, light, flat, clock, last.isi_memory, max_misfit)
            if refined is None:
                return None
            flat, clock, positions, likelihoods = refined
            shown = _shown(pose.map.inside, positions, clock)
        return View(
            replace(last.context, frame=frame, corners=self.corners, timer=timer),
            replace(last.acquisition, clock=clock),
            tracking.FrameBursts(frame.index, 0, clock, likelihoods.metrics, shown, tracked=True),
            last.isi_memory,
            frame.height,
            likelihoods.snr,
            light=light,
            pose=pose,
            flat=flat,
        )

    def _refined(
        self,
        picture: known_picture.KnownPicture,
        rows: FloatArray,
        light: Float32Array,
        flat: known_picture.ColumnLight,
        clock: Clock,
        isi_memory: int,
        max_misfit: float,
        known: Float32Array | None = None,
    ) -> tuple[known_picture.ColumnLight, Clock, FloatArray, SlotLikelihoods] | None:
        """Clock, response and noise put right by a first decision slot by slot; then positions and likelihoods.

        None where the light does not fit what was decided: another scene, or something in front of the screen.
        """
        positions, exposure_slots = known_picture.row_positions(rows, clock), clock.exposure_slots
        lit = known_picture.first_decision(flat, positions, clock) if known is None else known
        slots = known_picture.exposures(lit, positions, exposure_slots)
        fit = known_picture.fit_response(flat, slots)
        if fit.response.centre < SETTINGS.faded:
            expected = known_picture.expected_light(lit, positions, exposure_slots, isi_memory, fit.response)
            flat = picture.solve_again(light, expected.light, clock.rows_per_slot)
            fit = known_picture.fit_response(flat, slots)
        if abs(fit.late) > SETTINGS.late_slots:
            clock = replace(clock, row0=clock.row0 - fit.late * clock.rows_per_slot)
            positions = known_picture.row_positions(rows, clock)
            fit = known_picture.fit_response(flat, known_picture.exposures(lit, positions, exposure_slots))
        expected = known_picture.expected_light(lit, positions, exposure_slots, isi_memory, fit.response)
        judged = picture.judge(flat, expected.light, max_misfit, SETTINGS.frame_share, clock.rows_per_slot)
        if judged is None:
            return None
        return judged, clock, positions, known_picture.slot_likelihoods(judged, expected, clock, isi_memory)

    def _clock(
        self, frame: Frame, flat: known_picture.ColumnLight, old: Clock, time: tracking.LinkTime
    ) -> Clock | None:
        """The clock of the frame: from headers near their predicted place, else the predicted clock.

        None if no headers are found: another scene, or something in front of the screen.
        """
        rows = self.rows
        n_slots = int(np.ceil(rows.size / old.rows_per_slot)) + 1
        predicted = time.clock_at(frame.index, frame.time_s, old, n_slots, float(rows[0]) - 0.5)
        contrast = self._header(flat, predicted) if predicted is not None else 0.0
        if contrast <= SETTINGS.good_header:
            predicted, contrast = self._searched(flat, old, time, predicted, contrast)
        return predicted if contrast >= SETTINGS.min_header else None

    def _searched(
        self,
        flat: known_picture.ColumnLight,
        old: Clock,
        time: tracking.LinkTime,
        predicted: Clock | None,
        contrast: float,
    ) -> tuple[Clock | None, float]:
        """The clock by its headers, wherever they are, if they show better there than the contrast of the predicted."""
        rows = self.rows
        profiles = RowProfiles(
            light=flat.shrunk[:, None],
            inside=np.asarray(self.pose.map.inside.any(axis=1, keepdims=True)),
            rows=rows.astype(np.int64),
            sensor_row=None,
            count=np.ones((flat.shrunk.shape[0], 1), np.float32),
            noise_floor=1e-4,
            noise_slope=0.0,
        )
        found = sync.find_clock(profiles, old.rows_per_slot, old.exposure_slots, old.packet_slots, 0.03)
        if found is None:
            return predicted, contrast
        found = replace(found, delay_slots=old.delay_slots)
        if predicted is not None and _clock_distance(found, predicted) > time.sure_slots:
            return predicted, contrast
        here = self._header(flat, found)
        return (found, here) if here > contrast + SETTINGS.better_header else (predicted, contrast)

    def _header(self, flat: known_picture.ColumnLight, clock: Clock) -> float:
        return known_picture.header_contrast(flat, known_picture.row_positions(self.rows, clock), clock)

    # -- the picture ----------------------------------------------------------------------------------------------

    def update(self, view: View, lit: Callable[[], Float32Array]) -> None:
        """Set the frame that was received last; learn from the first frames, and from some later ones.

        Args:
            view: the frame.
            lit: gives the probability (C, N) that each of its slots is lit.
        """
        if self._n_updates < SETTINGS.first_updates or (self._n_updates + 1) % SETTINGS.update_every == 0:
            self.learn(view, lit())
        else:
            self._n_updates += 1
        self.last = view

    def learn(self, view: View, lit: Float32Array, *, forget: bool = True) -> Float32Array | None:
        """Take a frame into the picture; returns the update of the picture.

        See `known_picture.KnownPicture.learn` for `forget`.
        """
        if view.light is None or view.pose is None:
            return None
        self._n_updates += 1
        clock = view.bursts.clock
        positions = known_picture.row_positions(view.pose.rows, clock)
        slots = SlotLight(lit).mean_over(positions, clock.exposure_slots)
        trust = known_picture.trusted(lit, positions, clock.exposure_slots)
        observation = known_picture.Observation(
            view.light, slots, trust, view.pose.placement, self._frame_rows(view.pose)
        )
        return self._picture.learn(observation, forget=forget)

    def _frame_rows(self, pose: Pose) -> Float32Array | None:
        """(C, P) row of a frame that shows each row of the picture; None where that is where the first one did."""
        if pose.middles is None:
            return None
        rows = geometry.rows_elsewhere(self._first_pose.rows, self._first_middles, pose.middles)
        return rows - np.float32(pose.map.first_row)

    def can_measure_again(self, view: View) -> bool:
        """Whether a frame's strips are those of this screen."""
        return view.light is not None and view.pose is not None and view.pose.home is self._first_pose.map

    def measure_again(self, views: Sequence[View], known: Sequence[Float32Array], doubtful: Sequence[bool]) -> None:
        """Learn the picture anew from frames, and measure doubtful ones with the picture of the others.

        Args:
            views: the frames.
            known: (C, N) of each, probability that each slot is lit.
            doubtful: of each, whether it is to be measured.
        """
        self._n_updates = 0
        self._picture = self._new_picture(self._dark_light(views))
        updates = [self.learn(view, lit, forget=False) for view, lit in zip(views, known, strict=True)]
        for view, update, lit, needed in zip(views, updates, known, doubtful, strict=True):
            if needed and update is not None:
                self._measure_again(view, update, lit)

    def _dark_light(self, views: Sequence[View]) -> Float32Array:
        """(C, S) light of the strips where nothing is lit."""
        lights, dark, inside = [], [], []
        for view in views:
            if view.light is not None and view.pose is not None:
                positions = known_picture.row_positions(view.pose.rows, view.bursts.clock)
                lights.append(view.light)
                dark.append(known_picture.header_dark(positions, view.bursts.clock))
                inside.append(view.pose.map.inside)
        return known_picture.dark_light(lights, dark, inside, self._begun_with[1])

    def _measure_again(self, view: View, own: Float32Array, known: Float32Array) -> None:
        """Measure a frame by the picture, less what the frame itself has shown of it."""
        assert view.light is not None
        assert view.pose is not None
        picture = self._picture.without(own).placed(view.pose.placement)
        flat = picture.solve(view.light)
        clock, rows, most = view.bursts.clock, view.pose.rows, SETTINGS.misfit
        if known_picture.header_contrast(flat, known_picture.row_positions(rows, clock), clock) < SETTINGS.min_header:
            return
        refined = self._refined(picture, rows, view.light, flat, clock, view.isi_memory, most, known)
        if refined is not None:
            burst = view.bursts.clock.burst
            view.flat, clock, _, found = refined
            view.snr = found.snr
            view.bursts = replace(view.bursts, clock=replace(clock, burst=burst), metrics=found.metrics, tracked=True)


def followed_outline(frame: Frame, corners: FloatArray, screen: ScreenProfile) -> FloatArray | None:
    """Corners (4, 2) of a screen by its outline, which is looked for near `corners`; None if it is not there."""
    from rxcli.receiver.screen.find import ColumnLayout, follow_outline

    stored, order = _stored_order(corners)
    layout = ColumnLayout(screen.columns, screen.light_spread, screen.aspect)
    found = follow_outline(plane.read_plane(frame), stored, layout)
    return None if found is None else found[order]


def _less_ends(inside: BoolArray, rows: float) -> BoolArray:
    """(C, S, R) strips on the screen, without `rows` rows at its ends."""
    n = int(np.ceil(min(rows, SETTINGS.max_end_rows)))
    left = np.zeros_like(inside)
    left[..., n:-n] = inside[..., 2 * n :] & inside[..., : -2 * n]
    return left


def _map(
    frame: Frame, corners: FloatArray, camera: Camera, acquisition: Acquisition, n_strips: int | None = None
) -> tracked.StripMap:
    """Map of the strips; `n_strips` keeps an earlier number of strips, which a known picture depends on."""
    n_columns = acquisition.screen.columns
    if n_strips is None:
        column_px = float(np.linalg.norm(corners[1] - corners[0])) / n_columns
        n_strips = min(plane.strips_per_column(column_px), SETTINGS.max_strips)
    outlines = geometry.column_outlines(corners, n_columns, n_strips, frame.width, frame.height, camera.lens)
    return tracked.map_strips(outlines, frame, lambda coded: plane.tone_to_light(camera.tone, coded))


def _shown(inside: NDArray[np.bool_], positions: FloatArray, clock: Clock) -> IntArray:
    """(n_copies, C, packet) 1 where the middle of a slot is on the screen."""
    on_screen = np.asarray(inside.any(axis=1))
    columns = np.arange(on_screen.shape[0]) % positions.shape[0]
    start = positions[columns, on_screen.argmax(axis=1)][:, None]
    end = positions[columns, on_screen.shape[1] - 1 - on_screen[:, ::-1].argmax(axis=1)][:, None]
    middles = np.arange(clock.n_slots) + 0.5
    shown = (middles >= start) & (middles <= end) & np.asarray(on_screen.any(axis=1))[:, None]
    return np.asarray(clock.to_copies(shown.astype(np.float32)), np.int64).transpose(1, 0, 2)


def _clock_distance(left: Clock, right: Clock) -> float:
    """Slots between two clocks, modulo the packet."""
    length = left.packet_slots
    difference = left.first_slot - right.first_slot - (left.row0 - right.row0) / left.rows_per_slot
    return float(abs((difference + length / 2) % length - length / 2))


def _stored_order(corners: FloatArray) -> tuple[FloatArray, IntArray]:
    """Corners clockwise from the one of smallest x + y, and the order that turns such ones back."""
    following = np.roll(corners, -1, axis=0)
    area = float((corners[:, 0] * following[:, 1] - following[:, 0] * corners[:, 1]).sum())
    order = np.arange(4) if area > 0 else np.arange(4)[::-1]
    order = np.roll(order, -int(corners[order].sum(axis=1).argmin()))
    return corners[order], np.argsort(order)


def _is_possible(moved: FloatArray, covariance: FloatArray) -> bool:
    """Whether corners (4, 2) that seem to have moved may have stayed, each coordinate for itself."""
    return bool((np.square(moved.ravel()) < SETTINGS.rest_sds**2 * np.diag(covariance)).all())


def _is_still(moved: FloatArray, sd_px: float) -> bool:
    """Whether corners (4, 2) that seem to have moved may be where they were."""
    shift, each = np.abs(moved.mean(axis=0)).max(), float(np.sqrt(np.square(moved).mean()))
    return bool(
        shift < max(SETTINGS.still_px, SETTINGS.still_sds * sd_px / 2)
        and each < max(SETTINGS.still_px, SETTINGS.still_sds * sd_px)
    )
