"""`vlc-rx inspect`: pictures of every stage for one photo or frame."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rxcli.cli.common import complete_files, receiver_arguments, receiver_options
from rxcli.errors import ExitCode, InputError

if TYPE_CHECKING:
    from rxcli.profiles import CameraProfile, ScreenProfile
    from rxcli.receiver.pipeline import ReceiverOptions
    from rxcli.types import Frame, FrameResult


@click.command()
@click.argument("path", shell_complete=complete_files)
@receiver_arguments
@click.option("--frame", type=click.IntRange(0), default=0, show_default=True, help="Frame of a clip.")
@click.option(
    "--out", type=click.Path(file_okay=False, path_type=Path), help="Folder to write. [default: PATH.inspect]"
)
@click.option("--truth", metavar="FILE|auto", help="Count wrong bits against this truth.")
def inspect(path: str, frame: int, out: Path | None, truth: str | None, **options: Any) -> int:
    """Write pictures of every stage of PATH, and an HTML page that shows them; prints the page's path."""
    from rxcli.results.plots import new_figure, write_pictures

    new_figure(1, 1)  # a missing extra is told before the work, not after it
    configured = receiver_options(**options)
    picture = _frame_of(path, frame)
    result = _scored(_receive(picture, configured), path, truth)
    screen, camera = _profiles_of(picture, result, configured)
    folder = out if out is not None else Path(f"{path}.inspect")
    click.echo(write_pictures(folder, picture, result, screen, camera))
    received = any(column.packets for column in result.columns)
    return ExitCode.OK if received else ExitCode.NOT_RECEIVED


def _frame_of(path: str, number: int) -> Frame:
    from rxcli.ingest import open_source

    found = next(islice(open_source(path), number, None), None)
    if found is None:
        raise InputError(f"{path}: has no frame {number}", "choose a lower --frame")
    return found


def _receive(picture: Frame, options: ReceiverOptions) -> FrameResult:
    from rxcli.receiver.pipeline import receive

    return next(iter(receive([picture], options)))


def _scored(result: FrameResult, path: str, truth: str | None) -> FrameResult:
    from rxcli.results.truth import Scorer, find_truth, load_truth

    found = find_truth(path) if truth == "auto" else truth
    return Scorer(load_truth(found)).add(result) if found else result


def _profiles_of(
    picture: Frame, result: FrameResult, options: ReceiverOptions
) -> tuple[ScreenProfile | None, CameraProfile | None]:
    from rxcli.receiver.camera import camera_profile

    screen = next((s for s in options.screens if s.name == result.screen_profile), None)
    camera = next((c for c in options.cameras if c.name == result.camera_profile), None)
    if camera is None and "line_delay_s" in result.estimated:
        camera = camera_profile(result.estimated, "estimated", None, None, picture.width, picture.height)
    return screen, camera
