"""Outputs never destroy: what would be lost is refused before anything is opened; what is written is whole."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest
from small_frames import write_frame, write_profiles

from rxcli import outputs
from rxcli.cli.main import run
from rxcli.errors import OutputError, UsageError
from rxcli.outputs import Output, claim, encode_png, replacing, write_whole


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
@pytest.mark.parametrize("target", ["in/a.png", "in/link.png", "profiles/screen.toml", "profiles/camera.toml"])
@pytest.mark.parametrize("force", [[], ["--force"]])
def test_an_input_or_a_profile_is_never_written_over(
    option: str,
    target: str,
    force: list[str],
    tmp_path: Path,
    names: list[str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "in" / "link.png").symlink_to("a.png")
    before = contents(tmp_path)
    assert run(["decode", str(tmp_path / "in" / "a.png"), option, str(tmp_path / target), *force, *names]) == 2
    assert contents(tmp_path) == before
    said = capsys.readouterr().err
    assert said.startswith(f"vlc-rx: {option} {tmp_path / target}: the same file is ")
    assert said.count("\n") == 1


def test_a_truth_that_is_read_is_never_written_over(tmp_path: Path, names: list[str]) -> None:
    path = tmp_path / "in" / "a.png"
    before = contents(tmp_path)
    truth = str(tmp_path / "in" / "a.truth.json")
    for options in (["--truth", truth], ["--truth", "auto"]):
        assert run(["decode", str(path), *options, "--json", truth, "--force", *names]) == 2
    assert run(["decode", str(path), "--json", truth, *names]) == 2  # not read, and not ours either
    assert contents(tmp_path) == before


def test_one_file_twice_and_folders_are_refused(
    tmp_path: Path, names: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    picture, same = str(tmp_path / "in" / "a.png"), str(tmp_path / "out.csv")
    os.symlink(tmp_path, tmp_path / "here")
    for options, reason in (
        (["--summary", same, "--junit", same], "the same file is written by"),
        (["--summary", same, "--json", str(tmp_path / "here" / "out.csv")], "the same file is written by"),
        (["--json", str(tmp_path / "in")], "is a folder"),
        (["--json", str(tmp_path / "none" / "out.jsonl")], "there is no such folder"),
    ):
        assert run(["decode", picture, *options, *names]) == 2
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


def test_other_commands_do_not_destroy_either(tmp_path: Path, names: list[str]) -> None:
    picture = tmp_path / "in" / "a.png"
    before = contents(tmp_path)
    for command in (
        ["simulate", str(picture)],
        ["simulate", str(tmp_path / "b.png"), "--camera-profile", str(picture)],
        ["simulate", str(tmp_path / "b.png"), "--picture", str(picture), "--camera-profile", str(picture), "--force"],
        ["profiles", "which", str(picture), "--json", str(picture)],
        ["profiles", "show", names[1], "--json", names[1]],
        ["calibrate", "lens", str(picture), "--picture", str(picture)],
        ["calibrate", "lens", str(picture), "--save", str(picture)],
        ["calibrate", "shutter", str(picture), "--frequency", "1000", "--json", str(picture)],
        ["live", "/dev/video0", "--json", str(picture)],
    ):
        assert run(command) == 2, command
        assert contents(tmp_path) == before, command


def test_a_capture_of_the_simulator_may_be_made_anew(tmp_path: Path) -> None:
    command = ["simulate", str(tmp_path / "a.jpg"), "--preset", "phone-plain", "--scale", "0.05"]
    command += ["--camera-profile", str(tmp_path / "c.toml")]
    assert run(command) == 0
    first = contents(tmp_path)
    assert run(command) == 0
    assert contents(tmp_path) == first
    truth = json.loads((tmp_path / "a.truth.json").read_text())
    (tmp_path / "a.truth.json").write_text(json.dumps({k: v for k, v in truth.items() if k != "written_by"}))
    assert run(command) == 2
    assert run([*command, "--force"]) == 0


def half_written(path: Path, error: Exception) -> None:
    with replacing(path) as hidden:
        hidden.write_text("half")
        raise error


def test_what_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_whole(path, "old")
    with pytest.raises(ZeroDivisionError):
        half_written(path, ZeroDivisionError())
    with pytest.raises(OutputError, match=r"a\.txt: cannot be written \(No space left"):
        half_written(path, OSError(28, os.strerror(28)))
    assert contents(tmp_path) == {"a.txt": b"old"}
    with pytest.raises(OutputError, match="cannot be written"):
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
    with pytest.raises(OutputError, match="/dev/full: cannot be written"):
        write_whole(Path("/dev/full"), "new")


def test_names_that_no_system_takes(tmp_path: Path) -> None:
    for name in ("a\0b", "x" * 300, "loop"):
        (tmp_path / "loop").unlink(missing_ok=True)
        (tmp_path / "loop").symlink_to("loop")
        with pytest.raises(UsageError):
            claim([Output("--json", tmp_path / name, outputs.JOURNAL)])


def test_our_png_is_known_again(tmp_path: Path) -> None:
    import cv2

    picture = np.arange(60, dtype=np.uint8).reshape(6, 10)
    data = encode_png(picture)
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), picture)
    assert outputs.PICTURE.search(data)
    assert not outputs.PICTURE.search(cv2.imencode(".png", picture)[1].tobytes())


def test_taps_of_files_with_one_name_stand_in_their_folders(tmp_path: Path, names: list[str]) -> None:
    """`a/IMG.png` and `b/IMG.png` had one NPZ between them, and so had names that differ in odd characters only."""
    for number, place in enumerate(("a/IMG.png", "b/IMG.png", "b/c/x y.png", "b/c/x_y.png")):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        write_frame(tmp_path / place, number)
    camera = tmp_path / "profiles" / "camera.toml"
    camera.write_text(
        f"{camera.read_text()}\n[lens]\nwidth = 340\nheight = 620\ndist_coeffs = [-0.1, 0.0, 0.0, 0.0]\n"
        "camera_matrix = [[500.0, 0.0, 169.5], [0.0, 500.0, 309.5], [0.0, 0.0, 1.0]]\n"
    )
    folders = [str(tmp_path / "a"), str(tmp_path / "b")]
    taps, pictures = tmp_path / "taps", tmp_path / "pictures"
    assert run(["decode", *folders, "--dump-dir", str(taps), "--save-undistorted", str(pictures), *names]) in (0, 1)
    assert set(contents(taps)) == {
        *("a/IMG.png-000000.npz", "b/IMG.png-000000.npz"),
        *("b/c/x_y.png-000000.npz", "b/c/2/x_y.png-000000.npz"),
    }
    assert {"a/IMG.png.00000.png", "b/IMG.png.00000.png"} <= set(contents(pictures))
    lights = [np.load(path)["samples.light"].tobytes() for path in taps.rglob("*.npz")]
    assert len(set(lights)) == 4


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


def test_other_commands_try_their_outputs_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "a.png"
    picture.write_bytes(b"")
    for arguments in (
        ["inspect", str(picture), "--out", "/proc/o"],
        ["simulate", "/proc/o.png"],
        ["encode", "--text", "a", "--screen", "data-17k3", "--out", "/proc/o.npy"],
        ["calibrate", "shutter", str(picture), "--frequency", "1000", "--save", "/proc/o.toml"],
    ):
        assert run(arguments) == 2
        assert "cannot be written (No such file or directory)" in capsys.readouterr().err


def test_a_file_that_may_not_be_changed_is_no_output(tmp_path: Path) -> None:
    path = tmp_path / "o"
    path.write_bytes(b"")
    path.chmod(0o400)
    if os.access(path, os.W_OK):
        pytest.skip("permissions do not bind this user")
    with pytest.raises(UsageError, match="Permission denied"):
        claim([Output("--json", path, outputs.ANYTHING)])


def test_a_failing_disk_is_no_wrong_usage() -> None:
    full = outputs.unwritable(Path("a"), OSError(errno.ENOSPC, "No space left on device"))
    readonly = outputs.unwritable(Path("a"), OSError(errno.EROFS, "Read-only file system"))
    assert (full.exit_code, readonly.exit_code) == (3, 2)


def test_claiming_leaves_no_trace(tmp_path: Path) -> None:
    claim([Output("--json", tmp_path / "o", outputs.ANYTHING), Output("--junit", tmp_path / "p", outputs.JUNIT)])
    outputs.claim_folder("--out", tmp_path / "folder")
    assert [path.name for path in tmp_path.rglob("*")] == ["folder"]


def test_taps_do_not_replace_a_file_of_somebody_else(
    tmp_path: Path, names: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    picture, taps = tmp_path / "in" / "a.png", tmp_path / "taps"
    assert run(["decode", str(picture), "--dump-dir", str(taps), *names]) == 0
    assert run(["decode", str(picture), "--dump-dir", str(taps), *names]) == 0
    (taps / "a.png-000000.npz").write_text("mine")
    assert run(["decode", str(picture), "--dump-dir", str(taps), *names]) == 2
    assert "no earlier output" in capsys.readouterr().err
    assert (taps / "a.png-000000.npz").read_text() == "mine"


def test_cells_that_a_spreadsheet_would_compute_are_quoted(tmp_path: Path, names: list[str]) -> None:
    folder = tmp_path / "odd"
    folder.mkdir()
    for name in ("=1+1.png", "+a.png", "@b.png", "-c.png", "d.png"):
        (folder / name).write_bytes(b"")
    before = Path.cwd()
    os.chdir(folder)
    try:
        odd = ["=1+1.png", "+a.png", "@b.png", "-c.png", "d.png"]
        run(["decode", "--summary", "s.csv", *names, "--quiet", "--", *odd])
        write_frame(folder / "=1+1.png", 1)
        run(["decode", "--payloads", "p.csv", *names, "--quiet", "--", "=1+1.png"])
    finally:
        os.chdir(before)
    sources = [line.split(",")[0] for line in (folder / "s.csv").read_text().splitlines()[1:]]
    assert sources == ["'=1+1.png", "'+a.png", "'@b.png", "'-c.png", "d.png"]
    assert {line.split(",")[0] for line in (folder / "p.csv").read_text().splitlines()[1:]} == {"'=1+1.png"}


@pytest.mark.parametrize(
    "command",
    [
        ["benchmark", "confidence", "--count", "1"],
        ["benchmark", "compare", "."],
        ["benchmark", "--quick"],
        ["inspect", "a.png"],
        ["train"],
    ],
    ids=lambda command: " ".join(command[:2]),
)
def test_folders_of_results_are_no_folders_of_photos(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A folder that holds other files is neither written to nor marked as one that runs pass over."""
    monkeypatch.chdir(tmp_path)
    write_frame(tmp_path / "a.png", 1)
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "a.jpg").write_bytes(b"photo")
    (photos / "notes.csv").write_text("mine")
    for name in ("torch", "onnx", "matplotlib") if command == ["train"] else ():
        pytest.importorskip(name)
    if command[1:2] == ["compare"]:
        monkeypatch.setattr("rxcli.lab.benchmark.compare.check_checkout", lambda path: path)
    assert run([*command, *(["--out"] if command != ["train"] else []), "photos"]) == 2
    said = capsys.readouterr().err
    assert "photos: the folder holds files that this command did not write; name a new folder" in said
    assert sorted(path.name for path in photos.iterdir()) == ["a.jpg", "notes.csv"]


def test_a_folder_of_results_is_new_empty_or_the_commands_own(tmp_path: Path) -> None:
    new, old, other = tmp_path / "a" / "new", tmp_path / "old", tmp_path / "other"
    for _ in range(2):
        outputs.claim_own_folder("--out", new, ("*.journal.jsonl",))
        (new / "confidence.csv").write_text("x")
    assert (new / outputs.OUTPUT_MARKER).exists()
    for folder, name in ((old, "confidence.journal.jsonl"), (other, "a.jpg")):
        folder.mkdir()
        (folder / name).touch()
    outputs.claim_own_folder("--out", old, ("*.journal.jsonl",))
    outputs.claim_own_folder("--out", other, (), force=True)
    with pytest.raises(UsageError, match="the folder holds files"):
        outputs.claim_own_folder("--out", other, ("*.journal.jsonl",))
    with pytest.raises(UsageError, match="File exists"):
        outputs.claim_own_folder("--out", other / "a.jpg")
    assert not any((folder / outputs.OUTPUT_MARKER).exists() for folder in (old, other))
