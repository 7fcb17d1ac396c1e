"""`vlc-rx encode`, and texts and files through `simulate` and `decode`."""

import csv
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import COMMAND, ENVIRONMENT
from numpy.typing import NDArray

from rxcli.cli.main import run
from rxcli.errors import ExitCode, InputError, UsageError
from rxcli.lab.simulate.transmitter import Link
from rxcli.link.encoder import file_object, message, packet_slots_of
from rxcli.link.slots import read_slots
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.protocol import bits_to_hex, codebook
from rxcli.results.truth import load_truth


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
        (
            ["--text", "a", "--force", "--out", "x.txt"],
            ExitCode.USAGE,
            "must end in .csv, .npy, .bin, .h, .vcd, or be - (got 'x.txt')",
        ),
        (["--text", "a", "--same"], ExitCode.USAGE, "--same belongs to --payload"),
        (["--text", "a", "--payload", "random"], ExitCode.USAGE, "--payload excludes"),
        (["--text", "a", "--only-column", "2"], ExitCode.USAGE, "--only-column needs slots"),
        (["--payload", "random", "--only-column", "20"], ExitCode.USAGE, "data-34k6 has 20 columns"),
        (["--payload", "lit", "--truth", "t.json"], ExitCode.USAGE, "sends no packets"),
        (["--payload", "hex:a"], ExitCode.USAGE, "give an even number of hex digits"),
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


def test_weights_that_are_no_whole_numbers_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    weights = tmp_path / "w.json"
    weights.write_text("5.5")
    assert encode("--text", "a", "--weights", weights, "--out", tmp_path / "x.npy") == ExitCode.USAGE
    assert "give 1..9 for every column" in capsys.readouterr().err


SCREEN = """format = 1
kind = "screen"
name = "bench-12"
columns = 12
slot_rate_hz = 17300
payload_symbols = 11
repeats = 2
"""


def slots_of_c(text: str, tmp_path: Path) -> list[int]:
    """Bytes of the array that a C compiler makes of a header."""
    if not (compiler := shutil.which("cc") or shutil.which("gcc")):
        pytest.skip("no C compiler here")
    (tmp_path / "slots.h").write_text(text)
    main = '#include <stdio.h>\n#include "slots.h"\nint main(void) { fwrite(vlc_slots, 1, sizeof vlc_slots, stdout); }'
    (tmp_path / "main.c").write_text(main)
    subprocess.run([compiler, "-Wall", "-Werror", "main.c", "-o", "dump"], cwd=tmp_path, check=True)
    return list(subprocess.run([tmp_path / "dump"], capture_output=True, check=True).stdout)


def slots_of_vcd(text: str, rate_hz: float) -> NDArray[np.uint8]:
    """(n, C) states of a value change dump, sampled in the middle of every slot."""
    names = re.findall(r"\$var wire 1 (\S+) column_\d+ \$end", text)
    changes = [(int(time), body) for time, body in re.findall(r"^#(\d+)\n((?:[01]\S+\n)*)", text, re.MULTILINE)]
    assert "$timescale 1 ns $end" in text
    n_slots, state, rows = round(changes[-1][0] * rate_hz / 1e9), dict.fromkeys(names, "0"), []
    for slot in range(n_slots):
        while changes and changes[0][0] * rate_hz / 1e9 < slot + 0.5:
            state |= {change[1:]: change[0] for change in changes.pop(0)[1].split()}
        rows.append([int(state[name]) for name in names])
    return np.array(rows, np.uint8)


def test_every_format_of_slots_is_read_back_bit_for_bit(tmp_path: Path, capsysbinary: Any) -> None:
    """By a reader of its kind: NumPy, C, a table, a value change dump."""
    (tmp_path / "bench.toml").write_text(SCREEN)
    how = ("--payload", "random", "--seed", 4, "--weights", 4, "--screen", tmp_path / "bench.toml", "--bursts", 3)
    for suffix in (".csv", ".npy", ".bin", ".h", ".vcd"):
        assert encode(*how, "--out", tmp_path / f"s{suffix}") == ExitCode.OK
    assert encode(*how, "--out", "-") == ExitCode.OK
    screen = load_profile(tmp_path / "bench.toml", ScreenProfile)
    sent = Link(screen, np.full(12, 4), seed=4).slots(0, 3 * 2 * 130).T
    text, packed = (tmp_path / "s.csv").read_text(), np.packbits(sent, axis=1)
    assert capsysbinary.readouterr().out.decode() == text
    assert text.startswith("# 780 slots; one row a slot at 17300 Hz, first sent first; 12 columns")
    assert np.array_equal([row[::2] for row in text.splitlines()[2:]], ["".join(map(str, row)) for row in sent])
    assert np.array_equal(np.load(tmp_path / "s.npy"), packed)
    assert (tmp_path / "s.bin").read_bytes() == packed.tobytes()
    assert "one row a slot at 17300 Hz" in (tmp_path / "s.bin.README.txt").read_text()
    assert np.array_equal(slots_of_vcd((tmp_path / "s.vcd").read_text(), 17300), sent)
    for name in ("s.csv", "s.npy", "s.bin"):
        assert np.array_equal(read_slots(tmp_path / name, screen), sent)
    assert slots_of_c((tmp_path / "s.h").read_text(), tmp_path) == packed.ravel().tolist()


@pytest.mark.parametrize(("name", "content"), [("a.csv", "x"), ("a.npy", "x"), ("a.bin", "xx"), ("a.h", "x")])
def test_what_is_no_file_of_slots_is_refused(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises((UsageError, InputError), match=name):
        read_slots(tmp_path / name, load_profile("data-17k3", ScreenProfile))


@pytest.mark.parametrize("content", ["hex:cafe", "random"])
def test_raw_payload_is_what_the_simulator_sends(tmp_path: Path, content: str) -> None:
    """Two encoders, written apart; and what the truth says is in the slots."""
    out, truth_file, weights = tmp_path / "s.bin", tmp_path / "t.json", [1 + c % 9 for c in range(20)]
    how = ("--screen", "paper-8k65", "--weights", ",".join(map(str, weights)), "--bursts", 2)
    assert encode("--payload", content, *how, "--out", out, "--truth", truth_file) == ExitCode.OK
    screen = load_profile("paper-8k65", ScreenProfile)
    link = Link(screen, np.array(weights), 0, bytes.fromhex(content[4:]) if content != "random" else None)
    assert np.array_equal(read_slots(out, screen), link.slots(0, 2 * 3 * 70).T)
    truth = load_truth(truth_file)
    assert truth.payload == {b: tuple(bits_to_hex(bits) for bits in link.payload(b)) for b in range(2)}
    assert truth.payload_bits == tuple(link.bits_per_column())


@pytest.mark.parametrize("content", ["hex:0123456789abcdef", "random"])
def test_weights_of_raw_payload_may_change_from_burst_to_burst(tmp_path: Path, content: str) -> None:
    screen, out, weights = load_profile("paper-8k65", ScreenProfile), tmp_path / "s.npy", tmp_path / "w.json"
    weights.write_text(json.dumps([[5] * 20, [2] * 20]))
    assert encode("--payload", content, "--screen", "paper-8k65", "--weights", weights, "--out", out) == ExitCode.OK
    slots = read_slots(out, screen).reshape(2, 3, 7, 10, 20)
    assert np.unique(slots[0, :, 2:].sum(axis=2)).tolist() == [5]
    assert np.unique(slots[1, :, 2:].sum(axis=2)).tolist() == [2]
    if content != "random":  # The second burst goes on where the first ends.
        bits = np.unpackbits(np.frombuffer(bytes.fromhex(content[4:]), np.uint8))
        sent = [codebook(2).tolist().index(row) for row in slots[1, 0, 2:, :, 0].tolist()]
        assert "".join(f"{index:05b}" for index in sent) == "".join(map(str, np.resize(bits, 725)[700:]))


@pytest.mark.parametrize(
    ("what", "lit"),
    [(("counter",), None), (("hex:cafe", "--same"), None), (("lit",), 4), (("half",), 2), (("random",), None)],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_first_light_is_the_same_in_all_columns_or_in_one(
    tmp_path: Path, what: tuple[str, ...], lit: int | None
) -> None:
    out, screen = tmp_path / "s.bin", load_profile("data-17k3", ScreenProfile)
    how = ("--screen", "data-17k3", "--bursts", 3, "--out", out)
    assert encode("--payload", *what, *how) == ExitCode.OK
    slots = read_slots(out, screen)
    assert (slots == slots[:, :1]).all() == (what != ("random",))
    if lit is not None:
        assert np.array_equal(slots[:, 0], np.arange(3 * 130) % 4 < lit)
    if what == ("counter",):
        words = codebook(5).tolist()
        packet = [words.index(word.tolist()) for word in slots[130:260, 0].reshape(13, 10)[2:]]
        bits = "".join(f"{index:07b}" for index in packet)
        assert bits == (f"{1:016b}" * 5)[:77]
    assert encode("--payload", *what, *how, "--only-column", 7, "--force") == ExitCode.OK
    alone = read_slots(out, screen)
    assert np.array_equal(alone[:, 7], slots[:, 7])
    assert not np.delete(alone, 7, axis=1).any()


def test_slots_through_the_simulator_are_scored_against_the_truth_of_encode(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The way of docs/transmitter.md, from the payload to a scored photo."""
    slots, truth, shot = tmp_path / "slots.csv", tmp_path / "sent.json", tmp_path / "photo.png"
    assert encode("--payload", "random", "--screen", "paper-17k3", "--out", slots, "--truth", truth) == ExitCode.OK
    how = ("--scale", "0.25", "--keep-readout", "--picture", "grey", "--screen", "paper-17k3", "--start-slot", "9000")
    assert run(["simulate", str(shot), "--slots", str(slots), *how]) == ExitCode.OK
    gate = ("--min-packets", "20", "--max-ber", "0.01")
    assert run(["decode", str(shot), "--truth", str(truth), *gate]) == ExitCode.OK
    capsys.readouterr()
    assert run(["decode", str(shot), "--truth", "auto"]) == ExitCode.UNREADABLE
    assert "encode --truth" in capsys.readouterr().out


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


@pytest.mark.parametrize(("where", "code", "said"), [("| head -c 1", 130, ""), ("> /dev/full", 3, "No space left")])
def test_a_stream_that_takes_no_more(where: str, code: int, said: str) -> None:
    command = f"set -o pipefail; {' '.join(COMMAND)} encode --payload counter --seconds 20 --out - {where}"
    done = subprocess.run(["bash", "-c", command], env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert done.returncode == code
    assert said in done.stderr
    assert ("cannot be written" in done.stderr) == bool(said)


def test_weights_go_by_one_name(tmp_path: Path) -> None:
    """Of what is sent and of what is simulated; the short one stays."""
    for flag in ("--weights", "--w"):
        sent = tmp_path / f"{flag}.csv"
        assert encode("--payload", "counter", "--screen", "paper-8k65", flag, 3, "--out", sent) == ExitCode.OK
        photo = ("--preset", "phone-plain", "--screen", "paper-8k65", "--scale", 0.05, flag, 3)
        assert run(["simulate", str(tmp_path / f"{flag}.png"), *map(str, photo)]) == ExitCode.OK
