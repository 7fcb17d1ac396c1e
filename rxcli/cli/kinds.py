"""Kinds of values that options take: what the command line gives, checked and typed."""

import math
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

AUTO = "auto"
SHARE, POSITIVE = click.FloatRange(0, 1), click.FloatRange(0, min_open=True)
FILE = click.Path(dir_okay=False, path_type=Path, allow_dash=False)
FOLDER = click.Path(file_okay=False, path_type=Path)


class Point(click.ParamType[tuple[float, float]]):
    """`x,y` in pixels."""

    name = "x,y"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        """Two numbers."""
        if isinstance(value, tuple):
            return value
        try:
            x, y = (float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not two numbers, such as 120.5,80", param, ctx)
        if not (abs(x) < 1e6 and abs(y) < 1e6):  # written so that NaN fails
            self.fail(f"{value!r} is no position in a picture", param, ctx)
        return x, y


class Exposure(click.ParamType[float]):
    """Seconds, as a number or a fraction."""

    name = "seconds"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Between 0 and 10 seconds."""
        numerator, _, denominator = str(value).partition("/")
        try:
            seconds = float(numerator) / float(denominator or 1)
        except (ValueError, ZeroDivisionError):
            seconds = math.nan
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
