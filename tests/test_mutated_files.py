"""The program that mutates files: the same seed makes the same case, and what goes wrong is named by its seed."""

import random
from pathlib import Path

import cv2
import mutated_files
import numpy as np
import pytest

from rxcli.cli.main import run


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory) -> mutated_files.Cases:
    return mutated_files.Cases(tmp_path_factory.mktemp("cases"))


def test_unharmed_samples_are_received(cases: mutated_files.Cases, capsys: pytest.CaptureFixture[str]) -> None:
    """What is mutated must be good at first, or nothing is tried beyond the first check."""
    path = cases.folder / "sample.png"
    path.write_bytes(cases.samples["known/a.png"])
    assert run(["decode", str(path), *cases.pictures["known"].options]) == 0
    assert "10 packets received (10 columns)" in capsys.readouterr().out
    rng = random.Random(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mutated_files, "_mutated_text", lambda data, _rng: data)
        for kind in ("screen", "camera", "truth", "journal", "baseline", "config", "gyroflow"):
            assert run(cases.arguments(kind, rng)) == 0, kind


def test_what_goes_wrong_is_a_problem_with_its_seed(
    cases: mutated_files.Cases, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mutated_files, "peak_memory_mb", lambda: 100.0)  # This process has run other tests.
    assert cases.run(1)["problems"] == []
    monkeypatch.setattr(mutated_files, "_call", lambda *_: (1, "vlc-rx: internal error (IndexError: 5)"))
    [(problem, seeds)] = mutated_files.problems_of([cases.run(7)]).items()
    assert "internal error (IndexError: 5)" in problem
    assert seeds == [7]


# What mutated files have found, as small as it gets.


def _outcome(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert run(["decode", *arguments]) in (1, 3)
    said = capsys.readouterr()
    assert "internal error" not in said.out + said.err
    return said.out


@pytest.mark.parametrize("height", [1, 2, 24, 47, 66])
def test_few_rows_are_no_reason_for_an_error(height: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The search for curved stripes compared more rows than there were."""
    rows = np.repeat(np.random.default_rng(height).integers(0, 2, -(-height // 3)) * 180 + 30, 3)[:height]
    flat = np.repeat(rows[:, None], 300, axis=1).astype(np.uint8)
    for name, picture in (("flat.png", flat), ("narrow.png", np.ascontiguousarray(flat.T))):
        assert cv2.imwrite(str(tmp_path / name), picture)
        _outcome([str(tmp_path / name), "--no-skip", "no_screen"], capsys)


def test_a_screen_of_more_columns_than_pixels_breaks_nothing(
    cases: mutated_files.Cases, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    screen = (cases.folder / "screen.toml").read_text().replace("columns = 10", "columns = 200")
    (tmp_path / "s.toml").write_text(screen.replace("light_spread = 0.45", "light_spread = 1e-6"))
    known = [option.replace("329,", "109,") for option in cases.pictures["known"].options]
    arguments = ["decode", str(cases.folder / "good1.png"), *known[2:], "--screen", str(tmp_path / "s.toml")]
    assert run(arguments) in (0, 1)
    assert "internal error" not in capsys.readouterr().err
