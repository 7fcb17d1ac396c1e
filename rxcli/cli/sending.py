"""What `encode` and `simulate` send: a text, a URI, a file, or raw payload."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import InputError, UsageError
from rxcli.link.encoder import FileSending, MessageSending, RawSending, TestLight, file_object, message
from rxcli.link.formats import MAX_MESSAGE_BYTES

#: Name under which a text goes that is too long for a message.
_TEXT_NAME = "message.txt"
_MAX_FILE_BYTES = 1 << 30
#: Lit slots of four of payloads without packets.
LIGHT = {"lit": 4, "half": 2}


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
    try:
        data = bytes.fromhex(text[4:]) if text.startswith("hex:") else Path(text).read_bytes()
    except ValueError:
        raise UsageError(f"--payload: {text!r} holds no hex", "give an even number of hex digits") from None
    except OSError as error:
        reason = f"--payload: {text}: cannot be read ({error.strerror})"
        raise UsageError(reason, "give 'random', 'hex:...' or a file") from None
    if not data:
        raise UsageError(f"--payload: {text!r} is empty", "give at least one byte")
    return data


def _bytes_of(path: Path) -> bytes:
    try:
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise UsageError(f"{path} has {path.stat().st_size} bytes; at most 1 GiB can be sent", "send parts of it")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})", "name a file") from None
