"""`vlc-rx`: the group of commands, and the one place that turns errors into a line and an exit code.

Nothing heavy is imported before a command runs, so that `vlc-rx --help` is quick; short help texts stand here for the
same reason.
"""

import gc
import io
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from typing import Any

import click

from rxcli import __version__
from rxcli.cli.groups import SuggestingGroup
from rxcli.errors import ExitCode, OutputError, ReceiverError, Terminated, is_out_of_memory, printable

_COMMANDS = {
    "demo": "Try it without a screen: a simulated photo with a text.",
    "decode": "Texts, files and payloads of photos, clips and folders.",
    "serve": "A page for photos from a phone and for a live camera.",
    "live": "Texts, files and payloads of a V4L2 camera.",
    "encode": "What a screen must send: a text or a file as labels.",
    "inspect": "Pictures of every stage for one photo.",
    "measure": "Frequency, duty and depth of lights that blink in a photo.",
    "calibrate": "Measure a lens or a shutter; writes a camera profile.",
    "simulate": "Captures with known truth, from a picture and a payload.",
    "benchmark": "Run time against error; stability.",
    "train": "Train the auto-encoder.",
    "profiles": "Known screens and cameras, and which one a file gets.",
}
#: New objects between two collections of garbage. With Python's 700 they take a tenth of the time of all imports.
_OBJECTS_BETWEEN_COLLECTIONS = 20_000


def _switch(flags: list[str], switch_on: Callable[[], None], text: str) -> click.Option:
    """An option of every command that acts before the command runs."""

    def act(_context: click.Context, _parameter: click.Parameter, given: bool) -> None:
        if given:
            switch_on()

    return click.Option(flags, is_flag=True, is_eager=True, expose_value=False, callback=act, help=text)


_SWITCHES = [
    _switch(
        ["-v", "--verbose"],
        lambda: logging.getLogger("rxcli").setLevel(logging.DEBUG),
        "Log what is done to stderr; show the traceback of an internal error.",
    ),
    _switch(
        ["--log-json"],
        lambda: setattr(_StderrHandler, "as_json", True),
        "Write logs and errors to stderr as JSON, one object a line.",
    ),
]


class _PipeClosedError(Exception):
    """The reader of our output has gone."""


class _LazyGroup(SuggestingGroup):
    """A group whose commands are modules of `rxcli.cli`, imported when they are run."""

    def list_commands(self, _context: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        if name in _COMMANDS and name not in self.commands:
            command = getattr(import_module(f"rxcli.cli.{name}"), name)
            command.params += [switch for switch in _SWITCHES if switch not in command.params]
            self.add_command(command, name)
        return super().get_command(context, name)

    def format_commands(self, context: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(_COMMANDS.items()))

    def invoke(self, context: click.Context) -> Any:
        try:
            result = super().invoke(context)
            sys.stdout.flush()
        except BrokenPipeError:
            raise _PipeClosedError from None  # before click turns it into its own exit code
        return result


@click.group(
    name="vlc-rx",
    cls=_LazyGroup,
    params=list(_SWITCHES),
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120},
)
@click.version_option(__version__, prog_name="vlc-rx", message="%(prog)s %(version)s")
@click.pass_context
def cli(context: click.Context) -> None:
    """Receive data that the mini-LED backlight of a display sends to rolling-shutter cameras.

    Try it: vlc-rx demo. Then vlc-rx decode photo.jpg, or vlc-rx inspect photo.jpg for a page that shows what was seen,
    or vlc-rx serve for photos from a phone.

    stdout carries data only; logs and progress go to stderr. Exit codes: 0 every input gave a packet or a text, 1 some
    gave none, 2 bad usage or profile, 3 an input could not be read or an output could not be written, 130 interrupted,
    143 terminated.
    """
    from rxcli.resources import user_dir

    path = user_dir() / "config.toml"
    if os.path.isfile(path):  # in a home that may be unreadable
        from rxcli.cli.config import option_defaults

        context.default_map = dict.fromkeys(_COMMANDS, option_defaults(path))


def main() -> None:
    """Entry point of `vlc-rx`."""
    # Our matrices are small: threads inside their products spin more than they help, and numpy is not loaded yet.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _reserve_standard_streams()
    gc.set_threshold(_OBJECTS_BETWEEN_COLLECTIONS)
    os.environ["PYTHONSAFEPATH"] = "1"  # no child takes modules from the current folder
    sys.path[:] = filter(None, sys.path)
    code = run(sys.argv[1:], is_program=True)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run has ended, and its exit code stands
    gc.freeze()  # else the interpreter looks for garbage among all objects once more before it ends
    sys.exit(code)


def _end(number: int, _frame: object) -> None:
    """End the run with its summary, which a second signal does not disturb; one after a second ends it at once."""
    begun_s = time.monotonic()
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, lambda *_: time.monotonic() > begun_s + 1 and os._exit(128 + number))
    raise Terminated if number == signal.SIGTERM else KeyboardInterrupt


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


def run(arguments: Sequence[str], is_program: bool = False) -> int:
    """Run `vlc-rx` with `arguments`; errors become one line on stderr. Returns the exit code.

    Args:
        arguments: of the command line.
        is_program: whether signals end it with its summary.
    """
    _log_to_stderr()
    color = False if os.environ.get("NO_COLOR") else None  # https://no-color.org
    try:
        for number in (signal.SIGINT, signal.SIGTERM) if is_program else ():
            signal.signal(number, _end)
        code = cli.main(args=list(arguments), prog_name="vlc-rx", standalone_mode=False, color=color)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.ctx.get_help())
        return ExitCode.OK
    except (_PipeClosedError, BrokenPipeError):
        _leave_stdout()
        return ExitCode.INTERRUPTED
    except (Exception, KeyboardInterrupt, Terminated) as error:
        message, ending = _explained(error)
        logging.getLogger("rxcli").error("%s", message)
        return ending
    return int(code or ExitCode.OK)


def _explained(error: BaseException) -> tuple[str, ExitCode]:
    """An error in one line with the next step, and its exit code."""
    match error:
        case click.ClickException():
            context = getattr(error, "ctx", None)
            path = context.command_path if context is not None else "vlc-rx"
            message = error.format_message().rstrip(".").replace("\n", " ")
            return f"{message}; see `{path} --help`", ExitCode.USAGE
        case click.Abort() | KeyboardInterrupt():
            return "interrupted", ExitCode.INTERRUPTED
        case Terminated():
            return "terminated", ExitCode.TERMINATED
        case ReceiverError():
            return str(error), error.exit_code
        case OSError(filename=None):  # own errors name their files
            _leave_stdout()
            reason = f"stdout: cannot be written ({error.strerror or error})"
            return f"{reason}; redirect it to where there is room", ExitCode.UNREADABLE
        case OSError():
            reason = f"{error.filename}: {error.strerror or error}"
            return f"{reason}; make room or correct the permissions, and try again", ExitCode.UNREADABLE
        case _ if is_out_of_memory(error):
            step = "decode fewer or smaller files at a time"
            return f"more memory is needed than there is; {step}", ExitCode.UNREADABLE
    logging.getLogger("rxcli").debug("internal error", exc_info=error)
    reason = f"internal error ({type(error).__name__}: {error})"
    return f"{reason}; run again with --verbose and report its output", ExitCode.NOT_RECEIVED


def _log_to_stderr() -> None:
    log = logging.getLogger("rxcli")
    log.setLevel(logging.WARNING)
    _StderrHandler.as_json = False
    if not log.handlers:
        log.addHandler(_StderrHandler())


class _StderrHandler(logging.Handler):
    """Writes to what stderr is at the time; errors are messages for people, and other records name their level."""

    #: One JSON object a line, where `--log-json` asks for it; times are Unix seconds.
    as_json = False

    def emit(self, record: logging.LogRecord) -> None:
        traceback = logging.Formatter().formatException(record.exc_info) if record.exc_info else ""
        level, message = record.levelname, printable(record.getMessage())
        text = f"vlc-rx: {'' if level == 'ERROR' else f'{level}: '}{message}" + f"\n{traceback}" * bool(traceback)
        if self.as_json:
            about = {"time": round(record.created, 3), "level": level.lower(), "message": record.getMessage()}
            text = json.dumps(about | ({"traceback": traceback} if traceback else {}))
        with suppress(OSError):  # nobody hears that nobody hears
            click.echo(text, err=True)


def _leave_stdout() -> None:
    """What still waits to be written cannot be, and is not tried again at exit."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    main()
