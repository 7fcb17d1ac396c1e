"""Which of several estimated cameras it is, and pictures of unknown cameras from end to end."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_frames import BOTTOM, LEFT, RIGHT, ROWS_PER_SLOT, SCREEN, TOP, write_frame

from rxcli.ingest import open_source
from rxcli.lab.benchmark import phones
from rxcli.lab.benchmark.journal import SEEDS_A_RUN
from rxcli.lab.benchmark.trial import Trial, score_result, simulate_trial
from rxcli.lab.simulate.isp import Isp, Tone
from rxcli.lab.simulate.optics import Lens, Pose
from rxcli.lab.simulate.scenes import preset
from rxcli.lab.simulate.sensor import Sensor
from rxcli.profiles import ScreenProfile, load_profile, parse_profile
from rxcli.receiver import camera as blind
from rxcli.receiver import unknown_camera
from rxcli.receiver.acquisition import Acquisition, sample_columns
from rxcli.receiver.cameras import Cameras, find_cameras
from rxcli.receiver.context import Camera, Failure, FrameContext, Timer
from rxcli.receiver.pipeline import ReceiverOptions, receive
from rxcli.receiver.screen_choice import acquire, quick_look
from rxcli.receiver.still import decode
from rxcli.types import Frame, FrameResult

CORNERS = np.array([[LEFT, TOP], [RIGHT, TOP], [RIGHT, BOTTOM], [LEFT, BOTTOM]], float)
OPTIONS = ReceiverOptions(
    screens=(parse_profile(SCREEN, ScreenProfile, "small"),), cameras=(), corners=CORNERS, cae="never"
)


def _frame(folder: Path) -> tuple[Frame, list[str]]:
    payloads = write_frame(folder / "small.png", 5)
    return next(iter(open_source(str(folder / "small.png")))), payloads


def _with_camera(frame: Frame, rows_per_slot: float) -> FrameContext:
    camera = Camera(None, 1e-4 / rows_per_slot, 1e-5, None, "linear")
    return FrameContext(frame, CORNERS, camera, OPTIONS.screens, Timer())


def _chosen(frame: Frame, found: Cameras, monkeypatch: pytest.MonkeyPatch) -> FrameContext | Failure:
    monkeypatch.setattr(unknown_camera, "find_cameras", lambda *_, **__: found)
    return unknown_camera.likely_camera(frame, CORNERS, OPTIONS, Timer())


def _why_none(frame: Frame, found: Cameras, monkeypatch: pytest.MonkeyPatch) -> str:
    failure = _chosen(frame, found, monkeypatch)
    assert isinstance(failure, Failure)
    return failure.message


def test_headers_decide_between_estimates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame, _ = _frame(tmp_path)
    right, wrong, other = (
        _with_camera(frame, rows) for rows in (ROWS_PER_SLOT, 1.13 * ROWS_PER_SLOT, 0.7 * ROWS_PER_SLOT)
    )
    assert _chosen(frame, Cameras(wrong, (other, right)), monkeypatch) is right
    assert _chosen(frame, Cameras(right, (wrong, other)), monkeypatch) is right
    assert _chosen(frame, Cameras(None, (wrong, right), "nothing"), monkeypatch) is right


@pytest.mark.parametrize(("seed", "number", "n_packets"), [(777, 71, 10), (2024, 25, 8)])
def test_packets_of_long_exposures_are_received(seed: int, number: int, n_packets: int) -> None:
    """The first shows less than two packets, so that longer ones fit its light as well, without a second header.

    Of the second, whose picture has much texture, wrong clocks fit as well until its slots are read.
    """
    packets = phones.packets_of({"seed": SEEDS_A_RUN * seed + number, "cae": "never"})["packets"]
    assert sum(packet["bit_errors"] == 0 for packet in packets) >= n_packets


def test_an_estimate_beyond_doubt_needs_no_packets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame, _ = _frame(tmp_path)
    first, other = _with_camera(frame, 1.13 * ROWS_PER_SLOT), _with_camera(frame, 0.7 * ROWS_PER_SLOT)
    assert _chosen(frame, Cameras(first, (other,), sure=True), monkeypatch) is first
    assert "no packet header" in _why_none(frame, Cameras(first, (other,)), monkeypatch)


def test_without_headers_nothing_is_chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame, _ = _frame(tmp_path)
    found = Cameras(None, (_with_camera(frame, 1.13 * ROWS_PER_SLOT),), "too dark")
    assert _why_none(frame, found, monkeypatch) == "too dark"


def test_an_estimate_without_a_lock_is_none_where_it_has_rivals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame, _ = _frame(tmp_path)
    right, wrong = _with_camera(frame, ROWS_PER_SLOT), _with_camera(frame, 1.13 * ROWS_PER_SLOT)
    monkeypatch.setattr(unknown_camera, "quick_look", lambda *_: Failure("no_signal", "nothing there"))
    assert _chosen(frame, Cameras(right), monkeypatch) is right
    assert "no packet header" in _why_none(frame, Cameras(right, (wrong,)), monkeypatch)


def test_packets_are_seen_on_their_own_clock_alone(tmp_path: Path) -> None:
    frame, _ = _frame(tmp_path)
    clocks = (ROWS_PER_SLOT, 1.004 * ROWS_PER_SLOT)
    right, wrong = (unknown_camera._initial_evidence(_with_camera(frame, rows)) for rows in clocks)
    assert right[0] > 100
    assert sum(wrong) < 0.8 * sum(right)


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
def test_a_picture_whose_values_follow_light_is_read_as_one(tone: Tone, monkeypatch: pytest.MonkeyPatch) -> None:
    trial, frame = _small_phone(tone)
    options = ReceiverOptions(cameras=(), corners=trial.corners, cae="never")
    read: list[str] = []

    def noting_the_tone(context: FrameContext) -> Acquisition | Failure:
        read.append(context.camera.tone)
        return quick_look(context)

    monkeypatch.setattr(unknown_camera, "quick_look", noting_the_tone)
    result = next(receive([frame], options))
    exponent, sd = result.estimated["tone_exponent"]
    assert abs(exponent - (1.0 if tone == "linear" else 2.2)) < 2 * sd
    assert ("linear" in read) == (tone == "linear")
    _, score = score_result(result, trial.truth)
    assert score.error_free >= 15
    profile = blind.camera_profile(result.estimated, "mine", None, None, frame.width, frame.height)
    assert profile.tone == ("linear" if tone == "linear" else "auto")
