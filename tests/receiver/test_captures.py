"""Floors on the reference captures beside the checkout: pictures that the project's own simulator did not make."""

import json
from collections.abc import Callable
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Floor:
    """Error-free packets that a capture must give, and those that the bound on its sensor values gives."""

    name: str
    error_free: int
    bound: int


FLOORS = (
    Floor("xs10_sky_34k6", 20, 20),
    Floor("xs10_china_17k3", 32, 38),
    Floor("xs10_flower_34k6", 16, 16),
    Floor("phone_coffee_8k65", 17, 20),
    Floor("phone_astronaut_17k3", 14, 18),
    Floor("phone_motorcycle_17k3_near", 17, 20),
    Floor("xs10_coffee_wide100", 95, 100),
)
MIN_MEAN_RATIO = 0.92


@dataclass(frozen=True)
class Reception:
    #: With the wrong bits of every packet.
    result: FrameResult
    score: Score
    truth: dict[str, Any]


class Corpus:
    """Captures, each decoded once."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._received: dict[str, Reception] = {}

    def __getitem__(self, name: str) -> Reception:
        if name not in self._received:
            self._received[name] = self._receive(name)
        return self._received[name]

    def _receive(self, name: str) -> Reception:
        path = self._folder / f"{name}.truth.json"
        truth, scorer = json.loads(path.read_text()), Scorer(load_truth(path))
        screen, camera = load_profile(truth["screen"], ScreenProfile), camera_of(truth["camera"])
        options = ReceiverOptions(screens=(screen,), cameras=(camera,), force_camera=True)
        (result,) = receive(open_source(self._folder / truth["capture"]), options)
        return Reception(scorer.add(result), scorer.score(), truth)


@pytest.fixture(scope="session")
def corpus(shared_captures: Path) -> Corpus:
    return Corpus(shared_captures)


@pytest.fixture
def say(capsys: pytest.CaptureFixture[str]) -> Callable[[str], None]:
    """Prints past pytest's capture."""

    def speak(text: str) -> None:
        with capsys.disabled():
            print(f"\n{text}", end=" ")

    return speak


@pytest.mark.parametrize("floor", FLOORS, ids=lambda floor: floor.name)
def test_floor(corpus: Corpus, floor: Floor, say: Callable[[str], None]) -> None:
    received = corpus[floor.name]
    score = received.score
    above = score.error_free - floor.error_free
    say(f"{floor.name}: {score.error_free} error-free, {above:+d} to the floor, bound {floor.bound}")
    assert score.error_free >= floor.error_free
    assert (score.false, score.wrong_w) == (0, 0)
    assert received.result.status in {"ok", "partial"}


@pytest.mark.parametrize("floor", FLOORS, ids=lambda floor: floor.name)
def test_corners_are_found(corpus: Corpus, floor: Floor) -> None:
    """Those in the picture: across the columns within an eighth of a column of twenty, along them 2 %."""
    import cv2

    received = corpus[floor.name]
    camera = received.truth["camera"]
    corners = np.array(received.truth["corners_sensor_px"])
    if camera["distortion_already_corrected"]:
        matrix, coeffs = np.array(camera["camera_matrix"]), np.array(camera["dist_coeffs"])
        corners = cv2.undistortPoints(corners[:, None], matrix, coeffs, P=matrix)[:, 0]
    in_picture = ((corners >= 0) & (corners <= [camera["width"] - 1, camera["height"] - 1])).all(axis=1)
    assert in_picture.sum() >= 2
    width = float(np.linalg.norm(corners[1] - corners[0]))
    across = (corners[1] - corners[0]) / width
    off = (received.result.corners - corners)[in_picture]
    assert np.abs(off @ across).max() < width / 160
    # Of dark rows packets cannot tell whose they are.
    assert np.linalg.norm(off, axis=1).max() < 0.02 * width


def test_confidence_is_not_boasted(corpus: Corpus) -> None:
    """Of the packets of all captures reported at 0.99 and above, at most one in fifty has a wrong bit."""
    packets = [packet for floor in FLOORS for packet in corpus[floor.name].result.packets]
    right = [packet.bit_errors == 0 for packet in packets if packet.confidence >= 0.99]
    assert len(right) >= 50
    assert np.mean(right) >= 0.98


def test_mean_ratio_to_the_bound(corpus: Corpus, say: Callable[[str], None]) -> None:
    ratio = float(np.mean([corpus[floor.name].score.error_free / floor.bound for floor in FLOORS]))
    say(f"error-free packets over the bound's, mean of {len(FLOORS)} captures: {ratio:.3f} (floor {MIN_MEAN_RATIO})")
    assert ratio >= MIN_MEAN_RATIO
