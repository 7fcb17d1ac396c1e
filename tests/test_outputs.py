"""Outputs never destroy: what would be lost is refused before anything is opened; what is written is whole."""

import csv
import errno
import io
import json
import os
from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest
from small_frames import write_frame, write_profiles

from rxcli import outputs
from rxcli.cli.main import run
from rxcli.errors import InputError, OutputError, ReceiverError, UsageError
from rxcli.link.saving import save_object
from rxcli.outputs import Output, claim, replacing, write_whole
from rxcli.results.dump import dump_stages
from rxcli.types import ReceivedObject


@pytest.fixture
def names(tmp_path: Path) -> list[str]:
    """A picture `in/a.png` and its profiles, and the options that name these."""
    for folder in ("in", "profiles"):
        (tmp_path / folder).mkdir()
    write_frame(tmp_path / "in" / "a.png", 1)
    return write_profiles(tmp_path / "profiles")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("option", ["--json", "--junit", "--save-camera"])
@pytest.mark.parametrize(
    "target", ["in/a.png", "in/link.png", "in/a.truth.json", "profiles/screen.toml", "profiles/camera.toml"]
)
def test_what_is_read_is_never_written_over(
    option: str, target: str, tmp_path: Path, names: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "in" / "link.png").symlink_to("a.png")
    before = contents(tmp_path)
    command = ["decode", str(tmp_path / "in" / "a.png"), "--truth", "auto", option, str(tmp_path / target), *names]
    for force in ([], ["--force"]):
        assert run([*command, *force]) == 2
        assert contents(tmp_path) == before
        said = capsys.readouterr().err
        assert said.startswith(f"vlc-rx: {option} {tmp_path / target}: the same file is ")
        assert said.count("\n") == 1


def test_one_file_twice_and_folders_are_refused(
    tmp_path: Path, names: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "loop").symlink_to("loop")
    os.symlink(tmp_path, tmp_path / "here")
    for options, reason in (
        (["--summary", "out.csv", "--junit", "out.csv"], "the same file is written by"),
        (["--summary", "out.csv", "--json", "here/out.csv"], "the same file is written by"),
        (["--json", "in"], "is a folder"),
        (["--json", "none/out.jsonl"], "there is no such folder"),
        *((["--json", name], "--json") for name in ("a\0b", "x" * 300, "loop")),  # names that no system takes
    ):
        with chdir(tmp_path):
            assert run(["decode", "in/a.png", *options, *names]) == 2
        assert reason in capsys.readouterr().err
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.parametrize(
    ("option", "name"),
    [("--junit", "o.xml"), ("--payloads", "o.csv"), ("--summary", "o.csv"), ("--summary", "o.parquet")],
)
def test_a_file_of_somebody_else_needs_force_and_one_of_ours_does_not(
    option: str, name: str, tmp_path: Path, names: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["decode", str(tmp_path / "in" / "a.png"), "--quiet", option, str(tmp_path / name), *names]
    (tmp_path / name).write_text("source of much joy\n")
    assert run(command) == 2
    assert "replace it with --force" in capsys.readouterr().err
    assert (tmp_path / name).read_text() == "source of much joy\n"
    assert run([*command, "--force"]) == 0
    first = (tmp_path / name).read_bytes()
    assert b"joy" not in first
    (tmp_path / name).chmod(0o640)
    assert run(command) == 0
    assert (tmp_path / name).stat().st_mode & 0o777 == 0o640
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(
    "command",
    [
        "simulate in/a.png",
        "simulate b.png --camera-profile in/a.png",
        "simulate b.png --picture in/a.png --camera-profile in/a.png --force",
        "simulate /proc/o.png",
        "encode --text a --screen data-17k3 --out /proc/o.npy",
        "inspect in/a.png --out /proc/o",
        "profiles which in/a.png --json in/a.png",
        "profiles show profiles/screen.toml --json profiles/screen.toml",
        "calibrate lens in/a.png --picture in/a.png",
        "calibrate lens in/a.png --save in/a.png",
        "calibrate shutter in/a.png --frequency 1000 --json in/a.png",
        "calibrate shutter in/a.png --frequency 1000 --save /proc/o.toml",
        "live /dev/video0 --json in/a.png",
    ],
)
@pytest.mark.usefixtures("names")
def test_other_commands_do_not_destroy_either(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(tmp_path)
    with chdir(tmp_path):
        assert run(command.split()) == 2
    assert contents(tmp_path) == before
    assert ("cannot be written (No such file or directory)" in capsys.readouterr().err) == ("/proc" in command)


def test_a_capture_of_the_simulator_may_be_made_anew(tmp_path: Path) -> None:
    command = ["simulate", str(tmp_path / "a.jpg"), "--preset", "phone-plain", "--scale", "0.05"]
    command += ["--camera-profile", str(tmp_path / "c.toml")]
    assert run(command) == 0
    before = contents(tmp_path)
    assert run(command) == 0
    assert contents(tmp_path) == before
    truth = json.loads((tmp_path / "a.truth.json").read_text())
    del truth["written_by"]
    (tmp_path / "a.truth.json").write_text(json.dumps(truth))
    assert run(command) == 2
    assert run([*command, "--force"]) == 0


@pytest.mark.parametrize(
    ("error", "raised"),
    [(ZeroDivisionError(), ZeroDivisionError), (OSError(errno.ENOSPC, "No space left"), OutputError)],
)
def test_what_fails_leaves_the_old_file_and_nothing_else(
    error: Exception, raised: type[Exception], tmp_path: Path
) -> None:
    path = tmp_path / "a.txt"
    write_whole(path, "old")

    def fail() -> None:
        with replacing(path) as hidden:
            hidden.write_text("half")
            raise error

    with pytest.raises(raised):
        fail()
    assert contents(tmp_path) == {"a.txt": b"old"}
    with pytest.raises(UsageError, match="cannot be written"):
        write_whole(tmp_path / "none" / "a.txt", "new")


def test_a_link_is_followed_and_a_device_is_no_file(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "a.txt").write_text("old")
    (tmp_path / "a.txt").symlink_to("real/a.txt")
    write_whole(tmp_path / "a.txt", "new")
    assert (tmp_path / "a.txt").is_symlink()
    assert (tmp_path / "real" / "a.txt").read_text() == "new"
    null = Path("/dev/null")
    claim([Output("--json", null, outputs.JOURNAL), Output("--junit", null, outputs.JUNIT)])
    write_whole(null, "new")
    assert null.is_char_device()
    for path, code in (("/dev/full", 3), ("/proc/none", 2)):  # a full disk, a wrong name
        with pytest.raises(ReceiverError, match=f"{path}: cannot be written") as caught:
            write_whole(Path(path), "new")
        assert caught.value.exit_code == code


def test_a_temporary_file_is_not_where_a_link_may_wait_and_is_never_set_uid(tmp_path: Path) -> None:
    path, victim = tmp_path / "a.txt", tmp_path / "victim"
    victim.write_text("mine")
    path.write_text("old")
    path.chmod(0o4755)
    (tmp_path / f".a.{os.getpid()}.part.txt").symlink_to(victim)
    with replacing(path) as hidden:
        assert hidden.parent.stat().st_mode & 0o777 == 0o700
        hidden.write_text("new")
    assert (path.read_text(), path.stat().st_mode & 0o7777) == ("new", 0o755)
    assert victim.read_text() == "mine"


@pytest.mark.parametrize("kind", ["file", "pipe", "link", "link to the same"])
def test_a_received_file_replaces_what_is_there_and_is_not_written_into_it(kind: str, tmp_path: Path) -> None:
    path, victim = tmp_path / "out" / "a.txt", tmp_path / "victim"
    path.parent.mkdir()
    there = "sent" if kind == "link to the same" else "mine"
    victim.write_text(there)
    make = {"file": lambda: path.write_text("mine"), "pipe": lambda: os.mkfifo(path)}
    make.get(kind, lambda: path.symlink_to(victim))()
    received = ReceivedObject("a.txt", b"sent", 4, "00", 1, 1, "", 0, 0.0)
    with pytest.raises(InputError, match="exists with other content"):
        save_object(received, path.parent)
    assert save_object(received, path.parent, force=True) == save_object(received, path.parent)  # no conflict any more
    assert list(path.parent.iterdir()) == [path]
    assert path.is_file()
    assert not path.is_symlink()
    assert (path.read_bytes(), victim.read_text()) == (b"sent", there)


@pytest.mark.parametrize("mode", [0o755, 0o4711, 0o640])
def test_a_received_file_may_not_be_executed(tmp_path: Path, mode: int) -> None:
    """Though it replaces a program: whoever sends chooses name and content."""
    (tmp_path / "tool").write_text("a program")
    (tmp_path / "tool").chmod(mode)
    save_object(ReceivedObject("tool", b"sent", 4, "00", 1, 1, "", 0, 0.0), tmp_path, force=True)
    assert (tmp_path / "tool").read_bytes() == b"sent"
    assert (tmp_path / "tool").stat().st_mode & 0o7777 == mode & 0o666


def test_a_pipe_with_the_name_of_a_tap_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.jpg-000000.npz")
    with pytest.raises(UsageError, match="is no file"):
        dump_stages(tmp_path, "a.jpg", 0, {})


def test_names_as_long_as_file_systems_take_are_cut_where_something_is_appended(
    tmp_path: Path, names: list[str]
) -> None:
    lens = "[lens]\nwidth = 340\nheight = 620\ndist_coeffs = [-0.1, 0.0, 0.0, 0.0]\n"
    matrix = "camera_matrix = [[500.0, 0.0, 169.5], [0.0, 500.0, 309.5], [0.0, 0.0, 1.0]]\n"
    camera = tmp_path / "profiles" / "camera.toml"
    camera.write_text(f"{camera.read_text()}\n{lens}{matrix}")
    for name in (240 * "a" + "1.png", 240 * "a" + "2.png", 79 * "字" + ".png"):
        (tmp_path / "in" / name).write_bytes((tmp_path / "in" / "a.png").read_bytes())
    taps, pictures = tmp_path / "taps", tmp_path / "pictures"
    command = ["decode", str(tmp_path / "in"), *names, "--truth", "auto", "--dump-dir", str(taps)]
    assert run([*command, "--save-undistorted", str(pictures)]) in (0, 1)
    assert len([*taps.rglob("*.npz")]) == len([*pictures.rglob("*.png")]) == 4
    assert run(["inspect", str(tmp_path / "in" / (240 * "a" + "1.png")), *names, "--out", str(tmp_path / "page")]) == 0


def test_taps_of_files_with_one_name_stand_in_their_folders(
    tmp_path: Path, names: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """As do names that differ in odd characters only; a file of somebody else is not replaced."""
    for number, place in enumerate(("a/IMG.png", "b/IMG.png", "b/c/x y.png", "b/c/x_y.png")):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        write_frame(tmp_path / place, number)
    camera = tmp_path / "profiles" / "camera.toml"
    camera.write_text(
        f"{camera.read_text()}\n[lens]\nwidth = 340\nheight = 620\ndist_coeffs = [-0.1, 0.0, 0.0, 0.0]\n"
        "camera_matrix = [[500.0, 0.0, 169.5], [0.0, 500.0, 309.5], [0.0, 0.0, 1.0]]\n"
    )
    taps, pictures = tmp_path / "taps", tmp_path / "pictures"
    command = ["decode", str(tmp_path / "a"), str(tmp_path / "b"), *names, "--dump-dir", str(taps)]
    assert run([*command, "--save-undistorted", str(pictures)]) in (0, 1)
    assert set(contents(taps)) == {
        *("a/IMG.png-000000.npz", "b/IMG.png-000000.npz"),
        *("b/c/x_y.png-000000.npz", "b/c/2/x_y.png-000000.npz"),
    }
    assert {"a/IMG.png.00000.png", "b/IMG.png.00000.png"} <= set(contents(pictures))
    assert outputs.PICTURE.search(contents(pictures)["a/IMG.png.00000.png"])
    lights = [np.load(path)["samples.light"].tobytes() for path in taps.rglob("*.npz")]
    assert len(set(lights)) == 4
    assert run(command) in (0, 1)
    (taps / "a" / "IMG.png-000000.npz").write_text("mine")
    capsys.readouterr()
    assert run(command) == 2
    assert "no earlier output" in capsys.readouterr().err
    assert (taps / "a" / "IMG.png-000000.npz").read_text() == "mine"


@pytest.mark.parametrize(
    "option", ["--json", "--junit", "--summary", "--payloads", "--save-camera", "--dump-dir", "--save-undistorted"]
)
def test_what_cannot_be_written_is_wrong_usage_before_any_work(
    option: str, tmp_path: Path, names: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """/proc takes no file, whoever asks; a file is no folder."""
    name = "o.csv" if option == "--summary" else "o"
    for target in (f"/proc/{name}", str(tmp_path / "in" / "a.png" / name)):
        assert run(["decode", str(tmp_path / "in" / "a.png"), option, target, *names]) == 2
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.startswith(f"vlc-rx: {option} {target}: ")
        assert captured.err.count("\n") == 1


def test_cells_that_a_spreadsheet_would_compute_are_quoted(tmp_path: Path, names: list[str]) -> None:
    shown = {name: f"'{name}" for name in ("=1+1.png", "+a.png", "@b.png", "-c.png")}
    shown |= {"d.png": "d.png", "line\nbreak.png": "line\\nbreak.png", "back\\n.png": "back\\\\n.png"}
    shown |= {os.fsdecode(b"byte\xff.png"): "byte\\xff.png"}  # the names can be told from what is shown
    write_frame(tmp_path / "=1+1.png", 1)
    with chdir(tmp_path):
        for name in shown:
            Path(name).write_bytes(Path("=1+1.png").read_bytes())
        assert run(["decode", "--summary", "s.csv", "--payloads", "p.csv", *names, "--quiet", "--", *shown]) == 0
    for name in ("s.csv", "p.csv"):
        rows = csv.DictReader(io.StringIO((tmp_path / name).read_text(encoding="utf-8")))
        assert list(dict.fromkeys(row["source"] for row in rows)) == list(shown.values())


@pytest.mark.parametrize(
    "command",
    [
        "benchmark confidence --count 1 --out photos",
        "benchmark compare . --out photos",
        "benchmark --quick --out photos",
        "inspect a.png --out photos",
        "train photos",
    ],
)
def test_folders_of_results_are_no_folders_of_photos(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A folder that holds other files is neither written to nor marked as one that runs pass over."""
    monkeypatch.setattr("rxcli.lab.benchmark.compare.check_checkout", lambda path: path)
    photos = {"a.jpg": b"photo", "notes.csv": b"mine"}
    (tmp_path / "photos").mkdir()
    for name, data in photos.items():
        (tmp_path / "photos" / name).write_bytes(data)
    for name in ("torch", "onnx", "matplotlib") if command == "train photos" else ():
        pytest.importorskip(name)
    with chdir(tmp_path):
        write_frame(Path("a.png"), 1)
        assert run(command.split()) == 2
    said = capsys.readouterr().err
    assert "photos: the folder holds files that this command did not write; name a new folder" in said
    assert contents(tmp_path / "photos") == photos


def test_a_folder_of_results_is_new_empty_or_the_commands_own(tmp_path: Path) -> None:
    for _ in range(2):
        outputs.claim_own_folder("--out", tmp_path / "a" / "new", ("*.journal.jsonl",))
        (tmp_path / "a" / "new" / "confidence.csv").write_text("x")
    assert (tmp_path / "a" / "new" / outputs.OUTPUT_MARKER).exists()
    for name, file in (("old", "confidence.journal.jsonl"), ("other", "a.jpg")):
        (tmp_path / name).mkdir()
        (tmp_path / name / file).touch()
    outputs.claim_own_folder("--out", tmp_path / "old", ("*.journal.jsonl",))
    outputs.claim_own_folder("--out", tmp_path / "other", (), force=True)
    for name, reason in (("other", "the folder holds files"), ("other/a.jpg", "File exists")):
        with pytest.raises(UsageError, match=reason):
            outputs.claim_own_folder("--out", tmp_path / name, ("*.journal.jsonl",))
