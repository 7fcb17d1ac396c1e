"""Random compressed clips for the calibration of the confidence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rxcli.lab.benchmark import clip_confidence
from rxcli.lab.benchmark.clip_confidence import ClipScene, Encoding, clips_of, packets_of, rows, scene_of
from rxcli.lab.benchmark.confidence import calibration
from rxcli.lab.simulate.scenes import preset

SEED = 44


def small_scene(_seed: int) -> ClipScene:
    """Two frames, a third as wide."""
    base = preset("video-1080p", "paper-8k65").scaled(0.36, 0.6, keep_readout=True)
    sensor = replace(base.sensor, width=692, height=648)
    scene = replace(base, sensor=sensor, picture="coffee", shake_px=0.0, n_frames=2)
    return ClipScene(scene, "photo", (Encoding("h264", "veryfast", 9_000_000),), camera_told=True)


def test_seeds_differ_and_repeat() -> None:
    clips = [scene_of(seed) for seed in range(60)]
    again = scene_of(7)
    assert again.encodings == clips[7].encodings
    assert again.scene.pose == clips[7].scene.pose
    assert np.array_equal(np.asarray(again.scene.picture), np.asarray(clips[7].scene.picture))
    assert {clip.scene.screen.name for clip in clips} == {"paper-8k65", "paper-17k3", "paper-34k6"}
    assert 15 < sum(clip.kind != "photo" for clip in clips) < 45
    assert 8 < sum(clip.scene.hand_px > 0 for clip in clips) < 35
    assert 6 < sum(not clip.camera_told for clip in clips) < 32
    every = [encoding for clip in clips for encoding in clip.encodings]
    assert {encoding.codec for encoding in every} == {"h264", "hevc"}
    hd = [e.bit_rate for clip in clips if clip.scene.sensor.height == 1080 for e in clip.encodings]
    assert 6e6 <= min(hd) < 7e6
    assert 22e6 < max(hd) <= 25e6


def test_packets_of_a_clip_are_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clip_confidence, "scene_of", small_scene)
    record = packets_of({"seed": SEED, "cae": "never"})
    (clip,) = record["clips"]
    assert clip["bytes"] > 1000
    assert len(clip["given"]["status"]) == record["n_frames"] == 2
    assert clip["given"]["error_free"] >= 20
    assert clip["given"]["false"] == 0
    assert calibration([record]).n_packets == len(record["packets"]) == len(clip["searched"]["packets"])
    last = rows([record])[-1]
    assert (last["clips"], last["n"]) == ("all", 1)
    assert last["corners_given"] == clip["given"]["error_free"]
    confident = [packet for packet in record["packets"] if packet["confidence"] >= 0.99]
    assert last["confident_0.99"] == len(confident)
    assert last["wrong"] == sum(packet["bit_errors"] != 0 for packet in confident)


def test_the_files_go_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clip_confidence, "scene_of", small_scene)
    with clips_of(SEED) as ((path,), take):
        assert path.stat().st_size > 1000
        assert take.scene.n_frames == 2
    assert not path.parent.exists()
