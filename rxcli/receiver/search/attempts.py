"""Other ways to read a photograph that gives few packets: with an estimated camera, and turned by 90 degrees."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from math import inf, log
from typing import Any

from rxcli.options import ReceiverOptions
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.camera import FrameCamera
from rxcli.receiver.frame.result import Failure, Received, failed, is_received
from rxcli.receiver.light import LONG_EXPOSURE_SLOTS
from rxcli.receiver.plane import orientation
from rxcli.receiver.search.cameras import known_camera
from rxcli.receiver.search.outlines import may_be_turned
from rxcli.receiver.search.refusal import likeliest_reason
from rxcli.receiver.search.settings import SETTINGS
from rxcli.types import Frame, FrameResult, Reason, Remark

#: Relative difference of line delays up to which an estimate agrees with a profile, and confidence of a sure packet.
_SAME_LINE_DELAY, _SURE = 0.01, SETTINGS.sure_certainty
#: Packets of a long exposure that show that it was stated rightly.
_PLAIN_LONG = 4
#: Receives a photograph as it is, if a screen has evidence of packets of more than a least.
_Receive = Callable[[FrameCache, ReceiverOptions, float], Received]


def receive_either_way(cache: FrameCache, options: ReceiverOptions, receive: _Receive) -> Received:
    """Receive a frame as it is stored; without packets, also turned by 90 degrees if its columns lie along its rows."""
    frame, asks_for_turn = cache.frame, cache.frame.metadata.orientation in orientation.PORTRAIT
    upright = cache.with_metadata(replace(frame.metadata, orientation=1)) if asks_for_turn else cache
    received = _receive_stated(upright, options, receive)
    if received.n_believable:
        reason: Reason = "upside_down" if _is_reversed(received.result) else "as_stored"
        return received.with_remark(Remark(reason) if reason == "upside_down" or asks_for_turn else None)
    if options.corners is not None or received.result.reason == "steady_light":
        return received
    attempts = []
    for quarter_turns in orientation.QUARTER_TURNS if may_be_turned(upright, options) else ():
        back = orientation.turned_frame(frame, quarter_turns)
        attempt = receive(FrameCache(back, cache.timer).in_blinking_colours(), options, -inf)
        result = orientation.as_stored(back, attempt.result, quarter_turns)
        if not _gives_few(result):
            rank = not _is_reversed(result), attempt.n_believable, quarter_turns
            attempts.append((rank, attempt._replace(result=result)))
    if attempts:
        (*_, quarter_turns), best = max(attempts, key=lambda attempt: attempt[0])
        return best.with_remark(Remark("turned_counterclockwise" if quarter_turns == 1 else "turned_clockwise"))
    remarks = likeliest_reason(cache, received.result, options)
    if remarks and remarks[0].reason in ("portrait", "on_its_side"):
        # Packets that are not believable are none then.
        nothing = FrameResult(frame.source, frame.index, frame.time_s, "ok")
        return Received(failed(nothing, Failure(remarks[0], "no_screen")), {})
    return received.with_remarks(*remarks)


def _receive_stated(cache: FrameCache, options: ReceiverOptions, receive: _Receive) -> Received:
    """Receive a frame as profile and file state its camera; where few columns give packets, also as it is estimated."""
    best = stated = received = receive(cache, options, -inf)
    evidence = max((step.evidence for step in stated.result.search), default=0.0)
    for attempt, estimating in _with_estimates(cache, options):
        is_plain = best.n_believable >= _PLAIN_LONG and _is_long(best.result, cache.frame, options)
        is_plain |= sum(packet.confidence >= _SURE for packet in best.result.packets) > 1 and evidence > SETTINGS.plain
        # Without a hypothesis of the camera its exposure did not count.
        if not _gives_few(best.result) or is_plain or (attempt is not cache and not received.result.search):
            break
        received = receive(attempt, estimating, evidence)
        # One packet is no evidence that what was stated is wrong.
        if received.n_believable > max(best.n_believable, 1) and _is_credible(received.result, cache.frame, options):
            remark = _difference(cache.frame, options, stated, received, is_exposure=attempt is not cache)
            best = received.with_remark(remark)
    return best


def _is_long(result: FrameResult, frame: Frame, options: ReceiverOptions) -> bool:
    """Whether the stated exposure lasts several slots of the screen, so that few packets are as many as expected."""
    rate_hz = next((screen.slot_rate_hz for screen in options.screens if screen.name == result.screen_profile), 0.0)
    return (frame.metadata.exposure_s or 0.0) * rate_hz > LONG_EXPOSURE_SLOTS


def _gives_few(result: FrameResult) -> bool:
    """Whether less than half of the lit columns gave a packet."""
    lit = [column for column in result.columns if column.status != "dark"]
    n_received = sum(any(is_received(packet, result) for packet in column.packets) for column in lit)
    return 2 * n_received < max(len(lit), 1)


def _is_reversed(result: FrameResult) -> bool:
    return result.estimated.get("readout_reversed", (0.0, 0.0))[0] > 0


def _with_estimates(cache: FrameCache, options: ReceiverOptions) -> Iterator[tuple[FrameCache, ReceiverOptions]]:
    """The frame without its camera profile, then without its stated exposure as well: both are estimated."""
    frame, estimated = cache.frame, replace(options, cameras=(), force_camera=False)
    if known_camera(frame, options) is not None:
        yield cache, estimated
    if frame.metadata.exposure_s is not None:
        yield cache.with_metadata(replace(frame.metadata, exposure_s=None)), estimated


def _is_credible(estimated: FrameResult, frame: Frame, options: ReceiverOptions) -> bool:
    """Whether a result with an estimated camera outweighs what is stated; one that contradicts it needs sure packets.

    Under a screen that is not the one in the picture, an estimate of the camera may fit what a profile rules out.
    """
    known, line_delay_s = known_camera(frame, options), estimated.line_delay_s
    is_same = True
    if isinstance(known, FrameCamera) and line_delay_s is not None:
        is_same = abs(line_delay_s / known.line_delay_s - 1) < _SAME_LINE_DELAY
    if is_same and not _is_exposure_of_another(estimated, frame, options):
        return True
    lit = [column for column in estimated.columns if column.status != "dark"]
    n_sure = sum(any(p.confidence > _SURE for p in column.packets) for column in lit)
    return 2 * n_sure > len(lit)


def _is_exposure_of_another(estimated: FrameResult, frame: Frame, options: ReceiverOptions) -> bool:
    """Whether the exposure that the file states lasts as many slots of another screen as the light shows."""
    rates = {screen.name: screen.slot_rate_hz for screen in options.screens}
    own, stated_s, found_s = rates.get(estimated.screen_profile or ""), frame.metadata.exposure_s, estimated.exposure_s
    if not own or not stated_s or not found_s:
        return False
    off = {rate: abs(log(found_s * own / (stated_s * rate))) for rate in rates.values()}
    return min(off, key=off.__getitem__) != own


def _difference(
    frame: Frame, options: ReceiverOptions, stated: Received, estimated: Received, *, is_exposure: bool
) -> Remark:
    """Remark on a result with an estimated camera: what was stated, and what was estimated.

    Args:
        frame: the picture.
        options: those with the stated camera.
        stated: result with the stated camera.
        estimated: result with the estimate.
        is_exposure: whether the exposure was estimated as well.
    """
    known, found = known_camera(frame, options), estimated.result
    if isinstance(known, Failure):
        return known.remark
    facts: dict[str, Any] = {"n_stated": stated.n_believable, "n_estimated": estimated.n_believable}
    facts |= {"stated_s": frame.metadata.exposure_s or 0.0, "exposure_s": found.exposure_s or 0.0}
    if known is None:
        return Remark("other_exposure", facts)
    facts |= {"profile": known.profile, "profile_s": known.line_delay_s, "line_delay_s": found.line_delay_s or 0.0}
    return Remark("other_camera_and_exposure" if is_exposure else "other_camera", facts)
