"""A small folder of good and bad files, a run that is killed, and a clip without end."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from mixed_folder import BAD, Contents, Outcome, make_folder, passed, reasons, run

from rxcli.errors import UsageError
from rxcli.ingest import open_source
from rxcli.lab.benchmark.media import repeat_clip

N_GOOD = 12


@pytest.fixture(scope="module")
def contents(tmp_path_factory: pytest.TempPathFactory) -> Contents:
    return make_folder(tmp_path_factory.mktemp("folder"), N_GOOD, len(BAD))


def test_the_folder_is_mixed_and_every_good_file_has_its_truth(contents: Contents) -> None:
    assert len({path.suffix for path in contents.good}) == 7
    assert all(path.with_name(path.stem + ".truth.json").is_file() for path in contents.good)
    assert len({path.read_bytes() for path in contents.bad}) == len(BAD) - 1  # two are empty


def test_what_is_there_is_kept(contents: Contents) -> None:
    before = [path.stat().st_mtime_ns for path in contents.good]
    assert make_folder(contents.folder, N_GOOD, len(BAD)) == contents
    assert [path.stat().st_mtime_ns for path in contents.good] == before


@pytest.mark.slow
def test_killed_and_resumed_runs_give_the_same_results(contents: Contents, tmp_path: Path) -> None:
    outcomes = run(contents, tmp_path, n_kills=3, workers=(2,))
    assert [outcome.n_kills for outcome in outcomes] == [0, 3]
    assert passed(contents, outcomes), [outcome.as_row() for outcome in outcomes]
    told = {row["file"]: row["reason"] for row in reasons(contents, tmp_path, workers=2)}
    assert len(told) == len(BAD)
    assert "the file is empty" in told["bad-00-empty.jpg"]
    assert "the picture is black" in told["monday/bad-17-black.png"]


@pytest.mark.parametrize(
    "change", [{"n_good": N_GOOD - 1}, {"n_reasons": 0}, {"same": False}, {"exit_code": 0}], ids=lambda c: next(iter(c))
)
def test_a_run_that_misses_anything_does_not_pass(contents: Contents, change: dict[str, int]) -> None:
    good = {"n_good": N_GOOD, "n_reasons": len(BAD), "same": True, "exit_code": 3}
    values = {"label": "run", "n_kills": 0, "n_lines": 9, "wall_s": 1.0}
    assert passed(contents, [Outcome(**good, **values)])
    assert not passed(contents, [Outcome(**{**good, **change}, **values)])


def test_bad_files_need_good_ones_to_be_made_of(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"made of 12 good ones \(got 3\)"):
        make_folder(tmp_path, 3, 1)


def test_a_clip_written_several_times_over_is_one_clip(contents: Contents, tmp_path: Path) -> None:
    short = next(path for path in contents.good if path.suffix == ".mp4")
    out = tmp_path / "long.mp4"
    repeat_clip(short, out, 3)
    once, thrice = list(open_source(short)), list(open_source(out))
    assert len(thrice) == 3 * len(once)
    steps = {round(b.time_s - a.time_s, 4) for a, b in pairwise(thrice)}
    assert len(steps) == 1
    for number, frame in enumerate(thrice):
        assert (frame.pixels == once[number % len(once)].pixels).all()
