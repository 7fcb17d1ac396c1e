"""Write received files under their own names to one folder, replacing existing files only on request."""

from __future__ import annotations

import hashlib
import os
import uuid
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rxcli.errors import InputError
from rxcli.link.formats import safe_name
from rxcli.outputs import Taken
from rxcli.types import FrameResult, ReceivedObject


def save_object(
    received: ReceivedObject, folder: Path, force: bool = False, taken: Taken | None = None
) -> ReceivedObject:
    """Write a complete file and return it with its path.

    The file is written under a temporary name and renamed, so that a partial file is never visible. An existing file of
    the same name and content is left as it is.

    Args:
        received: the file.
        folder: output folder.
        force: replace an existing file of the same name, unless this run wrote it.
        taken: files of this run; the new one is added.

    Raises:
        InputError: a different file has its name, or the folder is not writable.
    """
    path = folder / safe_name(received.name)
    taken = Taken() if taken is None else taken
    if _is_same(path, received):
        taken.add(path, "a file received before")
        return replace(received, path=str(path))
    whose = taken.by(path)
    if whose is not None:
        raise InputError(
            f"{path} is {whose}; {received.name} ({received.size} bytes) was not written",
            "give another folder with --out",
        )
    hidden = folder / f".vlc-rx-{uuid.uuid4().hex}.part"
    try:
        try:
            hidden.write_bytes(received.data)
            _put(hidden, path, force)
        finally:
            hidden.unlink(missing_ok=True)
    except FileExistsError:
        raise InputError(
            f"{path} exists with other content; {received.name} ({received.size} bytes) was not written",
            "give --force to overwrite it, or another folder",
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})", "name another folder") from None
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
        except InputError as error:
            objects.append(received)
            on_error(str(error))
    return replace(result, objects=tuple(objects)) if objects else result


def _put(written: Path, path: Path, force: bool) -> None:
    if force:
        os.replace(written, path)  # replaces a link itself, never its target
        return
    try:
        os.link(written, path)
    except FileExistsError:
        raise
    except OSError:  # a file system without links
        with path.open("xb") as file:
            file.write(written.read_bytes())


def _is_same(path: Path, received: ReceivedObject) -> bool:
    if path.is_symlink() or not path.is_file() or path.stat().st_size != received.size:
        return False
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest() == received.sha256
    except OSError:
        return False
