"""Maximum-likelihood detection of MPPM symbols under inter-symbol interference, soft.

The channel hands over one log-likelihood for every slot and every pattern of the slot and its `isi_memory`
predecessors. Copies of a packet are added. A trellis over symbols, whose state is the last `isi_memory` slots of the
previous symbol and whose branches are the codewords, then gives the posterior of every symbol (forward-backward;
Bahl et al., IEEE Trans. Inf. Theory 20(2), 1974). Header and dimming symbol are
known once `w` is, so both ends of the trellis are fixed, and the sum over all paths is the evidence for `w`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from math import comb

import numpy as np
from numpy.typing import NDArray

from rxcli.protocol import HEADER, PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, WEIGHTS, bits_per_symbol, codebook, dimming_symbol
from rxcli.types import BurstPosteriors, Float32Array, FloatArray

#: Longest memory of the trellis; five slots cover an exposure of four.
MAX_MEMORY = 5
_NEVER = -1e9
#: Slots are taken to be at most this sure when weights are compared: one bad slot must not decide.
_SURE_LLR = 12.0
#: Probabilities below this are not told apart.
_TINY = 1e-30
#: Packets that are detected together: more leave the processor's cache, fewer take more calls.
_AT_ONCE = 256


@dataclass(frozen=True, slots=True)
class _Branches:
    """Branches of one symbol of weight w: every codeword from every state."""

    #: (words, 10) uint8.
    words: NDArray[np.uint8]
    #: (10 * 2**(memory+1), states * words) float32: which metrics a branch adds up.
    features: NDArray[np.float32]
    #: (words, states) float32: 1 where the word ends in the state, else 0.
    into: NDArray[np.float32]
    #: Patterns of header and dimming symbol, from the first slot whose predecessors are known.
    preamble: NDArray[np.int64]
    #: State that header and dimming symbol end in.
    first_state: int
    #: (states, memory) patterns of the next header's first slots after each state.
    tail: NDArray[np.int64]


def _pattern_index(slots: NDArray[np.integer], isi_memory: int) -> NDArray[np.int64]:
    """Index of the pattern at every slot that has `isi_memory` predecessors; (..., n) to (..., n - memory)."""
    windows = np.lib.stride_tricks.sliding_window_view(slots.astype(np.int64), isi_memory + 1, axis=-1)
    return windows @ (1 << np.arange(isi_memory, -1, -1))


@lru_cache(maxsize=64)
def _branches(w: int, isi_memory: int) -> _Branches:
    words = codebook(w)
    n_states, n_words = 1 << isi_memory, len(words)
    states = (np.arange(n_states)[:, None] >> np.arange(isi_memory - 1, -1, -1)) & 1
    slots = np.concatenate(
        [np.repeat(states[:, None], n_words, axis=1), np.repeat(words[None], n_states, axis=0)], axis=2
    )
    index = _pattern_index(slots, isi_memory)
    features = (index[..., None] == np.arange(1 << (isi_memory + 1))).reshape(n_states * n_words, -1)
    end = words[:, SLOTS_PER_SYMBOL - isi_memory :] @ (1 << np.arange(isi_memory - 1, -1, -1))
    into = (end[:, None] == np.arange(n_states)).astype(np.float32)
    preamble = np.concatenate([np.array(HEADER, np.int64), dimming_symbol(w)])
    header = np.broadcast_to(np.array(HEADER[:isi_memory], np.int64), (n_states, isi_memory))
    return _Branches(
        words,
        np.ascontiguousarray(features.T, np.float32),
        into,
        _pattern_index(preamble, isi_memory),
        int(_pattern_index(preamble[PREAMBLE_SLOTS - isi_memory :], isi_memory - 1)[0]),
        _pattern_index(np.concatenate([states, header], axis=1), isi_memory),
    )


def _log_sum(values: FloatArray, axis: int) -> FloatArray:
    top = values.max(axis=axis, keepdims=True)
    return np.asarray((top + np.log(np.exp(values - top).sum(axis=axis, keepdims=True))).squeeze(axis))


def _over_few(combine: np.ufunc, values: FloatArray) -> FloatArray:
    """Sum or maximum over a short last axis, where going by slices is quicker than a reduction."""
    total = values[..., 0]
    for number in range(1, values.shape[-1]):
        total = combine(total, values[..., number])
    return total


@dataclass(frozen=True, slots=True)
class _Steps:
    """n packets of one weight, as a trellis over their symbols."""

    branches: _Branches
    #: (n,) log-likelihood that all words share.
    common: FloatArray
    #: (n, N, states, words) likelihood of each word after each state over that of the best, and the best's logarithm.
    likelihood: Float32Array
    top: Float32Array
    #: (n, N, states, states) log-likelihood of going from state to state, over all words; the first's state, and what
    #: the header that follows says of the last.
    step: FloatArray
    start: FloatArray
    end: FloatArray


def _steps(metrics: FloatArray, w: int, isi_memory: int) -> _Steps:
    """The trellis of n packets of weight `w` from their metrics (n, packet + memory, patterns)."""
    branches = _branches(w, isi_memory)
    n, length, _ = metrics.shape
    n_symbols = (length - isi_memory - PREAMBLE_SLOTS) // SLOTS_PER_SYMBOL
    n_states, n_words = 1 << isi_memory, len(branches.words)
    known = metrics[:, np.arange(isi_memory, PREAMBLE_SLOTS), branches.preamble].sum(axis=1)
    payload = metrics[:, PREAMBLE_SLOTS : length - isi_memory].reshape(n * n_symbols, -1)
    # Only differences matter; what is left fits float32 with room to spare.
    offset = payload.max(axis=1)
    payload = (payload - offset[:, None]).astype(np.float32)
    branch = (payload @ branches.features).reshape(n, n_symbols, n_states, n_words)
    top = branch.max(axis=3, keepdims=True)
    branch -= top
    likelihood = np.exp(branch, out=branch)
    step = np.log(np.maximum(likelihood @ branches.into, _TINY)) + top
    start = np.full((n, n_states), _NEVER)
    start[:, branches.first_state] = 0.0
    offset = SLOTS_PER_SYMBOL * offset.reshape(n, n_symbols).sum(axis=1)
    common = known + offset - n_symbols * np.log(n_words)
    tail = metrics[:, length - isi_memory :]
    end = np.asarray(tail[:, np.arange(isi_memory), branches.tail].sum(axis=2))
    return _Steps(branches, common, likelihood, top[..., 0], step, start, end)


def _log_evidence(metrics: FloatArray, w: int, isi_memory: int) -> FloatArray:
    """(n,) log evidence of packets of weight `w`, for which going forward is enough."""
    trellis = _steps(metrics, w, isi_memory)
    state = trellis.start
    for symbol in range(trellis.step.shape[1]):
        state = _log_sum(state[:, :, None] + trellis.step[:, symbol], axis=1)
    return np.asarray(trellis.common + _log_sum(state + trellis.end, axis=1))


def _word_posteriors(metrics: FloatArray, w: int, isi_memory: int) -> FloatArray:
    """(n, N, words) probability of the words of n packets of weight `w`, by forward-backward."""
    trellis = _steps(metrics, w, isi_memory)
    before, after = _recursions(trellis.step, trellis.start, trellis.end)
    joint = _scaled(before + trellis.top)[:, :, None, :] @ trellis.likelihood
    joint = joint[:, :, 0] * (_scaled(after) @ trellis.branches.into.T)
    total = joint.sum(axis=2, keepdims=True)
    uniform = np.full_like(joint, 1 / joint.shape[2])
    return np.asarray(np.divide(joint, total, out=uniform, where=total > 0))


def _recursions(step: FloatArray, start: FloatArray, end: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Log-likelihood of each state before and after every symbol, (n, N, states), from the steps between states.

    Both recursions take as many steps and run side by side: what counts is the number of calls.
    """
    steps = np.concatenate([step[:, :-1], step[:, :0:-1].swapaxes(2, 3)])
    states = [np.concatenate([start, end])]
    for symbol in range(steps.shape[1]):
        states.append(_log_sum(states[-1][:, :, None] + steps[:, symbol], axis=1))
    before, after = np.split(np.stack(states, axis=1), 2)
    return before, after[:, ::-1]


def _scaled(log_values: FloatArray) -> NDArray[np.float32]:
    """Exponentials, the largest of each last axis being 1."""
    return np.asarray(np.exp(log_values - log_values.max(axis=-1, keepdims=True)), np.float32)


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
    total = np.zeros((*metrics.shape[:-2], n_slots))
    likelihood = np.exp(metrics - _over_few(np.maximum, metrics)[..., None])
    for age in range(isi_memory + 1):
        # Bit `age` of the pattern's number is the slot `age` slots ago.
        split = likelihood[..., age : age + n_slots, :].reshape(*total.shape, -1, 2, 1 << age)
        dark, lit = (_over_few(np.add, split[..., state, :].reshape(*total.shape, -1)) for state in (0, 1))
        total += np.log((lit + _TINY) / (dark + _TINY))
    return total.astype(np.float32)


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
    slot_margin = np.zeros(decided.shape)
    for age in range(isi_memory + 1):
        n_observed, shown = metrics[..., age : age + n_slots, :], pattern[..., age : age + n_slots, None]
        slot_margin += (
            np.take_along_axis(n_observed, shown, -1) - np.take_along_axis(n_observed, shown ^ (1 << age), -1)
        )[..., 0]
    return slot_margin.astype(np.float32)


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
    symbols = np.clip(symbols, -_SURE_LLR, _SURE_LLR)
    payload = symbols[:, :, 2:]
    coefficients = np.zeros((*payload.shape[:3], SLOTS_PER_SYMBOL + 1))
    coefficients[..., 0] = 1.0
    for slot in np.moveaxis(np.exp(payload), 3, 0):
        coefficients[..., 1:] += coefficients[..., :-1] * slot[..., None]
    words = np.array([comb(SLOTS_PER_SYMBOL, w) for w in WEIGHTS])
    score = np.log(coefficients[..., 1:SLOTS_PER_SYMBOL] / words).sum(axis=(0, 2))
    return np.asarray(score + np.cumsum(symbols[:, :, 1], axis=2)[..., : len(WEIGHTS)].sum(axis=0))


def first_decision_of(metrics: FloatArray) -> Float32Array:
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
    n_bursts, n_columns = metrics.shape[:2]
    isi_memory = _isi_memory_of(metrics)
    out = np.full((n_columns, len(WEIGHTS)), -np.inf)
    for w in WEIGHTS:
        columns = np.flatnonzero(candidates[:, w - 1])
        if columns.size:
            chosen = metrics[:, columns].reshape(n_bursts * columns.size, *metrics.shape[2:])
            out[columns, w - 1] = _log_evidence(chosen, w, isi_memory).reshape(n_bursts, -1).sum(axis=0)
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
    steps = metrics.reshape(n_columns, -1, n_patterns // 2, 2) + prior[:, None, None]
    state = np.full((n_columns, n_patterns // 2), -np.log(n_patterns // 2))
    for step in steps.transpose(1, 0, 2, 3):
        pattern = (state[..., None] + step).reshape(n_columns, 2, -1)
        state = np.logaddexp(pattern[:, 0], pattern[:, 1])
    return np.asarray(np.logaddexp.reduce(state, axis=1))


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
    return _posteriors(metrics, _weights(metrics, candidates))


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


def detect_with_words(
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
        by_burst = word.reshape(len(metrics), columns.size, *word.shape[1:])
        found.append(_in_doubt(by_burst, w, columns, certain, most))

    posteriors = _posteriors(metrics, _weights(metrics, candidates), on_posteriors)
    return posteriors, DoubtfulWords(
        np.concatenate([f.places for f in found]),
        np.concatenate([f.words for f in found]),
        np.concatenate([f.log_prob for f in found]),
    )


def _in_doubt(word: FloatArray, w: int, columns: NDArray[np.int64], certain: float, most: int) -> DoubtfulWords:
    """Symbols in doubt of columns of one weight, from the probability of every word, (B, columns, N, words)."""
    at = np.argwhere(word.max(axis=3) < np.exp(certain))
    doubtful = word[tuple(at.T)]
    order = np.argsort(-doubtful, axis=1)[:, :most]
    places = np.stack([at[:, 0], columns[at[:, 1]], at[:, 2]], axis=1)
    return DoubtfulWords(places, codebook(w)[order], np.log(np.take_along_axis(doubtful, order, axis=1) + _TINY))


def _weights(metrics: FloatArray, candidates: NDArray[np.bool_]) -> FloatArray:
    """(C, 9) log probability of every weight; no evidence is needed where one candidate is left."""
    log_prob = np.where(candidates, 0.0, -np.inf)
    open_columns = np.flatnonzero(candidates.sum(axis=1) > 1)
    if open_columns.size:
        log_prob[open_columns] = weight_log_evidence(metrics[:, open_columns], candidates[open_columns])
    return np.asarray(log_prob - _log_sum(log_prob, 1)[:, None])


def _posteriors(
    metrics: FloatArray,
    w_log_prob: FloatArray,
    on_posteriors: Callable[[int, NDArray[np.int64], FloatArray], None] | None = None,
) -> BurstPosteriors:
    """Posteriors given the weights; `on_posteriors` gets weight, columns, (B * C, N, words) probabilities."""
    n_bursts, n_columns, length, _ = metrics.shape
    isi_memory = _isi_memory_of(metrics)
    n_symbols = (length - isi_memory - PREAMBLE_SLOTS) // SLOTS_PER_SYMBOL
    weights = w_log_prob.argmax(axis=1) + 1
    lit = np.empty((n_bursts, n_columns, length - isi_memory), np.float32)
    index = np.empty((n_bursts, n_columns, n_symbols), np.int64)
    log_prob = np.empty((n_bursts, n_columns, n_symbols))
    bit_llr = np.full((n_bursts, n_columns, n_symbols, 7), np.nan)
    for w, columns in _batches(weights, n_bursts):
        chosen = metrics[:, columns].reshape(n_bursts * columns.size, *metrics.shape[2:])
        posterior = _word_posteriors(chosen, w, isi_memory)
        if on_posteriors is not None:
            on_posteriors(w, columns, posterior)
        words = codebook(w)
        preamble = np.concatenate([np.array(HEADER), dimming_symbol(w)])
        lit[:, columns, :PREAMBLE_SLOTS] = preamble
        lit[:, columns, PREAMBLE_SLOTS:] = (posterior @ words).reshape(n_bursts, columns.size, -1)
        best = posterior.argmax(axis=2)
        index[:, columns] = best.reshape(n_bursts, columns.size, n_symbols)
        log_prob[:, columns] = _log_of_best(posterior, best).reshape(n_bursts, columns.size, n_symbols)
        k = bits_per_symbol(w)
        bit_llr[:, columns, :, :k] = _bit_llr(posterior, k).reshape(n_bursts, columns.size, n_symbols, k)
    return BurstPosteriors(weights, w_log_prob, lit, index, log_prob, bit_llr, _header_llr(metrics))


def _batches(weights: NDArray[np.int64], n_bursts: int) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Each weight with columns that have it; as many at a time as are quick to detect."""
    for w in np.unique(weights):
        columns = np.flatnonzero(weights == w)
        for batch in np.array_split(columns, min(-(-columns.size * n_bursts // _AT_ONCE), columns.size)):
            yield int(w), batch


def _header_llr(metrics: FloatArray) -> FloatArray:
    """(B, C) log-likelihood of the header's slots as they must be, over slots that are anything with equal chance."""
    isi_memory = _isi_memory_of(metrics)
    header = metrics[:, :, isi_memory : len(HEADER)]
    known = header[:, :, np.arange(len(HEADER) - isi_memory), _pattern_index(np.array(HEADER), isi_memory)]
    anything = _log_sum(header, axis=3) - np.log(metrics.shape[-1])
    return np.asarray((known - anything).sum(axis=2))


def _log_of_best(posterior: FloatArray, best: NDArray[np.int64]) -> FloatArray:
    """Log of the largest probability, from the sum of the others so that 1 - 1e-12 is told from 1."""
    rest = posterior.astype(np.float64)
    np.put_along_axis(rest, best[..., None], 0.0, 2)
    return np.asarray(np.log1p(-np.minimum(rest.sum(axis=2), 1 - 1 / posterior.shape[2])))


def _bit_llr(posterior: FloatArray, k: int) -> FloatArray:
    """(n, N, k) ln p(1)/p(0) from (n, N, 2**k) probabilities of the codebook indices."""
    bits = (np.arange(1 << k)[:, None] >> np.arange(k - 1, -1, -1)) & 1
    one, zero = posterior @ bits, posterior @ (1 - bits)
    return np.asarray(np.log(np.maximum(one, _TINY)) - np.log(np.maximum(zero, _TINY)))
