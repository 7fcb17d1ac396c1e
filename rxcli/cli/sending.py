"""What `encode` and `simulate` send: a text, a URI, a file, or raw payload."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import UsageError, failure_explained
from rxcli.link.encoder import FileSending, MessageSending, RawSending, TestLight, file_object, message
from rxcli.link.formats import MAX_MESSAGE_BYTES

#: Name under which a text goes that is too long for a message.
_TEXT_NAME = "message.txt"
_MAX_FILE_BYTES = 1 << 30
#: Lit slots of four of payloads without packets.
LIGHT = {"lit": 4, "half": 2}


def sending_of(path: Path | None, text: str | None, uri: str | None) -> FileSending | MessageSending:
    """The one thing that is given, ready to be sent; a text that is too long for a message goes as a file.

    Raises:
        UsageError: nothing, or more than one thing, is given, or it cannot be sent.
        InputError: the file cannot be read.
    """
    given = [value for value in (path, text, uri) if value is not None]
    if len(given) != 1:
        raise UsageError(f"one of PATH, --text and --uri is needed ({len(given)} were given)", "give one of them")
    if path is not None:
        return file_object(path.name, _bytes_of(path))
    if uri is not None:
        return message(uri, "uri")
    assert text is not None
    try:
        data = text.encode("utf-8")
    except UnicodeEncodeError:
        raise UsageError("the text is no valid UTF-8", "send it as a file") from None
    if len(data) > MAX_MESSAGE_BYTES:
        return file_object(_TEXT_NAME, data)
    return message(data)


def raw_sending(text: str, weights: NDArray[np.int64], seed: int, same: bool) -> RawSending | TestLight:
    """What --payload names: a test light, random bits, a counter, hex digits, or a file.

    Raises:
        UsageError: it is no hex, empty, or no file.
    """
    if text in LIGHT:
        return TestLight(LIGHT[text])
    if text == "counter":
        return RawSending(None, weights, None)
    return RawSending(payload_bytes(text), weights, seed, same)


def payload_bytes(text: str) -> bytes | None:
    """The bytes of hex digits or of a file, or None for "random".

    Raises:
        UsageError: it is no hex, empty, or no file.
    """
    if text == "random":
        return None
    step = "give an even number of hex digits after 'hex:', a file, or 'random'"
    with failure_explained(f"--payload: {text} cannot be read", step, UsageError):
        data = bytes.fromhex(text[4:]) if text.startswith("hex:") else Path(text).read_bytes()
    if not data:
        raise UsageError(f"--payload: {text!r} is empty", "give at least one byte")
    return data


def _bytes_of(path: Path) -> bytes:
    with failure_explained(f"{path}: cannot be read", "name a file"):
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise UsageError(f"{path} has {path.stat().st_size} bytes; at most 1 GiB can be sent", "send parts of it")
        return path.read_bytes()
