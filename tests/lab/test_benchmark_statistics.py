"""Intervals, fits, fronts, tables and journals of the benchmark."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rxcli.errors import InputError
from rxcli.lab.benchmark.journal import Journal, Run, Task
from rxcli.lab.benchmark.statistics import cluster_interval, pareto_front, power_law, wilson
from rxcli.lab.benchmark.tables import format_table, to_csv, write_outputs


def test_wilson_agrees_with_published_values() -> None:
    # Newcombe, Stat. Med. 17, 857 (1998), table I, method 3.
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(15, 148) == pytest.approx((0.0624, 0.1605), abs=5e-5)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson(1, 29) == pytest.approx((0.0061, 0.1718), abs=5e-5)
    assert wilson(0, 0) == (0.0, 1.0)
    assert wilson(20, 20)[1] == 1.0


def test_wilson_covers_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    covered = [low <= 0.1 <= high for low, high in (wilson(int(k), 80) for k in rng.binomial(80, 0.1, 2000))]
    assert 0.93 < np.mean(covered) < 0.97


def test_clusters_widen_the_interval() -> None:
    apart = cluster_interval([5.0] * 8 + [6.0] * 8, [100.0] * 16, units=16)
    together = cluster_interval([0.0] * 14 + [44.0] * 2, [100.0] * 16, units=16)
    assert apart == pytest.approx(wilson(88, 1600))
    assert together[1] - together[0] > 3 * (apart[1] - apart[0])
    assert cluster_interval([0.0, 0.0], [1000.0, 1000.0], units=20) == wilson(0, 20)
    assert cluster_interval([], [], units=0) == (0.0, 1.0)


def test_power_law_finds_the_exponent() -> None:
    x = [2.0, 4.0, 8.0, 50.0]
    assert power_law(x, [3 * v**1.25 for v in x]) == pytest.approx(1.25)
    with pytest.raises(ValueError, match="positive"):
        power_law([1, 2], [0, 1])
    with pytest.raises(ValueError, match="two or more"):
        power_law([1, 1], [2, 3])


def test_pareto_front() -> None:
    assert pareto_front([(1, 5), (2, 2), (3, 2), (4, 1), (4, 3)]) == [True, True, False, True, False]
    assert pareto_front([(1, 1), (1, 1)]) == [True, True]


def test_tables_align_and_survive_csv(tmp_path: Path) -> None:
    rows = [{"name": "a", "rate": 0.00012345, "range": (0.0, 0.5)}, {"name": "bcd", "rate": None, "range": (0.25, 1.0)}]
    lines = format_table(rows).splitlines()
    assert lines[2].split() == ["a", "0.000123", "0..0.5"]
    assert lines[3].split() == ["bcd", "-", "0.25..1"]
    assert to_csv(rows).splitlines() == ["name,rate,range_low,range_high", "a,0.00012345,0.0,0.5", "bcd,,0.25,1.0"]
    _, as_json = write_outputs(tmp_path / "new", "x", rows, {"more": 1})
    assert json.loads(as_json.read_text())["details"] == {"more": 1}
    assert format_table([]) == "(nothing to show)"


def _double(task: Task) -> dict[str, Any]:
    _double_calls.append(task["n"])
    return {"twice": 2 * task["n"]}


_double_calls: list[int] = []


def test_an_interrupted_run_goes_on(tmp_path: Path) -> None:
    _double_calls.clear()
    path = tmp_path / "run" / "journal.jsonl"
    tasks: list[Task] = [{"n": n} for n in range(4)]
    Run(Journal(path), quiet=True).tasks("double", tasks[:3], _double)
    with path.open("a") as file:
        file.write('{"key": "half a li')  # as a killed process leaves it
    records = Run(Journal(path), quiet=True).tasks("double", tasks, _double)
    assert [record["twice"] for record in records] == [0, 2, 4, 6]
    assert _double_calls == [0, 1, 2, 3]
    assert len(Journal(path)._records) == 4


def test_a_file_that_is_no_journal_is_told(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    path.write_text("no journal\n")
    with pytest.raises(InputError, match="line 1 is no journal entry"):
        Journal(path)
