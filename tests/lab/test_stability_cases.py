"""Hostile values that must not upset the receiver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hostile_cases import CASES, base_trial, inspect_frame
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from watched_stages import watched

from rxcli.lab.benchmark.cases import problems_in
from rxcli.lab.benchmark.draw import small_scene
from rxcli.lab.benchmark.trial import simulate_trial
from rxcli.receiver.decode import detect


@pytest.mark.parametrize("case", CASES)
def test_hostile_case(case: str) -> None:
    assert CASES[case]() == []


@settings(max_examples=12, deadline=None, derandomize=True)
@given(
    block=hnp.arrays(
        np.uint8, st.tuples(st.integers(1, 40), st.integers(1, 40)), elements=st.sampled_from([0, 1, 255])
    ),
    row=st.floats(0, 1),
    column=st.floats(0, 1),
    shift=st.floats(-300, 300),
)
def test_no_block_of_extremes_upsets_the_receiver(
    block: NDArray[np.uint8], row: float, column: float, shift: float
) -> None:
    base = base_trial()
    pixels = np.array(base.frame.pixels, np.uint8)
    top, left = int(row * (pixels.shape[0] - 1)), int(column * (pixels.shape[1] - 1))
    part = pixels[top : top + block.shape[0] * 10, left : left + block.shape[1]]
    part[:] = np.repeat(block, 10, axis=0)[: part.shape[0], : part.shape[1]]
    options = replace(base.options(), corners=base.corners + shift * np.array([[1, 0], [0, 1], [-1, 0], [0, -1]]) / 10)
    assert inspect_frame(replace(base.frame, pixels=pixels), options)[1] == []


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    metrics=hnp.arrays(
        np.float64,
        st.tuples(st.integers(1, 2), st.integers(1, 3), st.sampled_from([32, 42]), st.just(4)),
        elements=st.floats(-1e6, 1e6),
    )
)
def test_posteriors_of_any_metrics_are_probabilities(metrics: NDArray[np.float64]) -> None:
    # 20 + 10 N slots and a memory of one: cut what is too much.
    metrics = metrics[:, :, : (metrics.shape[2] - 2) // 10 * 10 + 1]
    with watched() as found:
        posteriors = detect.detect(metrics)
    assert found == []
    assert (posteriors.lit >= 0).all()
    assert (posteriors.lit <= 1 + 1e-6).all()
    assert (posteriors.log_prob <= 1e-9).all()
    assert np.exp(posteriors.w_log_prob).sum(axis=1) == pytest.approx(np.ones(metrics.shape[1]))


def test_the_watch_sees_nan_infinity_and_warnings() -> None:
    assert list(problems_in({"a": (1.0, np.array([np.nan, np.inf]))}, "x")) == [
        "x['a'][1] holds NaN",
        "x['a'][1] holds infinity",
    ]
    assert list(problems_in(np.array([-np.inf, 0.0]), "x")) == []
    with watched() as found:
        np.divide(np.ones(1), np.zeros(1))
    assert "divide by zero" in found[0]


def test_the_watch_names_the_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> float:
        return float("nan")

    broken.__module__ = detect.__name__
    monkeypatch.setattr(detect, "broken", broken, raising=False)
    with watched() as found:
        detect.broken()  # type: ignore[attr-defined]
    assert found == ["detect.broken holds NaN"]
    assert detect.broken is broken  # type: ignore[attr-defined]


@pytest.mark.parametrize("seed", [3394, 1000463])
def test_scenes_that_led_the_pose_astray(seed: int) -> None:
    """Found by ten thousand random scenes: sides that are no screen's, and a pose without a unique step."""
    trial = simulate_trial(small_scene(seed), seed)
    result, problems = inspect_frame(trial.frame, trial.options(known_outline=False))
    assert not problems
    assert result is not None
    assert result.status == "no_screen"
