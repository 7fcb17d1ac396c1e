"""Other ways to read a photograph that gives few packets: with an estimated camera, and turned by 90 degrees."""

from collections.abc import Callable
from dataclasses import replace

from rxcli.options import ReceiverOptions
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.camera import FrameCamera
from rxcli.receiver.frame.result import Failure, Received, failed, is_received
from rxcli.receiver.plane import orientation
from rxcli.receiver.search.cameras import known_camera
from rxcli.receiver.search.outlines import ON_ITS_SIDE, lean_on_its_side, unreadable_orientation
from rxcli.receiver.search.refusal import STEADY_LIGHT, likeliest_reason
from rxcli.receiver.search.settings import SETTINGS
from rxcli.types import FrameResult

_UPSIDE_DOWN = (
    "the rows run against the readout, as in a picture that was turned upside down or mirrored after it was taken; "
    "columns count from the left of the stored picture"
)
_AS_STORED = (
    "the file asks to be turned by 90 degrees, but the columns stand upright in the stored picture; they are counted "
    "from its left"
)
#: Relative difference of line delays up to which an estimate agrees with a profile.
_SAME_LINE_DELAY = 0.01
#: Receives a photograph as it is.
_Receive = Callable[[FrameCache, ReceiverOptions], Received]


def receive_either_way(cache: FrameCache, options: ReceiverOptions, receive: _Receive) -> Received:
    """Receive a frame as it is stored; without packets, also turned by 90 degrees if its columns lie along its rows."""
    frame, asks_for_turn = cache.frame, cache.frame.metadata.orientation in orientation.PORTRAIT
    upright = cache.with_metadata(replace(frame.metadata, orientation=1)) if asks_for_turn else cache
    received = _receive_stated(upright, options, receive)
    if received.n_believable:
        remark = _UPSIDE_DOWN if _is_reversed(received.result) else _AS_STORED if asks_for_turn else None
        return received.with_remark(remark)
    if options.corners is not None or received.result.message == STEADY_LIGHT:
        return received
    lean = lean_on_its_side(upright, options)
    if not lean:
        return received.with_message(likeliest_reason(frame, received.result, options))
    attempts = []
    for quarter_turns in orientation.QUARTER_TURNS if lean < 0 else ():
        back = orientation.turned_frame(frame, quarter_turns)
        attempt = receive(FrameCache(back, cache.timer).in_blinking_colours(), options)
        result = orientation.as_stored(back, attempt.result, quarter_turns)
        if not _gives_few(result):
            rank = not _is_reversed(result), attempt.n_believable, quarter_turns
            attempts.append((rank, attempt._replace(result=result)))
    if attempts:
        (*_, quarter_turns), best = max(attempts, key=lambda attempt: attempt[0])
        return best.with_remark(orientation.remark(quarter_turns))
    failure = unreadable_orientation(frame) or Failure("no_screen", f"no screen found: {ON_ITS_SIDE}")
    return Received(failed(FrameResult(frame.source, frame.index, frame.time_s, "ok"), failure), {})


def _receive_stated(cache: FrameCache, options: ReceiverOptions, receive: _Receive) -> Received:
    """Receive a frame as its profile states the camera; where few columns give packets, also as it is estimated."""
    stated, known = receive(cache, options), known_camera(cache.frame, options)
    if known is None or not _gives_few(stated.result):
        return stated
    estimated = receive(cache, replace(options, cameras=(), force_camera=False))
    # One packet is no evidence that what was stated is wrong.
    if estimated.n_believable <= max(stated.n_believable, 1) or not _is_credible(estimated.result, known):
        return stated
    return estimated.with_remark(known.message if isinstance(known, Failure) else _difference(known, stated, estimated))


def _gives_few(result: FrameResult) -> bool:
    """Whether less than half of the lit columns gave a packet."""
    lit = [column for column in result.columns if column.status != "dark"]
    n_received = sum(any(is_received(packet, result) for packet in column.packets) for column in lit)
    return 2 * n_received < max(len(lit), 1)


def _is_reversed(result: FrameResult) -> bool:
    return result.estimated.get("readout_reversed", (0.0, 0.0))[0] > 0


def _is_credible(estimated: FrameResult, known: FrameCamera | Failure) -> bool:
    """Whether a result with an estimated camera outweighs a profile; one that contradicts it needs sure packets.

    Under a screen that is not the one in the picture, an estimate of the camera may fit what a profile rules out.
    """
    line_delay_s = estimated.line_delay_s
    if isinstance(known, Failure) or line_delay_s is None:
        return True
    if abs(line_delay_s / known.line_delay_s - 1) < _SAME_LINE_DELAY:
        return True
    lit = [column for column in estimated.columns if column.status != "dark"]
    n_sure = sum(any(p.confidence > SETTINGS.sure_certainty for p in column.packets) for column in lit)
    return 2 * n_sure > len(lit)


def _difference(known: FrameCamera, stated: Received, estimated: Received) -> str:
    """Message of a result with an estimated camera in place of that of a profile."""
    return (
        f"camera profile {known.profile} ({1e6 * known.line_delay_s:.3f} us a row) gave {stated.n_believable} packets, "
        f"an estimate ({1e6 * (estimated.result.line_delay_s or 0.0):.3f} us a row) {estimated.n_believable}, "
        "which are reported; leave out or replace that profile"
    )
