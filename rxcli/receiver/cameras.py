"""Which camera took a frame: from a profile, or estimated from the frame itself. Part of the wiring."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from rxcli.options import ReceiverOptions
from rxcli.profiles import ReadoutMode, ScreenProfile, match_camera
from rxcli.receiver import camera as blind
from rxcli.receiver.acquisition import Acquisition, n_strips_of
from rxcli.receiver.context import DEFAULT_TONE, Camera, Failure, FrameContext, Timer
from rxcli.receiver.screen import geometry
from rxcli.types import Clock, Float32Array, FloatArray, Frame, Lens


def has_profile(frame: Frame, options: ReceiverOptions) -> bool:
    """Whether a profile tells the frame's camera."""
    meta = frame.metadata
    found = match_camera(options.cameras, meta.make, meta.model, frame.width, frame.height)
    return options.force_camera or found is not None


def _camera_of(frame: Frame, options: ReceiverOptions) -> Camera | Failure | None:
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
        return Failure(
            "no_signal",
            f"camera profile {profile.name} has no readout mode for {frame.width} x {frame.height}; add one with "
            "vlc-rx calibrate shutter, or leave the camera to be estimated with --camera auto",
        )
    lens = geometry.lens_for(profile.lens, frame.width, frame.height) if profile.lens else None
    tone = DEFAULT_TONE if profile.tone == "auto" else profile.tone
    return Camera(profile.name, mode.line_delay_s, _exposure_of(frame, mode), lens, tone)


def known_lens(frame: Frame, options: ReceiverOptions) -> Lens | None:
    """The lens of a camera that a profile tells; None where none does."""
    known = _camera_of(frame, options)
    return known.lens if isinstance(known, Camera) else None


@dataclass(frozen=True, slots=True)
class Cameras:
    """Cameras that may have taken a frame, each with the frame and the screens that remain with it."""

    #: None where nothing was estimated, for the reason.
    first: FrameContext | None
    #: Estimates that are worth a look too, best first.
    rivals: tuple[FrameContext, ...] = ()
    reason: str = ""
    #: What the picture tells of its camera even where nothing can be received.
    estimated: dict[str, tuple[float, float]] = field(default_factory=dict)
    #: Whether the first is beyond doubt but for the length of its packets.
    sure: bool = False


def find_cameras(
    frame: Frame,
    corners: FloatArray,
    options: ReceiverOptions,
    timer: Timer,
    shows_packets: Callable[[FrameContext], bool] = lambda _: False,
    *,
    periods: blind.Periods = "all",
) -> Cameras:
    """The camera that a profile tells, or those that may be, estimated from the frame.

    Args:
        frame: the picture.
        corners: (4, 2) of the screen.
        options: screens and cameras.
        timer: of the frame.
        shows_packets: whether packets show with a camera beyond doubt; asked before the search is widened.
        periods: see `estimate_camera`.
    """
    known = _camera_of(frame, options)
    if isinstance(known, Failure):
        return Cameras(None, reason=known.message)
    if known is not None:
        return Cameras(FrameContext(frame, corners, known, options.screens, timer))
    screen = min(options.screens, key=lambda one: one.columns)
    with timer("sampling"):
        strips = _straightened_strips(frame, corners, screen.columns, screen.light_spread, None, timer)
    contexts: dict[int, FrameContext] = {}

    def with_camera(estimate: blind.BlindEstimate) -> FrameContext:
        if id(estimate) not in contexts:
            screens = _screens_of(estimate, options.screens)
            camera = _estimated_camera(estimate, strips, screens[0].slot_rate_hz)
            contexts[id(estimate)] = FrameContext(frame, corners, camera, screens, timer)
        return contexts[id(estimate)]

    with timer("blind"):
        found = blind.estimate_camera(
            strips,
            options.screens,
            frame.metadata.exposure_s,
            lambda estimate: shows_packets(with_camera(estimate)),
            periods=periods,
        )
    first = with_camera(found.estimate) if found.estimate else None
    rivals = tuple(with_camera(rival) for rival in found.rivals)
    by_edges = blind.summary_of_rows(found.by_edges) if found.by_edges else {}
    return Cameras(first, rivals, found.reason, by_edges, found.sure)


def find_camera(frame: Frame, corners: FloatArray, options: ReceiverOptions, timer: Timer) -> FrameContext | Failure:
    """The frame with its camera, from a profile or estimated, and the screens that remain."""
    found = find_cameras(frame, corners, options, timer)
    return found.first or Failure("no_signal", found.reason, found.estimated)


def context_at(context: FrameContext, corners: FloatArray) -> FrameContext:
    """A frame with its camera, the screen elsewhere: what the camera was estimated from is read there."""
    camera = context.camera
    if corners is context.corners:
        return context
    if camera.blind_estimate is None:
        return replace(context, corners=corners)
    estimate, strips = camera.blind_estimate
    with context.timer("sampling"):
        there = _straightened_strips(
            context.frame, corners, strips.n_columns, strips.light_spread, strips.sides, context.timer, camera.tone
        )
    return replace(context, corners=corners, camera=replace(camera, blind_estimate=(estimate, there)))


def _screens_of(estimate: blind.BlindEstimate, screens: tuple[ScreenProfile, ...]) -> tuple[ScreenProfile, ...]:
    """The screens that an estimated camera may show."""
    alike = [screen for screen in screens if screen.packet_slots == estimate.packet_slots]
    return tuple(screen for screen in alike if screen.slot_rate_hz == alike[0].slot_rate_hz)


def _straightened_strips(
    frame: Frame,
    corners: FloatArray,
    n_columns: int,
    light_spread: float,
    sides: tuple[float, float] | None,
    timer: Timer,
    tone: str = DEFAULT_TONE,
) -> blind.Strips:
    """Strips of a picture whose camera is not known, along sides that show some distortion."""
    lens = blind.curving_lens(blind.side_curvature_of(sides), frame.width, frame.height)
    n_strips = n_strips_of(corners, n_columns)
    outlines = geometry.column_outlines(corners, n_columns, n_strips, frame.width, frame.height, lens)
    centre_x = (outlines.edges_x[1:] + outlines.edges_x[:-1]) / 2
    profiles = timer.rows.sample(frame, outlines, tone)
    mosaic = frame.mosaic is not None
    undone = None if mosaic or frame.linear else tone
    return blind.strips_of(profiles, centre_x, frame.width, frame.height, light_spread, sides, mosaic, undone)


def _estimated_camera(estimate: blind.BlindEstimate, strips: blind.Strips, rate: float) -> Camera:
    return Camera(
        profile=None,
        line_delay_s=1 / (estimate.rows_per_slot * rate),
        exposure_s=estimate.exposure_slots / rate,
        lens=blind.lens_of(estimate, strips.width, strips.height),
        tone=strips.tone or DEFAULT_TONE,
        reversed=estimate.reversed,
        estimated=blind.summary(estimate, rate),
        blind_estimate=(estimate, strips),
    )


def refitted_camera(
    context: FrameContext, acquisition: Acquisition, clock: Clock, lit: Float32Array
) -> tuple[Camera, float]:
    """An estimated camera from slots (C, N) that were decoded on a clock; and how far that moves the clock, slots."""
    camera, n_columns, light_spread = context.camera, acquisition.screen.columns, acquisition.screen.light_spread
    if camera.blind_estimate is None:
        return camera, 0.0
    estimate, strips = camera.blind_estimate
    if strips.n_columns != n_columns:
        strips = _straightened_strips(
            context.frame, context.corners, n_columns, light_spread, strips.sides, context.timer, camera.tone
        )
    found, moved_slots = blind.refit(strips, estimate, clock, lit)
    return _estimated_camera(found, strips, acquisition.screen.slot_rate_hz), moved_slots


def linear_camera(context: FrameContext, acquisition: Acquisition, clock: Clock, lit: Float32Array) -> Camera:
    """An estimated camera refitted to values taken as they are, where light bends over the slots as if they were light.

    The same camera where it does not; without an exponent where that is not borne out by the values as they are.
    """
    camera, screen = context.camera, acquisition.screen
    if camera.blind_estimate is None or camera.tone != DEFAULT_TONE:
        return camera
    estimate, strips = camera.blind_estimate
    if not blind.is_linear(estimate.tone):
        return camera
    as_stored = _straightened_strips(
        context.frame, context.corners, screen.columns, screen.light_spread, strips.sides, context.timer, "linear"
    )
    found, _ = blind.refit(as_stored, estimate, clock, lit)
    if blind.is_linear(found.tone):
        return _estimated_camera(found, as_stored, screen.slot_rate_hz)
    return camera.without_tone()


def _exposure_of(frame: Frame, mode: ReadoutMode) -> float:
    exposure = frame.metadata.exposure_s or mode.exposure_s
    return exposure if exposure else 5 * mode.line_delay_s
