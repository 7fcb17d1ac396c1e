"""Groups of commands: help without arguments, suggestions for mistyped names."""

from collections.abc import Iterable
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


class SuggestingGroup(click.Group):
    """A group that names the nearest command where one is mistyped, and lays out its commands' help."""

    context_class = PlainContext

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        command = super().get_command(ctx, cmd_name)
        if command is not None:
            command.context_class = PlainContext
        return command

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        try:
            return super().resolve_command(ctx, args)
        except NoSuchCommand as error:
            raise NoSuchCommand(error.command_name, possibilities=self.list_commands(ctx), ctx=ctx) from None
