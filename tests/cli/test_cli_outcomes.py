"""How a run ends is told: exit codes, summaries and journals of runs that are interrupted, refused or cannot write."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from small_frames import write_frame, write_profiles

from rxcli.cli.main import run
from rxcli.ingest import open_source
from rxcli.runs.batch import Decoder
from rxcli.runs.journal import Journal
from rxcli.types import FrameResult, ReceivedObject

ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
COMMAND = [sys.executable, "-m", "rxcli.cli.main"]
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


def test_two_runs_do_not_write_one_journal(tmp_path: Path, folder: Path, decode: Decode) -> None:
    fcntl = pytest.importorskip("fcntl")
    out = tmp_path / "o.jsonl"
    assert decode(folder, "--json", out)[0] == 0
    whole = out.read_bytes()
    with out.open("ab") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        for way in ("--force", "--resume"):
            code, said = decode(folder, "--json", out, "--summary", tmp_path / "s.csv", way)
            assert code == 2
            assert f"{out}: another run is writing this file" in said
    assert out.read_bytes() == whole
    assert not (tmp_path / "s.csv").exists()


def test_a_journal_is_replaced_with_force_alone(tmp_path: Path, folder: Path, decode: Decode) -> None:
    out = tmp_path / "o.jsonl"
    assert decode(folder, "--json", out)[0] == 0
    whole = out.read_bytes()
    code, said = decode(folder / "0.png", "--json", out)
    assert code == 2
    assert "holds the results of an earlier run; go on with it by --resume, replace it with --force" in said
    assert out.read_bytes() == whole
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
        return Decoder(options, open_source, receive)

    monkeypatch.setattr("rxcli.cli.decode.standard_decoder", decoder)
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


def test_resuming_with_other_options_or_changed_files_is_refused(tmp_path: Path, folder: Path, decode: Decode) -> None:
    out = tmp_path / "o.jsonl"
    assert decode(folder, "--json", out)[0] == 0
    whole = out.read_bytes()
    assert decode(folder, "--json", out, "--resume", "--workers", "2", "--quiet") == (0, "")
    assert out.read_bytes() == whole

    def refused(*options: str) -> str:
        code, said = decode(folder, "--json", out, "--resume", *options)
        assert code == 2
        assert out.read_bytes() == whole
        return said

    assert "--min-confidence was null, is 0.5" in refused("--min-confidence", "0.5")
    assert "--cae was" in refused("--cae", "never")
    os.utime(folder / "1.png", (1, 1))
    assert f"{folder / '1.png'} has changed (modified_s was" in refused()
    write_frame(folder / "1.png", 9)
    assert f"{folder / '1.png'} has changed" in refused()
    (folder / "1.png").unlink()
    assert decode(folder, "--json", out, "--resume")[0] == 0  # no longer asked for: kept
    assert out.read_bytes() == whole


def test_a_changed_profile_is_another_option(tmp_path: Path, folder: Path, decode: Decode) -> None:
    out, screen = tmp_path / "o.jsonl", tmp_path / "profiles" / "screen.toml"
    assert decode(folder, "--json", out)[0] == 0
    screen.write_text(screen.read_text().replace("0.45", "0.55"))
    code, said = decode(folder, "--json", out, "--resume")
    assert code == 2
    assert "--profiles was" in said


def test_resuming_with_other_inputs_keeps_what_is_there(tmp_path: Path, folder: Path, decode: Decode) -> None:
    out = tmp_path / "o.jsonl"
    assert decode(folder / "0.png", folder / "1.png", "--json", out)[0] == 0
    before = out.read_bytes()
    assert decode(folder / "2.png", "--json", out, "--resume")[0] == 0
    assert out.read_bytes().startswith(before)
    assert [record["source"] for record in records(out)] == [str(folder / f"{n}.png") for n in range(3)]


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs Linux's /proc")
def test_many_files_in_one_process_leave_nothing_behind(
    tmp_path: Path, decode: Decode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Memory and handles after 240 files of three sorts are those after 80."""
    folder = tmp_path / "many"
    folder.mkdir()
    write_frame(tmp_path / "good.png", 1)
    good = (tmp_path / "good.png").read_bytes()
    for number in range(80):
        (folder / f"{number:03}-a.png").write_bytes(good)
        (folder / f"{number:03}-b.jpg").write_bytes(b"\xff\xd8\xff cut")
        (folder / f"{number:03}-c.dng").write_bytes(b"II*\0\x08\0\0\0" + bytes(64))
    seen = []
    append = Journal.append

    def appended(journal: Journal, line: str) -> None:
        append(journal, line)
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        seen.append((len(os.listdir("/proc/self/fd")), pages * resource.getpagesize() / 2**20))

    monkeypatch.setattr(Journal, "append", appended)
    assert decode(folder, "--json", tmp_path / "o.jsonl", "--quiet")[0] == 3
    assert len(seen) == 240
    (before, before_mb), (after, after_mb) = seen[79], seen[-1]
    assert after == before
    assert after_mb < before_mb + 8


def without_run(record: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in record.items() if name != "run"}


def test_a_file_whose_decoder_was_killed_is_tried_again(tmp_path: Path, folder: Path, decode: Decode) -> None:
    out = tmp_path / "o.jsonl"
    assert decode(folder, "--json", out)[0] == 0
    whole = records(out)
    for number in range(3):
        killed = [json.loads(line) for line in out.read_text().splitlines()]
        killed[number] |= {"status": "unreadable", "message": "two processes that decoded it died", "retry": True}
        killed[number]["columns"] = []
        cut = tmp_path / f"{number}.jsonl"
        cut.write_text("".join(json.dumps(record) + "\n" for record in killed))
        table = tmp_path / "s.csv"
        assert decode(folder, "--json", cut, "--resume", "--summary", table) == (0, "")
        found = records(cut)
        assert found[0].pop("run") == whole[0]["run"]
        others = [place for place in range(3) if place != number]
        assert found == [without_run(whole[place]) for place in (*others, number)]
        assert [row["packets"] for row in csv.DictReader(table.read_text().splitlines())] == ["10"] * 3
        assert decode(folder, "--json", cut, "--resume")[0] == 0  # nothing is left to do, and the file is whole


def test_the_packets_of_a_killed_run_stand_once(tmp_path: Path, folder: Path, decode: Decode) -> None:
    out, table = tmp_path / "o.jsonl", tmp_path / "p.csv"
    assert decode(folder, "--json", out, "--payloads", table)[0] == 0
    whole = table.read_bytes()
    assert whole.count(b"\n") == 31
    out.write_bytes(b"".join(out.read_bytes().splitlines(keepends=True)[:2]) + b'{"source": "half')
    for rows in (12, 21, 25):  # some were lost, or are of the file that is decoded again
        table.write_bytes(b"".join(whole.splitlines(keepends=True)[:rows]))
        assert decode(folder, "--json", out, "--resume", "--payloads", table)[0] == 0
        assert table.read_bytes() == whole


def test_packets_that_cannot_be_written_are_told_of(folder: Path, decode: Decode) -> None:
    code, said = decode(folder, "--payloads", "/dev/full")
    assert code == 3
    assert "/dev/full: cannot be written (No space left on device)" in said


def test_a_resumed_file_is_that_of_an_undisturbed_run(tmp_path: Path, folder: Path, decode: Decode) -> None:
    whole, cut = tmp_path / "whole.jsonl", tmp_path / "cut.jsonl"
    assert decode(folder, "--json", whole)[0] == 0
    data = whole.read_bytes()
    for length in (0, 1, 200, len(data) // 2, len(data) - 1, len(data)):
        cut.write_bytes(data[:length])
        assert decode(folder, "--json", cut, "--resume")[0] == 0
        assert records(cut) == records(whole)


@pytest.mark.parametrize(
    "change",
    [
        {"frame": "0"},
        {"frame": 10**400},
        {"frame": float("inf")},
        {"status": "great"},
        {"columns": 5},
        {"screen": None},
        {"camera": []},
        {"timing_ms": {"total": "long"}},
        {"message": {"a": 1}},
        {"run": 3},
        {"columns": [{"column": 0}]},
        {"estimated": {"x": 1}},
        {"skipped": {"a": "b"}},
    ],
)
def test_a_journal_of_wrong_types_is_refused(
    change: dict[str, Any], tmp_path: Path, folder: Path, decode: Decode
) -> None:
    out = tmp_path / "o.jsonl"
    assert decode(folder / "0.png", "--json", out)[0] == 0
    record = json.loads(out.read_text())
    out.write_text(json.dumps(record | change) + "\n")
    before = out.read_bytes()
    code, said = decode(folder, "--json", out, "--resume")
    assert code == 2
    assert str(out) in said
    assert "internal error" not in said
    assert out.read_bytes() == before


@pytest.mark.parametrize("tail", ["[" * 100_000, '{"source": ' + "9" * 5000 + "}", "\0\0\0", '"'])
def test_a_journal_with_a_line_that_is_none(tail: str, tmp_path: Path, folder: Path, decode: Decode) -> None:
    out = tmp_path / "o.jsonl"
    assert decode(folder / "0.png", "--json", out)[0] == 0
    out.write_text(out.read_text() + tail + "\n")
    code, said = decode(folder, "--json", out, "--resume")
    assert code == 2
    assert f"{out} line 2: not JSON" in said or f"{out} line 2: no" in said


# -- one bad truth, profile or number


@pytest.mark.parametrize("value", ["9" * 400, "[" * 100_000, '"a"', "-1", "1e999"])
def test_one_bad_truth_never_stops_the_others(value: str, folder: Path, decode: Decode) -> None:
    truth = folder / "0.truth.json"
    truth.write_text(truth.read_text().replace('"payload_symbols": 5', f'"payload_symbols": {value}'))
    code, said = decode(folder, "--truth", "auto", "--json", "-")
    assert code == 3
    assert "0.truth.json: cannot be read as truth" in said
    assert "internal error" not in said
    assert "1 of 3 failed" in said


def test_a_truth_that_is_a_pipe_does_not_block(tmp_path: Path, folder: Path, decode: Decode) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    code, said = decode(folder / "0.png", "--truth", tmp_path / "pipe.json", "--quiet")
    assert code == 3
    assert "pipe.json: cannot be read as truth (is no regular file)" in said


@pytest.mark.parametrize(
    "text", ["x = " + "9" * 5000, "x = " + "[" * 100_000, "x = nan", "\0", "slot_rate_hz = 1e-300"]
)
def test_a_bad_profile_is_exit_code_2(text: str, tmp_path: Path, folder: Path, decode: Decode) -> None:
    screen = tmp_path / "profiles" / "screen.toml"
    screen.write_text(text)
    code, said = decode(folder)
    assert code == 2
    assert said.startswith(f"vlc-rx: {screen}: ")
    assert said.count("\n") == 1
    assert run(["profiles", "validate", str(screen)]) == 2


@pytest.mark.parametrize("number", ["nan", "inf", "-inf"])
def test_what_is_no_number_is_none_for_any_option(
    number: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in (
        ["decode", str(folder), "--truth", "auto", "--max-ber", number],
        ["decode", str(folder), "--min-confidence", number],
        ["live", "/dev/video0", "--duration", number],
        ["live", "/dev/video0", "--fps", number],
        ["live", "/dev/video0", "--exposure", number],
        ["simulate", str(folder / "x.png"), "--roll", number],
        ["simulate", str(folder / "x.png"), "--exposure", number],
        ["simulate", str(folder / "x.png"), "--column-delays", number],
        ["calibrate", "lens", str(folder), "--square", number],
        ["calibrate", "shutter", str(folder), "--frequency", number],
    ):
        assert run(command) == 2, command
        assert capsys.readouterr().err.count("\n") == 1


# -- how runs end


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
@pytest.mark.parametrize("workers", [1, 2])
def test_a_signal_ends_the_run_with_its_summary(tmp_path: Path, number: int, code: int, workers: int) -> None:
    folder, summary, junit = many(tmp_path / "in", 3000), tmp_path / "s.csv", tmp_path / "j.xml"
    options = ["--json", "-", "--summary", summary, "--junit", junit, "--workers", workers]
    started = start("decode", folder, *options, stdout=subprocess.PIPE)
    assert started.stdout is not None
    assert started.stdout.readline().startswith(b'{"source"')
    started.send_signal(number)
    _, said = started.communicate(timeout=60)
    assert started.returncode == code
    assert b"Traceback" not in said
    with summary.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert 0 < len(rows) < 3000
    assert junit.read_text().count("<testcase") == len(rows)


def test_an_interrupt_is_130_also_where_the_summary_cannot_be_written(tmp_path: Path) -> None:
    folder, junit = many(tmp_path / "in", 3000), tmp_path / "j.xml"
    options = ["--json", "-", "--summary", tmp_path / "out" / "s.csv", "--junit", junit]
    (tmp_path / "out").mkdir()
    started = start("decode", folder, *options, stdout=subprocess.PIPE)
    assert started.stdout is not None
    started.stdout.readline()
    shutil.rmtree(tmp_path / "out")
    started.send_signal(signal.SIGINT)
    _, said = started.communicate(timeout=60)
    assert started.returncode == 130
    assert b"s.csv: cannot be written" in said
    assert junit.exists()


def test_a_summary_that_cannot_be_written_does_not_cost_the_others(
    tmp_path: Path, folder: Path, decode: Decode, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr("rxcli.results.summary._write_csv", full)
    code, said = decode(folder, "--summary", tmp_path / "s.csv", "--junit", tmp_path / "j.xml", "--quiet")
    assert code == 3
    assert "s.csv: cannot be written (No space left on device)" in said
    assert (tmp_path / "j.xml").exists()


def test_a_closed_pipe_leaves_both_summaries(tmp_path: Path) -> None:
    folder = many(tmp_path / "in", 3000)
    for form in (["--json", "-"], []):
        summary, junit = tmp_path / "s.csv", tmp_path / "j.xml"
        started = start("decode", folder, *form, "--summary", summary, "--junit", junit, stdout=subprocess.PIPE)
        assert started.stdout is not None
        started.stdout.readline()
        started.stdout.close()
        assert started.stderr is not None
        said = started.stderr.read()
        assert started.wait(60) == 130
        started.stderr.close()
        assert b"Traceback" not in said
        assert summary.exists()
        assert junit.exists()
        summary.unlink()
        junit.unlink()


@pytest.mark.parametrize("form", ["--json -", ""])
@pytest.mark.parametrize(
    ("redirection", "reason"),
    [("> /dev/full", "stdout: cannot be written (No space left"), (">&-", "stdout is closed")],
)
def test_a_stdout_that_takes_nothing(tmp_path: Path, form: str, redirection: str, reason: str) -> None:
    folder = many(tmp_path / "in", 3)
    line = f"{' '.join(COMMAND)} decode {folder} {form} --summary {tmp_path / 's.csv'} {redirection}"
    done = subprocess.run(["bash", "-c", line], env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert done.returncode == 3
    lines = [line for line in done.stderr.splitlines() if line.startswith("vlc-rx:")]
    assert len(lines) == 1
    assert reason in lines[0]
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    assert (tmp_path / "s.csv").exists()


@pytest.mark.parametrize(
    ("prefix", "redirection", "reason"),
    [
        ("", "<&-", "stdin is closed"),
        ("TMPDIR=/nowhere/at/all ", "< /dev/null", ""),
        ("ulimit -f 0; trap '' XFSZ;", "< /bin/sh", "stdin: cannot be kept in a temporary file"),
    ],
)
def test_a_stdin_that_gives_nothing(prefix: str, redirection: str, reason: str) -> None:
    line = f"{prefix} {' '.join(COMMAND)} decode - {redirection}"
    done = subprocess.run(["bash", "-c", line], env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert done.returncode == 3
    assert "internal error" not in done.stderr + done.stdout
    assert "Traceback" not in done.stderr
    assert reason in done.stderr


# -- clusters


def test_addresses_that_are_none(folder: Path, decode: Decode) -> None:
    pytest.importorskip("distributed", reason="dask.distributed is not installed (extra cluster)")
    began = time.monotonic()
    for address in (
        "",
        " ",
        "nonsense://x",
        "tcp://",
        "tcp://x:notaport",
        "127.0.0.1:99999",
        "tcp://127.0.0.1:1",
        "\0",
    ):
        code, said = decode(folder, "--cluster", address)
        assert code == 2, address
        assert said.count("\n") == 1
        assert "--cluster" in said
    assert time.monotonic() - began < 40


def test_a_server_that_accepts_and_says_nothing_is_given_up(folder: Path) -> None:
    pytest.importorskip("distributed", reason="dask.distributed is not installed (extra cluster)")
    from rxcli.errors import UsageError
    from rxcli.runs.batch import Source
    from rxcli.runs.cluster import decode_on_cluster

    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        began = time.monotonic()
        with pytest.raises(UsageError, match="nothing within 1 s"):
            next(decode_on_cluster([Source("a", "a")], None, address, connect_s=1.0))  # type: ignore[arg-type]
        assert time.monotonic() - began < 20


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


def test_inspect_of_odd_names_and_shapes(tmp_path: Path, names: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    import cv2
    import numpy as np

    write_frame(tmp_path / "$a_{b$.png", 1)
    assert run(["inspect", str(tmp_path / "$a_{b$.png"), "--out", str(tmp_path / "odd"), *names]) == 0
    cv2.imwrite(str(tmp_path / "thin.png"), np.zeros((4000, 1), np.uint8))
    assert run(["inspect", str(tmp_path / "thin.png"), "--out", str(tmp_path / "thin")]) == 1
    assert "$a_{b$.png" in (tmp_path / "odd" / "index.html").read_text(encoding="utf-8")
    assert (tmp_path / "thin" / "index.html").stat().st_size < 1 << 20
