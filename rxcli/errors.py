"""Exit codes and the exceptions that carry them.

An expected failure of reception (no screen, no signal) is a status in the result, never an exception. Exceptions are
for input that cannot be read, for wrong configuration, and for wrong usage; `rxcli.cli.main` turns them into one line.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes of every command, in order of precedence."""

    OK = 0
    NOT_RECEIVED = 1
    UNREADABLE = 3
    USAGE = 2
    INTERRUPTED = 130
    TERMINATED = 143


def worst(codes: list[ExitCode]) -> ExitCode:
    """Exit code of a run in which each of `codes` occurred."""
    return max(codes, key=list(ExitCode).index, default=ExitCode.OK)


#: Clauses that only apply to a command line.
_COMMAND = re.compile(r"--[a-z]|\bpip |vlc-rx ")


def without_commands(text: str) -> str:
    """Remove parentheses and clauses about options and commands from a message."""
    text = re.sub(r" \([^()]*\)", lambda found: "" if _COMMAND.search(found[0]) else found[0], text)
    clauses = re.split(r"(; |, or )", text)
    remaining = [
        (joint, clause)
        for joint, clause in zip(["", *clauses[1::2]], clauses[::2], strict=True)
        if not _COMMAND.search(clause)
    ]
    return "".join(joint * (n > 0) + clause for n, (joint, clause) in enumerate(remaining))


class Terminated(BaseException):
    """SIGTERM was received: the run ends as by Ctrl-C, with its results so far."""


class ReceiverError(Exception):
    """An error that the user can act on, with reason and next step in one line.

    Args:
        message: the object, the constraint and the value.
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
    """A file that cannot be written, for instance on a full disk; it ends the run."""


class ProfileError(ReceiverError):
    """A profile that is missing, malformed, or holds an impossible value."""

    exit_code = ExitCode.USAGE


class UsageError(ReceiverError):
    """A combination of options that makes no sense."""

    exit_code = ExitCode.USAGE


def reason_of(error: BaseException) -> str:
    """Message of an exception in one short line; of one of the system its text alone. LibRaw's are bytes."""
    parts = (part.decode("ascii", "replace") if isinstance(part, bytes) else str(part) for part in error.args)
    text = getattr(error, "strerror", None) or " ".join(parts) or type(error).__name__
    return " ".join(str(text).split())[:160]


@contextmanager
def failure_explained(reason: str, step: str, kind: type[ReceiverError] = InputError) -> Iterator[None]:
    """Raise whatever the system or a library raises, on a damaged file some ten unrelated types, as an error of ours.

    Args:
        reason: file and fault; the other's own message is added.
        step: next step.
        kind: of the error.
    """
    try:
        yield
    except ReceiverError:
        raise
    except Exception as error:
        raise kind(f"{reason} ({reason_of(error)})", step) from None


def require(what: str, *packages: str) -> None:
    """Refuse what needs packages that are not installed.

    Raises:
        UsageError: of the first one that is missing.
    """
    from importlib.util import find_spec

    for package in packages:
        if find_spec(package) is None:
            raise UsageError(f"{what} needs the package {package}", f"pip install {package}")


#: How libraries that cannot be loaded, threads that cannot be started and C code state a lack of memory.
_NO_MEMORY = re.compile(r"failed to map segment|allocate memory|start new thread|nsufficient memory|bad_alloc")


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an exception of any type is for want of memory."""
    return isinstance(error, MemoryError) or bool(_NO_MEMORY.search(str(error)))


def shortened(text: str, length: int = 80) -> str:
    """`text` cut to a length, so that a message stays one line."""
    return text if len(text) <= length else f"{text[: length - 3]}..."


def printable(text: str) -> str:
    """`text` in one line that any terminal takes: other characters are escaped, `\\xff` is a byte that is no UTF-8."""
    return "".join(character if character.isprintable() else _escape(character) for character in text)


def _escape(character: str) -> str:
    code = ord(character)
    if 0xDC80 <= code <= 0xDCFF:  # a byte of a file name (PEP 383)
        return f"\\x{code - 0xDC00:02x}"
    return {"\n": "\\n", "\r": "\\r", "\t": "\\t"}.get(character) or (
        f"\\u{code:04x}" if code < 1 << 16 else f"\\U{code:08x}"
    )


def capitalised(text: str) -> str:
    """`text` with a capital, for titles."""
    return text[:1].upper() + text[1:]


def sentence(text: str) -> str:
    """A message or a hint as a sentence of its own, for pages."""
    return capitalised(text).rstrip(".") + "." if text else ""
