"""Cameras that no profile fits: which of several estimates it is, and the estimate once more. Part of the wiring."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.receiver import camera as blind
from rxcli.receiver import channel
from rxcli.receiver.locate import (
    Acquisition,
    Camera,
    Failure,
    Stages,
    acquire,
    find_cameras,
    linear_camera,
    refitted_camera,
)
from rxcli.receiver.still import Reception, decode_likeliest, initial_pass, packet_llr
from rxcli.types import FloatArray, Frame, FrameResult

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


def likely_camera(
    frame: Frame, corners: FloatArray, options: ReceiverOptions, stages: Stages
) -> tuple[Camera, ReceiverOptions]:
    """The camera, known or estimated, and the options with the screens that remain.

    Where several estimates are left, each has a quick look: the one under which headers, packets and
    symbols show best is it, and without packets none, unless the first is beyond doubt.
    """
    found = find_cameras(frame, corners, options, stages)
    if found.first is not None and not found.rivals:
        return found.first
    best, most = found.first if found.sure else None, -np.inf
    for camera in ([found.first] if found.first else []) + list(found.rivals):
        packets, symbols = _quick_evidence(frame, corners, *camera, stages)
        if packets > _PACKETS_AT_LEAST and packets + symbols > most:
            best, most = camera, packets + symbols
    if best is None:
        raise Failure("no_signal", found.reason or _NO_HEADERS, found.estimated)
    return best


def _quick_evidence(
    frame: Frame, corners: FloatArray, camera: Camera, options: ReceiverOptions, stages: Stages
) -> tuple[float, float]:
    """What a quick look says of a camera: evidence of headers and packets, and how sure the symbols are, nats."""
    try:
        acquisition = acquire(frame, corners, camera, options, stages, quick=True)
    except Failure:
        return -np.inf, 0.0
    with stages("detect"):
        reception = initial_pass(acquisition)
        packets = float(reception.posteriors.header_llr.sum()) + packet_llr(reception)
    return packets, _SAY_OF_SYMBOLS * float(reception.posteriors.log_prob.mean())


def with_refitted_camera(
    frame: Frame,
    corners: FloatArray,
    camera: Camera,
    acquisition: Acquisition,
    reception: Reception,
    options: ReceiverOptions,
    stages: Stages,
) -> tuple[Camera, Acquisition, Reception]:
    """The camera that the slots tell, and what is received with it, until that moves the clock no more.

    Where packets show less then, what was received before stays. Values that seem to be light are received as such.
    """
    for _ in range(_MOST_REFITS):
        with stages("blind"):
            lit = channel.lit_on_grid(reception.posteriors, reception.clock)
            camera, moved_slots = refitted_camera(frame, corners, camera, acquisition, reception.clock, lit)
        if moved_slots < _MATTERS_SLOTS:
            break
        found = _received(frame, corners, camera, reception, options, stages)
        if found is None:
            break
        acquisition, reception = found
    with stages("blind"):
        lit = channel.lit_on_grid(reception.posteriors, reception.clock)
        linear = linear_camera(frame, corners, camera, acquisition, reception.clock, lit)
    if linear.tone == camera.tone:
        return linear, acquisition, reception
    found = _received(frame, corners, linear, reception, options, stages)
    if found is None:
        return camera.without_tone(), acquisition, reception
    return with_refitted_camera(frame, corners, linear, *found, options, stages)


def _received(
    frame: Frame, corners: FloatArray, camera: Camera, before: Reception, options: ReceiverOptions, stages: Stages
) -> tuple[Acquisition, Reception] | None:
    """What is received with a camera; None where packets show less than in what was received before."""
    try:
        acquisition = acquire(frame, corners, camera, options, stages, quick=True)
    except Failure:
        return None
    with stages("detect"):
        reception = decode_likeliest(acquisition, options.skip)
    return (acquisition, reception) if packet_llr(reception) >= _KEPT_EVIDENCE * packet_llr(before) else None


def without_estimate(result: FrameResult, camera: Camera, reception: Reception) -> FrameResult:
    """A result without packets, the camera's estimate taken out where neither packets nor edges bear it out."""
    if camera.blind_estimate is None or packet_llr(reception) >= _PACKETS_IF_NONE_RECEIVED:
        return result
    estimate, strips = camera.blind_estimate
    if blind.by_edges(strips, [estimate]):
        return result
    return replace(result, line_delay_s=None, exposure_s=None, estimated={}, message=_NO_HEADERS)
