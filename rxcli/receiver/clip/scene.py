"""What frames of a clip have taught of the scene in view: where the screen is, and the picture on it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rxcli.receiver import channel, sampling, sync
from rxcli.receiver.acquisition import Acquisition
from rxcli.receiver.channel import known_picture
from rxcli.receiver.clip.views import View
from rxcli.receiver.context import Camera, FrameContext, Timer
from rxcli.receiver.sampling import tracked
from rxcli.receiver.screen import geometry
from rxcli.receiver.sync import tracking
from rxcli.types import Clock, Float32Array, FloatArray, Frame, IntArray, RowProfiles

#: Strips of a column, at most: more tell no more of a picture that is known, and take time.
_STRIPS = 4
#: Frames beyond which each one's share of what is known of the picture does not matter.
_MANY_VIEWS = 12
#: How often the corners are looked at.
_LOOK_EVERY = 30
#: Looks whose median is where the corners are.
_N_CORNERS = 5
#: A screen found anew whose corners are closer than this to where they were, in screen widths, is where it was.
_NEAR = 0.06
#: Movement of a corner that is followed at once, and the one below which nothing is changed, in screen widths.
_JUMP, _STILL = 0.012, 0.0004
#: Frames from which the picture is learned one by one, and how often from then on.
_FIRST_UPDATES, _UPDATE_EVERY = 12, 6
#: Frames of which the picture is known so little that strips are compared with what is expected of them.
_FEW_UPDATES = 4
#: Columns decided worse than this many times the foreseen variance do not fit what is known.
_MISFIT = 40.0
#: Slots of lateness that are put right, contrast of headers, against full, below which nothing is known any more, and
#: contrast of a frame below which compression has taken much of it.
_LATE, _LEAST_HEADER, _FADED = 0.03, 0.3, 0.85
#: Share of a frame's noise in what is expected of the next.
_NOISE_SHARE = 0.2
#: Contrast of its headers at which the foretold clock is not doubted.
_GOOD_HEADER = 0.6
#: How much better its headers must show for a clock to be taken instead of the foretold one.
_BETTER = 0.05
#: Every so manieth row tells enough of a column's signal-to-noise ratio.
_SNR_EVERY = 5


class TrackedScreen:
    """A screen that stays where it is, or moves little, and the picture on it.

    Args:
        corners: of the screen, (4, 2).
        strip_map: how its strips are read.
        lock: of the frame that it begins with.
        floor: light of a dark slot there.
    """

    def __init__(
        self, corners: FloatArray, strip_map: tracked.StripMap, acquisition: Acquisition, black_level: float
    ) -> None:
        self.corners, self.map = corners, strip_map
        #: The frame that was received last.
        self.last: View | None = None
        self._corner_history = deque([corners], maxlen=_N_CORNERS)
        self._n_frames = 0
        self._begun_with = acquisition, black_level
        self._n_updates = 0
        self._picture = self._new_picture(black_level)

    @classmethod
    def of_frame(
        cls,
        context: FrameContext,
        acquisition: Acquisition,
        black_level: float,
        before: TrackedScreen | None,
    ) -> TrackedScreen:
        """A new picture; the strips stay those of the scene before, where the screen is still there."""
        n_columns, corners = acquisition.screen.columns, context.corners
        if before is not None and corners is before.corners and before.map.inside.shape[0] == n_columns:
            return cls(corners, before.map, acquisition, black_level)
        strip_map = _map(context.frame, corners, context.camera, acquisition)
        return cls(corners, strip_map, acquisition, black_level)

    def _new_picture(self, black_level: float | Float32Array) -> known_picture.KnownPicture:
        acquisition, profiles = self._begun_with[0], self._begun_with[0].profiles
        return known_picture.KnownPicture(
            self.map.inside,
            channel.crosstalk_matrix(self.map.inside.shape[1], acquisition.screen.light_spread),
            black_level,
            max(profiles.noise_floor / self.map.pixels, 1e-7),
            profiles.noise_slope / self.map.pixels,
        )

    @property
    def rows(self) -> FloatArray:
        """(R,) sensor rows that are read."""
        return self.map.first_row + np.arange(self.map.inside.shape[2], dtype=np.float64)

    def strips(self, frame: Frame) -> Float32Array:
        """(C, S, R) light of the strips in a frame."""
        return tracked.sample_strips(frame, self.map)

    # -- where the screen is -----------------------------------------------------------------------------------

    def near(self, corners: FloatArray) -> bool:
        """Whether a screen found at the corners is where this one is."""
        return bool(np.abs(corners - self.corners).max() < _NEAR * np.ptp(self.corners[:, 0]))

    def follow(self, frame: Frame, may_move: bool) -> bool:
        """Look where the screen is, now and then; returns whether it moved."""
        self._n_frames += 1
        if not may_move or self._n_frames % _LOOK_EVERY:
            return False
        from rxcli.receiver.screen.find import track_screen

        stored, order = _stored_order(self.corners)
        found = track_screen(frame.pixels, stored, black=frame.black, white=frame.white)
        if found.corners is None:
            return False
        found_corners = found.corners[order]
        width = float(np.linalg.norm(self.corners[1] - self.corners[0]))
        if np.abs(found_corners - self.corners).max() > _JUMP * width:
            self._corner_history.clear()
        self._corner_history.append(found_corners)
        corners = np.median(self._corner_history, axis=0)
        moved = bool(np.abs(corners - self.corners).max() > _STILL * width)
        if moved:
            self._move(frame, corners)
        return moved

    def _move(self, frame: Frame, corners: FloatArray) -> None:
        assert self.last is not None
        rows, before, before_map = self.rows, self.corners, self.map
        self.map = _map(frame, corners, self.last.context.camera, self.last.acquisition, before_map.inside.shape[1])
        self.corners = corners
        row_of = _row_before(self.rows, corners, before, self.last.acquisition.screen.columns)
        self._picture.moved(row_of - rows[0], self.map.inside)

    # -- a frame ------------------------------------------------------------------------------------------------

    def view(self, frame: Frame, time: tracking.LinkTime, thorough: bool, timer: Timer) -> View | None:
        """A frame by what is known; None where that does not fit.

        Args:
            frame: taken with the same camera as those before.
            time: the link's time.
            thorough: False where it is enough to measure a faded frame roughly, for it will be measured again.
            timer: time is counted there.
        """
        last = self.last
        if last is None:
            return None
        with timer("sampling"):
            light = self.strips(frame)
            flat = self._picture.solve(light)
        with timer("clock"):
            clock = self._clock(frame, flat, last.acquisition.clock, time)
            if clock is None:
                return None
        with timer("detect"):
            refined = self._refined(self._picture, light, flat, clock, last.isi_memory, thorough)
            if refined is None:
                return None
            flat, clock, positions, metrics = refined
            shown = _shown(self.map.inside, positions, clock)
            snr = _snr(flat, clock)
        return View(
            replace(last.context, frame=frame, corners=self.corners, timer=timer),
            replace(last.acquisition, clock=clock),
            tracking.FrameBursts(frame.index, 0, clock, metrics, shown, tracked=True),
            last.isi_memory,
            frame.height,
            snr,
            light=light,
            map=self.map,
            flat=flat,
        )

    def _refined(
        self,
        picture: known_picture.KnownPicture,
        light: Float32Array,
        flat: known_picture.ColumnLight,
        clock: Clock,
        isi_memory: int,
        thorough: bool,
    ) -> tuple[known_picture.ColumnLight, Clock, FloatArray, FloatArray] | None:
        """Clock, response and noise put right by a first decision slot by slot; then positions and metrics.

        Not `thorough` is enough of faded frames that will be measured again.
        None where the headers are not where the clock has them: another scene, or something in front of the screen.
        """
        positions, exposure_slots = known_picture.row_positions(self.rows, clock), clock.exposure_slots
        if known_picture.header_contrast(flat, positions, clock) < _LEAST_HEADER:
            return None
        lit = known_picture.first_decision(flat, positions, clock)
        slots = known_picture.exposures(lit, positions, exposure_slots)
        fit = known_picture.fit_response(flat, slots)
        if self._n_updates < _FEW_UPDATES or (thorough and fit.response.centre < _FADED):
            expected = fit.response.expected(lit, positions, exposure_slots)
            flat = picture.solve_again(light, expected, clock.rows_per_slot)
            fit = known_picture.fit_response(flat, slots)
        if thorough and fit.response.centre < _FADED:
            flat = known_picture.equalized(flat, slots)
            fit = known_picture.fit_response(flat, slots)
        if abs(fit.late) > _LATE:
            clock = replace(clock, row0=clock.row0 - fit.late * clock.rows_per_slot)
            positions = known_picture.row_positions(self.rows, clock)
            fit = known_picture.fit_response(flat, known_picture.exposures(lit, positions, exposure_slots))
        expected = fit.response.expected(lit, positions, exposure_slots)
        flat, ratio = picture.judge(flat, expected, _NOISE_SHARE)
        if ratio > _MISFIT:
            return None
        metrics = known_picture.pattern_metrics(flat, positions, clock, isi_memory, fit.response, expected, lit)
        return flat, clock, positions, metrics

    def _clock(
        self, frame: Frame, flat: known_picture.ColumnLight, old: Clock, time: tracking.LinkTime
    ) -> Clock | None:
        """The clock of the frame: from its headers where they are about as foretold, else as foretold."""
        rows = self.rows
        n_slots = int(np.ceil(rows.size / old.rows_per_slot)) + 1
        predicted = time.clock_at(frame.index, frame.time_s, old, n_slots, float(rows[0]) - 0.5)
        contrast = self._header(flat, predicted) if predicted is not None else 0.0
        if contrast > _GOOD_HEADER:
            return predicted
        profiles = RowProfiles(
            light=flat.shrunk[:, None],
            inside=np.asarray(self.map.inside.any(axis=1, keepdims=True)),
            rows=rows.astype(np.int64),
            sensor_row=None,
            count=np.ones((flat.shrunk.shape[0], 1), np.float32),
            noise_floor=1e-4,
            noise_slope=0.0,
        )
        found = sync.find_clock(profiles, old.rows_per_slot, old.exposure_slots, old.packet_slots, 0.03)
        if found is None:
            return predicted
        found = replace(found, delay_slots=old.delay_slots)
        if predicted is not None and _apart(found, predicted) > time.sure_slots:
            return predicted
        return found if self._header(flat, found) > contrast + _BETTER else predicted

    def _header(self, flat: known_picture.ColumnLight, clock: Clock) -> float:
        return known_picture.header_contrast(flat, known_picture.row_positions(self.rows, clock), clock)

    # -- the picture ----------------------------------------------------------------------------------------------

    def take(self, view: View, lit: Callable[[], Float32Array]) -> None:
        """The frame that was received last. The first ones, and some of those that follow, are learned from.

        Args:
            view: the frame.
            lit: gives the probability (C, N) that each of its slots is lit.
        """
        if self._n_updates < _FIRST_UPDATES or (self._n_updates + 1) % _UPDATE_EVERY == 0:
            self.learn(view, lit())
        else:
            self._n_updates += 1
        self.last = view

    def learn(
        self, view: View, lit: Float32Array, keep: float = known_picture.MEMORY
    ) -> tuple[Float32Array, Float32Array] | None:
        """Take a frame into the picture; returns what it showed.

        See `known_picture.KnownPicture.learn` for `keep`, and for what is returned: slots and trust.
        """
        if view.light is None or view.light.shape[2] != self.rows.size:
            return None
        self._n_updates += 1
        clock = view.bursts.clock
        positions = known_picture.row_positions(self.rows, clock)
        slots = known_picture.exposed(lit, positions, clock.exposure_slots)
        trust = known_picture.trusted(lit, positions, clock.exposure_slots)
        self._picture.learn(view.light, slots, trust, keep)
        return slots, trust

    def can_measure_again(self, view: View) -> bool:
        """Whether a frame's strips were read where the screen is now."""
        return view.light is not None and view.map is self.map

    def measure_again(self, views: Sequence[View], known: Sequence[Float32Array], doubtful: Sequence[bool]) -> None:
        """Learn the picture anew from frames, and measure those in doubt by what the others say of it.

        Args:
            views: the frames.
            known: (C, N) of each, probability that each slot is lit.
            doubtful: of each, whether it is to be measured.
        """
        self._n_updates = 0
        self._picture = self._new_picture(self._dark_light(views))
        updates = [self.learn(view, lit, keep=1.0) for view, lit in zip(views, known, strict=True)]
        alone = len(views) <= _MANY_VIEWS
        for view, update, needed in zip(views, updates, doubtful, strict=True):
            if needed:
                self._measure_again(view, update if alone else None)

    def _dark_light(self, views: Sequence[View]) -> Float32Array:
        """(C, S) light of the strips where nothing is lit."""
        lights = [view.light for view in views if view.light is not None]
        clocks = [view.bursts.clock for view in views if view.light is not None]
        dark = [known_picture.header_dark(known_picture.row_positions(self.rows, clock), clock) for clock in clocks]
        return known_picture.dark_light(lights, dark, self.map.inside, self._begun_with[1])

    def _measure_again(self, view: View, update: tuple[Float32Array, Float32Array] | None) -> None:
        """Measure a frame by the picture, less what the frame itself has shown of it where that is given."""
        assert view.light is not None
        picture = self._picture if update is None else self._picture.without(view.light, *update)
        flat = picture.solve(view.light)
        refined = self._refined(picture, view.light, flat, view.bursts.clock, view.isi_memory, thorough=True)
        if refined is not None:
            burst = view.bursts.clock.burst
            view.flat, clock, _, metrics = refined
            view.snr = _snr(view.flat, clock)
            view.bursts = replace(view.bursts, clock=replace(clock, burst=burst), metrics=metrics, tracked=True)


def _map(
    frame: Frame, corners: FloatArray, camera: Camera, acquisition: Acquisition, n_strips: int | None = None
) -> tracked.StripMap:
    """Where the strips lie; as many as before where `n_strips` says so, for a picture known by strips cannot follow."""
    n_columns = acquisition.screen.columns
    if n_strips is None:
        column_px = float(np.linalg.norm(corners[1] - corners[0])) / n_columns
        n_strips = min(sampling.strips_per_column(column_px), _STRIPS)
    outlines = geometry.column_outlines(corners, n_columns, n_strips, frame.width, frame.height, camera.lens)
    return tracked.map_strips(outlines, frame, lambda coded: sampling.tone_to_light(camera.tone, coded))


def _shown(inside: NDArray[np.bool_], positions: FloatArray, clock: Clock) -> IntArray:
    """(n_copies, C, packet) 1 where the middle of a slot is on the screen."""
    on_screen = np.asarray(inside.any(axis=1))
    columns = np.arange(on_screen.shape[0]) % positions.shape[0]
    first = positions[columns, on_screen.argmax(axis=1)][:, None]
    last = positions[columns, on_screen.shape[1] - 1 - on_screen[:, ::-1].argmax(axis=1)][:, None]
    middles = np.arange(clock.n_slots) + 0.5
    shown = (middles >= first) & (middles <= last) & np.asarray(on_screen.any(axis=1))[:, None]
    return np.asarray(sync.to_copies(shown.astype(np.float32), clock), np.int64).transpose(1, 0, 2)


def _snr(flat: known_picture.ColumnLight, clock: Clock) -> Float32Array:
    """(C, N) squared contrast over variance of a slot: the mean of the rows around."""
    mean = np.median(flat.precision[:, ::_SNR_EVERY], axis=1) * np.float32(clock.rows_per_slot)
    return np.repeat(mean[:, None], clock.n_slots, axis=1).astype(np.float32)


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
