"""Received files on disk: under their own name, in one folder, never over another file unless asked."""

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
    """Write a file that came whole; returns it with its path.

    It is written beside its place first, so that nobody sees half of it. A file of the same name and content is left
    as it is.

    Args:
        received: the file.
        folder: where it is written.
        force: replace another file of its name, though none of this run.
        taken: files of this run; the new one is added.

    Raises:
        InputError: another file has its name, or the folder cannot be written.
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
            f"{path} exists and is another file; {received.name} ({received.size} bytes) was not written",
            "give --force to overwrite it, or another folder",
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})", "name another folder") from None
    taken.add(path, "a file received before")
    return replace(received, path=str(path))


def save_objects(
    result: FrameResult, folder: Path, force: bool, tell: Callable[[str], None], taken: Taken
) -> FrameResult:
    """The result with the paths of its files, once they are written; `tell` is given why one could not be."""
    objects = []
    for received in result.objects:
        try:
            objects.append(save_object(received, folder, force, taken))
        except InputError as error:
            objects.append(received)
            tell(str(error))
    return replace(result, objects=tuple(objects)) if objects else result


def _put(written: Path, path: Path, force: bool) -> None:
    if force:
        os.replace(written, path)  # replaces a link itself, never what it points to
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
