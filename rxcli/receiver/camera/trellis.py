"""Probabilities of slots that overlap through the exposure: forward-backward over all columns at once."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from rxcli.protocol import slot_patterns
from rxcli.receiver.light import exposure_shares
from rxcli.types import BoolArray, Float32Array, FloatArray, IntArray

#: Slots that are walked together, and those before them from which their first state is told.
_BLOCK, _LEAD = 48, 16


def pattern_light(exposure_slots: float, samples: int) -> FloatArray:
    """Light 0..1 of the middle slot's samples for every pattern of it and its neighbours.

    Args:
        exposure_slots: exposure; up to two slots three slots are seen, up to four slots five.
        samples: samples a slot.

    Returns:
        (2**n, samples), n = 3 or 5; the earliest slot is the most significant bit.
    """
    reach = 1 if exposure_slots <= 2 else 2
    middle = (np.arange(samples) + 0.5) / samples
    share = exposure_shares(middle, np.arange(-reach, reach + 1)[:, None], exposure_slots)
    return np.asarray(slot_patterns(2 * reach) @ share)


def lit_probability(
    metric: FloatArray | Float32Array, log_odds: FloatArray | Float32Array
) -> tuple[Float32Array, FloatArray]:
    """Probability that each slot is lit, and the evidence of the light.

    Args:
        metric: (2**n, C, N) log-likelihood of slot k's samples for every pattern of slots k - n // 2 .. k + n // 2.
        log_odds: (C, N) prior log-odds of being lit.

    Returns:
        (C, N) float32; and (C,) float64, the logarithm of the likelihood's mean over all slots that the prior allows.
    """
    n_patterns, n_columns, _ = metric.shape
    n_bits = n_patterns.bit_length() - 1
    pattern = np.arange(n_patterns)
    weight, top = _weights(metric, log_odds)
    # The way back is the way forth of the mirrored sequence: both are walked together.
    back = weight[_mirrored(n_bits), :, ::-1]
    walked, scales = _walk(np.concatenate([weight, back], axis=1))
    # State before slot k: its first n - 1 bits; state after it, from the other side, mirrored: its last n - 1.
    after = _mirrored(n_bits - 1)[pattern & (n_patterns // 2 - 1)]
    weight *= walked[pattern >> 1, :n_columns]
    weight *= walked[after, n_columns:, ::-1]
    lit = weight[_lit_in_the_middle(n_patterns)].sum(axis=0) / np.maximum(weight.sum(axis=0), np.float32(1e-30))
    return np.asarray(lit, np.float32), _summed(scales[:n_columns], top)


def log_evidence(metric: FloatArray | Float32Array, log_odds: FloatArray | Float32Array) -> FloatArray:
    """(C,) the evidence of the light alone, see `lit_probability`: it needs no way back."""
    weight, top = _weights(metric, log_odds)
    return _summed(_walk(weight)[1], top)


def _weights(
    metric: FloatArray | Float32Array, log_odds: FloatArray | Float32Array
) -> tuple[Float32Array, Float32Array]:
    """(patterns, C, N) likelihood of patterns with their prior over that of the likeliest, and that one's logarithm."""
    weight = np.asarray(metric, np.float32) - np.asarray(np.logaddexp(0, log_odds), np.float32)
    weight[_lit_in_the_middle(len(weight))] += np.asarray(log_odds, np.float32)
    top = weight.max(axis=0)
    weight -= top
    return np.exp(np.maximum(weight, np.float32(-60), out=weight), out=weight), top


def _lit_in_the_middle(n_patterns: int) -> BoolArray:
    """(patterns,) those whose middle slot is lit."""
    return np.asarray((np.arange(n_patterns) >> (n_patterns.bit_length() - 1) // 2) & 1 > 0)


def _summed(scales: Float32Array, top: Float32Array) -> FloatArray:
    return np.asarray(np.log(scales).sum(axis=1, dtype=np.float64) + top.sum(axis=1, dtype=np.float64))


@lru_cache(maxsize=8)
def _mirrored(n_bits: int) -> IntArray:
    """Every number of some bits, its bits read from the other end."""
    return np.array([int(format(number, f"0{n_bits}b")[::-1], 2) for number in range(1 << n_bits)], np.int64)


def _walk(weight: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Probability of the state before each slot (states, rows, N) from weights (patterns, rows, N), block by block.

    And (rows, N) what the probabilities' sum was at every slot. States far back tell nothing of a slot, so that blocks
    can be walked side by side, each from a few slots before its own.
    """
    n_patterns, n_rows, n = weight.shape
    states, n_blocks = n_patterns // 2, -(-n // _BLOCK)
    # Slots outside weigh all patterns alike, which leaves the state at the sequence's ends open.
    padded = np.ones((n_patterns, n_rows, _LEAD + n_blocks * _BLOCK), np.float32)
    padded[..., _LEAD : _LEAD + n] = weight
    windows = np.lib.stride_tricks.sliding_window_view(padded, _LEAD + _BLOCK, axis=2)[:, :, ::_BLOCK]
    # A pattern is the state and one new bit; the new state drops the oldest bit.
    steps = np.ascontiguousarray(np.moveaxis(windows, 3, 0)).reshape(-1, 2, states // 2, 2, n_rows * n_blocks)
    out = np.empty((_BLOCK, states, n_rows * n_blocks), np.float32)
    scale = np.empty((_BLOCK, n_rows * n_blocks), np.float32)
    state = np.full((states, n_rows * n_blocks), 1 / states, np.float32)
    for k, step in enumerate(steps, -_LEAD):
        if k >= 0:
            out[k] = state
        step *= state.reshape(2, states // 2, 1, -1)
        state = (step[0] + step[1]).reshape(states, -1)
        total = state.sum(axis=0)
        total += np.float32(1e-30)
        state /= total
        if k >= 0:
            scale[k] = total

    def in_order(values: Float32Array) -> Float32Array:
        return np.moveaxis(values, 0, -1).reshape(-1, n_rows, n_blocks * _BLOCK)[..., :n]

    return in_order(out), in_order(scale)[0]
