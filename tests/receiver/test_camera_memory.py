"""Cameras that are remembered: what is kept, when it is used, and that it is replaced where it does not fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rxcli.ingest import open_source
from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile, parse_profile
from rxcli.receiver import camera_memory
from rxcli.receiver.context import Camera
from rxcli.receiver.pipeline import receive_frame
from rxcli.types import Frame, FrameResult, Metadata
from tests.small_frames import BOTTOM, LEFT, RIGHT, ROWS_PER_SLOT, SCREEN, TOP, write_frame

CORNERS = np.array([[LEFT, TOP], [RIGHT, TOP], [RIGHT, BOTTOM], [LEFT, BOTTOM]], float)


def _options(folder: Path | None) -> ReceiverOptions:
    screen = parse_profile(SCREEN, ScreenProfile, "small")
    return ReceiverOptions(screens=(screen,), cameras=(), corners=CORNERS, cae="never", camera_cache=folder)


def _frame(folder: Path, seed: int = 5, model: str | None = "One") -> Frame:
    path = folder / f"{seed}.png"
    write_frame(path, seed)
    return replace(next(iter(open_source(str(path)))), metadata=Metadata("Maker", model))


def _camera(line_delay_s: float, sd: float = 1e-9, k1: float = 0.1) -> Camera:
    estimated = {"line_delay_s": (line_delay_s, sd), "readout_reversed": (0.0, 0.0), "rows_per_slot": (3.0, 0.1)}
    estimated |= {"k1": (k1, 0.01), "k2": (-k1, 0.1), "distortion_corrected": (1.0, 0.0)}
    return Camera(None, line_delay_s, 1e-5, None, "srgb", estimated=estimated)


def _packets(result: FrameResult) -> list[str]:
    return [packet.payload for column in result.columns for packet in column.packets]


def test_the_second_picture_of_a_camera_is_not_estimated(tmp_path: Path) -> None:
    folder = tmp_path / "cache"
    first = receive_frame(_frame(tmp_path, 5), _options(folder))
    (kept,) = folder.glob("*.json")
    assert "Maker-One" in kept.name
    second = receive_frame(_frame(tmp_path, 6), _options(folder))
    anew = receive_frame(_frame(tmp_path, 6), _options(None))
    assert "blind" in first.timing_ms
    assert "blind" in anew.timing_ms
    assert _packets(second) == _packets(anew) != []
    assert second.estimated["rows_per_slot"][0] == pytest.approx(ROWS_PER_SLOT, rel=1e-3)
    assert second.estimated["line_delay_s"][0] == pytest.approx(anew.estimated["line_delay_s"][0], rel=1e-3)


def test_a_camera_that_does_not_fit_is_replaced(tmp_path: Path) -> None:
    frame, folder = _frame(tmp_path), tmp_path / "cache"
    line_delay_s = receive_frame(frame, _options(None)).estimated["line_delay_s"][0]
    camera_memory.remember(folder, frame, _camera(1.3 * line_delay_s))
    result = receive_frame(frame, _options(folder))
    assert _packets(result) == _packets(receive_frame(frame, _options(None))) != []
    found = camera_memory.recall(folder, frame)
    assert found is not None
    assert found.estimated["line_delay_s"][0] == pytest.approx(line_delay_s, rel=1e-3)


def test_pictures_add_up(tmp_path: Path) -> None:
    frame = _frame(tmp_path)
    for line_delay_s, sd, k1 in ((1e-5, 3e-9, 0.1), (1.0004e-5, 1e-9, 0.2)):
        camera_memory.remember(tmp_path, frame, _camera(line_delay_s, sd, k1))
    found = camera_memory.recall(tmp_path, frame)
    assert found is not None
    assert found.pictures == 2
    assert found.estimated["line_delay_s"][0] == pytest.approx(1.00036e-5, rel=1e-9)
    assert found.estimated["line_delay_s"][1] < 1e-9
    assert found.estimated["k1"][0] == pytest.approx(0.19)
    assert "rows_per_slot" not in found.estimated
    # Another line delay is another mode: nothing of the first is left.
    camera_memory.remember(tmp_path, frame, _camera(2e-5))
    again = camera_memory.recall(tmp_path, frame)
    assert again is not None
    assert again.pictures == 1


def test_other_cameras_and_unnamed_ones_are_not_recalled(tmp_path: Path) -> None:
    frame = _frame(tmp_path)
    camera_memory.remember(tmp_path, frame, _camera(1e-5))
    lens = replace(frame, metadata=replace(frame.metadata, focal_length_mm=2.2))
    assert camera_memory.recall(tmp_path, frame) is not None
    assert camera_memory.recall(tmp_path, lens) is None
    assert camera_memory.recall(tmp_path, _frame(tmp_path, model="Two")) is None
    unnamed = _frame(tmp_path, model=None)
    before = sorted(tmp_path.glob("*.json"))
    camera_memory.remember(tmp_path, unnamed, _camera(1e-5))
    assert sorted(tmp_path.glob("*.json")) == before
    assert camera_memory.recall(None, frame) is None


@pytest.mark.parametrize("content", [b"", b"{", b'{"format": 1}', b"\xff\x00"])
def test_a_broken_cache_is_none(tmp_path: Path, content: bytes) -> None:
    frame, folder = _frame(tmp_path), tmp_path / "cache"
    camera_memory.remember(folder, frame, _camera(1e-5))
    (path,) = folder.glob("*.json")
    path.write_bytes(content)
    assert camera_memory.recall(folder, frame) is None
    camera_memory.remember(folder, frame, _camera(1e-5))
    assert camera_memory.recall(folder, frame) is not None


def test_a_cache_that_cannot_be_written_is_none(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    frame = _frame(tmp_path)
    camera_memory.remember(tmp_path / "file", frame, _camera(1e-5))
    assert camera_memory.recall(tmp_path / "file", frame) is None


def test_forgetting_takes_all_away(tmp_path: Path) -> None:
    frame = _frame(tmp_path)
    camera_memory.remember(tmp_path / "cache", frame, _camera(1e-5))
    assert camera_memory.forget(tmp_path / "cache") == 1
    assert camera_memory.recall(tmp_path / "cache", frame) is None
    assert camera_memory.forget(tmp_path / "nowhere") == 0
