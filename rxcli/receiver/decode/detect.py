"""Maximum-likelihood detection of MPPM symbols under inter-symbol interference, soft.

The input is one log-likelihood for every slot and every pattern of the slot and its `isi_memory` predecessors, added
over the copies of a packet. A trellis over symbols, whose state is the last `isi_memory` slots of the previous symbol
and whose branches are the codewords, then gives the posterior of every symbol (forward-backward; Bahl et al., IEEE
Trans. Inf. Theory 20(2), 1974). Header and dimming symbol are known once the weight `w` is, so both ends of the trellis
are fixed, and the sum over all paths is the evidence for `w`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import comb

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import MIN_FLOAT32
from rxcli.protocol import (
    HEADER,
    PREAMBLE_SLOTS,
    SLOTS_PER_SYMBOL,
    WEIGHTS,
    bits_per_symbol,
    codebook,
    dimming_symbol,
)
from rxcli.receiver.decode.settings import SETTINGS
from rxcli.receiver.light import slot_llr
from rxcli.types import BurstPosteriors, Float32Array, FloatArray, IntArray

#: Lower limit of likelihoods of states and slots relative to the likeliest one, so that their logarithm exists.
_MIN_LIKELIHOOD = 1e-60
#: Most bits of a symbol.
MAX_BITS = max(map(bits_per_symbol, WEIGHTS))


def detect(metrics: FloatArray, candidates: NDArray[np.bool_] | None = None) -> BurstPosteriors:
    """Detect weights and symbols of every burst and column.

    Args:
        metrics: (B, C, packet + memory, 2**(memory+1)) natural log-likelihoods, copies added: entry i, j is the
            log-likelihood of the light at slot i given pattern j of `protocol.slot_patterns`. The first `isi_memory`
            slots are not used; the last `isi_memory` are the first slots of the header that follows.
        candidates: (C, 9) weights to consider, all by default.
    """
    if candidates is None:
        candidates = np.ones((metrics.shape[1], len(WEIGHTS)), bool)
    trellises = _trellises(metrics, candidates)
    w_log_evidence = np.full(candidates.shape, -np.inf)
    for w, trellis in trellises.items():
        w_log_evidence[trellis.columns, w - 1] = trellis.log_evidence
    log_evidence = np.logaddexp.reduce(w_log_evidence, axis=1)
    return posteriors_of(
        w_log_evidence.argmax(axis=1) + 1,
        w_log_evidence - log_evidence[:, None],
        log_evidence,
        header_llr(metrics),
        (metrics.shape[2] - PREAMBLE_SLOTS) // SLOTS_PER_SYMBOL,
        lambda w, columns: trellises[w].word_posteriors(np.isin(trellises[w].columns, columns)),
    )


def posteriors_of(
    weights: IntArray,
    w_log_prob: FloatArray,
    log_evidence: FloatArray,
    header_llr: FloatArray,
    n_symbols: int,
    of_words: Callable[[int, IntArray], FloatArray],
) -> BurstPosteriors:
    """Posteriors of slots, symbols and bits from those of words.

    Args:
        weights: (C,) of the columns.
        w_log_prob, log_evidence, header_llr: see `BurstPosteriors`.
        n_symbols: of the payload, N.
        of_words: the (B, columns, N, words) probabilities of the words of a weight in some columns.
    """
    shape = (*header_llr.shape, n_symbols)
    lit = np.empty((*header_llr.shape, PREAMBLE_SLOTS + n_symbols * SLOTS_PER_SYMBOL), np.float32)
    index, log_prob = np.empty(shape, np.int64), np.empty(shape)
    bit_llr = np.full((*shape, MAX_BITS), np.nan)
    for w in np.unique(weights).tolist():
        columns = np.flatnonzero(weights == w)
        posterior, n_bits = of_words(w, columns), bits_per_symbol(w)
        lit[:, columns, :PREAMBLE_SLOTS] = preamble_slots(w)
        lit[:, columns, PREAMBLE_SLOTS:] = (posterior @ codebook(w)).reshape(len(lit), columns.size, -1)
        index[:, columns] = best = posterior.argmax(axis=-1)
        log_prob[:, columns] = log_of_best(posterior, best)
        bit_llr[:, columns, :, :n_bits] = llr_of_bits(posterior, n_bits)
    return BurstPosteriors(weights, w_log_prob, log_evidence, lit, index, log_prob, bit_llr, header_llr)


def _isi_memory_of(metrics: FloatArray) -> int:
    return int(metrics.shape[-1]).bit_length() - 2


def preamble_slots(w: int) -> NDArray[np.uint8]:
    """(20,) slots of header and dimming symbol."""
    return np.concatenate([np.array(HEADER, np.uint8), dimming_symbol(w)])


def log_of_best(posterior: FloatArray, best: NDArray[np.int64]) -> FloatArray:
    """Log of the largest probability, computed from the sum of the others to resolve 1 - 1e-12 from 1."""
    rest = posterior.copy()
    np.put_along_axis(rest, best[..., None], 0.0, -1)
    return np.asarray(np.log1p(-np.minimum(rest.sum(axis=-1), 1 - 1 / posterior.shape[-1])))


def llr_of_bits(posterior: FloatArray, k: int) -> FloatArray:
    """(..., k) ln p(1)/p(0) from (..., 2**k) probabilities of the codebook indices."""
    bits = _states(k)
    p_one, p_zero = posterior @ bits, posterior @ (1 - bits)
    return np.asarray(np.log(np.maximum(p_one, MIN_FLOAT32)) - np.log(np.maximum(p_zero, MIN_FLOAT32)))


def header_llr(metrics: FloatArray) -> FloatArray:
    """(B, C) log-likelihood ratio of the header's slots against arbitrary, equally likely slots."""
    isi_memory = _isi_memory_of(metrics)
    header = metrics[:, :, isi_memory : len(HEADER)]
    likelihood, top = _over_likeliest(header)
    known = header[:, :, np.arange(len(HEADER) - isi_memory), _pattern_index(np.array(HEADER), isi_memory)]
    return np.asarray((known - top[..., 0] - np.log(likelihood.mean(axis=-1))).sum(axis=2))


@dataclass(frozen=True, slots=True)
class _Branches:
    """Branches of one symbol of weight w: every codeword from every state.

    The metrics of a word's first slots depend on the preceding state too, those of the other slots on the word alone.
    Both parts are computed separately.
    """

    #: ((10 - memory) * patterns, words): metrics that a word adds up from the first slot no preceding state reaches.
    features: FloatArray
    #: (words,) the word's first `memory` slots, and its last ones, as state numbers.
    prefix: NDArray[np.int64]
    suffix: NDArray[np.int64]
    #: (words, states * states): 1 at the word's prefix and suffix.
    transition: Float32Array
    #: Patterns of header and dimming symbol, from the first slot whose predecessors are known.
    preamble: NDArray[np.int64]
    #: (states,) 1 at the state after header and dimming symbol.
    start: FloatArray
    #: (states, memory) patterns of the next header's first slots after each state.
    header: NDArray[np.int64]


@cache
def _branches(w: int, isi_memory: int) -> _Branches:
    words, states = codebook(w), _states(isi_memory)
    n_states = len(states)
    index = _pattern_index(words, isi_memory)
    ends = words[:, :isi_memory], words[:, -isi_memory:]
    prefix, suffix = (_pattern_index(end, isi_memory - 1)[:, 0] for end in ends)
    preamble = preamble_slots(w)
    header = np.broadcast_to(np.array(HEADER[:isi_memory]), states.shape)
    return _Branches(
        features=(index[..., None] == np.arange(2 * n_states)).reshape(len(words), -1).T.astype(np.float64, order="C"),
        prefix=prefix,
        suffix=suffix,
        transition=((prefix * n_states + suffix)[:, None] == np.arange(n_states**2)).astype(np.float32),
        preamble=_pattern_index(preamble, isi_memory),
        start=(states == preamble[-isi_memory:]).all(axis=1).astype(np.float64),
        header=_pattern_index(np.concatenate([states, header], axis=1), isi_memory),
    )


def _pattern_index(slots: NDArray[np.integer], isi_memory: int) -> NDArray[np.int64]:
    """(..., n - memory) pattern index at every slot of (..., n) that has `isi_memory` predecessors."""
    windows = np.lib.stride_tricks.sliding_window_view(slots.astype(np.int64), isi_memory + 1, axis=-1)
    return windows @ (1 << np.arange(isi_memory, -1, -1))


@cache
def _states(isi_memory: int) -> NDArray[np.int64]:
    """(states, memory) slots of each state; also the bits of each number, most significant first."""
    states: NDArray[np.int64] = (np.arange(1 << isi_memory)[:, None] >> np.arange(isi_memory - 1, -1, -1)) & 1
    return states


@cache
def _boundary_patterns(isi_memory: int) -> NDArray[np.int64]:
    """(memory, states * prefixes) pattern at each of a word's first slots, by preceding state and prefix."""
    states = _states(isi_memory)
    slots = np.concatenate([np.repeat(states, len(states), axis=0), np.tile(states, (len(states), 1))], axis=1)
    return np.ascontiguousarray(_pattern_index(slots, isi_memory).T)


@dataclass(frozen=True, slots=True)
class _Trellis:
    """Packets of B bursts of c columns under the hypothesis of one weight; likelihoods relative to the likeliest."""

    w: int
    #: (c,) numbers of the columns.
    columns: NDArray[np.int64]
    #: (c,) log evidence of the weight, all bursts together.
    log_evidence: FloatArray
    #: (N, B, c, states, prefixes) likelihood of each prefix of a word after each state.
    boundary: FloatArray
    #: (N, B, c, words) float32: likelihood of each word's slots from the first that no preceding state reaches.
    remainder: Float32Array
    #: (N + 1, B, c, states) forward and backward likelihoods of the states.
    before: FloatArray
    after: FloatArray

    def word_posteriors(self, chosen: NDArray[np.bool_]) -> FloatArray:
        """(B, columns, N, words) probability of the words of the chosen columns, (c,)."""
        branches = _branches(self.w, self.boundary.shape[-1].bit_length() - 1)
        leads = np.matmul(self.before[:-1, :, chosen, None], self.boundary[:, :, chosen])[..., 0, :]
        joint = leads.take(branches.prefix, axis=-1)
        joint *= self.remainder[:, :, chosen]
        joint *= self.after[1:, :, chosen].take(branches.suffix, axis=-1)
        total = joint.sum(axis=-1, keepdims=True)
        uniform = np.full_like(joint, 1 / joint.shape[-1])
        return np.moveaxis(np.divide(joint, total, out=uniform, where=total > 0), 0, 2)


def _trellises(metrics: FloatArray, candidates: NDArray[np.bool_]) -> dict[int, _Trellis]:
    """Trellis of the columns of each candidate weight, from metrics (B, C, packet + memory, patterns)."""
    isi_memory = _isi_memory_of(metrics)
    payload = metrics[:, :, PREAMBLE_SLOTS : metrics.shape[2] - isi_memory]
    slots = np.moveaxis(payload.reshape(*payload.shape[:2], -1, SLOTS_PER_SYMBOL, payload.shape[-1]), 2, 0)
    patterns = _boundary_patterns(isi_memory)
    boundary = slots[..., 0, :].take(patterns[0], axis=-1)
    for slot in range(1, isi_memory):
        boundary += slots[..., slot, :].take(patterns[slot], axis=-1)
    boundary, top = _over_likeliest(boundary)
    words = slots[..., isi_memory:, :].reshape(*slots.shape[:-2], -1)
    log_scale = top.sum(axis=(0, 1, -1))
    return {
        w: _trellis(w, chosen, metrics[:, chosen], words[:, :, chosen], boundary[:, :, chosen], log_scale[chosen])
        for w in WEIGHTS
        if (chosen := np.flatnonzero(candidates[:, w - 1])).size
    }


def _trellis(
    w: int,
    columns: NDArray[np.int64],
    metrics: FloatArray,
    words: FloatArray,
    boundary: FloatArray,
    log_scale: FloatArray,
) -> _Trellis:
    """Run forward and backward through the packets of some columns of weight `w`.

    Args:
        w: the weight.
        columns: (c,) their numbers.
        metrics: (B, c, packet + memory, patterns).
        words: (N, B, c, (10 - memory) * patterns) metrics of each word from the first slot no preceding state reaches.
        boundary: (N, B, c, states * prefixes) likelihood of each word's first slots.
        log_scale: (c,) logarithm of the scale of `boundary`.
    """
    isi_memory = _isi_memory_of(metrics)
    branches, n_states = _branches(w, isi_memory), 1 << isi_memory
    known = metrics[:, :, np.arange(isi_memory, PREAMBLE_SLOTS), branches.preamble].sum(axis=(0, 2))
    end = metrics[:, :, np.arange(-isi_memory, 0), branches.header].sum(axis=-1)
    end, top_of_end = _over_likeliest(end)
    scores = words @ branches.features
    top = scores.max(axis=-1, keepdims=True)
    # Single precision suffices for probabilities and is much faster.
    remainder = np.maximum(np.exp((scores - top).astype(np.float32)), MIN_FLOAT32)
    n_words = remainder.shape[-1]
    log_scale = log_scale + known + top.sum(axis=(0, 1, -1)) + top_of_end.sum(axis=(0, 2))
    log_scale = log_scale - top[..., 0].size / len(columns) * np.log(n_words)
    boundary = boundary.reshape(*boundary.shape[:-1], n_states, n_states)
    transitions = boundary @ (remainder @ branches.transition).reshape(boundary.shape)
    start = np.broadcast_to(branches.start, end.shape)
    # One chain for both directions: symbols are sequential, so everything else is batched.
    directions = np.concatenate([transitions, transitions[::-1].swapaxes(-2, -1)], axis=1)
    states, log_total = _chain(directions, np.concatenate([start, end]))
    before, after = states[:, : len(end)], states[::-1, len(end) :]
    last = np.log(np.maximum((before[-1] * end).sum(axis=2), _MIN_LIKELIHOOD)) + log_total[: len(end)]
    return _Trellis(w, columns, log_scale + last.sum(axis=0), boundary, remainder, before, after)


def _chain(transitions: FloatArray, initial: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Propagate initial states (..., S) through transitions (N, ..., S, S).

    Returns:
        (N + 1, ..., S) states, each relative to its likeliest; and (...) the logarithm of the total scale.
    """
    states = np.empty((len(transitions) + 1, *initial.shape))
    tops = np.empty((len(transitions), *initial.shape[:-1], 1))
    states[0] = initial
    for before, transition, after, top in zip(states, transitions, states[1:], tops, strict=False):
        np.matmul(before[..., None, :], transition, out=after[..., None, :])
        np.maximum(after.max(axis=-1, keepdims=True), _MIN_LIKELIHOOD, out=top)
        after /= top
    return states, np.log(tops[..., 0]).sum(axis=0)


def _over_likeliest(log_values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Exponentials over the last axis relative to the largest, and the largest value, (..., 1)."""
    top = log_values.max(axis=-1, keepdims=True)
    return np.exp(log_values - top), top


def free_log_evidence(metrics: FloatArray, share: FloatArray) -> FloatArray:
    """(C,) log evidence of arbitrary slots, each lit independently of the others.

    Args:
        metrics: (C, n, patterns) log-likelihoods of the slots.
        share: (C,) probability that a slot is lit.
    """
    n_columns, _, n_patterns = metrics.shape
    log_prior = np.log(np.stack([1 - share, share], axis=1))
    # A pattern is the state (the slots before) and the slot itself; the next state drops the oldest slot.
    by_slot, tops = _over_likeliest(metrics.swapaxes(0, 1) + np.tile(log_prior, n_patterns // 2))
    steps = np.maximum(by_slot, _MIN_LIKELIHOOD).reshape(-1, n_columns, 2, n_patterns // 4, 2)
    state, totals = np.full((n_columns, n_patterns // 2), 2 / n_patterns), np.empty_like(tops)
    for step, total in zip(steps, totals, strict=True):
        pattern = state.reshape(n_columns, 2, -1, 1) * step
        state = (pattern[:, 0] + pattern[:, 1]).reshape(n_columns, -1)
        state /= state.sum(axis=1, keepdims=True, out=total)
    return np.asarray((tops + np.log(totals))[..., 0].sum(axis=0))


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


def plausible_weights(metrics: FloatArray, margin: float, llr: Float32Array | None = None) -> NDArray[np.bool_]:
    """Candidate weights, (C, 9): the likeliest one and all within a log-likelihood of `margin`.

    Slots count as independent and a symbol of weight w as any of the C(10, w) words. The likelihoods of all weights are
    then the coefficients of a polynomial, the product over the symbol's slots of 1 + x exp(llr).

    Args:
        metrics: (B, C, packet + memory, patterns) log-likelihoods of B bursts.
        margin: log-likelihood below the likeliest weight.
        llr: `slot_llr` of the metrics, where it is known.
    """
    llr = np.clip(slot_llr(metrics) if llr is None else llr, -SETTINGS.max_llr, SETTINGS.max_llr)
    symbols = llr.reshape(*llr.shape[:2], -1, SLOTS_PER_SYMBOL)
    payload = np.ascontiguousarray(np.moveaxis(symbols[:, :, 2:], -1, 0))
    coefficients = np.zeros((SLOTS_PER_SYMBOL + 1, *payload.shape[1:]))
    coefficients[0] = 1.0
    for slot in np.exp(payload):
        coefficients[1:] += coefficients[:-1] * slot
    words = np.array([comb(SLOTS_PER_SYMBOL, w) for w in WEIGHTS])
    score = np.log(coefficients[1:SLOTS_PER_SYMBOL]).sum(axis=(1, 3)).T - np.log(words) * payload[0, :, 0].size
    score += np.cumsum(symbols[:, :, 1], axis=2)[..., : len(WEIGHTS)].sum(axis=0)
    # Each metric was counted once for every slot that it covers.
    lead = margin * (_isi_memory_of(metrics) + 1) / 2
    return np.asarray(score >= score.max(axis=1, keepdims=True) - lead)


def common_weights(w_log_prob: FloatArray) -> NDArray[np.bool_]:
    """(C, 9) the weight of every column, where it is known by the words alone; see `weight_shares`."""
    common = SETTINGS.weight_temper * w_log_prob + np.log(weight_shares(w_log_prob))
    return np.asarray(common == common.max(axis=1, keepdims=True))


def weight_shares(w_log_prob: FloatArray) -> FloatArray:
    """(9,) shares of the weights in all columns, from log probabilities (C, 9) of columns by themselves.

    Columns of most screens have the same weight, so these are the prior of each column.
    """
    own = SETTINGS.weight_temper * w_log_prob
    shares = np.full(len(WEIGHTS), 1 / len(WEIGHTS))
    for _ in own:  # Many rounds, which converge; a column more, of any weight, is assumed beside those in view.
        posterior = own + np.log(shares)
        posterior = np.exp(posterior - np.logaddexp.reduce(posterior, axis=1, keepdims=True))
        shares = posterior.sum(axis=0) + 1 / len(WEIGHTS)
        shares /= shares.sum()
    return shares
