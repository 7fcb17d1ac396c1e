"""Two checkouts on the same files: what is the same, what differs and where, and how long either took."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from rxcli.cli.benchmark import benchmark
from rxcli.errors import ReceiverError, UsageError
from rxcli.lab.benchmark import compare
from rxcli.lab.benchmark.compare import Comparison, Decoded, Job


def compared(before: list[object], now: list[object], codes: tuple[int, int] = (0, 0)) -> Comparison:
    return Comparison(Job("captures", Path("a.jpg")), Decoded(now, 1.0, codes[1]), Decoded(before, 2.0, codes[0]))


@pytest.mark.parametrize(
    ("before", "now", "difference"),
    [
        ([{"a": [1, 2.5]}], [{"a": [1, 2.5]}], None),
        ([{"a": [1, 2.5]}], [{"a": [1, 2.5000001]}], "[0].a[1]: 2.5 -> 2.5000001"),
        ([{"a": 1}], [{"a": 1, "b": 2}], "[0].b: null -> 2"),
        ([{"a": [1]}], [{"a": [1, 2]}], "[0].a: [1] -> [1, 2]"),
        ([{"a": 1}], [{"a": True}], "[0].a: 1 -> true"),
        ([], [{}], ": [] -> [{}]"),
    ],
)
def test_the_first_difference_is_named(before: list[object], now: list[object], difference: str | None) -> None:
    assert compared(before, now).difference == difference


def test_another_exit_code_is_a_difference() -> None:
    assert compared([], [], (0, 1)).difference == "exit code: 0 -> 1"


def test_rows_count_and_add_up() -> None:
    found = [compared([{"columns": [{"packets": [1, 2]}]}] * 2, [{"columns": [{"packets": [1, 2]}]}]), compared([], [])]
    (group, total) = compare.rows(found)
    assert (group["files"], total["files"]) == ("captures", "all")
    assert (group["n"], group["same"], group["packets"]) == (2, 1, 2)
    assert group["cpu_ratio"] == pytest.approx(0.5)
    assert [row["file"] for row in compare.differing(found)] == ["a.jpg"]


def test_what_is_no_checkout_is_told(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no checkout of this project"):
        compare.check_checkout(tmp_path)


def test_a_checkout_that_breaks_off_is_told(tmp_path: Path) -> None:
    package = tmp_path / "rxcli" / "cli"
    package.mkdir(parents=True)
    (package.parent / "__init__.py").touch()
    (package / "__init__.py").touch()
    (package / "main.py").write_text("raise RuntimeError('out of order')\n")
    with pytest.raises(ReceiverError, match="out of order"):
        compare.compare([], compare.this_checkout(), compare.check_checkout(tmp_path), 1)


def test_a_changed_receiver_is_found_out(tmp_path: Path) -> None:
    """A copy of this checkout that rounds confidences differently, on one random scene and one phone."""
    here, other = compare.this_checkout(), tmp_path / "other"
    for name in ("rxcli", "calibration", "models"):
        shutil.copytree(here / name, other / name, ignore=shutil.ignore_patterns("__pycache__"))
    arguments = ["compare", str(other), "--captures", str(tmp_path / "none"), "--scenes", "1", "--phones", "1"]
    arguments += ["--repeats", "1", "--seed", "9", "--out", str(tmp_path / "out"), "--quiet"]
    (tmp_path / "none").mkdir()
    same = CliRunner().invoke(benchmark, arguments, standalone_mode=False)
    assert same.return_value == 0, same.output
    report = other / "rxcli" / "results" / "report.py"
    text = report.read_text()
    assert '"confidence": _rounded(packet.confidence, 6)' in text
    report.write_text(text.replace("packet.confidence, 6", "packet.confidence, 1"))
    changed = CliRunner().invoke(benchmark, arguments, standalone_mode=False)
    assert changed.return_value == 1, changed.output
    assert "confidence: " in changed.output
