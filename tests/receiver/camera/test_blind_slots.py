"""Slots that overlap through the exposure: the trellis against brute force, and decisions at levels nobody told."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest

from rxcli.protocol import encode_packet, payload_bits
from rxcli.receiver.camera.trellis import lit_probability, log_evidence, pattern_light
from rxcli.receiver.camera.waves import (
    SAMPLES,
    Grid,
    Slots,
    Waves,
    decide,
    exposure_of_known,
    likely_weights,
    packet_llr,
    read_freely,
)


@pytest.mark.parametrize("n_bits", [3, 5])
def test_probabilities_are_those_of_all_sequences(n_bits: int) -> None:
    rng = np.random.default_rng(n_bits)
    n, reach = 7, n_bits // 2
    metric, log_odds = rng.normal(0, 2, (2, n, 1 << n_bits)), rng.normal(0, 1, (2, n))
    lit, total, count = np.zeros((2, n)), np.zeros(2), np.zeros(2)
    for bits in product((0, 1), repeat=n + 2 * reach):
        pattern = [int("".join(map(str, bits[k : k + n_bits])), 2) for k in range(n)]
        middle = np.array(bits[reach : reach + n])
        prior = np.exp((log_odds * middle - np.logaddexp(0, log_odds)).sum(axis=1))
        weight = prior * np.exp(metric[:, np.arange(n), pattern].sum(axis=1))
        lit += weight[:, None] * middle
        total += weight
        count += prior
    found, evidence = lit_probability(np.moveaxis(metric, 2, 0), log_odds)
    np.testing.assert_allclose(found, lit / total[:, None], atol=1e-6)
    # The slots beyond the ends are any.
    np.testing.assert_allclose(evidence, np.log(total / count), rtol=1e-5)
    np.testing.assert_allclose(log_evidence(np.moveaxis(metric, 2, 0), log_odds), evidence, rtol=1e-6)


def test_patterns_see_the_share_of_every_slot() -> None:
    light = pattern_light(1.5, 4)
    np.testing.assert_allclose(light[0b000], 0)
    np.testing.assert_allclose(light[0b111], 1)
    # The first sample, an eighth into the slot, begins 0.625 slots before it.
    np.testing.assert_allclose(light[0b100, 0], 0.625 / 1.5)
    assert pattern_light(2.2, 4).shape == (32, 4)


def _scene(rng: np.random.Generator, exposure: float, weights: list[int]) -> tuple[Waves, Any, Grid]:
    """Levelled light of columns of 17.3 kHz packets from slot 50 on, the slots, and where they stand."""
    packets = [
        np.concatenate([encode_packet(rng.integers(0, 2, payload_bits(w, 11), dtype=np.uint8), w) for _ in range(3)])
        for w in weights
    ]
    slots = np.stack(packets)[:, 50:300].astype(np.float64)
    fine = np.repeat(slots, 40, axis=1)
    box = np.ones(max(round(exposure * 40), 1))
    seen = np.stack([np.convolve(row, box / box.size, "same") for row in fine])[:, 5 :: 40 // SAMPLES]
    seen = (seen - seen.mean(axis=1, keepdims=True)) / seen.std(axis=1, keepdims=True)
    noisy = seen + rng.normal(0, 0.25, seen.shape)
    return Waves(noisy.astype(np.float32), np.ones(seen.shape, np.float32)), slots, Grid(50, 130)


@pytest.mark.parametrize("exposure", [0.5, 1.2, 1.9])
def test_slots_are_found_at_unknown_levels(exposure: float) -> None:
    weights = [2, 3, 5, 5, 7, 8]
    waves, truth, grid = _scene(np.random.default_rng(5), exposure, weights)
    lit, _ = read_freely(waves, exposure)
    slots = Slots(lit, np.array(weights))
    for _ in range(3):
        slots = decide(waves, exposure, grid, slots)
    assert np.mean((slots.lit > 0.5) != (truth > 0.5)) < (0.02 if exposure < 1.5 else 0.06)


@pytest.mark.parametrize("exposure", [0.5, 1.2, 1.9])
def test_skewness_tells_the_weight(exposure: float) -> None:
    weights = np.array([1, 2, 3, 5, 5, 7, 8, 9])
    waves, _, _ = _scene(np.random.default_rng(5), exposure, weights.tolist())
    found = likely_weights(waves, exposure)
    assert np.abs(found - weights).max() <= 1
    assert np.count_nonzero(found == weights) >= 5


def test_evidence_knows_where_headers_are() -> None:
    waves, _, grid = _scene(np.random.default_rng(6), 1.0, [3, 4, 5, 6, 7])
    lit, _ = read_freely(waves, 1.0)
    slots = Slots(lit, np.array([3, 4, 5, 6, 7]))
    right = packet_llr(waves, 1.0, grid, decide(waves, 1.0, grid, slots))
    wrong = Grid((grid.first_slot + 37) % 130, 130)
    assert right > 60
    assert packet_llr(waves, 1.0, wrong, decide(waves, 1.0, wrong, slots)) < 0.2 * right


@pytest.mark.parametrize("exposure", [0.6, 1.3, 2.0])
def test_exposure_is_told_by_the_blur(exposure: float) -> None:
    waves, truth, grid = _scene(np.random.default_rng(7), exposure, [3, 4, 5, 5, 6, 7, 5, 4])
    start = Slots(np.asarray(truth * 0.8 + 0.1, np.float32), np.array([3, 4, 5, 5, 6, 7, 5, 4]))
    found, _ = exposure_of_known(waves, start.lit, None)
    slots = decide(waves, found, grid, start)
    again, sd = exposure_of_known(waves, slots.lit, found)
    assert again == pytest.approx(exposure, abs=0.2)
    assert 0.02 <= sd <= 0.5
