"""What is said of pictures that give no packets: the likeliest reason first."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from test_pipeline import proportioned

from rxcli.lab.simulate.capture import prepare
from rxcli.lab.simulate.pictures import load_picture
from rxcli.lab.simulate.scenes import preset
from rxcli.options import ReceiverOptions
from rxcli.receiver.receive import receive_frame
from rxcli.receiver.screen.stripes import MIN_LEAN, stripe_lean
from rxcli.results.aim import Aim
from rxcli.types import Frame, Metadata


def photo(name: str) -> NDArray[np.uint8]:
    """An ordinary photograph, as grey values."""
    grey = load_picture(name, 1600, 1068).mean(axis=2)
    return np.clip(grey + np.random.default_rng(1).normal(0, 2, grey.shape), 0, 255).astype(np.uint8)


def test_stripes_lean_across_or_downwards_and_photographs_hardly() -> None:
    stripes = proportioned().frame.pixels
    assert stripe_lean(stripes) > MIN_LEAN
    assert stripe_lean(np.rot90(stripes)) == pytest.approx(-stripe_lean(stripes), abs=0.01)
    assert max(stripe_lean(photo(name)) for name in ("astronaut", "coffee", "rocket", "retina")) < MIN_LEAN


@pytest.mark.parametrize(
    ("name", "exposure_s", "reason"),
    [("coffee", None, "no_stripes_across"), ("rocket", 578e-6, "long_exposure"), ("astronaut", 0.01, "long_exposure")],
)
def test_an_ordinary_photo_may_show_no_screen_that_sends(name: str, exposure_s: float | None, reason: str) -> None:
    result = receive_frame(Frame(photo(name), "photo", metadata=Metadata(exposure_s=exposure_s)), ReceiverOptions())
    assert result.packets == ()
    assert result.reason == reason


def taken(roll_deg: float = 0.0, exposure_slots: float = 0.0, **metadata: Any) -> Frame:
    """A photograph of a screen that sends."""
    scene = preset("phone-plain", "paper-17k3").scaled(0.4, keep_readout=True)
    scene = replace(scene, pose=replace(scene.pose, roll_deg=roll_deg, fill=0.5 if roll_deg else scene.pose.fill))
    if exposure_slots:
        exposure_s = exposure_slots / 17300
        scene = scene.exposed(exposure_s, scene.exposure_s / exposure_s)
    return Frame(prepare(scene, 1).frame().pixels, "photo", metadata=Metadata(**metadata))


def straightened() -> Frame:
    """A photograph that was turned by 3 degrees after it was taken."""
    pixels = taken().pixels
    height, width = pixels.shape
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), 3, 1.0)
    turned = cv2.warpAffine(pixels, turn, (width, height))[height // 16 : -height // 16, width // 16 : -width // 16]
    return Frame(np.ascontiguousarray(turned), "photo")


def page(exposure_s: float | None = None) -> Frame:
    """Lines of text."""
    rng, lines = np.random.default_rng(1), np.full((900, 1200), 235.0)
    for top in range(30, 870, 36):
        lines[top : top + 20, 40:1160] -= 200 * rng.integers(0, 2, (5, 280)).repeat(4, axis=0).repeat(4, axis=1)
    noisy = cv2.GaussianBlur(lines, (0, 0), 1.0) + rng.normal(0, 2, lines.shape)
    return Frame(np.clip(noisy, 0, 255).astype(np.uint8), "photo", metadata=Metadata(exposure_s=exposure_s))


def dimmed(level: float = 1.0) -> Frame:
    """A picture under light that is switched on and off steadily."""
    pixels = photo("astronaut") * level
    lit = np.arange(len(pixels)) / 21.7 % 1 < 0.3
    return Frame((pixels * lit[:, None]).astype(np.uint8), "photo", metadata=Metadata(exposure_s=1 / 4000))


def striped_down() -> Frame:
    """Plain stripes down the picture."""
    edges = np.random.default_rng(2).integers(8, 40, 100)
    row = np.repeat(np.tile([40, 210], 50), edges)[:1600].astype(np.uint8)
    return Frame(np.tile(row, (1068, 1)), "photo")


@pytest.mark.parametrize(
    ("picture", "reason"),
    [
        (lambda: taken(roll_deg=90), "on_its_side"),
        (lambda: taken(roll_deg=-88, orientation=6), "portrait"),
        (lambda: taken(exposure_slots=17), "no_columns_striped"),
        (lambda: taken(exposure_slots=17, exposure_s=17 / 17300), "long_exposure"),
        (straightened, "no_columns_striped"),
        (page, "steady_light"),
        (lambda: page(1 / 60), "long_exposure"),
        (dimmed, "steady_light"),
        (lambda: dimmed(0.25), "steady_light"),
        (striped_down, "stripes_down"),
        (lambda: Frame(photo("chelsea"), "photo"), "no_columns"),
        (
            lambda: Frame(photo("chelsea"), "photo", metadata=Metadata(exposure_s=1 / 250, orientation=6)),
            "long_exposure",
        ),
        (lambda: Frame(photo("hubble") // 4, "photo", metadata=Metadata(exposure_s=1 / 8)), "long_exposure"),
    ],
    ids=[
        *("portrait", "portrait by its file", "17 slots", "17 slots stated", "straightened", "text", "text at 1/60 s"),
        *("switched lamp", "dim switched lamp", "stripes down", "cat", "cat upright", "night"),
    ],
)
def test_the_reason_is_true_of_the_picture(picture: Callable[[], Frame], reason: str) -> None:
    result = receive_frame(picture(), ReceiverOptions())
    assert not any(packet.is_believable for packet in result.packets)
    assert result.reason == reason


def test_a_photo_that_states_an_exposure_of_many_slots_is_searched_on_request_or_where_it_shows_stripes() -> None:
    options, stated = ReceiverOptions(), Metadata(exposure_s=1 / 60)
    given_up = receive_frame(Frame(photo("coffee"), "photo", metadata=stated), options)
    assert [remark.reason for remark in given_up.remarks] == ["long_exposure", "not_searched"]
    assert "no_screen" in given_up.skipped
    insisted = receive_frame(
        Frame(photo("coffee"), "photo", metadata=stated), replace(options, skip=options.skip - {"no_screen"})
    )
    assert "not_searched" not in [remark.reason for remark in insisted.remarks]
    striped = receive_frame(replace(proportioned().frame, metadata=stated), options)
    assert "not_searched" not in [remark.reason for remark in striped.remarks]


def test_columns_out_of_the_picture_are_not_told_to_come_closer() -> None:
    taken = proportioned()
    corners = taken.options().corners
    width = round(0.6 * corners[:, 0].max())
    options = taken.options()
    cut = replace(taken.frame, pixels=np.ascontiguousarray(taken.frame.pixels[:, :width]))
    result = receive_frame(cut, replace(options, cameras=(), force_camera=False))
    hidden = [column.column for column in result.columns if column.reason == "out_of_view"]
    assert hidden == list(range(hidden[0], 20))
    assert 5 <= len(hidden) <= 9
    state = Aim().update(result, 0.0, cut.height)
    assert state.locked
    assert f"{len(hidden)} of the screen's columns are out of the picture" in state.reason
    assert "closer" not in state.advice
