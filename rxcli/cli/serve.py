"""`vlc-rx serve`: a local page for photos from a phone, and for a live camera."""

from __future__ import annotations

import asyncio
import secrets
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rxcli.cli.common import options, receiver_arguments, receiver_options, refuse
from rxcli.cli.kinds import FOLDER, Exposure
from rxcli.errors import ExitCode, require

if TYPE_CHECKING:
    from rxcli.web.server import Site


@click.command()
@click.argument("device", required=False, type=click.Path(path_type=Path))
@options(
    ("--host", str, None, "Where to listen: 0.0.0.0 for phones in the same network. [default: this machine alone]"),
    ("--proxy", str, None, "Where a proxy shows the page: https://lab.example.org."),
    ("--port", click.IntRange(0, 65535), 8017, "0 takes any free one."),
    ("--keep", FOLDER, None, "Keep uploads in this folder."),
    ("--max-upload", click.IntRange(1, 4096), 96, "Megabytes a file."),
    ("--max-kept", click.IntRange(1, 1 << 20), 4096, "Megabytes of the folder of --keep."),
    ("--exposure", Exposure(), None, "Of the live camera: seconds, or 1/8000. [default: the shortest]"),
    ("--gain", int, None, "Of the live camera, in its own units. [default: as it is]"),
)
@receiver_arguments
def serve(device: Path | None, **options: Any) -> int:
    """Serve a page that decodes photos from a phone, and shows the live camera DEVICE where one is named.

    Without --host the page can be opened on this machine alone. With --host it can be opened by whoever has the
    address that is shown, which holds a secret; a phone reads it from the QR code.
    """
    require("the page", "aiohttp", "segno")
    asyncio.run(_run(_site(device, options)))
    click.echo("stopped", err=True)
    return ExitCode.OK


def _site(device: Path | None, options: dict[str, Any]) -> Site:
    from rxcli.ingest.v4l2 import CameraSettings
    from rxcli.web.server import Bounds, Site

    proxy, step = options["proxy"], "name all of it, such as https://lab.example.org"
    is_part = proxy and not proxy.startswith(("http://", "https://"))
    refuse((is_part, f"--proxy {proxy!r} is no address", step))
    return Site(
        options=receiver_options(options, soft_bits=True),
        host=options["host"] or "127.0.0.1",
        port=options["port"],
        token=secrets.token_urlsafe(12) if options["host"] else None,
        proxy=proxy,
        device=device,
        camera=CameraSettings(exposure_s=options["exposure"], gain=options["gain"], wait=True),
        keep=options["keep"],
        bounds=Bounds(upload_bytes=options["max_upload"] << 20, keep_bytes=options["max_kept"] << 20),
    )


async def _run(site: Site) -> None:
    from rxcli.web.server import Server

    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # before there is anything to leave behind
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    async with Server(site) as server:
        for_phones = " For a phone in the same network: vlc-rx serve --host 0.0.0.0"
        if site.token is not None:
            for_phones = ""
            import segno

            segno.make(server.address, micro=False).terminal(sys.stderr, compact=True, border=2)
        click.echo(server.address)
        for address in server.addresses[1:]:
            click.echo(f"or {address}", err=True)
        click.echo(f"Ctrl-C stops it.{for_phones}", err=True)
        sys.stdout.flush()
        await stopped.wait()
