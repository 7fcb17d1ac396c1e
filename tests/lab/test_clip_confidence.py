"""Random compressed clips for the calibration of the confidence."""

from __future__ import annotations

from rxcli.lab.benchmark.clip_confidence import clip_of, packets_of, scene_of
from rxcli.lab.benchmark.confidence import calibration

#: A clip of two frames.
SHORT = 44


def test_seeds_differ_and_repeat() -> None:
    scenes = [scene_of(seed) for seed in range(40)]
    assert scenes == [scene_of(seed) for seed in range(40)]
    assert len({clip.scene.screen.name for clip in scenes}) == 3
    assert {clip.codec for clip in scenes} == {"h264", "hevc"}
    assert all(clip.scene.sensor.width % 2 == 0 for clip in scenes)
    bits = [c.bit_rate / (c.scene.sensor.width * c.scene.sensor.height * c.scene.frame_rate_hz) for c in scenes]
    assert min(bits) < 0.06
    assert max(bits) > 1.0


def test_packets_of_a_clip_are_recorded() -> None:
    record = packets_of({"seed": SHORT, "cae": "never"})
    assert record["n_frames"] == len(record["status"]) == 2
    assert record["expected"] == 40
    assert record["error_free"] >= 20
    assert record["false"] == 0
    result = calibration([record])
    assert result.n_packets == len(record["packets"])
    sure = [packet for packet in record["packets"] if packet["confidence"] >= 0.9]
    assert sum(packet["bit_errors"] > 0 for packet in sure) <= 0.1 * len(sure) + 1


def test_the_file_goes_away() -> None:
    with clip_of(SHORT) as (path, take):
        assert path.stat().st_size > 1000
        assert take.scene.n_frames == 2
    assert not path.parent.exists()
