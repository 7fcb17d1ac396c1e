"""Kinds of values that options take: what the command line gives, checked and typed."""

from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

AUTO = "auto"
SHARE, POSITIVE = click.FloatRange(0, 1), click.FloatRange(0, min_open=True)
FILE = click.Path(dir_okay=False, path_type=Path, allow_dash=False)
FOLDER = click.Path(file_okay=False, path_type=Path)


class Numbers(click.ParamType[tuple[Any, ...]]):
    """Several numbers, written as an example is: as many, with its separator, whole ones where it has no point.

    Args:
        example: such as "120.5,80"; or "9x6", of whose last two numbers none may be 0.
        any_count: take any number of them.
    """

    name = "numbers"

    def __init__(self, example: str, any_count: bool = False) -> None:
        self._example, self._any_count = example, any_count

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[Any, ...]:
        """The numbers, each below a million."""
        is_whole, separator = "." not in self._example, "x" if "x" in self._example else ","
        n = 1 + self._example.count(separator)
        try:
            numbers = tuple(map(int if is_whole else float, str(value).lower().split(separator)))
        except ValueError:
            numbers = ()
        is_right = len(numbers) == n or (self._any_count and numbers)
        is_size = not is_whole or (min(numbers, default=0) >= 0 and 0 not in numbers[-2:])
        if not (is_right and is_size and all(abs(number) < 1e6 for number in numbers)):  # written so that NaN fails
            count = "a list of" if self._any_count else f"{n} whole" if is_whole else n
            bounds = "below a million, sizes above 0" if is_whole else "below a million"
            self.fail(f"{value!r} is not {count} numbers ({bounds}), such as {self._example}", param, ctx)
        return numbers


class Exposure(click.ParamType[float]):
    """Seconds, as a number or a fraction."""

    name = "seconds"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Between 0 and 10 seconds."""
        numerator, _, denominator = str(value).partition("/")
        try:
            seconds = float(numerator) / float(denominator or 1)
        except (ValueError, ZeroDivisionError):
            seconds = 0.0
        if not 0 < seconds < 10:
            self.fail(f"{value!r} is no time; give seconds up to 10, or a fraction such as 1/8000", param, ctx)
        return seconds


class ProfileName(click.ParamType[str]):
    """Name of a profile, or a TOML file; `folder` holds the known ones."""

    name = "profile"

    def __init__(self, folder: str) -> None:
        self._folder = folder

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Names of profiles, then files, for the shell."""
        from rxcli.resources import profile_dirs

        stems = {path.stem for _, parent in profile_dirs() for path in (parent / self._folder).glob("*.toml")}
        names = sorted(name for name in [AUTO, *stems] if name.startswith(incomplete))
        return [CompletionItem(name) for name in names] or [CompletionItem(incomplete, type="file")]


SCREEN, CAMERA = ProfileName("screens"), ProfileName("cameras")
