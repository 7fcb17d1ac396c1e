"""Column numbers that a picture leaves open, shifted or mirrored: texts and files decide, or a user knows."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_frames import N_COLUMNS, write_frame, write_profiles
from test_receiver import COLUMNS, clip

from rxcli.cli.main import run
from rxcli.lab.benchmark.goodput import detect
from rxcli.link.collector import Collector, PhotoCollector
from rxcli.link.encoder import file_object, message
from rxcli.link.placement import Placement, possible_placements
from rxcli.link.receiver import LinkReceiver
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.runs.api import Receiver
from rxcli.types import ColumnResult, Frame, FrameResult, FrameSoftBits, Metadata, PacketResult, Remark

SCREEN = load_profile("paper-34k6", ScreenProfile)
NO = Placement()


PLACEMENTS = [Placement(mirrored, shift) for mirrored in (False, True) for shift in (-3, -1, 0, 2)]


def result(soft: FrameSoftBits, placement: Placement = NO, source: str = "a") -> FrameResult:
    """A frame's result as a mirror or a wrong outline shows it; column 9 of the screen has a packet of its own."""
    soft = replace(soft, llr=placement.inverse.of(soft.llr), source=source)
    ninth = (COLUMNS - 1 - 9 if placement.mirrored else 9) + placement.inverse.shift
    packets = (PacketResult(0.0, 1.0, 8, "09", 0.4, 0.0),)
    columns = tuple(ColumnResult(c, "ok", packets=packets if c == ninth else ()) for c in range(COLUMNS))
    corners = np.array([[0, 0], [20, 0], [20, 10], [0, 10]], float)
    told = replace(FrameResult(source, 0, 0.0, "ok", columns=columns), column_certainty=0.5, column_offset=None)
    remarks = (Remark("not_believed"), Remark("column_numbers"))
    return replace(told, screen_profile=SCREEN.name, corners=corners, soft_bits=soft, remarks=remarks)


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_a_text_shows_how_the_columns_of_its_picture_lie(placement: Placement) -> None:
    collector = Collector([SCREEN])
    [soft, *_] = clip(message("hello"), 0, 1, np.random.default_rng(1))
    got = collector.add(result(soft, placement))
    assert [one.text for one in got.messages] == ["hello"]
    assert got.mirrored is placement.mirrored
    assert [column.column for column in got.columns] == list(range(COLUMNS))
    assert [column.column for column in got.columns if column.packets] == [9]
    unread = range(placement.shift) if placement.shift > 0 else range(COLUMNS + placement.shift, COLUMNS)
    assert [column.column for column in got.columns if column.reason == "not_read"] == list(unread)
    # What was uncertain by its number alone is certain.
    assert got.columns[9].packets[0].confidence == 0.8
    assert (got.column_certainty, got.column_offset, got.remarks) == (1.0, 0, (Remark("not_believed"),))
    left = -placement.shift if not placement.mirrored else COLUMNS + placement.shift
    assert got.corners[0].tolist() == pytest.approx([left, 0], abs=1e-4)
    # What is known of one camera says nothing of another one.
    other = collector.add(result(replace(soft, llr=0 * soft.llr, epoch=1), source="b"))
    assert other.columns[9].packets[0].confidence == 0.4


def test_the_outline_of_a_picture_without_packets_follows_its_text() -> None:
    [soft, *_] = clip(message("hello"), 0, 1, np.random.default_rng(1))
    got = Collector([SCREEN]).add(replace(result(soft, Placement(False, 2)), columns=()))
    assert got.columns == ()
    assert got.corners[0].tolist() == pytest.approx([-2, 0], abs=1e-4)


def test_the_first_of_several_photos_is_not_tried_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """It was tried alone before; with the second one it counts as ever."""
    add, tried, photos, rng = LinkReceiver.add, [], PhotoCollector([SCREEN]), np.random.default_rng(1)
    monkeypatch.setattr(LinkReceiver, "add", lambda self, soft: tried.append(soft.source) or add(self, soft))
    [soft, *_] = clip(message("z" * 190), 0, 1, rng)
    for name, symbols in (("a", slice(0, 10)), ("b", slice(8, 22))):
        llr = np.zeros_like(soft.llr[1:2])
        llr[:, symbols] = soft.llr[1:2, symbols]
        last = photos.add(result(replace(soft, burst=soft.burst[1:2], llr=llr), source=name))
        assert [one.text for one in last.messages] == ["z" * 190] * (name == "b")
        assert tried == {"a": [], "b": ["a", "b"]}[name]


def test_a_shift_never_leaves_out_a_column_that_carries_bits() -> None:
    llr = np.full((2, 3, COLUMNS, 7), 9.0)
    assert possible_placements(llr) == [[NO], [Placement(True)]]
    llr[..., :2, :] = llr[..., -1:, :] = 0.1
    *_, shifted = possible_placements(llr)
    left_free, right_free = 2, 1
    assert {p.shift for p in shifted if not p.mirrored} == {*range(-left_free, 0), *range(1, right_free + 1)}
    assert {p.shift for p in shifted if p.mirrored} == {*range(-right_free, 0), *range(1, left_free + 1)}


def test_photos_that_are_numbered_differently_add_up() -> None:
    rng, collector, came = np.random.default_rng(6), PhotoCollector([SCREEN]), []
    for placement in (NO, Placement(True), Placement(False, 2), Placement(False, -3), NO):
        llr = detect(message("z" * 150).labels(np.arange(1), COLUMNS, 24), 5, (9.0,) * COLUMNS, rng)
        llr[:, rng.permutation(24)[:14]] = llr[:, :, -3:] = llr[:, :, :3] = 0
        came.append(collector.add(result(FrameSoftBits(np.arange(1), llr), placement, source=str(placement))))
    assert not came[0].messages
    [*_, last] = came
    assert [one.text for got in came for one in got.messages] == ["z" * 150]
    assert [column.column for column in last.columns if column.packets] == [9]


@pytest.mark.parametrize("placement", [NO, Placement(True), Placement(False, -1), Placement(True, 2)])
def test_a_file_whose_columns_are_numbered_wrongly_is_received(placement: Placement) -> None:
    sending = file_object("a.txt", b"data" * 20)
    collector = Collector([SCREEN])
    got = [collector.add(result(soft, placement)) for soft in clip(sending, 0, 40, np.random.default_rng(2))]
    [received] = [one for frame in got for one in frame.objects]
    assert received.data == b"data" * 20
    assert got[-1].columns[9].packets


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
    cv2.imwrite(str(tmp_path / "a.png"), picture[:, ::-1])
    names = write_profiles(tmp_path)
    assert run(["decode", str(tmp_path / "a.png"), "--mirrored", *names]) == 0
    out = capsys.readouterr().out
    rows = [line.split() for line in out.splitlines() if line[:7].strip().isdigit()]
    assert [(row[0], row[-1]) for row in rows] == [(str(n), payloads[n]) for n in range(N_COLUMNS)]
    assert "The picture is mirrored: columns are counted from its right." in out
