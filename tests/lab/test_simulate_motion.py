"""A camera in a hand: its turns, its speed, and rows that are read while it moves."""

from dataclasses import replace

import numpy as np
import pytest

from rxcli.lab.simulate.capture import prepare, stabilised
from rxcli.lab.simulate.motion import HandMotion, turned, turned_back
from rxcli.lab.simulate.scenes import Change, Scene, preset


def scene_in_hand(hand_px: float = 4.0, n_frames: int = 40) -> Scene:
    scene = preset("video-1080p", "paper-17k3").scaled(0.25, 0.25)
    return replace(scene, hand_px=hand_px, n_frames=n_frames)


def test_a_turn_is_undone_and_a_yaw_moves_the_axis_by_its_tangent() -> None:
    rng = np.random.default_rng(1)
    points, motion = rng.uniform(-0.5, 0.5, (50, 2)), rng.normal(0, 0.05, (50, 4))
    assert turned_back(turned(points, motion), motion) == pytest.approx(points, abs=1e-12)
    assert turned(np.zeros((1, 2)), np.array([[0.1, 0.0, 0, 0]]))[0] == pytest.approx([np.tan(0.1), 0.0])
    assert HandMotion(3, 0.2, 0.2).at(np.zeros(1)) == pytest.approx(np.zeros((1, 4)))


def test_the_picture_goes_as_far_as_asked() -> None:
    speeds = []
    for seed in range(6):
        take = prepare(scene_in_hand(4.0), seed)
        centres = np.array([frame["corners_sensor_px"] for frame in take.truth("clip")["frames"]]).mean(axis=1)
        speeds.append(np.hypot(*np.diff(centres, axis=0).T).mean())
    assert np.mean(speeds) == pytest.approx(4.0, rel=0.25)


def test_places_are_read_where_their_row_saw_them() -> None:
    exposure = prepare(scene_in_hand(8.0), 2).exposure(7)
    places = np.random.default_rng(4).uniform(0, 1, (30, 2))
    pixels = exposure.screen_to_pixels(places)
    assert exposure.pixels_to_screen(pixels) == pytest.approx(places, abs=1e-4)
    at_rest = replace(exposure, motion=None)
    assert np.abs(pixels - at_rest.screen_to_pixels(places)).max() > 2
    sides, still = (part.corners[3] - part.corners[0] for part in (exposure, at_rest))
    assert np.abs(sides - still).max() > 0.5  # rows skew meanwhile


def test_steps_of_exposure_and_focus() -> None:
    changes = (Change(2, light=0.5), Change(4, blur_px=3.0))
    take = prepare(replace(scene_in_hand(0.0, 6), changes=changes), 1)
    light = [take.exposure(n).scene.light_e_per_s / take.scene.light_e_per_s for n in range(6)]
    assert light == [1, 1, 0.5, 0.5, 1, 1]
    assert [take.exposure(n).scene.blur_px == 3.0 for n in range(6)] == [False] * 4 + [True] * 2


def test_a_stabilised_clip_stays_where_it_is() -> None:
    """A dot that the hand moves by pixels is where it was, to a part of one."""
    take = prepare(replace(scene_in_hand(8.0, 8), stabilised=True), 3)
    moved, left = [], []
    for number in range(0, 8, 2):
        exposure = take.exposure(number)
        x, y = exposure.screen_to_pixels(np.array([[0.5, 0.5]]))[0]
        columns, rows = np.arange(exposure.scene.sensor.width), np.arange(exposure.scene.sensor.height)
        dot = np.exp(-((columns - x) ** 2 + (rows[:, None] - y) ** 2) / 18.0)
        picture = np.repeat((200 * dot).astype(np.uint8)[..., None], 3, axis=2)
        steady = stabilised(picture, exposure)[..., 0].astype(float)
        left.append([(steady * columns).sum() / steady.sum(), (steady * rows[:, None]).sum() / steady.sum()])
        moved.append([x, y])
    assert np.ptp(moved, axis=0).max() > 4
    assert np.ptp(left, axis=0).max() < 0.7
