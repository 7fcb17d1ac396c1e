"""What several commands share: options, the receiver's options made of them, writing JSON."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from rxcli.cli.kinds import CAMERA, SCREEN, SHARE, Numbers
from rxcli.errors import UsageError

if TYPE_CHECKING:
    from rxcli.options import ReceiverOptions
    from rxcli.outputs import Output

_F = TypeVar("_F", bound=Callable[..., Any])


def options(*rows: tuple[Any, ...]) -> Callable[[_F], _F]:
    """Options of a command as a table of flags, type, default and help; and, where that is not all, further arguments.

    Flags are as click takes them, separated by spaces, a parameter's name of its own among them; the first may have
    what help calls its value, as in "--json=FILE|- json_path". A type of None makes a switch, a list takes the option
    several times, a tuple holds the choices, and a default that is not None is shown. Further arguments are a
    dictionary of `click.option`'s.
    """

    def decorate(command: _F) -> _F:
        for flags, kind, default, text, *more in reversed(rows):
            long_flag, *short_flags = flags.split()
            flag, _, metavar = long_flag.partition("=")
            arguments = {"metavar": metavar or None, "callback": _finite, **_option(kind, default)}
            arguments |= more[0] if more else {}
            command = click.option(flag, *short_flags, help=text, **arguments)(command)
        return command

    return decorate


def _option(kind: Any, default: Any) -> dict[str, Any]:
    if kind is None:
        return {"default": None} if default is None else {"is_flag": True, "default": default}
    if isinstance(kind, list):
        return {"type": kind[0], "multiple": True}
    shown = {} if default is None else {"default": default, "show_default": True}
    return {"type": click.Choice(kind) if isinstance(kind, tuple) else kind, **shown}


def _finite(context: click.Context, parameter: click.Parameter, value: Any) -> Any:
    """Refuse nan and infinities: no comparison with nan fails, so that it passes every bound."""
    for number in value if isinstance(value, tuple) else (value,):
        if isinstance(number, float) and not math.isfinite(number):
            raise click.BadParameter(f"{number} is no number", context, parameter)
    return value


_SCREEN_HELP = "Screen profile; may be given several times. [default: auto, the one whose clock fits best]"
_CAMERA_HELP = "Camera profile; of several, each file takes the one that fits it. [default: auto, all that are known]"
_CORNERS_HELP = "The screen's corners in stored pixels, top-left first, clockwise as a viewer sees the screen."
_SKIP_HELP = (
    "Switch off a shortcut: no_screen, unlikely, no_packets, dark_columns, certain_columns or tracking; several times."
)
_MEMORY_HELP = "Memory for the files that are being received; the least complete are dropped."
#: What `receiver_options` takes.
receiver_arguments = options(
    ("--screen=NAME|FILE|auto screens", [SCREEN], None, _SCREEN_HELP, {"envvar": "VLC_RX_SCREEN"}),
    ("--camera=NAME|FILE|auto cameras", [CAMERA], None, _CAMERA_HELP, {"envvar": "VLC_RX_CAMERA"}),
    ("--corners", Numbers("120.5,80"), None, _CORNERS_HELP, {"nargs": 4, "metavar": "x,y x,y x,y x,y"}),
    ("--mirrored", None, False, "The picture is mirrored, as of some front cameras: count columns from its right."),
    ("--cae", ("auto", "always", "never"), "auto", "When the auto-encoder runs."),
    ("--min-confidence", SHARE, None, "Report only packets of at least this confidence. [default: all]"),
    ("--no-skip=NAME", [str], None, _SKIP_HELP),
    ("--file-memory=MB file_memory_mb", click.IntRange(1, 1 << 20), 512, _MEMORY_HELP),
)
#: For every command that writes files which may be somebody's.
force_argument = options(
    ("--force", None, False, "Replace files that are there already and were not written by the same option.")
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
    from inspect import signature

    from rxcli.options import receiver_options as options_of

    names = signature(options_of).parameters.keys() & given.keys()
    return options_of(**{name: given[name] for name in names if given[name] not in (None, ())}, **more)


def refuse(*rules: tuple[object, str, str]) -> None:
    """Refuse what makes no sense: each rule is a condition, and the reason and the next step where it holds.

    Raises:
        UsageError: of the first rule that holds.
    """
    for is_wrong, reason, step in rules:
        if is_wrong:
            raise UsageError(reason, step)


def output(option: str, path: Any, ours: re.Pattern[bytes], **more: Any) -> Output | None:
    """The file that an option names; None where the option was not given, or means stdout. See `Output`."""
    from rxcli.outputs import Output

    return None if path is None or str(path) == "-" else Output(option, Path(path), ours, **more)


def json_output(path: str | None, *keys: str) -> Output | None:
    """The file of a command's --json, or None; earlier outputs are recognised by their `keys`."""
    from rxcli.outputs import json_with

    return output("--json", path, json_with(*keys))


def write_json(value: Any, path: str | None) -> None:
    """Write `value` as indented JSON to a file, or to stdout where `path` is "-"; nowhere where it is None.

    Raises:
        InputError: the file cannot be written.
    """
    if path is None:
        return
    import msgspec

    from rxcli.outputs import write_whole

    finite = msgspec.json.decode(msgspec.json.encode(value, enc_hook=float))  # null for nan and infinities
    text = json.dumps(finite, indent=2)
    if path == "-":
        click.echo(text)
    else:
        write_whole(Path(path), text + "\n")


def field_table(text: str) -> dict[str, Any]:
    """FIELD=VALUE as a table of TOML; a text needs no quotes."""
    import tomllib

    name, _, value = text.partition("=")
    for toml in (value, json.dumps(value)):
        try:
            return tomllib.loads(f"{name} = {toml}")
        except tomllib.TOMLDecodeError:
            continue
    raise UsageError(f"--set {text}: not FIELD=VALUE", "name a field and its value, as in isp.quality=85")
