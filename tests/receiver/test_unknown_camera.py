"""Pictures of unknown cameras from end to end."""

import tomllib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_stages import hypothesis_of
from small_frames import BOTTOM, LEFT, RIGHT, ROWS_PER_SLOT, SCREEN, TOP, write_frame
from small_scene import scored

from rxcli.ingest import open_source
from rxcli.lab.benchmark.trial import Trial, simulate_trial
from rxcli.lab.simulate.isp import Isp, Tone
from rxcli.lab.simulate.optics import Lens, Pose
from rxcli.lab.simulate.scenes import preset
from rxcli.lab.simulate.sensor import Sensor
from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile, check_profile, load_profile
from rxcli.receiver.camera.proposals import CameraHypothesis
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.result import Failure
from rxcli.receiver.receive import receive
from rxcli.receiver.search import Found, cameras, search
from rxcli.types import Frame, Metadata

CORNERS = np.array([[LEFT, TOP], [RIGHT, TOP], [RIGHT, BOTTOM], [LEFT, BOTTOM]], float)
OPTIONS = ReceiverOptions(
    screens=(check_profile(tomllib.loads(SCREEN), ScreenProfile, "small"),), cameras=(), corners=CORNERS, cae="never"
)


def _frame(folder: Path) -> tuple[Frame, list[str]]:
    payloads = write_frame(folder / "small.png", 5)
    return next(iter(open_source(str(folder / "small.png")))), payloads


def test_packets_of_a_long_exposure_are_received() -> None:
    """It shows less than two packets, so that longer ones fit its light as well, without a second header."""
    base = preset("phone-plain", "paper-8k65")
    scene = replace(
        base,
        sensor=replace(base.sensor, width=960, height=720, line_delay_s=3.118e-5, full_scale_e=260.0, read_noise_e=2.0),
        lens=Lens(0.7678, (0.13124, -0.06682, -3.08e-4, 4.71e-4, 0.0)),
        pose=Pose(0.82687, 0.567, -9.959, 1.465, -0.00605, 0.00226),
        isp=Isp("srgb", 2.0, 0.3195, denoise_px=0.294, correct_distortion=True, quality=90),
        picture="rocket",
        w=4,
        exposure_s=2.505e-4,
        light_e_per_s=2.807e5,
        blur_px=0.87,
    )
    trial = simulate_trial(scene, 1071)
    frame = replace(trial.frame, metadata=Metadata())
    options = ReceiverOptions(cameras=(), corners=trial.corners, cae="never")
    result, _ = scored(next(iter(receive([frame], options))), trial.truth)
    assert sum(packet.bit_errors == 0 for packet in result.packets) >= 10


@pytest.mark.parametrize("told_exposure_s", [None, 2e-6])
def test_an_unknown_camera_is_refitted_and_received(tmp_path: Path, told_exposure_s: float | None) -> None:
    frame, payloads = _frame(tmp_path)
    frame = replace(frame, metadata=replace(frame.metadata, exposure_s=told_exposure_s))
    result = next(receive([frame], OPTIONS))
    assert result.estimated["rows_per_slot"][0] == pytest.approx(ROWS_PER_SLOT, rel=1e-3)
    assert result.exposure_s >= (told_exposure_s or 0.0)
    believable = [(column.column, p) for column in result.columns for p in column.packets if p.is_believable]
    right = [packet.payload == payloads[column] for column, packet in believable]
    assert len(right) >= 8
    assert all(right)


def _proposed(*rows_per_slot: float) -> list[CameraHypothesis]:
    known = {"packet_slots": OPTIONS.screens[0].packet_slots, "score": 100.0, "rows_per_slot_sd": 0.01}
    return [hypothesis_of(rows, number=n, curvature_sd=np.zeros(4), **known) for n, rows in enumerate(rows_per_slot)]


def _chosen(frame: Frame, proposed: Iterable[CameraHypothesis], monkeypatch: pytest.MonkeyPatch) -> Found | Failure:
    monkeypatch.setattr(cameras, "propose", lambda *_, **__: list(proposed))
    return search(FrameCache(frame), OPTIONS)


def test_packets_decide_between_hypotheses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame, _ = _frame(tmp_path)
    wrong, right, other = _proposed(1.13 * ROWS_PER_SLOT, ROWS_PER_SLOT, 0.7 * ROWS_PER_SLOT)
    for proposed in ([wrong, right], [wrong, other, right], [right, other]):
        found = _chosen(frame, proposed, monkeypatch)
        assert isinstance(found, Found)
        chosen = found.best.hypothesis.camera.hypothesis
        assert chosen.number == right.number


def test_without_packets_there_is_no_camera_but_a_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame, _ = _frame(tmp_path)
    for proposed in ([], _proposed(1.2 * ROWS_PER_SLOT, 0.7 * ROWS_PER_SLOT)):
        failure = _chosen(frame, proposed, monkeypatch)
        assert isinstance(failure, Failure)
        assert failure.reason in ("no_headers", "no_header")


def test_a_period_that_is_somewhat_off_is_fitted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame, payloads = _frame(tmp_path)
    monkeypatch.setattr(cameras, "propose", lambda *_, **__: _proposed(1.002 * ROWS_PER_SLOT))
    result = next(receive([frame], OPTIONS))
    found, sd = result.estimated["rows_per_slot"]
    assert abs(found - ROWS_PER_SLOT) < 4 * sd < 0.01 * ROWS_PER_SLOT
    assert all(packet.payload == payloads[column.column] for column in result.columns for packet in column.packets)


def _small_phone(tone: Tone) -> tuple[Trial, Frame]:
    """A simulated phone's picture of a bright photograph, without metadata."""
    profile = load_profile("paper-17k3", ScreenProfile)
    line_delay_s = 1 / (3.7 * profile.slot_rate_hz)
    scene = replace(
        preset("phone-plain", profile),
        sensor=Sensor(1280, 960, line_delay_s, "bayer", full_scale_e=260.0, black_level=64, white_level=1023),
        lens=Lens(0.8, (0.0, 0.0, 0.0, 0.0, 0.0)),
        pose=Pose(fill=0.92, roll_deg=0.6),
        isp=Isp(tone=tone, gain=2.0),
        exposure_s=0.9 / profile.slot_rate_hz,
        light_e_per_s=1.4e6 * profile.slot_rate_hz / 20000,
        picture="chelsea",
    )
    trial = simulate_trial(scene, 5)
    return trial, Frame(np.asarray(trial.capture.pixels, np.uint8), "phone")


@pytest.mark.parametrize("tone", ["srgb", "linear"])
def test_packets_are_received_through_either_tone_curve(tone: Tone) -> None:
    trial, frame = _small_phone(tone)
    options = ReceiverOptions(cameras=(), corners=trial.corners, cae="never")
    result = next(receive([frame], options))
    _, score = scored(result, trial.truth)
    assert score.error_free >= 15
