"""Wiring of the receiver: `receive_frame` reads as the block diagram.

`search` finds the screen, its camera and its clock, `still` alternates light model and detection, and `clip` carries
knowledge from frame to frame.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from itertools import chain
from typing import Any

from rxcli.numerics import one_blas_thread
from rxcli.options import SKIPS, CaeMode, ReceiverOptions
from rxcli.profiles import ScreenProfile
from rxcli.receiver import turned
from rxcli.receiver.acquisition import Acquisition
from rxcli.receiver.cameras import difference, is_credible, with_estimates
from rxcli.receiver.context import Failure, Outline, Timer
from rxcli.receiver.corners import (
    ON_ITS_SIDE,
    lies_on_its_side,
    no_screen,
    proposed_screens,
    too_small,
    unreadable_orientation,
)
from rxcli.receiver.decode import assemble
from rxcli.receiver.reception import Reception, headerless, soft_bits
from rxcli.receiver.search import search
from rxcli.receiver.still import apply_autoencoder, decode_photograph
from rxcli.receiver.sync import clock as sync
from rxcli.results.dump import dump_stages
from rxcli.types import FloatArray, Frame, FrameResult

__all__ = ["SKIPS", "CaeMode", "ReceiverOptions", "failed", "receive", "receive_frame"]


_COUNTED_FROM_LEFT = (
    "no side of the screen is in view: columns are counted from the leftmost visible one; take one side into view to "
    "have the screen's numbers"
)
_UPSIDE_DOWN = (
    "the rows run against the readout, as in a picture that was turned upside down or mirrored after it was taken; "
    "columns count from the left of the stored picture"
)
_AS_STORED = (
    "the file asks to be turned by 90 degrees, but the columns stand upright in the stored picture; they are counted "
    "from its left"
)


def receive(frames: Iterable[Frame], options: ReceiverOptions) -> Iterator[FrameResult]:
    """Receive the frames of one source; yields one result per frame, in order.

    Results of a clip are delayed by some frames, because a packet is reported in the last frame that shows it.
    """
    options = _in_total_order(options)
    with closing(_iterator(frames)) as source:
        frame_0 = next(source, None)
        if frame_0 is None:
            return
        try:
            frame_1 = next(source, None)
        except Exception:
            yield receive_frame(frame_0, options)
            raise
        if frame_1 is None:
            yield receive_frame(frame_0, options)
            return
        from rxcli.receiver.clip import receive_clip

        for result in receive_clip(chain((frame_0, frame_1), source), options):
            yield result.with_columns_mirrored() if options.mirrored else result


def _iterator(frames: Iterable[Frame]) -> Generator[Frame, None, None]:
    """The frames as a generator, whose end also ends theirs: a file is closed when reception is left early."""
    yield from frames


def _in_total_order(options: ReceiverOptions) -> ReceiverOptions:
    """Sort the profiles, so that a result does not depend on their order."""
    screens = sorted(options.screens, key=lambda s: (s.columns, -s.slot_rate_hz, s.packet_slots, s.name))
    cameras = options.cameras if options.force_camera else tuple(sorted(options.cameras, key=lambda c: c.name))
    return replace(options, screens=tuple(screens), cameras=cameras)


def receive_frame(frame: Frame, options: ReceiverOptions) -> FrameResult:
    """Receive one frame as a photograph."""
    timer = Timer()
    with one_blas_thread():
        result = _receive_either_way(frame, _in_total_order(options), timer)
    result = replace(result, message=_with_tried(result, options.screens), timing_ms=timer.total())
    if options.mirrored:
        return result.with_columns_mirrored()
    return replace(result, mirrored=None if frame.metadata.names_front_camera else False)


def _with_tried(result: FrameResult, screens: tuple[ScreenProfile, ...]) -> str | None:
    """Message of a failure; if only one screen was tried, it names that screen."""
    if result.status != "no_signal" or result.message is None or len(screens) != 1:
        return result.message
    return f"{result.message}; only the screen {screens[0].name} was tried (--screen auto tries all)"


def _receive_either_way(frame: Frame, options: ReceiverOptions, timer: Timer) -> FrameResult:
    """Receive a frame as it is stored; without packets, also turned by 90 degrees if its columns lie along its rows."""
    asks_for_turn = frame.metadata.orientation in turned.PORTRAIT
    upright = turned.turned_frame(frame, 0) if asks_for_turn else frame
    result = _receive_stated(upright, options, timer)
    if _n_believable(result):
        remark = _UPSIDE_DOWN if _is_reversed(result) else _AS_STORED if asks_for_turn else None
        return _with_remark(result, remark)
    if options.corners is not None or frame.mosaic is not None or not lies_on_its_side(upright, options, timer):
        return result
    attempts = []
    for quarter_turns in turned.QUARTER_TURNS:
        back = turned.turned_frame(frame, quarter_turns)
        found = turned.as_stored(back, _receive_stated(back, options, timer), quarter_turns)
        attempts.append((_n_believable(found) * (not _is_reversed(found)), _n_believable(found), quarter_turns, found))
    _, n_packets, quarter_turns, found = max(attempts, key=lambda attempt: attempt[:3])
    if n_packets:
        return _with_remark(found, turned.remark(quarter_turns))
    return failed(result, unreadable_orientation(frame) or Failure("no_screen", f"no screen found: {ON_ITS_SIDE}"))


def _receive_stated(frame: Frame, options: ReceiverOptions, timer: Timer) -> FrameResult:
    """Receive a frame as profile and file state its camera; where few columns give packets, also as it is estimated."""
    best = stated = _receive_still(frame, options, timer)
    for attempt, estimating in with_estimates(frame, options):
        if not _gives_few(best):
            break
        result = _receive_still(attempt, replace(estimating, dump_dir=None), timer)
        if _n_believable(result) > _n_believable(best) and is_credible(result, frame, options):
            best = result if options.dump_dir is None else _receive_still(attempt, estimating, timer)
            is_exposure = attempt.metadata.exposure_s != frame.metadata.exposure_s
            best = _with_remark(best, difference(frame, options, stated, best, is_exposure=is_exposure))
    return best


def _gives_few(result: FrameResult) -> bool:
    """Whether less than half of the lit columns gave a packet."""
    lit = [column for column in result.columns if column.status != "dark"]
    return 2 * sum(column.status == "ok" for column in lit) < max(len(lit), 1)


def _is_reversed(result: FrameResult) -> bool:
    return result.estimated.get("readout_reversed", (0.0, 0.0))[0] > 0


def _with_remark(result: FrameResult, remark: str | None) -> FrameResult:
    return replace(result, message="; ".join(filter(None, (remark, result.message))) or None)


def _n_believable(result: FrameResult) -> int:
    return sum(packet.is_believable for packet in result.packets)


def _receive_still(frame: Frame, options: ReceiverOptions, timer: Timer) -> FrameResult:
    """Receive every screen in a frame; the one with the most packets comes first."""
    nothing = FrameResult(frame.source, frame.index, frame.time_s, "ok")
    screens = proposed_screens(frame, options, timer)
    if isinstance(screens, Failure):
        return failed(nothing, screens)
    results = [_receive_screen(frame, outlines, options, timer) for outlines in screens]
    if not screens[0][0].stands_out and not results[0].packets:
        return failed(nothing, no_screen(frame, options, timer))
    results.sort(key=lambda result: -_n_believable(result))
    return replace(results[0], other_screens=tuple(result for result in results[1:] if result.packets))


def _receive_screen(frame: Frame, outlines: list[Outline], options: ReceiverOptions, timer: Timer) -> FrameResult:
    result = FrameResult(frame.source, frame.index, frame.time_s, "ok")
    # Search: where the columns are, what a row is in time, which screen and clock.
    found = search(frame, options, timer, outlines=outlines)
    if isinstance(found, Failure):
        return failed(result, found)
    outline, context, acquisition = found.outline, found.best.context, found.best.acquisition
    camera = context.camera
    # Channel and decode, in turn: metrics of slots to symbols, and symbols to the picture.
    with timer("detect"):
        reception = decode_photograph(acquisition, options.skip, found.best.reception)
    tried = tuple(tried.step for tried in found.tried)
    result = replace(result, **outline.result_fields, **camera.result_fields, search=tried)
    with timer("detect"):
        no_header = headerless(reception)
    with timer("denoise"):
        reception, denoised, report = apply_autoencoder(acquisition, reception, options)
    if options.dump_dir is not None:
        dump_stages(options.dump_dir, frame.source, frame.index, _taps(outline.corners, acquisition, reception))
    # Packets, with the probability that they are right.
    columns = assemble.column_results(
        reception.clock,
        reception.posteriors,
        reception.snr,
        reception.n_observed,
        reception.confidence_features(reception.posteriors, denoised),
        no_header,
        options.min_confidence,
        denoised,
        outline.certainty,
    )
    if camera.reversed:
        columns = tuple(assemble.in_stored_rows(column, frame.height) for column in columns)
    result = replace(
        result,
        screen_profile=acquisition.variant(sync.likely_repeats(reception.clock, acquisition.repeats)).name,
        columns=columns,
        status=assemble.frame_status(columns),
        denoiser=report,
        skipped=reception.skipped,
    )
    if options.soft_bits:
        result = replace(result, soft_bits=soft_bits(frame, reception, no_header, denoised))
    if result.status != "no_signal":
        return replace(result, message=_COUNTED_FROM_LEFT) if outline.is_counted_from_left else result
    message = too_small(context, acquisition.screen) or assemble.why_no_packet(columns)
    return replace(result, message=message)


def _taps(corners: FloatArray, acquisition: Acquisition, reception: Reception) -> dict[str, Any]:
    """Arrays at the stage boundaries, by stage."""
    return {
        "geometry.corners": corners,
        "sampling": acquisition.profiles,
        "clock": reception.clock,
        "samples": reception.samples,
        "channel.metrics": reception.metrics,
        "detect": reception.posteriors,
    }


def failed(result: FrameResult, failure: Failure) -> FrameResult:
    """Result of a failed reception with its reason."""
    # An estimated camera without packets is not reliable.
    camera = failure.context.camera if failure.context and failure.context.camera.hypothesis is None else None
    facts = {**(failure.outline.result_fields if failure.outline else {}), **(camera.result_fields if camera else {})}
    result = replace(result, **facts)
    return replace(
        result,
        search=tuple(tried.step for tried in failure.tried),
        status=failure.status,
        message=failure.message,
        skipped={"no_screen": 1} if failure.status == "no_screen" else {},
        estimated=failure.estimated or result.estimated,
    )
