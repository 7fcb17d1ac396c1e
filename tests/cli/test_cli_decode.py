"""`vlc-rx decode` from end to end: small pictures in, tables, lines, files and exit codes out."""

from __future__ import annotations

import csv
import io
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from small_frames import N_COLUMNS, W, write_frame, write_profiles

from rxcli.cli.main import run
from rxcli.results.undistort import UndistortedWriter
from rxcli.types import Frame, FrameResult

Decode = Callable[..., tuple[int, str, str]]


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


def test_lines_for_programs_and_nothing_else_on_stdout(tmp_path: Path, decode: Decode) -> None:
    payloads = write_frame(tmp_path / "a.png", 2)
    code, out, err = decode(tmp_path / "a.png", "--json", "-")
    assert code == 0
    [record] = without_times(out)
    assert [column["packets"][0]["payload"] for column in record["columns"]] == payloads
    assert record["columns"][0]["packets"][0]["bit_errors"] is None
    assert "a.png" in err  # the summary


def test_quiet_says_nothing(tmp_path: Path, decode: Decode) -> None:
    write_frame(tmp_path / "a.png", 2)
    assert decode(tmp_path / "a.png", "--quiet") == (0, "", "")


def test_quiet_says_why_a_file_failed(tmp_path: Path, decode: Decode) -> None:
    write_frame(tmp_path / "a.png", 2)
    (tmp_path / "b.png").write_bytes(b"")
    told = f"vlc-rx: {tmp_path / 'b.png'}: the file is empty (0 bytes); copy it from the camera again\n"
    assert decode(tmp_path, "--quiet") == (3, "", told)


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
    assert code == 3
    link, shut = err.splitlines()
    assert "b.png: is a link to gone.png, which is not there; name the file itself, or mend the link" in link
    assert "shut: the folder may not be read (Permission denied)" in shut
    code, _, err = decode(tmp_path / "in" / "shut", "--quiet")
    assert (code, err) == (3, shut + "\n")


def test_odd_names_can_be_told_from_tables(tmp_path: Path, decode: Decode) -> None:
    names = ["line\nbreak.png", os.fsdecode(b"byte\xff.png"), "back\\nslash.png"]
    shown = ["line\\nbreak.png", "byte\\xff.png", "back\\\\nslash.png"]
    write_frame(tmp_path / "a.png", 2)
    for name in names:
        (tmp_path / name).write_bytes((tmp_path / "a.png").read_bytes())
    csv_files = ("--summary", tmp_path / "s.csv", "--payloads", tmp_path / "p.csv")
    code, out, _ = decode(*(tmp_path / name for name in names), *csv_files, "--junit", tmp_path / "j.xml")
    assert code == 0
    for file in ("s.csv", "p.csv"):
        rows = csv.DictReader(io.StringIO((tmp_path / file).read_text(encoding="utf-8")))
        assert list(dict.fromkeys(row["source"] for row in rows)) == [f"{tmp_path}/{name}" for name in shown]
    [suite] = ElementTree.parse(tmp_path / "j.xml").getroot()
    assert [case.get("name") for case in suite] == [f"{tmp_path}/{name}" for name in shown]
    assert all(f"{tmp_path}/{name}" in out for name in shown)


def test_a_picture_on_stdin(tmp_path: Path, decode: Decode, monkeypatch: pytest.MonkeyPatch) -> None:
    payloads = write_frame(tmp_path / "a.png", 3)

    class Stdin:
        buffer = io.BytesIO((tmp_path / "a.png").read_bytes())

    monkeypatch.setattr(sys, "stdin", Stdin)
    code, out, _ = decode("-", "--json", "-")
    [record] = without_times(out)
    assert (code, record["source"]) == (0, "-")
    assert record["columns"][1]["packets"][0]["payload"] == payloads[1]


def test_one_bad_file_never_stops_the_rest(tmp_path: Path, decode: Decode) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    write_frame(folder / "a.png", 1)
    (folder / "b.png").write_bytes(b"")
    (folder / "c.jpg").write_bytes(b"\xff\xd8\xff" + bytes(50))
    write_frame(folder / "d.png", 4)
    code, out, _ = decode(folder, tmp_path / "missing.png", "--json", "-")
    assert code == 3
    records = without_times(out)
    assert [record["status"] for record in records] == ["ok", "unreadable", "unreadable", "ok", "unreadable"]
    assert all(record["source"] in record["message"] for record in records if record["status"] == "unreadable")


def test_limits_for_continuous_integration(tmp_path: Path, decode: Decode) -> None:
    write_frame(tmp_path / "a.png", 1)
    path = tmp_path / "a.png"
    assert decode(path, "--truth", tmp_path / "a.truth.json", "--max-ber", "0")[0] == 0
    assert decode(path, "--min-packets", N_COLUMNS)[0] == 0
    assert decode(path, "--min-packets", N_COLUMNS + 1)[0] == 1
    truth = json.loads((tmp_path / "a.truth.json").read_text())
    truth["payload"]["0"][0] = f"{int(truth['payload']['0'][0], 16) ^ 1 << 39:010x}"
    (tmp_path / "a.truth.json").write_text(json.dumps(truth))
    code, out, _ = decode(path, "--truth", "auto", "--max-ber", "1e-3", "--junit", tmp_path / "j.xml")
    assert code == 1
    assert f"bit error rate {1 / (35 * N_COLUMNS):.3g} is above 0.001" in out
    [[case]] = ElementTree.parse(tmp_path / "j.xml").getroot()
    assert case.find("failure") is not None


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
    assert "uncertain" not in out
    assert decode(path, "--min-confidence", least, "--min-packets", n_sure + 1)[0] == 1
    code, out, _ = decode(path, "--min-packet-confidence", least)
    assert code == 1
    assert f"a packet has a confidence of {min(sure):.4g}, below {least:g}" in out


def test_what_is_wrong_is_named_by_column_burst_and_bits(tmp_path: Path, decode: Decode) -> None:
    write_frame(tmp_path / "a.png", 1)
    (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes())
    truth = json.loads((tmp_path / "a.truth.json").read_text())
    payloads = truth["payload"]["0"]
    payloads[3] = f"{int(payloads[3], 16) ^ 7 << 37:010x}"
    payloads[5] = f"{int(payloads[5], 16) ^ 0xFFFFFFFFFF:010x}"
    (tmp_path / "a.truth.json").write_text(json.dumps(truth))
    told = "column 3 burst 0 (3 wrong bits), column 5 burst 0 (lost)"
    code, out, _ = decode(tmp_path / "a.png", "--truth", "auto", "--max-ber", "1e-3", "--junit", tmp_path / "j.xml")
    assert code == 1
    assert f"is above 0.001: {told}" in " ".join(out.split())
    [[[failure, _]]] = ElementTree.parse(tmp_path / "j.xml").getroot()
    assert told in failure.get("message", "")
    assert failure.text == told.replace(", ", "\n")
    truth["frames"][0]["bursts"][0]["visible_slots"] = 70.0
    (tmp_path / "a.truth.json").write_text(json.dumps(truth))
    code, out, _ = decode(tmp_path / "a.png", "--truth", "auto", "--max-ber", "1e-3")
    assert code == 1
    assert "no bit error rate: the truth shows no burst for 1.02 packet lengths" in " ".join(out.split())
    code, out, _ = decode(tmp_path / "b.png", "--truth", "auto", "--max-ber", "1e-3")
    assert code == 1
    assert "no truth to hold the bit error rate against" in out


def test_a_case_has_one_failure_with_all_reasons(tmp_path: Path, decode: Decode) -> None:
    write_frame(tmp_path / "a.png", 1)
    decode(tmp_path / "a.png", "--min-packets", 99, "--min-packet-confidence", 1, "--junit", tmp_path / "j.xml")
    [[case]] = ElementTree.parse(tmp_path / "j.xml").getroot()
    failure, _ = case
    assert "99 were asked for; a packet has a confidence of" in failure.get("message", "")


def test_a_run_is_held_against_an_earlier_one(tmp_path: Path, decode: Decode) -> None:
    write_frame(tmp_path / "a.png", 1)
    base = tmp_path / "base.jsonl"
    assert decode(tmp_path / "a.png", "--json", base)[0] == 0
    assert decode(tmp_path / "a.png", "--baseline", base, "--slower", 1000)[0] == 0
    lines = base.read_text()
    other = lines.replace(json.loads(lines)["columns"][3]["packets"][0]["payload"], "00" * 5)
    base.write_text(other)
    code, out, _ = decode(tmp_path / "a.png", "--baseline", base, "--slower", 1000)
    assert code == 1
    assert "1 packet of the baseline lost (column 3)" in out
    record = json.loads(lines)
    record["timing_ms"] = {"total": 1e-3}
    base.write_text(json.dumps(record) + "\n")
    code, out, _ = decode(tmp_path / "a.png", "--baseline", base)
    assert code == (1 if "times the baseline's" in out else 0)
    record["timing_ms"] = {"total": -1e9}
    base.write_text(json.dumps(record) + "\n")
    assert decode(tmp_path / "a.png", "--baseline", base)[0] == 1
    write_frame(tmp_path / "b.png", 2)
    base.unlink()
    assert decode(tmp_path / "a.png", tmp_path / "b.png", "--json", base)[0] == 0
    code, out, _ = decode(tmp_path / "a.png", "--baseline", base, "--slower", 1000)
    assert code == 1
    assert [
        line.split("  ")[0] for line in out.splitlines() if line.endswith("in the baseline, and not in this run")
    ] == [str(tmp_path / "b.png")]
    more = ("--baseline", base, "--slower", 1000, "--quiet")
    again = (tmp_path / "a.png", tmp_path / "b.png", "--json", tmp_path / "again.jsonl", *more)
    assert decode(*again) == (0, "", "")
    assert decode(*again, "--resume") == (0, "", "")  # packets of the earlier part count
    base.write_text("{}\n")
    code, _, err = decode(tmp_path / "a.png", "--baseline", base)
    assert code == 2
    assert "base.jsonl line 1: no result of `vlc-rx decode --json`" in err


def test_a_legend_stands_under_the_tables(tmp_path: Path, decode: Decode) -> None:
    write_frame(tmp_path / "a.png", 1)
    assert decode(tmp_path / "a.png")[1].count("w: lit slots of ten") == 1
    (tmp_path / "b.png").write_bytes(b"")
    assert "lit slots of ten" not in decode(tmp_path / "b.png")[1]


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: np.zeros((600, 800), np.uint8), "is black; expose longer"),
        (lambda: np.full((600, 800), 255, np.uint8), "is saturated; expose shorter"),
        (lambda: np.zeros((60, 80), np.uint8), "use the picture in its full size"),
        (lambda: np.random.default_rng(1).integers(90, 99, (600, 800), np.uint8), "photograph a screen that sends"),
    ],
)
def test_advice_is_by_what_was_seen(make: Any, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), make())
    assert run(["decode", str(tmp_path / "a.png")]) == 1
    said = capsys.readouterr().out
    assert told in said
    assert "--corners" not in said


def test_advice_for_a_picture_turned_on_its_side(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sample = Path(__file__).resolve().parents[2] / "sample_frames" / "phone_chelsea_17k3.jpg"
    cv2.imwrite(str(tmp_path / "a.png"), np.rot90(cv2.imread(str(sample), cv2.IMREAD_GRAYSCALE)))
    assert run(["decode", str(tmp_path / "a.png")]) == 1
    assert "was turned by 90 degrees" in capsys.readouterr().out


def test_advice_where_the_wrong_screen_was_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    samples = Path(__file__).resolve().parents[2] / "sample_frames"
    named = ["--screen", "paper-34k6", "--camera", str(samples / "xs10-small.toml")]
    assert run(["decode", str(samples / "xtrans_sky_17k3.dng"), *named]) == 1
    assert "only the screen paper-34k6 was tried (--screen auto tries all)" in capsys.readouterr().out


def test_an_address_is_not_fetched(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["decode", "http://a.b/c.jpg"]) == 3
    assert "is an address, and nothing is fetched" in capsys.readouterr().out


def test_a_broken_truth_file_is_told_and_the_packets_are_still_there(tmp_path: Path, decode: Decode) -> None:
    write_frame(tmp_path / "a.png", 1)
    (tmp_path / "a.truth.json").write_text("{")
    code, out, _ = decode(tmp_path / "a.png", "--truth", "auto")
    assert code == 3
    assert f"{N_COLUMNS} packets received" in out
    assert "a.truth.json: cannot be read as truth" in out


def test_a_summary_file(tmp_path: Path, decode: Decode) -> None:
    write_frame(tmp_path / "a.png", 1)
    assert decode(tmp_path / "a.png", "--truth", "auto", "--summary", tmp_path / "s.csv")[0] == 0
    with (tmp_path / "s.csv").open(newline="") as file:
        [row] = csv.DictReader(file)
    assert (row["packets"], row["error_free"], row["ber"]) == (str(N_COLUMNS), str(N_COLUMNS), "0.0")


def test_undistorted_pictures_need_a_lens(tmp_path: Path, decode: Decode) -> None:
    write_frame(tmp_path / "a.png", 1)
    code, _, err = decode(tmp_path / "a.png", "--save-undistorted", tmp_path / "straight")
    assert code == 0
    assert "no camera profile with a lens fits" in err
    with (tmp_path / "profiles" / "camera.toml").open("a") as file:
        file.write(
            "\n[lens]\nwidth = 340\nheight = 620\ndist_coeffs = [-0.1, 0.0, 0.0, 0.0]\n"
            "camera_matrix = [[500.0, 0.0, 169.5], [0.0, 500.0, 309.5], [0.0, 0.0, 1.0]]\n"
        )
    decode(tmp_path / "a.png", "--save-undistorted", tmp_path / "straight")
    [straight] = (tmp_path / "straight").iterdir()
    assert straight.name == "a.png.00000.png"
    assert straight.read_bytes() != (tmp_path / "a.png").read_bytes()


def test_a_frame_without_a_profile_waits_for_the_lens_that_is_estimated(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A line that the lens has bent comes out straight; where nothing is estimated, a warning says so."""
    width, height, k1 = 640, 480, -0.3
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    matrix = np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1]], np.float64)
    points = np.stack([x, y], -1).reshape(-1, 1, 2)
    coefficients = np.array([k1, -k1, 0, 0, 0])
    ideal_y = cv2.undistortPoints(points, matrix, coefficients, P=matrix)[:, 0, 1].reshape(height, width)
    bent = np.where(ideal_y < 60, 30, 220).astype(np.uint8)
    estimated = {"line_delay_s": (1e-5, 1e-9), "k1": (k1, 0.0), "k2": (-k1, 0.0), "distortion_corrected": (0.0, 0.0)}
    writer = UndistortedWriter(tmp_path, ())
    frames = [Frame(bent, "a.png", index=index) for index in range(2)]
    for frame in frames:
        writer(frame)
    assert list(tmp_path.iterdir()) == []
    writer.finish(FrameResult("a.png", 0, 0.0, "ok", estimated=estimated))
    writer.finish(FrameResult("a.png", 1, 0.0, "no_screen"))
    [path] = tmp_path.iterdir()
    assert path.name == "a.png.00000.png"
    assert "none could be estimated" in caplog.text

    def border(picture: Any) -> Any:
        return np.argmax(picture > 125, axis=0)

    straight = border(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    assert np.ptp(border(bent)) >= 6
    assert np.ptp(straight) <= 1


def test_reference_photo(shared_captures: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo = shared_captures / "xs10_sky_34k6.jpg"
    code = run(["decode", str(photo), "--screen", "paper-34k6", "--truth", "auto", "--max-ber", "0"])
    assert "20 packets received (20 columns)" in capsys.readouterr().out
    assert code == 0


def test_an_estimated_camera_is_kept_as_a_profile(tmp_path: Path) -> None:
    """What was estimated of a camera receives the same picture again, as well as it did."""
    sample = Path(__file__).resolve().parents[2] / "sample_frames" / "phone_chelsea_17k3.jpg"
    profile, again = tmp_path / "my phone.toml", tmp_path / "again.jsonl"
    screen = ["--screen", "paper-17k3", "--truth", str(sample).replace(".jpg", ".truth.json"), "--max-ber", "0.01"]
    assert run(["decode", str(sample), *screen, "--quiet", "--camera", "auto", "--save-camera", str(profile)]) == 0
    assert 'name = "my-phone"' in profile.read_text()
    assert run(["decode", str(sample), *screen, "--quiet", "--camera", str(profile), "--json", str(again)]) == 0
    assert json.loads(again.read_text())["camera"]["profile"] == "my-phone"


def test_a_camera_is_not_kept_where_nothing_was_received(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The lower half of the picture is lost: no packet shows, so that no estimate can be believed."""
    sample = Path(__file__).resolve().parents[2] / "sample_frames" / "phone_chelsea_17k3.jpg"
    picture, profile, out = tmp_path / "part.png", tmp_path / "mine.toml", tmp_path / "out.jsonl"
    pixels = cv2.imread(str(sample), cv2.IMREAD_GRAYSCALE)
    assert pixels is not None
    pixels[1900:] = 0
    cv2.imwrite(str(picture), pixels)
    corners = ["--corners", "260,477", "3926,485", "3927,2636", "177,2499"]
    options = [*corners, "--json", str(out), "--save-camera", str(profile)]
    assert run(["decode", str(picture), "--quiet", "--camera", "auto", *options]) == 1
    assert "estimated" not in json.loads(out.read_text())
    assert "no packet was received with an estimated camera" in capsys.readouterr().err
    assert not profile.exists()


@pytest.mark.parametrize("column", ["1e999", "[]", '"x"'])
def test_a_baseline_of_impossible_numbers_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], column: str
) -> None:
    packet = '{"payload": "aa", "confidence": 1}'
    columns = f'[{{"column": {column}, "packets": [{packet}]}}]'
    (tmp_path / "old.jsonl").write_text(f'{{"source": "a", "columns": {columns}, "timing_ms": {{}}}}\n')
    write_frame(tmp_path / "a.png", 1)
    assert run(["decode", str(tmp_path / "a.png"), "--baseline", str(tmp_path / "old.jsonl")]) == 2
    assert "line 1: no result of" in capsys.readouterr().err
