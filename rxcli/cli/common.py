"""What several commands share: options, the receiver's options made of them, writing JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from rxcli.errors import UsageError

if TYPE_CHECKING:
    from rxcli.outputs import Output
    from rxcli.profiles import CameraProfile, ScreenProfile
    from rxcli.receiver.pipeline import ReceiverOptions

_F = TypeVar("_F", bound=Callable[..., Any])
AUTO = "auto"


class _Point(click.ParamType[tuple[float, float]]):
    """`x,y` in pixels."""

    name = "x,y"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        if isinstance(value, tuple):
            return value
        try:
            x, y = (float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not two numbers, such as 120.5,80", param, ctx)
        if not (abs(x) < 1e6 and abs(y) < 1e6):  # written so that NaN fails
            self.fail(f"{value!r} is no position in a picture", param, ctx)
        return x, y


def _check_skip(_context: click.Context, _parameter: click.Parameter, names: tuple[str, ...]) -> tuple[str, ...]:
    from rxcli.receiver.pipeline import SKIPS

    for name in names:
        if name not in SKIPS:
            raise click.BadParameter(f"{name!r} is not one of {', '.join(SKIPS)}")
    return names


_OPTIONS = (
    click.option(
        "--screen",
        "screens",
        multiple=True,
        metavar="NAME|FILE|auto",
        help="Screen profile; may be given several times. [default: auto, the one whose clock fits best]",
    ),
    click.option(
        "--camera",
        "cameras",
        multiple=True,
        metavar="NAME|FILE|auto",
        help="Camera profile; of several, each file takes the one that matches its make, model and size. "
        "[default: auto, all shipped ones]",
    ),
    click.option(
        "--corners",
        nargs=4,
        type=_Point(),
        metavar="x,y x,y x,y x,y",
        help="The screen's corners in stored pixels, top-left first, clockwise as a viewer sees the screen.",
    ),
    click.option(
        "--cae",
        type=click.Choice(["auto", "always", "never"]),
        default="auto",
        show_default=True,
        help="When the auto-encoder runs.",
    ),
    click.option(
        "--min-confidence",
        type=click.FloatRange(0, 1),
        default=0.0,
        help="Report only packets of at least this confidence.",
    ),
    click.option(
        "--no-skip",
        multiple=True,
        metavar="NAME",
        callback=_check_skip,
        help="Switch off a shortcut (no_screen, dark_columns, certain_columns, tracking); may be given several times.",
    ),
)


def receiver_arguments(command: _F) -> _F:
    """Add the options that `receiver_options` takes: screens, cameras, corners, cae, min_confidence, no_skip."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def receiver_options(
    screens: tuple[str, ...] = (),
    cameras: tuple[str, ...] = (),
    corners: tuple[tuple[float, float], ...] | None = None,
    cae: str = AUTO,
    min_confidence: float = 0.0,
    no_skip: tuple[str, ...] = (),
    dump_dir: Path | None = None,
    stop_when_certain: bool = False,
) -> ReceiverOptions:
    """The receiver's options from what the command line gave.

    A single camera that is named, not `auto`, is taken whatever a file says of itself; of several, and of the shipped
    ones, each file takes the one that matches.

    Raises:
        ProfileError: a profile is missing or malformed.
        UsageError: the corners are no convex quadrilateral.
    """
    import numpy as np

    from rxcli.receiver.pipeline import SKIPS, ReceiverOptions

    named = [name for name in cameras if name != AUTO]
    return ReceiverOptions(
        screens=_screens(screens),
        cameras=_cameras(cameras),
        force_camera=len(named) == 1 == len(cameras),
        corners=_checked(np.array(corners, dtype=np.float64)) if corners else None,
        cae=cae,  # type: ignore[arg-type]  # one of the choices
        min_confidence=min_confidence,
        skip=frozenset(SKIPS) - set(no_skip),
        dump_dir=dump_dir.absolute() if dump_dir else None,  # workers may stand in other folders
        stop_when_certain=stop_when_certain,
    )


def _screens(names: tuple[str, ...]) -> tuple[ScreenProfile, ...]:
    from rxcli.profiles import ScreenProfile, load_profile, shipped_profiles

    named = [load_profile(name, ScreenProfile) for name in names if name != AUTO]
    return tuple(named if names and AUTO not in names else [*named, *shipped_profiles(ScreenProfile)])


def _cameras(names: tuple[str, ...]) -> tuple[CameraProfile, ...]:
    from rxcli.profiles import CameraProfile, load_profile, shipped_profiles

    named = [load_profile(name, CameraProfile) for name in names if name != AUTO]
    return tuple(named if names and AUTO not in names else [*named, *shipped_profiles(CameraProfile)])


def _checked(corners: Any) -> Any:
    """The corners, where going round them always turns the same way, as it does round a screen seen by a camera."""
    import numpy as np

    edges = np.roll(corners, -1, axis=0) - corners
    following = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
    if not (np.all(turns > 0) or np.all(turns < 0)):
        raise UsageError(
            "--corners must go once round a convex outline: top-left, top-right, bottom-right, bottom-left",
            "check their order and the numbers",
        )
    return corners


#: For every command that writes files which may be somebody's.
force_argument = click.option(
    "--force", is_flag=True, help="Replace files that are there already and were not written by the same option."
)


def claim_outputs(
    outputs: Iterable[Output | None],
    inputs: Iterable[str | Path] = (),
    profiles: Iterable[str | Path | None] = (),
    force: bool = False,
) -> None:
    """Refuse outputs that would destroy something, before anything is opened (see `rxcli.outputs.claim`).

    Args:
        outputs: all files that the command will write; None where an option was not given.
        inputs: files that it reads.
        profiles: names and files of profiles that it reads.
        force: of `force_argument`.

    Raises:
        UsageError: one of them would.
    """
    from rxcli.outputs import claim

    named = [path for path in profiles if path is not None and path != AUTO]
    claim([output for output in outputs if output is not None], inputs, named, force)


def json_output(path: str | None, *keys: str) -> Output | None:
    """The file of a command's --json, None where there is none; earlier ones are told by the `keys` they hold."""
    from rxcli.outputs import Output, json_with

    return None if path in (None, "-") else Output("--json", Path(str(path)), json_with(*keys))


def write_json(value: Any, path: str) -> None:
    """Write `value` as indented JSON to a file, or to stdout where `path` is "-".

    Raises:
        InputError: the file cannot be written.
    """
    text = json.dumps(_finite(value), indent=2)
    if path == "-":
        click.echo(text)
        return
    from rxcli.outputs import write_whole

    write_whole(Path(path), text + "\n")


def _finite(value: Any) -> Any:
    """JSON knows no NaN and no infinity."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
