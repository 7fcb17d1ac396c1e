"""Where the screen is by the picture on it: shifts, skews, stripes that move on their own, flat pictures."""

import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.registration import ScreenTexture
from rxcli.types import FloatArray, Frame

WIDTH, HEIGHT = 960, 540
CORNERS = np.array([[110.0, 60.0], [850.0, 66.0], [846.0, 476.0], [104.0, 482.0]])


def texture(seed: int = 1) -> NDArray[np.float32]:
    import cv2

    noise = np.random.default_rng(seed).normal(0, 1, (300, 520)).astype(np.float32)
    return np.asarray(np.clip(0.5 + 0.6 * cv2.GaussianBlur(noise, (0, 0), 2.0), 0.05, 1.0))


def picture_of(panel: NDArray[np.float32], corners: FloatArray, seed: int) -> Frame:
    """A frame whose columns are lit at random, slot by slot of five rows."""
    import cv2

    rng = np.random.default_rng(seed)
    to_panel = np.diag([panel.shape[1], panel.shape[0], 1.0]) @ np.linalg.inv(geometry.homography(corners))
    flags = cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR
    shown = cv2.warpPerspective(panel, to_panel, (WIDTH, HEIGHT), flags=flags)
    slots = rng.integers(0, 2, (HEIGHT // 5 + 1, 20)).repeat(5, axis=0)[:HEIGHT]
    bumps = np.exp(-0.5 * ((np.linspace(0, 20, WIDTH)[None] - np.arange(20)[:, None] - 0.5) / 0.45) ** 2)
    light = shown * (slots @ bumps).clip(0, 1) + 0.01
    coded = 220 * light ** (1 / 2.2) + rng.normal(0, 1, light.shape)
    return Frame(np.clip(coded, 0, 255).astype(np.uint8), "frame", seed)


def known_of(panel: NDArray[np.float32]) -> ScreenTexture:
    """What five frames teach of a screen that stays where it is."""
    known = ScreenTexture(picture_of(panel, CORNERS, 1), CORNERS, None)
    for seed in range(2, 6):
        frame = picture_of(panel, CORNERS, seed)
        known.learn(frame, known.find(frame))
    return known


@pytest.mark.parametrize("shift", [(0.0, 0.0), (6.0, -4.0), (-9.0, 7.0)])
def test_a_shift_is_found(shift: tuple[float, float]) -> None:
    panel = texture()
    known = known_of(panel)
    found = known.find(picture_of(panel, CORNERS + np.array(shift), 9))
    assert found.is_precise
    assert found.fits
    assert found.corners == pytest.approx(CORNERS + np.array(shift), abs=1.5)


def test_a_fit_ends_when_the_corners_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Coarse and fine cells together take a few steps, though the stripes are others."""
    panel, steps = texture(), []
    known = known_of(panel)
    read = ScreenTexture._read
    monkeypatch.setattr(ScreenTexture, "_read", lambda *at: (steps.append(1), read(*at))[1])
    found = known.find(picture_of(panel, CORNERS + np.array([3.0, -2.0]), 9))
    assert found.is_precise
    assert len(steps) <= 7


def test_many_frames_know_better_than_one() -> None:
    panel, moved = texture(), CORNERS + np.array([2.0, 1.0])

    def error_px(known: ScreenTexture) -> float:
        found = [known.find(picture_of(panel, moved, seed)).corners for seed in range(9, 13)]
        return float(np.square(np.array(found) - moved).mean()) ** 0.5

    assert error_px(known_of(panel)) < 0.5 * error_px(ScreenTexture(picture_of(panel, CORNERS, 1), CORNERS, None))


def test_a_skew_of_rows_is_a_motion_of_corners() -> None:
    """Five pixels to the right from the first row to the last."""
    panel = texture()
    skewed = CORNERS + np.array([[-2.5, 0], [-2.5, 0], [2.5, 0], [2.5, 0]])
    assert known_of(panel).find(picture_of(panel, skewed, 9)).corners == pytest.approx(skewed, abs=1.2)


def test_stripes_on_a_flat_picture_seem_to_move_it_little() -> None:
    flat = np.full((300, 520), 0.6, np.float32)
    known = ScreenTexture(picture_of(flat, CORNERS, 1), CORNERS, None)
    for seed in range(2, 5):
        frame = picture_of(flat, CORNERS, seed)
        found = known.find(frame)
        assert np.abs(found.corners - CORNERS).max() < 2.2
        known.learn(frame, found)


def test_another_picture_fits_worse() -> None:
    known = known_of(texture(1))
    same, other = (known.find(picture_of(texture(seed), CORNERS, 9)).correlation for seed in (1, 2))
    assert same > other + 0.1
