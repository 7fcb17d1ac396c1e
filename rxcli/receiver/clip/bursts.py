"""The bursts of a clip: metrics of several frames are added, and detected when their result is needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rxcli.protocol import PREAMBLE_SLOTS, WEIGHTS
from rxcli.receiver import channel
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.clip.views import View, Waiting
from rxcli.receiver.decode import assemble, confidence, detect
from rxcli.receiver.light import slot_llr
from rxcli.receiver.settings import SETTINGS as receiver_settings
from rxcli.types import BoolArray, BurstPosteriors, Float32Array, FloatArray, IntArray


@dataclass(slots=True, eq=False)
class Burst:
    """A burst, added up over the frames that show it."""

    #: Number in the clip.
    number: int
    #: (C, packet + memory, patterns) of all frames together.
    metrics: FloatArray
    #: (C, packet) number of observations of each slot.
    n_observed: IntArray
    frames: tuple[int, ...]
    #: Whether the picture was known from other frames in any of them.
    tracked: bool
    #: Of this burst alone, once detected.
    posteriors: BurstPosteriors | None = None
    #: Whether frames were added since the last detection.
    is_stale: bool = True

    def add(self, burst: Burst) -> None:
        """Add what a further frame shows of it."""
        self.metrics, added = with_common_memory([self.metrics, burst.metrics])
        self.metrics += added
        self.n_observed = self.n_observed + burst.n_observed
        self.frames += burst.frames
        self.tracked |= burst.tracked
        self.is_stale = True

    @property
    def certain(self) -> BoolArray:
        """(C,) columns that need no further pass."""
        if self.posteriors is None:
            return np.zeros(len(self.n_observed), bool)
        return np.asarray(self.posteriors.log_prob[0].min(axis=1) >= SETTINGS.certain_log_prob)

    @property
    def lit(self) -> Float32Array:
        """(C, packet) probability that each slot is lit."""
        half = np.full(self.n_observed.shape, 0.5, np.float32)
        return half if self.posteriors is None else np.asarray(self.posteriors.lit[0])

    def detected(self, columns: IntArray, posteriors: BurstPosteriors) -> None:
        """Set the posteriors of some columns."""
        n = len(self.n_observed)
        if columns.size < n:
            posteriors = (self.posteriors or _unobserved(self.metrics, n)).with_columns(columns, posteriors)
        self.posteriors = posteriors

    def ended(self, first_number: int, n_strips: int) -> confidence.BurstInClip:
        """What is reported of it; `first_number` is that of the first burst of the last frame that shows it."""
        assert self.posteriors is not None
        features = against = None
        if self.tracked:
            llr = slot_llr(self.metrics[None])[0, :, PREAMBLE_SLOTS:]
            decided = np.sign(self.posteriors.lit[0, :, PREAMBLE_SLOTS:] - 0.5)
            against = np.asarray(np.maximum(-llr * decided, 0).max(axis=1), np.float32)
        else:
            margin = detect.slot_margin(self.metrics[None], self.posteriors.lit > 0.5)[:, :, PREAMBLE_SLOTS:]
            undenoised = np.zeros(margin.shape[1], bool)
            features = confidence.confidence_features(self.posteriors, margin, undenoised, n_strips)[0]
        index = self.number - first_number
        return confidence.BurstInClip(
            self.number, index, self.posteriors, self.n_observed, self.frames, features, against
        )


class Bursts:
    """The bursts that are still going on.

    Args:
        skip: what may be skipped, see `rxcli.options`.
    """

    def __init__(self, skip: frozenset[str]) -> None:
        self._skip = skip
        #: Whether dark columns are tried in every frame.
        self.dark_too = False
        self.begin()

    def begin(self) -> None:
        """Forget all bursts."""
        self._open: dict[int, Burst] = {}
        self._closed: list[Burst] = []

    def settled(self, number: int, lit: BoolArray) -> bool:
        """Whether all lit columns (C,) of a burst, open or closed, are certain."""
        return any(
            burst.number == number and bool(burst.certain[lit].all()) for burst in (*self._open.values(), *self._closed)
        )

    def add(self, view: View, numbers: IntArray) -> None:
        """Add a frame to its bursts (B,), which are detected when their result is needed."""
        own = view.bursts
        metrics = channel.by_burst(own.metrics, own.clock)
        for index, number in enumerate(numbers.tolist()):
            n_observed = own.shown[own.clock.burst == index].sum(axis=0)
            burst = Burst(number, metrics[index].copy(), n_observed, (own.frame,), own.tracked)
            if number in self._open:
                self._open[number].add(burst)
            elif not self._closed or number > self._closed[-1].number:
                self._open[number] = burst

    def close(self, numbers: IntArray) -> list[Burst]:
        """Remove bursts in time order; later frames add nothing to them or to earlier ones."""
        closed = [self._open.pop(number) for number in np.sort(numbers).tolist() if number in self._open]
        self._closed = [*self._closed, *closed][-SETTINGS.remembered_bursts :]
        return [burst for burst in closed if burst.posteriors is not None]

    def of(self, waiting: Waiting) -> list[Burst]:
        """The bursts of a frame that are open."""
        assert waiting.numbers is not None
        return [self._open[number] for number in waiting.numbers.tolist() if number in self._open]

    def detect_stale(self, waiting: Waiting) -> None:
        """Detect the bursts of a frame that were added to since they were looked at."""
        self.detect(waiting, [burst for burst in self.of(waiting) if burst.is_stale], self.dark_too)

    def detect(self, waiting: Waiting, bursts: Sequence[Burst], dark_too: bool) -> None:
        """Detect open bursts of a frame together, for they share the columns' weights; dark columns if `dark_too`."""
        assert waiting.view is not None
        tried = np.flatnonzero(~self._dark(waiting.view) | dark_too)
        waiting.skip("dark_columns", len(bursts) * (len(waiting.view.snr) - tried.size))
        if bursts and tried.size:
            metrics = np.stack(with_common_memory([burst.metrics[tried] for burst in bursts]))
            found = detect.detect(metrics, detect.plausible_weights(metrics, receiver_settings.weight_margin))
            for index, burst in enumerate(bursts):
                burst.detected(tried, found.of_burst(index))
        for burst in bursts:
            burst.is_stale = False

    def _dark(self, view: View) -> BoolArray:
        """(C,) columns of a tracked frame with too little light to try; now and then they are tried all the same."""
        tried = (view.bursts.frame + 1) % SETTINGS.try_dark_every == 0
        if view.flat is None or "dark_columns" not in self._skip or tried:
            return np.zeros(view.snr.shape[0], bool)
        return np.asarray(np.median(view.snr, axis=1) < SETTINGS.dark_snr)

    def lit(self, waiting: Waiting) -> Float32Array:
        """(C, N) probability that each slot of a frame is lit, by all that is known of its bursts."""
        assert waiting.view is not None
        assert waiting.numbers is not None
        self.detect_stale(waiting)
        clock = waiting.view.bursts.clock
        lit = np.full((waiting.numbers.size, len(waiting.view.snr), clock.packet_slots), 0.5, np.float32)
        for burst in self.of(waiting):
            lit[waiting.numbers == burst.number] = burst.lit
        return clock.on_grid(lit)

    def doubts(self, waiting: Waiting) -> tuple[int, int]:
        """Numbers of doubtful packets and of all packets, among complete packets of a frame in well-lit columns."""
        assert waiting.view is not None
        self.detect_stale(waiting)
        lit = np.median(waiting.view.snr, axis=1) >= SETTINGS.well_lit_snr
        doubtful = total = 0
        for burst in self.of(waiting):
            if burst.posteriors is not None:
                whole = assemble.complete(burst.n_observed[None])[0] & lit
                log_prob = burst.posteriors.log_prob[0].sum(axis=1)
                doubtful += int((log_prob < SETTINGS.doubtful_log_prob)[whole].sum())
                total += int(whole.sum())
        return doubtful, total

    def confidence(self, numbers: IntArray) -> Float32Array | None:
        """(C,) of the best packet of bursts (B,) that are still going on, None where nothing is known of any."""
        open_ones = (self._open[number] for number in numbers.tolist() if number in self._open)
        log_probs = [burst.posteriors.log_prob for burst in open_ones if burst.posteriors is not None]
        best = [np.exp(log_prob.sum(axis=2)).max(axis=0) for log_prob in log_probs]
        return np.asarray(np.max(best, axis=0), np.float32) if best else None


def with_common_memory(metrics: Sequence[FloatArray]) -> list[FloatArray]:
    """Convert metrics (..., n + memory, patterns) of several frames to the longest ISI memory among them.

    A metric of a shorter memory applies to every longer pattern that ends with its slots.
    """
    n_patterns = max((some.shape[-1] for some in metrics), default=0)
    n_metrics = max((some.shape[-2] for some in metrics), default=0)

    def written(some: FloatArray) -> FloatArray:
        if some.shape[-1] == n_patterns:
            return some
        every = some[..., np.arange(n_patterns) % some.shape[-1]]
        more = [(0, 0)] * (some.ndim - 2)
        return np.pad(every, [*more, (0, n_metrics - some.shape[-2]), (0, 0)])

    return [written(some) for some in metrics]


def _unobserved(like: FloatArray, n: int) -> BurstPosteriors:
    """Posteriors of `n` columns of a burst without light, of metrics such as (..., packet + memory, patterns)."""
    middle = np.arange(len(WEIGHTS)) == len(WEIGHTS) // 2
    blank = detect.detect(np.zeros((1, 1, *like.shape[-2:])), middle[None])
    return replace(blank, lit=np.full_like(blank.lit, 0.5)).of_columns(np.zeros(n, np.int64))
