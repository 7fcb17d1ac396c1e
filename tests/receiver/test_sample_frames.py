"""The shipped captures decode without naming a profile, each at least as well as its floor, and nothing is invented."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from rxcli.cli.main import run
from rxcli.errors import ExitCode
from rxcli.resources import data_dir

#: Packets that are expected, and that must at least be free of errors.
FLOORS = {
    "phone_chelsea_17k3.jpg": (20, 18),
    "video1080_chelsea_17k3.mp4": (360, 350),
    "xtrans_sky_17k3.dng": (20, 20),
}


def test_samples_decode(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    summary = tmp_path / "summary.csv"
    code = run(["decode", str(data_dir("sample_frames")), "--truth", "auto", "--summary", str(summary), "--quiet"])
    assert code == ExitCode.OK
    assert capsys.readouterr() == ("", "")
    rows = {Path(row["source"]).name: row for row in csv.DictReader(summary.read_text(encoding="utf-8").splitlines())}
    assert rows.keys() == FLOORS.keys()
    for name, (expected, floor) in FLOORS.items():
        found = {key: int(rows[name][key]) for key in ("expected", "error_free", "false", "wrong_w")}
        print(f"{name}: {found['error_free']} of {expected} error-free, {found['error_free'] - floor:+} to the floor")
        assert found["expected"] == expected
        assert found["error_free"] >= floor, name
        assert (found["false"], found["wrong_w"]) == (0, 0), name
