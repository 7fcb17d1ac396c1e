"""Floors on the reference captures beside the checkout: pictures that the project's own simulator did not make."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_scene import camera_of

from rxcli.ingest import open_source
from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.receiver.receive import receive
from rxcli.results.truth import Score, Scorer, load_truth
from rxcli.types import FrameResult

#: Error-free packets that a capture must give, and those that the bound on its sensor values gives.
FLOORS = {
    "xs10_sky_34k6": (20, 20),
    "xs10_china_17k3": (32, 38),
    "xs10_flower_34k6": (16, 16),
    "phone_coffee_8k65": (17, 20),
    "phone_astronaut_17k3": (14, 18),
    "phone_motorcycle_17k3_near": (17, 20),
    "xs10_coffee_wide100": (95, 100),
}
MIN_MEAN_RATIO = 0.92


@cache
def received(folder: Path, name: str) -> tuple[FrameResult, Score, dict[str, Any]]:
    """The result of a capture, with the wrong bits of every packet; its score, and the truth."""
    path = folder / f"{name}.truth.json"
    truth, scorer = json.loads(path.read_text()), Scorer(load_truth(path))
    screen, camera = load_profile(truth["screen"], ScreenProfile), camera_of(truth["camera"])
    options = ReceiverOptions(screens=(screen,), cameras=(camera,), force_camera=True)
    (result,) = receive(open_source(folder / truth["capture"]), options)
    return scorer.add(result), scorer.score(), truth


@pytest.mark.parametrize("name", FLOORS)
def test_floor(shared_captures: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    (result, score, _), (floor, bound) = received(shared_captures, name), FLOORS[name]
    with capsys.disabled():
        print(f"\n{name}: {score.error_free} error-free, {score.error_free - floor:+d} to the floor, bound {bound}")
    assert score.error_free >= floor
    assert (score.false, score.wrong_w) == (0, 0)
    assert result.status in {"ok", "partial"}


@pytest.mark.parametrize("name", FLOORS)
def test_corners_are_found(shared_captures: Path, name: str) -> None:
    """Those in the picture: across the columns within an eighth of a column of twenty, along them 2 %."""
    import cv2

    result, _, truth = received(shared_captures, name)
    camera, corners = truth["camera"], np.array(truth["corners_sensor_px"])
    if camera["distortion_already_corrected"]:
        matrix, coeffs = np.array(camera["camera_matrix"]), np.array(camera["dist_coeffs"])
        corners = cv2.undistortPoints(corners[:, None], matrix, coeffs, P=matrix)[:, 0]
    in_picture = ((corners >= 0) & (corners <= [camera["width"] - 1, camera["height"] - 1])).all(axis=1)
    assert in_picture.sum() >= 2
    width = float(np.linalg.norm(corners[1] - corners[0]))
    across = (corners[1] - corners[0]) / width
    off = (result.corners - corners)[in_picture]
    assert np.abs(off @ across).max() < width / 160
    # Of dark rows packets cannot tell whose they are.
    assert np.linalg.norm(off, axis=1).max() < 0.02 * width


def test_confidence_is_not_boasted(shared_captures: Path) -> None:
    """Of the packets of all captures reported at 0.99 and above, at most one in fifty has a wrong bit."""
    packets = [packet for name in FLOORS for packet in received(shared_captures, name)[0].packets]
    right = [packet.bit_errors == 0 for packet in packets if packet.confidence >= 0.99]
    assert len(right) >= 50
    assert np.mean(right) >= 0.98


def test_mean_ratio_to_the_bound(shared_captures: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ratios = [received(shared_captures, name)[1].error_free / bound for name, (_, bound) in FLOORS.items()]
    ratio = float(np.mean(ratios))
    with capsys.disabled():
        print(f"\nerror-free packets over the bound's, mean of {len(FLOORS)}: {ratio:.3f} (floor {MIN_MEAN_RATIO})")
    assert ratio >= MIN_MEAN_RATIO
