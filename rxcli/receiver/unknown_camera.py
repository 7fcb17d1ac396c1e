"""Cameras that no profile fits: which of several estimates it is, and the estimate once more. Part of the wiring."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.receiver import camera as blind
from rxcli.receiver.acquisition import Acquisition
from rxcli.receiver.cameras import find_cameras, refitted_camera
from rxcli.receiver.context import Camera, Failure, FrameContext, Timer
from rxcli.receiver.reception import Reception, packet_llr
from rxcli.receiver.screen_choice import quick_look
from rxcli.receiver.settings import SETTINGS
from rxcli.receiver.still import decode_likeliest, initial_pass
from rxcli.types import Clock, Float32Array, FloatArray, Frame, FrameResult

_NO_HEADERS = (
    "there are stripes but no packet header where it should be; the screen may show less than one packet (move "
    "closer), the picture may be merged from several exposures (switch HDR off), or the screen is none of those tried"
)


@dataclass(frozen=True, slots=True)
class Received:
    """What was received of a frame with a camera."""

    context: FrameContext
    acquisition: Acquisition
    reception: Reception


def likely_camera(frame: Frame, corners: FloatArray, options: ReceiverOptions, timer: Timer) -> FrameContext | Failure:
    """The frame with its camera, known or estimated, and the screens that remain.

    Several estimates differ in the length of their packets: the one whose initial pass looks most like packets is it.
    """
    found = find_cameras(frame, corners, options, timer, shows_packets)
    candidates = [found.first, *found.rivals] if found.first else list(found.rivals)
    if not candidates:
        return Failure("no_signal", found.reason or _NO_HEADERS, found.estimated)
    return candidates[0] if len(candidates) == 1 else max(candidates, key=_initial_evidence)


def shows_packets(context: FrameContext) -> bool:
    """Whether an initial pass shows packets beyond doubt."""
    return _initial_evidence(context) > SETTINGS.plain_packets


def _initial_evidence(context: FrameContext) -> float:
    """Log-likelihood ratio of headers and packets in an initial pass with a camera."""
    acquisition = quick_look(context)
    if isinstance(acquisition, Failure):
        return -np.inf
    with context.timer("detect"):
        reception = initial_pass(acquisition)
        return float(reception.posteriors.header_llr.sum()) + packet_llr(reception)


def receive_unknown(context: FrameContext, acquisition: Acquisition, skip: frozenset[str]) -> Received:
    """Receive a frame with an estimated camera and refine the camera's parameters from the decoded slots."""
    with context.timer("detect"):
        reception = decode_likeliest(acquisition, skip)
    received = Received(context, acquisition, reception)
    with context.timer("blind"):
        camera, _ = refitted_camera(*_decided(received))
    return replace(received, context=replace(context, camera=camera))


def _decided(received: Received) -> tuple[FrameContext, Acquisition, Clock, Float32Array]:
    """Frame, acquisition, clock, and the probability (C, N) that each slot is lit."""
    clock = received.reception.clock
    return received.context, received.acquisition, clock, clock.on_grid(received.reception.posteriors.lit)


def packets_are_plain(reception: Reception) -> bool:
    """Whether packets show beyond doubt."""
    return packet_llr(reception) >= SETTINGS.plain_packets


def without_estimate(result: FrameResult, camera: Camera, reception: Reception) -> FrameResult:
    """A result without packets, the camera's estimate taken out where neither packets nor edges bear it out."""
    if camera.blind_estimate is None or packet_llr(reception) >= SETTINGS.some_packets:
        return result
    estimate, strips = camera.blind_estimate
    if blind.by_edges(strips, [estimate]):
        return result
    return replace(result, line_delay_s=None, exposure_s=None, estimated={}, message=_NO_HEADERS)
