"""The shipped captures decode without naming a profile, each at least as well as its floor, and nothing is invented."""

import csv
import json
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


def test_results_depend_on_neither_order_nor_workers_nor_earlier_runs(tmp_path: Path) -> None:
    """Byte for byte, but for the times: in two orders in one process, and with two workers."""
    samples = [str(data_dir("sample_frames") / name) for name in FLOORS]
    results = []
    for number, (order, workers) in enumerate([(samples, 1), (samples[::-1], 1), (samples, 2)]):
        out = tmp_path / f"{number}.jsonl"
        assert run(["decode", *order, "--json", str(out), "--quiet", "--workers", str(workers)]) == ExitCode.OK
        lines = [json.loads(line) for line in out.read_text(encoding="utf-8").splitlines()]
        assert lines[0].pop("run")  # the options, with the first line of a file
        assert all(line.pop("timing_ms") for line in lines)
        by_source = {source: [line for line in lines if line.get("source") == source] for source in samples}
        results.append(json.dumps(by_source))
    assert {len(json.loads(result)[samples[1]]) for result in results} == {24}
    assert len(set(results)) == 1
