"""How a run ends is told: exit codes, summaries and journals of runs that are interrupted, refused or cannot write."""

import csv
import hashlib
import json
import os
import resource
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from commands import COMMAND, ENVIRONMENT
from small_frames import write_frame, write_profiles

from rxcli.cli.main import run
from rxcli.runs.batch import Decoder
from rxcli.runs.journal import Journal
from rxcli.types import FrameResult, ReceivedObject

Decode = Callable[..., tuple[int, str]]


@pytest.fixture
def names(tmp_path: Path) -> list[str]:
    (tmp_path / "profiles").mkdir()
    return write_profiles(tmp_path / "profiles")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three pictures."""
    folder = tmp_path / "in"
    folder.mkdir()
    for number in range(3):
        write_frame(folder / f"{number}.png", number)
    return folder


@pytest.fixture
def decode(names: list[str], capsys: pytest.CaptureFixture[str]) -> Decode:
    def call(*arguments: object) -> tuple[int, str]:
        code = run(["decode", *map(str, arguments), *names])
        return code, capsys.readouterr().err

    return call


def many(folder: Path, n: int) -> Path:
    """Files that are refused at once: a run over them can be caught at any moment."""
    folder.mkdir()
    for number in range(n):
        (folder / f"{number:05}.jpg").write_bytes(b"\xff\xd8\xff cut")
    return folder


def start(*arguments: object, **options: Any) -> subprocess.Popen[bytes]:
    command = [*COMMAND, *map(str, arguments)]
    return subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.PIPE, **options)


def records(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) | {"timing_ms": None} for line in path.read_text().splitlines()]


# -- journals


def test_a_journal_is_replaced_with_force_alone_and_by_one_run_at_a_time(
    tmp_path: Path, folder: Path, decode: Decode
) -> None:
    fcntl = pytest.importorskip("fcntl")
    out = tmp_path / "o.jsonl"
    assert decode(folder, "--json", out)[0] == 0
    whole = out.read_bytes()
    with out.open("ab") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        for way, reason in (
            ((), "holds the results of an earlier run; go on with it by --resume, replace it with --force"),
            (("--force",), "another run is writing this file"),
            (("--resume",), "another run is writing this file"),
        ):
            code, said = decode(folder, "--json", out, "--summary", tmp_path / "s.csv", *way)
            assert code == 2
            assert f"{out}: {reason}" in said
    assert out.read_bytes() == whole
    assert not (tmp_path / "s.csv").exists()
    assert decode(folder / "0.png", "--json", out, "--force")[0] == 0
    assert len(records(out)) == 1


def test_a_received_file_replaces_nothing_of_its_run(
    tmp_path: Path, folder: Path, decode: Decode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sender chooses names; --force is for files of earlier runs."""
    names = ("0.png", "s.csv", "j.jsonl", "0.truth.json", "twice.txt", "old.txt")
    sent = {name: b"sent as " + name.encode() for name in names}

    def receive(frames: Any, _options: Any) -> Iterator[FrameResult]:
        for frame in frames:
            files = [(name, data + frame.source.encode() * (name == "twice.txt")) for name, data in sent.items()]
            objects = [ReceivedObject(n, d, len(d), hashlib.sha256(d).hexdigest(), 1, 1, "", 0, 0.0) for n, d in files]
            yield FrameResult(frame.source, 0, 0.0, "ok", objects=tuple(objects))

    def decoder(options: Any, *_: Any) -> Decoder:
        return Decoder(replace(options, soft_bits=False), receive=receive)

    monkeypatch.setattr("rxcli.runs.batch.Decoder", decoder)
    (folder / "old.txt").write_text("of another run")
    before = {name: (folder / name).read_bytes() for name in ("0.png", "0.truth.json")}
    outputs = ("--json", folder / "j.jsonl", "--summary", folder / "s.csv", "--truth", "auto", "--out", folder)
    more = ("--junit", tmp_path / "j.xml", "--force")
    code, said = decode(folder / "0.png", folder / "1.png", *outputs, *more)
    assert code == 1
    assert {name: (folder / name).read_bytes() for name in before} == before
    assert (folder / "s.csv").read_text().startswith("source,exit_code,frames")
    assert len(records(folder / "j.jsonl")) == 2
    assert (folder / "twice.txt").read_bytes().endswith(b"0.png")
    assert (folder / "old.txt").read_bytes() == b"sent as old.txt"
    assert "0.png is an input; 0.png (13 bytes) was not written" in (tmp_path / "j.xml").read_text()
    code, said = decode(folder / "0.png", "--dump-dir", folder, "--out", folder)
    assert code == 2
    assert "--dump-dir writes there" in said


def test_resuming_with_other_options_is_refused(tmp_path: Path, folder: Path, decode: Decode) -> None:
    out, screen = tmp_path / "o.jsonl", tmp_path / "profiles" / "screen.toml"
    assert decode(folder / "0.png", folder / "1.png", "--json", out)[0] == 0
    before = out.read_bytes()
    assert decode(folder / "2.png", "--json", out, "--resume", "--workers", "2", "--quiet") == (0, "")
    whole = out.read_bytes()
    assert whole.startswith(before)  # other inputs are added
    assert [record["source"] for record in records(out)] == [str(folder / f"{n}.png") for n in range(3)]

    def refused(*options: str) -> str:
        code, said = decode(folder, "--json", out, "--resume", *options)
        assert code == 2
        assert out.read_bytes() == whole
        return said

    assert "--min-confidence was null, is 0.5" in refused("--min-confidence", "0.5")
    assert "--cae was" in refused("--cae", "never")
    (folder / "1.png").unlink()
    for paths in ((folder,), (folder, folder / "1.png")):  # no longer there, asked for or not: kept
        assert decode(*paths, "--json", out, "--resume")[0] == 0
        assert out.read_bytes() == whole
    screen.write_text(screen.read_text().replace("0.45", "0.55"))
    assert "--profiles was" in refused()


def test_files_that_changed_since_the_journal_are_decoded_again(tmp_path: Path, folder: Path, decode: Decode) -> None:
    out = tmp_path / "o.jsonl"
    assert decode(folder, "--json", out)[0] == 0
    before, payloads = records(out), write_frame(folder / "1.png", 7)
    code, said = decode(folder, "--json", out, "--resume")
    assert code == 0
    assert f"{folder / '1.png'} has changed (" in said
    after = records(out)
    assert [record["source"][-5:] for record in after] == ["0.png", "2.png", "1.png"]
    assert [column["packets"][0]["payload"] for column in after[2]["columns"]] == payloads
    assert after[0] == before[0]  # what the first line says of the run stays
    assert after[1] == before[2]


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs Linux's /proc")
def test_many_files_in_one_process_leave_nothing_behind(
    tmp_path: Path, folder: Path, decode: Decode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Memory and handles after 120 files of three sorts are those after 60."""
    good = (folder / "0.png").read_bytes()
    kinds = {"a.png": good, "b.jpg": b"\xff\xd8\xff cut", "c.dng": b"II*\0\x08\0\0\0" + bytes(64)}
    (tmp_path / "many").mkdir()
    for number in range(40):
        for name, data in kinds.items():
            (tmp_path / "many" / f"{number:03}-{name}").write_bytes(data)
    seen = []
    append = Journal.append

    def appended(journal: Journal, line: str) -> None:
        append(journal, line)
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        seen.append((len(os.listdir("/proc/self/fd")), pages * resource.getpagesize() / 2**20))

    monkeypatch.setattr(Journal, "append", appended)
    assert decode(tmp_path / "many", "--json", tmp_path / "o.jsonl", "--quiet")[0] == 3
    assert len(seen) == 120
    (before, before_mb), (after, after_mb) = seen[59], seen[-1]
    assert after == before
    assert after_mb < before_mb + 8


def test_the_packets_of_a_killed_run_stand_once(tmp_path: Path, folder: Path, decode: Decode) -> None:
    out, table = tmp_path / "o.jsonl", tmp_path / "p.csv"
    assert decode(folder, "--json", out, "--payloads", table)[0] == 0
    whole = table.read_bytes()
    assert whole.count(b"\n") == 31
    out.write_bytes(b"".join(out.read_bytes().splitlines(keepends=True)[:2]) + b'{"source": "half')
    table.write_bytes(b"".join(whole.splitlines(keepends=True)[:25]))  # some are of the file that is decoded again
    assert decode(folder, "--json", out, "--resume", "--payloads", table)[0] == 0
    assert table.read_bytes() == whole
    code, said = decode(folder, "--payloads", "/dev/full")
    assert code == 3
    assert "/dev/full: cannot be written (No space left on device)" in said


@pytest.mark.parametrize(
    "change",
    [
        *({"frame": value} for value in ("0", 10**400, float("inf"))),
        *({"status": "great"}, {"columns": 5}, {"screen": None}, {"camera": []}, {"timing_ms": {"total": "long"}}),
        *({"message": {"a": 1}}, {"run": 3}, {"columns": [{"column": 0}]}, {"estimated": {"x": 1}}),
        {"skipped": {"a": "b"}},
        *("[" * 100_000, '{"source": ' + "9" * 5000 + "}", "\0\0\0", '"'),
    ],
    ids=lambda change: f"{change!s:.30}",
)
def test_a_journal_that_is_none_is_refused(
    change: dict[str, Any] | str, tmp_path: Path, folder: Path, decode: Decode
) -> None:
    out = tmp_path / "o.jsonl"
    assert decode(folder / "0.png", "--json", out)[0] == 0
    line = out.read_text()
    out.write_text(line + change + "\n" if isinstance(change, str) else json.dumps(json.loads(line) | change) + "\n")
    before = out.read_bytes()
    code, said = decode(folder, "--json", out, "--resume")
    assert code == 2
    assert str(out) in said
    assert "internal error" not in said
    assert out.read_bytes() == before


# -- one bad truth, profile or number


@pytest.mark.parametrize("value", ["9" * 400, "[" * 100_000, '"a"', "-1", "1e999"])
def test_one_bad_truth_never_stops_the_others(value: str, folder: Path, decode: Decode) -> None:
    truth = folder / "0.truth.json"
    truth.write_text(truth.read_text().replace('"payload_symbols": 5', f'"payload_symbols": {value}'))
    os.mkfifo(folder / "pipe.json")
    (folder / "1.truth.json").unlink()
    (folder / "1.truth.json").symlink_to("pipe.json")
    code, said = decode(folder, "--truth", "auto", "--json", "-")
    assert code == 3
    assert "0.truth.json: cannot be read as truth" in said
    assert "internal error" not in said
    assert "1 of 3 failed" in said
    assert decode(folder / "1.png", "--truth", folder / "pipe.json", "--quiet")[0] == 3  # does not block


@pytest.mark.parametrize("number", ["nan", "inf", "-inf"])
def test_what_is_no_number_is_none_for_any_option(
    number: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in (
        ["decode", str(folder), "--truth", "auto", "--max-ber", number],
        ["live", "/dev/video0", "--exposure", number],
        ["simulate", str(folder / "x.png"), "--roll", number],
        ["simulate", str(folder / "x.png"), "--column-delays", number],
        ["calibrate", "shutter", str(folder), "--frequency", number],
    ):
        assert run(command) == 2, command
        assert capsys.readouterr().err.count("\n") == 1


# -- how runs end


@pytest.mark.parametrize(
    ("number", "code", "workers", "pause_s"),
    [
        (signal.SIGTERM, 143, 1, None),
        (signal.SIGINT, 130, 1, None),
        (signal.SIGTERM, 143, 2, None),
        *((signal.SIGINT, 130, 2, pause_s) for pause_s in (0.0, 0.02, 0.05)),
    ],
)
def test_a_signal_ends_the_run_with_its_summary(
    tmp_path: Path, number: int, code: int, workers: int, pause_s: float | None
) -> None:
    """So does one that is repeated after a pause, by a person who does not wait."""
    folder, summary, junit = many(tmp_path / "in", 3000), tmp_path / "s.csv", tmp_path / "j.xml"
    options = ["--json", "-", "--summary", summary, "--junit", junit, "--workers", workers]
    started = start("decode", folder, *options, stdout=subprocess.PIPE)
    assert started.stdout.readline().startswith(b'{"source"')
    started.send_signal(number)
    if pause_s is not None:
        time.sleep(pause_s)
        started.send_signal(number)
    _, said = started.communicate(timeout=60)
    assert started.returncode == code
    assert b"Traceback" not in said
    with summary.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert 0 < len(rows) < 3000
    assert junit.read_text().count("<testcase") == len(rows)


def test_a_summary_that_cannot_be_written_does_not_cost_the_others(
    tmp_path: Path, folder: Path, decode: Decode
) -> None:
    (tmp_path / "s.csv").symlink_to("/dev/full")
    code, said = decode(folder, "--summary", tmp_path / "s.csv", "--junit", tmp_path / "j.xml", "--quiet")
    assert code == 3
    assert "s.csv: cannot be written (No space left on device)" in said
    assert (tmp_path / "j.xml").exists()


@pytest.mark.parametrize("form", [["--json", "-"], []])
def test_a_closed_pipe_leaves_both_summaries(form: list[str], tmp_path: Path) -> None:
    folder, summary, junit = many(tmp_path / "in", 3000), tmp_path / "s.csv", tmp_path / "j.xml"
    started = start("decode", folder, *form, "--summary", summary, "--junit", junit, stdout=subprocess.PIPE)
    started.stdout.readline()
    started.stdout.close()
    assert started.stderr is not None
    with started.stderr as said:
        assert b"Traceback" not in said.read()
    assert started.wait(60) == 130
    assert summary.exists()
    assert junit.exists()


@pytest.mark.parametrize(
    ("before", "arguments", "redirection", "reason"),
    [
        ("", "many --json -", "> /dev/full", "stdout: cannot be written (No space left"),
        ("", "many", "> /dev/full", "stdout: cannot be written (No space left"),
        ("", "many --json -", ">&-", "stdout is closed"),
        ("", "many", ">&-", "stdout is closed"),
        ("", "-", "<&-", "stdin is closed"),
        ("TMPDIR=/nowhere/at/all", "-", "< /dev/null", ""),
        ("ulimit -f 0; trap '' XFSZ;", "-", "< /bin/sh", "stdin: cannot be kept in a temporary file"),
    ],
)
def test_streams_that_take_or_give_nothing(
    before: str, arguments: str, redirection: str, reason: str, tmp_path: Path
) -> None:
    many(tmp_path / "many", 3)
    line = f"{before} {' '.join(COMMAND)} decode {arguments} --summary s.csv {redirection}"
    done = subprocess.run(
        ["bash", "-c", line], env=ENVIRONMENT, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 3
    assert reason in done.stderr
    for word in ("internal error", "Traceback", "Exception ignored"):
        assert word not in done.stderr + done.stdout
    if reason.startswith("stdout"):
        assert len([line for line in done.stderr.splitlines() if line.startswith("vlc-rx:")]) == 1
        assert (tmp_path / "s.csv").exists()


# -- pictures


def test_corners_outside_the_picture(folder: Path, decode: Decode, capsys: pytest.CaptureFixture[str]) -> None:
    for corners in (
        ["5000,0", "6000,0", "6000,700", "5000,700"],
        ["0,-900", "1000,-900", "1000,-3", "0,-3"],
        ["0,-900", "4000,-900", "4000,2", "0,2"],
        ["-1e5,-1e5", "1e5,-1e5", "1e5,1e5", "-1e5,1e5"],
    ):
        assert run(["decode", str(folder / "0.png"), "--corners", *corners]) == 1
        assert "the corners that were given" in capsys.readouterr().out
