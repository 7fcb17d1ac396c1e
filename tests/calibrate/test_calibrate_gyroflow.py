"""Gyroflow's fisheye profiles as OpenCV's pinhole model, against OpenCV's own fisheye; readouts that cannot be."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rxcli.calibrate.gyroflow import load_gyroflow
from rxcli.cli.main import run
from rxcli.errors import ExitCode, InputError, ProfileError
from rxcli.profiles import CameraProfile, load_profile

PROFILE: dict[str, Any] = {
    "camera_brand": "Maker",
    "camera_model": "M 1",
    "lens_model": "15 mm",
    "calib_dimension": {"w": 3840, "h": 2160},
    "frame_readout_time": 14.5,
    "fps": 30.0,
    "input_horizontal_stretch": 1.0,
    "fisheye_params": {
        "camera_matrix": [[2600.0, 0, 1910.0], [0, 2610.0, 1085.0], [0, 0, 1]],
        "distortion_coeffs": [0.3, 0.1, -0.2, 0.1],
    },
}

#: Of a lens that sees more than 70 degrees from the axis.
WIDE = [[900.0, 0, 1910], [0, 900, 1085], [0, 0, 1]]


def written(folder: Path, **changes: Any) -> Path:
    (folder / "lens.json").write_text(json.dumps(PROFILE | changes))
    return folder / "lens.json"


def test_points_fall_where_the_fisheye_has_them(tmp_path: Path) -> None:
    """Rays through OpenCV's fisheye and through the pinhole model, whose rays differ by their scale alone."""
    found = load_gyroflow(written(tmp_path))
    rng = np.random.default_rng(1)
    rays = np.column_stack([rng.uniform(-0.6, 0.6, 500), rng.uniform(-0.35, 0.35, 500), np.ones(500)])
    matrix = np.array(PROFILE["fisheye_params"]["camera_matrix"], np.float64)
    coefficients = np.array(PROFILE["fisheye_params"]["distortion_coeffs"])
    expected = cv2.fisheye.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]
    got = cv2.projectPoints(
        rays, np.zeros(3), np.zeros(3), np.array(found.lens.camera_matrix), np.array(found.lens.dist_coeffs)
    )[0][:, 0]
    inside = np.all((expected > 0) & (expected < (3839, 2159)), axis=1)
    assert inside.sum() > 300
    assert np.abs(got - expected)[inside].max() < found.worst_px + 0.05
    assert found.worst_px < 0.5


def test_other_sizes(tmp_path: Path) -> None:
    half = load_gyroflow(written(tmp_path), (1920, 1080)).lens
    whole = load_gyroflow(written(tmp_path)).lens
    assert half.camera_matrix[0][0] == pytest.approx(whole.camera_matrix[0][0] / 2, rel=1e-3)
    assert half.camera_matrix[0][2] == pytest.approx((1910 + 0.5) / 2 - 0.5)
    cropped = load_gyroflow(written(tmp_path), (3840, 1600)).lens
    assert cropped.camera_matrix[1][2] == pytest.approx(1085 - 280)
    squeezed = load_gyroflow(written(tmp_path, input_horizontal_stretch=1.5)).lens
    assert squeezed.width == 2560
    assert squeezed.camera_matrix[0][0] == pytest.approx(whole.camera_matrix[0][0] / 1.5, rel=1e-2)


@pytest.mark.parametrize(
    ("changes", "readout_s", "upwards", "note"),
    [
        ({}, 0.0145, False, "may be wrong"),
        ({"frame_readout_time": -14.5}, 0.0145, True, "from the bottom to the top"),
        ({"frame_readout_direction": "BottomToTop"}, 0.0145, True, "from the bottom to the top"),
        ({"frame_readout_time": 40.0}, None, False, "impossible at 30 frames/s"),
        ({"frame_readout_time": None}, None, False, "states no readout"),
        ({"global_shutter": True}, None, False, "a global shutter"),
    ],
)
def test_the_readout_is_a_hint(
    changes: dict[str, Any], readout_s: float | None, upwards: bool, note: str, tmp_path: Path
) -> None:
    found = load_gyroflow(written(tmp_path, **changes))
    assert (found.readout_s, found.reversed) == (readout_s, upwards)
    assert note in " ".join(found.notes)


@pytest.mark.parametrize(
    "changes",
    [
        {"fisheye_params": {}},
        {"calib_dimension": {"w": 0, "h": 0}},
        {"fisheye_params": {"camera_matrix": [[0, 0, 0], [0, 0, 0], [0, 0, 1]], "distortion_coeffs": [0, 0, 0, 0]}},
        {"fisheye_params": {**PROFILE["fisheye_params"], "distortion_coeffs": [-3.0, 0, 0, 0]}},
        {"fisheye_params": {"camera_matrix": WIDE, "distortion_coeffs": [0] * 4}},
    ],
)
def test_what_is_no_lens_for_screens_is_refused(changes: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(ProfileError):
        load_gyroflow(written(tmp_path, **changes))
    (tmp_path / "none.json").write_text("[")
    with pytest.raises(InputError, match="it is no JSON"):
        load_gyroflow(tmp_path / "none.json")


def test_the_lens_is_written_and_a_wrong_hint_is_told_by_a_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The sample's readout is 12.7 ms; a profile says 9, which is not written."""
    sample = Path(__file__).resolve().parents[2] / "sample_frames" / "video1080_chelsea_17k3.mp4"
    arguments = ["calibrate", "gyroflow", str(written(tmp_path, frame_readout_time=9.0))]
    arguments += ["--size", "1920x1080", "--save", str(tmp_path / "cam.toml")]
    assert run(arguments) == 0
    profile = load_profile(str(tmp_path / "cam.toml"), CameraProfile)
    assert (profile.make, profile.models, profile.modes) == ("Maker", ("M 1",), ())
    assert profile.lens is not None
    assert run([*arguments, "--photo", str(sample)]) == ExitCode.USAGE
    assert run([*arguments, "--photo", str(sample), "--screen", "paper-17k3"]) == 0
    assert "% below the picture's (12.7" in capsys.readouterr().out
    [mode] = load_profile(str(tmp_path / "cam.toml"), CameraProfile).modes
    assert mode.line_delay_s * 1080 == pytest.approx(12.74e-3, rel=2e-3)


@pytest.mark.parametrize("name", ["fujifilm_x-s10_xc15-45_c4k.json", "samsung_s25_ultra_4k.json"])
def test_real_profiles(name: str, shared_real: Path) -> None:
    found = load_gyroflow(shared_real / "gyroflow" / name)
    assert found.model in ("X-S10", "S25 Ultra")
    assert found.worst_px < 4.0  # in the far corners; 0.7 and 3.7 px when written
    print(f"{name}: within {found.worst_px:.2f} px; {found.readout_s}")
