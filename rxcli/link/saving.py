"""Write received files under their own names to one folder, replacing existing files only on request."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rxcli.errors import InputError, ReceiverError
from rxcli.link.formats import safe_name
from rxcli.outputs import Taken, write_whole
from rxcli.types import FrameResult, ReceivedObject


def save_object(
    received: ReceivedObject, folder: Path, force: bool = False, taken: Taken | None = None
) -> ReceivedObject:
    """Write a complete file and return it with its path.

    A partial file is never visible. An existing file of the same name and content is left as it is. What replaces a
    program may not be executed.

    Args:
        received: the file.
        folder: output folder.
        force: replace an existing file of the same name, unless this run wrote it.
        taken: files of this run; the new one is added.

    Raises:
        InputError: a different file has its name, or it cannot be written.
    """
    path = folder / safe_name(received.name)
    taken = Taken() if taken is None else taken
    if not _is_same(path, received):
        whose, lost = taken.by(path), f"{received.name} ({received.size} bytes) was not written"
        if whose is not None:
            raise InputError(f"{path} is {whose}; {lost}", "give another folder with --out")
        if os.path.lexists(path) and not force:
            step = "give --force to overwrite it, or another folder"
            raise InputError(f"{path} exists with other content; {lost}", step)
        write_whole(path, received.data, follow=False, kept_mode=0o666)
    taken.add(path, "a file received before")
    return replace(received, path=str(path))


def save_objects(
    result: FrameResult, folder: Path, force: bool, on_error: Callable[[str], None], taken: Taken
) -> FrameResult:
    """Write the files of a result and add their paths to it; reasons of failure go to `on_error`."""
    objects = []
    for received in result.objects:
        try:
            objects.append(save_object(received, folder, force, taken))
        except ReceiverError as error:
            objects.append(received)
            on_error(str(error))
    return replace(result, objects=tuple(objects)) if objects else result


def _is_same(path: Path, received: ReceivedObject) -> bool:
    try:
        is_file = path.is_file() and not path.is_symlink()
        return is_file and path.stat().st_size == received.size and path.read_bytes() == received.data
    except OSError:
        return False
