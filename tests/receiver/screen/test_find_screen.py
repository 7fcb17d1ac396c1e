"""Finding the screen: synthetic stripes with known corners, pictures without a screen, and the reference captures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.receiver.screen.find import ScreenSearch, find_screen, track_screen
from rxcli.receiver.screen.pose import Places, Rectangle, fit_pose, misfit, pose_of
from rxcli.receiver.screen.sides import across, straight

WIDTH, HEIGHT = 1920, 1200


def quad(
    fill: float = 0.8, roll_deg: float = 0.0, keystone: float = 0.0, shift: tuple[float, float] = (0, 0)
) -> NDArray[np.float64]:
    """Corners of a 16:9 screen that fills a share of the width; `keystone` makes the right side higher."""
    x = np.array([-0.5, 0.5, 0.5, -0.5]) * fill * WIDTH
    y = np.array([-0.5, -0.5, 0.5, 0.5]) * fill * WIDTH * 9 / 16 * (1 + keystone * np.array([-1, 1, 1, -1]))
    angle = np.deg2rad(roll_deg)
    turned = np.stack([x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)], axis=1)
    return turned + np.array([WIDTH / 2 + shift[0], HEIGHT / 2 + shift[1]])


def draw(
    corners: NDArray[np.float64],
    seed: int = 0,
    *,
    rows_per_slot: int = 5,
    transmittance: NDArray[np.float32] | None = None,
    wall: float = 0.02,
    noise: float = 0.01,
    lit: float = 0.5,
) -> NDArray[np.float32]:
    """Light of a picture: 20 columns of random slots inside the corners, a dark bezel, a wall, noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    to_screen = cv2.getPerspectiveTransform(corners.astype(np.float32), square)
    u, v = np.moveaxis(cv2.perspectiveTransform(np.stack([x, y], axis=-1), to_screen), -1, 0)
    slots = (rng.random((HEIGHT // rows_per_slot + 2, 20)) < lit).astype(np.float32)
    spread = cv2.GaussianBlur(slots, (5, 1), 0.5)[(np.arange(HEIGHT) + rng.integers(rows_per_slot)) // rows_per_slot]
    light = np.take_along_axis(spread, np.clip(u * 20, 0, 19).astype(np.int64), axis=1)
    if transmittance is not None:
        light = light * cv2.remap(
            transmittance, u * (transmittance.shape[1] - 1), v * (transmittance.shape[0] - 1), cv2.INTER_LINEAR
        )
    beyond = np.maximum(np.abs(u - 0.5), np.abs(v - 0.5)) - 0.5
    picture = np.where(beyond < 0, light + 0.02, np.where(beyond < 0.06, 0.03, wall))
    picture = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 0.8)
    return np.maximum(picture + rng.normal(0, noise, picture.shape).astype(np.float32), 0)


def luma(light: NDArray[np.float32]) -> NDArray[np.uint8]:
    return (np.clip(light, 0, 1) ** 0.45 * 255).astype(np.uint8)


def search(pixels: NDArray[Any], **options: Any) -> ScreenSearch:
    return find_screen(pixels, black=options.pop("black", 0.0), white=options.pop("white", 255.0), **options)


def error(found: ScreenSearch, truth: NDArray[np.float64]) -> float:
    """Largest distance of a corner, in screen widths; the start of the order is checked by its own test."""
    assert found.corners is not None, found.reason
    distances = [np.linalg.norm(np.roll(found.corners, turn, axis=0) - truth, axis=1).max() for turn in range(4)]
    return float(min(distances) / np.linalg.norm(truth[1] - truth[0]))


@pytest.mark.parametrize(
    ("case", "options"),
    [
        (quad(), {}),
        (quad(0.45, shift=(300, 120)), {}),
        (quad(0.8, roll_deg=5), {}),
        (quad(0.8, roll_deg=-7, keystone=0.04), {}),
        (quad(0.85, roll_deg=1, keystone=-0.05), {"rows_per_slot": 9}),
        (quad(0.8, roll_deg=1.5), {"wall": 0.8}),
        (quad(0.8, roll_deg=-2), {"rows_per_slot": 3, "lit": 0.2}),
        (quad(0.8, roll_deg=2), {"lit": 0.8, "noise": 0.03}),
    ],
)
def test_corners_within_three_thousandths_of_the_width(case: NDArray[np.float64], options: dict[str, Any]) -> None:
    assert error(search(luma(draw(case, 3, **options))), case) < 0.003


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("roll_deg", [-3.0, 0.0, 2.0])
def test_full_resolution_places_corners_to_a_pixel(roll_deg: float, seed: int) -> None:
    case = quad(0.8, roll_deg=roll_deg)
    assert error(search(luma(draw(case, seed))), case) < 1.5 / (0.8 * WIDTH)


def test_slots_that_are_dark_in_all_columns_do_not_pull_the_bottom_in() -> None:
    """The last slots before the lower edge are dark: stripes end along a row, the screen does not."""
    case = quad(0.8, roll_deg=3)
    light = draw(case, 4)
    end = int(case[2:, 1].min()) - 12
    light[end:] = np.minimum(light[end:], 0.03)
    assert error(search(luma(light)), case) < 0.015


def _turned_screen() -> tuple[Rectangle, NDArray[np.float64]]:
    rectangle = Rectangle(WIDTH, HEIGHT, 16 / 9)
    return rectangle, np.array([0.1, -0.12, 0.05, 0.02, -0.01, np.log(0.8), np.log(1.3), 0.0])


def test_pose_of_corners_has_these_corners() -> None:
    rectangle, pose = _turned_screen()
    corners = rectangle.project(pose)
    assert np.abs(rectangle.project(pose_of(corners, rectangle)) - corners).max() < 2.0


def test_three_sides_tell_where_the_fourth_is_and_contradict_a_wrong_one() -> None:
    rectangle, pose = _turned_screen()
    corners = rectangle.project(pose)
    places: list[Places | None] = []
    for side in range(4):
        ends = np.sort(corners[[side, (side + 1) % 4], 0 if across(side) else 1])
        t = np.linspace(*ends, 12)
        places.append(Places(t, straight(corners, side).at(t), 1.5))
    start = pose_of(corners + 15.0, rectangle)
    found = fit_pose([*places[:3], None], corners, 300.0, start, rectangle, 12)
    assert np.abs(rectangle.project(found) - corners).max() < 0.01 * WIDTH
    assert places[3] is not None
    wrong: list[Places | None] = [*places[:3], Places(places[3].t, places[3].place + 0.05 * WIDTH, 1.5)]
    costs = [misfit(p, fit_pose(p, corners, 300.0, start, rectangle, 12), rectangle) for p in (places, wrong)]
    assert costs[1] > costs[0] + 20


def test_order_is_clockwise_from_the_top_left_of_the_stored_picture() -> None:
    case = quad(0.7, roll_deg=3)
    found = search(luma(draw(case)))
    assert found.corners is not None
    assert np.abs(found.corners - case).max() < 0.003 * 0.7 * WIDTH


def test_black_picture_areas_at_the_edges_do_not_pull_the_sides_in() -> None:
    picture = np.full((90, 160), 0.8, np.float32)
    picture[:50, :40] = 0
    picture[70:, 110:] = 0
    case = quad(0.85, roll_deg=2)
    assert error(search(luma(draw(case, 1, transmittance=picture))), case) < 0.003


def test_side_outside_the_picture_is_inferred() -> None:
    case = quad(0.9, roll_deg=1, shift=(140, 0))
    assert case[:, 0].max() > WIDTH + 20
    found = search(luma(draw(case)))
    assert found.inferred == ("right",)
    assert error(found, case) < 0.015


def test_black_wedges_of_a_lens_correction_are_no_side() -> None:
    case = quad(0.94, roll_deg=0.5)
    pixels = luma(draw(case, wall=0.05))
    wedge = (18 + 12 * np.cos(np.linspace(0, 2 * np.pi, HEIGHT))).astype(int)
    pixels[np.arange(WIDTH) < wedge[:, None]] = 0
    assert error(search(pixels), case) < 0.003


@pytest.mark.parametrize("period", [1, 2, 6])
def test_linear_mosaic_with_black_level(period: int) -> None:
    case = quad(0.8, roll_deg=1)
    gains = np.random.default_rng(5).uniform(0.4, 1.0, (period, period))
    mosaic = np.tile(gains, (HEIGHT // period, WIDTH // period)) * draw(case, rows_per_slot=10)
    raw = (np.clip(mosaic, 0, 1) * 15000 + 1022).astype(np.uint16)
    found = search(raw, black=1022.0, white=16383.0, mosaic_period=period)
    assert error(found, case) < 0.003


def test_limited_range_luma() -> None:
    case = quad(0.8)
    pixels = (16 + luma(draw(case)) * (219 / 255)).astype(np.uint8)
    assert error(search(pixels, black=16.0, white=235.0), case) < 0.003


def test_upright_screen_gets_its_own_reason() -> None:
    # Stripes along the rows on an area that is higher than wide.
    tall = np.array([[700, 100], [1220, 100], [1220, 1024], [700, 1024]], np.float64)
    found = search(luma(draw(tall)))
    assert found.corners is None
    assert "upright" in found.reason


def test_tracking_follows_a_small_move_and_notices_a_loss() -> None:
    first, second = quad(0.8, roll_deg=1), quad(0.8, roll_deg=1.2, shift=(6, -4))
    pixels = luma(draw(second, 7))
    assert error(track_screen(pixels, first, black=0.0, white=255.0), second) < 0.003
    assert track_screen(luma(draw(quad(0.3), 7)), first, black=0.0, white=255.0).corners is None
    assert track_screen(np.zeros_like(pixels), first, black=0.0, white=255.0).corners is None


def _without_screen(name: str) -> NDArray[Any]:
    rng = np.random.default_rng(11)
    shape = (1080, 1920)
    y, x = np.mgrid[: shape[0], : shape[1]]
    pictures = {
        "grey": lambda: np.full(shape, 128, np.uint8),
        "noise": lambda: rng.integers(0, 256, shape, dtype=np.uint8),
        "dim noise": lambda: np.clip(rng.normal(10, 3, shape), 0, 255).astype(np.uint8),
        "row noise": lambda: np.clip(rng.normal(60, 8, (shape[0], 1)) + rng.normal(0, 8, shape), 0, 255).astype(
            np.uint8
        ),
        "stripes over all": lambda: np.tile((rng.random((216, 1)) < 0.5).repeat(5, axis=0) * np.uint8(200), (1, 1920)),
        "checkerboard": lambda: (((x // 60 + y // 60) % 2) * 200 + 20).astype(np.uint8),
        "blurred texture": lambda: cv2.normalize(
            cv2.GaussianBlur(rng.normal(0, 1, shape).astype(np.float32), (0, 0), 6), None, 0, 255, cv2.NORM_MINMAX
        ).astype(np.uint8),
        "flickering room": lambda: np.tile((90 + 40 * np.sin(y[:, :1] / 170)).astype(np.uint8), (1, 1920)),
    }
    return np.asarray(pictures[name]())


@pytest.mark.parametrize(
    "name",
    [
        "grey",
        "noise",
        "dim noise",
        "row noise",
        "stripes over all",
        "checkerboard",
        "blurred texture",
        "flickering room",
    ],
)
def test_no_screen_has_a_reason(name: str) -> None:
    found = search(_without_screen(name))
    assert found.corners is None
    assert found.reason


@pytest.mark.parametrize(
    ("pixels", "reason"),
    [
        (np.zeros((1080, 1920), np.uint8), "black"),
        (np.full((1080, 1920), 255, np.uint8), "saturated"),
        (np.zeros((0, 0), np.uint8), "0 x 0"),
        (np.zeros((1, 1), np.uint8), "1 x 1"),
        (np.zeros((1, 4000), np.uint8), "4000 x 1"),
        (np.zeros((20, 30), np.uint16), "30 x 20"),
    ],
)
def test_useless_pictures_are_named(pixels: NDArray[Any], reason: str) -> None:
    found = search(pixels)
    assert found.corners is None
    assert reason in found.reason


@pytest.mark.parametrize("shape", [(96, 96), (97, 501), (500, 97), (240, 320)])
def test_small_pictures_do_not_fail(shape: tuple[int, int]) -> None:
    found = search(np.random.default_rng(2).integers(0, 256, shape, dtype=np.uint8))
    assert found.corners is None


def _capture(folder: Path, name: str) -> tuple[NDArray[Any], dict[str, Any]]:
    path = folder / name
    if path.suffix == ".jpg":
        import simplejpeg

        return simplejpeg.decode_jpeg(path.read_bytes(), colorspace="GRAY")[..., 0], {}
    if path.suffix == ".dng":
        import rawpy

        with rawpy.imread(str(path)) as raw:
            levels = {"black": float(raw.black_level_per_channel[0]), "white": float(raw.white_level)}
            return raw.raw_image_visible.copy(), {**levels, "mosaic_period": 6}
    import av

    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
        plane = np.frombuffer(frame.planes[0], np.uint8).reshape(-1, frame.planes[0].line_size)
        return plane[: frame.height, : frame.width].copy(), {"black": 16.0, "white": 235.0}


def _delivered_corners(truth: dict[str, Any]) -> NDArray[np.float64]:
    """Corners where the delivered picture has them: after the camera's own correction."""
    corners, camera = np.array(truth["corners_sensor_px"], np.float64), truth["camera"]
    if camera["distortion_already_corrected"]:
        matrix, coefficients = np.array(camera["camera_matrix"]), np.array(camera["dist_coeffs"])
        corners = cv2.undistortPoints(corners[:, None], matrix, coefficients, P=matrix)[:, 0]
    return np.asarray(corners, np.float64)


#: Bounds in screen widths; larger where the screen's edge is not in the picture: the near phone cuts the right side
#: off, and both clips start with slots that are dark in every column along the top right.
@pytest.mark.parametrize(
    ("name", "bound"),
    [
        ("phone_astronaut_17k3.jpg", 0.003),
        ("phone_coffee_8k65.jpg", 0.003),
        ("phone_motorcycle_17k3_near.jpg", 0.012),
        ("video1080_chelsea_17k3.mp4", 0.006),
        ("video4k_rocket_34k6.mp4", 0.006),
        ("xs10_china_17k3.jpg", 0.003),
        ("xs10_coffee_wide100.jpg", 0.003),
        ("xs10_flower_34k6.dng", 0.003),
        ("xs10_sky_34k6.jpg", 0.003),
    ],
)
def test_reference_captures(shared_captures: Path, name: str, bound: float) -> None:
    pixels, levels = _capture(shared_captures, name)
    truth = json.loads((shared_captures / name).with_suffix(".truth.json").read_text())
    assert error(search(pixels, **levels), _delivered_corners(truth)) < bound
