"""What the receiver finds of a trial before its auto-encoder is asked."""

from __future__ import annotations

from rxcli.lab.benchmark.trial import Trial
from rxcli.receiver.acquisition import Acquisition, sample_columns
from rxcli.receiver.context import Failure, Timer
from rxcli.receiver.outline import find_outline
from rxcli.receiver.screen_choice import acquire
from rxcli.receiver.unknown_camera import likely_camera


def acquired(trial: Trial, *, quick: bool = True) -> Acquisition | None:
    """Screen and clock of a trial's first frame; None where they are not found. For `quick` see `sample_columns`."""
    options, timer = trial.options(), Timer()
    outline = find_outline(trial.frame, options, timer)
    context = outline if isinstance(outline, Failure) else likely_camera(trial.frame, outline.corners, options, timer)
    if isinstance(context, Failure):
        return None
    found = acquire(context, sample_columns(context, context.n_columns, quick=quick))
    return None if isinstance(found, Failure) else found
