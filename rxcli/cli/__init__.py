"""The command line: one file per command."""

import sys
from os import path

# While `python -m` looks for a command, its first place is the current folder, whose files are not to be trusted.
_is_started = sys.argv[:1] == ["-m"] and "rxcli.cli.main" in sys.orig_argv and not sys.flags.safe_path
if _is_started and sys.path[0] != path.dirname(path.dirname(path.dirname(__file__))):
    del sys.path[0]
