"""What a laboratory sends first: the same in all columns, a counter, one column alone, all lit, half lit."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.lab.simulate.capture import Capture, prepare
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.lab.simulate.truth import build_camera_profile
from rxcli.options import receiver_options
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.protocol import encode_packet
from rxcli.receiver.receive import receive
from rxcli.results.reasons import explained
from rxcli.types import Frame, FrameResult

SCREEN = load_profile("paper-17k3", ScreenProfile)
N_BITS = 7 * SCREEN.payload_symbols


def payload(number: int) -> NDArray[np.uint8]:
    """A number of 16 bits over and over."""
    return np.resize(np.unpackbits(np.frombuffer(number.to_bytes(2, "big"), np.uint8)), N_BITS)


def slots_of(numbers: tuple[int, ...]) -> NDArray[np.float64]:
    """(20, slots) of bursts that send the same number in all columns."""
    bursts = [np.tile(encode_packet(payload(number), 5), SCREEN.repeats) for number in numbers]
    return np.tile(np.concatenate(bursts).astype(np.float64), (SCREEN.columns, 1))


@cache
def filmed(numbers: tuple[int, ...], n_frames: int, lone: int | None = None) -> tuple[Scene, list[Capture]]:
    """Pictures of bursts that send the same in all columns, or in one alone."""
    slots = slots_of(numbers)
    if lone is not None:
        slots[np.arange(SCREEN.columns) != lone] = 0
    return filmed_light(slots, n_frames)


def filmed_light(slots: NDArray[np.float64], n_frames: int) -> tuple[Scene, list[Capture]]:
    # A photograph's pixels stay square: without borders of columns, the aspect tells the screen from a window.
    scene = preset("phone-plain" if n_frames == 1 else "video-1080p", SCREEN).scaled(1.0 if n_frames == 1 else 0.5, 1.0)

    def light(slot: NDArray[np.float64]) -> NDArray[np.float64]:
        return slots[:, np.maximum(slot, 0).astype(int) % slots.shape[1]]

    take = prepare(replace(scene, waveform=light, picture="grey", n_frames=n_frames), 1)
    return scene, [take.frame(number) for number in range(n_frames)]


def received(made: tuple[Scene, list[Capture]], *, known: bool, corners: bool = False) -> FrameResult:
    (scene, captures), options = made, receiver_options()
    if known:
        options = replace(options, cameras=(build_camera_profile(scene, captures[0].exposure),), force_camera=True)
    if corners:
        options = replace(options, corners=captures[0].exposure.corners)
    frames = [Frame(one.pixels, "drawn", one.frame, one.frame / scene.frame_rate_hz) for one in captures]
    results = receive(frames, options)
    return explained(list(results)[-1])


@pytest.mark.parametrize(("n_frames", "known"), [(1, False), (1, True), (3, True)])
@pytest.mark.parametrize("numbers", [(0xCAFE,), tuple(range(7, 27))], ids=["same", "counter"])
def test_the_same_in_all_columns_is_received_and_named(numbers: tuple[int, ...], n_frames: int, known: bool) -> None:
    result = received(filmed(numbers, n_frames), known=known)
    sent = {np.packbits(payload(number)).tobytes().hex() for number in numbers}
    right = {column.column for column in result.columns for packet in column.packets if packet.payload in sent}
    assert len(right) >= 18
    assert result.remarks[-1].reason == "all_the_same"


@pytest.mark.parametrize("n_frames", [1, 3])
def test_one_column_alone_is_received_and_named(n_frames: int) -> None:
    made = filmed((4711,), n_frames, lone=7)
    result = received(made, known=True)
    assert [packet.payload for packet in result.packets] == [np.packbits(payload(4711)).tobytes().hex()]
    assert "one column alone sends" in (result.message or "")
    for known in (True, False) if n_frames == 1 else ():
        result = received(made, known=known, corners=True)
        assert (result.message or "").endswith("column 7 alone sends")


@pytest.mark.parametrize(("n_lit", "reason"), [(4, "lit"), (2, "steady_light")])
def test_a_screen_that_is_lit_or_half_lit_is_named(n_lit: int, reason: str) -> None:
    slots = np.tile((np.arange(2000) % 4 < n_lit).astype(np.float64), (20, 1))
    result = received(filmed_light(slots, 1), known=False)
    assert not result.packets
    assert result.reason == reason
