"""Probabilities of slots that overlap through the exposure: forward-backward over all columns at once."""

from __future__ import annotations

import numpy as np

from rxcli.types import Float32Array, FloatArray


def pattern_light(exposure_slots: float, samples: int) -> FloatArray:
    """Light 0..1 of the middle slot's samples for every pattern of it and its neighbours.

    Args:
        exposure_slots: exposure; up to two slots three slots are seen, up to four slots five.
        samples: samples a slot.

    Returns:
        (2**n, samples), n = 3 or 5; the earliest slot is the most significant bit.
    """
    reach = 1 if exposure_slots <= 2 else 2
    n = 2 * reach + 1
    middle = (np.arange(samples) + 0.5) / samples
    slot = np.arange(-reach, reach + 1)[:, None]
    begin = np.maximum(middle - exposure_slots / 2, slot)
    end = np.minimum(middle + exposure_slots / 2, slot + 1)
    share = np.maximum(end - begin, 0) / exposure_slots
    patterns = (np.arange(1 << n)[:, None] >> np.arange(n - 1, -1, -1)) & 1
    return np.asarray(patterns @ share)


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
    n_columns, n, n_patterns = metric.shape
    n_bits = n_patterns.bit_length() - 1
    reach = n_bits // 2
    middle = ((np.arange(n_patterns) >> reach) & 1).astype(np.float32)
    weight = metric + (log_odds[..., None] * middle - np.logaddexp(0, log_odds)[..., None])
    top = weight.max(axis=2, keepdims=True)
    weight = np.exp(np.maximum(weight - top, -60)).astype(np.float32)
    # The way back is the way forth of the mirrored sequence: both are walked together.
    mirrored = np.array([int(format(p, f"0{n_bits}b")[::-1], 2) for p in range(n_patterns)])
    both = np.concatenate([weight, weight[:, ::-1][..., mirrored]]).transpose(1, 0, 2)
    walked, scales = _walk(np.ascontiguousarray(both).reshape(n, 2 * n_columns, 2, n_patterns // 2))
    ahead = walked[:, :n_columns]
    back = walked[::-1, n_columns:]
    # State before slot k: its first n - 1 bits; state after it, from the other side, mirrored: its last n - 1.
    states = n_patterns // 2
    turned = np.array([int(format(s, f"0{n_bits - 1}b")[::-1], 2) for s in range(states)])
    patterns = np.arange(n_patterns)
    joint = ahead[..., patterns >> 1] * back[..., turned[patterns & (states - 1)]] * weight.transpose(1, 0, 2)
    total = joint.sum(axis=2)
    log_evidence = np.log(scales[:, :n_columns].astype(np.float64)).sum(axis=0) + top.sum(axis=(1, 2), dtype=np.float64)
    return np.asarray(((joint @ middle) / np.maximum(total, 1e-30)).T, np.float32), log_evidence


def _walk(weight: Float32Array) -> tuple[Float32Array, Float32Array]:
    """(N, 2C, states) probability of the state before each slot, from the weights (N, 2C, oldest bit, others).

    And (N, 2C) what the probabilities' sum was multiplied with at every slot.
    """
    n, n_rows, _, states = weight.shape
    out = np.empty((n, n_rows, states), np.float32)
    scale = np.empty((n, n_rows, 1), np.float32)
    ones = np.ones((states, 1), np.float32)
    # A pattern is the state and one new bit; the new state drops the oldest bit.
    weight = weight.reshape(n, n_rows, 2, states // 2, 2)
    state = np.full((n_rows, states), 1 / states, np.float32)
    for k in range(n):
        out[k] = state
        pattern = state.reshape(n_rows, 2, states // 2, 1) * weight[k]
        state = (pattern[:, 0] + pattern[:, 1]).reshape(n_rows, states)
        np.matmul(state, ones, out=scale[k])
        scale[k] += np.float32(1e-30)
        state /= scale[k]
    return out, scale[..., 0]
