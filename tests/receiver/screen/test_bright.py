"""A bright screen whose picture hides the columns' borders: its outline is where it is bright."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from rxcli.lab.benchmark.trial import simulate_trial
from rxcli.lab.simulate.scenes import preset
from rxcli.options import ReceiverOptions
from rxcli.receiver.plane.read import read_plane
from rxcli.receiver.receive import receive_frame
from rxcli.receiver.screen.bright import bright_parts
from rxcli.types import Frame

CORNERS = np.array([[210.0, 120.0], [1390.0, 160.0], [1370.0, 860.0], [190.0, 800.0]])


def picture_of(corners: np.ndarray, level: int = 200, dark: tuple[slice, slice] | None = None) -> Frame:
    pixels = np.full((1000, 1600), 20, np.uint8)
    cv2.fillConvexPoly(pixels, np.round(corners).astype(np.int32), level)
    if dark is not None:
        pixels[dark] = 20
    return Frame(pixels, "drawn")


@pytest.mark.parametrize(
    "dark",
    [
        None,
        (slice(400, 500), slice(600, 700)),
        (slice(0, 180), slice(0, 300)),
        (slice(0, 300), slice(0, 800)),
    ],
    ids=["whole", "hole", "corner", "large corner"],
)
def test_corners_of_a_bright_part(dark: tuple[slice, slice] | None) -> None:
    found = bright_parts(read_plane(picture_of(CORNERS, dark=dark)))[0]
    assert found is not None
    np.testing.assert_allclose(found, CORNERS, atol=12)


@pytest.mark.parametrize(
    "corners",
    [
        np.array([[800.0, 500.0], [1000.0, 500.0], [1000.0, 660.0], [800.0, 660.0]]),
        np.array([[800.0, 20.0], [1500.0, 900.0], [1500.0, 901.0], [100.0, 900.0]]),
        np.array([[-9.0, 100.0], [1609.0, 100.0], [1609.0, 900.0], [-9.0, 900.0]]),
    ],
    ids=["small", "triangle", "two sides in view"],
)
def test_what_is_no_screen(corners: np.ndarray) -> None:
    assert bright_parts(read_plane(picture_of(corners)))[0] is None


@pytest.mark.parametrize("step", [6, 0])
def test_a_dark_screen_is_a_faint_part_around_a_bright_window(step: int) -> None:
    frame, rng = picture_of(CORNERS, 20 + step), np.random.default_rng(5)
    frame.pixels[300:700, 500:1000] = 220
    noisy = (frame.pixels + rng.normal(0, 4, frame.pixels.shape)).clip(0, 255).astype(np.uint8)
    found = [part for part in bright_parts(read_plane(replace(frame, pixels=noisy))) if part is not None]
    np.testing.assert_allclose(found[0], [[500, 300], [1000, 300], [1000, 700], [500, 700]], atol=20)
    near = [corners for corners in found if np.abs(corners - CORNERS).max() < 20]
    assert len(near) == bool(step)


def test_a_checkerboard_is_received() -> None:
    scene = preset("xs10-still", "paper-17k3").scaled(0.5, keep_readout=True)
    checks = np.kron(np.indices((16, 28)).sum(axis=0) % 2, np.ones((24, 24), int))[..., None] * np.uint8([200] * 3)
    scene = replace(scene, picture=checks.astype(np.uint8), light_e_per_s=2 * scene.light_e_per_s)
    trial = simulate_trial(replace(scene, pose=replace(scene.pose, fill=0.75)), 3)
    result = receive_frame(trial.frame, ReceiverOptions())
    sent = {payload for burst in trial.truth.payload.values() for payload in burst}
    assert sum(packet.payload in sent for packet in result.packets) >= 15
    assert max(packet.confidence for packet in result.packets) <= 0.9
