"""The bursts of a clip: the evidence of several frames is added, and detected when its result is needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, codewords
from rxcli.receiver import channel
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.clip.views import View
from rxcli.receiver.decode import assemble, confidence, detect
from rxcli.types import BoolArray, BurstPosteriors, Float32Array, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Burst:
    """What some frames show of a burst; the sum of two is what all their frames show."""

    #: Number in the clip.
    number: int
    #: (C, packet) log-likelihood ratio of every slot, of all frames together.
    llr: FloatArray
    #: (C, N, n) for the words of symbols, beyond their slots: `channel.word_metrics`, or log-likelihoods of joint
    #: detections, whose slots have no ratios; (C, 1, 1) without any.
    words: Float32Array
    #: (C, packet) number of observations of each slot.
    n_observed: IntArray
    frames: tuple[int, ...]
    #: Numbers of the copies whose payload they show.
    copies: IntArray
    #: Whether the picture was known from other frames in any of them.
    tracked: bool

    def __add__(self, burst: Burst) -> Burst:
        return Burst(
            self.number,
            self.llr + burst.llr,
            _added(self.words, burst.words),
            self.n_observed + burst.n_observed,
            self.frames + burst.frames,
            np.union1d(self.copies, burst.copies),
            self.tracked or burst.tracked,
        )

    @cached_property
    def posteriors(self) -> BurstPosteriors:
        """Of this burst alone."""
        return detect.detect(self.llr[None], beyond_slots=_by_word(self.words)[None])

    @property
    def certain(self) -> BoolArray:
        """(C,) columns that further frames add nothing to."""
        return np.asarray(self.posteriors.log_prob[0].min(axis=1) >= SETTINGS.certain_log_prob)

    def probability(self, column: int) -> float:
        """Probability of a column's packet as detected, by the light model alone."""
        return float(np.exp(self.posteriors.log_prob[0, column].sum()))

    def ended(self, view: View) -> confidence.BurstInView:
        """What is reported of it; `view` is of the last frame that shows it."""
        assert view.numbers is not None
        features = against = None
        margin = (np.where(self.posteriors.lit[0] > 0.5, self.llr, -self.llr)[:, PREAMBLE_SLOTS:]).astype(np.float32)
        if self.tracked:
            against = np.maximum(-margin, 0).max(axis=1)
        else:
            undenoised, joint = np.zeros(len(margin), bool), np.full(len(margin), view.joint is not None)
            n_strips = view.acquisition.binned.light.shape[1]
            features = confidence.confidence_features(self.posteriors, margin[None], undenoised, n_strips, joint)[0]
        index = self.number - int(view.numbers[0])
        return confidence.BurstInView(
            self.number, index, self.posteriors, self.n_observed, self.frames, features, against
        )


def _added(words: Float32Array, more: Float32Array) -> Float32Array:
    return words + more if words.shape == more.shape else _by_word(words) + _by_word(more)


def _by_word(words: Float32Array) -> Float32Array:
    """(C, N, words) log-likelihoods of words, which joint detections give at once; (C, 1, 1) without any."""
    return words if words.shape[-1] in (1, len(codewords()[0])) else channel.beyond_slots(words)


def bursts_of(view: View) -> list[Burst]:
    """What a frame shows of its bursts."""
    assert view.numbers is not None
    llr = view.clock.by_burst(view.llr)
    shows_payload = view.shown[..., PREAMBLE_SLOTS:].any(axis=(1, 2))
    # Copies that were detected together under another assignment count by themselves.
    joint = view.joint if view.joint and np.array_equal(view.joint.burst, view.clock.burst) else None
    bursts: list[Burst] = []
    if joint is not None:
        words = detect.log_words(joint.posteriors)
    elif view.words is not None:
        words = view.clock.added(view.words)[:, :, PREAMBLE_SLOTS // SLOTS_PER_SYMBOL :]
    else:
        words = np.zeros((len(llr), 1, 1, 1), np.float32)
    for index, number in enumerate(view.numbers.tolist()):
        which = view.clock.burst == index
        copies, n_observed = view.first_copy + np.flatnonzero(which & shows_payload), view.shown[which].sum(axis=0)
        own = llr[index]
        if joint is not None:
            own = channel.llr_of(joint.posteriors.lit[index]) * (n_observed > 0)
            own[:, PREAMBLE_SLOTS:] = 0
        bursts.append(Burst(number, own, words[index], n_observed, (view.context.frame.index,), copies, view.tracked))
    return bursts


def lit_slots(view: View, bursts: Sequence[Burst]) -> Float32Array:
    """(C, N) probability that each slot of a frame is lit, by what is known of its bursts."""
    assert view.numbers is not None
    numbers, clock = view.numbers, view.clock
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
