"""Maximum-likelihood detection of MPPM symbols under inter-symbol interference, soft.

The channel hands over one log-likelihood for every slot and every pattern of the slot and its `isi_memory`
predecessors. Copies of a packet are added. A trellis over symbols, whose state is the last `isi_memory` slots of the
previous symbol and whose branches are the codewords, then gives the posterior of every symbol (forward-backward;
Bahl et al., IEEE Trans. Inf. Theory 20(2), 1974). Header and dimming symbol are
known once `w` is, so both ends of the trellis are fixed, and the sum over all paths is the evidence for `w`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import comb

import numpy as np
from numpy.typing import NDArray

from rxcli.protocol import (
    HEADER,
    PREAMBLE_SLOTS,
    SLOTS_PER_SYMBOL,
    WEIGHTS,
    bits_per_symbol,
    codebook,
    dimming_symbol,
    slot_patterns,
)
from rxcli.receiver.decode.settings import SETTINGS
from rxcli.receiver.light import MAX_MEMORY
from rxcli.types import BurstPosteriors, Float32Array, FloatArray

#: Likelihoods, over that of the likeliest state, are taken to be at least this, so that their logarithm exists.
_LEAST = 1e-300
#: The same for words, a logarithm: what float32 holds.
_MIN_WORD = -85.0
#: Probabilities below this are not told apart.
_TINY = 1e-30
#: Slots after which likelihoods that shrink are scaled, and the least of a slot, so that none is lost till then.
_SCALED_AFTER, _MIN_SLOT_PROBABILITY = 4, 1e-60
#: Metrics that are worked on together: more leave the processor's cache, fewer take more calls.
_AT_ONCE = 250_000


@dataclass(frozen=True, slots=True)
class _Branches:
    """Branches of one symbol of weight w: every codeword from every state.

    The first slots of a word share metrics with the state it comes from, the others are the word's alone. So what is
    said of words and what is said of states and words' beginnings are worked out apart.
    """

    #: (words, 10) uint8.
    words: NDArray[np.uint8]
    #: ((10 - memory) * patterns, words): which metrics a word adds up from the first slot that no state reaches.
    features: FloatArray
    #: (words,) the word's first slots, and its last ones, as states.
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    #: (words, states * states): 1 where a word begins and ends so.
    passes: Float32Array
    #: Patterns of header and dimming symbol, from the first slot whose predecessors are known.
    preamble: NDArray[np.int64]
    #: State that header and dimming symbol end in.
    initial_state: int
    #: (states, memory) patterns of the next header's first slots after each state.
    tail: NDArray[np.int64]


def _pattern_index(slots: NDArray[np.integer], isi_memory: int) -> NDArray[np.int64]:
    """Index of the pattern at every slot that has `isi_memory` predecessors; (..., n) to (..., n - memory)."""
    windows = np.lib.stride_tricks.sliding_window_view(slots.astype(np.int64), isi_memory + 1, axis=-1)
    return windows @ (1 << np.arange(isi_memory, -1, -1))


def _states(isi_memory: int) -> NDArray[np.int64]:
    """(states, memory) the slots that each state stands for."""
    states: NDArray[np.int64] = (np.arange(1 << isi_memory)[:, None] >> np.arange(isi_memory - 1, -1, -1)) & 1
    return states


@lru_cache(maxsize=8)
def _boundary_patterns(isi_memory: int) -> NDArray[np.int64]:
    """(memory, states * beginnings) pattern at each of a word's first slots, by the state before and these slots."""
    states = _states(isi_memory)
    either = np.concatenate([np.repeat(states, len(states), axis=0), np.tile(states, (len(states), 1))], axis=1)
    return np.ascontiguousarray(_pattern_index(either, isi_memory).T)


@lru_cache(maxsize=64)
def _branches(w: int, isi_memory: int) -> _Branches:
    words = codebook(w)
    n_states = 1 << isi_memory
    index = _pattern_index(words, isi_memory)
    features = (index[..., None] == np.arange(2 * n_states)).reshape(len(words), -1)
    place = 1 << np.arange(isi_memory - 1, -1, -1)
    first, last = words[:, :isi_memory] @ place, words[:, SLOTS_PER_SYMBOL - isi_memory :] @ place
    passes = (first * n_states + last)[:, None] == np.arange(n_states * n_states)
    preamble = np.concatenate([np.array(HEADER, np.int64), dimming_symbol(w)])
    header = np.broadcast_to(np.array(HEADER[:isi_memory], np.int64), (n_states, isi_memory))
    return _Branches(
        words,
        np.ascontiguousarray(features.T, np.float64),
        first,
        last,
        passes.astype(np.float32),
        _pattern_index(preamble, isi_memory),
        int(_pattern_index(preamble[PREAMBLE_SLOTS - isi_memory :], isi_memory - 1)[0]),
        _pattern_index(np.concatenate([_states(isi_memory), header], axis=1), isi_memory),
    )


def _log_sum(values: FloatArray, axis: int) -> FloatArray:
    top = values.max(axis=axis, keepdims=True)
    return np.asarray((top + np.log(np.exp(values - top).sum(axis=axis, keepdims=True))).squeeze(axis))


def _reduce_short_axis(combine: np.ufunc, values: FloatArray) -> FloatArray:
    """Sum or maximum over a short last axis, where going by slices is quicker than a reduction."""
    total = values[..., 0]
    for number in range(1, values.shape[-1]):
        total = combine(total, values[..., number])
    return total


@dataclass(frozen=True, slots=True)
class _Payload:
    """What n packets' metrics say of the N symbols of their payload, whatever their weight."""

    #: (n, packet + memory, patterns).
    metrics: FloatArray
    #: (N, n, states, beginnings) likelihood of each beginning of a word after each state over that of the likeliest,
    #: and (n,) the logarithm of that, added up.
    meeting: FloatArray
    log_scale: FloatArray

    @property
    def isi_memory(self) -> int:
        return _isi_memory_of(self.metrics)

    @property
    def n_symbols(self) -> int:
        return len(self.meeting)

    def of_packets(self, packets: NDArray[np.int64]) -> _Payload:
        return _Payload(self.metrics[packets], self.meeting[:, packets], self.log_scale[packets])


def _payload_of(metrics: FloatArray) -> _Payload:
    """The payload of packets from their metrics (n, packet + memory, patterns)."""
    isi_memory = _isi_memory_of(metrics)
    n, length, n_patterns = metrics.shape
    by_packet = metrics[:, PREAMBLE_SLOTS : length - isi_memory].reshape(n, -1, SLOTS_PER_SYMBOL, n_patterns)
    slots = by_packet.swapaxes(0, 1).reshape(-1, SLOTS_PER_SYMBOL, n_patterns)
    patterns = _boundary_patterns(isi_memory)
    meeting = slots[:, 0].take(patterns[0], axis=1)
    for slot in range(1, isi_memory):
        meeting += slots[:, slot].take(patterns[slot], axis=1)
    meeting, top = _over_likeliest(meeting)
    n_states = 1 << isi_memory
    return _Payload(metrics, meeting.reshape(-1, n, n_states, n_states), top.reshape(-1, n).sum(axis=0))


@dataclass(frozen=True, slots=True)
class _Trellis:
    """n packets of one weight as a trellis over their symbols, in likelihoods over those of the likeliest."""

    branches: _Branches
    #: (n,) logarithm of what all words share, and of what the others are scaled by.
    common: FloatArray
    #: (N, n, states, beginnings) as in `_Payload`.
    meeting: FloatArray
    #: (N, n, words) float32: likelihood of each word's slots from the first that no state before it reaches.
    rest: Float32Array
    #: (n, states) before the first symbol, and what the header that follows says of the last.
    start: FloatArray
    end: FloatArray

    def transitions(self) -> FloatArray:
        """(N, n, states, states) likelihood of all words from each state to each state."""
        passing: FloatArray = (self.rest @ self.branches.passes).reshape(self.meeting.shape).astype(np.float64)
        return np.asarray(np.matmul(self.meeting, passing))

    def word_posteriors(self, before: FloatArray, after: FloatArray, packets: NDArray[np.int64]) -> FloatArray:
        """(packets, N, words) probability of the words of some packets.

        Args:
            before: (N + 1, n, states) likelihood of what leads to each state before a symbol.
            after: likewise, of what follows.
            packets: those that are asked for.
        """
        leads = np.matmul(before[:-1, packets, None], self.meeting[:, packets])[:, :, 0]
        joint = leads.take(self.branches.first, axis=2)
        joint *= self.rest[:, packets]
        joint *= after[1:, packets].take(self.branches.last, axis=2)
        total = joint.sum(axis=2, keepdims=True)
        uniform = np.full_like(joint, 1 / joint.shape[2])
        return np.asarray(np.divide(joint, total, out=uniform, where=total > 0)).swapaxes(0, 1)


@dataclass(frozen=True, slots=True)
class _Hypothesis:
    """Columns as ones of a weight: their packets' trellis, burst by burst, and what came of it."""

    w: int
    #: (columns,) numbers of the columns.
    columns: NDArray[np.int64]
    trellis: _Trellis
    #: (N + 1, packets, states) likelihood of what leads to each state, and of what follows it, scaled.
    before: FloatArray
    after: FloatArray
    #: (columns,).
    log_evidence: FloatArray

    def word_posteriors(self, columns: NDArray[np.int64]) -> FloatArray:
        """(B, columns, N, words) probability of the words of some of its columns, by forward-backward."""
        packets = np.arange(len(self.trellis.common)).reshape(-1, len(self.columns))
        asked = packets[:, np.searchsorted(self.columns, columns)]
        posterior = self.trellis.word_posteriors(self.before, self.after, asked.ravel())
        return posterior.reshape(*asked.shape, *posterior.shape[1:])


def _hypotheses(payload: _Payload, candidates: NDArray[np.bool_]) -> list[_Hypothesis]:
    """The packets of C columns as ones of every weight that may be, (C, 9)."""
    packets = np.arange(len(payload.metrics)).reshape(-1, len(candidates))
    columns = {w: np.flatnonzero(candidates[:, w - 1]) for w in WEIGHTS}
    weights = [w for w in WEIGHTS if columns[w].size]
    trellises = [_trellis(payload.of_packets(packets[:, columns[w]].ravel()), w) for w in weights]
    # One chain for all weights, there and back: symbols come one after the other, whatever else is worked on together.
    there = np.concatenate([trellis.transitions() for trellis in trellises], axis=1)
    back = there[::-1].swapaxes(2, 3)
    ends = [np.concatenate([getattr(trellis, end) for trellis in trellises]) for end in ("start", "end")]
    states, log_scale = _chain(np.concatenate([there, back], axis=1), np.concatenate(ends))
    n = there.shape[1]
    before, after = states[:, :n], states[::-1, n:]
    last = np.log(np.maximum((before[-1] * ends[1]).sum(axis=1), _LEAST)) + log_scale[:n]
    out, first = [], 0
    for w, trellis in zip(weights, trellises, strict=True):
        part = slice(first, first + len(trellis.common))
        log_evidence = (trellis.common + last[part]).reshape(-1, columns[w].size).sum(axis=0)
        out.append(_Hypothesis(w, columns[w], trellis, before[:, part], after[:, part], log_evidence))
        first = part.stop
    return out


def _chain(transitions: FloatArray, first: FloatArray) -> tuple[FloatArray, FloatArray]:
    """States (N + 1, n, S) that transitions (N, n, S, S) lead to from the first (n, S), each over its likeliest; and
    (n,) the logarithm of what they were scaled by altogether."""
    states = np.empty((len(transitions) + 1, *first.shape))
    tops = np.empty((len(transitions), len(first), 1))
    states[0] = first
    for before, transition, after, top in zip(states, transitions, states[1:], tops, strict=False):
        np.matmul(before[:, None], transition, out=after[:, None])
        np.maximum(after.max(axis=1, keepdims=True), _LEAST, out=top)
        after /= top
    return states, np.log(tops[..., 0]).sum(axis=0)


def _trellis(payload: _Payload, w: int) -> _Trellis:
    """The trellis of n packets as ones of weight `w`."""
    metrics, isi_memory, n_symbols = payload.metrics, payload.isi_memory, payload.n_symbols
    branches = _branches(w, isi_memory)
    n, length, n_patterns = metrics.shape
    known = metrics[:, np.arange(isi_memory, PREAMBLE_SLOTS), branches.preamble].sum(axis=1)
    slots = metrics[:, PREAMBLE_SLOTS : length - isi_memory].reshape(n * n_symbols, -1)
    of_words = slots[:, isi_memory * n_patterns :] @ branches.features
    top = of_words.max(axis=1)
    of_words -= top[:, None]
    # Words add up to one: seven digits are enough, and a fifth of the time.
    rest = np.exp(np.maximum(of_words, _MIN_WORD).astype(np.float32))
    end, top_end = _over_likeliest(metrics[:, length - isi_memory + np.arange(isi_memory), branches.tail].sum(axis=2))
    start = np.zeros((n, 1 << isi_memory))
    start[:, branches.initial_state] = 1.0
    scale = payload.log_scale + top.reshape(n, -1).sum(axis=1) + top_end[:, 0]
    return _Trellis(
        branches,
        known + scale - n_symbols * np.log(rest.shape[1]),
        payload.meeting,
        rest.reshape(n, n_symbols, -1).swapaxes(0, 1),
        start,
        end,
    )


def _over_likeliest(log_values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Exponentials of the last axis over the largest there, and the largest itself, (..., 1)."""
    top = log_values.max(axis=-1, keepdims=True)
    return np.exp(log_values - top), top


def slot_llr(metrics: FloatArray) -> Float32Array:
    """Log-likelihood ratio of every slot being lit, each slot on its own, its neighbours lit or not alike.

    A slot shows in its own metric and in the `isi_memory` metrics after it; what each says of it is added.

    Args:
        metrics: (..., N + memory, patterns).

    Returns:
        (..., N) float32.
    """
    isi_memory = _isi_memory_of(metrics)
    n_slots = metrics.shape[-2] - isi_memory
    likelihood = np.exp((metrics - _reduce_short_axis(np.maximum, metrics)[..., None]).astype(np.float32))
    sums = np.log(likelihood @ _lit_and_dark(isi_memory) + np.float32(_TINY))
    odds = sums[..., : isi_memory + 1] - sums[..., isi_memory + 1 :]
    return np.asarray(sum(odds[..., age : age + n_slots, age] for age in range(isi_memory + 1)), np.float32)


@lru_cache(maxsize=8)
def _lit_and_dark(isi_memory: int) -> Float32Array:
    """(patterns, 2 * (memory + 1)): 1 where the slot `age` slots ago is lit, by age; and where it is dark."""
    lit = slot_patterns(isi_memory)[:, ::-1].astype(np.float32)
    return np.concatenate([lit, 1 - lit], axis=1)


def slot_margin(metrics: FloatArray, decided: NDArray[np.bool_]) -> Float32Array:
    """What the light says for every slot as decided against the other way, all other slots as decided, nats.

    It is what a single slot has to say; a packet may be sure as a whole and yet have slots that say much against it.

    Args:
        metrics: (..., N + memory, patterns).
        decided: (..., N) whether each slot is lit; those around them are taken to be dark.

    Returns:
        (..., N) float32, 0 where nothing is seen.
    """
    isi_memory, n_slots = _isi_memory_of(metrics), decided.shape[-1]
    around = [(0, 0)] * (decided.ndim - 1)
    pattern = _pattern_index(np.pad(decided, [*around, (isi_memory, isi_memory)]).astype(np.uint8), isi_memory)
    margin = np.zeros(decided.shape)
    for age in range(isi_memory + 1):
        metric, index = metrics[..., age : age + n_slots, :], pattern[..., age : age + n_slots, None]
        margin += (np.take_along_axis(metric, index, -1) - np.take_along_axis(metric, index ^ (1 << age), -1))[..., 0]
    return margin.astype(np.float32)


def plausible_weights(metrics: FloatArray, margin: float) -> NDArray[np.bool_]:
    """Weights that stand up to a quick look, (C, 9): the best one and those within `margin` nats of it.

    Slots are taken as independent, and a symbol of weight w as any of the C(10, w) words, so that the likelihoods of
    all weights are the coefficients of a polynomial: the product over the symbol's slots of 1 + x exp(llr).

    Args:
        metrics: (B, C, packet + memory, patterns) log-likelihoods of B bursts.
        margin: nats.
    """
    score = _weight_scores(_symbols_llr(metrics))
    # The metrics that a slot shares with its neighbours were counted for each of them.
    lead = margin * (_isi_memory_of(metrics) + 1) / 2
    return np.asarray(score >= score.max(axis=1, keepdims=True) - lead)


def _symbols_llr(metrics: FloatArray) -> Float32Array:
    """(B, C, symbols, 10) log-likelihood ratios of the slots of packets, header first."""
    llr = slot_llr(metrics)[:, :, : metrics.shape[2] - _isi_memory_of(metrics)]
    return llr.reshape(*llr.shape[:2], -1, SLOTS_PER_SYMBOL)


def _weight_scores(symbols: Float32Array) -> FloatArray:
    """(C, 9) log-likelihood of every weight from the log-likelihood ratios (B, C, symbols, 10) of slots."""
    symbols = np.clip(symbols, -SETTINGS.max_slot_llr, SETTINGS.max_slot_llr)
    payload = symbols[:, :, 2:]
    coefficients = np.zeros((*payload.shape[:3], SLOTS_PER_SYMBOL + 1))
    coefficients[..., 0] = 1.0
    for slot in np.moveaxis(np.exp(payload), 3, 0):
        coefficients[..., 1:] += coefficients[..., :-1] * slot[..., None]
    words = np.array([comb(SLOTS_PER_SYMBOL, w) for w in WEIGHTS])
    score = np.log(coefficients[..., 1:SLOTS_PER_SYMBOL] / words).sum(axis=(0, 2))
    return np.asarray(score + np.cumsum(symbols[:, :, 1], axis=2)[..., : len(WEIGHTS)].sum(axis=0))


def initial_slot_probability(metrics: FloatArray) -> Float32Array:
    """Probability of every slot of B bursts being lit, (B, C, packet), every symbol by itself.

    What slots share with their neighbours is told by `slot_llr` alone, so that no trellis is needed; as a start for the
    light model that is as good where an exposure is hardly longer than a slot.

    Args:
        metrics: (B, C, packet + memory, patterns) log-likelihoods.
    """
    symbols = _symbols_llr(metrics)
    weights = _weight_scores(symbols).argmax(axis=1) + 1
    lit = np.empty_like(symbols)
    for w in np.unique(weights):
        columns = np.flatnonzero(weights == w)
        lit[:, columns, :2] = np.stack([np.array(HEADER), dimming_symbol(int(w))])
        words = codebook(int(w)).astype(np.float32)
        score = symbols[:, columns, 2:] @ words.T
        likely = np.exp(score - score.max(axis=3, keepdims=True))
        lit[:, columns, 2:] = likely @ words / likely.sum(axis=3, keepdims=True)
    return lit.reshape(*lit.shape[:2], -1)


def weight_log_evidence(metrics: FloatArray, candidates: NDArray[np.bool_]) -> FloatArray:
    """Log evidence of every weight, (C, 9); -inf where it is not among the `candidates`.

    Args:
        metrics: (B, C, packet + memory, patterns) log-likelihoods of B bursts.
        candidates: (C, 9) which weights to try for each column.
    """
    out = np.empty(candidates.shape)
    for columns in _batches(metrics):
        out[columns] = _of_weights(
            _hypotheses(_payload_of(_packets(metrics, columns)), candidates[columns]), columns.size
        )
    return out


def _packets(metrics: FloatArray, columns: NDArray[np.int64]) -> FloatArray:
    """(B * columns, packet + memory, patterns) the packets of some columns, burst by burst."""
    return metrics[:, columns].reshape(-1, *metrics.shape[2:])


def _of_weights(hypotheses: list[_Hypothesis], n_columns: int) -> FloatArray:
    """(C, 9) log evidence of every weight, -inf where nobody asked."""
    out = np.full((n_columns, len(WEIGHTS)), -np.inf)
    for hypothesis in hypotheses:
        out[hypothesis.columns, hypothesis.w - 1] = hypothesis.log_evidence
    return out


def free_log_evidence(metrics: FloatArray, share: FloatArray) -> FloatArray:
    """(C,) log evidence of slots that are no packets: each is lit on its own.

    Args:
        metrics: (C, n, patterns) log-likelihoods of the slots.
        share: (C,) probability that a slot is lit.
    """
    n_columns, _, n_patterns = metrics.shape
    prior = np.log(np.stack([1 - share, share], axis=1))
    # A pattern is the state, the slots before, and the slot itself; the next state drops the oldest of them.
    by_slot, tops = _over_likeliest(metrics.swapaxes(0, 1) + np.tile(prior, n_patterns // 2))
    steps = np.maximum(by_slot, _MIN_SLOT_PROBABILITY).reshape(-1, n_columns, 2, n_patterns // 4, 2)
    log_evidence = tops[..., 0].sum(axis=0)
    state = np.full((n_columns, n_patterns // 2), 2 / n_patterns)
    for number, step in enumerate(steps, 1):
        pattern = state.reshape(n_columns, 2, -1, 1) * step
        state = (pattern[:, 0] + pattern[:, 1]).reshape(n_columns, -1)
        if number % _SCALED_AFTER == 0:
            top = np.maximum(state.max(axis=1), _LEAST)
            log_evidence += np.log(top)
            state /= top[:, None]
    return np.asarray(log_evidence + np.log(np.maximum(state.sum(axis=1), _LEAST)))


def _isi_memory_of(metrics: FloatArray) -> int:
    return int(metrics.shape[-1]).bit_length() - 2


def detect(metrics: FloatArray, candidates: NDArray[np.bool_] | None = None) -> BurstPosteriors:
    """Weights and symbols of every burst and column.

    Args:
        metrics: (B, C, packet + memory, 2**(memory+1)) natural log-likelihoods, copies added: entry i, j is the
            log-likelihood of what was seen at slot i given pattern j of `protocol.slot_patterns`. The first
            `isi_memory` slots are not used; the last ones, as many, are the first slots of the header that follows.
        candidates: (C, 9) weights to consider, all by default.

    Returns:
        Posteriors; see `BurstPosteriors`.

    Raises:
        ValueError: shapes do not fit.
    """
    _check(metrics)
    if candidates is None:
        candidates = np.ones((metrics.shape[1], len(WEIGHTS)), bool)
    return _posteriors(metrics, candidates)


def _check(metrics: FloatArray) -> None:
    if metrics.ndim != 4 or metrics.shape[-1] not in {1 << (m + 1) for m in range(1, MAX_MEMORY + 1)}:
        raise ValueError(
            f"metrics must be (bursts, columns, slots, 2**(memory+1)) with memory 1..{MAX_MEMORY} (got {metrics.shape})"
        )
    n_payload = metrics.shape[2] - _isi_memory_of(metrics) - PREAMBLE_SLOTS
    if n_payload <= 0 or n_payload % SLOTS_PER_SYMBOL:
        raise ValueError(f"metrics must hold whole packets and memory slots after them (got {metrics.shape})")


@dataclass(frozen=True, slots=True)
class DoubtfulWords:
    """Symbols whose best word is not sure, and their K likeliest words."""

    #: (J, 3) burst, column and number of each symbol.
    places: NDArray[np.int64]
    #: (J, K, 10), best first.
    words: NDArray[np.uint8]
    #: (J, K).
    log_prob: FloatArray


def detect_with_candidates(
    metrics: FloatArray, candidates: NDArray[np.bool_], certain: float, most: int
) -> tuple[BurstPosteriors, DoubtfulWords]:
    """Weights and symbols as `detect` gives them, and the words between which it was in doubt.

    Args:
        metrics: as for `detect`.
        candidates: likewise.
        certain: log probability from which on a word is sure.
        most: words to give of each symbol, K; every code has eight.

    Raises:
        ValueError: shapes do not fit.
    """
    _check(metrics)
    found: list[DoubtfulWords] = []

    def on_posteriors(w: int, columns: NDArray[np.int64], word: FloatArray) -> None:
        found.append(_doubtful_words(word, w, columns, certain, most))

    posteriors = _posteriors(metrics, candidates, on_posteriors)
    return posteriors, DoubtfulWords(
        np.concatenate([f.places for f in found]),
        np.concatenate([f.words for f in found]),
        np.concatenate([f.log_prob for f in found]),
    )


def _doubtful_words(word: FloatArray, w: int, columns: NDArray[np.int64], certain: float, most: int) -> DoubtfulWords:
    """Symbols in doubt of columns of one weight, from the probability of every word, (B, columns, N, words)."""
    at = np.argwhere(word.max(axis=3) < np.exp(certain))
    doubtful = word[tuple(at.T)]
    order = np.argsort(-doubtful, axis=1)[:, :most]
    places = np.stack([at[:, 0], columns[at[:, 1]], at[:, 2]], axis=1)
    return DoubtfulWords(places, codebook(w)[order], np.log(np.take_along_axis(doubtful, order, axis=1) + _TINY))


def _posteriors(
    metrics: FloatArray,
    candidates: NDArray[np.bool_],
    on_posteriors: Callable[[int, NDArray[np.int64], FloatArray], None] | None = None,
) -> BurstPosteriors:
    """Posteriors of the weights that may be; `on_posteriors` gets weight, columns, (B, C, N, words) probabilities."""
    n_bursts, n_columns, length, _ = metrics.shape
    isi_memory = _isi_memory_of(metrics)
    n_symbols = (length - isi_memory - PREAMBLE_SLOTS) // SLOTS_PER_SYMBOL
    w_log_prob = np.empty((n_columns, len(WEIGHTS)))
    lit = np.empty((n_bursts, n_columns, length - isi_memory), np.float32)
    index = np.empty((n_bursts, n_columns, n_symbols), np.int64)
    log_prob = np.empty((n_bursts, n_columns, n_symbols))
    bit_llr = np.full((n_bursts, n_columns, n_symbols, 7), np.nan)
    log_evidence = np.empty(n_columns)
    for batch in _batches(metrics):
        hypotheses = _hypotheses(_payload_of(_packets(metrics, batch)), candidates[batch])
        w_log_evidence = _of_weights(hypotheses, batch.size)
        log_evidence[batch] = _log_sum(w_log_evidence, 1)
        w_log_prob[batch] = w_log_evidence - log_evidence[batch][:, None]
        weights = w_log_prob[batch].argmax(axis=1) + 1
        for hypothesis in hypotheses:
            alike, w = np.flatnonzero(weights == hypothesis.w), hypothesis.w
            if not alike.size:
                continue
            columns, posterior = batch[alike], hypothesis.word_posteriors(alike)
            if on_posteriors is not None:
                on_posteriors(w, columns, posterior)
            lit[:, columns, :PREAMBLE_SLOTS] = np.concatenate([np.array(HEADER), dimming_symbol(w)])
            lit[:, columns, PREAMBLE_SLOTS:] = (posterior @ codebook(w)).reshape(n_bursts, columns.size, -1)
            index[:, columns] = best = posterior.argmax(axis=3)
            log_prob[:, columns] = _log_of_best(posterior, best)
            bit_llr[:, columns, :, : bits_per_symbol(w)] = _bit_llr(posterior, bits_per_symbol(w))
    weights = w_log_prob.argmax(axis=1) + 1
    return BurstPosteriors(weights, w_log_prob, log_evidence, lit, index, log_prob, bit_llr, _header_llr(metrics))


def _batches(metrics: FloatArray) -> list[NDArray[np.int64]]:
    """Columns of metrics (B, C, packet + memory, patterns), as many at a time as fit the cache."""
    n_bursts, n_columns, length, n_patterns = metrics.shape
    numbers = n_bursts * length * n_patterns
    return np.array_split(np.arange(n_columns), max(min(-(-n_columns * numbers // _AT_ONCE), n_columns), 1))


def _header_llr(metrics: FloatArray) -> FloatArray:
    """(B, C) log-likelihood of the header's slots as they must be, over slots that are anything with equal chance."""
    isi_memory = _isi_memory_of(metrics)
    header = metrics[:, :, isi_memory : len(HEADER)]
    known = header[:, :, np.arange(len(HEADER) - isi_memory), _pattern_index(np.array(HEADER), isi_memory)]
    anything = _log_sum(header, axis=3) - np.log(metrics.shape[-1])
    return np.asarray((known - anything).sum(axis=2))


def _log_of_best(posterior: FloatArray, best: NDArray[np.int64]) -> FloatArray:
    """Log of the largest probability, from the sum of the others so that 1 - 1e-12 is told from 1."""
    rest = posterior.copy()
    np.put_along_axis(rest, best[..., None], 0.0, -1)
    return np.asarray(np.log1p(-np.minimum(rest.sum(axis=-1), 1 - 1 / posterior.shape[-1])))


def _bit_llr(posterior: FloatArray, k: int) -> FloatArray:
    """(..., k) ln p(1)/p(0) from (..., 2**k) probabilities of the codebook indices."""
    bits = (np.arange(1 << k)[:, None] >> np.arange(k - 1, -1, -1)) & 1
    p_one, p_zero = posterior @ bits, posterior @ (1 - bits)
    return np.asarray(np.log(np.maximum(p_one, _TINY)) - np.log(np.maximum(p_zero, _TINY)))
