"""Clips whose camera nobody told: chosen, refitted and remembered as of photographs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rxcli.options import ReceiverOptions
from rxcli.receiver import camera_memory, cameras
from rxcli.receiver.context import Camera
from rxcli.receiver.pipeline import receive
from rxcli.types import Frame, Metadata
from tests.receiver.test_video import Clip, scored, simulate

N_FRAMES = 5


@pytest.fixture(scope="module")
def clip() -> Clip:
    made = simulate(8, N_FRAMES)
    named = tuple(replace(frame, metadata=Metadata("Maker", "One")) for frame in made.frames)
    return replace(made, frames=named)


def _unknown(clip: Clip, folder: Path | None = None) -> ReceiverOptions:
    return replace(clip.options, cameras=(), force_camera=False, camera_cache=folder)


def _line_delay_s(clip: Clip) -> float:
    assert clip.truth.camera is not None
    return float(clip.truth.camera["line_delay_s"])


def test_the_camera_is_estimated_once_and_refitted(clip: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Frame] = []
    find = cameras.find_cameras

    def counted(frame: Frame, *rest: object, **named: str) -> cameras.Cameras:
        asked.append(frame)
        return find(frame, *rest, **named)  # type: ignore[arg-type]

    monkeypatch.setattr("rxcli.receiver.unknown_camera.find_cameras", counted)
    results, score = scored(list(receive(clip.frames, _unknown(clip))), clip.truth)
    assert len(asked) == 1
    known = scored(list(receive(clip.frames, clip.options)), clip.truth)[1]
    assert score.error_free >= 0.95 * known.error_free > 60
    assert score.false == 0
    assert results[-1].line_delay_s == pytest.approx(_line_delay_s(clip), rel=1e-3)
    assert results[-1].estimated == results[0].estimated


def test_the_camera_is_remembered_for_the_next_clip(clip: Clip, tmp_path: Path) -> None:
    first = list(receive(clip.frames, _unknown(clip, tmp_path)))
    kept = camera_memory.recall(tmp_path, clip.frames[0])
    assert kept is not None
    assert kept.estimated["line_delay_s"][0] == pytest.approx(_line_delay_s(clip), rel=1e-3)
    again = list(receive(clip.frames, _unknown(clip, tmp_path)))
    assert scored(again, clip.truth)[1].error_free >= scored(first, clip.truth)[1].error_free - 2


def test_a_remembered_camera_that_does_not_fit_is_replaced(clip: Clip, tmp_path: Path) -> None:
    estimated = {"line_delay_s": (1.3 * _line_delay_s(clip), 1e-9), "readout_reversed": (0.0, 0.0)}
    estimated |= {"distortion_corrected": (0.0, 0.0), "k1": (0.0, 0.01)}
    camera = Camera(None, estimated["line_delay_s"][0], 1e-5, None, "srgb", estimated=estimated)
    camera_memory.remember(tmp_path, clip.frames[0], camera)
    score = scored(list(receive(clip.frames, _unknown(clip, tmp_path))), clip.truth)[1]
    assert score.error_free > 60
    kept = camera_memory.recall(tmp_path, clip.frames[0])
    assert kept is not None
    assert kept.estimated["line_delay_s"][0] == pytest.approx(_line_delay_s(clip), rel=1e-3)
