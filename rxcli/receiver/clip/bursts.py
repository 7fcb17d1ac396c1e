"""The bursts of a clip: metrics of several frames are added, and detected when their result is needed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rxcli.protocol import WEIGHTS
from rxcli.receiver import channel
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.clip.views import View, Waiting
from rxcli.receiver.decode import assemble, detect
from rxcli.receiver.settings import SETTINGS as receiver_settings
from rxcli.receiver.sync.tracking import Bursts, with_common_memory
from rxcli.types import Float32Array, FloatArray, IntArray


class BurstReader:
    """The bursts that are still going on.

    Args:
        skip: what may be skipped, see `rxcli.options`.
    """

    def __init__(self, skip: frozenset[str]) -> None:
        self._skip = skip
        self.open = Bursts()
        #: Whether dark columns are tried in every frame.
        self.dark_too = False
        #: (C, 9) the weight that a column was last certain of, alone; None before any.
        self._weights: NDArray[np.bool_] | None = None

    def begin(self) -> None:
        """Forget all bursts, but not the columns' weights."""
        self.open = Bursts()

    def add(self, view: View, numbers: IntArray) -> None:
        """Add a frame to its bursts (B,), which are detected when their result is needed."""
        metrics = channel.by_burst(view.bursts.metrics, view.bursts.clock)
        self.open.add(view.bursts, numbers, metrics)

    def detect_stale(self, *frames: Waiting) -> None:
        """Detect the bursts of frames that were added to since they were looked at."""
        asked: list[tuple[Waiting, IntArray]] = []
        stale: set[int] = set()
        for waiting in frames:
            assert waiting.numbers is not None
            numbers = [int(n) for n in waiting.numbers if self.open.is_stale(int(n)) and int(n) not in stale]
            stale.update(numbers)
            asked.append((waiting, np.array(numbers, np.int64)))
        self.detect(asked, self.dark_too)

    def detect(self, asked: Sequence[tuple[Waiting, IntArray]], dark_too: bool) -> None:
        """Detect bursts of frames as far as they are open, in columns that are neither certain nor, unless they are to
        be tried too, dark."""
        found: list[tuple[IntArray, NDArray[np.bool_]]] = []
        for waiting, numbers in asked:
            assert waiting.view is not None
            still_open = np.array([n for n in numbers if self.open.is_open(int(n))], np.int64)
            if still_open.size == 0:
                continue
            certain = self.open.certain(still_open)
            if "certain_columns" not in self._skip:
                certain[:] = False
            dark = ~certain & (self._dark(waiting.view) & (not dark_too))
            waiting.skip("certain_columns", int(certain.sum()))
            waiting.skip("dark_columns", int(dark.sum()))
            self.open.mark_detected(still_open)
            if not (certain | dark).all():
                found.append((still_open, ~certain & ~dark))
        if found:
            self._detect_open(found)

    def _dark(self, view: View) -> NDArray[np.bool_]:
        """(C,) columns of a tracked frame with too little light to try; now and then they are tried all the same."""
        tried = (view.bursts.frame + 1) % SETTINGS.try_dark_every == 0
        if view.flat is None or "dark_columns" not in self._skip or tried:
            return np.zeros(view.snr.shape[0], bool)
        return np.asarray(np.median(view.snr, axis=1) < SETTINGS.dark_snr)

    def _detect_open(self, found: list[tuple[IntArray, NDArray[np.bool_]]]) -> None:
        """Detect the columns wanted, (B, C), of the open bursts of some frames.

        All at once, for each symbol's turn costs the same; only the weights are settled frame by frame.
        """
        if self._weights is None or self._weights.shape[0] != self.open.n_columns:
            self._weights = np.zeros((self.open.n_columns, len(WEIGHTS)), bool)
        places = [np.nonzero(wanted) for _, wanted in found]
        metrics = with_common_memory([self.open.metrics(numbers) for numbers, _ in found])
        weights = [_settled_weights(self._weights, m, wanted) for m, (_, wanted) in zip(metrics, found, strict=True)]
        number = np.concatenate([numbers[burst] for (numbers, _), (burst, _) in zip(found, places, strict=True)])
        column = np.concatenate([c for _, c in places])
        posteriors = detect.detect(
            np.concatenate([m[place] for m, place in zip(metrics, places, strict=True)])[None],
            np.concatenate([w[c] for w, (_, c) in zip(weights, places, strict=True)]),
        )
        certain = posteriors.log_prob[0].min(axis=1) >= SETTINGS.certain_log_prob
        for value in np.unique(number):
            mine = np.flatnonzero(number == value)
            self.open.store(int(value), column[mine], posteriors.of_columns(mine), certain[mine])
        # Weights of columns that were certain are the only ones tried next, until they are not certain any more.
        self._weights[column] = False
        self._weights[column[certain], posteriors.w[certain] - 1] = True

    def lit(self, waiting: Waiting) -> Float32Array:
        """(C, N) probability that each slot of a frame is lit, by all that is known of its bursts."""
        assert waiting.view is not None
        assert waiting.numbers is not None
        self.detect_stale(waiting)
        clock = waiting.view.bursts.clock
        lit = np.full((waiting.numbers.size, self.open.n_columns, clock.packet_slots), 0.5, np.float32)
        for place, number in enumerate(waiting.numbers):
            if self.open.is_open(int(number)):
                lit[place] = self.open.lit(waiting.numbers[place : place + 1])[0]
        return clock.on_grid(lit)

    def doubts(self, waiting: Waiting) -> tuple[int, int]:
        """Numbers of doubtful packets and of all packets, among complete packets of a frame in well-lit columns."""
        assert waiting.view is not None
        assert waiting.numbers is not None
        self.detect_stale(waiting)
        lit = np.median(waiting.view.snr, axis=1) >= SETTINGS.well_lit_snr
        doubtful = total = 0
        for number in waiting.numbers:
            known = self.open.known(int(number)) if self.open.is_open(int(number)) else None
            if known is not None:
                whole = assemble.complete(self.open.n_observed(np.array([number])))[0] & lit
                doubtful += int((known.log_prob[0].sum(axis=1) < SETTINGS.doubtful_log_prob)[whole].sum())
                total += int(whole.sum())
        return doubtful, total

    def confidence(self, numbers: IntArray) -> Float32Array | None:
        """(C,) of the best packet of bursts (B,) that are still going on, None where nothing is known of any."""
        known = [p for p in (self.open.known(int(n)) for n in numbers if self.open.is_open(int(n))) if p]
        if not known:
            return None
        best = np.max([np.exp(p.log_prob.sum(axis=2)).max(axis=0) for p in known], axis=0)
        return np.asarray(best, np.float32)


def _settled_weights(before: NDArray[np.bool_], metrics: FloatArray, wanted: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(C, 9) the weight of each column, from all bursts (B, C, ...) of a frame; only of those wanted, (B, C)."""
    bursts, columns = np.flatnonzero(wanted.any(axis=1)), np.flatnonzero(wanted.any(axis=0))
    weights = before.copy()
    unknown = columns[~weights[columns].any(axis=1)]
    if unknown.size:
        weights[unknown] = detect.plausible_weights(metrics[bursts][:, unknown], receiver_settings.weight_margin)
    several = columns[weights[columns].sum(axis=1) > 1]
    if several.size:
        found = detect.detect(metrics[bursts][:, several], weights[several])
        weights[several] = np.array(WEIGHTS) == found.w[:, None]
    return weights
