"""From a frame to a locked clock: corners, camera, screen profile, row profiles. Part of the wiring."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rxcli.options import ReceiverOptions
from rxcli.profiles import ReadoutMode, ScreenProfile, match_camera
from rxcli.receiver import camera as blind
from rxcli.receiver import sampling, sync
from rxcli.receiver.screen import geometry
from rxcli.types import Clock, Float32Array, FloatArray, Frame, IntArray, Lens, Outlines, RowProfiles

_DEFAULT_TONE = "srgb"
#: A header peak less than this times the strongest rival is no lock.
_MIN_LOCK = 1.6
#: Of so many strips a column a quick look reads pairs; what tells screens by their columns needs some.
_MANY_STRIPS = 4
#: Orientations in which the readout runs along the columns' width.
_PORTRAIT = (5, 6, 7, 8)


class Failure(Exception):
    """Reception ends here, with a status and a message; never leaves this module."""

    def __init__(
        self,
        status: Literal["no_screen", "no_signal"],
        message: str,
        estimated: dict[str, tuple[float, float]] | None = None,
    ) -> None:
        super().__init__(message)
        #: What was estimated of the camera all the same.
        self.estimated = estimated or {}
        self.status = status
        self.message = message


class Stages:
    """Wall time by stage."""

    def __init__(self) -> None:
        self.timing_ms: dict[str, float] = {}
        self._start = time.perf_counter()

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = 1e3 * (time.perf_counter() - start)
            self.timing_ms[name] = self.timing_ms.get(name, 0.0) + elapsed

    def total(self) -> dict[str, float]:
        return {**self.timing_ms, "total": 1e3 * (time.perf_counter() - self._start)}


@dataclass(frozen=True, slots=True)
class Camera:
    """What is known of the camera that took a frame."""

    #: None for a camera that was estimated from the frame itself.
    profile: str | None
    line_delay_s: float
    exposure_s: float
    lens: Lens | None
    tone: str
    #: True where the stored rows run against the readout.
    reversed: bool = False
    #: What was estimated: name -> (value, standard deviation).
    estimated: dict[str, tuple[float, float]] = field(default_factory=dict)
    #: The estimate and the strips it is of, for `refitted_camera`; None for a camera from a profile.
    blind_estimate: tuple[blind.BlindEstimate, blind.Strips] | None = None

    @property
    def facts(self) -> dict[str, Any]:
        """What a result says of it, by the names of its fields."""
        return {
            "camera_profile": self.profile,
            "line_delay_s": self.line_delay_s,
            "exposure_s": self.exposure_s,
            "estimated": self.estimated,
        }

    def without_tone(self) -> Camera:
        """The camera, its tone curve not told."""
        denoised = {name: found for name, found in self.estimated.items() if name != "tone_exponent"}
        return replace(self, estimated=denoised)


@dataclass(frozen=True, slots=True)
class ColumnSampler:
    """What was read of the columns of a screen."""

    profiles: RowProfiles
    #: Whether strips were read in pairs, as a quick look takes them.
    is_binned: bool = False
    #: Reads all strips of some columns pixel by pixel, given the noise model, where the profiles are of a quick look;
    #: None where they are not.
    read: Callable[[slice, tuple[float, float]], RowProfiles] | None = None

    @property
    def n_binned_strips(self) -> int:
        """Strips of a column that a quick look takes: see `sync.binned_strips`."""
        n_strips: int = self.profiles.light.shape[1]
        return n_strips if self.is_binned or n_strips % 2 else n_strips // 2

    def binned(self) -> RowProfiles:
        """Strips pooled in pairs."""
        return self.profiles if self.is_binned else sync.binned_strips(self.profiles)

    def in_depth(self, columns: NDArray[np.int64]) -> ColumnSampler:
        """The same with some columns read pixel by pixel, strip by strip."""
        if self.read is None or not columns.size:
            return self
        every = sync.unbinned_strips(self.profiles) if self.is_binned else self.profiles
        names = [name for name in ("light", "inside", "count", "sensor_row") if getattr(every, name) is not None]
        arrays = {name: getattr(every, name).copy() for name in names}
        for run in np.split(columns, np.flatnonzero(np.diff(columns) > 1) + 1):
            part = slice(int(run[0]), int(run[-1]) + 1)
            read = self.read(part, (every.noise_floor, every.noise_slope))
            for name, array in arrays.items():
                array[part] = getattr(read, name)
        return ColumnSampler(replace(every, **arrays), read=self.read)


@dataclass(frozen=True, slots=True)
class Acquisition:
    """A screen whose clock was found."""

    screen: ScreenProfile
    sampler: ColumnSampler
    clock: Clock
    #: Another that it may be: of columns which are not spread in time, where they seem to be.
    rival: Clock | None = None
    #: (n_copies,) burst of every copy; None where the light is to tell.
    burst: IntArray | None = None

    @property
    def profiles(self) -> RowProfiles:
        return self.sampler.profiles

    def is_binned(self) -> Acquisition:
        """The lock with strips pooled in pairs."""
        return replace(self, sampler=ColumnSampler(self.sampler.binned(), is_binned=True))

    def in_depth(self, columns: NDArray[np.int64]) -> Acquisition:
        """The lock with some columns read pixel by pixel, strip by strip."""
        sampler = self.sampler.in_depth(columns)
        return self if sampler is self.sampler else replace(self, sampler=sampler)


def _camera_of(frame: Frame, options: ReceiverOptions) -> Camera | None:
    """What the profiles say of the frame's camera; None where none fits."""
    meta = frame.metadata
    profile = (
        options.cameras[0]
        if options.force_camera
        else match_camera(options.cameras, meta.make, meta.model, frame.width, frame.height)
    )
    mode = profile.mode_for(frame.width, frame.height) if profile else None
    if profile is None:
        return None
    if mode is None:
        raise Failure(
            "no_signal",
            f"camera profile {profile.name} has no readout mode for {frame.width} x {frame.height}; add one with "
            "vlc-rx calibrate shutter, or leave the camera to be estimated with --camera auto",
        )
    lens = geometry.lens_for(profile.lens, frame.width, frame.height) if profile.lens else None
    tone = _DEFAULT_TONE if profile.tone == "auto" else profile.tone
    return Camera(profile.name, mode.line_delay_s, _exposure_of(frame, mode), lens, tone)


def find_camera(
    frame: Frame, corners: FloatArray, options: ReceiverOptions, stages: Stages
) -> tuple[Camera, ReceiverOptions]:
    """The camera, from a profile or estimated, and the options with the screens that remain."""
    found = find_cameras(frame, corners, options, stages)
    if found.first is None:
        raise Failure("no_signal", found.reason)
    return found.first


@dataclass(frozen=True, slots=True)
class Cameras:
    """Cameras that may have taken a frame, each with the options and the screens that remain with it."""

    #: None where nothing was estimated, for the reason.
    first: tuple[Camera, ReceiverOptions] | None
    #: Estimates that are worth a look too, best first.
    rivals: tuple[tuple[Camera, ReceiverOptions], ...] = ()
    reason: str = ""
    #: What the picture tells of its camera even where nothing can be received.
    estimated: dict[str, tuple[float, float]] = field(default_factory=dict)
    #: Whether the first is beyond doubt but for the length of its packets.
    sure: bool = False


def find_cameras(frame: Frame, corners: FloatArray, options: ReceiverOptions, stages: Stages) -> Cameras:
    """The camera that a profile tells, or those that may be, estimated from the frame."""
    known = _camera_of(frame, options)
    if known is not None:
        return Cameras((known, options))
    n_columns = min(screen.columns for screen in options.screens)
    with stages("sampling"):
        strips = _straightened_strips(frame, corners, n_columns, _sides_of(frame, corners))
    with stages("blind"):
        contradicted = strips.side_curvature is not None and blind.stripes_are_curved(strips)
    if contradicted:
        # Lenses that are left in a picture do not bend stripes: what looked like its sides are others.
        with stages("sampling"):
            strips = _straightened_strips(frame, corners, n_columns, None)
    with stages("blind"):
        found = blind.estimate_camera(strips, options.screens, frame.metadata.exposure_s)
    first = _with_screens(found.estimate, strips, options) if found.estimate else None
    rivals = tuple(_with_screens(rival, strips, options) for rival in found.rivals)
    by_edges = blind.summary_of_rows(found.by_edges) if found.by_edges else {}
    return Cameras(first, rivals, found.reason, by_edges, found.sure)


def _with_screens(
    estimate: blind.BlindEstimate, strips: blind.Strips, options: ReceiverOptions
) -> tuple[Camera, ReceiverOptions]:
    """An estimated camera, and the options with the screens that it may show."""
    screens = [screen for screen in options.screens if screen.packet_slots == estimate.packet_slots]
    rate = screens[0].slot_rate_hz
    remaining = tuple(screen for screen in screens if screen.slot_rate_hz == rate)
    return _estimated_camera(estimate, strips, rate), replace(options, screens=remaining)


def _sides_of(frame: Frame, corners: FloatArray) -> tuple[float, float] | None:
    """The distortion that the screen's sides show, see `find_screen.measure_side_curvature`."""
    from rxcli.receiver.screen.find import measure_side_curvature

    return measure_side_curvature(frame.pixels, corners, **levels_of(frame))


def _straightened_strips(
    frame: Frame, corners: FloatArray, n_columns: int, sides: tuple[float, float] | None, tone: str = _DEFAULT_TONE
) -> blind.Strips:
    """Strips of a picture whose camera is not known, along sides that show some distortion."""
    lens = blind.curving_lens(blind.side_curvature_of(sides), frame.width, frame.height)
    outlines = _outlines(frame, corners, lens, n_columns)
    centre_x = (outlines.edges_x[1:] + outlines.edges_x[:-1]) / 2
    profiles = sampling.sample_rows(frame, outlines, tone)
    mosaic = frame.mosaic is not None
    undone = None if mosaic or frame.linear else tone
    return blind.strips_of(profiles, centre_x, frame.width, frame.height, sides, mosaic, undone)


def _estimated_camera(estimate: blind.BlindEstimate, strips: blind.Strips, rate: float) -> Camera:
    return Camera(
        profile=None,
        line_delay_s=1 / (estimate.rows_per_slot * rate),
        exposure_s=estimate.exposure_slots / rate,
        lens=blind.lens_of(estimate, strips.width, strips.height),
        tone=strips.tone or _DEFAULT_TONE,
        reversed=estimate.reversed,
        estimated=blind.summary(estimate, rate),
        blind_estimate=(estimate, strips),
    )


def refitted_camera(
    frame: Frame, corners: FloatArray, camera: Camera, acquisition: Acquisition, clock: Clock, lit: Float32Array
) -> tuple[Camera, float]:
    """An estimated camera from slots (C, N) that were decoded on a clock; and how far that moves the clock, slots."""
    if camera.blind_estimate is None:
        return camera, 0.0
    estimate, strips = camera.blind_estimate
    if strips.n_columns != acquisition.screen.columns:
        strips = _straightened_strips(frame, corners, acquisition.screen.columns, strips.sides, camera.tone)
    found, moved_slots = blind.refit(strips, estimate, clock, lit)
    return _estimated_camera(found, strips, acquisition.screen.slot_rate_hz), moved_slots


def linear_camera(
    frame: Frame, corners: FloatArray, camera: Camera, acquisition: Acquisition, clock: Clock, lit: Float32Array
) -> Camera:
    """An estimated camera refitted to values taken as they are, where light bends over the slots as if they were light.

    The same camera where it does not; without an exponent where that is not borne out by the values as they are.
    """
    if (
        camera.blind_estimate is None
        or camera.tone != _DEFAULT_TONE
        or not blind.is_linear(camera.blind_estimate[0].tone)
    ):
        return camera
    estimate, strips = camera.blind_estimate
    as_stored = _straightened_strips(frame, corners, acquisition.screen.columns, strips.sides, "linear")
    found, _ = blind.refit(as_stored, estimate, clock, lit)
    if blind.is_linear(found.tone):
        return _estimated_camera(found, as_stored, acquisition.screen.slot_rate_hz)
    return camera.without_tone()


def _exposure_of(frame: Frame, mode: ReadoutMode) -> float:
    exposure = frame.metadata.exposure_s or mode.exposure_s
    return exposure if exposure else 5 * mode.line_delay_s


def levels_of(frame: Frame) -> dict[str, Any]:
    """What pixel values mean, by the names of the arguments of `find_screen` and `measure_side_curvature`."""
    levels = frame.mosaic
    if levels is None:
        return {"black": frame.black, "white": frame.white}
    return {"black": float(np.mean(levels.black)), "white": levels.white, "mosaic_period": levels.pattern.shape[1]}


def find_corners(frame: Frame, options: ReceiverOptions) -> FloatArray:
    orientation = frame.metadata.orientation
    if orientation in _PORTRAIT:
        raise Failure(
            "no_signal",
            f"the picture was taken in portrait (EXIF orientation {orientation}): the sensor reads along the width of "
            "the columns, so that they cannot be told apart; hold the camera in landscape",
        )
    if options.corners is not None:
        return options.corners
    from rxcli.receiver.screen.find import find_screen

    found = find_screen(frame.pixels, **levels_of(frame))
    corners = found.corners
    if corners is None and "no_screen" in options.skip:
        raise Failure("no_screen", f"no screen found: {found.reason}; give its place with --corners")
    if corners is None:
        # Told not to give up: the picture may show nothing but a part of the screen.
        right, bottom = frame.width - 1.0, frame.height - 1.0
        corners = np.array([[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]])
    return geometry.viewer_order(corners, orientation)


def acquire(
    frame: Frame, corners: FloatArray, camera: Camera, options: ReceiverOptions, stages: Stages, *, quick: bool = False
) -> Acquisition:
    """The screen profile that fits best, with the row profiles of its columns.

    Screens that differ in nothing but their columns share a clock: which of them it is, is asked last. With `quick`,
    columns are read pixel by pixel when they are asked for, see `Acquisition.in_depth`.
    """
    n_columns = min(screen.columns for screen in options.screens)
    with stages("sampling"):
        sampler = _read_columns(frame, corners, camera, n_columns, quick=quick)
    with stages("clock"):
        pooled = sync.pooled_strips(sampler.binned())
        rates = {(s.slot_rate_hz, s.packet_slots): s for s in options.screens}
        clocks = {rate: found for rate, screen in rates.items() if (found := _clocks_of(screen, pooled, camera))}
        clocks = {rate: found for rate, found in clocks.items() if found[0].header_peak_ratio >= _MIN_LOCK}
        if not clocks:
            raise Failure("no_signal", _why_no_signal(frame, corners, camera, options))
        rate = next(iter(clocks)) if len(clocks) == 1 else max(clocks, key=lambda r: _structure(pooled, clocks[r][0]))
    alike = [screen for screen in options.screens if (screen.slot_rate_hz, screen.packet_slots) == rate]
    acquisitions = [_acquired(alike[0], sampler, clocks[rate])] if alike[0].columns == n_columns else []
    for screen in alike[len(acquisitions) :]:
        with stages("sampling"):
            finer = _read_columns(frame, corners, camera, screen.columns, quick=quick)
        with stages("clock"):
            found = _clocks_of(screen, sync.pooled_strips(finer.binned()), camera)
        if found:
            acquisitions.append(_acquired(screen, finer, found))
    if not acquisitions:
        raise Failure("no_signal", _why_no_signal(frame, corners, camera, options))
    return acquisitions[0] if len(acquisitions) == 1 else _with_likely_columns(acquisitions)


def _acquired(screen: ScreenProfile, sampler: ColumnSampler, clocks: tuple[Clock, ...]) -> Acquisition:
    return Acquisition(screen, sampler, clocks[0], rival=clocks[1] if len(clocks) > 1 else None)


def _structure(profiles: RowProfiles, clock: Clock) -> float:
    """How much the strips, each on its own, look like packets on this clock."""
    samples = sync.sample_slots(profiles, clock, 1)
    slots = samples.light.reshape(-1, clock.n_slots).astype(np.float64)
    return blind.structure_llr(slots, clock.first_slot, clock.packet_slots)


def _with_likely_columns(acquisitions: list[Acquisition]) -> Acquisition:
    """Among screens of one clock, the one whose columns are as wide as seen."""
    finest = max(
        acquisitions, key=lambda acquisition: acquisition.profiles.light.shape[0] * acquisition.profiles.light.shape[1]
    )
    likely = blind.likely_columns(finest.profiles, finest.clock, [acquisition.screen for acquisition in acquisitions])
    return next(acquisition for acquisition in acquisitions if acquisition.screen is likely)


def _n_strips(corners: FloatArray, n_columns: int) -> int:
    return sampling.strips_per_column(float(np.linalg.norm(corners[1] - corners[0])) / n_columns)


def _outlines(frame: Frame, corners: FloatArray, lens: Lens | None, n_columns: int) -> Outlines:
    n_strips = _n_strips(corners, n_columns)
    return geometry.column_outlines(corners, n_columns, n_strips, frame.width, frame.height, lens)


def sample_columns(frame: Frame, corners: FloatArray, camera: Camera, n_columns: int) -> RowProfiles:
    """Row profiles of a screen of `n_columns` columns, in the order of time."""
    return _read_columns(frame, corners, camera, n_columns, quick=False).profiles


def _read_columns(frame: Frame, corners: FloatArray, camera: Camera, n_columns: int, *, quick: bool) -> ColumnSampler:
    """All columns; after a quick look, with what reads some of them pixel by pixel."""
    quick = quick and sampling.is_coded(frame)
    n_strips = _n_strips(corners, n_columns)
    is_binned = quick and n_strips >= _MANY_STRIPS and n_strips % 2 == 0

    def read(
        columns: slice, noise: tuple[float, float] | None, n_strips: int = n_strips, quick: bool = False
    ) -> RowProfiles:
        outlines = geometry.column_outlines(
            corners, n_columns, n_strips, frame.width, frame.height, camera.lens, columns
        )
        profiles = sampling.sample_rows(frame, outlines, camera.tone, quick=quick, noise=noise)
        return blind.in_time_order(profiles, frame.height) if camera.reversed else profiles

    profiles = read(slice(0, n_columns), None, n_strips // 2 if is_binned else n_strips, quick)
    return ColumnSampler(profiles, is_binned, read if quick else None)


def _clocks_of(screen: ScreenProfile, profiles: RowProfiles, camera: Camera) -> tuple[Clock, ...]:
    rows_per_slot = 1 / (screen.slot_rate_hz * camera.line_delay_s)
    exposure_slots = camera.exposure_s * screen.slot_rate_hz
    return sync.find_clocks(profiles, rows_per_slot, exposure_slots, screen.packet_slots, noise_of(profiles))


def _why_no_signal(frame: Frame, corners: FloatArray, camera: Camera, options: ReceiverOptions) -> str:
    shortest = min(options.screens, key=lambda screen: screen.packet_s)
    return too_small(frame, corners, camera, shortest) or (
        "a screen was found but no packet header; check that it sends, the shutter is electronic and HDR is off"
    )


def too_small(frame: Frame, corners: FloatArray, camera: Camera, screen: ScreenProfile) -> str | None:
    """Why no packet of `screen` fits the rows that show it, None where one does."""
    fill = float(np.ptp(np.clip(corners[:, 1], 0, frame.height - 1))) / frame.height
    needed = screen.packet_s / (camera.line_delay_s * frame.height)
    if fill >= needed:
        return None
    advice = "move closer" if needed < 1 else "use a faster slot rate or shorter packets"
    return (
        f"the screen fills {np.floor(100 * fill):.0f} % of the height: one packet at {screen.slot_rate_hz / 1e3:g} kHz "
        f"needs {np.ceil(100 * needed):.0f} % with this camera; {advice}"
    )


def noise_of(profiles: RowProfiles) -> float:
    """Standard deviation of a strip's row of no light."""
    return float(np.sqrt(profiles.noise_floor / max(float(np.median(profiles.count)), 1.0)))
