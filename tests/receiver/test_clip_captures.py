"""Floors on the reference clips beside the checkout: pictures that the project's own simulator did not make."""

import math
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from small_scene import camera_of

from rxcli.ingest import open_source
from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.receiver.receive import receive
from rxcli.results.truth import Scorer, load_truth, truth_path
from rxcli.types import PacketResult


@pytest.mark.parametrize(
    ("name", "n_frames", "least"), [("clip_exposure4_8k65", 16, 240), ("clip_exposure6_8k65", 16, 200)]
)
def test_clips_of_long_exposures(shared_captures: Path, name: str, n_frames: int, least: int) -> None:
    """Nothing told; a burst that starts in these frames has 20 packets, and there are some fourteen."""
    path = shared_captures / f"{name}.mp4"
    scorer = Scorer(load_truth(truth_path(path)))
    results = [scorer.add(result) for result in receive(islice(open_source(path), n_frames), ReceiverOptions())]
    packets = [packet for result in results for packet in result.packets]
    assert sum(right(packet) for packet in packets) >= least
    believed = [packet for packet in packets if packet.confidence >= 0.9]
    doubt = sum(1 - packet.confidence for packet in believed)  # as many may be wrong, and two deviations more
    assert sum(not right(packet) for packet in believed) <= doubt + 2 * math.sqrt(doubt)


#: Of the 4K clip's starved frames, slots given, 464 to 473 packets come out: docs/video.md.
@pytest.mark.parametrize(
    ("name", "expected", "floor"), [("video1080_chelsea_17k3", 720, 718), ("video4k_rocket_34k6", 520, 450)]
)
def test_floor(shared_captures: Path, name: str, expected: int, floor: int, capsys: pytest.CaptureFixture[str]) -> None:
    path = shared_captures / f"{name}.mp4"
    truth = load_truth(truth_path(path))
    screen = load_profile(str(truth.screen), ScreenProfile)
    options = ReceiverOptions(screens=(screen,), cameras=(camera_of(truth.camera),), force_camera=True)
    scorer = Scorer(truth)
    results = [scorer.add(result) for result in receive(open_source(path), options)]
    score = scorer.score()
    with capsys.disabled():
        print(f"\n{name}: {score.error_free} of {score.expected} error-free, {score.false} false", end=" ")
    assert score.expected == expected
    assert score.error_free >= floor
    assert score.false == 0
    assert score.wrong_w == 0
    sure = [p for r in results for c in r.columns for p in c.packets if p.confidence >= 0.99]
    assert sure
    assert np.mean([right(packet) for packet in sure]) >= 0.99


def right(packet: PacketResult) -> bool:
    return packet.bit_errors == 0
