"""`vlc-rx live`: a V4L2 camera, its lock and its payloads as they come. `rxcli.cli.following` does the work."""

from pathlib import Path
from typing import Any

import click

from rxcli.cli.common import force_argument, options, receiver_arguments
from rxcli.cli.kinds import FOLDER, POSITIVE, Exposure


@click.command()
@click.argument("device", type=click.Path(path_type=Path))
@options(
    ("--width", click.IntRange(1), None, "Pixels across. [default: the largest that is fast enough]"),
    ("--height", click.IntRange(1), None, "Rows. [default: the largest that is fast enough]"),
    ("--fps", POSITIVE, None, "Frames a second. [default: the camera's most]"),
    ("--format=FOURCC pixel_format", str, None, "GREY, Y10, Y12, Y16, NV12, YUYV, UYVY or MJPG."),
    ("--exposure exposure_s", Exposure(), None, "Seconds, or 1/8000. [default: as short as the camera can]"),
    ("--gain", int, None, "In the camera's own units. [default: as it is]"),
    ("--wait", None, False, "Wait for a camera that is missing, busy or unplugged."),
    ("--list list_only", None, False, "Show the camera's modes and leave."),
    ("--frames n_frames", click.IntRange(1), None, "Stop after this many frames."),
    ("--duration=SECONDS", POSITIVE, None, "Stop after this time."),
    ("--json=FILE|- json_path", str, None, "Write one JSON object a frame, instead of tables."),
    ("--out", FOLDER, None, "Write files that came whole into this folder, under their own names."),
    ("--until-complete", None, False, "Stop when a message or a file has come whole."),
    ("--quiet", None, False, "No status line."),
)
@receiver_arguments
@force_argument
def live(device: Path, **options: Any) -> int:
    """Receive from the V4L2 camera DEVICE, such as /dev/video0, until Ctrl-C."""
    from rxcli.cli.following import run

    return run(device, options)
