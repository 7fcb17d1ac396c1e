"""Maximum-likelihood detection of MPPM symbols, soft.

The input is the log-likelihood ratio of every slot, added over the copies of a packet: the channel has resolved
inter-symbol interference. The likelihood of a word is then the product of those of its slots, and of what a sample of
several slots adds to it. Header and dimming symbol are known once the weight `w` is, so the sum over all words is the
evidence for `w`.
"""

from collections.abc import Callable

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
    codewords,
    dimming_symbol,
)
from rxcli.receiver.decode.settings import SETTINGS
from rxcli.types import BoolArray, BurstPosteriors, Float32Array, FloatArray, IntArray

#: Most bits of a symbol.
MAX_BITS = max(map(bits_per_symbol, WEIGHTS))
#: Least probability of a word: paths that were dropped are not impossible.
_MIN_WORD = 1e-8


def detect(
    llr: Float32Array | FloatArray, candidates: BoolArray | None = None, beyond_slots: Float32Array | None = None
) -> BurstPosteriors:
    """Detect weights and symbols of every burst and column.

    Args:
        llr: (B, C, packet) log-likelihood ratio of each slot, copies added.
        candidates: (C, 9) weights to consider, all by default.
        beyond_slots: (B, C, payload symbols, words) log-likelihood of words in `codewords` beyond that of their slots.
    """
    n_bursts, n_columns, _ = llr.shape
    payload = np.asarray(llr[..., PREAMBLE_SLOTS:], np.float32).reshape(n_bursts, n_columns, -1, SLOTS_PER_SYMBOL)
    words, starts = codewords()
    score = payload @ words.T.astype(np.float32)
    if beyond_slots is not None:
        score = score + beyond_slots
    top = score.max(axis=-1, keepdims=True)
    by_weight = np.add.reduceat(np.exp(score - top), starts, axis=-1)
    # Against dark slots, all bursts together.
    by_symbol = np.log(np.maximum(by_weight, MIN_FLOAT32)) + top - np.log(np.diff([*starts, len(words)]))
    w_log_evidence = by_symbol.sum(axis=(0, 2), dtype=np.float64)
    for w in WEIGHTS:
        w_log_evidence[:, w - 1] += (llr[..., :PREAMBLE_SLOTS] @ preamble_slots(w)).sum(axis=0)
    if candidates is not None:
        w_log_evidence[~candidates] = -np.inf
    log_evidence = np.logaddexp.reduce(w_log_evidence, axis=1)

    def posterior(w: int, columns: IntArray) -> FloatArray:
        own = score[:, columns, :, starts[w - 1] : starts[w - 1] + (1 << bits_per_symbol(w))].astype(np.float64)
        likelihood = np.exp(own - own.max(axis=-1, keepdims=True))
        return np.asarray(likelihood / likelihood.sum(axis=-1, keepdims=True))

    return posteriors_of(
        w_log_evidence.argmax(axis=1) + 1,
        w_log_evidence - log_evidence[:, None],
        log_evidence,
        header_llr(llr),
        payload.shape[2],
        posterior,
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
    bit_llr, words = np.full((*shape, MAX_BITS), np.nan), np.zeros((*shape, 1 << MAX_BITS), np.float32)
    for w in np.unique(weights).tolist():
        columns = np.flatnonzero(weights == w)
        posterior, n_bits = of_words(w, columns), bits_per_symbol(w)
        words[:, columns, :, : 1 << n_bits] = posterior
        lit[:, columns, :PREAMBLE_SLOTS] = preamble_slots(w)
        lit[:, columns, PREAMBLE_SLOTS:] = (posterior @ codebook(w)).reshape(len(lit), columns.size, -1)
        index[:, columns] = best = posterior.argmax(axis=-1)
        log_prob[:, columns] = log_of_best(posterior, best)
        bit_llr[:, columns, :, :n_bits] = llr_of_bits(posterior, n_bits)
    return BurstPosteriors(weights, w_log_prob, log_evidence, lit, index, log_prob, bit_llr, header_llr, words)


def log_words(posteriors: BurstPosteriors) -> Float32Array:
    """(B, C, N, words) log probability of the words in `codewords`, over that of any word of the column's weight."""
    (words, starts), n_symbols = codewords(), posteriors.index.shape[2]
    less = np.maximum(posteriors.w_log_prob - posteriors.w_log_prob.max(axis=1, keepdims=True), np.log(_MIN_WORD))
    weight = words.sum(axis=1) - WEIGHTS[0]
    out = np.tile((less[:, None, weight] / n_symbols).astype(np.float32), (len(posteriors.index), 1, n_symbols, 1))
    for w in np.unique(posteriors.w).tolist():
        columns, n_words = np.flatnonzero(posteriors.w == w), 1 << bits_per_symbol(w)
        own = np.maximum(posteriors.words[:, columns, :, :n_words], _MIN_WORD) * n_words
        out[:, columns, :, starts[w - 1] : starts[w - 1] + n_words] = np.log(own)
    return out


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
    bits = (np.arange(1 << k)[:, None] >> np.arange(k - 1, -1, -1)) & 1
    p_one, p_zero = posterior @ bits, posterior @ (1 - bits)
    return np.asarray(np.log(np.maximum(p_one, MIN_FLOAT32)) - np.log(np.maximum(p_zero, MIN_FLOAT32)))


def header_llr(llr: Float32Array | FloatArray) -> FloatArray:
    """(B, C) log-likelihood ratio of the header's slots against arbitrary, equally likely slots."""
    against = llr[..., : len(HEADER)] * (1 - 2 * np.array(HEADER))
    return np.asarray((np.log(2) - np.logaddexp(0.0, against)).sum(axis=-1))


def free_log_evidence(llr: Float32Array | FloatArray, share: FloatArray) -> FloatArray:
    """(C,) log evidence of arbitrary slots (C, N), each lit independently with a probability `share` (C,)."""
    share = share[:, None]
    return np.asarray(np.logaddexp(np.log1p(-share), np.log(share) + llr).sum(axis=1))


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
