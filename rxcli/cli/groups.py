"""Groups of commands: help without arguments, suggestions for mistyped names."""

import inspect
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import click
from click.exceptions import NoSuchCommand

#: A hyphen at which no line is broken; written as a plain one in the end, so that options can be copied.
_UNBROKEN = "\u2011"


class PlainFormatter(click.HelpFormatter):
    """Help whose lines end between words, never at a hyphen inside one; headings are bold where colours are shown."""

    def write_text(self, text: str) -> None:
        super().write_text(text.replace("-", _UNBROKEN))

    def write_dl(self, rows: Iterable[tuple[str, str]], *spacing: int, **named: int) -> None:
        super().write_dl([(name, text.replace("-", _UNBROKEN)) for name, text in rows], *spacing, **named)

    def write_heading(self, heading: str) -> None:
        self.write(f"{'':>{self.current_indent}}{click.style(f'{heading}:', bold=True)}\n")

    def getvalue(self) -> str:
        return super().getvalue().replace(_UNBROKEN, "-")


class PlainContext(click.Context):
    """A context whose help is laid out by `PlainFormatter`."""

    formatter_class = PlainFormatter


def _described(command: click.Command) -> None:
    """Take the help from the source, as Python keeps no docstrings with -OO."""
    if command.help is None and command.callback is not None:
        import ast
        import textwrap

        with suppress(OSError, SyntaxError):
            source = ast.parse(textwrap.dedent(inspect.getsource(command.callback)))
            command.help = ast.get_docstring(source.body[0])  # type: ignore[arg-type]


class SuggestingGroup(click.Group):
    """A group that names the nearest command where one is mistyped, and lays out its commands' help."""

    context_class = PlainContext

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        _described(self)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        command = super().get_command(ctx, cmd_name)
        if command is not None:
            command.context_class = PlainContext
            _described(command)
        return command

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        try:
            return super().resolve_command(ctx, args)
        except NoSuchCommand as error:
            raise NoSuchCommand(error.command_name, possibilities=self.list_commands(ctx), ctx=ctx) from None
