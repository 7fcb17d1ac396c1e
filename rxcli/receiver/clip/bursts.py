"""The bursts of a clip: the evidence of several frames is added, and detected when its result is needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from rxcli.protocol import PREAMBLE_SLOTS, WEIGHTS
from rxcli.receiver import channel
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.clip.views import View
from rxcli.receiver.decode import assemble, confidence, detect
from rxcli.receiver.light import slot_llr
from rxcli.receiver.settings import SETTINGS as receiver_settings
from rxcli.types import BoolArray, BurstPosteriors, Float32Array, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Burst:
    """What some frames show of a burst; the sum of two is what all their frames show."""

    #: Number in the clip.
    number: int
    #: (C, packet + memory, patterns) of all frames together.
    metrics: FloatArray
    #: (C, packet) number of observations of each slot.
    n_observed: IntArray
    frames: tuple[int, ...]
    #: Whether the picture was known from other frames in any of them.
    tracked: bool
    #: (C,) columns with enough light in any of them; the others are not detected.
    tried: BoolArray

    def __add__(self, burst: Burst) -> Burst:
        metrics, more = with_common_memory([self.metrics, burst.metrics])
        return Burst(
            self.number,
            metrics + more,
            self.n_observed + burst.n_observed,
            self.frames + burst.frames,
            self.tracked or burst.tracked,
            self.tried | burst.tried,
        )

    @cached_property
    def posteriors(self) -> BurstPosteriors:
        """Of this burst alone; columns that are not tried are unknown."""
        columns, n_columns = np.flatnonzero(self.tried), self.tried.size
        if not columns.size:
            return _unobserved(n_columns, *self.metrics.shape[1:])
        metrics = self.metrics[None, columns]
        found = detect.detect(metrics, detect.plausible_weights(metrics, receiver_settings.weight_margin))
        if columns.size == n_columns:
            return found
        return _unobserved(n_columns, *self.metrics.shape[1:]).with_columns(columns, found)

    @property
    def certain(self) -> BoolArray:
        """(C,) columns that further frames add nothing to."""
        return np.asarray(self.posteriors.log_prob[0].min(axis=1) >= SETTINGS.certain_log_prob)

    @property
    def probability(self) -> Float32Array:
        """(C,) of the packets as detected, by the light model alone."""
        return np.asarray(np.exp(self.posteriors.log_prob[0].sum(axis=1)), np.float32)

    def ended(self, view: View) -> confidence.BurstInClip:
        """What is reported of it; `view` is of the last frame that shows it."""
        assert view.numbers is not None
        features = against = None
        if self.tracked:
            llr = slot_llr(self.metrics[None])[0, :, PREAMBLE_SLOTS:]
            decided = np.sign(self.posteriors.lit[0, :, PREAMBLE_SLOTS:] - 0.5)
            against = np.asarray(np.maximum(-llr * decided, 0).max(axis=1), np.float32)
        else:
            margin = detect.slot_margin(self.metrics[None], self.posteriors.lit > 0.5)[:, :, PREAMBLE_SLOTS:]
            undenoised = np.zeros(margin.shape[1], bool)
            n_strips = view.acquisition.binned.light.shape[1]
            features = confidence.confidence_features(self.posteriors, margin, undenoised, n_strips)[0]
        index = self.number - int(view.numbers[0])
        return confidence.BurstInClip(
            self.number, index, self.posteriors, self.n_observed, self.frames, features, against
        )


def bursts_of(view: View, tried: BoolArray) -> list[Burst]:
    """What a frame shows of its bursts; `tried` (C,) are the columns to detect."""
    assert view.numbers is not None
    own = view.bursts
    metrics = channel.by_burst(own.metrics, own.clock)
    return [
        Burst(number, metrics[index], own.shown[own.clock.burst == index].sum(axis=0), (own.frame,), own.tracked, tried)
        for index, number in enumerate(view.numbers.tolist())
    ]


def has_light(view: View) -> BoolArray:
    """(C,) columns of a frame with enough light to try; now and then, and of a photograph, all of them."""
    if view.flat is None or (view.bursts.frame + 1) % SETTINGS.try_dark_every == 0:
        return np.ones(len(view.snr), bool)
    return np.asarray(view.snr[:, 0] >= SETTINGS.dark_snr)


def lit_slots(view: View, bursts: Sequence[Burst]) -> Float32Array:
    """(C, N) probability that each slot of a frame is lit, by what is known of its bursts."""
    assert view.numbers is not None
    numbers, clock = view.numbers, view.bursts.clock
    lit = np.full((numbers.size, len(view.snr), clock.packet_slots), 0.5, np.float32)
    for burst in bursts:
        lit[numbers == burst.number] = burst.posteriors.lit[0]
    return clock.on_grid(lit)


def doubts(view: View, bursts: Sequence[Burst]) -> tuple[int, int]:
    """Numbers of doubtful packets and of all packets, among complete packets of a frame in well-lit columns."""
    lit = np.median(view.snr, axis=1) >= SETTINGS.well_lit_snr
    n_doubtful = n_whole = 0
    for burst in bursts:
        whole = assemble.complete(burst.n_observed[None])[0] & lit
        log_prob = burst.posteriors.log_prob[0].sum(axis=1)[whole]
        n_doubtful += int((log_prob < SETTINGS.doubtful_log_prob).sum())
        n_whole += log_prob.size
    return n_doubtful, n_whole


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


@lru_cache(maxsize=8)
def _unobserved(n_columns: int, n_metrics: int, n_patterns: int) -> BurstPosteriors:
    """Posteriors of the columns of a burst without light."""
    middle = np.arange(len(WEIGHTS)) == len(WEIGHTS) // 2
    blank = detect.detect(np.zeros((1, 1, n_metrics, n_patterns)), middle[None])
    return replace(blank, lit=np.full_like(blank.lit, 0.5)).of_columns(np.zeros(n_columns, np.int64))
