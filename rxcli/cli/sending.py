"""What `encode` and `simulate` send: a text, a URI or a file."""

from __future__ import annotations

from pathlib import Path

from rxcli.errors import InputError, UsageError
from rxcli.link.encoder import FileSending, MessageSending, file_object, message
from rxcli.link.formats import MAX_MESSAGE_BYTES

#: Name under which a text goes that is too long for a message.
_TEXT_NAME = "message.txt"
_MAX_FILE_BYTES = 1 << 30


def sending_of(
    path: Path | None, text: str | None, uri: str | None, mother: int = 2, object_id: int | None = None
) -> FileSending | MessageSending:
    """The one thing that is given, ready to be sent; a text that is too long for a message goes as a file.

    Raises:
        UsageError: nothing, or more than one thing, is given, or it cannot be sent.
        InputError: the file cannot be read.
    """
    given = [value for value in (path, text, uri) if value is not None]
    if len(given) != 1:
        raise UsageError(f"one of PATH, --text and --uri is needed ({len(given)} were given)", "give one of them")
    if path is not None:
        return file_object(path.name, _bytes_of(path), object_id, mother)
    if uri is not None:
        return message(uri, "uri")
    assert text is not None
    try:
        data = text.encode("utf-8")
    except UnicodeEncodeError:
        raise UsageError("the text is no valid UTF-8", "send it as a file") from None
    if len(data) > MAX_MESSAGE_BYTES:
        return file_object(_TEXT_NAME, data, object_id, mother)
    return message(data)


def _bytes_of(path: Path) -> bytes:
    try:
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise UsageError(f"{path} has {path.stat().st_size} bytes; at most 1 GiB can be sent", "send parts of it")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})", "name a file") from None
