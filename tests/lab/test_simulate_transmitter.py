"""The transmitter against closed forms and the air interface's own numbers."""

from pathlib import Path

import numpy as np
import pytest

from rxcli.errors import UsageError
from rxcli.lab.simulate.pictures import load_picture, picture_names
from rxcli.lab.simulate.transmitter import (
    PICTURE_FILES,
    Link,
    backlight_average,
    choose_weights,
    dimming_levels,
    drive_screen,
    export_picture,
    light_spread,
)
from rxcli.profiles import ScreenProfile, load_profile


@pytest.fixture(scope="module")
def screen() -> ScreenProfile:
    return load_profile("paper-34k6", ScreenProfile)


def link_of(screen: ScreenProfile, w: int = 5, message: bytes | None = None) -> Link:
    return Link(screen, np.full(screen.columns, w), 1, message)


@pytest.mark.parametrize(("sigma", "n"), [(0.45, 20), (0.5, 100), (0.45, 8)])
def test_light_of_a_segment_is_one_pitch_of_light(sigma: float, n: int) -> None:
    places = np.linspace(-0.5, 1.5, 40001)
    energy = light_spread(places, n, sigma).sum(axis=0) * (places[1] - places[0]) * n
    np.testing.assert_allclose(energy, 1.0, rtol=1e-6)
    np.testing.assert_array_equal(light_spread((np.arange(5) + 0.5) / 5, 5, 0), np.eye(5))


def test_neighbours_give_fifteen_percent_in_the_middle_and_half_at_the_edge() -> None:
    spread = light_spread(np.array([10.5 / 20, 11 / 20]), 20, 0.45)
    share = 1 - spread[:, 10] / spread.sum(axis=1)
    # Closed form: 2 g(1) / (1 + 2 g(1)) with g(1) = exp(-1 / (2 * 0.45^2)).
    g = np.exp(-0.5 / 0.45**2)
    assert share[0] == pytest.approx(2 * g / (1 + 2 * g), rel=1e-3)
    assert share[0] == pytest.approx(0.15, abs=0.01)
    assert share[1] == pytest.approx(0.5, abs=0.01)


def test_tails_of_the_spread_are_those_measured() -> None:
    places = (np.array([10, 11, 12]) + 0.5) / 20
    light = light_spread(places, 20, 0.45, 0.39)[:, 10]
    assert light[1:] / light[0] == pytest.approx([0.20, 0.03], abs=2e-3)
    fine = (np.arange(-20000, 40000) + 0.5) / 20000
    assert light_spread(fine, 20, 0.45, 0.39)[:, 10].mean() * 60 == pytest.approx(1.0, rel=1e-6)


def test_compensated_picture_times_backlight_is_the_picture(screen: ScreenProfile) -> None:
    picture = np.full((screen.height_px, screen.width_px, 3), 128, np.uint8)
    picture[:, ::2] = 90
    drive = drive_screen(screen, picture, (2,) * 10 + (8,) * 10)
    np.testing.assert_allclose(drive.lit_light * drive.weights / 10, drive.levels)
    shown = drive.transmittance * backlight_average(drive.levels, screen, *picture.shape[:2], 0.0)[..., None]
    wanted = (picture / 255) ** 2.2
    inner = (slice(100, -100), slice(80, -80))
    # The brightest pixels find a little less than the average light between segments, and cannot do more than open.
    np.testing.assert_allclose(shown[inner][:, 1::2], wanted[inner][:, 1::2], rtol=0.08)
    np.testing.assert_allclose(shown[inner][:, ::2], wanted[inner][:, ::2], rtol=0.02)


def test_weights_follow_the_dimming_and_are_checked() -> None:
    picture = np.zeros((8, 20, 3))
    picture[3, 7, 2], picture[3, 8, 0], picture[6, 12:] = 0.72, 0.3, 1.0  # the brightest subpixel of each segment
    levels = dimming_levels(picture, 4, 10)
    assert levels.sum() == pytest.approx(0.72 + 0.3 + 4)
    assert choose_weights("dimming", levels).tolist() == [1, 1, 1, 7, 3, 1, 9, 9, 9, 9]
    assert choose_weights(4, levels).tolist() == [4] * 10
    with pytest.raises(UsageError, match=r"one for each of 10 columns \(got 2\)"):
        choose_weights((4, 5), levels)
    with pytest.raises(UsageError, match=r"1\.\.9"):
        choose_weights(10, levels)


def test_slots_are_laid_out_as_the_air_interface_says(screen: ScreenProfile) -> None:
    # All payload bits 0, then all 1: codewords 0 and 127 of weight 5, written out in the air interface.
    for message, word in ((b"\x00", "0000011111"), (b"\xff", "1000010111")):
        slots = link_of(screen, message=message).slots(0, 260)[3]
        assert "".join(map(str, slots)) == "0011100011" + "1111100000" + word * 24


def test_bursts_are_three_equal_packets_without_gap_and_any_window_shows_them(screen: ScreenProfile) -> None:
    link = link_of(screen)
    stream = link.slots(-30, 2 * link.burst_slots)
    assert not stream[:, :30].any()
    slots = stream[:, 30:]
    first, second, third, fourth = (slots[:, i * 260 : (i + 1) * 260] for i in range(4))
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(first, third)
    assert (first != fourth).any(axis=1).all()
    assert (slots.reshape(20, -1, 10).sum(axis=2) == 5).all()
    for start, stop in ((-30, -5), (-3, 4), (779, 781), (700, 1500)):
        np.testing.assert_array_equal(link.slots(start, stop), stream[:, start + 30 : stop + 30])


def test_message_is_sent_burst_by_burst_and_column_by_column(screen: ScreenProfile) -> None:
    message = bytes(range(256)) * 2
    link = link_of(screen, message=message)
    sent = np.concatenate([*link.payload(0), *link.payload(1)])
    wanted = np.resize(np.unpackbits(np.frombuffer(message, np.uint8)), sent.size)
    np.testing.assert_array_equal(sent, wanted)


def test_picture_for_a_real_backlight(screen: ScreenProfile, tmp_path: Path) -> None:
    import cv2

    drive = drive_screen(screen, load_picture("bars", 1366, 768), 5)
    export_picture(drive, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == set(PICTURE_FILES)
    levels = np.loadtxt(tmp_path / "levels.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(levels, drive.levels, atol=1e-6)
    picture = cv2.imread(str(tmp_path / "picture.png"))[..., ::-1]
    np.testing.assert_array_equal(picture, drive.grey)


@pytest.mark.parametrize("name", picture_names())
def test_every_picture_fills_the_screen(name: str) -> None:
    picture = load_picture(name, 136, 77)
    assert picture.shape == (77, 136, 3)
    assert picture.dtype == np.uint8
    assert (picture.max() > 0) == (name != "black")
