"""Twins of captures, and the bound on the delivered picture."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rxcli.cli.benchmark import benchmark
from rxcli.errors import InputError
from rxcli.lab.benchmark import captures
from rxcli.lab.benchmark.delivered import delivered
from rxcli.lab.benchmark.trial import Trial, simulate_trial
from rxcli.lab.benchmark.yardsticks import bound_score, genie_score
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.lab.simulate.truth import write_truth
from rxcli.receiver.screen import geometry
from rxcli.results.truth import Score, load_truth
from rxcli.types import Lens

#: Row 0 sees the first burst's end, so that the truth tells when the frame began.
START = 200.0


def small(light: float = 1.0) -> Scene:
    scene = preset("phone-corrected", "paper-17k3").scaled(0.25, keep_readout=True)
    room = replace(scene.room, light_e_per_s=scene.room.light_e_per_s * light)
    return replace(scene, picture="coffee", light_e_per_s=scene.light_e_per_s * light, room=room, start_slot=START)


def lens_of(trial: Trial) -> Lens:
    assert trial.camera.lens is not None
    return geometry.lens_for(trial.camera.lens, trial.frame.width, trial.frame.height)


@pytest.fixture(scope="module")
def bright() -> Trial:
    return simulate_trial(small(), 3, oracle=True)


def test_the_bound_on_the_file_is_near_the_one_on_the_sensor(bright: Trial) -> None:
    found = delivered(bright.frame, bright.capture.exposure, small().isp, bright.corners, lens_of(bright))
    assert found.explained > 0.98
    score, sensor = genie_score(found.oracle, bright.truth), bound_score(bright)
    assert abs(score.error_free - sensor.error_free) <= 2
    assert captures._bound(found, bright.truth, score) == (score.error_free, found.explained)
    assert score.error_free >= bright.receive(bright.options())[1].error_free
    assert 0.02 < found.light < 0.5


def test_the_bound_falls_with_the_light() -> None:
    trial = simulate_trial(small(0.03), 3, oracle=True)
    found = delivered(trial.frame, trial.capture.exposure, small().isp, trial.corners, lens_of(trial))
    assert genie_score(found.oracle, trial.truth).error_free < 10


def test_a_genie_who_is_told_another_payload_explains_little(bright: Trial) -> None:
    exposure = bright.capture.exposure
    other = replace(exposure, link=replace(exposure.link, seed=exposure.link.seed + 1))
    found = delivered(bright.frame, other, small().isp, bright.corners, lens_of(bright))
    assert found.explained < captures.EXPLAINED
    assert captures._bound(found, bright.truth, Score()) == (None, found.explained)


def test_a_genie_who_decides_worse_than_the_receiver_gives_no_bound(bright: Trial) -> None:
    found = delivered(bright.frame, bright.capture.exposure, small().isp, bright.corners, lens_of(bright))
    assert captures._bound(found, bright.truth, Score(error_free=21))[0] is None


def test_the_start_of_the_clock_is_found(bright: Trial) -> None:
    exposure = replace(bright.capture.exposure, start_slot=0.0)
    starts = START - 5, START + 5
    found = delivered(bright.frame, exposure, small().isp, bright.corners, lens_of(bright), starts)
    assert found.oracle.exposure.start_slot == pytest.approx(START, abs=0.06)


@pytest.fixture(scope="module")
def folder(bright: Trial, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture that the simulator made, with a truth that tells no more than that of another maker."""
    folder = tmp_path_factory.mktemp("captures")
    path = folder / "phone_coffee.jpg"
    path.write_bytes(bright.capture.jpeg)
    told = {
        key: bright.capture.truth[key]
        for key in (
            *("screen", "columns", "slot_rate_hz", "payload_symbols", "repeats", "camera", "w", "payload_bits"),
            *("corners_sensor_px", "frames", "payload"),
        )
    }
    write_truth({**told, "capture": path.name}, path)
    return folder


def test_a_twin_shows_the_same_from_the_same_place(folder: Path, bright: Trial) -> None:
    [reference] = captures.find_captures(folder)
    scene = reference.scene
    assert scene.picture == "coffee"
    assert scene.sensor.line_delay_s == pytest.approx(small().sensor.line_delay_s)
    assert scene.isp.correct_distortion
    np.testing.assert_allclose(np.array(scene.pose.corners), bright.capture.exposure.view.corners)
    low, high = reference.starts
    assert low <= START <= high
    assert high - low == pytest.approx(1.0)


def test_capture_and_twins_stand_side_by_side(folder: Path, tmp_path: Path) -> None:
    arguments = ["captures", str(folder), "--twins", "1", "--out", str(tmp_path), "--quiet"]
    result = CliRunner().invoke(benchmark, arguments)
    assert result.exit_code == 0, result.output
    capture, twins = json.loads((tmp_path / "captures.json").read_text())["rows"]
    assert (capture["what"], twins["what"]) == ("capture", "twins")
    assert capture["picture"] == twins["picture"] == "coffee"
    assert capture["expected"] == twins["expected"] == 20
    assert capture["sensor_bound"] is None
    for row in (capture, twins):
        assert row["explained"] > 0.98
        assert row["share95"][0] <= row["share"] <= row["share95"][1]
    assert abs(capture["delivered_bound"] - twins["delivered_bound"]) < 0.3


def test_a_picture_that_is_not_at_hand_gives_no_bound(folder: Path) -> None:
    [reference] = captures.find_captures(folder)
    unknown = captures.Reference(reference.path)
    vars(unknown)["picture"] = None
    look = captures.look(unknown, None)
    assert look.delivered_bound is None
    assert look.score.expected == 20


def test_a_folder_of_pictures_comes_before_the_simulators_own(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "coffee.png").touch()
    [reference] = captures.find_captures(folder, tmp_path)
    assert reference.picture == str(tmp_path / "coffee.png")


def test_bursts_of_a_capture_are_sent_again_as_they_were(folder: Path) -> None:
    from rxcli.lab.simulate.capture import prepare

    [reference] = captures.find_captures(folder)
    take = prepare(replace(reference.scene, payload=reference.message, start_slot=START), 0)
    for burst, sent in load_truth(folder / "phone_coffee.truth.json").payload.items():
        assert take.link.payload_hex(burst) == list(sent)


def test_a_folder_without_truth_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no capture with its NAME"):
        captures.find_captures(tmp_path)
