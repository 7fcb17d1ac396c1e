"""Line delay from a screen that sends data: known line delays are found again, refusals."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import rxcli
from rxcli.calibrate.slots import calibrate_slots
from rxcli.cli.main import run
from rxcli.errors import ExitCode, ReceiverError
from rxcli.lab.simulate.capture import prepare
from rxcli.lab.simulate.optics import Lens
from rxcli.lab.simulate.scenes import preset
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.types import Frame

SCREEN = load_profile("paper-17k3", ScreenProfile)


def phone_picture(rows_per_slot: float, k1: float = 0.0, seed: int = 1) -> Any:
    """A phone's picture of the screen; its lens distortion `k1` is corrected in the camera."""
    base = preset("phone-corrected", SCREEN)
    scene = replace(
        base.exposed(0.6 / SCREEN.slot_rate_hz),
        sensor=replace(base.sensor, width=1280, height=960, line_delay_s=1 / (rows_per_slot * SCREEN.slot_rate_hz)),
        lens=Lens(0.8, (k1, -k1 / 2, 0.0, 0.0, 0.0)),
        isp=replace(base.isp, correct_distortion=k1 != 0),
    )
    return prepare(scene, seed).frame(0).pixels


@pytest.mark.parametrize(("rows_per_slot", "k1"), [(2.6, 0.0), (3.4, 0.08), (5.1, 0.0)])
def test_line_delay_from_data(rows_per_slot: float, k1: float) -> None:
    """Also of a phone that corrected its lens distortion: its rows are not the sensor's."""
    frame = Frame(phone_picture(rows_per_slot, k1), "phone")
    result = calibrate_slots([frame], SCREEN)
    truth = 1 / (SCREEN.slot_rate_hz * rows_per_slot)
    assert result.line_delay_s == pytest.approx(truth, rel=5e-4)
    low, high = result.line_delay_interval_s
    assert low - (high - low) < truth < high + (high - low)
    assert result.periods == pytest.approx(960 / rows_per_slot, rel=1e-3)
    assert [("corrected" in warning) for warning in result.warnings] == [True] * (k1 != 0)


def test_a_rotated_picture_is_read_along_its_columns() -> None:
    frame = Frame(np.ascontiguousarray(np.rot90(phone_picture(3.4), -1)), "phone")
    result = calibrate_slots([frame], SCREEN, "columns")
    assert result.line_delay_s == pytest.approx(1 / (SCREEN.slot_rate_hz * 3.4), rel=5e-4)
    assert result.n_lines == 960


@pytest.mark.parametrize("picture", [np.full((600, 400), 90), np.random.default_rng(3).integers(0, 256, (600, 400))])
def test_pictures_without_a_slot_clock_are_refused(picture: Any) -> None:
    with pytest.raises(ReceiverError, match="slot clock"):
        calibrate_slots([Frame(picture.astype(np.uint8), "x")], SCREEN)


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "screen.png"
    Image.fromarray(phone_picture(3.4)).save(path)
    arguments = ["calibrate", "shutter", str(path), "--json", "-", "--screen"]
    assert run([*arguments, "paper-17k3"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["readout_s"] == pytest.approx(960 / SCREEN.slot_rate_hz / 3.4, rel=1e-3)
    assert run([*arguments, "no-such"]) == ExitCode.USAGE
    assert run([*arguments, "paper-17k3", "--region", "0,0,99,99"]) == ExitCode.USAGE


def test_the_profile_of_a_camera_that_corrects_its_lens_receives_the_next_picture(tmp_path: Path) -> None:
    pictures = [tmp_path / "first.png", tmp_path / "next.png"]
    for seed, path in enumerate(pictures, 1):
        Image.fromarray(phone_picture(3.4, 0.08, seed)).save(path)
    profile = str(tmp_path / "phone.toml")
    assert run(["calibrate", "shutter", str(pictures[0]), "--screen", "paper-17k3", "--save", profile]) == 0
    result = rxcli.decode(pictures[1], screens="paper-17k3", cameras=profile)
    assert result.camera_profile == "phone"
    assert sum(packet.is_believable for packet in result.packets) >= 12


@pytest.mark.parametrize("name", ["video4k_rocket_34k6.mp4", "xs10_china_17k3.jpg", "phone_astronaut_17k3.jpg"])
def test_reference_captures(shared_captures: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = shared_captures / name
    truth = json.loads((shared_captures / f"{path.stem}.truth.json").read_text())
    arguments = ["calibrate", "shutter", str(path), "--screen", truth["screen"], "--frames", "1", "--json", "-"]
    assert run(arguments) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["line_delay_s"] == pytest.approx(truth["camera"]["line_delay_s"], rel=3e-4)
