"""Floors on the reference captures beside the checkout: pictures that the project's own simulator did not make."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rxcli.ingest import open_source
from rxcli.options import ReceiverOptions
from rxcli.profiles import CameraProfile, ScreenProfile, check_profile, load_profile
from rxcli.protocol import hex_to_bits, packet_slots
from rxcli.receiver.receive import receive
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
    result: FrameResult
    truth: dict[str, Any]

    def wrong_shares(self, column: int, payload: str, n_bits: int, bursts: list[int]) -> list[float]:
        """Share of wrong bits against each of `bursts`; 1 where the number of bits differs."""
        n_sent = self.truth["payload_bits"][column]
        if n_bits != n_sent:
            return [1.0] * len(bursts)
        sent = [hex_to_bits(self.truth["payload"][str(burst)][column], n_sent) for burst in bursts]
        return [float(np.mean(hex_to_bits(payload, n_bits) != bits)) for bits in sent]

    @property
    def error_free(self) -> int:
        """Expected packets (shown for 1.02 packet lengths) that were received without a wrong bit."""
        length = packet_slots(self.truth["payload_symbols"])
        expected = [b["burst"] for b in self.truth["frames"][0]["bursts"] if b["visible_slots"] >= 1.02 * length]
        return sum(
            any(0.0 in self.wrong_shares(c.column, p.payload, p.payload_bits, [burst]) for p in c.packets)
            for c in self.result.columns
            for burst in expected
        )

    @property
    def false(self) -> int:
        """Reported packets with more than a quarter of wrong bits against every burst of the frame."""
        shown = [b["burst"] for b in self.truth["frames"][0]["bursts"]]
        packets = [(c.column, p) for c in self.result.columns for p in c.packets]
        return sum(min(self.wrong_shares(c, p.payload, p.payload_bits, shown)) > 0.25 for c, p in packets)


def camera_of(truth: dict[str, Any]) -> CameraProfile:
    camera = truth["camera"]
    size = {"width": camera["width"], "height": camera["height"]}
    mode = {"name": "still", **size, "line_delay_s": camera["line_delay_s"], "exposure_s": camera["exposure_s"]}
    lens = {key: camera[key] for key in ("camera_matrix", "dist_coeffs", "distortion_already_corrected")}
    raw = {"format": 1, "kind": "camera", "name": camera["name"], "modes": [mode], "lens": {**size, **lens}}
    return check_profile(raw, CameraProfile, "truth")


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
        truth = json.loads((self._folder / f"{name}.truth.json").read_text())
        screen = load_profile(truth["screen"], ScreenProfile)
        options = ReceiverOptions(screens=(screen,), cameras=(camera_of(truth),), force_camera=True)
        (result,) = receive(open_source(self._folder / truth["capture"]), options)
        return Reception(result, truth)


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
    above = received.error_free - floor.error_free
    say(f"{floor.name}: {received.error_free} error-free, {above:+d} to the floor, bound {floor.bound}")
    assert received.error_free >= floor.error_free
    assert received.false == 0
    denoised = {c.column: c.w for c in received.result.columns if c.w is not None}
    assert denoised == {column: received.truth["w"][column] for column in denoised}
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
    assert received.result.corners is not None
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
    right = []
    for floor in FLOORS:
        received = corpus[floor.name]
        shown = [b["burst"] for b in received.truth["frames"][0]["bursts"]]
        right += [
            0.0 in received.wrong_shares(c.column, p.payload, p.payload_bits, shown)
            for c in received.result.columns
            for p in c.packets
            if p.confidence >= 0.99
        ]
    assert len(right) >= 50
    assert np.mean(right) >= 0.98


def test_mean_ratio_to_the_bound(corpus: Corpus, say: Callable[[str], None]) -> None:
    ratio = float(np.mean([corpus[floor.name].error_free / floor.bound for floor in FLOORS]))
    say(f"error-free packets over the bound's, mean of {len(FLOORS)} captures: {ratio:.3f} (floor {MIN_MEAN_RATIO})")
    assert ratio >= MIN_MEAN_RATIO
