"""Arrays at the stage boundaries, written for people and for tests: one NPZ a frame."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from rxcli.errors import UsageError
from rxcli.types import BurstPosteriors, Clock, FloatArray, Frame, RowProfiles, SlotSamples


def dump_frame(
    folder: Path,
    frame: Frame,
    corners: FloatArray,
    profiles: RowProfiles,
    clock: Clock,
    samples: SlotSamples,
    metrics: FloatArray,
    posteriors: BurstPosteriors,
) -> Path:
    """Write the arrays of one frame to `folder`/SOURCE-FRAME.npz; keys are `stage.field`.

    Stages and fields are those of `rxcli.types`; `geometry.corners` and `channel.metrics` stand beside them. Bit
    log-likelihood ratios are ln p(1)/p(0).

    Raises:
        UsageError: the folder cannot be written.
    """
    arrays: dict[str, Any] = {"geometry.corners": corners, "channel.metrics": metrics}
    for stage, value in (("sampling", profiles), ("clock", clock), ("samples", samples), ("detect", posteriors)):
        for item in fields(value):
            content = getattr(value, item.name)
            if content is not None:
                arrays[f"{stage}.{item.name}"] = np.asarray(content)
    stem = re.sub(r"[^A-Za-z0-9._-]+", "_", Path(frame.source).name) or "frame"
    path = folder / f"{stem}-{frame.index:06d}.npz"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(path, **arrays)
    except OSError as error:
        raise UsageError(f"{path}: cannot be written ({error})", "name another folder with --dump-dir") from None
    return path
