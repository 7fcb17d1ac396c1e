"""Calibration of the confidence: bins and fits against outcomes drawn from known probabilities."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.lab.benchmark.confidence import bin_outcomes, calibration, fit_scaling, logistic_regression, packets_of, rows


def _outcomes(n: int, truth: NDArray[np.float64], seed: int = 0) -> NDArray[np.bool_]:
    return np.random.default_rng(seed).random(n) < truth


@pytest.fixture(scope="module")
def confidence() -> NDArray[np.float64]:
    return np.random.default_rng(3).random(6000)


def test_calibrated_confidence_is_found_so(confidence: NDArray[np.float64]) -> None:
    right = _outcomes(6000, confidence)
    bins = bin_outcomes(confidence, right)
    assert sum(b.n for b in bins) == 6000
    assert all(b.low <= b.reported <= b.high for b in bins)
    assert sum(b.calibrated for b in bins) >= 8
    scaling = fit_scaling(confidence, right)
    assert scaling is not None
    assert (scaling.offset, scaling.slope) == pytest.approx((0, 1), abs=0.1)


def test_overconfidence_is_found_and_scaled_away(confidence: NDArray[np.float64]) -> None:
    logit = np.log(confidence / (1 - confidence))
    right = _outcomes(6000, 1 / (1 + np.exp(2.0 - 0.5 * logit)))
    assert sum(b.calibrated for b in bin_outcomes(confidence, right)) <= 3
    scaling = fit_scaling(confidence, right)
    assert scaling is not None
    assert (scaling.offset, scaling.slope) == pytest.approx((-2, 0.5), abs=0.15)
    assert sum(b.calibrated for b in bin_outcomes(scaling(confidence), right) if b.n > 100) >= 3


def test_weights_of_evidence_are_found_again() -> None:
    terms = np.concatenate([np.ones((8000, 1)), np.random.default_rng(7).normal(size=(8000, 2))], axis=1)
    weights = np.array([0.5, 1.5, -0.8])
    found = logistic_regression(terms, _outcomes(8000, 1 / (1 + np.exp(-terms @ weights))))
    assert found == pytest.approx(weights, abs=0.1)


def test_outcomes_all_alike_suggest_nothing() -> None:
    ones = np.full(5, 1.0)
    assert fit_scaling(ones, np.ones(5, bool)) is None
    assert bin_outcomes(ones, np.ones(5, bool))[-1].right == 5


def test_a_simulated_frame_gives_packets_with_outcomes() -> None:
    record = packets_of({"seed": 4, "cae": "never"})
    assert record["packets"]
    result = calibration([record])
    assert result.n_packets == len(record["packets"])
    assert sum(row["packets"] for row in rows(result)) == result.n_packets
    for packet in record["packets"]:
        assert 0 <= packet["confidence"] <= 1
        assert packet["bit_errors"] >= 0
        assert len(packet["evidence"]) == 8
