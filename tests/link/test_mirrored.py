"""Mirrored pictures: texts and files say it themselves, front cameras may be mirrored, and a user may know it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_frames import N_COLUMNS, write_frame, write_profiles
from test_receiver import COLUMNS, clip

from rxcli.cli.main import run
from rxcli.link.collector import Collector
from rxcli.link.encoder import file_object, message
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.runs.api import Receiver
from rxcli.types import ColumnResult, Frame, FrameResult, FrameSoftBits, Metadata

SCREEN = load_profile("paper-34k6", ScreenProfile)


def result(soft: FrameSoftBits, mirrored: bool, source: str = "a") -> FrameResult:
    """A frame's result whose first column on the screen is weak, as a camera or a mirror shows it."""
    first = COLUMNS - 1 if mirrored else 0
    columns = tuple(ColumnResult(c, "weak" if c == first else "ok") for c in range(COLUMNS))
    soft = replace(soft, llr=soft.llr[:, :, ::-1] if mirrored else soft.llr, source=source)
    corners = np.array([[0, 0], [9, 0], [9, 5], [0, 5]], float)
    return FrameResult(
        source, 0, 0.0, "ok", screen_profile=SCREEN.name, corners=corners, columns=columns, soft_bits=soft
    )


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_text_says_whether_its_picture_is_mirrored(mirrored: bool) -> None:
    sending = message("hello")
    collector = Collector([SCREEN])
    [soft, *_] = clip(sending, 0, 1, np.random.default_rng(1))
    got = collector.add(result(soft, mirrored))
    assert [one.text for one in got.messages] == ["hello"]
    assert got.mirrored is mirrored
    assert [column.column for column in got.columns] == list(range(COLUMNS))
    assert got.columns[0].status == "weak"
    assert got.corners is not None
    assert got.corners[0, 0] == (9 if mirrored else 0)
    # What is known of one camera says nothing of another one.
    other = collector.add(result(replace(soft, llr=0 * soft.llr, epoch=1), False, "b"))
    assert other.columns[0].status == "weak"


def test_a_file_that_comes_only_mirrored_is_received() -> None:
    sending = file_object("a.txt", b"data" * 20)
    collector = Collector([SCREEN])
    got = [collector.add(result(soft, True)) for soft in clip(sending, 0, 60, np.random.default_rng(2))]
    [received] = [one for frame in got for one in frame.objects]
    assert received.data == b"data" * 20
    assert got[-1].mirrored


@pytest.mark.parametrize(
    ("metadata", "named"),
    [
        (Metadata(lens="iPhone 12 front camera 2.71mm f/2.2"), True),
        (Metadata(orientation=2), True),
        (Metadata(orientation=3, model="Frontier 9", lens="back camera"), False),
    ],
)
def test_a_front_camera_is_told_by_its_file(metadata: Metadata, named: bool) -> None:
    assert metadata.names_front_camera is named
    received = Receiver().decode(Frame(np.zeros((8, 8), np.uint8), "a", metadata=metadata))
    assert received.mirrored is (None if named else False)


def test_columns_count_from_the_right_on_request(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    payloads = write_frame(tmp_path / "a.png", 1)
    picture = cv2.imread(str(tmp_path / "a.png"))
    assert picture is not None
    cv2.imwrite(str(tmp_path / "a.png"), picture[:, ::-1])
    names = write_profiles(tmp_path)
    assert run(["decode", str(tmp_path / "a.png"), "--mirrored", *names]) == 0
    out = capsys.readouterr().out
    rows = [line.split() for line in out.splitlines() if line[:7].strip().isdigit()]
    assert [(row[0], row[-1]) for row in rows] == [(str(n), payloads[n]) for n in range(N_COLUMNS)]
    assert "The picture is mirrored: columns are counted from its right." in out
