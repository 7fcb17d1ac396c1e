"""The benchmark of outlines: scenes are placed as asked, errors and rows are counted right."""

from __future__ import annotations

import numpy as np
import pytest

from rxcli.lab.benchmark.outline import BOUND, corner_error, kind_of, rows, scene_of, search
from rxcli.lab.benchmark.trial import simulate_trial
from rxcli.lab.simulate.optics import View
from rxcli.lab.simulate.scenes import preset


@pytest.mark.parametrize("seed", range(12))
def test_screens_lie_in_the_picture_at_any_size(seed: int) -> None:
    scene = scene_of(seed)
    size = np.array([scene.sensor.width, scene.sensor.height])
    corners = View(
        scene.screen, scene.lens, scene.pose, scene.sensor.width, scene.sensor.height, scene.sensor.pixel_aspect
    ).corners
    assert (corners > 0).all()
    assert (corners < size).all()
    assert 0.35 < (np.ptp(corners, axis=0) / size).max() < 0.99


def test_an_error_is_the_farthest_corner_in_any_order() -> None:
    truth = np.array([[0.0, 0], [100, 0], [100, 60], [0, 60]])
    found = np.roll(truth + np.array([[0, 0], [0, 3], [0, 0], [0, 1]]), 2, axis=0)
    assert corner_error(found, truth) == pytest.approx(0.03)


def test_rows_count_what_was_not_found() -> None:
    kind = kind_of(preset("video-1080p"))
    table = rows([{"kind": kind, "error": error} for error in (BOUND / 2, 2 * BOUND, None)])
    assert [row["frames"] for row in table] == ["other", "all"]
    assert table[-1]["n"] == 3
    assert table[-1]["within_0.3_%"] == pytest.approx(1 / 3)
    assert table[-1]["none_found"] == pytest.approx(1 / 3)
    assert table[-1]["median_error"] == pytest.approx(1.25 * BOUND)


def test_a_bright_screen_is_found() -> None:
    assert search(simulate_trial(preset("video-1080p", "paper-17k3"), 3)) < BOUND
