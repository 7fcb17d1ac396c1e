"""Cameras of a frame: from a profile, or proposed from the picture and fitted to decoded slots."""

from collections.abc import Generator, Iterator, Sequence
from dataclasses import replace

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile, match_camera
from rxcli.receiver.camera.advice import why_not
from rxcli.receiver.camera.camera import lens_of, summary
from rxcli.receiver.camera.fit import settle as settle_hypothesis
from rxcli.receiver.camera.proposals import CameraHypothesis, in_phase, propose, propose_slots
from rxcli.receiver.camera.stripes import Stripes
from rxcli.receiver.camera.strips import ColumnStrips, strips_of
from rxcli.receiver.frame.acquisition import Acquisition
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.camera import FrameCamera
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.frame.passes import Reception
from rxcli.receiver.frame.result import Failure
from rxcli.receiver.screen import geometry
from rxcli.receiver.search.evidence import USUAL_COLUMNS
from rxcli.receiver.search.settings import SETTINGS
from rxcli.types import Clock, Float32Array, FloatArray, Frame, Lens, Remark, RowProfiles

DEFAULT_TONE = "srgb"
UNKNOWN = FrameCamera(None, float("nan"), float("nan"), None, DEFAULT_TONE)


def known_camera(frame: Frame, options: ReceiverOptions) -> FrameCamera | Failure | None:
    """Camera from the matching profile, or None."""
    meta = frame.metadata
    profile = (
        options.cameras[0]
        if options.force_camera
        else match_camera(options.cameras, meta.make, meta.model, frame.width, frame.height)
    )
    if profile is None:
        return None
    mode = profile.mode_for(frame.width, frame.height)
    if mode is None:
        facts = {"profile": profile.name, "width": frame.width, "height": frame.height}
        return Failure(Remark("no_readout_mode", facts))
    lens = geometry.lens_for(profile.lens, frame.width, frame.height) if profile.lens else None
    tone = DEFAULT_TONE if profile.tone == "auto" else profile.tone
    exposure_s = meta.exposure_s or mode.exposure_s or 5 * mode.line_delay_s
    return FrameCamera(profile.name, mode.line_delay_s, exposure_s, lens, tone)


def known_lens(frame: Frame, options: ReceiverOptions) -> Lens | None:
    """Lens from the matching camera profile, or None."""
    known = known_camera(frame, options)
    return known.lens if isinstance(known, FrameCamera) else None


def propose_cameras(
    cache: FrameCache, corners: FloatArray, options: ReceiverOptions, n_columns: int, *, may_bend: bool = True
) -> Generator[FrameCamera, None, Remark]:
    """Propose cameras of a frame, likeliest first; returns the reason if there are no others.

    Args:
        cache: the picture.
        corners: (4, 2) of the screen.
        options: screens.
        n_columns: number of columns of the screen.
        may_bend: whether the camera may have taken a distortion out.
    """
    frame, timer = cache.frame, cache.timer
    context = FrameContext(cache, corners, UNKNOWN, options.screens)
    profiles = context.sample_columns(n_columns)

    def find_stripes() -> Stripes:
        return Stripes(_strips(context, profiles, may_bend=may_bend))

    with timer("blind"):
        stripes = cache.once(("stripes", corners.tobytes(), n_columns, may_bend), find_stripes)
    # A picture does not show the slot rate: the fastest screen represents all with the same packet length.
    screens = sorted(options.screens, key=lambda screen: -screen.slot_rate_hz)
    with timer("blind"):
        hypotheses = propose(stripes, screens, frame.metadata.exposure_s)
    rates = {screen.packet_slots: screen.slot_rate_hz for screen in reversed(screens)}

    def camera_of(hypothesis: CameraHypothesis) -> FrameCamera:
        return estimated_camera(hypothesis, rates[hypothesis.packet_slots], frame)

    stated = [hypothesis for hypothesis in hypotheses if has_stated_readout(camera_of(hypothesis), frame)]
    for hypothesis in stated or hypotheses:
        with timer("blind"):
            precise = in_phase(stripes, hypothesis)
        yield camera_of(precise)
    return why_not(stripes)


def has_stated_readout(camera: FrameCamera, frame: Frame) -> bool:
    """Whether a file states a readout and an estimated camera has it, about."""
    stated_s = frame.metadata.readout_s
    if stated_s is None:
        return False
    return bool(abs(np.log(camera.line_delay_s * frame.height / stated_s)) < SETTINGS.near_readouts)


def cameras_by_slots(
    context: FrameContext, screens: Sequence[ScreenProfile]
) -> Iterator[tuple[ScreenProfile, FrameCamera]]:
    """Cameras by the spectral line of the slot rate alone, each with every screen.

    Args:
        context: the frame.
        screens: that it may show.
    """
    frame = context.frame
    unknown = replace(context, camera=UNKNOWN)
    for n_columns in dict.fromkeys(screen.columns for screen in screens):
        profiles = unknown.sample_columns(n_columns)
        with context.timer("blind"):
            every = max(n_columns // USUAL_COLUMNS, 1)
            hypotheses = propose_slots(Stripes(_strips(unknown, profiles, every)))
        for hypothesis in hypotheses:
            camera = estimated_camera(hypothesis, screens[0].slot_rate_hz, frame)
            yield from ((s, relabelled_camera(camera, s, frame)) for s in screens if s.columns == n_columns)


def estimated_camera(hypothesis: CameraHypothesis, slot_rate_hz: float, frame: Frame) -> FrameCamera:
    """Camera from an estimate, for slots of a known rate."""
    return FrameCamera(
        profile=None,
        line_delay_s=1 / (hypothesis.rows_per_slot * slot_rate_hz),
        exposure_s=hypothesis.exposure_slots / slot_rate_hz,
        lens=lens_of(hypothesis.curvature, frame.width, frame.height),
        tone=DEFAULT_TONE,
        reversed=hypothesis.reversed,
        estimated=summary(hypothesis, slot_rate_hz),
        hypothesis=hypothesis,
    )


def relabelled_camera(camera: FrameCamera, screen: ScreenProfile, frame: Frame) -> FrameCamera:
    """Convert an estimated camera to the slot rate of a screen, since a picture only shows rows per slot."""
    hypothesis, rate = camera.hypothesis, screen.slot_rate_hz
    if hypothesis is None:
        return camera
    stated = (frame.metadata.exposure_s or 0.0) * rate
    if hypothesis.packet_slots != screen.packet_slots:
        exposure_slots = stated or hypothesis.exposure_slots
        hypothesis = replace(hypothesis, packet_slots=screen.packet_slots, exposure_slots=exposure_slots)
    return estimated_camera(replace(hypothesis, stated_exposure_slots=stated), rate, frame)


def settle(
    context: FrameContext, acquisition: Acquisition, reception: Reception, *, may_bend: bool = True
) -> tuple[FrameCamera, float]:
    """Fit an estimated camera to decoded slots; also return the largest shift of the clock, slots."""
    lit = reception.clock.on_grid(reception.posteriors.lit)
    return settle_slots(context, acquisition, reception.clock, lit, may_bend=may_bend)


def settle_slots(
    context: FrameContext, acquisition: Acquisition, clock: Clock, lit: Float32Array, *, may_bend: bool = True
) -> tuple[FrameCamera, float]:
    """`settle` on the probabilities (C, N) that the slots of a clock are lit."""
    camera, screen, frame = context.camera, acquisition.screen, context.frame
    if camera.hypothesis is None:
        return camera, 0.0
    with context.timer("blind"):
        found, moved_slots = settle_hypothesis(
            _strips(context, acquisition.profiles, may_bend=may_bend),
            camera.hypothesis,
            clock,
            lit,
            screen.light_spread,
        )
    return estimated_camera(found, screen.slot_rate_hz, frame), moved_slots


def _strips(context: FrameContext, profiles: RowProfiles, every: int = 1, *, may_bend: bool = True) -> ColumnStrips:
    """Convert row profiles to strips in order of time, of each `every`-th column; from a mosaic stripes never bend."""
    frame, outlines = context.frame, context.outlines(len(profiles.light))
    x = (outlines.edges_x[1:] + outlines.edges_x[:-1]) / 2
    x = x.reshape(*profiles.light.shape)[::every].reshape(-1, x.shape[1])
    profiles = profiles.of_columns(slice(None, None, every))
    x = x[:, ::-1] if context.camera.reversed else x
    return strips_of(profiles, x, frame.width, frame.height, may_bend=may_bend and frame.mosaic is None)
