"""How lenses bow a screen's sides: the coefficient that they show, and what the receiver makes of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.lab.benchmark.trial import Trial, simulate_trial
from rxcli.lab.simulate.isp import Isp
from rxcli.lab.simulate.optics import Lens, Pose
from rxcli.lab.simulate.scenes import preset
from rxcli.lab.simulate.sensor import Sensor
from rxcli.profiles import CameraProfile, ScreenProfile, dump_profile, load_profile, parse_profile
from rxcli.receiver.pipeline import ReceiverOptions, receive
from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.find import measure_side_curvature
from rxcli.types import FloatArray

WIDTH, HEIGHT = 1280, 960
BLACK_AND_WHITE = {"black": 0.0, "white": 255.0}


def take(k1: float, *, corrected: bool = False, picture: str = "coffee", seed: int = 3) -> Trial:
    """A phone's picture; `k1` is for a focal length of one width."""
    screen = load_profile("paper-17k3", ScreenProfile)
    scene = replace(
        preset("phone-plain", screen),
        sensor=Sensor(
            WIDTH,
            HEIGHT,
            1 / (3.6 * screen.slot_rate_hz),
            "bayer",
            full_scale_e=260.0,
            black_level=64,
            white_level=1023,
        ),
        lens=Lens(0.8, (k1 * 0.8**2, -k1 * 0.8**4, 0.0, 0.0, 0.0)),
        pose=Pose(fill=0.9, roll_deg=-0.8, yaw_deg=3.0, pitch_deg=2.0),
        isp=Isp(tone="srgb", gain=2.0, sharpen=0.4, denoise_px=0.3, correct_distortion=corrected),
        exposure_s=0.6 / screen.slot_rate_hz,
        light_e_per_s=1.4e6 * screen.slot_rate_hz / 16000,
        picture=picture,
    )
    return simulate_trial(scene, seed)


def measured(trial: Trial) -> tuple[float, float]:
    found = measure_side_curvature(trial.frame.pixels, trial.corners, **BLACK_AND_WHITE)
    assert found is not None
    return found


@pytest.mark.parametrize("k1", [-0.25, -0.08, 0.0, 0.12, 0.3])
def test_the_sides_show_what_a_lens_does(k1: float) -> None:
    found, sd = measured(take(k1))
    assert 0.003 < sd < 0.03
    assert found == pytest.approx(k1, abs=3 * sd)


@pytest.mark.parametrize("k1", [-0.2, 0.2])
def test_sides_are_straight_where_the_camera_corrected_them(k1: float) -> None:
    found, sd = measured(take(k1, corrected=True))
    assert abs(found) < 2 * sd


def test_neither_a_turned_nor_a_mirrored_picture_changes_the_bow() -> None:
    trial = take(-0.15)
    pixels, corners = trial.frame.pixels, trial.corners
    last = np.array([WIDTH - 1, HEIGHT - 1])
    turned = measure_side_curvature(np.ascontiguousarray(pixels[::-1, ::-1]), last - corners, **BLACK_AND_WHITE)
    mirrored = measure_side_curvature(
        np.ascontiguousarray(pixels[:, ::-1]), corners * [-1, 1] + [WIDTH - 1, 0], **BLACK_AND_WHITE
    )
    for found in (turned, mirrored, measure_side_curvature(pixels, corners[[2, 3, 0, 1]], **BLACK_AND_WHITE)):
        assert found is not None
        assert found[0] == pytest.approx(-0.15, abs=3 * found[1])


def test_a_mosaic_is_measured_too() -> None:
    trial = take(-0.15)
    found = measure_side_curvature(trial.capture.raw, trial.corners, black=64.0, white=1023.0, mosaic_period=2)
    assert found is not None
    assert found[0] == pytest.approx(-0.15, abs=3 * found[1])


@pytest.mark.parametrize(
    ("pixels", "corners"),
    [
        (np.zeros((HEIGHT, WIDTH), np.uint8), [[100, 100], [1100, 100], [1100, 700], [100, 700]]),
        (np.full((HEIGHT, WIDTH), 90, np.uint8), [[100, 100], [1100, 100], [1100, 700], [100, 700]]),
        (np.full((120, 160), 90, np.uint8), [[-900, -500], [900, -500], [900, 600], [-900, 600]]),
    ],
)
def test_where_no_sides_show_nothing_is_told(pixels: NDArray[Any], corners: list[list[int]]) -> None:
    assert measure_side_curvature(pixels, np.array(corners, float), **BLACK_AND_WHITE) is None


@pytest.mark.parametrize(
    "corners",
    [
        [[0, 0], [0, 0], [0, 0], [0, 0]],
        [[0, 0], [100, 0], [200, 0], [300, 0]],
        [[50, 0], [50, 100], [50, 200], [50, 300]],
        [[100, 100], [1100, 700], [1100, 100], [100, 700]],
        [[-90000, -90000], [90000, -90000], [90000, 90000], [-90000, 90000]],
        [[5000, 5000], [6000, 5000], [6000, 5500], [5000, 5500]],
        [[900, 50], [950, 900], [400, 910], [380, 60]],
        [[10, 10], [12, 10], [12, 11], [10, 11]],
    ],
)
def test_corners_that_are_no_screens_tell_nothing(corners: list[list[int]]) -> None:
    rng = np.random.default_rng(1)
    stripes = np.repeat(rng.integers(0, 256, (HEIGHT, 1)), WIDTH, axis=1).astype(np.uint8)
    assert measure_side_curvature(stripes, np.array(corners, float), **BLACK_AND_WHITE) is None


def test_any_corners_on_any_pixels_end_well() -> None:
    rng = np.random.default_rng(4)
    for turn in range(150):
        width, height = rng.integers(96, 400, 2)
        pixels = rng.integers(0, 256, (height, width if turn % 3 else 1)).astype(np.uint8)
        pixels = np.ascontiguousarray(np.broadcast_to(pixels, (height, width)))
        corners = rng.uniform(-1, 2, (4, 2)) if turn % 2 else np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]])
        found = measure_side_curvature(
            pixels, (corners + rng.normal(0, 0.04, (4, 2))) * [width, height], **BLACK_AND_WHITE
        )
        assert found is None or (np.isfinite(found).all() and found[1] > 0)


def test_noise_has_no_sides() -> None:
    rng = np.random.default_rng(2)
    corners = np.array([[100.0, 100.0], [1100, 110], [1090, 700], [105, 690]])
    for _ in range(5):
        noise = rng.integers(0, 255, (HEIGHT, WIDTH)).astype(np.uint8)
        found = measure_side_curvature(noise, corners, **BLACK_AND_WHITE)
        assert found is None or abs(found[0]) < 3 * found[1]


def _columns_off(corners: FloatArray, profile: CameraProfile | None, trial: Trial) -> float:
    """Largest distance of a column's border from where it is, in columns."""
    true = trial.camera.lens
    assert true is not None
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 21), np.linspace(0, 1, 9)), axis=-1)
    lens = geometry.lens_for(profile.lens, WIDTH, HEIGHT) if profile and profile.lens else None
    there = geometry.screen_to_picture(grid, corners, geometry.lens_for(true, WIDTH, HEIGHT))
    off = geometry.screen_to_picture(grid, corners, lens) - there
    return float(np.abs(off[..., 0]).max()) * 20 / float(np.linalg.norm(corners[1] - corners[0]))


def test_a_picture_with_bowed_sides_is_followed_reported_and_kept() -> None:
    from rxcli.receiver import camera as blind

    trial = take(-0.25)
    options = ReceiverOptions(cameras=(), corners=trial.corners, cae="never")
    result = next(receive([trial.frame], options))
    estimated = result.estimated
    assert estimated["distortion_corrected"][0] == 0
    assert estimated["k1"][0] == pytest.approx(-0.25, abs=3 * estimated["k1"][1])
    assert estimated["rows_per_slot"][0] == pytest.approx(3.6, rel=5e-4)
    profile = blind.camera_profile(estimated, "mine", None, None, WIDTH, HEIGHT)
    again = parse_profile(dump_profile(profile), CameraProfile, "mine")
    assert again.lens is not None
    assert not again.lens.distortion_already_corrected
    assert _columns_off(trial.corners, again, trial) < 0.02 < 0.08 < _columns_off(trial.corners, None, trial)


@pytest.mark.parametrize("mistaken", [False, True])
def test_stripes_are_bent_in_a_corrected_picture(mistaken: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bent stripes are believed, also where something else was taken for bowed sides."""
    trial = take(0.2, corrected=True)
    if mistaken:
        monkeypatch.setattr("rxcli.receiver.unknown_camera._distortion", lambda *_: (-0.1, 0.01))
    options = ReceiverOptions(cameras=(), corners=trial.corners, cae="never")
    estimated = next(receive([trial.frame], options)).estimated
    assert estimated["distortion_corrected"][0] == 1
    assert estimated["rows_per_slot"][0] == pytest.approx(3.6, rel=5e-4)
