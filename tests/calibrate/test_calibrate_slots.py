"""Line delay from a screen that sends data: the slot clock, its parts and multiples, refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from rxcli.calibrate.bent import calibrate_bent
from rxcli.calibrate.slots import calibrate_slots
from rxcli.cli.main import run
from rxcli.errors import ExitCode, ReceiverError
from rxcli.lab.simulate.capture import prepare
from rxcli.lab.simulate.optics import Lens
from rxcli.lab.simulate.scenes import preset
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.types import Frame

HEADER = [0, 0, 1, 1, 1, 0, 0, 0, 1, 1]


def packet(rng: np.random.Generator) -> Any:
    symbols = [rng.permutation([1] * 5 + [0] * 5) for _ in range(5)]
    return np.concatenate([HEADER, [1] * 5 + [0] * 5, *symbols])


def screen_picture(rng: np.random.Generator, rows_per_slot: float, n_rows: int, exposure_slots: float = 1.0) -> Any:
    """16 columns of random symbols, five slots of ten lit, each packet three times; delays of up to two slots."""
    time = np.arange(n_rows) / rows_per_slot
    columns = []
    for delay in rng.uniform(-2, 2, 16):
        bursts = [np.tile(packet(rng), 3) for _ in range(6)]
        lit = np.concatenate([[0.0], np.cumsum(np.concatenate(bursts))])
        start = time + 100 + delay
        edges = np.arange(lit.size)
        light = np.interp(start + exposure_slots, edges, lit) - np.interp(start, edges, lit)
        columns.append(np.repeat(light[:, None] / exposure_slots, 12, axis=1))
    picture = 0.05 + 0.7 * np.hstack(columns) * rng.uniform(0.5, 1, (1, 192))
    return np.clip(picture + 0.01 * rng.standard_normal(picture.shape), 0, 1)


@pytest.mark.parametrize(("rows_per_slot", "exposure_slots"), [(2.6, 0.5), (4.99, 1.08), (9.98, 0.6), (20.3, 0.3)])
def test_line_delay_from_data(rows_per_slot: float, exposure_slots: float) -> None:
    picture = screen_picture(np.random.default_rng(1), rows_per_slot, 2000, exposure_slots)
    result = calibrate_slots([picture], 8650, 70)
    truth = 1 / (8650 * rows_per_slot)
    assert result.line_delay_s == pytest.approx(truth, rel=1e-3)
    low, high = result.line_delay_interval_s
    assert low - (high - low) < truth < high + (high - low)
    assert result.periods == pytest.approx(2000 / rows_per_slot, rel=1e-3)


def test_the_other_packet_length_is_not_accepted() -> None:
    picture = screen_picture(np.random.default_rng(2), 5.0, 2000)
    with pytest.raises(ReceiverError, match="slot clock"):
        calibrate_slots([picture], 17300, 133)


def test_no_slot_clock_in_noise_or_a_scene() -> None:
    rng = np.random.default_rng(3)
    for picture in (rng.random((600, 400)), np.full((600, 400), 0.4), np.cumsum(rng.random((600, 400)), axis=0) / 600):
        with pytest.raises(ReceiverError, match="slot clock"):
            calibrate_slots([picture], 8650, 70)


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "screen.png"
    picture = screen_picture(np.random.default_rng(4), 6.1, 1500)
    Image.fromarray(np.round(255 * picture).astype(np.uint8)).save(path)
    assert run(["calibrate", "shutter", str(path), "--screen", "paper-8k65", "--json", "-"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["readout_s"] == pytest.approx(1500 / 8650 / 6.1, rel=1e-3)
    assert run(["calibrate", "shutter", str(path), "--screen", "no-such"]) == ExitCode.USAGE


@pytest.mark.parametrize("name", ["video4k_rocket_34k6.mp4", "xs10_china_17k3.jpg", "phone_astronaut_17k3.jpg"])
def test_reference_captures(shared_captures: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = shared_captures / name
    truth = json.loads((shared_captures / f"{path.stem}.truth.json").read_text())
    arguments = ["calibrate", "shutter", str(path), "--screen", truth["screen"], "--frames", "1", "--json", "-"]
    assert run(arguments) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["line_delay_s"] == pytest.approx(truth["camera"]["line_delay_s"], rel=3e-4)


def test_bent_stripes_are_measured_with_their_bend() -> None:
    """A phone that took its lens distortion out: the slot clock along the picture's rows is not the sensor's."""
    screen = load_profile("paper-17k3", ScreenProfile)
    line_delay_s = 1 / (3.4 * screen.slot_rate_hz)
    base = preset("phone-corrected", screen)
    scene = replace(
        base,
        sensor=replace(base.sensor, width=1280, height=960, line_delay_s=line_delay_s),
        lens=Lens(0.8, (0.08, -0.04, 0.0, 0.0, 0.0)),
        exposure_s=0.6 / screen.slot_rate_hz,
        light_e_per_s=2.5e6,
    )
    frame = Frame(prepare(scene, 1).frame(0).pixels, "phone")
    result = calibrate_bent([frame], screen)
    assert result is not None
    assert result.line_delay_s == pytest.approx(line_delay_s, rel=5e-4)
    low, high = result.line_delay_interval_s
    assert low < line_delay_s < high
    assert "bent" in result.warnings[0]
    straight = replace(scene, isp=replace(base.isp, correct_distortion=False), lens=Lens(0.8, (0.0,) * 5))
    assert calibrate_bent([Frame(prepare(straight, 1).frame(0).pixels, "phone")], screen) is None
