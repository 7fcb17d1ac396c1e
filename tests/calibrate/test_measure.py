"""Lights that blink, measured: frequency, lit share, depth, waveform; what is refused, and what stays open."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_lamps import Lamp, LampScene, draw_lamps
from PIL import Image

from rxcli.calibrate.frames import frame_light
from rxcli.calibrate.measure import Timing, measure_lamp
from rxcli.calibrate.periodic import fit_fundamental
from rxcli.calibrate.shutter import bands_across, calibrate_shutter, find_stripes
from rxcli.cli.main import run
from rxcli.errors import ExitCode, ReceiverError
from rxcli.types import Frame

LINE_DELAY_S, EXPOSURE_S = 2e-5, 1 / 8000


def scene(*lamps: Lamp, shape: tuple[int, int] = (720, 640), **more: Any) -> LampScene:
    return LampScene("test", shape, LINE_DELAY_S, EXPOSURE_S, lamps, **more)


def light_of(drawn: LampScene, seed: int = 1) -> Any:
    return frame_light(Frame(drawn.render(np.random.default_rng(seed)), "x"))


def measured(drawn: LampScene, seed: int = 1) -> tuple[str, list[Any]]:
    axis, found = find_stripes(light_of(drawn, seed))
    return axis, [measure_lamp(stripes, Timing(LINE_DELAY_S, 0.0, "x"), EXPOSURE_S) for stripes in found]


@pytest.mark.parametrize(("duty", "depth"), [(0.05, 1.0), (0.3, 0.6), (0.5, 1.0), (0.9, 1.0)])
@pytest.mark.parametrize("axis", ["rows", "columns"])
def test_a_switched_lamp_is_measured(duty: float, depth: float, axis: str) -> None:
    along, [lamp] = measured(scene(Lamp(1230, duty, depth), axis=axis, ambient=0.0))
    assert along == axis
    assert lamp.frequency_hz == pytest.approx(1230, rel=1e-3)
    assert lamp.duty == pytest.approx(duty, abs=0.015)
    assert lamp.duty_interval[0] <= duty <= lamp.duty_interval[1]
    assert lamp.depth == pytest.approx(depth, abs=0.05)
    assert lamp.is_switched
    assert lamp.waveform.max() > 1 > lamp.waveform.min()


def test_a_sine_is_no_switched_lamp() -> None:
    _, [lamp] = measured(scene(Lamp(1230, None, 0.5), ambient=0.0))
    assert not lamp.is_switched
    assert lamp.duty == pytest.approx(0.5, abs=0.04)
    assert lamp.depth == pytest.approx(0.5, abs=0.05)


def test_what_two_harmonics_leave_open_is_not_claimed() -> None:
    """Of a period of a few rows the lit share is not seen, the frequency is."""
    _, [lamp] = measured(scene(Lamp(1 / (3.7 * LINE_DELAY_S), 0.3)))
    assert lamp.frequency_hz == pytest.approx(1 / (3.7 * LINE_DELAY_S), rel=1e-3)
    assert lamp.duty is None or lamp.duty_interval[0] <= 0.3 <= lamp.duty_interval[1]


def test_lamps_out_of_focus_whose_stripes_run_down_are_found_with_the_axis_left_open() -> None:
    """Regions of a few lines have fewer values than a rich model has parameters."""
    disks = [(0.2, 0.3), (0.5, 0.7), (0.8, 0.35)]
    lamps = [Lamp(hz, 0.5, 1.0, (x, y, 0.13)) for hz, (x, y) in zip((1000, 1500, 2000), disks, strict=True)]
    picture = light_of(scene(*lamps, shape=(900, 1200), axis="columns"))
    result = calibrate_shutter([picture], [1000, 1500, 2000])
    assert result.axis == "columns"
    assert result.line_delay_s == pytest.approx(LINE_DELAY_S, rel=2e-3)
    assert {lamp.frequency_hz for lamp in result.lamps} >= {1000, 1500, 2000}


def test_the_courses_of_a_wall_are_no_lamp() -> None:
    """Stripes of a few columns of the picture beside others of other places."""
    rng = np.random.default_rng(4)
    wall = np.full((512, 512), 0.5)
    for left in range(0, 512, 24):
        rows = np.arange(512) + rng.integers(0, 36)
        wall[:, left : left + 24] -= 0.3 * (rows % 36 < 5)[:, None]
    assert not find_stripes(wall + 0.02 * rng.standard_normal(wall.shape), "rows")[1]


def test_a_profile_of_few_values_is_no_error() -> None:
    rng = np.random.default_rng(3)
    for n in (24, 25, 30, 41):
        for frequency in (0.1, 0.2, 0.4):
            wave = 1 + np.sin(2 * np.pi * frequency * np.arange(n)) + 0.1 * rng.standard_normal(n)
            fit = fit_fundamental(wave, frequency)
            assert fit is None or fit.frequency > 0


def test_few_stripes_in_a_spot_are_found() -> None:
    """Dark stripes as long as the lamp's parts do not cut it into pieces."""
    drawn = scene(Lamp(450, 0.4, 1.0, (0.5, 0.5, 0.35)), shape=(900, 1200))
    _, [lamp] = measured(drawn)
    assert 2 < lamp.periods < 6
    assert lamp.frequency_hz == pytest.approx(450, rel=5e-3)


def test_too_few_stripes_are_a_reason_of_their_own() -> None:
    slow = light_of(scene(Lamp(80, 0.5, phase=0.6)))
    assert bands_across(slow, "rows") in (1, 2)
    with pytest.raises(ReceiverError, match="too few stripes") as caught:
        calibrate_shutter([slow], [80])
    assert "Hz or more" in str(caught.value)
    assert bands_across(np.full((200, 200), 0.5), "rows") == 0


@pytest.mark.parametrize(("exposure_rows", "blur_rows"), [(1.5, 0.7), (2, 0.9), (4, 1.2)])
def test_the_blur_of_the_picture_is_in_the_interval_of_the_exposure(exposure_rows: float, blur_rows: float) -> None:
    drawn = replace(scene(Lamp(800, 0.5)), exposure_s=exposure_rows * LINE_DELAY_S, blur_rows=blur_rows)
    result = calibrate_shutter([light_of(drawn)], [800], "rows", tone_known=False)
    low, high = result.exposure.interval_s or (0.0, 1.0)
    assert low <= drawn.exposure_s <= high


def test_the_drawing_is_repeatable() -> None:
    pictures = [draw_lamps(rng).render(rng) for rng in (np.random.default_rng(9), np.random.default_rng(9))]
    np.testing.assert_array_equal(*pictures)


@pytest.fixture
def lamp_file(tmp_path: Path) -> str:
    drawn = scene(Lamp(1000, 0.3, 1.0, (0.25, 0.5, 0.3)), Lamp(2400, 0.6, 1.0, (0.75, 0.5, 0.3)), shape=(720, 960))
    Image.fromarray(drawn.render(np.random.default_rng(5))).save(tmp_path / "lamps.png")
    return str(tmp_path / "lamps.png")


def test_command(lamp_file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "drawn.png"
    arguments = ["measure", lamp_file, "--exposure", "1/8000"]
    assert run([*arguments, "--readout", str(720 * LINE_DELAY_S), "--json", "-", "--picture", str(picture)]) == 0
    record = json.loads(capsys.readouterr().out)
    by_hz = sorted(record["lamps"], key=lambda lamp: lamp["frequency_hz"])
    assert [lamp["frequency_hz"] for lamp in by_hz] == pytest.approx([1000, 2400], rel=2e-3)
    assert [lamp["duty"] for lamp in by_hz] == pytest.approx([0.3, 0.6], abs=0.02)
    assert by_hz[0]["no_stripes_exposures_s"][:2] == pytest.approx([1e-3, 2e-3], rel=2e-3)
    assert record["line_delay_s"] == pytest.approx(LINE_DELAY_S)
    with Image.open(picture) as drawn:
        assert drawn.width == 1280
    assert run(arguments) == 0
    shown = capsys.readouterr()
    assert "x lamp 1" in shown.out
    assert "ratios" in shown.err


@pytest.mark.parametrize(
    ("extra", "word"),
    [
        (["--readout", "1e-2", "--line-delay", "1e-5"], "--readout"),
        (["--readout", "-1"], "--readout"),
        (["--camera", "absent"], "absent"),
        (["--camera", "xs10"], "readout mode"),
    ],
)
def test_wrong_usage_is_one_line(
    lamp_file: str, extra: list[str], word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["measure", lamp_file, *extra]) == ExitCode.USAGE
    err = capsys.readouterr().err
    assert word in err
    assert len(err.strip().splitlines()) == 1


def test_pictures_without_stripes_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Image.new("L", (200, 200), 99).save(tmp_path / "dull.png")
    assert run(["measure", str(tmp_path / "dull.png")]) == ExitCode.NOT_RECEIVED
    assert "no stripes" in capsys.readouterr().err
    slow = scene(Lamp(80, 0.5, phase=0.6)).render(np.random.default_rng(1))
    Image.fromarray(slow).save(tmp_path / "slow.png")
    assert run(["measure", str(tmp_path / "slow.png")]) == ExitCode.NOT_RECEIVED
    assert "too few stripes" in capsys.readouterr().err


@pytest.mark.parametrize("axis", ["rows", "columns"])
def test_stripes_that_lean_may_be_texture(tmp_path: Path, axis: str, capsys: pytest.CaptureFixture[str]) -> None:
    y, x = np.mgrid[:480, :640]
    blinds = 40 + 120 * ((y + 0.004 * x) % 24 < 9) + np.random.default_rng(2).normal(0, 2, y.shape)
    stored = blinds if axis == "rows" else blinds.T
    Image.fromarray(stored.round().clip(0, 255).astype(np.uint8)).save(tmp_path / "blinds.png")
    assert run(["measure", str(tmp_path / "blinds.png")]) == ExitCode.NOT_RECEIVED
    assert "may be texture" in capsys.readouterr().err
    straight = light_of(scene(Lamp(1 / (24 * LINE_DELAY_S), 0.4), shape=(480, 640)))
    assert all(stripes.is_lamp for stripes in find_stripes(straight)[1])


def test_the_readout_is_exported(lamp_file: str, tmp_path: Path) -> None:
    export = tmp_path / "readout.json"
    arguments = ["calibrate", "shutter", lamp_file, "--frequency", "1000", "--frequency", "2400"]
    assert run([*arguments, "--export", str(export), "--mode", "still"]) == 0
    record = json.loads(export.read_text())
    assert record["readout_s"] == pytest.approx(720 * LINE_DELAY_S, rel=2e-3)
    low, high = record["line_delay_interval95_s"]
    assert low < record["line_delay_s"] < high
    assert (record["lines"], record["mode"], record["axis"]) == (720, "still", "rows")
    assert run([*arguments, "--export", str(export)]) == 0  # an earlier one is replaced
    export.write_text("mine")
    assert run([*arguments, "--export", str(export)]) == ExitCode.USAGE
