"""Exit codes and the exceptions that carry them.

An expected failure of reception (no screen, no signal) is a status in the result, never an exception. Exceptions are
for input that cannot be read, for wrong configuration, and for wrong usage; `rxcli.cli.main` turns them into one line.
"""

from __future__ import annotations

import re
from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes of every command."""

    OK = 0
    NOT_RECEIVED = 1
    USAGE = 2
    UNREADABLE = 3
    INTERRUPTED = 130
    TERMINATED = 143


#: Where several codes hold, the first of these wins.
_PRECEDENCE = (
    *(ExitCode.TERMINATED, ExitCode.INTERRUPTED),
    *(ExitCode.USAGE, ExitCode.UNREADABLE, ExitCode.NOT_RECEIVED, ExitCode.OK),
)


def worst(codes: list[ExitCode]) -> ExitCode:
    """The exit code of a run in which each of `codes` occurred."""
    return next((code for code in _PRECEDENCE if code in codes), ExitCode.OK)


#: What only a reader with a command line can do.
_COMMAND = re.compile(r"--[a-z]|\bpip |vlc-rx ")


def without_commands(text: str) -> str:
    """A message for readers without a command line: parentheses and clauses about options and commands left out."""
    text = re.sub(r" \([^()]*\)", lambda found: "" if _COMMAND.search(found[0]) else found[0], text)
    clauses = re.split(r"(; |, or )", text)
    kept = [
        (joint, clause)
        for joint, clause in zip(["", *clauses[1::2]], clauses[::2], strict=True)
        if not _COMMAND.search(clause)
    ]
    return "".join(joint * (n > 0) + clause for n, (joint, clause) in enumerate(kept))


class Terminated(BaseException):
    """SIGTERM came: the run ends as by Ctrl-C, with what it has so far."""


class ReceiverError(Exception):
    """An error the user can act on: what, why, and the next step, in one line.

    Args:
        message: the thing concerned, the constraint and the value.
        hint: the next step, as a sentence.
    """

    exit_code = ExitCode.NOT_RECEIVED

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        return f"{self.message}; {self.hint}" if self.hint else self.message


class InputError(ReceiverError):
    """A file or device that cannot be read."""

    exit_code = ExitCode.UNREADABLE


class OutputError(InputError):
    """A file that cannot be written: the disk is full, for instance. It ends the run, whatever the source in hand."""


class ProfileError(ReceiverError):
    """A profile that is missing, malformed, or holds an impossible value."""

    exit_code = ExitCode.USAGE


class UsageError(ReceiverError):
    """A combination of options that makes no sense."""

    exit_code = ExitCode.USAGE


def capitalised(text: str) -> str:
    """`text` with a capital, for titles."""
    return text[:1].upper() + text[1:]


def sentence(text: str) -> str:
    """A message or a hint as a sentence of its own, for pages."""
    return capitalised(text).rstrip(".") + "." if text else ""
