"""The group of commands: help, version, and errors as one line with an exit code."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import click
import pytest

from rxcli import __version__
from rxcli.cli import main as cli_main
from rxcli.cli.main import run
from rxcli.cli.terminal import coloured
from rxcli.errors import InputError

ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}


def test_help_lists_the_commands_there_are_and_no_others(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--help"]) == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.split("Commands:")[1].splitlines() if line.strip()]
    assert "decode" in listed
    assert all(find_spec(f"rxcli.cli.{name}") for name in listed)


def test_every_command_has_help_and_verbose(capsys: pytest.CaptureFixture[str]) -> None:
    group = cli_main.cli
    for name in group.list_commands(click.Context(group)):
        assert run([name, "--help"]) == 0, name
        assert "--verbose" in capsys.readouterr().out, name


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--version"]) == 0
    assert capsys.readouterr().out == f"vlc-rx {__version__}\n"


def test_help_loads_nothing_heavy() -> None:
    code = "import sys; from rxcli.cli.main import run; run(['--help']); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split("\n")[-2].split())
    assert "click" in loaded
    assert not loaded & {"numpy", "msgspec", "cv2", "av", "rawpy", "onnxruntime", "tqdm", "rxcli.receiver.pipeline"}


def test_one_photo_loads_only_what_it_needs() -> None:
    """Half of its time is the loading of packages."""
    sample = Path(__file__).resolve().parents[2] / "sample_frames" / "phone_chelsea_17k3.jpg"
    code = f"import sys; from rxcli.cli.main import run; run(['decode', {str(sample)!r}]); print(*sys.modules)"
    environment = ENVIRONMENT | {"OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    loaded = set(done.stdout.splitlines()[-1].split())
    assert "rxcli.receiver.pipeline" in loaded
    unused = {"tqdm", "email", "scipy", "av", "rawpy", "skimage", "tifffile", "threadpoolctl"}
    assert not loaded & unused


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nonsense"], "no command 'nonsense'; there are demo, decode"),
        (["decoed"], "no command 'decoed'; did you mean 'decode'?; see `vlc-rx --help`"),
        (["calibrate", "lense"], "no command 'lense'; did you mean 'lens'?; see `vlc-rx calibrate --help`"),
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
        (["decode", "a", "--no-skip", "nix"], "'nix' is not one of no_screen"),
        (["decode", "a", "--corners", "1,2", "3,4", "5", "6,7"], "'5' is not two numbers, such as 120.5,80"),
        (["decode", "a", "--corners", "1,2", "3,4", "5,nan", "6,7"], "'5,nan' is no position in a picture"),
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


@pytest.mark.parametrize("arguments", [[], ["calibrate"]])
def test_bare_groups_show_help_and_are_no_error(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(arguments) == 0
    captured = capsys.readouterr()
    assert "Commands:" in captured.out
    assert captured.err == ""


def test_help_breaks_no_words_at_80_characters(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    group = cli_main.cli
    for name in group.list_commands(click.Context(group)):
        run([name, "--help"])
        lines = capsys.readouterr().out.splitlines()
        assert max(map(len, lines)) <= 80, name
        assert not [line for line in lines if line.endswith("-") and line[-2:-1].isalpha()], name
        assert not any("\u2011" in line for line in lines)


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
    (tmp_path / "config.toml").write_text('camera = "from-file"\n')
    picture = ["decode", str(tmp_path / "no.jpg"), "--quiet"]
    assert run(picture) == 2
    assert "no profile 'from-file' among cameras" in capsys.readouterr().err
    monkeypatch.setenv("VLC_RX_CAMERA", "from-env")
    assert run(picture) == 2
    assert "no profile 'from-env' among cameras" in capsys.readouterr().err
    assert run([*picture, "--camera", "xs10"]) == 3
    (tmp_path / "config.toml").write_text('kamera = "x"\n')
    assert run(picture) == 2
    assert "config.toml: unknown key 'kamera'; known are screen, camera, workers" in capsys.readouterr().err
    (tmp_path / "config.toml").write_text('workers = "x"\n')
    assert run(picture) == 2
    assert "workers has a value of the wrong kind ('x')" in capsys.readouterr().err


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


def with_command(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    """Put a command that raises `error` into the group."""

    @click.command()
    def fails() -> None:
        raise error

    monkeypatch.setattr(cli_main.cli, "get_command", lambda context, name: fails)


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (InputError("a.jpg: no", "do this"), 3, "vlc-rx: a.jpg: no; do this\n"),
        (KeyboardInterrupt(), 130, "vlc-rx: interrupted\n"),
        (ZeroDivisionError("oh"), 1, "vlc-rx: internal error (ZeroDivisionError: oh); run again with --verbose"),
    ],
)
def test_errors_become_a_line_and_a_code(
    error: BaseException, code: int, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with_command(monkeypatch, error)
    assert run(["fails"]) == code
    said = capsys.readouterr().err
    assert line in said
    assert "Traceback" not in said


def test_verbose_shows_the_traceback_of_an_internal_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with_command(monkeypatch, ZeroDivisionError("oh"))
    assert run(["--verbose", "fails"]) == 1
    assert "Traceback" in capsys.readouterr().err
