"""Light that is the same everywhere: lamps and dimmed screens give no packets, a screen that says one thing does."""

from dataclasses import dataclass, replace

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from small_scene import reception

from rxcli.lab.benchmark.trial import simulate_trial
from rxcli.lab.simulate.capture import prepare
from rxcli.lab.simulate.no_data import no_data_scene
from rxcli.lab.simulate.scenes import preset
from rxcli.lab.simulate.truth import build_camera_profile
from rxcli.options import ReceiverOptions
from rxcli.receiver.decode.steady import is_common_light
from rxcli.receiver.receive import receive
from rxcli.types import Frame


def clip_of(kind: str, seed: int, n_frames: int) -> tuple[list[Frame], ReceiverOptions]:
    """Frames without data, their camera, and corners: one light has no columns to be found."""
    scene = no_data_scene(kind, np.random.default_rng([999, seed, 23]), n_frames)[0].scaled(0.5, keep_readout=True)
    take = prepare(scene, seed)
    captures = [take.frame(number) for number in range(n_frames)]
    frames = [Frame(one.pixels, "drawn", one.frame, one.frame / scene.frame_rate_hz) for one in captures]
    camera, corners = build_camera_profile(scene, captures[0].exposure), captures[0].exposure.corners
    return frames, ReceiverOptions(cameras=(camera,), force_camera=True, corners=corners)


@pytest.mark.parametrize("n_frames", [1, 2])
@pytest.mark.parametrize(("kind", "reason"), [("pwm", "steady_light"), ("codes", "one_lamp")])
def test_one_lamp_gives_no_packets_and_is_named(kind: str, reason: str, n_frames: int) -> None:
    """Photographs and clips alike; what is seen is named in one of two photographs at least."""
    reasons = []
    for seed in (0, 3) if n_frames == 1 else (1,):
        results = list(receive(*clip_of(kind, seed, n_frames)))
        assert len(results) == n_frames
        assert not any(column.packets for result in results for column in result.columns)
        reasons += [result.reason for result in results]
    assert reason in reasons


@dataclass(frozen=True)
class Alike:
    """The same random labels in all columns."""

    def labels(self, bursts: NDArray[np.int64], columns: int, payload_symbols: int) -> NDArray[np.uint8]:
        """See `LabelSource`."""
        rng = np.random.default_rng(bursts)
        return np.repeat(rng.integers(0, 128, (bursts.size, payload_symbols, 1), np.uint8), columns, axis=2)


@pytest.mark.parametrize("screen", ["paper-8k65", "paper-17k3"])
def test_a_screen_that_says_the_same_in_all_columns_is_received(screen: str) -> None:
    scene = preset("phone-plain", screen).scaled(0.3, 0.5, keep_readout=True)
    trial = simulate_trial(replace(scene, labels=Alike(), picture="coffee"), 3)
    result, score = reception(trial, trial.options())
    assert result.status == "ok"
    assert score.error_free >= 18
    # Two may be wrong, each in its own way.
    assert len({column.packets[0].payload for column in result.columns}) <= 3


def test_columns_are_alike_that_show_one_light() -> None:
    """With noise, and a little later from column to column; packets of one clock are not alike."""
    rng = np.random.default_rng(1)
    light = np.sign(rng.normal(size=400))
    slanted = np.stack([light[k : k + 300] for k in range(20)]).astype(np.float32)
    noisy = slanted + rng.normal(0, 0.5, slanted.shape).astype(np.float32)
    weight = np.ones_like(noisy)
    assert is_common_light(noisy, weight, 0.15, 20)
    assert not is_common_light(noisy, weight, 0.15)
    different = rng.normal(size=(20, 300)).astype(np.float32)
    different[:, ::4] = light[:75]
    assert not is_common_light(different, weight, 0.15, 20)
    assert not is_common_light(different[:2], weight[:2], 0.15)
    assert not is_common_light(np.zeros_like(weight), np.zeros_like(weight), 0.15, 20)


def test_columns_may_have_many_headers_in_common() -> None:
    """Two fifths of the slots of a packet of three symbols are its header."""
    rng = np.random.default_rng(2)
    light = np.sign(rng.normal(size=(20, 300))).astype(np.float32)
    light[:, np.arange(300) % 10 < 7] = light[0, np.arange(300) % 10 < 7]
    weight = np.ones_like(light)
    assert is_common_light(light, weight, 0.0)
    assert not is_common_light(light, weight, 0.4)


def test_a_few_lit_columns_side_by_side_are_no_single_lamp() -> None:
    """Most of a dark picture's columns are noise, so few lit ones lie far apart."""
    trial = simulate_trial(replace(preset("xs10-still", "paper-17k3").scaled(0.4, 1.0), picture="flower"), 1)
    (result,) = receive([trial.frame], trial.options())
    assert len(result.packets) >= 5


def test_a_screen_of_two_columns_is_received() -> None:
    """Where it fills a part of the picture, and where less than its two columns are in view: which is no bug."""
    scene = preset("phone-plain", "paper-8k65").scaled(0.3, 0.3, keep_readout=True)
    two = msgspec.structs.replace(scene.screen, name="two", columns=2, width_mm=60.0, height_mm=60.0)
    options = ReceiverOptions(screens=(two,))
    for fill, n_received in ((0.7, 2), (3.0, 0)):
        own = replace(scene, screen=two, picture="white", pose=replace(scene.pose, fill=fill))
        (result,) = receive([simulate_trial(own, 1).frame], options)
        assert len(result.packets) >= n_received


def test_one_column_alone_has_no_number() -> None:
    scene = preset("phone-plain", "paper-8k65").scaled(0.4, 0.4, keep_readout=True)
    slots = np.random.default_rng(1).integers(0, 2, 70)
    slots[:20] = [int(digit) for digit in "00111000111111100000"]
    slots[20:] = np.tile([1, 0, 0, 1, 1, 0, 1, 0, 1, 0], 5)

    def waveform(slot: NDArray[np.int64]) -> NDArray[np.float64]:
        out = np.zeros((20, slot.size))
        out[7] = slots[slot.astype(np.int64) % 70]
        return out

    trial = simulate_trial(replace(scene, waveform=waveform, picture="white").metered(0.9), 1)
    (result,) = receive([trial.frame], ReceiverOptions())
    assert [remark.reason for remark in result.remarks] == ["one_column"]
    assert len(result.packets) == 1
