"""Cameras that no profile fits: which of several estimates it is, and the estimate once more. Part of the wiring."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.receiver import camera as blind
from rxcli.receiver import channel
from rxcli.receiver.acquisition import Acquisition, acquire, sample_columns
from rxcli.receiver.cameras import find_cameras, linear_camera, refitted_camera
from rxcli.receiver.context import Camera, Failure, FrameContext, Timer
from rxcli.receiver.still import Reception, decode_likeliest, initial_pass, packet_llr
from rxcli.types import Clock, Float32Array, FloatArray, Frame, FrameResult

#: A refitted camera that moves the clock less than this, slots, anywhere is told but not received with.
_MATTERS_SLOTS = 0.05
_MOST_REFITS = 3
#: What is received with a refitted camera shows packets as well as before from this share of the evidence on.
_KEPT_EVIDENCE = 0.9
#: Headers and packets, all columns together, that an estimate with rivals must show, nats: wrong ones have next to none
#: of one or of the other.
_PACKETS_AT_LEAST = 80.0
#: Packets that an estimate must show under which none is received, nats: wrong ones show less than 10, right ones 80.
_PACKETS_IF_NONE_RECEIVED = 30.0
#: Symbols' mean log probability counts so many times beside the headers: half a packet has headers, but no symbols.
_SAY_OF_SYMBOLS = 40.0
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

    Where several estimates are left, each has an initial pass: the one under which headers, packets and
    symbols show best is it, and without packets none, unless the first is beyond doubt.
    """
    found = find_cameras(frame, corners, options, timer)
    if found.first is not None and not found.rivals:
        return found.first
    best, most = found.first if found.sure else None, -np.inf
    for candidate in ([found.first] if found.first else []) + list(found.rivals):
        packets, symbols = _initial_evidence(candidate)
        if packets > _PACKETS_AT_LEAST and packets + symbols > most:
            best, most = candidate, packets + symbols
    return best or Failure("no_signal", found.reason or _NO_HEADERS, found.estimated)


def _initial_evidence(context: FrameContext) -> tuple[float, float]:
    """What an initial pass says of a camera: evidence of headers and packets, and how sure symbols are; nats."""
    acquisition = acquire(context, sample_columns(context, context.n_columns, quick=True))
    if isinstance(acquisition, Failure):
        return -np.inf, 0.0
    with context.timer("detect"):
        reception = initial_pass(acquisition)
        packets = float(reception.posteriors.header_llr.sum()) + packet_llr(reception)
    return packets, _SAY_OF_SYMBOLS * float(reception.posteriors.log_prob.mean())


def with_refitted_camera(received: Received, skip: frozenset[str]) -> Received:
    """The camera that the slots tell, and what is received with it, until that moves the clock no more.

    Where packets show less then, what was received before stays. Values that seem to be light are received as such.
    """
    for _ in range(_MOST_REFITS):
        with received.context.timer("blind"):
            camera, moved_slots = refitted_camera(*_decided(received))
        received = _with_camera(received, camera)
        if moved_slots < _MATTERS_SLOTS:
            break
        again = _received_again(received, skip)
        if again is None:
            break
        received = again
    with received.context.timer("blind"):
        linear = linear_camera(*_decided(received))
    if linear.tone == received.context.camera.tone:
        return _with_camera(received, linear)
    again = _received_again(_with_camera(received, linear), skip)
    if again is None:
        return _with_camera(received, received.context.camera.without_tone())
    return with_refitted_camera(again, skip)


def _decided(received: Received) -> tuple[FrameContext, Acquisition, Clock, Float32Array]:
    """Frame, acquisition, clock, and the probability (C, N) that each slot is lit."""
    clock = received.reception.clock
    return received.context, received.acquisition, clock, channel.lit_on_grid(received.reception.posteriors, clock)


def _with_camera(received: Received, camera: Camera) -> Received:
    return replace(received, context=replace(received.context, camera=camera))


def _received_again(before: Received, skip: frozenset[str]) -> Received | None:
    """What is received with a refitted camera; None where packets show less than in what was received before."""
    context = before.context
    acquisition = acquire(context, sample_columns(context, context.n_columns, quick=True))
    if isinstance(acquisition, Failure):
        return None
    with context.timer("detect"):
        reception = decode_likeliest(acquisition, skip)
    kept = packet_llr(reception) >= _KEPT_EVIDENCE * packet_llr(before.reception)
    return Received(context, acquisition, reception) if kept else None


def without_estimate(result: FrameResult, camera: Camera, reception: Reception) -> FrameResult:
    """A result without packets, the camera's estimate taken out where neither packets nor edges bear it out."""
    if camera.blind_estimate is None or packet_llr(reception) >= _PACKETS_IF_NONE_RECEIVED:
        return result
    estimate, strips = camera.blind_estimate
    if blind.by_edges(strips, [estimate]):
        return result
    return replace(result, line_delay_s=None, exposure_s=None, estimated={}, message=_NO_HEADERS)
