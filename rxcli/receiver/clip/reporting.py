"""The result of a frame of a clip: the packets of the bursts that it shows last."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.receiver.clip.bursts import Burst
from rxcli.receiver.clip.timeline import Timeline
from rxcli.receiver.clip.views import View, Waiting
from rxcli.receiver.decode import assemble
from rxcli.receiver.decode.confidence import BurstInView
from rxcli.receiver.decode.soft_bits import clip_soft_bits
from rxcli.types import BELIEVABLE, FrameResult, IntArray, OnTaps


def completed(
    waiting: Waiting,
    timeline: Timeline,
    closed: Sequence[Burst],
    going_on: Sequence[Burst],
    options: ReceiverOptions,
    on_taps: OnTaps | None,
) -> FrameResult:
    """The result of a received frame.

    Args:
        waiting: the frame.
        timeline: that numbered its bursts.
        closed: its bursts that no later frame shows.
        going_on: its other bursts.
        options: of the receiver.
        on_taps: is given the arrays of every received frame.
    """
    result, view = waiting.result, waiting.view
    assert view is not None
    ended = [burst.ended(view) for burst in closed]
    framing = np.ones(view.clock.n_copies)
    for burst, end in zip(closed, ended, strict=True):
        framing[end.index] = timeline.certainty(burst.copies)
    headerless = timeline.headerless(ended, len(view.snr))
    columns = assemble.clip_results(
        assemble.FrameColumns(view.clock, view.snr, headerless, options.min_confidence, waiting.certainty, framing),
        ended,
        lambda column: any(burst.probability(column) >= BELIEVABLE for burst in going_on),
    )
    if view.denoised:
        columns = tuple(replace(column, denoised=column.column in view.denoised) for column in columns)
    if view.context.camera.reversed:
        columns = tuple(assemble.in_stored_rows(column, view.context.frame.height) for column in columns)
    if on_taps is not None:
        on_taps(result.source, result.frame, _taps(result, view, ended))
    soft = None
    if options.soft_bits:
        soft = clip_soft_bits(ended, assemble.snr_db_of_columns(view.snr), timeline.epoch)
    if soft is not None:
        soft = replace(soft, source=result.source, frame=result.frame, time_s=result.time_s)
    name = view.acquisition.variant(timeline.phase.repeats).name
    status = assemble.clip_status(columns)
    return replace(result, columns=columns, status=status, screen_profile=name, soft_bits=soft)


def _taps(result: FrameResult, view: View, ended: Sequence[BurstInView]) -> dict[str, Any]:
    """What is written of a frame: as of a photograph, but strips as tracking samples them, and bursts that end here."""
    found: dict[str, Any] = {"geometry.corners": result.corners, "clock": view.clock}
    found["geometry.sampled_corners"] = view.context.sampled_corners
    if view.light is not None and view.pose is not None:
        rows = view.pose.rows.astype(np.int64)
        found |= {"sampling.light": view.light, "sampling.inside": view.pose.map.inside, "sampling.rows": rows}
    else:
        found["sampling"] = view.acquisition.profiles
    numbers: IntArray = np.array([burst.number for burst in ended], np.int64)
    found |= {"channel.llr": view.llr, "bursts.shown": view.shown}
    found |= {"bursts.number": view.numbers, "bursts.ended": numbers}
    return found | {f"detect.{burst.number}": burst.posteriors for burst in ended}
