"""What is said of pictures that give no packets: the likeliest reason first."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from test_pipeline import corners_of, frame_of, options_for, proportioned

from rxcli.lab.simulate.pictures import load_picture
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
    stripes = proportioned().pixels
    assert stripe_lean(stripes) > MIN_LEAN
    assert stripe_lean(np.rot90(stripes)) == pytest.approx(-stripe_lean(stripes), abs=0.01)
    assert max(stripe_lean(photo(name)) for name in ("astronaut", "coffee", "rocket", "retina")) < MIN_LEAN


@pytest.mark.parametrize(
    ("name", "exposure_s", "reason"),
    [("rocket", None, "no_stripes_across"), ("rocket", 578e-6, "long_exposure"), ("astronaut", 0.01, "long_exposure")],
)
def test_an_ordinary_photo_may_show_no_screen_that_sends(name: str, exposure_s: float | None, reason: str) -> None:
    result = receive_frame(Frame(photo(name), "photo", metadata=Metadata(exposure_s=exposure_s)), ReceiverOptions())
    assert result.packets == ()
    assert result.reason == reason


def test_columns_out_of_the_picture_are_not_told_to_come_closer() -> None:
    taken = proportioned()
    corners = corners_of(taken)
    width = round(0.6 * corners[:, 0].max())
    options = options_for(taken)
    cut = replace(frame_of(taken), pixels=np.ascontiguousarray(taken.pixels[:, :width]))
    result = receive_frame(cut, replace(options, cameras=(), force_camera=False))
    hidden = [column.column for column in result.columns if column.reason == "out_of_view"]
    assert hidden == list(range(hidden[0], 20))
    assert 5 <= len(hidden) <= 9
    state = Aim().update(result, 0.0, cut.height)
    assert state.locked
    assert f"{len(hidden)} of the screen's columns are out of the picture" in state.reason
    assert "closer" not in state.advice
