"""Yardsticks and sweeps on small frames."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from rxcli.lab.benchmark import sweeps, yardsticks
from rxcli.lab.benchmark.journal import Journal, Run
from rxcli.lab.benchmark.trial import Trial, simulate_trial
from rxcli.lab.simulate.scenes import preset
from rxcli.protocol import encode_packet, payload_bits
from rxcli.results.truth import Score


@pytest.fixture(scope="module")
def easy() -> Trial:
    """A plain picture, plenty of light, a camera that is held straight."""
    scene = preset("xs10-still", "paper-17k3")
    pose = replace(scene.pose, roll_deg=0.0, yaw_deg=0.0, pitch_deg=0.0)
    scene = replace(sweeps.binned(scene, 0.07), picture="sky", pose=pose)
    return simulate_trial(scene, 3, oracle=True)


def test_bound_and_paper_read_an_easy_frame(easy: Trial) -> None:
    bound, paper = yardsticks.bound_score(easy), yardsticks.paper_score(easy)
    assert bound.expected == paper.expected > 0
    assert bound.error_free == bound.expected
    assert bound.false == 0
    assert paper.error_free > 0.5 * paper.expected


def test_the_bound_is_no_magic(easy: Trial) -> None:
    dark = replace(easy.capture.scene, light_e_per_s=easy.capture.scene.light_e_per_s * 1e-4)
    score = yardsticks.bound_score(simulate_trial(dark, 3, oracle=True))
    assert score.ber is not None
    assert score.ber > 0.25


def test_paper_reads_packets_between_two_headers() -> None:
    rng = np.random.default_rng(0)
    screen = sweeps.screen_of(sweeps.Point("x", "x", payload_symbols=5))
    payload = rng.integers(0, 2, payload_bits(4, 5)).astype(np.uint8)
    slots = np.tile(encode_packet(payload, 4), 2)[:-20]
    lit = np.repeat(slots, 6)
    starts, agreement = yardsticks.find_headers(lit.astype(bool), 6.0)
    assert 0 in np.round(starts)
    assert agreement.max() == 1
    # The second header is cut off: two are needed.
    assert list(yardsticks._between_headers(lit[: 70 * 6], 6.0, screen)) == []
    found = list(yardsticks._between_headers(lit, 6.0, screen))
    assert [packet.payload for packet in found] == [np.packbits(payload).tobytes().hex()]


def test_binning_keeps_the_electrons(easy: Trial) -> None:
    whole = preset("xs10-still", "paper-17k3")
    narrow = sweeps.binned(whole, 0.25)
    assert narrow.sensor.height == whole.sensor.height
    assert narrow.sensor.width == whole.sensor.width / 4
    assert narrow.light_e_per_s / narrow.sensor.full_scale_e == pytest.approx(
        whole.light_e_per_s / whole.sensor.full_scale_e
    )
    assert narrow.light_e_per_s * narrow.sensor.width == pytest.approx(whole.light_e_per_s * whole.sensor.width)
    assert sweeps.binned(whole, 1.5) is whole


def test_points_are_told_apart_and_rates_are_the_papers() -> None:
    points = sweeps.points_of(sweeps.SWEEPS)
    assert len({(p.sweep, p.label) for p in points}) == len(points)
    rates = [p.rate_kbps for p in points if p.sweep == "rate" and p.picture == "sky"]
    assert rates[:3] == pytest.approx([42.0, 92.4, 201.6])
    free = {p.label: p.free_rate_kbps for p in points if p.sweep == "table4"}
    assert free["20 columns, 1 x"] == pytest.approx(3 * free["20 columns, 3 x"])
    for point in points:
        scene = sweeps.scene_of(point)
        assert scene.screen.columns == point.columns
        assert not point.binned or scene.sensor.width <= point.columns * 46


def test_a_sweep_runs_resumes_and_sums(tmp_path: Path) -> None:
    point = sweeps.Point("t", "t", 1.0, "video-1080p", slot_rate_hz=17300.0, payload_symbols=11, picture="white")
    point = replace(point, receivers=("receiver", "no auto-encoder"))
    path = tmp_path / "journal.jsonl"
    first = sweeps.run([point], 2, Run(Journal(path), quiet=True))
    again = sweeps.run([point], 2, Run(Journal(path), quiet=True))
    assert [s.method for s in first] == ["receiver", "no auto-encoder", "bound", "paper"]
    assert [s.as_row() for s in again] == [s.as_row() for s in first]
    bound = first[2].score
    assert all(summary.score.expected == bound.expected for summary in first)
    assert first[0].median_ms() is not None
    assert first[2].median_ms() is None
    plane = sweeps.run_time_plane(first)
    assert all(p.method != "bound" for p in plane)


def _summary(method: str, ms: float, wrong: int) -> sweeps.Summary:
    score = Score(expected=10, bits=770, error_free=10 - wrong, bit_errors=5 * wrong)
    return sweeps.Summary(sweeps.Point("t", "t"), method, (sweeps.Outcome(score, 10, {"total": ms}),))


def test_plane_marks_the_front_and_intervals_hold_the_rate() -> None:
    summaries = [_summary("a", 10.0, 2), _summary("b", 20.0, 1), _summary("c", 30.0, 3)]
    assert [p.on_front for p in sweeps.run_time_plane(summaries)] == [True, True, False]
    row = summaries[0].as_row()
    low, high = row["ber95"]
    assert low < row["ber"] == 10 / 770 < high
    assert row["error_free"] == 0.8
    record = asdict(summaries[0].outcomes[0])
    assert sweeps.Outcome.from_record(record) == summaries[0].outcomes[0]
    assert sweeps.Point(**asdict(summaries[0].point)) == summaries[0].point
