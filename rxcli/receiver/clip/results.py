"""What a frame of a clip reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rxcli.protocol import PREAMBLE_SLOTS
from rxcli.receiver.clip.views import View, Waiting
from rxcli.receiver.decode import assemble, confidence, detect
from rxcli.receiver.sync.tracking import ClosedBurst
from rxcli.types import ColumnResult, Float32Array, FloatArray, IntArray


def bursts_of(closed: Sequence[ClosedBurst], first: int, view: View) -> list[confidence.BurstInClip]:
    """Bursts that end in the frame of a view, for `assemble`; `first` is the number of the frame's first burst."""
    n_strips = view.acquisition.sampler.binned.light.shape[1]
    return [
        confidence.BurstInClip(
            number=burst.number,
            index=int(burst.number - first),
            posteriors=burst.posteriors,
            n_observed=burst.n_observed,
            frames=burst.frames,
            confidence_features=None if burst.tracked else _confidence_features(burst, n_strips),
            against=_against(burst),
        )
        for burst in closed
    ]


def columns_of(
    view: View, ended: Sequence[confidence.BurstInClip], later: Float32Array | None, min_confidence: float
) -> tuple[ColumnResult, ...]:
    """Results of a frame's columns.

    Args:
        view: the frame.
        ended: bursts that end in it.
        later: (C,) confidence of the best packet that the next frame will report; None where it reports none.
        min_confidence: packets below it are left out.
    """
    sure = np.zeros(view.snr.shape[0], np.float32) if later is None else later
    columns = assemble.clip_results(view.bursts.clock, ended, sure, view.snr, min_confidence)
    if view.denoised:
        columns = tuple(replace(c, denoised=c.column in view.denoised) for c in columns)
    return tuple(assemble.in_stored_rows(c, view.height) for c in columns) if view.context.camera.reversed else columns


def taps(waiting: Waiting, view: View, ended: Sequence[confidence.BurstInClip]) -> dict[str, Any]:
    """What is written of a frame: as of a photograph, but strips as tracking samples them, and bursts that end here."""
    found: dict[str, Any] = {"geometry.corners": waiting.result.corners, "clock": view.bursts.clock}
    if view.light is not None and view.pose is not None:
        rows = view.pose.rows.astype(np.int64)
        found |= {"sampling.light": view.light, "sampling.inside": view.pose.map.inside, "sampling.rows": rows}
    else:
        found["sampling"] = view.acquisition.profiles
    numbers: IntArray = np.array([burst.number for burst in ended], np.int64)
    found |= {"channel.metrics": view.bursts.metrics, "bursts.shown": view.bursts.shown}
    found |= {"bursts.number": waiting.numbers, "bursts.ended": numbers}
    return found | {f"detect.{burst.number}": burst.posteriors for burst in ended}


def _confidence_features(burst: ClosedBurst, n_strips: int) -> FloatArray:
    """(C, 8) what the confidence of packets is made of, all copies and frames together."""
    slot_margin = detect.slot_margin(burst.metrics[None], burst.posteriors.lit > 0.5)[:, :, PREAMBLE_SLOTS:]
    confidence_features = confidence.confidence_features(
        burst.posteriors, slot_margin, np.zeros(slot_margin.shape[1], bool), n_strips
    )
    return np.asarray(confidence_features[0])


def _against(burst: ClosedBurst) -> Float32Array | None:
    """(C,) log-likelihood against what was decided of the payload slot that says so most; None for photographs."""
    if not burst.tracked:
        return None
    llr = detect.slot_llr(burst.metrics[None])[0, :, PREAMBLE_SLOTS:]
    decided = np.sign(burst.posteriors.lit[0, :, PREAMBLE_SLOTS:] - 0.5)
    return np.asarray(np.maximum(-llr * decided, 0).max(axis=1), np.float32)
