"""The group of commands: help, version, and errors as one line with an exit code."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import click
import pytest
from commands import COMMAND, ENVIRONMENT
from small_frames import write_frame, write_profiles

from rxcli import __version__
from rxcli.cli import main as cli_main
from rxcli.cli.main import run
from rxcli.cli.printing import coloured
from rxcli.errors import InputError


def test_help_of_every_command_breaks_no_words_at_80_characters(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert run(["--version"]) == run([]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith(f"vlc-rx {__version__}\n")
    listed = [line.split()[0] for line in shown.split("Commands:")[1].splitlines() if line.strip()]
    assert listed == cli_main.cli.list_commands(click.Context(cli_main.cli))
    for arguments in (["calibrate"], *([name, "--help"] for name in listed)):
        assert run(arguments) == 0, arguments
        lines = capsys.readouterr().out.splitlines()
        assert any("--verbose" in line for line in lines), arguments
        assert max(map(len, lines)) <= 80, arguments
        assert not [line for line in lines if line.endswith("-") and line[-2:-1].isalpha()], arguments
        assert not any("\u2011" in line for line in lines)
        assert not any(line.endswith("...") and "Usage:" not in line for line in lines), arguments


def test_ctrl_c_before_the_program_has_begun_is_no_traceback(tmp_path: Path) -> None:
    """A library that it loads first stands for the moment."""
    (tmp_path / "click.py").write_text(
        "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\nimport time\ntime.sleep(9)\n"
    )
    environment = {**ENVIRONMENT, "PYTHONPATH": os.pathsep.join((str(tmp_path), ENVIRONMENT["PYTHONPATH"]))}
    ended = subprocess.run([*COMMAND, "profiles"], env=environment, capture_output=True, cwd=tmp_path.parent)
    assert (ended.returncode, ended.stderr) == (130, b"vlc-rx: interrupted\n")


def test_profiles_show_no_control_characters_of_names(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    odd, home = tmp_path / "a\x1b[31m\u202e.png", tmp_path / "home" / "screens"
    write_frame(odd, 1)
    write_profiles(tmp_path)
    home.mkdir(parents=True)
    text = (tmp_path / "screen.toml").read_text()
    (home / "odd.toml").write_text(f'{text}description = "a\\u001b[31m"\n')
    (tmp_path / "s\x1b[31m.toml").write_text(text)
    monkeypatch.setenv("VLC_RX_HOME", str(tmp_path / "home"))
    commands = (["which", str(odd)], ["list"], ["show", "odd"], ["validate", str(tmp_path / "s\x1b[31m.toml")])
    for command in commands:
        assert run(["profiles", *command]) == 0
        shown = capsys.readouterr()
        assert "\x1b" not in shown.out + shown.err, command
        assert "\u202e" not in shown.out + shown.err, command


def loaded_by(*arguments: str) -> set[str]:
    """Modules that a command has loaded."""
    code = f"import sys; from rxcli.cli.main import run; run({arguments!r}); print(*sys.modules)"
    environment = ENVIRONMENT | {"OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    return set(done.stdout.splitlines()[-1].split())


@pytest.mark.parametrize("arguments", [("--help",), ("decode", "--help"), ("live", "--help")], ids=" ".join)
def test_help_loads_nothing_heavy(arguments: tuple[str, ...]) -> None:
    loaded = loaded_by(*arguments)
    assert "click" in loaded
    assert not loaded & {"numpy", "msgspec", "cv2", "av", "rawpy", "onnxruntime", "tqdm", "rxcli.receiver.receive"}


def test_one_photo_loads_only_what_it_needs() -> None:
    """Half of its time is the loading of packages."""
    loaded = loaded_by("decode", str(Path(__file__).resolve().parents[2] / "sample_frames" / "phone_chelsea_17k3.jpg"))
    assert "rxcli.receiver.receive" in loaded
    assert not loaded & {"tqdm", "email", "scipy", "av", "rawpy", "skimage", "tifffile", "threadpoolctl", "PIL"}
    assert not loaded & {"rxcli.receiver.clip", "rxcli.runs.provenance", "logging.handlers", "concurrent.futures"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nonsense"], "No such command 'nonsense'; see `vlc-rx --help`"),
        (["decoed"], "'decoed'. (Did you mean one of: 'decode', 'demo', 'encode'?); see `vlc-rx --help`"),
        (["calibrate", "lense"], "(Did you mean one of: 'lens', 'lensfun'?); see `vlc-rx calibrate --help`"),
        (["decode"], "Missing argument 'PATH...'; see `vlc-rx decode --help`"),
        (["decode", "a", "--max-ber", "2"], "Invalid value for '--max-ber'"),
        (["decode", "a", "--nonsense"], "No such option"),
        (["decode", "a", "--max-ber", "0.1"], "--max-ber needs the truth; give --truth FILE"),
        (["decode", "a", "--resume"], "--resume needs the file that --json wrote"),
        (["decode", "a", "--resume", "--json", "-"], "--resume needs the file that --json wrote"),
        (["decode", "a", "--workers", "2", "--cluster", "tcp://x"], "--workers and --cluster exclude each other"),
        (["decode", "-", "--cluster", "tcp://x"], "stdin cannot be sent to a cluster"),
        (["decode", "a", "--summary", "s.xls"], "--summary must end in .csv or .parquet (got 's.xls')"),
        (["decode", "a", "--summary", "none/s.csv"], "--summary none/s.csv: there is no such folder"),
        (["decode", "a", "--dump-dir", "/dev/null/x"], "--dump-dir /dev/null/x: cannot be written (Not a directory)"),
        (["decode", "a", "b", "--truth", "t.json"], "--truth t.json is the truth of one file (2 were given)"),
        (["decode", "a", "--screen", "nix"], "no profile 'nix' among screens"),
        (["decode", "a", "--camera", "nix"], "no profile 'nix' among cameras"),
        (["simulate", "a.jpg", "--exposure", "1/0"], "'1/0' is no time"),
        (["live", "/dev/video9", "--exposure", "-1"], "'-1' is no time"),
        (["decode", "a", "--no-skip", "nix"], "no_skip must be one of no_screen"),
        (
            ["decode", "a", "--corners", "1,2", "3,4", "5", "6,7"],
            "'5' is not 2 numbers (below a million), such as 120.5,80",
        ),
        (["decode", "a", "--corners", "1,2", "3,4", "5,nan", "6,7"], "'5,nan' is not 2 numbers"),
        (["simulate", "a.jpg", "--corners", "1,2,3"], "'1,2,3' is not 8 numbers"),
        (["decode", "a", "--corners", "0,0", "9,9", "9,0", "0,9"], "corners must go once round a convex outline"),
    ],
)
def test_wrong_usage_is_one_line_and_exit_code_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("vlc-rx: ")
    assert message in captured.err
    assert captured.err.count("\n") == 1


#: Modules that a run loads: ours, of the standard library, of packages; here they leave a mark when they are loaded.
MODULES = ("multiprocessing", "__future__", "signal", "click", "json", "numpy", "rxcli")


@pytest.mark.parametrize("way", ["script", "module"])
def test_no_module_is_taken_from_the_current_folder(way: str, tmp_path: Path) -> None:
    """A folder of photos may be anybody's."""
    script, photos = tmp_path / "vlc-rx", tmp_path / "photos"
    script.write_text("from rxcli.cli.main import main\nif __name__ == '__main__':\n    main()\n")
    photos.mkdir()
    for name in MODULES if way == "script" else MODULES[:-1]:  # `python -m` has to find the package first
        (photos / f"{name}.py").write_text(f"open({str(tmp_path / 'loaded')!r}, 'a').write({name!r})")
    for name in ("a.jpg", "b.jpg"):
        (photos / name).write_bytes(b"\xff\xd8\xff cut")
    command = [sys.executable, str(script)] if way == "script" else COMMAND
    done = subprocess.run([*command, "decode", ".", "--workers", "2"], cwd=photos, env=ENVIRONMENT, check=False)
    assert done.returncode == 3
    assert not (tmp_path / "loaded").exists()


def test_a_machine_without_room_for_the_libraries_is_told_so() -> None:
    photo = Path(__file__).resolve().parents[2] / "sample_frames" / "phone_chelsea_17k3.jpg"
    command = f"ulimit -v 400000; exec {' '.join(COMMAND)} decode --quiet {photo}"
    done = subprocess.run(["bash", "-c", command], env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert done.returncode == 3
    assert (
        done.stderr == f"vlc-rx: {photo}: cannot be decoded (more memory is needed than there is); try it by itself\n"
    )


def test_without_a_home_nothing_is_taken_from_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where no home is known, `~` is a name like any other."""
    (tmp_path / "~" / ".config" / "vlc-rx").mkdir(parents=True)
    (tmp_path / "~" / ".config" / "vlc-rx" / "config.toml").write_text("workers = 0")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("VLC_RX_HOME")
    monkeypatch.setattr("platformdirs.user_config_path", lambda *_, **__: Path("~/.config/vlc-rx"))
    assert run(["profiles"]) == 0
    assert "no home, set VLC_RX_HOME" in capsys.readouterr().out


def test_a_home_that_may_not_be_read_is_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stat = os.stat

    def refusing(path: Any, *arguments: Any, **more: Any) -> os.stat_result:
        if str(path).startswith(str(tmp_path)):
            raise PermissionError(13, "Permission denied", str(path))
        return stat(path, *arguments, **more)

    monkeypatch.setenv("VLC_RX_HOME", str(tmp_path))
    monkeypatch.setattr(os, "stat", refusing)
    assert run(["profiles", "show", "xs10"]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("workers", ["1", "2"])
def test_names_of_files_in_warnings_and_logs_are_printable(workers: str, tmp_path: Path) -> None:
    """They may hold what clears a terminal, or turns its text round."""
    for name in ("a\x1b[2J\u202egpj.jpg", "b.jpg"):
        (tmp_path / name).write_bytes(b"\xff\xd8\xff cut")
    command = [*COMMAND, "decode", ".", "--workers", workers, "--verbose"]
    done = subprocess.run(command, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert "a\\u001b[2J\\u202egpj.jpg" in done.stderr
    assert all(line.isprintable() for line in done.stderr.splitlines())


def test_logs_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["decode", "a", "--resume", "--log-json"]) == 2
    line = json.loads(capsys.readouterr().err)
    assert line["level"] == "error"
    assert line["message"].startswith("--resume needs the file")
    assert run(["decode", "a", "--resume"]) == 2
    assert capsys.readouterr().err.startswith("vlc-rx: --resume")  # the next run logs as before


def test_defaults_from_the_environment_and_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command line before the environment before the file."""
    monkeypatch.setenv("VLC_RX_HOME", str(tmp_path))
    picture = ["decode", str(tmp_path / "no.jpg"), "--quiet"]
    for text, told in (
        ('kamera = "x"', "unknown field `kamera`); it may hold screen, camera and workers"),
        ('workers = "x"', "Expected `int | null`, got `str` - at `$.workers`"),
        ('camera = "from-file"', "no profile 'from-file' among cameras"),
    ):
        (tmp_path / "config.toml").write_text(text)
        assert run(picture) == 2
        assert told in capsys.readouterr().err
    monkeypatch.setenv("VLC_RX_CAMERA", "from-env")
    assert run(picture) == 2
    assert "no profile 'from-env' among cameras" in capsys.readouterr().err
    assert run([*picture, "--camera", "xs10"]) == 3


def test_completion_names_profiles_and_files(tmp_path: Path) -> None:
    def complete(line: str) -> str:
        told = {"_VLC_RX_COMPLETE": "bash_complete", "COMP_WORDS": line, "COMP_CWORD": str(len(line.split()) - 1)}
        code = "import sys; sys.argv[0] = 'vlc-rx'; from rxcli.cli.main import main; main()"
        command = [sys.executable, "-c", code]
        return subprocess.run(command, env=ENVIRONMENT | told, capture_output=True, text=True, check=False).stdout

    assert "plain,paper-17k3" in complete("vlc-rx decode --screen paper-1")
    assert "plain,xs10" in complete("vlc-rx decode --camera x")
    assert complete("vlc-rx decode a").startswith("file,")


def test_states_have_colours_on_a_terminal_alone() -> None:
    text = "a.jpg | partial | 3 packets\n    col  status     w\n      0  ok*        5\n    1-3  dark       none"
    shown = coloured(text)
    assert click.unstyle(shown) == text
    assert shown.count("\x1b[0m") == 3
    assert coloured(text, plain=True) == text


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (InputError("a.jpg: no", "do this"), 3, "vlc-rx: a.jpg: no; do this\n"),
        (KeyboardInterrupt(), 130, "vlc-rx: interrupted\n"),
        (PermissionError(13, "no right", "a.txt"), 3, "vlc-rx: a.txt: no right; make room or correct the permissions"),
        (MemoryError(), 3, "vlc-rx: more memory is needed than there is; decode fewer or smaller files"),
        (ZeroDivisionError("oh"), 1, "vlc-rx: internal error (ZeroDivisionError: oh); run again with --verbose"),
    ],
)
def test_errors_become_a_line_and_a_code(
    error: BaseException, code: int, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    @click.command()
    def fails() -> None:
        raise error

    monkeypatch.setattr(cli_main.cli, "get_command", lambda context, name: fails)
    assert run(["fails"]) == code
    said = capsys.readouterr().err
    assert line in said
    assert "Traceback" not in said
    assert run(["--verbose", "fails"]) == code
    assert ("Traceback" in capsys.readouterr().err) == isinstance(error, ZeroDivisionError)
