"""Time and memory per stage: what is measured, not how fast it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rxcli.errors import ReceiverError, UsageError
from rxcli.lab.benchmark import speed
from rxcli.lab.simulate.scenes import preset
from rxcli.runs.processes import peak_memory_mb


@pytest.fixture(scope="module")
def small_jpeg(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("media") / "small.jpg"
    scene = replace(preset("video-1080p", "paper-17k3").scaled(0.4, 1.0), n_frames=1)
    speed.write_capture(scene, path, 0)
    return path


def test_a_measurement_runs_in_its_own_process(small_jpeg: Path) -> None:
    medium = speed.Medium("small", "video-1080p", "paper-17k3", ".jpg")
    timing = speed.time_medium(medium, small_jpeg, 1, 1)
    assert timing.times_real_time is None
    assert timing.bare_ms > 0
    assert timing.stages_ms["ingest"] > 0
    assert timing.ratio == timing.total_ms / timing.bare_ms
    assert sum(timing.stages_ms.values()) <= timing.total_ms * 1.01
    assert timing.status in {"ok", "partial", "no_screen", "no_signal"}
    (row,) = speed.timing_rows([timing])
    assert row["ingest"] == timing.stages_ms["ingest"] / timing.bare_ms


def test_peak_memory_is_the_process_s_own(small_jpeg: Path) -> None:
    ballast = bytearray(300 << 20)
    assert peak_memory_mb() > 300
    medium = speed.Medium("small", "video-1080p", "paper-17k3", ".jpg")
    memory = speed.memory_of(medium, small_jpeg)
    assert 0 < memory["idle_mb"] <= memory["peak_mb"]
    assert memory["idle_mb"] < 250
    assert len(ballast) == 300 << 20


def test_a_failed_measurement_is_told() -> None:
    with pytest.raises(ReceiverError, match="measurement memory failed"):
        speed.in_process({"work": "memory", "path": "none.jpg", "screen": "paper-17k3", "camera": "xs10"})


def test_growth_scenes_show_the_same_time() -> None:
    for megapixels in (2.0, 26.0):
        scene = speed.growth_scene(megapixels, 50)
        assert scene.sensor.width * scene.sensor.height == pytest.approx(megapixels * 1e6, rel=0.01)
        assert scene.sensor.height * scene.sensor.line_delay_s == pytest.approx(24.098e-3, rel=1e-3)
        assert scene.screen.columns == 50


def test_exponent() -> None:
    assert speed.Growth("columns", (20.0, 200.0), (5.0, 50.0)).exponent == pytest.approx(1.0)


CLIPS = [medium for medium in speed.MEDIA if medium.bursts_a_frame is not None]


@pytest.mark.parametrize("medium", CLIPS, ids=lambda medium: medium.name)
def test_the_payload_comes_again_with_the_first_frame(medium: speed.Medium) -> None:
    assert medium.bursts_a_frame is not None
    scene = speed.endless(preset(medium.camera, medium.screen), medium.n_frames, medium.bursts_a_frame)
    slots = scene.n_frames * scene.screen.slot_rate_hz / scene.frame_rate_hz
    bursts = slots / (scene.screen.packet_slots * scene.screen.repeats)
    assert bursts == pytest.approx(round(bursts), abs=1e-9)
    bits = {"paper-17k3": 77, "paper-34k6": 168}[medium.screen] * 20 * round(bursts)
    assert scene.payload is not None
    assert len(scene.payload) * 8 == bits


def test_a_clip_is_measured(tmp_path: Path) -> None:
    scene = preset("video-1080p", "paper-17k3").scaled(0.2, 0.2, keep_readout=True)
    path = tmp_path / "small.mp4"
    speed.write_capture(replace(scene, n_frames=3, frame_rate_hz=30.0), path, 0)
    timing = speed.time_file(path, "paper-17k3", str(path.with_suffix(".camera.toml")), 1, 2)
    assert timing.frame_rate_hz == pytest.approx(30)
    assert timing.times_real_time == pytest.approx(1e3 / 30 / timing.total_ms)
    assert 0 < timing.bare_cpu_ms < timing.total_cpu_ms


def test_what_has_no_bare_decode_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(50))
    with pytest.raises(UsageError, match="no bare decode"):
        speed.bare_decode(path)
