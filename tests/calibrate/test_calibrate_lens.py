"""Lens models from boards: known lenses are found again, bad pictures are named, what is missing is said."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rxcli.calibrate.lens import Board, LensCalibration, Sighting, calibrate_lens, find_board, find_boards
from rxcli.cli.main import run
from rxcli.errors import ReceiverError, UsageError
from rxcli.profiles import CameraProfile, LensModel, load_profile
from rxcli.results.undistort import grey_levels
from rxcli.types import Frame, Mosaic

SIZE = (640, 480)
MATRIX = np.array([[560.0, 0, 330.0], [0, 565.0, 235.0], [0, 0, 1]])
DISTORTION = np.array([-0.2, 0.05, 0.001, -0.0005, 0.0])
BOARD = Board(8, 6, 20.0)


def poses(n: int, seed: int = 0) -> list[tuple[Any, Any]]:
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(n):
        turn = rng.uniform([-0.5, -0.5, -0.3], [0.5, 0.5, 0.3])
        middle = np.array([rng.uniform(-40, 40), rng.uniform(-25, 25), rng.uniform(330, 430)])
        rotation, _ = cv2.Rodrigues(turn)
        found.append((turn, middle - rotation @ np.array([70.0, 50.0, 0.0])))
    return found


def photographed(texture: Any, pixels_per_mm: float, origin_mm: tuple[float, float], pose: Any) -> Any:
    """The flat `texture` seen by the lens: each pixel's ray is met with the board's plane."""
    x, y = np.meshgrid(np.arange(SIZE[0], dtype=np.float32), np.arange(SIZE[1], dtype=np.float32))
    rays = cv2.undistortPoints(np.stack([x, y], -1).reshape(-1, 1, 2), MATRIX, DISTORTION).reshape(-1, 2)
    rays = np.column_stack([rays, np.ones(len(rays))])
    rotation, _ = cv2.Rodrigues(pose[0])
    depth = (rotation[:, 2] @ pose[1]) / (rays @ rotation[:, 2])
    board_mm = (rays * depth[:, None] - pose[1]) @ rotation
    at = ((board_mm[:, :2] - np.array(origin_mm)) * pixels_per_mm - 0.5).astype(np.float32).reshape(SIZE[1], SIZE[0], 2)
    texture = cv2.GaussianBlur(texture, (0, 0), 2)  # about a pixel of the picture, so that nothing aliases
    seen = cv2.remap(texture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=200)
    return cv2.GaussianBlur(seen, (0, 0), 0.5)


def chessboard() -> tuple[Any, float, tuple[float, float]]:
    """Texture, its pixels per millimetre, and the board's coordinates of its corner."""
    squares = np.indices((BOARD.rows + 1, BOARD.columns + 1)).sum(axis=0) % 2
    texture = np.kron(np.where(squares, 230, 20), np.ones((80, 80))).astype(np.uint8)
    return cv2.copyMakeBorder(texture, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=230), 4.0, (-30.0, -30.0)


def pictures(n: int, seed: int = 0) -> list[tuple[str, Any]]:
    texture = chessboard()
    return [(f"p{i}.png", photographed(*texture, pose)) for i, pose in enumerate(poses(n, seed))]


@pytest.fixture(scope="module")
def boards() -> list[tuple[str, Any]]:
    return pictures(9)


def test_a_known_lens_is_found_again(boards: list[tuple[str, Any]]) -> None:
    results, width, height = find_boards(boards, BOARD)
    found = calibrate_lens(results, width, height)
    assert (width, height) == SIZE
    assert found.rms_px < 0.1
    assert len(found.accepted) >= 8
    matrix = np.array(found.model.camera_matrix)
    np.testing.assert_allclose(matrix[[0, 1], [0, 1]], [560, 565], rtol=5e-3)
    np.testing.assert_allclose(matrix[:2, 2], [330, 235], atol=2)
    grid = np.stack(np.meshgrid(np.linspace(60, 580, 9), np.linspace(60, 420, 7)), -1).reshape(-1, 1, 2)
    true_rays = cv2.undistortPoints(grid, MATRIX, DISTORTION)
    rays = cv2.undistortPoints(grid, matrix, np.array(found.model.dist_coeffs))
    assert np.abs(rays - true_rays).max() * 560 < 2.0
    np.testing.assert_allclose(np.sqrt(np.mean(np.sum(found.residuals**2, axis=1))), found.rms_px, rtol=1e-3)


def test_bad_pictures_are_named_with_the_reason(boards: list[tuple[str, Any]]) -> None:
    _, first = boards[0]
    reasons = {
        "blurred.png": (cv2.GaussianBlur(first, (0, 0), 3.5), "too blurred"),
        "empty.png": (np.full_like(first, 90), "found"),
        "small.png": (first[:400], "640x400"),
        "again.png": (boards[-1][1], "same view"),
    }
    results = find_boards([*boards, *((name, picture) for name, (picture, _) in reasons.items())], BOARD)
    rejected = {r.name: r.reason for r in calibrate_lens(*results).rejected}
    assert all(reason in rejected[name] for name, (_, reason) in reasons.items())
    assert boards[0][0] not in rejected


def test_an_outlier_is_dropped(boards: list[tuple[str, Any]]) -> None:
    results, width, height = find_boards(boards, BOARD)
    spoilt = next(r for r in results if isinstance(r, Sighting))
    rng = np.random.default_rng(3)
    moved = spoilt.corners + rng.normal(0, 3, spoilt.corners.shape).astype(np.float32)
    bent = Sighting("bent.png", spoilt.points, moved)
    found = calibrate_lens([bent if r is spoilt else r for r in results], width, height)
    assert any(r.name == "bent.png" and "outlier" in r.reason for r in found.rejected)
    assert found.rms_px < 0.1


def test_charuco(tmp_path: Path) -> None:
    board = Board(7, 5, 20.0, "DICT_5X5_100")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    texture = cv2.aruco.CharucoBoard((8, 6), 20.0, 15.0, dictionary).generateImage((640, 480))
    views = [(f"c{i}", photographed(texture, 4.0, (0.0, 0.0), pose)) for i, pose in enumerate(poses(8, 1))]
    views[0][1][:, :200] = 200  # a part of the board is enough
    found = calibrate_lens(*find_boards(views, board))
    assert found.rms_px < 0.3
    assert found.model.camera_matrix[0][0] == pytest.approx(560, rel=0.01)
    with pytest.raises(UsageError, match="DICT_NONE"):
        find_board(views[0][1], Board(7, 5, 20.0, "DICT_NONE"), "x")


def test_large_pictures_are_refined_at_full_size(boards: list[tuple[str, Any]]) -> None:
    large = [(name, cv2.resize(p, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)) for name, p in boards[:4]]
    found = calibrate_lens(*find_boards(large, BOARD))
    assert found.model.width == 2560
    assert found.rms_px / 4 < 0.1


def test_too_few_boards(boards: list[tuple[str, Any]]) -> None:
    blank = ("blank.png", np.zeros((480, 640), np.uint8))
    results, width, height = find_boards([*boards[:2], blank], BOARD)
    with pytest.raises(ReceiverError, match=r"2 usable boards.*blank\.png"):
        calibrate_lens(results, width, height)
    with pytest.raises(ReceiverError, match="no pictures"):
        find_boards([], BOARD)


def test_uncovered_parts_are_named() -> None:
    y, x = np.mgrid[2:480:20, 2:640:20]
    everywhere = np.column_stack([x.ravel(), y.ravel()]).astype(float)
    rows = tuple(map(tuple, MATRIX.tolist()))
    model = LensModel(width=640, height=480, camera_matrix=rows, dist_coeffs=tuple(DISTORTION.tolist()))
    inside = everywhere[(everywhere[:, 0] > 130) | (everywhere[:, 1] > 96)]
    for corners, named in ((everywhere, ()), (inside, ("top left",))):
        assert LensCalibration(model, 0.1, {}, (), corners, corners, ()).uncovered == named


def test_grey_of_a_mosaic_balances_colours() -> None:
    pattern = np.array([[0, 1], [1, 2]], np.uint8)
    level = np.array([500, 1000, 750])[np.tile(pattern, (10, 12))]
    frame = Frame((level + 100).astype(np.uint16), "x", mosaic=Mosaic(pattern, (2.0, 1.0, 4 / 3), (100.0,) * 3, 4000.0))
    assert np.ptp(grey_levels(frame).astype(int)) <= 1
    deep = Frame(np.array([[0, 32768, 65535]], np.uint16), "x", white=65535.0)
    assert grey_levels(deep).tolist() == [[0, 128, 255]]


def test_command(boards: list[tuple[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "boards"
    folder.mkdir()
    for name, picture in boards[:5]:
        cv2.imwrite(str(folder / name), picture)
    (folder / "cut.jpg").write_bytes(b"\xff\xd8\xff\xe0 no picture")
    (folder / "notes.txt").write_text("not a picture")
    profile = tmp_path / "new" / "mylens.toml"
    arguments = ["calibrate", "lens", str(folder), "--board", "8x6", "--save", str(profile)]
    assert run([*arguments, "--json", "-", "--picture", str(tmp_path / "r.png")]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["rms_px"] < 0.1
    assert len(record["accepted"]) == 5
    assert [Path(r["name"]).name for r in record["rejected"]] == ["cut.jpg"]
    saved = load_profile(str(profile), CameraProfile)
    assert [list(row) for row in saved.lens.camera_matrix] == record["camera_matrix"]
    assert saved.name == "mylens"
    drawn = cv2.imread(str(tmp_path / "r.png"))
    assert drawn.shape == (1020, 1280, 3)
    assert 0 < (np.ptp(drawn[:960].astype(int), axis=2) > 40).mean() < 0.2
    assert run(arguments) == 0
    assert "RMS" in capsys.readouterr().out


def test_opencv_set(shared_real: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["calibrate", "lens", str(shared_real / "lens"), "--board", "9x6", "--json", "-"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["rms_px"] <= 0.22
    assert record["camera_matrix"][0][0] == pytest.approx(533, rel=0.01)
    assert record["dist_coeffs"][0] == pytest.approx(-0.28, abs=0.03)
    assert len(record["accepted"]) == 13
