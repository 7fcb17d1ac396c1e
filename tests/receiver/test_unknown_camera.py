"""Pictures of unknown cameras from end to end."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_frames import BOTTOM, LEFT, RIGHT, ROWS_PER_SLOT, SCREEN, TOP, write_frame

from rxcli.ingest import open_source
from rxcli.lab.benchmark.draw import FIRST_SEED, as_stored, phone_of
from rxcli.lab.benchmark.trial import Trial, score_result, simulate_trial
from rxcli.lab.simulate.isp import Isp, Tone
from rxcli.lab.simulate.optics import Lens, Pose
from rxcli.lab.simulate.scenes import preset
from rxcli.lab.simulate.sensor import Sensor
from rxcli.profiles import ScreenProfile, load_profile, parse_profile
from rxcli.receiver import unknown_camera
from rxcli.receiver.acquisition import Acquisition, sample_columns
from rxcli.receiver.cameras import find_cameras
from rxcli.receiver.context import Camera, Timer
from rxcli.receiver.pipeline import ReceiverOptions, receive
from rxcli.receiver.screen_choice import acquire
from rxcli.receiver.still import decode
from rxcli.types import Frame, FrameResult

CORNERS = np.array([[LEFT, TOP], [RIGHT, TOP], [RIGHT, BOTTOM], [LEFT, BOTTOM]], float)
OPTIONS = ReceiverOptions(
    screens=(parse_profile(SCREEN, ScreenProfile, "small"),), cameras=(), corners=CORNERS, cae="never"
)


def _frame(folder: Path) -> tuple[Frame, list[str]]:
    payloads = write_frame(folder / "small.png", 5)
    return next(iter(open_source(str(folder / "small.png")))), payloads


def test_packets_of_a_long_exposure_are_received() -> None:
    """It shows less than two packets, so that longer ones fit its light as well, without a second header."""
    scene, turned = phone_of(777, 71)
    trial = simulate_trial(scene, FIRST_SEED + 71)
    frame, corners = as_stored(trial, turned)
    options = ReceiverOptions(cameras=(), corners=corners, cae="never")
    result, _ = score_result(next(iter(receive([frame], options))), trial.truth)
    assert sum(packet.bit_errors == 0 for packet in result.packets) >= 10


@pytest.mark.parametrize("told_exposure_s", [None, 2e-6])
def test_an_unknown_camera_is_refitted_and_received(tmp_path: Path, told_exposure_s: float | None) -> None:
    frame, payloads = _frame(tmp_path)
    frame = replace(frame, metadata=replace(frame.metadata, exposure_s=told_exposure_s))
    result = next(receive([frame], OPTIONS))
    assert result.estimated["rows_per_slot"][0] == pytest.approx(ROWS_PER_SLOT, rel=1e-3)
    assert result.exposure_s is not None
    assert result.exposure_s >= (told_exposure_s or 0.0)
    right = [packet.payload == payloads[column.column] for column in result.columns for packet in column.packets]
    assert len(right) >= 8
    assert all(right)


def test_an_estimate_that_neither_packets_nor_edges_bear_out_is_taken_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame, _ = _frame(tmp_path)

    context = find_cameras(frame, CORNERS, OPTIONS, Timer()).first
    assert context is not None
    right = context.camera
    assert right.blind_estimate is not None
    estimate, strips = right.blind_estimate
    wrong = replace(right, blind_estimate=(replace(estimate, rows_per_slot=1.03 * ROWS_PER_SLOT), strips))
    acquisition = acquire(context, sample_columns(context, context.n_columns, quick=True))
    assert isinstance(acquisition, Acquisition)
    reception = decode(acquisition, OPTIONS.skip)
    result = FrameResult("small", 0, None, "no_signal", message="none", **right.facts)

    def after(camera: Camera, packets: float) -> FrameResult:
        monkeypatch.setattr(unknown_camera, "packet_llr", lambda _: packets)
        return unknown_camera.without_estimate(result, camera, reception)

    assert after(wrong, 100.0) == after(right, 0.0) == after(replace(wrong, blind_estimate=None), 0.0) == result
    doubted = after(wrong, 0.0)
    assert not doubted.estimated
    assert doubted.line_delay_s is None
    assert "no packet header" in (doubted.message or "")


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
def test_the_tone_curve_is_estimated(tone: Tone) -> None:
    trial, frame = _small_phone(tone)
    options = ReceiverOptions(cameras=(), corners=trial.corners, cae="never")
    result = next(receive([frame], options))
    exponent, sd = result.estimated["tone_exponent"]
    assert abs(exponent - (1.0 if tone == "linear" else 2.2)) < 2 * sd
    _, score = score_result(result, trial.truth)
    assert score.error_free >= 15
