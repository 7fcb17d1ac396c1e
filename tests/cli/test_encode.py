"""`vlc-rx encode`, and texts and files through `simulate` and `decode`."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from rxcli.cli.main import run
from rxcli.errors import ExitCode
from rxcli.link.encoder import file_object, message, packet_slots_of


def encode(*arguments: object) -> int:
    return run(["encode", *map(str, arguments)])


def test_labels_of_a_text(tmp_path: Path) -> None:
    out, long = tmp_path / "t.npy", tmp_path / "l.npy"
    assert encode("--text", "hello", "--screen", "data-17k3", "--out", out, "--bursts", 3) == ExitCode.OK
    assert np.array_equal(np.load(out), message("hello").labels(np.arange(3), 20, 11))
    assert encode("--text", "x" * 200, "--out", long, "--bursts", 40) == ExitCode.OK  # goes as a file
    assert np.array_equal(np.load(long), file_object("message.txt", b"x" * 200).labels(np.arange(40), 20, 24))


def test_labels_of_a_file_for_people(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(b"content")
    out = tmp_path / "a.csv"
    assert encode(tmp_path / "a.bin", "--screen", "data-8k65", "--out", out, "--seconds", 0.02) == ExitCode.OK
    rows = list(csv.reader(out.read_text().splitlines()))
    assert rows[0][:3] == ["burst", "symbol", "column_0"]
    labels = np.array(rows[1:], np.int64)[:, 2:].reshape(-1, 5, 20)
    assert np.array_equal(labels, file_object("a.bin", b"content").labels(np.arange(3), 20, 5))


@pytest.mark.parametrize("screen", ["data-34k6", "paper-34k6"])
def test_slots_are_packed_in_the_order_that_the_line_beside_them_says(tmp_path: Path, screen: str) -> None:
    weights = tmp_path / "w.json"
    per_burst = [[3 + (b + c) % 5 for c in range(20)] for b in range(2)]
    weights.write_text(json.dumps(per_burst))
    out = tmp_path / "s.npy"
    assert encode("--text", "hi", "--screen", screen, "--slots", "--weights", weights, "--bursts", 2, "--out", out) == 0
    packed, repeats = np.load(out), 3 if screen == "paper-34k6" else 1
    assert packed.shape == (2 * 260 * repeats, 3)
    slots = np.unpackbits(packed, axis=1)[:, :20].reshape(2, repeats, 260, 20)
    labels = message("hi").labels(np.arange(2), 20, 24)
    expected = packet_slots_of(labels, np.array(per_burst)).transpose(0, 2, 1)
    for copy in range(repeats):
        assert np.array_equal(slots[:, copy], expected)
    assert "column 0" in (tmp_path / "s.npy.README.txt").read_text()


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--text", "a", "--uri", "b"], ExitCode.USAGE, "one of PATH"),
        ([], ExitCode.USAGE, "one of PATH"),
        (["--text", "a", "--weights", "0"], ExitCode.USAGE, "1 to 9"),
        (["--text", "a", "--weights", "5,5"], ExitCode.USAGE, "list of 20"),
        (["--text", "y" * 199, "--weights", "1"], ExitCode.USAGE, "bits a round"),
        (["--text", "a", "--bursts", "1", "--seconds", "1"], ExitCode.USAGE, "exclude"),
        (["--uri", "u" * 200], ExitCode.USAGE, "199 bytes"),
        (["missing.bin"], ExitCode.UNREADABLE, "missing.bin"),
        (["--text", "a", "--screen", "nothing"], ExitCode.USAGE, "data-34k6"),
        (["--text", "a", "--force", "--out", "x.txt"], ExitCode.USAGE, "must end in .npy or .csv (got 'x.txt')"),
        (["--text", "a", "--slots", "--out", "x.csv"], ExitCode.USAGE, "--slots are written as .npy only"),
        (["--text", "a"], ExitCode.USAGE, "replace it with --force"),
    ],
)
def test_what_cannot_work_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], code: ExitCode, words: str
) -> None:
    out = tmp_path / "x.npy"
    if arguments == ["--text", "a"]:
        out.write_text("precious")
    before = out.read_bytes() if out.exists() else None
    assert encode("--out", out, *arguments) == code
    assert words in capsys.readouterr().err
    assert (out.read_bytes() if out.exists() else None) == before


@pytest.fixture(scope="module")
def photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small photo of a screen that sends a text."""
    path = tmp_path_factory.mktemp("photo") / "text.png"
    what = ("--screen", "data-17k3", "--text", "hällo\x1b", "--picture", "grey", "--seed", "3")
    how = ("--scale", "0.25", "--keep-readout", "--camera-profile", str(path.with_name("camera.toml")))
    code = run(["simulate", str(path), *what, *how])
    assert code == ExitCode.OK
    return path


def test_a_text_comes_first_and_in_json_and_payloads_as_rows(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command, table = ["decode", str(photo), "--camera", str(photo.with_name("camera.toml"))], tmp_path / "p.csv"
    assert run(command) == ExitCode.OK
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("text: hällo")
    assert lines[-1] == lines[0]
    assert "\x1b" not in lines[0]
    assert run([*command, "--json", "-", "--quiet", "--payloads", str(table)]) == ExitCode.OK
    record = json.loads(capsys.readouterr().out)
    assert record["messages"] == [{"kind": "text", "text": "hällo\x1b", "hex": "hällo\x1b".encode().hex()}]
    assert "soft_bits" not in record
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert len(rows) == sum(len(column["packets"]) for column in record["columns"])
    assert rows[0]["hex"] == record["columns"][0]["packets"][0]["payload"]


def test_it_is_said_that_no_packet_fits_a_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--preset", "video-1080p", "--screen", "paper-8k65", "--fill", "0.2", "--scale", "0.1"]
    assert run(["simulate", str(tmp_path / "x.png"), *arguments]) == ExitCode.OK
    assert "no packet fits a frame" in capsys.readouterr().err
