"""The sweep of simulated phones: what is drawn, received, and counted."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from rxcli.cli.benchmark import benchmark
from rxcli.lab.benchmark import phones
from rxcli.lab.benchmark.journal import Run


def test_phones_are_as_asked_for() -> None:
    drawn = [phones.phone_of(3, number) for number in range(60)]
    assert len({turned for _, turned in drawn}) == 2
    assert {scene.isp.correct_distortion for scene, _ in drawn} == {False, True}
    for scene, _ in drawn:
        sensor, screen = scene.sensor, scene.screen
        assert 1.5 <= scene.rows_per_slot <= 20
        assert 5e-3 <= sensor.line_delay_s * sensor.height <= 45e-3
        assert 0.65 <= scene.lens.focal_widths <= 1.2
        assert abs(scene.lens.distortion[0]) <= 0.15
        rows = scene.pose.fill * sensor.width / screen.aspect
        assert rows / scene.rows_per_slot / screen.packet_slots >= 1.3


def test_a_number_is_the_same_phone_again() -> None:
    assert phones.phone_of(3, 7) == phones.phone_of(3, 7)
    assert phones.phone_of(3, 7) != phones.phone_of(4, 7)


def _record(**changes: Any) -> dict[str, Any]:
    return {
        "picture": "coffee",
        "rows_per_slot": 4.0,
        "rows_per_slot_hat": 4.0,
        "rows_per_slot_sd": 0.001,
        "exposure_slots": 1.0,
        "corrected": False,
        "k1": 0.1,
        "status": "ok",
        "packets": [],
    } | changes


def test_estimates_and_packets_are_counted() -> None:
    packets = [
        {"confidence": 0.95, "bit_errors": 0},
        {"confidence": 0.999, "bit_errors": 3},
        {"confidence": 0.5, "bit_errors": 1},
    ]
    records = [
        _record(packets=packets),
        _record(rows_per_slot_hat=4.0015, corrected=True),
        _record(rows_per_slot_hat=4.1, rows_per_slot=4.0),
        _record(rows_per_slot_hat=None, rows_per_slot_sd=None, picture="hubble", status="no_signal"),
    ]
    table = {row["phones"]: row for row in phones.rows(records)}
    whole = table["all"]
    assert (whole["n"], whole["within"], whole["none"], whole["wild"]) == (4, 2, 1, 1)
    assert (whole["in_1_sd"], whole["in_2_sd"]) == (0.5, 1.0)
    assert (whole["packets"], whole["right"]) == (3, 1)
    assert (whole["at_0.9"], whole["wrong_at_0.9"], whole["at_0.99"], whole["wrong_at_0.99"]) == (2, 1, 1, 1)
    assert (table["corrected"]["n"], table["corrected"]["within"]) == (1, 1)
    assert table["star field"]["none"] == 1
    assert [row["number"] for row in phones.missed(records)] == [2, 3]


def test_a_turned_picture_has_its_corners_turned() -> None:
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    corners = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 2.0], [0.0, 2.0]])
    trial: Any = SimpleNamespace(capture=SimpleNamespace(pixels=pixels), corners=corners)
    frame, turned = phones.as_stored(trial, True)
    assert frame.pixels[0, 0] == 11
    np.testing.assert_allclose(turned[0], [3, 2])


def test_the_command_writes_what_it_found(tmp_path: Path) -> None:
    arguments = ["phones", "--count", "1", "--seed", "905", "--cae", "never", "--out", str(tmp_path), "--quiet"]
    result = CliRunner().invoke(benchmark, arguments)
    assert result.exit_code == 0, result.output
    assert "rows per slot within 0.05 %" in result.output
    rows = json.loads((tmp_path / "phones.json").read_text())["rows"]
    assert (rows[0]["phones"], rows[0]["n"]) == ("all", 1)
    (record,) = Run(seed=905, quiet=True).scenes("phones", phones.packets_of, 1, cae="never")
    assert record["rows_per_slot_hat"] == pytest.approx(record["rows_per_slot"], rel=5e-4)
    assert sum(packet["bit_errors"] == 0 for packet in record["packets"]) >= 5
