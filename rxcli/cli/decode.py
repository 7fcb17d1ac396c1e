"""`vlc-rx decode`: photos, RAW files, clips and folders. Here are its options; `rxcli.cli.decoding` does the work."""

import os
from contextlib import suppress
from typing import Any

import click

from rxcli.cli.common import force_argument, options, receiver_arguments
from rxcli.cli.kinds import FILE, FOLDER, SHARE


@click.command()
@click.argument("paths", nargs=-1, required=True, metavar="PATH...", type=click.Path())
@receiver_arguments
@options(
    ("--json=FILE|- json_path", str, None, "Write one JSON object a frame, instead of the table."),
    ("--truth=FILE|auto", str, None, "Score against this truth, or the NAME.truth.json beside each file."),
    ("--max-ber", SHARE, None, "Fail a file whose bit error rate is above (needs --truth)."),
    ("--min-packets", click.IntRange(1), 1, "Fail a file with fewer packets of --min-confidence (0.5) and texts."),
    ("--expect-text expected_texts", [str], None, "Fail a file that does not give this text; several times."),
    ("--baseline=FILE", FILE, None, "Fail a file that lost packets, or is slower, since this --json run."),
    ("--slower", click.FloatRange(1), 1.5, "How many times as long as in the --baseline a file may take."),
    ("--min-packet-confidence", SHARE, None, "Fail a file with a packet of lower confidence, which is still reported."),
    ("--junit", FILE, None, "Write one JUnit test case per file."),
    ("--summary", FILE, None, "Write one row per file, as .csv or .parquet."),
    ("--resume", None, False, "Go on with the run that wrote the file of --json."),
    ("--workers", click.IntRange(1), 1, "Decode in this many processes.", {"envvar": "VLC_RX_WORKERS"}),
    ("--cluster=ADDRESS", str, None, "Decode on the Dask cluster whose scheduler is at this address."),
    ("--dump-dir", FOLDER, None, "Write the arrays of every stage boundary into this folder."),
    ("--save-undistorted", FOLDER, None, "Write every frame without its lens distortion into this folder."),
    ("--save-camera", FILE, None, "Write what was estimated of an unknown camera as a profile (TOML)."),
    ("--same-camera", None, False, "All photos are by one camera: what one of them shows of it serves for all."),
    ("--stop-when-certain", None, False, "Pass over frames of a clip all of whose packets are certain already."),
    ("--out", FOLDER, None, "Write files that came whole into this folder, under their own names."),
    ("--packets", None, False, "Show every packet of a clip, not only its sum."),
    ("--payloads", FILE, None, "Write one row a packet (CSV): where it is from, bits, hex, confidence."),
    ("--quiet", None, False, "No table, no summary, no progress; only why a file failed."),
)
@force_argument
def decode(paths: tuple[str, ...], **options: Any) -> int:
    """Decode photos, RAW files and clips; PATH may be a folder, or - for one picture on stdin."""
    opened = None
    if options["workers"] == 1 and not (options["cluster"] or options["resume"]) and _is_jpeg(paths[0]):
        # A large photo takes longer than what is imported meanwhile.
        from rxcli.ingest import begun

        opened = begun(paths[0])
    from rxcli.cli.decoding import run

    return run(paths, options, opened)


def _is_jpeg(path: str) -> bool:
    """Whether a path is that of a file which begins as a JPEG picture."""
    with suppress(OSError, ValueError):
        if os.path.isfile(path):
            with open(path, "rb") as file:
                return file.read(2) == b"\xff\xd8"
    return False
