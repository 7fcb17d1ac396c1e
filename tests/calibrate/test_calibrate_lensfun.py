"""Lensfun's polynomials as OpenCV coefficients, against the polynomials themselves and against the database."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from rxcli.calibrate.fitting import fit_distortion
from rxcli.calibrate.lensfun import lens_from_database
from rxcli.cli.main import run
from rxcli.errors import ExitCode, ProfileError, UsageError
from rxcli.profiles import CameraProfile, LensModel, load_profile
from rxcli.types import Metadata

WIDTH, HEIGHT = 6240, 4160
XF18 = Metadata(make="FUJIFILM", model="X-S10", lens="XF18-55mmF2.8-4 R LM OIS", focal_length_mm=18.0)


#: Distorted radius of an ideal one, in half short sides.
POLYNOMIALS: dict[str, Any] = {
    "ptlens": lambda r, a, b, c: r * (a * r**3 + b * r**2 + c * r + 1 - a - b - c),
    "poly3": lambda r, k1: r * (1 - k1 + k1 * r**2),
    "poly5": lambda r, k1, k2: r * (1 + k1 * r**2 + k2 * r**4),
}
CENTRE = np.array([WIDTH - 1, HEIGHT - 1]) / 2


def field(seed: int) -> Any:
    return np.random.default_rng(seed).uniform([0, 0], [WIDTH - 1, HEIGHT - 1], (600, 2))


def distorted(points: Any, model: str, *terms: float) -> Any:
    offset = (points - CENTRE) / (HEIGHT / 2)
    r = np.linalg.norm(offset, axis=1, keepdims=True)
    return CENTRE + offset * POLYNOMIALS[model](r, *terms) / r * (HEIGHT / 2)


def by_opencv(lens: LensModel, points: Any, focal_px: float) -> Any:
    """OpenCV's distorted points of undistorted ones, which have the nominal focal length."""
    rays = np.column_stack([(points - np.array(lens.camera_matrix)[:2, 2]) / focal_px, np.ones(len(points))])
    matrix, coefficients = np.array(lens.camera_matrix), np.array(lens.dist_coeffs)
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, coefficients)[0].reshape(-1, 2)


@pytest.mark.parametrize(
    ("model", "terms", "tolerance_px"),
    [
        ("poly3", (-0.02,), 0.01),
        ("poly5", (-0.05, 0.01), 0.01),
        ("ptlens", (0.01, -0.03, 0.005), 1.0),
        ("ptlens", (0.02808, -0.10604, 0.07041), 4.5),
    ],
)
def test_each_polynomial_becomes_opencv_coefficients(model: Any, terms: Any, tolerance_px: float) -> None:
    known = field(1)
    rays, points = ((part - CENTRE) / 4800 for part in (known, distorted(known, model, *terms)))
    lens, worst = fit_distortion(rays, points, 4800.0, CENTRE, (WIDTH, HEIGHT))
    other = field(2)
    error = np.linalg.norm(by_opencv(lens, other, 4800.0) - distorted(other, model, *terms), axis=1)
    assert worst <= tolerance_px
    assert error.max() <= 1.5 * tolerance_px


def test_the_database_by_exif() -> None:
    pytest.importorskip("lensfunpy")
    found = lens_from_database(XF18, WIDTH, HEIGHT)
    assert found.lens_name == "XF18-55mmF2.8-4 R LM OIS"
    assert found.lens.dist_coeffs[0] < -0.05  # barrel distortion at the wide end
    assert found.lens.camera_matrix[0][0] == pytest.approx(18 / 23.5 * WIDTH, rel=0.05)
    assert found.worst_px < 5


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"focal_length_mm": None}, "focal length"),
        ({"make": "Nobody", "model": "Zorki 99"}, "Zorki 99"),
        ({"lens": "Triplet 5000"}, "Triplet 5000"),
        ({"lens": None}, "--lens"),
    ],
)
def test_what_the_database_does_not_know_is_said(changes: dict[str, Any], message: str) -> None:
    pytest.importorskip("lensfunpy")
    with pytest.raises((UsageError, ProfileError), match=message) as raised:
        lens_from_database(replace(XF18, **changes), WIDTH, HEIGHT)
    assert raised.value.hint


def test_without_the_extra_the_next_step_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "lensfunpy", None)
    with pytest.raises(UsageError, match="pip install"):
        lens_from_database(XF18, WIDTH, HEIGHT)


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("lensfunpy")
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "FUJIFILM", "X-S10"
    path, profile = tmp_path / "a.jpg", tmp_path / "lens.toml"
    Image.new("L", (624, 416), 90).save(path, exif=exif)
    assert run(["calibrate", "lensfun", str(path)]) == ExitCode.USAGE
    assert "focal length" in capsys.readouterr().err
    extra = ["--lens", str(XF18.lens), "--focal-length", "18", "--save", str(profile)]
    assert run(["calibrate", "lensfun", str(path), *extra]) == 0
    assert "Fujifilm X-S10" in capsys.readouterr().out
    saved = load_profile(str(profile), CameraProfile)
    assert saved.lens.width == 624
    assert saved.lens_models == (XF18.lens,)
    assert saved.models == ("X-S10",)
