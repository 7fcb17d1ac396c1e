"""The benchmark's commands."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from rxcli.cli.benchmark import benchmark
from rxcli.lab.benchmark import plots
from rxcli.lab.benchmark.confidence import bin_outcomes
from rxcli.lab.benchmark.speed import Growth
from rxcli.lab.benchmark.sweeps import Outcome, PlanePoint, Point, Summary
from rxcli.results.truth import Score


def test_confidence_writes_table_and_details(tmp_path: Path) -> None:
    result = CliRunner().invoke(benchmark, ["confidence", "--frames", "1", "--seed", "2", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert "0.9-1.0" in result.output
    details = json.loads((tmp_path / "confidence.json").read_text())["details"]
    assert details["frames"] == 1
    assert (tmp_path / "confidence.journal.jsonl").read_text().count("\n") == 1


def test_confidence_counts_packets_of_earlier_journals_too(tmp_path: Path) -> None:
    entries = [
        {
            "key": str(number),
            "record": {"packets": [{"confidence": 0.95, "bit_errors": number, "evidence": [1.0, 2.0]}]},
        }
        for number in range(2)
    ]
    earlier = tmp_path / "phones.journal.jsonl"
    earlier.write_text("".join(json.dumps(entry) + "\n" for entry in entries))
    arguments = ["confidence", "--frames", "1", "--seed", "5", "--out", str(tmp_path)]
    alone = CliRunner().invoke(benchmark, arguments)
    both = CliRunner().invoke(benchmark, [*arguments, "--also", str(earlier)])
    assert alone.exit_code == both.exit_code == 0, both.output
    counts = [int(result.output.split(" packets of ")[0].splitlines()[-1]) for result in (alone, both)]
    assert counts[1] == counts[0] + 2
    # Their evidence is of other terms: an earlier receiver's journal has no say in the weights.
    told = [[line for line in result.output.splitlines() if "weights" in line] for result in (alone, both)]
    assert told[0] == told[1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["sweep", "--only", "nope"], "is not one of rate"),
        (["speed", "--medium", "nope"], "choose from: jpeg-26mp"),
        (["--quick", "confidence"], "stands alone"),
    ],
)
def test_mistakes_are_told(tmp_path: Path, arguments: list[str], message: str) -> None:
    result = CliRunner().invoke(benchmark, arguments)
    assert result.exit_code == 2
    assert message in result.output


def test_without_a_command_help_is_shown() -> None:
    result = CliRunner().invoke(benchmark, [])
    assert result.exit_code == 0
    assert "stability" in result.output


def test_plots_are_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    import numpy as np

    score = Score(expected=10, bits=770, error_free=9, bit_errors=5)
    points = [Point("rate", "a", 42.0), Point("rate", "b", 92.4, payload_symbols=11)]
    summaries = [Summary(p, m, (Outcome(score, 10, {"total": 5.0}),)) for p in points for m in ("receiver", "paper")]
    plots.plot_rates(summaries, tmp_path / "rates.png")
    plots.plot_sweep(summaries, tmp_path / "sweep.png")
    plots.plot_plane([PlanePoint("a", 3.0, 0.1, True), PlanePoint("b", 5.0, 0.0, True)], tmp_path / "plane.png")
    plots.plot_growth([Growth("columns", (20.0, 200.0), (5.0, 50.0))], tmp_path / "growth.png")
    plots.plot_confidence(bin_outcomes(np.array([0.2, 0.95]), np.array([False, True])), tmp_path / "confidence.png")
    for path in tmp_path.glob("*.png"):
        assert path.read_bytes().startswith(b"\x89PNG")
        assert path.stat().st_size > 5000
    assert len(list(tmp_path.glob("*.png"))) == 5
