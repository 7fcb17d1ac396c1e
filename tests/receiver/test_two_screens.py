"""Two screens side by side in one photograph: both are received, and records and tables say so."""

from dataclasses import replace

import numpy as np
import pytest

from rxcli.lab.benchmark.trial import Trial, simulate_trial
from rxcli.lab.simulate.scenes import preset
from rxcli.options import ReceiverOptions
from rxcli.receiver.receive import receive_frame
from rxcli.results.record import from_record, to_record
from rxcli.results.report import format_frame
from rxcli.types import Frame, FrameResult

#: Packets of each screen, of which the rows show 19 and 11.
LEFT, RIGHT = 14, 7


@pytest.fixture(scope="module")
def trials() -> list[Trial]:
    """A screen in the left half of a photograph, and one in the right half."""
    scene = preset("xs10-still", "paper-17k3").scaled(0.5, keep_readout=True)
    scene = replace(scene, light_e_per_s=4 * scene.light_e_per_s)
    halves = ((-0.255, "coffee", 4), (0.25, "astronaut", 10))
    poses = [replace(scene.pose, fill=0.46, shift_x=shift) for shift, _, _ in halves]
    return [
        simulate_trial(replace(scene, picture=picture, pose=pose), seed)
        for pose, (_, picture, seed) in zip(poses, halves, strict=True)
    ]


@pytest.fixture(scope="module")
def photograph(trials: list[Trial]) -> Frame:
    left, right = trials
    pixels = np.array(left.frame.pixels)
    middle = round((left.corners[:, 0].max() + right.corners[:, 0].min()) / 2)
    pixels[:, middle:] = right.frame.pixels[:, middle:]
    return replace(left.frame, pixels=pixels)


@pytest.fixture(scope="module")
def received(photograph: Frame) -> FrameResult:
    return receive_frame(photograph, ReceiverOptions())


def n_right(result: FrameResult, trial: Trial) -> int:
    sent = trial.truth.payload
    return sum(
        any(burst[column.column] == packet.payload for burst in sent.values())
        for column in result.columns
        for packet in column.packets
    )


def test_both_screens_of_a_photograph_are_received(received: FrameResult, trials: list[Trial]) -> None:
    [other] = received.other_screens
    assert n_right(received, trials[0]) >= LEFT
    assert n_right(other, trials[1]) >= RIGHT
    for result, trial in zip((received, other), trials, strict=True):
        assert result.corners is not None
        np.testing.assert_allclose(result.corners, trial.corners, atol=0.01 * 3120)


def test_records_and_tables_have_the_other_screen(received: FrameResult) -> None:
    again = from_record(to_record(received))
    assert [to_record(other) for other in again.other_screens] == to_record(received)["other_screens"]
    text = format_frame(received)
    assert "another screen" in text
    assert all(packet.payload in text for packet in (*received.packets, *received.other_screens[0].packets))


def test_one_screen_with_dark_columns_in_its_middle_is_one_screen(trials: list[Trial]) -> None:
    scene = trials[0].capture.scene
    dark = np.full((108, 192, 3), 180, np.uint8)
    dark[:, 80:112] = 0
    trial = simulate_trial(replace(scene, picture=dark, pose=replace(scene.pose, fill=0.9, shift_x=0.0)), 3)
    result = receive_frame(trial.frame, ReceiverOptions())
    assert not result.other_screens
    assert n_right(result, trial) >= 17
