"""Every block of code in README and docs does what a reader would do with it: it runs, and Python is typed."""

import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import chdir
from pathlib import Path

import click
import numpy as np
import pytest

from rxcli.cli.main import cli

ROOT = Path(__file__).resolve().parents[1]
#: Notebooks tell what was done once; the rest is to be done again by whoever reads it.
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "sample_frames" / "README.md"]
_BLOCK = re.compile(r"^( *)```(\w*)\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
#: What the pages name and a reader has: sample -> names that it stands in for.
_FILES = {
    "phone_chelsea_17k3.jpg": ("photo.jpg", "a.jpg", "b.jpg", "captures/a.jpg", "boards/a.jpg"),
    "xtrans_sky_17k3.dng": ("photo.raf", "photo.dng"),
    "video1080_chelsea_17k3.mp4": ("clip.mp4", "capture.mp4"),
    "phone12.toml": ("mycam.toml", "mine.toml", "my.toml"),
}
_FOLDERS = ("p777", "p888", "w999", "captures", "boards", "lab", "../other", "other")
#: Commands that run here; of all others the arguments are read, as they need a camera, a board, a lamp or an hour.
_RUN = ("profiles", "decode sample_frames/", "inspect sample_frames/", "demo")


def blocks(page: Path, *languages: str) -> list[str]:
    text = page.read_text(encoding="utf-8")
    found = [(m[2], re.sub(rf"^{m[1]}", "", m[3], flags=re.MULTILINE)) for m in _BLOCK.finditer(text)]
    return [code for language, code in found if language in languages]


def commands() -> Iterator[list[str]]:
    """Arguments of every `vlc-rx` in a block of commands."""
    for page in PAGES:
        for block in blocks(page, "sh", "bash", "console", ""):
            for line in re.sub(r"\\\n\s*", " ", block).splitlines():
                for part in re.split(r"\s(?:&&|\|)\s", line):
                    words = shlex.split(part, comments=True)
                    if words and words[0].endswith("vlc-rx"):
                        yield words[1:]


PYTHON = [page for page in PAGES if blocks(page, "python")]
COMMANDS = list(dict.fromkeys(tuple(words) for words in commands()))


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the samples, and with what a reader is taken to have."""
    folder = tmp_path_factory.mktemp("desk")
    shutil.copytree(ROOT / "sample_frames", folder / "sample_frames")
    for name in _FOLDERS:
        (folder / name).mkdir(parents=True, exist_ok=True)
    for sample, names in _FILES.items():
        for name in names:
            shutil.copy(ROOT / "sample_frames" / sample, folder / name)
    for name in ("p777/phones", "p888/phones", "w999/warped"):
        (folder / f"{name}.journal.jsonl").touch()
    return folder


def test_the_walk_sees_blocks_and_commands() -> None:
    assert {page.name for page in PYTHON} >= {"python.md", "simulator.md"}
    assert len(COMMANDS) > 40
    assert "decode" in {words[0] for words in COMMANDS}


def test_ci_finds_the_command_that_runs_the_tests() -> None:
    """In one line of README, which `.ci/run` runs as it stands there."""
    assert "grep -F \"'.[test]'\" README.md" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    [line] = re.findall(r"^.*'\.\[test\]'.*$", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert line.startswith("python3 -m venv .venv && ")
    assert line.endswith("-m pytest")


def test_the_page_on_integration_names_one_folder() -> None:
    """The baseline is of the files that the job decodes."""
    text = (ROOT / "docs" / "ci.md").read_text(encoding="utf-8")
    assert {name for name in re.findall(r"vlc-rx decode (\S+)", text) if not name.endswith(".jpg")} == {"fixtures"}


@pytest.mark.slow
@pytest.mark.parametrize("page", PYTHON, ids=lambda page: page.name)
def test_python_blocks_run(page: Path, desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each block stands alone, and prints what a comment says that it prints."""
    np.random.seed(0)  # noqa: NPY002  # what a block draws without a seed of its own
    with chdir(desk):
        for number, code in enumerate(blocks(page, "python")):
            exec(compile(code, f"{page.name}, block {number}", "exec"), {"__name__": "__main__"})
            printed = capsys.readouterr().out
            assert [line for line in re.findall(r"# prints: (.*)", code) if line not in printed] == []


@pytest.mark.slow
def test_python_blocks_are_typed(tmp_path: Path) -> None:
    for page in PYTHON:
        for number, code in enumerate(blocks(page, "python")):
            (tmp_path / f"{page.stem}_{number}.py").write_text(code, encoding="utf-8")
    command = [sys.executable, "-m", "mypy", "--strict", "--config-file", "pyproject.toml", *tmp_path.glob("*.py")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_commands_are_understood(words: tuple[str, ...], desk: Path) -> None:
    """What click does before a command runs: every option is known, every value is one."""
    command: click.Command = cli
    context, arguments = click.Context(command, info_name="vlc-rx"), list(words)
    while isinstance(command, click.Group) and arguments and not arguments[0].startswith("-"):
        name = arguments.pop(0)
        found = command.get_command(context, name)
        assert found is not None, f"no command {name!r}"
        command, context = found, click.Context(found, context, name)
    if not {"--help", "--list", "--version"} & set(arguments):
        with chdir(desk):
            command.make_context(command.name or "", arguments, parent=context.parent)


@pytest.mark.slow
@pytest.mark.parametrize("words", [words for words in COMMANDS if " ".join(words).startswith(_RUN)], ids=" ".join)
def test_commands_run(words: tuple[str, ...], desk: Path) -> None:
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from rxcli.cli.main import main; main()"
    done = subprocess.run([sys.executable, "-c", code, *words], cwd=desk, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr
