"""Cameras that no profile fits: which of several estimates it is, and the estimate once more. Part of the wiring."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.receiver import camera as blind
from rxcli.receiver import channel
from rxcli.receiver.locate import Camera, Failure, Lock, Stages, find_cameras, find_lock, linear_camera, refitted_camera
from rxcli.receiver.still import Reception, decode_likeliest, packet_evidence, quick_look
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
        packets, symbols = _look(frame, corners, *camera, stages)
        if packets > _PACKETS_AT_LEAST and packets + symbols > most:
            best, most = camera, packets + symbols
    if best is None:
        raise Failure("no_signal", found.reason or _NO_HEADERS, found.estimated)
    return best


def _look(
    frame: Frame, corners: FloatArray, camera: Camera, options: ReceiverOptions, stages: Stages
) -> tuple[float, float]:
    """What a quick look says of a camera: evidence of headers and packets, and how sure the symbols are, nats."""
    try:
        lock = find_lock(frame, corners, camera, options, stages, quick=True)
    except Failure:
        return -np.inf, 0.0
    with stages("detect"):
        seen = quick_look(lock)
        packets = float(seen.posteriors.header_llr.sum()) + packet_evidence(seen)
    return packets, _SAY_OF_SYMBOLS * float(seen.posteriors.log_prob.mean())


def with_refitted_camera(
    frame: Frame,
    corners: FloatArray,
    camera: Camera,
    lock: Lock,
    seen: Reception,
    options: ReceiverOptions,
    stages: Stages,
) -> tuple[Camera, Lock, Reception]:
    """The camera that the slots tell, and what is received with it, until that moves the clock no more.

    Where packets show less then, what was received before stays. Values that seem to be light are received as such.
    """
    for _ in range(_MOST_REFITS):
        with stages("blind"):
            lit = channel.lit_on_grid(seen.posteriors, seen.clock)
            camera, moved_slots = refitted_camera(frame, corners, camera, lock, seen.clock, lit)
        if moved_slots < _MATTERS_SLOTS:
            break
        found = _received(frame, corners, camera, seen, options, stages)
        if found is None:
            break
        lock, seen = found
    with stages("blind"):
        lit = channel.lit_on_grid(seen.posteriors, seen.clock)
        linear = linear_camera(frame, corners, camera, lock, seen.clock, lit)
    if linear.tone == camera.tone:
        return linear, lock, seen
    found = _received(frame, corners, linear, seen, options, stages)
    if found is None:
        return camera.without_tone(), lock, seen
    return with_refitted_camera(frame, corners, linear, *found, options, stages)


def _received(
    frame: Frame, corners: FloatArray, camera: Camera, before: Reception, options: ReceiverOptions, stages: Stages
) -> tuple[Lock, Reception] | None:
    """What is received with a camera; None where packets show less than in what was received before."""
    try:
        lock = find_lock(frame, corners, camera, options, stages, quick=True)
    except Failure:
        return None
    with stages("detect"):
        seen = decode_likeliest(lock, options.skip)
    return (lock, seen) if packet_evidence(seen) >= _KEPT_EVIDENCE * packet_evidence(before) else None


def without_estimate(result: FrameResult, camera: Camera, seen: Reception) -> FrameResult:
    """A result without packets, the camera's estimate taken out where neither packets nor edges bear it out."""
    if camera.guess is None or packet_evidence(seen) >= _PACKETS_IF_NONE_RECEIVED:
        return result
    estimate, strips = camera.guess
    if blind.by_edges(strips, [estimate]):
        return result
    return replace(result, line_delay_s=None, exposure_s=None, estimated={}, message=_NO_HEADERS)
