"""The wiring of the receiver: `receive_frame` reads as the block diagram.

`locate` finds corners, camera and clock, `still` turns light model and detection, `clip` carries
over from frame to frame what is known.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from rxcli.options import SKIPS, CaeMode, ReceiverOptions
from rxcli.receiver.channel import denoise
from rxcli.receiver.decode import assemble
from rxcli.receiver.locate import Failure, Stages, acquire, find_camera, find_corners, too_small
from rxcli.receiver.still import apply_autoencoder, decode, decode_likeliest, doubtful_columns, headerless, slot_margin
from rxcli.receiver.unknown_camera import likely_camera, with_refitted_camera, without_estimate
from rxcli.results.dump import dump_frame
from rxcli.types import Frame, FrameResult

__all__ = ["SKIPS", "CaeMode", "ReceiverOptions", "denoiser_case", "receive", "receive_frame"]


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

        yield from receive_clip(chain((first, second), source), options)


def _iterator(frames: Iterable[Frame]) -> Generator[Frame, None, None]:
    """The frames as a generator, whose end also ends theirs: a file is closed when reception is left early."""
    yield from frames


def denoiser_case(frame: Frame, options: ReceiverOptions) -> tuple[denoise.DenoiserInput, NDArray[np.int64]] | None:
    """For training: what the auto-encoder is shown of a frame, and which columns it is asked; None without any."""
    try:
        corners = find_corners(frame, options)
        camera, options = find_camera(frame, corners, options, Stages())
        acquisition = acquire(frame, corners, camera, options, Stages(), quick=True)
    except Failure:
        return None
    reception = decode(acquisition, options.skip)
    columns = doubtful_columns(reception)
    return (reception.scene, columns) if reception.scene is not None and columns.size else None


def receive_frame(frame: Frame, options: ReceiverOptions) -> FrameResult:
    stages = Stages()
    result = FrameResult(frame.source, frame.index, frame.time_s, "ok")
    try:
        with stages("geometry"):
            corners = find_corners(frame, options)
        result = replace(result, corners=corners)
        camera, options = likely_camera(frame, corners, options, stages)
        result = replace(result, **camera.facts)
        acquisition = acquire(frame, corners, camera, options, stages, quick=True)
        result = replace(result, screen_profile=acquisition.screen.name)
        with stages("detect"):
            reception = decode_likeliest(acquisition, options.skip)
        if camera.blind_estimate is not None:
            camera, acquisition, reception = with_refitted_camera(
                frame, corners, camera, acquisition, reception, options, stages
            )
            result = replace(result, **camera.facts)
        with stages("detect"):
            no_header = headerless(reception)
        with stages("denoise"):
            reception, denoised, report = apply_autoencoder(acquisition, reception, options)
        if options.dump_dir is not None:
            dump_frame(
                options.dump_dir,
                frame,
                corners,
                acquisition.profiles,
                reception.clock,
                reception.samples,
                reception.metrics,
                reception.posteriors,
            )
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
        if camera.reversed:
            columns = tuple(assemble.in_stored_rows(column, frame.height) for column in columns)
        result = replace(result, denoiser=report, skipped=reception.skipped)
        result = replace(result, columns=columns, status=assemble.frame_status(columns))
        if result.status == "no_signal":
            too_few_rows = too_small(frame, corners, camera, acquisition.screen)
            result = replace(result, message=too_few_rows or assemble.why_no_packet(columns))
            result = without_estimate(result, camera, reception)
    except Failure as failure:
        skipped = {"no_screen": 1} if failure.status == "no_screen" else {}
        estimated = failure.estimated or result.estimated
        result = replace(result, status=failure.status, message=failure.message, skipped=skipped, estimated=estimated)
    return replace(result, timing_ms=stages.total())
