"""Text for people on a terminal: lines that end between words, states in colour."""

from __future__ import annotations

import os
import re
import shutil
from typing import TextIO

import click

_COLOURS = {"ok": "green", "partial": "yellow", "weak": "yellow", "dark": "bright_black"}
_COLOURS |= dict.fromkeys(("no_packet", "no_screen", "no_signal", "unreadable"), "red")
#: A state stands in a heading between bars, or in a table behind the column's number.
_STATE = re.compile(rf"(?<= \| )({'|'.join(_COLOURS)})(?= \||$)|(?<=\d  )({'|'.join(_COLOURS)})(?=\*? )")


def for_terminal(text: str, stream: TextIO) -> str:
    """`text` as it is shown on `stream`: as it is where that is no terminal; no colours where NO_COLOR is set."""
    if stream is None or not stream.isatty():
        return text
    from rxcli.results.report import wrapped

    return coloured(wrapped(text, shutil.get_terminal_size().columns), bool(os.environ.get("NO_COLOR")))


def coloured(text: str, plain: bool = False) -> str:
    """States of frames and columns in their colours."""
    if plain:
        return text
    return "\n".join(
        _STATE.sub(lambda found: click.style(found[0], fg=_COLOURS[found[0]]), line) for line in text.split("\n")
    )
