"""The command that mutates files: the same seed makes the same case, and what goes wrong is named by its seed."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from rxcli.cli.main import run
from rxcli.lab.benchmark import readers


def test_the_same_seed_makes_the_same_case() -> None:
    data = bytes(range(256)) * 20
    cases = [readers.mutated(data, random.Random(seed)) for seed in range(50)]
    assert cases == [readers.mutated(data, random.Random(seed)) for seed in range(50)]
    assert sum(case != data for case in cases) > 45


def test_what_goes_wrong_is_a_problem_with_its_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cases = readers.Cases(tmp_path, lambda arguments: int(run(arguments)))
    assert cases.run(1)["problems"] == []
    monkeypatch.setattr(readers, "_call", lambda *_: (1, "vlc-rx: internal error (IndexError: 5)"))
    record = cases.run(7)
    verdict = readers.Verdict()
    verdict.add(record)
    [(problem, seeds)] = verdict.problems.items()
    assert "internal error (IndexError: 5)" in problem
    assert seeds == [7]


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["benchmark", "stability", "--readers", "3", "--seed", "2", "--out", str(tmp_path)]
    assert run(command) == 0
    assert "3 cases with seeds from 2000000 on" in capsys.readouterr().out


@pytest.mark.parametrize("seed", [77000206, 77000377])
def test_a_clock_that_runs_away_is_no_clock(seed: int, tmp_path: Path) -> None:
    """Least squares on damaged pictures went to negative periods, or out of the picture, and ended in an error."""
    assert readers.Cases(tmp_path, lambda arguments: int(run(arguments))).run(seed)["problems"] == []
