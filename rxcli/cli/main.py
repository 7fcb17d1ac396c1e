"""`vlc-rx`: the group of commands, and the one place that turns errors into a line and an exit code.

Nothing heavy is imported before a command runs, so that `vlc-rx --help` is quick; short help texts stand here for the
same reason.
"""

from __future__ import annotations

import gc
import io
import json
import logging
import math
import os
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import click

from rxcli import __version__
from rxcli.cli.groups import PlainContext, SuggestingGroup
from rxcli.errors import ExitCode, OutputError, ReceiverError, Terminated

_COMMANDS = {
    "demo": "Try it without a screen: a simulated photo with a text.",
    "decode": "Texts, files and payloads of photos, clips and folders.",
    "serve": "A page for photos from a phone and for a live camera.",
    "live": "Texts, files and payloads of a V4L2 camera.",
    "encode": "What a screen must send: a text or a file as labels.",
    "inspect": "Pictures of every stage for one photo.",
    "calibrate": "Measure a lens or a shutter; writes a camera profile.",
    "simulate": "Captures with known truth, from a picture and a payload.",
    "benchmark": "Run time against error; stability.",
    "train": "Train the auto-encoder.",
    "profiles": "Known screens and cameras, and which one a file gets.",
}


def _set_verbose(context: click.Context, _parameter: click.Parameter, verbose: bool) -> None:
    if verbose:
        logging.getLogger("rxcli").setLevel(logging.DEBUG)


_VERBOSE = click.Option(
    ["-v", "--verbose"],
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_set_verbose,
    help="Log what is done to stderr; show the traceback of an internal error.",
)


def _set_log_json(_context: click.Context, _parameter: click.Parameter, as_json: bool) -> None:
    if as_json:
        _StderrHandler.as_json = True


_LOG_JSON = click.Option(
    ["--log-json"],
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_set_log_json,
    help="Write logs and errors to stderr as JSON, one object a line.",
)


class _PipeClosedError(Exception):
    """The reader of our output has gone."""


class _LazyGroup(SuggestingGroup):
    """A group whose commands are modules of `rxcli.cli`, imported when they are run."""

    def list_commands(self, _context: click.Context) -> list[str]:
        return [name for name in _COMMANDS if find_spec(f"rxcli.cli.{name}") is not None]

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        if name not in self.list_commands(context):
            return None
        command = getattr(import_module(f"rxcli.cli.{name}"), name)
        assert isinstance(command, click.Command)
        command.context_class = PlainContext
        if _VERBOSE not in command.params:
            command.params += [_VERBOSE, _LOG_JSON]
            _take_finite_numbers_only(command)
        return command

    def format_commands(self, context: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, _COMMANDS[name]) for name in self.list_commands(context)])

    def invoke(self, context: click.Context) -> Any:
        try:
            result = super().invoke(context)
            sys.stdout.flush()
        except BrokenPipeError:
            raise _PipeClosedError from None  # before click makes an exit code of its own of it
        return result


def _take_finite_numbers_only(command: click.Command) -> None:
    """Refuse nan and infinities for every option: no comparison with nan fails, so that it passes every bound."""
    for parameter in command.params:
        if isinstance(parameter.type, click.types.FloatParamType):
            parameter.callback = _finite_then(parameter.callback)
    if isinstance(command, click.Group):
        for below in command.commands.values():
            _take_finite_numbers_only(below)


def _finite_then(callback: Callable[..., Any] | None) -> Callable[..., Any]:
    def check(context: click.Context, parameter: click.Parameter, value: Any) -> Any:
        for number in value if isinstance(value, tuple) else (value,):
            if number is not None and not math.isfinite(number):
                raise click.BadParameter(f"{number} is no number", context, parameter)
        return value if callback is None else callback(context, parameter, value)

    return check


@click.group(
    name="vlc-rx",
    cls=_LazyGroup,
    params=[_VERBOSE, _LOG_JSON],
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120},
)
@click.version_option(__version__, prog_name="vlc-rx", message="%(prog)s %(version)s")
@click.pass_context
def cli(context: click.Context) -> None:
    """Receive data that the mini-LED backlight of a display sends to rolling-shutter cameras.

    Try it: vlc-rx demo. Then vlc-rx decode photo.jpg, or vlc-rx inspect photo.jpg for a page that shows what was seen,
    or vlc-rx serve for photos from a phone.

    stdout carries data only; logs and progress go to stderr. Exit codes: 0 every input gave a packet, 1 some input gave
    none, 2 bad usage or profile, 3 an input could not be read or an output could not be written, 130 interrupted, 143
    terminated.
    """
    from rxcli.cli.config import option_defaults

    context.default_map = option_defaults(list(_COMMANDS))


def main() -> None:
    """Entry point of `vlc-rx`."""
    # Our matrices are small: threads inside their products spin more than they help, and numpy is not loaded yet.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _reserve_standard_streams()
    signal.signal(signal.SIGTERM, _terminate)
    code = run(sys.argv[1:])
    gc.freeze()  # else the interpreter looks for garbage among all objects once more before it ends
    sys.exit(code)


def _terminate(_number: int, _frame: object) -> None:
    raise Terminated


def _reserve_standard_streams() -> None:
    """Replace closed standard streams, so that no file gets their numbers: libraries write to them."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
    if sys.stdout is None:
        sys.stdout = _ClosedStream()


class _ClosedStream(io.TextIOBase):
    """Replacement of a closed stdout, which fails on the first write."""

    def write(self, _text: str) -> int:
        raise OutputError("stdout is closed", "redirect it to a file, or use --quiet")


def run(arguments: Sequence[str]) -> int:
    """Run `vlc-rx` with `arguments`; errors become one line on stderr. Returns the exit code."""
    _log_to_stderr()
    color = False if os.environ.get("NO_COLOR") else None  # https://no-color.org
    try:
        code = cli.main(args=list(arguments), prog_name="vlc-rx", standalone_mode=False, color=color)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.ctx.get_help())
        return ExitCode.OK
    except click.ClickException as error:
        return _say_usage(error)
    except (click.Abort, KeyboardInterrupt):
        _say("interrupted")
        return ExitCode.INTERRUPTED
    except Terminated:
        _say("terminated")
        return ExitCode.TERMINATED
    except (_PipeClosedError, BrokenPipeError):
        _leave_stdout()
        return ExitCode.INTERRUPTED
    except ReceiverError as error:
        _say(str(error))
        return error.exit_code
    except OSError as error:
        return _say_system(error)
    except MemoryError:
        _say("more memory is needed than there is; decode fewer or smaller files at a time")
        return ExitCode.UNREADABLE
    except Exception as error:
        return _say_internal(error)
    return int(code or ExitCode.OK)


def _log_to_stderr() -> None:
    log = logging.getLogger("rxcli")
    log.setLevel(logging.WARNING)
    _StderrHandler.as_json = False
    if not log.handlers:
        log.addHandler(_StderrHandler())


class _StderrHandler(logging.Handler):
    """Writes to what stderr is at the time, around a progress bar if there is one."""

    #: One JSON object a line, where `--log-json` asks for it.
    as_json = False

    def __init__(self) -> None:
        super().__init__()
        self.setFormatter(logging.Formatter("vlc-rx: %(levelname)s: %(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        with suppress(OSError):  # nobody hears that nobody hears
            click.echo(_json_line(record) if self.as_json else self.format(record), err=True)


def _json_line(record: logging.LogRecord) -> str:
    """Time (Unix seconds), level, message, and a traceback where there is one."""
    line = {"time": round(record.created, 3), "level": record.levelname.lower(), "message": record.getMessage()}
    if record.exc_info:
        line["traceback"] = logging.Formatter().formatException(record.exc_info)
    return json.dumps(line)


def _say(message: str) -> None:
    """One line on stderr, for people or as JSON, if it can be written."""
    if _StderrHandler.as_json:
        logging.getLogger("rxcli").error("%s", message)
        return
    with suppress(OSError):
        click.echo(f"vlc-rx: {message}", err=True)


def _say_usage(error: click.ClickException) -> int:
    """Click's message in one line, with the command to ask for help."""
    context = getattr(error, "ctx", None)
    path = context.command_path if context is not None else "vlc-rx"
    message = error.format_message().rstrip(".").replace("\n", " ")
    _say(f"{message}; see `{path} --help`")
    return ExitCode.USAGE


def _leave_stdout() -> None:
    """What still waits to be written cannot be, and is not tried again at exit."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _say_system(error: OSError) -> int:
    """The system refuses something: no space, no right, too many files."""
    reason = error.strerror or str(error)
    if error.filename is None:  # own errors name their files
        _say(f"stdout: cannot be written ({reason}); redirect it to where there is room")
        _leave_stdout()
    else:
        _say(f"{error.filename}: {reason}; make room or correct the permissions, and try again")
    return ExitCode.UNREADABLE


def _say_internal(error: Exception) -> int:
    log = logging.getLogger("rxcli")
    if log.isEnabledFor(logging.DEBUG):
        log.debug("internal error", exc_info=error)
    _say(f"internal error ({type(error).__name__}: {error}); run again with --verbose and report its output")
    return ExitCode.NOT_RECEIVED


if __name__ == "__main__":
    main()
