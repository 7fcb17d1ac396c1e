"""What several commands share: options, the receiver's options made of them, writing JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.shell_completion import CompletionItem

if TYPE_CHECKING:
    from rxcli.options import ReceiverOptions
    from rxcli.outputs import Output, Taken

_F = TypeVar("_F", bound=Callable[..., Any])
AUTO = "auto"


def options(*rows: tuple[Any, ...]) -> Callable[[_F], _F]:
    """Options of a command as a table of flags, type, default and help; and, where that is not all, further arguments.

    Flags are as click takes them, separated by spaces, a parameter's name of its own among them; the first may have
    what help calls its value, as in "--json=FILE|- json_path". A type of None makes a switch, a list takes the option
    several times, a tuple holds the choices, and a default that is not None is shown. Further arguments are a
    dictionary of `click.option`'s.
    """

    def decorate(command: _F) -> _F:
        for flags, kind, default, text, *more in reversed(rows):
            first, *others = flags.split()
            flag, _, metavar = first.partition("=")
            arguments = {"metavar": metavar or None, **_option(kind, default), **(more[0] if more else {})}
            command = click.option(flag, *others, help=text, **arguments)(command)
        return command

    return decorate


def _option(kind: Any, default: Any) -> dict[str, Any]:
    if kind is None:
        return {"default": None} if default is None else {"is_flag": True, "default": default}
    if isinstance(kind, list):
        return {"type": kind[0], "multiple": True}
    shown = {} if default is None else {"default": default, "show_default": True}
    return {"type": click.Choice(kind) if isinstance(kind, tuple) else kind, **shown}


class _Point(click.ParamType[tuple[float, float]]):
    """`x,y` in pixels."""

    name = "x,y"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        if isinstance(value, tuple):
            return value
        try:
            x, y = (float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not two numbers, such as 120.5,80", param, ctx)
        if not (abs(x) < 1e6 and abs(y) < 1e6):  # written so that NaN fails
            self.fail(f"{value!r} is no position in a picture", param, ctx)
        return x, y


def _check_skip(_context: click.Context, _parameter: click.Parameter, names: tuple[str, ...]) -> tuple[str, ...]:
    from rxcli.options import SKIPS

    for name in names:
        if name not in SKIPS:
            raise click.BadParameter(f"{name!r} is not one of {', '.join(SKIPS)}")
    return names


def complete_files(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Names of files and folders, for the shell."""
    return [CompletionItem(incomplete, type="file")]


def _complete_profiles(
    folder: str, _context: click.Context, _parameter: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    from rxcli.resources import profile_dirs

    stems = {path.stem for _, parent in profile_dirs() for path in (parent / folder).glob("*.toml")}
    names = sorted(name for name in [AUTO, *stems] if name.startswith(incomplete))
    return [CompletionItem(name) for name in names] or [CompletionItem(incomplete, type="file")]


#: Names of profiles, then files, for the shell.
complete_screens, complete_cameras = (partial(_complete_profiles, folder) for folder in ("screens", "cameras"))


#: What `receiver_options` takes.
receiver_arguments = options(
    (
        "--screen=NAME|FILE|auto screens",
        [str],
        None,
        "Screen profile; may be given several times. [default: auto, the one whose clock fits best]",
        {"shell_complete": complete_screens, "envvar": "VLC_RX_SCREEN"},
    ),
    (
        "--camera=NAME|FILE|auto cameras",
        [str],
        None,
        "Camera profile; of several, each file takes the one that matches its make, model and size. "
        "[default: auto, all that are known]",
        {"shell_complete": complete_cameras, "envvar": "VLC_RX_CAMERA"},
    ),
    (
        "--corners",
        _Point(),
        None,
        "The screen's corners in stored pixels, top-left first, clockwise as a viewer sees the screen.",
        {"nargs": 4, "metavar": "x,y x,y x,y x,y"},
    ),
    ("--mirrored", None, False, "The picture is mirrored, as of some front cameras: count columns from its right."),
    ("--cae", ("auto", "always", "never"), "auto", "When the auto-encoder runs."),
    (
        "--min-confidence",
        click.FloatRange(0, 1),
        None,
        "Report only packets of at least this confidence. [default: all]",
    ),
    (
        "--no-skip=NAME",
        [str],
        None,
        "Switch off a shortcut (no_screen, no_packets, dark_columns, certain_columns, tracking); may be given several "
        "times.",
        {"callback": _check_skip},
    ),
    (
        "--file-memory=MB file_memory_mb",
        click.IntRange(1, 1 << 20),
        512,
        "Memory for the files that are being received; the least complete are dropped.",
    ),
)
_RECEIVER = ("screens", "cameras", "corners", "mirrored", "cae", "min_confidence", "no_skip", "file_memory_mb")
#: For every command that writes files which may be somebody's.
force_argument = options(
    ("--force", None, False, "Replace files that are there already and were not written by the same option."),
)


def receiver_options(given: dict[str, Any], **more: Any) -> ReceiverOptions:
    """`rxcli.options.receiver_options` of what the command line gave: an option not given is `auto`.

    Args:
        given: the options of a command, those of `receiver_arguments` among them.
        more: what the command knows besides.

    Raises:
        ProfileError: a profile is missing or malformed.
        UsageError: the corners are no convex quadrilateral.
    """
    from rxcli.options import receiver_options as options_of

    told = {name: given[name] for name in _RECEIVER if given[name] not in (None, ())}
    return options_of(**told, **more)


def claim_outputs(
    outputs: Iterable[Output | None],
    inputs: Iterable[str | Path] = (),
    profiles: Iterable[str | Path | None] = (),
    force: bool = False,
) -> Taken:
    """Refuse outputs that would destroy something, before anything is opened (see `rxcli.outputs.claim`).

    Args:
        outputs: all files that the command will write; None where an option was not given.
        inputs: files that it reads.
        profiles: names and files of profiles that it reads.
        force: of `force_argument`.

    Raises:
        UsageError: one of them would.
    """
    from rxcli.outputs import claim

    named = [path for path in profiles if path is not None and path != AUTO]
    return claim([output for output in outputs if output is not None], inputs, named, force)


def json_output(path: str | None, *keys: str) -> Output | None:
    """The file of a command's --json, None where there is none; earlier ones are told by the `keys` they hold."""
    from rxcli.outputs import Output, json_with

    return None if path in (None, "-") else Output("--json", Path(str(path)), json_with(*keys))


def write_json(value: Any, path: str) -> None:
    """Write `value` as indented JSON to a file, or to stdout where `path` is "-".

    Raises:
        InputError: the file cannot be written.
    """
    text = json.dumps(_finite(value), indent=2)
    if path == "-":
        click.echo(text)
        return
    from rxcli.outputs import write_whole

    write_whole(Path(path), text + "\n")


def _finite(value: Any) -> Any:
    """JSON knows no NaN and no infinity."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
