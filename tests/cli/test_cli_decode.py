"""`vlc-rx decode` from end to end: small pictures in, tables, lines, files and exit codes out."""

import io
import json
import os
import sys
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from small_frames import N_COLUMNS, W, write_frame, write_profiles

from rxcli.cli.main import run
from rxcli.results.record import from_record
from rxcli.results.summary import SourceSummary
from rxcli.results.undistort import UndistortedWriter
from rxcli.types import ColumnResult, Frame, FrameResult, PacketResult

Decode = Callable[..., tuple[int, str, str]]
SAMPLES = Path(__file__).resolve().parents[2] / "sample_frames"
PHOTO = SAMPLES / "phone_chelsea_17k3.jpg"


@pytest.fixture
def decode(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Decode:
    """Run `vlc-rx decode` with the profiles of the small pictures; returns exit code, stdout and stderr."""
    profiles = tmp_path / "profiles"
    profiles.mkdir()
    names = write_profiles(profiles)

    def call(*arguments: object) -> tuple[int, str, str]:
        code = run(["decode", *map(str, arguments), *names])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


def without_times(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) | {"timing_ms": None} for line in text.splitlines()]


def test_a_table_for_people(tmp_path: Path, decode: Decode) -> None:
    payloads = write_frame(tmp_path / "a.png", 1)
    code, out, err = decode(tmp_path / "a.png", "--truth", "auto")
    assert (code, err) == (0, "")
    rows = [line.split() for line in out.splitlines()[2 : 2 + N_COLUMNS]]
    shown = [(row[0], row[1].removesuffix("*"), row[2], row[6], row[7]) for row in rows]  # *: by the auto-encoder
    assert shown == [(str(column), "ok", str(W), "0", payload) for column, payload in enumerate(payloads)]
    assert f"{N_COLUMNS} packets received ({N_COLUMNS} columns)" in out
    assert out.count("w: lit slots of ten") == 1


@pytest.mark.parametrize("name", ["a.png", "-"])
def test_lines_for_programs_and_nothing_else_on_stdout(
    name: str, tmp_path: Path, decode: Decode, monkeypatch: pytest.MonkeyPatch
) -> None:
    payloads = write_frame(tmp_path / "a.png", 2)
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO((tmp_path / "a.png").read_bytes())))
    with chdir(tmp_path):
        code, out, err = decode(name, "--json", "-")
    [record] = without_times(out)
    assert (code, record["source"]) == (0, name)
    assert [column["packets"][0]["payload"] for column in record["columns"]] == payloads
    assert record["columns"][0]["packets"][0]["bit_errors"] is None
    assert name in err  # the summary


def test_stdin_without_end_is_bounded(decode: Decode, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=SimpleNamespace(read=bytes)))
    monkeypatch.setattr("rxcli.cli.decoding.MAX_BYTES", 3_000_000)
    code, out, err = decode("-")
    assert (code, out) == (3, "")
    assert "stdin: more than 0.003 GB; name a file instead of -" in err


def test_a_failed_photo_says_why_once(tmp_path: Path, decode: Decode) -> None:
    (tmp_path / "b.png").write_bytes(b"")
    reason = "the file is empty (0 bytes); copy it from the camera again"
    code, out, _ = decode(tmp_path / "b.png")
    assert (code, out.count(reason.replace("; ", "\n  "))) == (3, 1)
    assert "w: lit slots of ten" not in out
    code, out, err = decode(tmp_path / "b.png", "--json", "-")
    assert (out.count(reason), err.count(reason)) == (1, 1)  # of which each may go elsewhere
    write_frame(tmp_path / "a.png", 2)
    assert decode(tmp_path, "--quiet") == (3, "", f"vlc-rx: {tmp_path / 'b.png'}: {reason}\n")


def test_a_folder_that_may_not_be_read_and_a_link_to_nowhere(
    tmp_path: Path, decode: Decode, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "in" / "shut").mkdir(parents=True)
    write_frame(tmp_path / "in" / "a.png", 2)
    (tmp_path / "in" / "b.png").symlink_to("gone.png")
    scan = os.scandir

    def refuse(path: Any) -> Any:
        if str(path).endswith("shut"):
            raise PermissionError(13, "Permission denied", path)
        return scan(path)

    monkeypatch.setattr(os, "scandir", refuse)  # permissions do not bind every user
    code, _, err = decode(tmp_path / "in", "--quiet")
    link, shut = err.splitlines()
    assert "b.png: is a link to gone.png, which is not there; name the file itself, or mend the link" in link
    assert "shut: the folder may not be read (Permission denied)" in shut
    assert code == 3


def test_packets_below_the_asked_confidence_do_not_count_and_are_told(tmp_path: Path, decode: Decode) -> None:
    write_frame(tmp_path / "a.png", 1)
    path = tmp_path / "a.png"
    code, out, _ = decode(path, "--json", "-")
    sure = [column["packets"][0]["confidence"] for column in json.loads(out)["columns"]]
    assert code == 0
    least = (min(sure) + max(sure)) / 2
    n_sure = sum(value >= least for value in sure)
    assert 0 < n_sure < N_COLUMNS
    code, out, _ = decode(path, "--min-confidence", least)
    assert code == 0
    assert f"{n_sure} packet" in out
    assert f"below the {least:g} asked for (--min-confidence)" in out
    assert decode(path, "--min-confidence", least, "--min-packets", n_sure + 1)[0] == 1


def test_what_fails_a_file_is_named_with_all_reasons(tmp_path: Path, decode: Decode) -> None:
    write_frame(tmp_path / "a.png", 1)
    path, junit, told = tmp_path / "a.png", tmp_path / "j.xml", tmp_path / "a.truth.json"
    (tmp_path / "b.png").write_bytes(path.read_bytes())
    assert decode(path, "--truth", told, "--max-ber", "0", "--min-packets", N_COLUMNS)[0] == 0
    assert decode(path, "--min-packets", 99, "--min-packet-confidence", 1, "--junit", junit)[0] == 1
    [[[failure, _]]] = ElementTree.parse(junit).getroot()
    assert "99 were asked for; a packet has a confidence of" in failure.get("message", "")
    truth = json.loads(told.read_text())
    payloads = truth["payload"]["0"]
    payloads[3] = f"{int(payloads[3], 16) ^ 7 << 37:010x}"
    payloads[5] = f"{int(payloads[5], 16) ^ 0xFFFFFFFFFF:010x}"
    told.write_text(json.dumps(truth))
    faults = "column 3 burst 0 (3 wrong bits), column 5 burst 0 (lost)"
    code, out, _ = decode(path, "--truth", "auto", "--max-ber", "1e-3", "--junit", junit)
    assert code == 1
    assert f"is above 0.001: {faults}" in " ".join(out.split())
    [[[failure, _]]] = ElementTree.parse(junit).getroot()
    assert faults in failure.get("message", "")
    assert failure.text == faults.replace(", ", "\n")
    truth["frames"][0]["bursts"][0]["visible_slots"] = 70.0
    told.write_text(json.dumps(truth))
    for name, reason in (("a", "the truth shows no burst for 1.02 packet lengths"), ("b", "no truth to hold the bit")):
        code, out, _ = decode(tmp_path / f"{name}.png", "--truth", "auto", "--max-ber", "1e-3")
        assert code == 1
        assert reason in " ".join(out.split())


def test_packets_are_remembered_for_a_baseline_alone() -> None:
    """A camera sends a thousand a second, for days."""
    column = ColumnResult(0, "ok", packets=(PacketResult(0.0, 2.0, 8, "ab", 0.99, 1e-3),))
    for payloads, remembered in (None, None), (set[tuple[int, str]](), {(0, "ab")}):
        counted = SourceSummary("a", payloads=payloads)
        counted.add(FrameResult("a", 0, 0.0, "ok", columns=(column,)))
        assert counted.payloads == remembered


def test_a_run_is_held_against_an_earlier_one(tmp_path: Path, decode: Decode) -> None:
    pictures, base = (tmp_path / "a.png", tmp_path / "b.png"), tmp_path / "base.jsonl"
    for number, picture in enumerate(pictures):
        write_frame(picture, number)
    against = ("--baseline", base, "--slower", 1000)
    assert decode(*pictures, "--json", base)[0] == 0
    again = (*pictures, "--json", tmp_path / "again.jsonl", *against, "--quiet")
    assert decode(*again) == (0, "", "")
    assert decode(*again, "--resume") == (0, "", "")  # packets of the earlier part count
    code, out, _ = decode(pictures[0], *against)
    assert code == 1
    ending = "in the baseline, and not in this run"
    assert [line.split("  ")[0] for line in out.splitlines() if line.endswith(ending)] == [str(pictures[1])]
    line = base.read_text().splitlines()[0]
    base.write_text(line.replace(json.loads(line)["columns"][3]["packets"][0]["payload"], "00" * 5))
    code, out, _ = decode(pictures[0], *against)
    assert code == 1
    assert "1 packet of the baseline lost (column 3)" in out
    base.write_text(json.dumps(json.loads(line) | {"timing_ms": {"total": -1e9}}) + "\n")
    assert "times the baseline's" in decode(pictures[0], *against)[1]
    place = '{"source": "a", "timing_ms": {}, "columns": [{"column": %s, "packets": [{"payload": "aa"}]}]}'
    for text in ("{}", *(place % column for column in ("1e999", "[]", '"x"'))):
        base.write_text(text + "\n")
        code, _, err = decode(pictures[0], *against)
        assert code == 2
        assert "base.jsonl line 1: no result of `vlc-rx decode --json`" in err


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: np.zeros((600, 800), np.uint8), "is black\n  raise ISO"),
        (lambda: np.full((600, 800), 255, np.uint8), "is saturated\n  expose shorter"),
        (lambda: np.zeros((60, 80), np.uint8), "use the picture in its full size"),
    ],
)
def test_advice_is_by_what_was_seen(make: Any, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), make())
    assert run(["decode", str(tmp_path / "a.png")]) == 1
    said = capsys.readouterr().out
    assert told in said
    assert "--corners" not in said


def test_a_frame_without_a_profile_waits_for_the_lens_that_is_estimated(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A line that the lens has bent comes out straight; where nothing is estimated, a warning says so."""
    width, height, k1 = 640, 480, -0.3
    points = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 1, 2).astype(np.float64)
    matrix = np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1]], np.float64)
    ideal_y = cv2.undistortPoints(points, matrix, np.array([k1, -k1, 0, 0, 0]), P=matrix)[:, 0, 1]
    bent = np.where(ideal_y.reshape(height, width) < 60, 30, 220).astype(np.uint8)
    estimated = {"line_delay_s": (1e-5, 1e-9), "k1": (k1, 0.0), "k2": (-k1, 0.0), "distortion_corrected": (0.0, 0.0)}
    writer = UndistortedWriter(tmp_path, ())
    for index in range(2):
        writer(Frame(bent, "a.png", index=index))
    assert list(tmp_path.iterdir()) == []
    writer.finish(FrameResult("a.png", 0, 0.0, "ok", estimated=estimated))
    writer.finish(FrameResult("a.png", 1, 0.0, "no_screen"))
    [path] = tmp_path.iterdir()
    assert path.name == "a.png.00000.png"
    assert "none could be estimated" in caplog.text
    edges = [np.ptp(np.argmax(picture > 125, axis=0)) for picture in (bent, cv2.imread(str(path), 0))]
    assert edges[0] >= 6
    assert edges[1] <= 1


def test_a_photo_that_was_turned_is_received_and_the_json_says_how(tmp_path: Path) -> None:
    picture, out, again = tmp_path / "a.png", tmp_path / "a.jsonl", tmp_path / "page"
    cv2.imwrite(str(picture), np.rot90(cv2.imread(str(PHOTO), cv2.IMREAD_GRAYSCALE)))
    screen = ["--screen", "paper-17k3"]
    assert run(["decode", str(picture), *screen, "--json", str(out), "--save-camera", str(tmp_path / "a.toml")]) == 0
    result = from_record(json.loads(out.read_text()))
    assert (result.quarter_turns, len(result.packets)) == (3, 20)
    assert 'name = "4032x3024"' in (tmp_path / "a.toml").read_text()
    assert run(["inspect", str(picture), *screen, "--out", str(again)]) == 0


def test_an_estimated_camera_is_kept_as_a_profile(tmp_path: Path) -> None:
    """What was estimated of a camera receives the same picture again, as well as it did."""
    profile, again = tmp_path / "my phone.toml", tmp_path / "again.jsonl"
    screen = ["--screen", "paper-17k3", "--truth", str(PHOTO).replace(".jpg", ".truth.json"), "--max-ber", "0.01"]
    assert run(["decode", str(PHOTO), *screen, "--quiet", "--camera", "auto", "--save-camera", str(profile)]) == 0
    assert 'name = "my-phone"' in profile.read_text()
    assert run(["decode", str(PHOTO), *screen, "--quiet", "--camera", str(profile), "--json", str(again)]) == 0
    assert json.loads(again.read_text())["camera"]["profile"] == "my-phone"


def test_a_camera_is_not_kept_where_nothing_was_received(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The lower part of the picture is lost: no packet shows, so that the estimate may be wrong."""
    picture, profile, out = tmp_path / "a.png", tmp_path / "mine.toml", tmp_path / "out.jsonl"
    write_frame(picture, 1)
    pixels = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
    pixels[300:] = 8
    cv2.imwrite(str(picture), pixels)
    screen, name, _, _, *corners = write_profiles(tmp_path)
    options = [screen, name, *corners, "--json", str(out), "--save-camera", str(profile)]
    assert run(["decode", str(picture), "--quiet", "--camera", "auto", *options]) == 1
    record = json.loads(out.read_text())
    assert "line_delay_s" in record["estimated"]
    assert "only the screen small was tried (--screen auto tries all)" in record["message"]
    assert "no packet was received with an estimated camera" in capsys.readouterr().err
    assert not profile.exists()


def test_a_photo_of_less_than_a_packet_that_gives_its_text_is_a_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photo = str(tmp_path / "fast.jpg")
    sent = ["--screen", "data-17k3", "--text", "hello", "--readout", "5.1e-3", "--exposure-slots", "0.8"]
    run(["simulate", photo, "--preset", "phone-plain", "--scale", "0.3", "--keep-readout", *sent])
    assert run(["decode", photo, "--expect-text", "hello"]) == 0
    heading = f"{photo} | ok | screen data-17k3 | camera unknown | "
    assert capsys.readouterr().out.startswith(f"text: hello\n{heading}")
    assert run(["inspect", photo, "--out", str(tmp_path / "page")]) == 0
