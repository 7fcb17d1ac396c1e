"""The command line: one file per command."""

import sys
from os import _exit, path, write

# While `python -m` looks for a command, its first place is the current folder, whose files are not to be trusted.
_is_started = sys.argv[:1] == ["-m"] and "rxcli.cli.main" in sys.orig_argv and not sys.flags.safe_path
if _is_started and sys.path[0] != path.dirname(path.dirname(path.dirname(__file__))):
    del sys.path[0]


def _end(number: int, _frame: object) -> None:
    """End the program before it has begun."""
    write(2, b"vlc-rx: interrupted\n")
    _exit(128 + number)


if _is_started or path.basename(sys.argv[0]).startswith("vlc-rx"):  # until `rxcli.cli.main` takes signals itself
    from signal import SIGINT, signal

    signal(SIGINT, _end)
