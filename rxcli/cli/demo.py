"""`vlc-rx demo`: a simulated screen sends a text, a simulated phone photographs it, the receiver reads it."""

import os
import sys
from pathlib import Path

import click

from rxcli.cli.common import force_argument, options
from rxcli.cli.kinds import FOLDER
from rxcli.errors import ExitCode, UsageError

#: Camera, screen, and the scale of the camera's pixels, which keeps the demo under two seconds.
_PRESET, _SCREEN, _SCALE = "phone-plain", "data-17k3", 0.4


@click.command()
@options(
    ("--text", str, "Hello! This text came as light.", "Text that the screen sends."),
    ("--out", FOLDER, "vlc-rx-demo", "Folder for the photo and the page."),
    ("--open/--no-open open_page", None, True, "Open the page in the browser.", {"is_flag": True}),
)
@force_argument
def demo(text: str, out: Path, open_page: bool, force: bool) -> int:
    """Try the receiver without a screen: photograph a simulated one that sends a text, read the text, show how.

    Prints the text and the page that shows how it was read. The photo is kept: decode it again with other options.
    """
    from rxcli.cli.inspect import page_output, write_page
    from rxcli.options import receiver_options
    from rxcli.outputs import ANYTHING, NEVER, OUTPUT_MARKER, Output, claim, claim_own_folder, write_whole
    from rxcli.results.report import format_received

    photo = out / "photo.jpg"
    ours = ANYTHING if (out / OUTPUT_MARKER).exists() else NEVER
    claim([page_output(out), Output("--out", photo, ours, makes_folder=True)], force=force)
    picture = _photo_of(text)
    claim_own_folder("--out", out, force=force)
    write_whole(photo, picture)
    click.echo(f"A simulated screen sends the text; its photo: {photo}", err=True)
    [result] = write_page(str(photo), out / "index.html", receiver_options(soft_bits=True))
    for line in format_received(result):
        click.echo(line)
    click.echo(out / "index.html")
    if open_page and not _open(out / "index.html"):
        click.echo("Open this page in a browser: it shows how the text was read.", err=True)
    return ExitCode.OK if result.messages else ExitCode.NOT_RECEIVED


def _photo_of(text: str) -> bytes:
    """A JPEG of a screen that sends `text`.

    Raises:
        UsageError: the text does not fit a message.
    """
    from dataclasses import replace

    from rxcli.cli.sending import sending_of
    from rxcli.lab.simulate.capture import prepare
    from rxcli.lab.simulate.scenes import preset
    from rxcli.link.encoder import FileSending
    from rxcli.link.formats import MAX_MESSAGE_BYTES

    labels = sending_of(None, text, None)
    if isinstance(labels, FileSending):
        raise UsageError(f"--text has more than {MAX_MESSAGE_BYTES} bytes, more than one photo shows", "shorten it")
    scene = replace(preset(_PRESET, _SCREEN), labels=labels).scaled(_SCALE, keep_readout=True)
    return prepare(scene, 0).frame().jpeg


def _open(page: Path) -> bool:
    """Show the page to who sits at this machine; False where nobody does, or no browser is found."""
    import webbrowser

    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False  # what would open is a browser for terminals, which would take this one
    return webbrowser.open(page.absolute().as_uri())
