"""Cameras that no profile describes: choose among hypotheses, fit the chosen one to its slots. Part of the wiring."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from rxcli.options import ReceiverOptions
from rxcli.receiver import camera as blind
from rxcli.receiver.acquisition import Acquisition
from rxcli.receiver.cameras import known_camera
from rxcli.receiver.context import DEFAULT_TONE, Camera, Failure, FrameContext, Timer
from rxcli.receiver.reception import Reception, column_llr, packet_llr
from rxcli.receiver.sampling import is_coded
from rxcli.receiver.screen import geometry
from rxcli.receiver.screen_choice import quick_look, quick_sampler
from rxcli.receiver.settings import SETTINGS
from rxcli.receiver.still import decode_likeliest, initial_pass
from rxcli.types import FloatArray, Frame, RowProfiles


@dataclass(frozen=True, slots=True)
class Received:
    """What was received of a frame with a camera."""

    context: FrameContext
    acquisition: Acquisition
    reception: Reception


def likely_camera(frame: Frame, corners: FloatArray, options: ReceiverOptions, timer: Timer) -> FrameContext | Failure:
    """The frame with its camera, from a profile or estimated, and the screens that it may show.

    Hypotheses have an initial pass each, best first, until one shows packets plainly. Where none does, the best one is
    fitted to its slots once; if it shows next to nothing then, there is none.
    """
    known = known_camera(frame, options)
    if isinstance(known, Failure):
        return known
    if known is not None:
        return FrameContext(frame, corners, known, options.screens, timer)
    unknown = Camera(None, float("nan"), float("nan"), None, DEFAULT_TONE)
    context = FrameContext(frame, corners, unknown, options.screens, timer)
    profiles = quick_sampler(context).profiles
    with timer("blind"):
        strips = _strips(context, profiles)
    best, evidence = None, 0.0
    for hypothesis in _proposed(context, strips):
        received = _received(_with_hypothesis(context, hypothesis))
        if received is not None and (own := log_evidence(received.reception)) > evidence:
            best, evidence = received, own
        if evidence > SETTINGS.beyond_doubt:
            break
    if best is not None and SETTINGS.some_packets < evidence < SETTINGS.plain_packets:
        best, _ = _settled_once(best)
        evidence = log_evidence(best.reception)
    if best is None or evidence < SETTINGS.few_packets:
        return Failure("no_signal", blind.why_not(strips))
    return best.context


def _proposed(context: FrameContext, strips: blind.Strips) -> Iterator[blind.CameraHypothesis]:
    """Hypotheses of a frame's camera, best first; time is counted as they are asked for."""
    frame = context.frame
    may_bend = frame.mosaic is None
    found = blind.propose(strips, context.screens, frame.metadata.exposure_s, may_bend=may_bend)
    while True:
        with context.timer("blind"):
            hypothesis = next(found, None)
        if hypothesis is None:
            return
        yield hypothesis


def log_evidence(reception: Reception) -> float:
    """Log-likelihood ratio of packets and headers over slots of any kind, for a screen of twenty columns.

    Narrow columns show the same light several times.
    """
    headers = max(float(reception.posteriors.header_llr.sum()), 0.0)
    return 20 / column_llr(reception).size * (packet_llr(reception) + SETTINGS.headers_alone * headers)


def receive_unknown(context: FrameContext, acquisition: Acquisition, skip: frozenset[str]) -> Received:
    """Receive a frame with an estimated camera, fitted to the slots of initial passes first, and to decoded ones last.

    Where packets show plainly on an initial pass, decoding again with that last fit shows no more of them.
    """
    received = settled(context, acquisition)
    plain = packets_are_plain(received.reception)
    with context.timer("detect"):
        received = replace(received, reception=decode_likeliest(received.acquisition, skip))
    if plain:
        camera, _ = settle(received.context, received.acquisition, received.reception)
        return replace(received, context=replace(received.context, camera=camera))
    return _settled_once(received, lambda acquisition: decode_likeliest(acquisition, skip))[0]


def settled(context: FrameContext, acquisition: Acquisition) -> Received:
    """An initial pass with an estimated camera, and the camera fitted to its slots until it moves no more."""
    with context.timer("detect"):
        received = Received(context, acquisition, initial_pass(acquisition))
    for _ in range(SETTINGS.max_fits):
        received, moves = _settled_once(received)
        if not moves:
            break
    return _as_light(received)


def _settled_once(
    received: Received, receive: Callable[[Acquisition], Reception] = initial_pass
) -> tuple[Received, bool]:
    """The camera fitted to decoded slots; and whether that matters, so that the frame was received with it again."""
    camera, moved_slots = settle(received.context, received.acquisition, received.reception)
    fitted = replace(received.context, camera=camera)
    if moved_slots < SETTINGS.matters_slots:
        return replace(received, context=fitted), False
    again = _received(fitted, receive)
    # A fit under which packets show less was of wrong slots.
    kept = again is not None and packet_llr(again.reception) >= SETTINGS.kept_evidence * packet_llr(received.reception)
    return (again, True) if again and kept else (received, False)


def settle(context: FrameContext, acquisition: Acquisition, reception: Reception) -> tuple[Camera, float]:
    """An estimated camera fitted to decoded slots; and how far that moves the clock anywhere, slots."""
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
            tone=None if frame.mosaic is not None or frame.linear else camera.tone,
        )
    return _camera(found, screen.slot_rate_hz, frame, camera.tone), moved_slots


def _as_light(received: Received) -> Received:
    """With values taken for light where they seem to be, and packets show as well then."""
    context = received.context
    hypothesis = context.camera.hypothesis
    if hypothesis is None or not blind.is_linear(hypothesis.tone) or not is_coded(context.frame):
        return received
    again = _received(replace(context, camera=replace(context.camera, tone="linear")))
    if again is None or packet_llr(again.reception) < packet_llr(received.reception):
        return replace(received, context=replace(context, camera=context.camera.without_tone()))
    return _settled_once(again)[0]


def _received(context: FrameContext, receive: Callable[[Acquisition], Reception] = initial_pass) -> Received | None:
    """An initial pass, or another, over a frame; None where no clock is found."""
    acquisition = quick_look(context)
    if isinstance(acquisition, Failure):
        return None
    with context.timer("detect"):
        return Received(context, acquisition, receive(acquisition))


def _strips(context: FrameContext, profiles: RowProfiles) -> blind.Strips:
    """Strips from row profiles in the order of time."""
    frame, (n_columns, n_strips, _) = context.frame, profiles.light.shape
    lens = context.camera.lens
    outlines = geometry.column_outlines(
        context.corners,
        n_columns,
        n_strips,
        frame.width,
        frame.height,
        None if lens is None or lens.corrected else lens,
    )
    x = (outlines.edges_x[1:] + outlines.edges_x[:-1]) / 2
    return blind.strips_of(profiles, x[:, ::-1] if context.camera.reversed else x, frame.width, frame.height)


def _with_hypothesis(context: FrameContext, hypothesis: blind.CameraHypothesis) -> FrameContext:
    """The frame with an estimated camera and the screens that it may show then."""
    alike = [screen for screen in context.screens if screen.packet_slots == hypothesis.packet_slots]
    rate = alike[0].slot_rate_hz
    screens = tuple(screen for screen in alike if screen.slot_rate_hz == rate)
    return replace(context, camera=_camera(hypothesis, rate, context.frame, context.camera.tone), screens=screens)


def _camera(hypothesis: blind.CameraHypothesis, slot_rate_hz: float, frame: Frame, tone: str) -> Camera:
    return Camera(
        profile=None,
        line_delay_s=1 / (hypothesis.rows_per_slot * slot_rate_hz),
        exposure_s=hypothesis.exposure_slots / slot_rate_hz,
        lens=blind.lens_of(hypothesis.curvature, frame.width, frame.height, corrected=hypothesis.corrected),
        tone=tone,
        reversed=hypothesis.reversed,
        estimated=blind.summary(hypothesis, slot_rate_hz),
        hypothesis=hypothesis,
    )


def packets_are_plain(reception: Reception) -> bool:
    """Whether packets show beyond doubt, on a clock that nothing in the picture was asked for."""
    return packet_llr(reception) >= SETTINGS.plain_packets
