"""Probabilities of slots that overlap through the exposure: forward-backward over all columns at once."""

from __future__ import annotations

import numpy as np

from rxcli.protocol import slot_patterns
from rxcli.receiver.light import exposure_shares
from rxcli.types import Float32Array, FloatArray

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
        metric: (C, N, 2**n) log-likelihood of slot k's samples for every pattern of slots k - n // 2 .. k + n // 2.
        log_odds: (C, N) prior log-odds of being lit.

    Returns:
        (C, N) float32; and (C,) float64, the logarithm of the likelihood's mean over all slots that the prior allows.
    """
    n_columns, _, n_patterns = metric.shape
    n_bits = n_patterns.bit_length() - 1
    reach = n_bits // 2
    middle = ((np.arange(n_patterns) >> reach) & 1).astype(np.float32)
    prior = np.asarray(np.logaddexp(0, log_odds), np.float32)[..., None]
    weight = np.asarray(metric, np.float32) + (np.asarray(log_odds, np.float32)[..., None] * middle - prior)
    top = weight.max(axis=2, keepdims=True)
    weight = np.exp(np.maximum(weight - top, np.float32(-60)))
    # The way back is the way forth of the mirrored sequence: both are walked together.
    mirrored = np.array([int(format(p, f"0{n_bits}b")[::-1], 2) for p in range(n_patterns)])
    walked, scales = _walk(np.concatenate([weight, weight[:, ::-1][..., mirrored]]))
    ahead, back = walked[:n_columns], walked[n_columns:, ::-1]
    # State before slot k: its first n - 1 bits; state after it, from the other side, mirrored: its last n - 1.
    states = n_patterns // 2
    turned = np.array([int(format(s, f"0{n_bits - 1}b")[::-1], 2) for s in range(states)])
    by_states = ahead[..., None] * weight.reshape(*weight.shape[:2], states, 2)
    joint = by_states.reshape(*weight.shape[:2], 2, states) * back[..., None, turned]
    joint = joint.reshape(weight.shape)
    total = joint.sum(axis=2)
    log_evidence = np.log(scales[:n_columns]).sum(axis=1, dtype=np.float64) + top.sum(axis=(1, 2), dtype=np.float64)
    return np.asarray((joint @ middle) / np.maximum(total, np.float32(1e-30)), np.float32), log_evidence


def _walk(weight: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Probability of the state before each slot (rows, N, states) from weights (rows, N, patterns), block by block.

    And (rows, N) what the probabilities' sum was multiplied with at every slot. States far back tell nothing of a slot,
    so that blocks can be walked side by side, each from a few slots before its own.
    """
    n_rows, n, n_patterns = weight.shape
    states = n_patterns // 2
    n_blocks = -(-n // _BLOCK)
    # Slots outside weigh all patterns alike, which leaves the state at the sequence's ends open.
    padded = np.ones((n_rows, _LEAD + n_blocks * _BLOCK, n_patterns), np.float32)
    padded[:, _LEAD : _LEAD + n] = weight
    windows = np.lib.stride_tricks.sliding_window_view(padded, _LEAD + _BLOCK, axis=1)[:, ::_BLOCK]
    # A pattern is the state and one new bit; the new state drops the oldest bit.
    steps = np.ascontiguousarray(windows.transpose(3, 0, 1, 2)).reshape(-1, n_rows * n_blocks, 2, states // 2, 2)
    out = np.empty((_BLOCK, n_rows * n_blocks, states), np.float32)
    scale = np.empty((_BLOCK, n_rows * n_blocks, 1), np.float32)
    ones = np.ones((states, 1), np.float32)
    state = np.full((n_rows * n_blocks, states), 1 / states, np.float32)
    for k, step in enumerate(steps, -_LEAD):
        if k >= 0:
            out[k] = state
        pattern = state.reshape(-1, 2, states // 2, 1) * step
        state = (pattern[:, 0] + pattern[:, 1]).reshape(-1, states)
        total = state @ ones + np.float32(1e-30)
        state /= total
        if k >= 0:
            scale[k] = total

    def in_order(values: Float32Array) -> Float32Array:
        by_row = values.reshape(_BLOCK, n_rows, n_blocks, -1).transpose(1, 2, 0, 3)
        return by_row.reshape(n_rows, n_blocks * _BLOCK, -1)[:, :n]

    return in_order(out), in_order(scale)[..., 0]
