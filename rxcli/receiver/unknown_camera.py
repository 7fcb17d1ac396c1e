"""Cameras without a profile: proposed from the picture and fitted to decoded slots. Part of the wiring."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace

from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile
from rxcli.receiver import camera as blind
from rxcli.receiver.acquisition import Acquisition, outlines_of, sample_columns
from rxcli.receiver.context import DEFAULT_TONE, Camera, Failure, FrameContext, Timer
from rxcli.receiver.reception import Reception
from rxcli.types import FloatArray, Frame, RowProfiles


def propose_cameras(
    frame: Frame, corners: FloatArray, options: ReceiverOptions, timer: Timer, n_columns: int
) -> Generator[Camera, None, Failure]:
    """Propose cameras of a frame, likeliest first; returns the reason if there are no others.

    Args:
        frame: the picture.
        corners: (4, 2) of the screen.
        options: screens.
        timer: counts the time of each proposal.
        n_columns: number of columns of the screen.
    """
    unknown = Camera(None, float("nan"), float("nan"), None, DEFAULT_TONE)
    context = FrameContext(frame, corners, unknown, options.screens, timer)
    profiles = sample_columns(context, n_columns)
    with timer("blind"):
        strips = _strips(context, profiles)
    # A picture does not show the slot rate: the fastest screen represents all with the same packet length.
    screens = sorted(options.screens, key=lambda screen: -screen.slot_rate_hz)
    with timer("blind"):
        hypotheses = blind.propose(strips, screens, frame.metadata.exposure_s, may_bend=frame.mosaic is None)
    for hypothesis in sorted(hypotheses, key=lambda h: (-h.score, h.rows_per_slot, h.reversed)):
        screen = next(s for s in screens if s.packet_slots == hypothesis.packet_slots)
        yield _camera(hypothesis, screen.slot_rate_hz, frame)
    return Failure("no_signal", blind.why_not(strips))


def relabelled_camera(camera: Camera, screen: ScreenProfile, frame: Frame) -> Camera:
    """Convert an estimated camera to the slot rate of a screen, since a picture only shows rows per slot."""
    hypothesis, rate = camera.hypothesis, screen.slot_rate_hz
    if hypothesis is None:
        return camera
    stated = (frame.metadata.exposure_s or 0.0) * rate
    if hypothesis.packet_slots != screen.packet_slots:
        exposure_slots = stated or hypothesis.exposure_slots
        hypothesis = replace(hypothesis, packet_slots=screen.packet_slots, exposure_slots=exposure_slots)
    return _camera(replace(hypothesis, stated_exposure_slots=stated), rate, frame)


def settle(context: FrameContext, acquisition: Acquisition, reception: Reception) -> tuple[Camera, float]:
    """Fit an estimated camera to decoded slots; also return the largest shift of the clock, slots."""
    camera, screen, frame = context.camera, acquisition.screen, context.frame
    if camera.hypothesis is None:
        return camera, 0.0
    with context.timer("blind"):
        clock = reception.clock
        found, moved_slots = blind.settle(
            _strips(context, acquisition.profiles),
            camera.hypothesis,
            clock,
            clock.on_grid(reception.posteriors.lit),
            screen.light_spread,
            may_bend=frame.mosaic is None,
        )
    return _camera(found, screen.slot_rate_hz, frame), moved_slots


def _strips(context: FrameContext, profiles: RowProfiles) -> blind.Strips:
    """Convert row profiles to strips in order of time."""
    frame, outlines = context.frame, outlines_of(context, len(profiles.light))
    x = (outlines.edges_x[1:] + outlines.edges_x[:-1]) / 2
    return blind.strips_of(profiles, x[:, ::-1] if context.camera.reversed else x, frame.width, frame.height)


def _camera(hypothesis: blind.CameraHypothesis, slot_rate_hz: float, frame: Frame) -> Camera:
    return Camera(
        profile=None,
        line_delay_s=1 / (hypothesis.rows_per_slot * slot_rate_hz),
        exposure_s=hypothesis.exposure_slots / slot_rate_hz,
        lens=blind.lens_of(hypothesis.curvature, frame.width, frame.height),
        tone=DEFAULT_TONE,
        reversed=hypothesis.reversed,
        estimated=blind.summary(hypothesis, slot_rate_hz),
        hypothesis=hypothesis,
    )
