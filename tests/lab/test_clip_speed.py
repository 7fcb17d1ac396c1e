"""The speed benchmark: clips without a seam, and ratios of what was timed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rxcli.lab.benchmark import clip_speed
from rxcli.lab.benchmark.clip_speed import KINDS, Kind, Speed
from rxcli.lab.simulate.capture import prepare
from rxcli.lab.simulate.truth import build_camera_profile
from rxcli.lab.simulate.video import write_video
from rxcli.profiles import dump_profile


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_the_payload_comes_again_with_the_first_frame(kind: Kind) -> None:
    scene = clip_speed.scene_of(kind)
    slots = scene.n_frames * scene.screen.slot_rate_hz / scene.frame_rate_hz
    bursts = slots / (scene.screen.packet_slots * scene.screen.repeats)
    assert bursts == pytest.approx(round(bursts), abs=1e-9)
    bits = {"paper-17k3": 77, "paper-34k6": 168}[kind.screen] * 20 * round(bursts)
    assert scene.payload is not None
    assert len(scene.payload) * 8 == bits


def test_ratios() -> None:
    row = Speed("a.mp4", 60, 1.0, bare_s=(0.5, 0.8), received_s=(0.8, 1.2)).as_row()
    assert row["x real time"] == pytest.approx(1.25)
    assert row["received / bare, wall"] == pytest.approx(1.6)
    assert row["received / bare, cpu"] == pytest.approx(1.5)
    assert row["received cpu ms"] == pytest.approx(20)


def test_a_clip_is_measured(tmp_path: Path) -> None:
    scene = clip_speed.scene_of(KINDS[0]).scaled(0.2, 0.2, keep_readout=True)
    take = prepare(replace(scene, n_frames=3), 0)
    path = tmp_path / "small.mp4"
    write_video((np.asarray(take.frame(n, threads=1).rgb) for n in range(3)), path, "h264", 30.0)
    profile = path.with_suffix(".camera.toml")
    profile.write_text(dump_profile(build_camera_profile(take.scene, take.exposure())), encoding="utf-8")
    speed = clip_speed.measure(path, clip_speed.options_for(str(profile), "paper-17k3"), 2)
    assert speed.n_frames == 3
    assert speed.duration_s == pytest.approx(0.1, rel=1e-3)
    assert speed.bare_s[0] > 0
    assert 0 < speed.bare_s[1] < speed.received_s[1]
