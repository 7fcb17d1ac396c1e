"""Screen and clock of simulated frames, as the receiver finds them."""

from __future__ import annotations

from rxcli.lab.benchmark.trial import Trial
from rxcli.receiver.acquisition import Acquisition
from rxcli.receiver.context import Failure, Timer
from rxcli.receiver.search import search


def acquired(trial: Trial, *, quick: bool = True) -> Acquisition | None:
    """Screen and clock of a trial's first frame; None where they are not found. For `quick` see `sample_columns`."""
    found = search(trial.frame, trial.options(), Timer(), quick=quick)
    return None if isinstance(found, Failure) else found.best.acquisition
