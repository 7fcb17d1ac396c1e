"""The wiring of the receiver: `receive_frame` reads as the block diagram.

`corners` finds the screen, `cameras` and `unknown_camera` tell the camera, `acquisition` samples the columns and finds
the clock, `still` turns light model and detection, `clip` carries over from frame to frame what is known.
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
from rxcli.receiver import sync
from rxcli.receiver.acquisition import Acquisition
from rxcli.receiver.context import Failure, Timer
from rxcli.receiver.corners import too_small
from rxcli.receiver.decode import assemble
from rxcli.receiver.outline import locate, with_columns
from rxcli.receiver.reception import Reception, headerless, slot_margin, soft_bits
from rxcli.receiver.screen_choice import quick_look, quick_sampler
from rxcli.receiver.single_light import with_data
from rxcli.receiver.still import apply_autoencoder, decode_likeliest
from rxcli.receiver.unknown_camera import likely_camera, receive_unknown
from rxcli.results.dump import dump_stages
from rxcli.types import FloatArray, Frame, FrameResult

__all__ = ["SKIPS", "CaeMode", "ReceiverOptions", "failed", "receive", "receive_frame"]


_COUNTED_FROM_LEFT = (
    "no side of the screen is in view: columns are counted from the left of what is seen; take one side into view to "
    "have the screen's numbers"
)


def receive(frames: Iterable[Frame], options: ReceiverOptions) -> Iterator[FrameResult]:
    """Receive the frames of one source, in order; one result a frame, in order.

    A clip's result may come some frames later than the frame, because a packet stands in the last frame that shows it.
    """
    with closing(_iterator(frames)) as source:
        first = next(source, None)
        if first is None:
            return
        try:
            second = next(source, None)
        except Exception:
            yield receive_frame(first, options)
            raise
        if second is None:
            yield receive_frame(first, options)
            return
        from rxcli.receiver.clip import receive_clip

        for result in receive_clip(chain((first, second), source), options):
            yield result.with_columns_mirrored() if options.mirrored else result


def _iterator(frames: Iterable[Frame]) -> Generator[Frame, None, None]:
    """The frames as a generator, whose end also ends theirs: a file is closed when reception is left early."""
    yield from frames


def receive_frame(frame: Frame, options: ReceiverOptions) -> FrameResult:
    """Receive one frame as a photograph."""
    timer = Timer()
    with one_blas_thread():
        result = _receive_still(frame, options, timer)
    result = replace(result, message=_with_tried(result, options.screens), timing_ms=timer.total())
    if options.mirrored:
        return result.with_columns_mirrored()
    return replace(result, mirrored=None if frame.metadata.names_front_camera else False)


def _with_tried(result: FrameResult, screens: tuple[ScreenProfile, ...]) -> str | None:
    """Why nothing was received, and where a single screen was tried, that it may be the wrong one."""
    if result.status != "no_signal" or result.message is None or len(screens) != 1:
        return result.message
    return f"{result.message}; only the screen {screens[0].name} was tried (--screen auto tries all)"


def _receive_still(frame: Frame, options: ReceiverOptions, timer: Timer) -> FrameResult:
    result = FrameResult(frame.source, frame.index, frame.time_s, "ok")
    # Screen: where the columns are.
    located = locate(frame, options, timer)
    if isinstance(located, Failure):
        return failed(result, located)
    outline, corners = located.outline, located.outline.corners
    result = replace(result, **outline.facts)
    # Camera: what a row is in time.
    context = located.context or likely_camera(frame, corners, options, timer)
    if isinstance(context, Failure):
        return failed(result, context)
    context = with_columns(context, outline)
    # Sampling: pixels to row profiles; sync: row profiles to a clock.
    acquisition = with_data(context, quick_sampler(context), quick_look(context))
    if isinstance(acquisition, Failure):
        return failed(replace(result, **context.camera.facts), acquisition)
    # Channel and decode, in turn: slot metrics to symbols, and what they say of the picture.
    if context.camera.hypothesis is None:
        with timer("detect"):
            reception = decode_likeliest(acquisition, options.skip)
    else:
        received = receive_unknown(context, acquisition, options.skip)
        context, acquisition, reception = received.context, received.acquisition, received.reception
    with timer("detect"):
        no_header = headerless(reception)
    with timer("denoise"):
        reception, denoised, report = apply_autoencoder(acquisition, reception, options)
    if options.dump_dir is not None:
        dump_stages(options.dump_dir, frame.source, frame.index, _taps(corners, acquisition, reception))
    # Packets, with the probability that they are right.
    columns = assemble.column_results(
        reception.clock,
        reception.posteriors,
        reception.snr,
        reception.samples,
        slot_margin(reception),
        no_header,
        options.min_confidence,
        denoised,
    )
    columns = assemble.with_doubt(columns, outline.certainty, options.min_confidence)
    if context.camera.reversed:
        columns = tuple(assemble.in_stored_rows(column, frame.height) for column in columns)
    result = replace(
        result,
        **context.camera.facts,
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
    """The arrays at the boundaries of the stages, by stage."""
    return {
        "geometry.corners": corners,
        "sampling": acquisition.profiles,
        "clock": reception.clock,
        "samples": reception.samples,
        "channel.metrics": reception.metrics,
        "detect": reception.posteriors,
    }


def failed(result: FrameResult, failure: Failure) -> FrameResult:
    """A result of which nothing more comes, with the reason."""
    return replace(
        result,
        status=failure.status,
        message=failure.message,
        skipped={"no_screen": 1} if failure.status == "no_screen" else {},
        estimated=failure.estimated or result.estimated,
    )
