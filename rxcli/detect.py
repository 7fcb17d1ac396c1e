"""Maximum-likelihood detection of MPPM symbols under inter-symbol interference, soft.

The channel hands over one log-likelihood for every slot and every pattern of the slot and its `memory` predecessors.
Copies of a packet are added. A trellis over symbols, whose state is the last `memory` slots of the previous symbol and
whose branches are the codewords, then gives the posterior of every symbol (forward-backward; Bahl et al., IEEE Trans.
Inf. Theory 20(2), 1974). Header and dimming symbol are known once `w` is, so both ends of the trellis are fixed, and
the sum over all paths is the evidence for `w`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rxcli.protocol import HEADER, PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, WEIGHTS, bits_per_symbol, codebook, dimming_symbol
from rxcli.types import BurstPosteriors, FloatArray

#: Longest memory of the trellis; five slots cover an exposure of four.
MAX_MEMORY = 5
_NEVER = -1e9


@dataclass(frozen=True, slots=True)
class _Branches:
    """Branches of one symbol of weight w: every codeword from every state."""

    #: (words, 10) uint8.
    words: NDArray[np.uint8]
    #: (10 * 2**(memory+1), states * words) float32: which metrics a branch adds up.
    features: NDArray[np.float32]
    #: (words,) state after the word.
    end: NDArray[np.int64]
    #: (words, states) float64: 0 where the word ends in the state, else never.
    into: FloatArray


def _pattern_index(slots: NDArray[np.integer], memory: int) -> NDArray[np.int64]:
    """Index of the pattern at every slot that has `memory` predecessors; (..., n) to (..., n - memory)."""
    windows = np.lib.stride_tricks.sliding_window_view(slots.astype(np.int64), memory + 1, axis=-1)
    return windows @ (1 << np.arange(memory, -1, -1))


@lru_cache(maxsize=64)
def _branches(w: int, memory: int) -> _Branches:
    words = codebook(w)
    n_states, n_words = 1 << memory, len(words)
    states = (np.arange(n_states)[:, None] >> np.arange(memory - 1, -1, -1)) & 1
    slots = np.concatenate(
        [np.repeat(states[:, None], n_words, axis=1), np.repeat(words[None], n_states, axis=0)], axis=2
    )
    index = _pattern_index(slots, memory)
    features = (index[..., None] == np.arange(1 << (memory + 1))).reshape(n_states * n_words, -1)
    end = words[:, SLOTS_PER_SYMBOL - memory :] @ (1 << np.arange(memory - 1, -1, -1))
    into = np.where(end[:, None] == np.arange(n_states), 0.0, _NEVER)
    return _Branches(words, np.ascontiguousarray(features.T, np.float32), end.astype(np.int64), into)


def _log_sum(values: FloatArray, axis: int) -> FloatArray:
    top = values.max(axis=axis, keepdims=True)
    return np.asarray((top + np.log(np.exp(values - top).sum(axis=axis, keepdims=True))).squeeze(axis))


@dataclass(frozen=True, slots=True)
class _Packets:
    """Posterior of n packets of one weight."""

    evidence: FloatArray  # (n,)
    word: FloatArray  # (n, N, words) log posterior


def _forward_backward(metrics: FloatArray, w: int, memory: int) -> _Packets:
    """Posterior of n packets of weight `w` from their metrics (n, packet + memory, patterns)."""
    branches = _branches(w, memory)
    n, length, _ = metrics.shape
    n_symbols = (length - memory - PREAMBLE_SLOTS) // SLOTS_PER_SYMBOL
    n_states, n_words = 1 << memory, len(branches.words)
    preamble = np.concatenate([np.array(HEADER, np.int64), dimming_symbol(w)])
    known = _pattern_index(preamble, memory)
    evidence = metrics[:, np.arange(memory, PREAMBLE_SLOTS), known].sum(axis=1)
    payload = metrics[:, PREAMBLE_SLOTS : length - memory].reshape(n * n_symbols, -1).astype(np.float32)
    branch = (payload @ branches.features).astype(np.float64).reshape(n, n_symbols, n_states, n_words)
    start = np.full((n, n_states), _NEVER)
    start[:, _pattern_index(preamble[PREAMBLE_SLOTS - memory :], memory - 1)[0] if memory else 0] = 0.0
    forward, backward = [start], [_tail(metrics[:, length - memory :], memory)]
    for symbol in range(n_symbols):
        word = _log_sum(forward[-1][:, :, None] + branch[:, symbol], axis=1)
        forward.append(_log_sum(word[:, :, None] + branches.into, axis=1))
    for symbol in range(n_symbols - 1, -1, -1):
        backward.append(_log_sum(branch[:, symbol] + backward[-1][:, None, branches.end], axis=2))
    before = np.stack(forward[:-1], axis=1)
    after = np.stack(backward[-2::-1], axis=1)
    joint = _log_sum(before[..., None] + branch, axis=2) + after[:, :, branches.end]
    total = _log_sum(joint, axis=2)
    evidence = evidence + total[:, 0] - n_symbols * np.log(n_words)
    return _Packets(evidence, joint - total[..., None])


def _tail(metrics: FloatArray, memory: int) -> FloatArray:
    """(n, states) log-likelihood of the next header's first slots after each state; they tell of the last symbol."""
    states = (np.arange(1 << memory)[:, None] >> np.arange(memory - 1, -1, -1)) & 1
    header = np.broadcast_to(np.array(HEADER[:memory], np.int64), (len(states), memory))
    index = _pattern_index(np.concatenate([states, header], axis=1), memory)
    return metrics[:, np.arange(memory), index].sum(axis=2)


def weight_evidence(metrics: FloatArray, candidates: NDArray[np.bool_]) -> FloatArray:
    """Log evidence of every weight, (C, 9); -inf where it is not among the `candidates`.

    Args:
        metrics: (B, C, packet + memory, patterns) log-likelihoods of B bursts.
        candidates: (C, 9) which weights to try for each column.
    """
    n_bursts, n_columns = metrics.shape[:2]
    memory = _memory_of(metrics)
    out = np.full((n_columns, len(WEIGHTS)), -np.inf)
    for w in WEIGHTS:
        columns = np.flatnonzero(candidates[:, w - 1])
        if columns.size:
            chosen = metrics[:, columns].reshape(n_bursts * columns.size, *metrics.shape[2:])
            out[columns, w - 1] = _forward_backward(chosen, w, memory).evidence.reshape(n_bursts, -1).sum(axis=0)
    return out


def _memory_of(metrics: FloatArray) -> int:
    return int(metrics.shape[-1]).bit_length() - 2


def detect(metrics: FloatArray, candidates: NDArray[np.bool_] | None = None) -> BurstPosteriors:
    """Weights and symbols of every burst and column.

    Args:
        metrics: (B, C, packet + memory, 2**(memory+1)) natural log-likelihoods, copies added: entry i, j is the
            log-likelihood of what was seen at slot i given pattern j of `protocol.slot_patterns`. The first `memory` slots are not
            used; the last `memory` entries are the first slots of the header that follows.
        candidates: (C, 9) weights to consider, all by default.

    Returns:
        Posteriors; see `BurstPosteriors`.

    Raises:
        ValueError: shapes do not fit.
    """
    if metrics.ndim != 4 or metrics.shape[-1] not in {1 << (m + 1) for m in range(1, MAX_MEMORY + 1)}:
        raise ValueError(f"metrics must be (bursts, columns, slots, 2**(memory+1)) with memory 1..{MAX_MEMORY} (got {metrics.shape})")
    if candidates is None:
        candidates = np.ones((metrics.shape[1], len(WEIGHTS)), bool)
    return _posteriors(metrics, _weights(metrics, candidates))


def _weights(metrics: FloatArray, candidates: NDArray[np.bool_]) -> FloatArray:
    """(C, 9) log probability of every weight; no evidence is needed where one candidate is left."""
    log_prob = np.where(candidates, 0.0, -np.inf)
    open_columns = np.flatnonzero(candidates.sum(axis=1) > 1)
    if open_columns.size:
        log_prob[open_columns] = weight_evidence(metrics[:, open_columns], candidates[open_columns])
    return np.asarray(log_prob - _log_sum(log_prob, 1)[:, None])


def _posteriors(metrics: FloatArray, w_log_prob: FloatArray) -> BurstPosteriors:
    n_bursts, n_columns, length, _ = metrics.shape
    memory = _memory_of(metrics)
    n_symbols = (length - memory - PREAMBLE_SLOTS) // SLOTS_PER_SYMBOL
    weights = w_log_prob.argmax(axis=1) + 1
    lit = np.empty((n_bursts, n_columns, length - memory), np.float32)
    index = np.empty((n_bursts, n_columns, n_symbols), np.int64)
    log_prob = np.empty((n_bursts, n_columns, n_symbols))
    bit_llr = np.full((n_bursts, n_columns, n_symbols, 7), np.nan)
    for w in np.unique(weights):
        columns = np.flatnonzero(weights == w)
        chosen = metrics[:, columns].reshape(n_bursts * columns.size, *metrics.shape[2:])
        word = _forward_backward(chosen, int(w), memory).word
        words = codebook(int(w))
        posterior = np.exp(word)
        preamble = np.concatenate([np.array(HEADER), dimming_symbol(int(w))])
        lit[:, columns, :PREAMBLE_SLOTS] = preamble
        lit[:, columns, PREAMBLE_SLOTS:] = (posterior @ words).reshape(n_bursts, columns.size, -1)
        best = word.argmax(axis=2)
        index[:, columns] = best.reshape(n_bursts, columns.size, n_symbols)
        log_prob[:, columns] = np.take_along_axis(word, best[..., None], 2).reshape(n_bursts, columns.size, n_symbols)
        k = bits_per_symbol(int(w))
        bit_llr[:, columns, :, :k] = _bit_llr(posterior, k).reshape(n_bursts, columns.size, n_symbols, k)
    return BurstPosteriors(weights, w_log_prob, lit, index, log_prob, bit_llr)


def _bit_llr(posterior: FloatArray, k: int) -> FloatArray:
    """(n, N, k) ln p(1)/p(0) from (n, N, 2**k) probabilities of the codebook indices."""
    bits = (np.arange(1 << k)[:, None] >> np.arange(k - 1, -1, -1)) & 1
    one, zero = posterior @ bits, posterior @ (1 - bits)
    tiny = np.finfo(np.float64).tiny
    return np.asarray(np.log(np.maximum(one, tiny)) - np.log(np.maximum(zero, tiny)))
