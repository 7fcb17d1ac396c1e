"""Cameras that no profile fits: which of several estimates it is, and the estimate once more. Part of the wiring."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.receiver import camera as blind
from rxcli.receiver.acquisition import Acquisition
from rxcli.receiver.cameras import find_cameras, linear_camera, refitted_camera
from rxcli.receiver.context import Camera, Failure, FrameContext, Timer
from rxcli.receiver.reception import Reception, packet_llr
from rxcli.receiver.screen_choice import quick_look
from rxcli.receiver.settings import SETTINGS
from rxcli.receiver.still import decode_alike, decode_likeliest, initial_pass
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


def likely_camera(
    frame: Frame, corners: FloatArray, options: ReceiverOptions, timer: Timer, *, periods: blind.Periods = "all"
) -> FrameContext | Failure:
    """The frame with its camera, known or estimated, and the screens that remain.

    Where several estimates are left, they have initial passes by turns until one shows packets plainly: the one under
    which headers, packets and symbols show best is it, and without packets none, unless the first is beyond doubt.
    For `periods` see `camera.estimate_camera`.
    """
    found = find_cameras(frame, corners, options, timer, shows_packets, periods=periods)
    if found.first is not None and not found.rivals:
        return found.first
    best, most = found.first if found.sure else None, -np.inf
    plain: FrameContext | None = None
    for candidate in _of_different_clocks([*([found.first] if found.first else []), *found.rivals]):
        if plain is not None and not _may_be_of_shorter_packets(candidate, plain):
            continue
        packets, symbols = _initial_evidence(candidate)
        if packets > SETTINGS.headers_and_packets and packets + symbols > most:
            best, most = candidate, packets + symbols
        if packets > SETTINGS.plain_packets and plain is None:
            plain = candidate
    return best or Failure("no_signal", found.reason or _NO_HEADERS, found.estimated)


def _of_different_clocks(candidates: list[FrameContext]) -> list[FrameContext]:
    """The candidates without those whose clock is that of one before: a refit moves them to the same one."""
    chosen: list[FrameContext] = []
    for candidate in candidates:
        if not any(_same_clock(candidate, one) and _length(candidate) == _length(one) for one in chosen):
            chosen.append(candidate)
    return chosen


def _same_clock(one: FrameContext, other: FrameContext) -> bool:
    delays = [_line_delay_slots(context) for context in (one, other)]
    return abs(np.log(delays[0] / delays[1])) < SETTINGS.same_period and one.camera.reversed == other.camera.reversed


def _line_delay_slots(context: FrameContext) -> float:
    return context.camera.line_delay_s * context.screens[0].slot_rate_hz


def _length(context: FrameContext) -> int:
    return context.screens[0].packet_slots


def _may_be_of_shorter_packets(candidate: FrameContext, plain: FrameContext) -> bool:
    """Whether a candidate has shorter packets on the same clock: a second header may stand among longer ones' words."""
    return _same_clock(candidate, plain) and _length(candidate) < _length(plain)


def _initial_evidence(context: FrameContext) -> tuple[float, float]:
    """What an initial pass says of a camera: evidence of headers and packets, and how sure symbols are; nats."""
    if "evidence" not in context.kept:
        context.kept["evidence"] = _evidence_of(quick_look(context), context.timer)
    kept: tuple[float, float] = context.kept["evidence"]
    return kept


def _evidence_of(acquisition: Acquisition | Failure, timer: Timer) -> tuple[float, float]:
    if isinstance(acquisition, Failure):
        return -np.inf, 0.0
    with timer("detect"):
        reception = initial_pass(acquisition)
        packets = float(reception.posteriors.header_llr.sum()) + packet_llr(reception)
    return packets, SETTINGS.say_of_symbols * float(reception.posteriors.log_prob.mean())


def shows_packets(context: FrameContext) -> bool:
    """Whether packets show with a camera beyond doubt."""
    return _initial_evidence(context)[0] > SETTINGS.plain_packets


def receive_unknown(context: FrameContext, acquisition: Acquisition, skip: frozenset[str]) -> Received:
    """What is received of a frame whose camera was estimated, and the camera as decoded slots tell it."""
    with context.timer("detect"):
        first = Received(context, acquisition, initial_pass(acquisition))
    settled = _with_settled_clock(first)
    with context.timer("detect"):
        reception = decode_likeliest(settled.acquisition, skip)
    received = replace(settled, reception=reception)
    if _slots_changed(settled, received):
        received = _with_told_camera(received, skip, again=not packets_are_plain(settled.reception))
    return _as_light(received, skip)


def _with_told_camera(received: Received, skip: frozenset[str], *, again: bool) -> Received:
    """The camera that decoded slots tell, and what is decoded `again` with it where that moves the clock.

    Where packets showed plainly on an initial pass, to decode again shows no more of them.
    """
    with received.context.timer("blind"):
        camera, moved_slots = refitted_camera(*_decided(received))
    received = _with_camera(received, camera)
    if not again or moved_slots < SETTINGS.matters_slots[1]:
        return received
    return _decoded_again(received, skip) or received


def _decoded_again(received: Received, skip: frozenset[str]) -> Received | None:
    return _received_again(received, lambda acquisition: decode_alike(acquisition, skip, received.reception))


def _with_settled_clock(received: Received) -> Received:
    """The camera that the slots of an initial pass tell, until that moves the clock no more."""
    for _ in range(SETTINGS.most_initial_refits):
        with received.context.timer("blind"):
            camera, moved_slots = refitted_camera(*_decided(received))
        received = _with_camera(received, camera)
        if moved_slots < SETTINGS.matters_slots[not packets_are_plain(received.reception)]:
            break
        before, again = received, _received_again(received)
        if again is None:
            break
        received = again
        if not _slots_changed(before, again):
            break
    return received


def _slots_changed(before: Received, after: Received) -> bool:
    """Whether slots were decided otherwise than before, so that they may tell another camera."""
    lit = [one.reception.clock.on_grid(one.reception.posteriors.lit) for one in (before, after)]
    return lit[0].shape != lit[1].shape or float(np.abs(lit[0] - lit[1]).mean()) > SETTINGS.same_slots


def _as_light(received: Received, skip: frozenset[str]) -> Received:
    """Values that seem to be light as such, where packets show as well then."""
    with received.context.timer("blind"):
        linear = linear_camera(*_decided(received))
    if linear.tone == received.context.camera.tone:
        return _with_camera(received, linear)
    again = _decoded_again(_with_camera(received, linear), skip)
    if again is None:
        return _with_camera(received, received.context.camera.without_tone())
    return _with_told_camera(again, skip, again=False)


def _decided(received: Received) -> tuple[FrameContext, Acquisition, Clock, Float32Array]:
    """Frame, acquisition, clock, and the probability (C, N) that each slot is lit."""
    clock = received.reception.clock
    return received.context, received.acquisition, clock, clock.on_grid(received.reception.posteriors.lit)


def _with_camera(received: Received, camera: Camera) -> Received:
    return replace(received, context=replace(received.context, camera=camera))


def _received_again(before: Received, receive: Callable[[Acquisition], Reception] = initial_pass) -> Received | None:
    """What is received with a refitted camera; None where packets show less than in what was received before."""
    context = before.context
    acquisition = quick_look(context)
    if isinstance(acquisition, Failure):
        return None
    with context.timer("detect"):
        reception = receive(acquisition)
    kept = packet_llr(reception) >= SETTINGS.kept_evidence * packet_llr(before.reception)
    return Received(context, acquisition, reception) if kept else None


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
