"""Maximum-likelihood detection of MPPM symbols under inter-symbol interference, soft.

The input is one log-likelihood for every slot and every pattern of the slot and its `isi_memory` predecessors, added
over the copies of a packet. A trellis over symbols, whose state is the last `isi_memory` slots of the
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

#: Lower limit of likelihoods relative to the likeliest state, so that their logarithm exists.
_MIN_LIKELIHOOD = 1e-300
#: The same for words, as a logarithm: the range of float32.
_MIN_WORD = -85.0
#: Lower limit of probabilities.
_TINY = 1e-30
#: Slots between rescalings of likelihoods, and the lower limit of a slot's, so that none underflows in between.
_SCALED_AFTER, _MIN_SLOT_PROBABILITY = 4, 1e-60
#: Metrics per batch: more exceed the processor's cache, fewer take more calls.
_AT_ONCE = 250_000


@dataclass(frozen=True, slots=True)
class _Branches:
    """Branches of one symbol of weight w: every codeword from every state.

    The metrics of a word's first slots depend on the preceding state too, those of the other slots on the word alone.
    Both parts are computed separately.
    """

    #: (words, 10) uint8.
    words: NDArray[np.uint8]
    #: ((10 - memory) * patterns, words): metrics that a word adds up from the first slot no preceding state reaches.
    features: FloatArray
    #: (words,) the word's first `memory` slots, and its last ones, as state numbers.
    prefix: NDArray[np.int64]
    suffix: NDArray[np.int64]
    #: (words, states * states): 1 at the word's prefix and suffix.
    transition: Float32Array
    #: Patterns of header and dimming symbol, from the first slot whose predecessors are known.
    preamble: NDArray[np.int64]
    #: State after header and dimming symbol.
    initial_state: int
    #: (states, memory) patterns of the next header's first slots after each state.
    header: NDArray[np.int64]


def _pattern_index(slots: NDArray[np.integer], isi_memory: int) -> NDArray[np.int64]:
    """(..., n - memory) pattern index at every slot of (..., n) that has `isi_memory` predecessors."""
    windows = np.lib.stride_tricks.sliding_window_view(slots.astype(np.int64), isi_memory + 1, axis=-1)
    return windows @ (1 << np.arange(isi_memory, -1, -1))


def _states(isi_memory: int) -> NDArray[np.int64]:
    """(states, memory) slots of each state."""
    states: NDArray[np.int64] = (np.arange(1 << isi_memory)[:, None] >> np.arange(isi_memory - 1, -1, -1)) & 1
    return states


@lru_cache(maxsize=8)
def _boundary_patterns(isi_memory: int) -> NDArray[np.int64]:
    """(memory, states * prefixes) pattern at each of a word's first slots, by preceding state and prefix."""
    states = _states(isi_memory)
    slots = np.concatenate([np.repeat(states, len(states), axis=0), np.tile(states, (len(states), 1))], axis=1)
    return np.ascontiguousarray(_pattern_index(slots, isi_memory).T)


@lru_cache(maxsize=64)
def _branches(w: int, isi_memory: int) -> _Branches:
    words = codebook(w)
    n_states = 1 << isi_memory
    index = _pattern_index(words, isi_memory)
    features = (index[..., None] == np.arange(2 * n_states)).reshape(len(words), -1)
    place = 1 << np.arange(isi_memory - 1, -1, -1)
    prefix, suffix = words[:, :isi_memory] @ place, words[:, SLOTS_PER_SYMBOL - isi_memory :] @ place
    transition = (prefix * n_states + suffix)[:, None] == np.arange(n_states * n_states)
    preamble = np.concatenate([np.array(HEADER, np.int64), dimming_symbol(w)])
    header = np.broadcast_to(np.array(HEADER[:isi_memory], np.int64), (n_states, isi_memory))
    return _Branches(
        words,
        np.ascontiguousarray(features.T, np.float64),
        prefix,
        suffix,
        transition.astype(np.float32),
        _pattern_index(preamble, isi_memory),
        int(_pattern_index(preamble[PREAMBLE_SLOTS - isi_memory :], isi_memory - 1)[0]),
        _pattern_index(np.concatenate([_states(isi_memory), header], axis=1), isi_memory),
    )


def _log_sum(values: FloatArray, axis: int) -> FloatArray:
    top = values.max(axis=axis, keepdims=True)
    return np.asarray((top + np.log(np.exp(values - top).sum(axis=axis, keepdims=True))).squeeze(axis))


def _reduce_short_axis(combine: np.ufunc, values: FloatArray) -> FloatArray:
    """Sum or maximum over a short last axis; faster by slices than as a reduction."""
    total = values[..., 0]
    for number in range(1, values.shape[-1]):
        total = combine(total, values[..., number])
    return total


@dataclass(frozen=True, slots=True)
class _Payload:
    """Metrics of the N payload symbols of n packets, independent of the weight."""

    #: (n, packet + memory, patterns).
    metrics: FloatArray
    #: (N, n, states, prefixes) likelihood of each prefix of a word after each state relative to the likeliest pair, and
    #: (n,) the logarithm of the latter, summed over the symbols.
    boundary: FloatArray
    log_scale: FloatArray

    @property
    def isi_memory(self) -> int:
        return _isi_memory_of(self.metrics)

    @property
    def n_symbols(self) -> int:
        return len(self.boundary)

    def of_packets(self, packets: NDArray[np.int64]) -> _Payload:
        return _Payload(self.metrics[packets], self.boundary[:, packets], self.log_scale[packets])


def _payload_of(metrics: FloatArray) -> _Payload:
    """Split off the payload of packets, metrics (n, packet + memory, patterns)."""
    isi_memory = _isi_memory_of(metrics)
    n, length, n_patterns = metrics.shape
    by_packet = metrics[:, PREAMBLE_SLOTS : length - isi_memory].reshape(n, -1, SLOTS_PER_SYMBOL, n_patterns)
    slots = by_packet.swapaxes(0, 1).reshape(-1, SLOTS_PER_SYMBOL, n_patterns)
    patterns = _boundary_patterns(isi_memory)
    boundary = slots[:, 0].take(patterns[0], axis=1)
    for slot in range(1, isi_memory):
        boundary += slots[:, slot].take(patterns[slot], axis=1)
    boundary, top = _over_likeliest(boundary)
    n_states = 1 << isi_memory
    return _Payload(metrics, boundary.reshape(-1, n, n_states, n_states), top.reshape(-1, n).sum(axis=0))


@dataclass(frozen=True, slots=True)
class _Trellis:
    """Trellis over the symbols of n packets of one weight; likelihoods are relative to the likeliest."""

    branches: _Branches
    #: (n,) logarithm of the factors common to all words.
    log_scale: FloatArray
    #: (N, n, states, prefixes) as in `_Payload`.
    boundary: FloatArray
    #: (N, n, words) float32: likelihood of each word's slots from the first that no preceding state reaches.
    remainder: Float32Array
    #: (n, states) likelihoods before the first symbol, and after the last one by the header that follows.
    start: FloatArray
    end: FloatArray

    def transitions(self) -> FloatArray:
        """(N, n, states, states) likelihood of all words from each state to each state."""
        words: FloatArray = (self.remainder @ self.branches.transition).reshape(self.boundary.shape).astype(np.float64)
        return np.asarray(np.matmul(self.boundary, words))

    def word_posteriors(self, before: FloatArray, after: FloatArray, packets: NDArray[np.int64]) -> FloatArray:
        """(packets, N, words) probability of the words of some packets.

        Args:
            before: (N + 1, n, states) forward likelihood of each state.
            after: (N + 1, n, states) backward likelihood of each state.
            packets: numbers of the packets.
        """
        leads = np.matmul(before[:-1, packets, None], self.boundary[:, packets])[:, :, 0]
        joint = leads.take(self.branches.prefix, axis=2)
        joint *= self.remainder[:, packets]
        joint *= after[1:, packets].take(self.branches.suffix, axis=2)
        total = joint.sum(axis=2, keepdims=True)
        uniform = np.full_like(joint, 1 / joint.shape[2])
        return np.asarray(np.divide(joint, total, out=uniform, where=total > 0)).swapaxes(0, 1)


@dataclass(frozen=True, slots=True)
class _Hypothesis:
    """Columns under the hypothesis of one weight: trellis of their packets, burst by burst, and its result."""

    w: int
    #: (columns,) numbers of the columns.
    columns: NDArray[np.int64]
    trellis: _Trellis
    #: (N + 1, packets, states) forward and backward likelihoods of the states, scaled.
    before: FloatArray
    after: FloatArray
    #: (columns,).
    log_evidence: FloatArray

    def word_posteriors(self, columns: NDArray[np.int64]) -> FloatArray:
        """(B, columns, N, words) probability of the words of some of its columns, by forward-backward."""
        packets = np.arange(len(self.trellis.log_scale)).reshape(-1, len(self.columns))
        chosen = packets[:, np.searchsorted(self.columns, columns)]
        posterior = self.trellis.word_posteriors(self.before, self.after, chosen.ravel())
        return posterior.reshape(*chosen.shape, *posterior.shape[1:])


def _hypotheses(payload: _Payload, candidates: NDArray[np.bool_]) -> list[_Hypothesis]:
    """The packets of C columns under every candidate weight, (C, 9)."""
    packets = np.arange(len(payload.metrics)).reshape(-1, len(candidates))
    columns = {w: np.flatnonzero(candidates[:, w - 1]) for w in WEIGHTS}
    weights = [w for w in WEIGHTS if columns[w].size]
    trellises = [_trellis(payload.of_packets(packets[:, columns[w]].ravel()), w) for w in weights]
    # One chain for all weights, forward and backward: symbols are sequential, so everything else is batched.
    forward = np.concatenate([trellis.transitions() for trellis in trellises], axis=1)
    backward = forward[::-1].swapaxes(2, 3)
    ends = [np.concatenate([getattr(trellis, end) for trellis in trellises]) for end in ("start", "end")]
    states, log_scale = _chain(np.concatenate([forward, backward], axis=1), np.concatenate(ends))
    n = forward.shape[1]
    before, after = states[:, :n], states[::-1, n:]
    last = np.log(np.maximum((before[-1] * ends[1]).sum(axis=1), _MIN_LIKELIHOOD)) + log_scale[:n]
    out, start = [], 0
    for w, trellis in zip(weights, trellises, strict=True):
        part = slice(start, start + len(trellis.log_scale))
        log_evidence = (trellis.log_scale + last[part]).reshape(-1, columns[w].size).sum(axis=0)
        out.append(_Hypothesis(w, columns[w], trellis, before[:, part], after[:, part], log_evidence))
        start = part.stop
    return out


def _chain(transitions: FloatArray, initial: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Propagate initial states (n, S) through transitions (N, n, S, S).

    Returns:
        (N + 1, n, S) states, each relative to its likeliest; and (n,) the logarithm of the total scale.
    """
    states = np.empty((len(transitions) + 1, *initial.shape))
    tops = np.empty((len(transitions), len(initial), 1))
    states[0] = initial
    for before, transition, after, top in zip(states, transitions, states[1:], tops, strict=False):
        np.matmul(before[:, None], transition, out=after[:, None])
        np.maximum(after.max(axis=1, keepdims=True), _MIN_LIKELIHOOD, out=top)
        after /= top
    return states, np.log(tops[..., 0]).sum(axis=0)


def _trellis(payload: _Payload, w: int) -> _Trellis:
    """Build the trellis of n packets for weight `w`."""
    metrics, isi_memory, n_symbols = payload.metrics, payload.isi_memory, payload.n_symbols
    branches = _branches(w, isi_memory)
    n, length, n_patterns = metrics.shape
    known = metrics[:, np.arange(isi_memory, PREAMBLE_SLOTS), branches.preamble].sum(axis=1)
    slots = metrics[:, PREAMBLE_SLOTS : length - isi_memory].reshape(n * n_symbols, -1)
    word_scores = slots[:, isi_memory * n_patterns :] @ branches.features
    top = word_scores.max(axis=1)
    word_scores -= top[:, None]
    # Single precision suffices for probabilities and is much faster.
    remainder = np.exp(np.maximum(word_scores, _MIN_WORD).astype(np.float32))
    end, top_end = _over_likeliest(metrics[:, length - isi_memory + np.arange(isi_memory), branches.header].sum(axis=2))
    start = np.zeros((n, 1 << isi_memory))
    start[:, branches.initial_state] = 1.0
    scale = payload.log_scale + top.reshape(n, -1).sum(axis=1) + top_end[:, 0]
    return _Trellis(
        branches,
        known + scale - n_symbols * np.log(remainder.shape[1]),
        payload.boundary,
        remainder.reshape(n, n_symbols, -1).swapaxes(0, 1),
        start,
        end,
    )


def _over_likeliest(log_values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Exponentials over the last axis relative to the largest, and the largest value, (..., 1)."""
    top = log_values.max(axis=-1, keepdims=True)
    return np.exp(log_values - top), top


def slot_llr(metrics: FloatArray) -> Float32Array:
    """Log-likelihood ratio of each slot being lit, with its neighbours equally likely lit and dark.

    A slot contributes to its own metric and to the `isi_memory` metrics after it; their ratios are added.

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
    """(patterns, 2 * (memory + 1)): 1 where the slot `age` slots ago is lit, by age, then where it is dark."""
    lit = slot_patterns(isi_memory)[:, ::-1].astype(np.float32)
    return np.concatenate([lit, 1 - lit], axis=1)


def slot_margin(metrics: FloatArray, decided: NDArray[np.bool_]) -> Float32Array:
    """Log-likelihood ratio of each slot as decided against its opposite, all other slots as decided.

    A packet may be certain as a whole and still contain slots with strongly negative margins.

    Args:
        metrics: (..., N + memory, patterns).
        decided: (..., N) whether each slot is lit; slots before and after are assumed dark.

    Returns:
        (..., N) float32, 0 where nothing is visible.
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
    """Candidate weights, (C, 9): the likeliest one and all within a log-likelihood of `margin`.

    Slots count as independent and a symbol of weight w as any of the C(10, w) words. The likelihoods of all weights are
    then the coefficients of a polynomial, the product over the symbol's slots of 1 + x exp(llr).

    Args:
        metrics: (B, C, packet + memory, patterns) log-likelihoods of B bursts.
        margin: log-likelihood below the likeliest weight.
    """
    score = _weight_scores(_symbols_llr(metrics))
    # Each metric was counted once for every slot that it covers.
    lead = margin * (_isi_memory_of(metrics) + 1) / 2
    return np.asarray(score >= score.max(axis=1, keepdims=True) - lead)


def _symbols_llr(metrics: FloatArray) -> Float32Array:
    """(B, C, symbols, 10) log-likelihood ratios of the slots of packets, header first."""
    llr = slot_llr(metrics)[:, :, : metrics.shape[2] - _isi_memory_of(metrics)]
    return llr.reshape(*llr.shape[:2], -1, SLOTS_PER_SYMBOL)


def _weight_scores(symbols: Float32Array) -> FloatArray:
    """(C, 9) log-likelihood of every weight, from slot log-likelihood ratios (B, C, symbols, 10)."""
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
    """(B, C, packet) probability that each slot of B bursts is lit, with symbols treated as independent.

    Uses `slot_llr` instead of a trellis, which is a sufficient start for the light model while the exposure is hardly
    longer than a slot.

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
    """(C, 9) log evidence of every weight; -inf where it is not among the `candidates`.

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
    """(B * columns, packet + memory, patterns) packets of some columns, burst by burst."""
    return metrics[:, columns].reshape(-1, *metrics.shape[2:])


def _of_weights(hypotheses: list[_Hypothesis], n_columns: int) -> FloatArray:
    """(C, 9) log evidence of every weight, -inf where it is no candidate."""
    out = np.full((n_columns, len(WEIGHTS)), -np.inf)
    for hypothesis in hypotheses:
        out[hypothesis.columns, hypothesis.w - 1] = hypothesis.log_evidence
    return out


def free_log_evidence(metrics: FloatArray, share: FloatArray) -> FloatArray:
    """(C,) log evidence of arbitrary slots, each lit independently of the others.

    Args:
        metrics: (C, n, patterns) log-likelihoods of the slots.
        share: (C,) probability that a slot is lit.
    """
    n_columns, _, n_patterns = metrics.shape
    prior = np.log(np.stack([1 - share, share], axis=1))
    # A pattern is the state (the slots before) and the slot itself; the next state drops the oldest slot.
    by_slot, tops = _over_likeliest(metrics.swapaxes(0, 1) + np.tile(prior, n_patterns // 2))
    steps = np.maximum(by_slot, _MIN_SLOT_PROBABILITY).reshape(-1, n_columns, 2, n_patterns // 4, 2)
    log_evidence = tops[..., 0].sum(axis=0)
    state = np.full((n_columns, n_patterns // 2), 2 / n_patterns)
    for number, step in enumerate(steps, 1):
        pattern = state.reshape(n_columns, 2, -1, 1) * step
        state = (pattern[:, 0] + pattern[:, 1]).reshape(n_columns, -1)
        if number % _SCALED_AFTER == 0:
            top = np.maximum(state.max(axis=1), _MIN_LIKELIHOOD)
            log_evidence += np.log(top)
            state /= top[:, None]
    return np.asarray(log_evidence + np.log(np.maximum(state.sum(axis=1), _MIN_LIKELIHOOD)))


def _isi_memory_of(metrics: FloatArray) -> int:
    return int(metrics.shape[-1]).bit_length() - 2


def detect(metrics: FloatArray, candidates: NDArray[np.bool_] | None = None) -> BurstPosteriors:
    """Detect weights and symbols of every burst and column.

    Args:
        metrics: (B, C, packet + memory, 2**(memory+1)) natural log-likelihoods, copies added: entry i, j is the
            log-likelihood of the light at slot i given pattern j of `protocol.slot_patterns`. The first `isi_memory`
            slots are not used; the last `isi_memory` are the first slots of the header that follows.
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
    """Uncertain symbols and their K likeliest words."""

    #: (J, 3) burst, column and number of each symbol.
    places: NDArray[np.int64]
    #: (J, K, 10), best first.
    words: NDArray[np.uint8]
    #: (J, K).
    log_prob: FloatArray


def detect_with_candidates(
    metrics: FloatArray, candidates: NDArray[np.bool_], certain_log_prob: float, n_words: int
) -> tuple[BurstPosteriors, DoubtfulWords]:
    """Detect weights and symbols like `detect`, and return the candidate words of uncertain symbols.

    Args:
        metrics: as for `detect`.
        candidates: as for `detect`.
        certain_log_prob: log probability from which a word counts as certain.
        n_words: candidate words of each symbol, K; at most 8, the size of the smallest codebook.

    Raises:
        ValueError: shapes do not fit.
    """
    _check(metrics)
    found: list[DoubtfulWords] = []

    def on_posteriors(w: int, columns: NDArray[np.int64], word: FloatArray) -> None:
        found.append(_doubtful_words(word, w, columns, certain_log_prob, n_words))

    posteriors = _posteriors(metrics, candidates, on_posteriors)
    return posteriors, DoubtfulWords(
        np.concatenate([f.places for f in found]),
        np.concatenate([f.words for f in found]),
        np.concatenate([f.log_prob for f in found]),
    )


def _doubtful_words(
    word: FloatArray, w: int, columns: NDArray[np.int64], certain: float, n_words: int
) -> DoubtfulWords:
    """Uncertain symbols of columns of one weight, from word probabilities (B, columns, N, words)."""
    at = np.argwhere(word.max(axis=3) < np.exp(certain))
    doubtful = word[tuple(at.T)]
    order = np.argsort(-doubtful, axis=1)[:, :n_words]
    places = np.stack([at[:, 0], columns[at[:, 1]], at[:, 2]], axis=1)
    return DoubtfulWords(places, codebook(w)[order], np.log(np.take_along_axis(doubtful, order, axis=1) + _TINY))


def _posteriors(
    metrics: FloatArray,
    candidates: NDArray[np.bool_],
    on_posteriors: Callable[[int, NDArray[np.int64], FloatArray], None] | None = None,
) -> BurstPosteriors:
    """Posteriors for the candidate weights; `on_posteriors` gets weight, columns, (B, C, N, words) probabilities."""
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
            members, w = np.flatnonzero(weights == hypothesis.w), hypothesis.w
            if not members.size:
                continue
            columns, posterior = batch[members], hypothesis.word_posteriors(members)
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
    """Split the columns of metrics (B, C, packet + memory, patterns) into batches that fit the cache."""
    n_bursts, n_columns, length, n_patterns = metrics.shape
    numbers = n_bursts * length * n_patterns
    return np.array_split(np.arange(n_columns), max(min(-(-n_columns * numbers // _AT_ONCE), n_columns), 1))


def _header_llr(metrics: FloatArray) -> FloatArray:
    """(B, C) log-likelihood ratio of the header's slots against arbitrary, equally likely slots."""
    isi_memory = _isi_memory_of(metrics)
    header = metrics[:, :, isi_memory : len(HEADER)]
    known = header[:, :, np.arange(len(HEADER) - isi_memory), _pattern_index(np.array(HEADER), isi_memory)]
    anything = _log_sum(header, axis=3) - np.log(metrics.shape[-1])
    return np.asarray((known - anything).sum(axis=2))


def _log_of_best(posterior: FloatArray, best: NDArray[np.int64]) -> FloatArray:
    """Log of the largest probability, computed from the sum of the others to resolve 1 - 1e-12 from 1."""
    rest = posterior.copy()
    np.put_along_axis(rest, best[..., None], 0.0, -1)
    return np.asarray(np.log1p(-np.minimum(rest.sum(axis=-1), 1 - 1 / posterior.shape[-1])))


def _bit_llr(posterior: FloatArray, k: int) -> FloatArray:
    """(..., k) ln p(1)/p(0) from (..., 2**k) probabilities of the codebook indices."""
    bits = (np.arange(1 << k)[:, None] >> np.arange(k - 1, -1, -1)) & 1
    p_one, p_zero = posterior @ bits, posterior @ (1 - bits)
    return np.asarray(np.log(np.maximum(p_one, _TINY)) - np.log(np.maximum(p_zero, _TINY)))
