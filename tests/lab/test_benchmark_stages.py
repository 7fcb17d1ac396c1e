"""Time and memory per stage: what is measured, not how fast it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rxcli.errors import ReceiverError
from rxcli.lab.benchmark import stages
from rxcli.lab.simulate.scenes import preset


@pytest.fixture(scope="module")
def small_jpeg(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("media") / "small.jpg"
    scene = replace(preset("video-1080p", "paper-17k3").scaled(0.4, 1.0), n_frames=1)
    stages._write_capture(scene, path, 0)
    return path


def test_a_measurement_runs_in_its_own_process(small_jpeg: Path) -> None:
    medium = stages.Medium("small", "video-1080p", "paper-17k3", ".jpg")
    timing = stages.time_medium(medium, small_jpeg, 1, 1)
    assert timing.bare_ms > 0
    assert timing.stages_ms["ingest"] > 0
    assert timing.ratio == timing.total_ms / timing.bare_ms
    assert sum(timing.stages_ms.values()) <= timing.total_ms * 1.01
    assert timing.status in {"ok", "partial", "no_screen", "no_signal"}
    (row,) = stages.timing_rows([timing])
    assert row["ingest"] == timing.stages_ms["ingest"] / timing.bare_ms


def test_peak_memory_is_the_process_s_own(small_jpeg: Path) -> None:
    ballast = bytearray(300 << 20)
    assert stages.peak_memory_mb() > 300
    medium = stages.Medium("small", "video-1080p", "paper-17k3", ".jpg")
    memory = stages.memory_of(medium, small_jpeg)
    assert 0 < memory["idle_mb"] <= memory["peak_mb"]
    assert memory["idle_mb"] < 250
    assert len(ballast) == 300 << 20


def test_a_failed_measurement_is_told() -> None:
    with pytest.raises(ReceiverError, match="measurement memory failed"):
        stages.in_process({"work": "memory", "path": "none.jpg", "screen": "paper-17k3", "threads": 1})


def test_growth_scenes_show_the_same_time() -> None:
    for megapixels in (2.0, 26.0):
        scene = stages.growth_scene(megapixels, 50)
        assert scene.sensor.width * scene.sensor.height == pytest.approx(megapixels * 1e6, rel=0.01)
        assert scene.sensor.height * scene.sensor.line_delay_s == pytest.approx(24.098e-3, rel=1e-3)
        assert scene.screen.columns == 50


def test_exponent() -> None:
    assert stages.Growth("columns", (20.0, 200.0), (5.0, 50.0)).exponent == pytest.approx(1.0)
