"""Contents of blocks: bodies of beacons, announcements, containers. Pure functions with all rules of acceptance."""

import struct
import unicodedata
import zlib
from dataclasses import dataclass

from rxcli.errors import UsageError
from rxcli.link.layout import ANNOUNCEMENT_ID, ANNOUNCEMENT_PERIOD, BEACON_ID, BEACON_LENGTHS, CRC_BYTES
from rxcli.link.sequences import whiten
from rxcli.types import MessageKind

KINDS: tuple[MessageKind, ...] = ("raw", "text", "uri")
#: Longest message, bytes.
MAX_MESSAGE_BYTES = BEACON_LENGTHS[-1] - 1
_ANNOUNCEMENT = struct.Struct(">BBHIIII")
_VERSION = 1
_N_MOTHER_RATES = 3
_CONTAINER_HEAD = struct.Struct(">4sBBB")
_CONTAINER_TAIL = struct.Struct(">Q32s")
_MAGIC, _DEFLATED = b"VLRX", 0x01
#: Head, name of one byte, length, hash.
MIN_CONTAINER_BYTES = _CONTAINER_HEAD.size + 1 + _CONTAINER_TAIL.size
_MAX_NAME_BYTES = 255


def protect(data: bytes, object_id: int, block: int) -> bytes:
    """Append the CRC-32 to `data` and whiten both; the CRC of a file's block covers its object and number, too."""
    is_of_file = object_id < ANNOUNCEMENT_ID
    prefix = object_id.to_bytes(2, "big") + block.to_bytes(4, "big") if is_of_file else b""
    return whiten(data + zlib.crc32(prefix + data).to_bytes(CRC_BYTES, "big"), object_id, block)


def unprotect(coded: bytes, object_id: int, block: int) -> bytes | None:
    """Undo `protect`; None if the CRC does not fit."""
    data = whiten(coded, object_id, block)[:-CRC_BYTES]
    return data if protect(data, object_id, block) == coded else None


# -- beacons -----------------------------------------------------------------------------------------------------------


def beacon_body(kind: MessageKind, data: bytes) -> bytes:
    """Build a beacon's body: kind, message, padding.

    Raises:
        UsageError: the message is empty, too long, or a text with a zero byte.
    """
    if not data:
        raise UsageError("a message must hold at least one byte (got none)", "give a text")
    if len(data) > MAX_MESSAGE_BYTES:
        raise UsageError(
            f"a message holds at most {MAX_MESSAGE_BYTES} bytes (got {len(data)})", "send it as a file instead"
        )
    if kind != "raw" and b"\0" in data:
        raise UsageError("a text holds no zero byte", "send it as a file instead")
    length = next(n for n in BEACON_LENGTHS if n > len(data))
    return (bytes([KINDS.index(kind)]) + data).ljust(length, b"\0")


def protect_beacon(body: bytes) -> bytes:
    """Information bits of a beacon's codeword."""
    return protect(body, BEACON_ID, len(body))


def unprotect_beacon(coded: bytes) -> tuple[MessageKind, bytes] | None:
    """Kind and message, or None if the information is no beacon's or its body no message."""
    body = unprotect(coded, BEACON_ID, len(coded) - CRC_BYTES)
    if body is None or body[0] >= len(KINDS):
        return None
    kind, data = body[0], body[1:]
    if KINDS[kind] == "raw":
        return "raw", data
    text = data.rstrip(b"\0")
    is_utf8 = text.decode("utf-8", "ignore").encode("utf-8") == text
    return (KINDS[kind], text) if text and b"\0" not in text and is_utf8 else None


# -- announcements -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Announcement:
    """Announcement of a file in burst b."""

    mother: int
    object_id: int
    #: Length of the container, bytes.
    length: int
    burst: int
    container_crc: int

    def protected(self) -> bytes:
        """Information bits of the announcement's codeword."""
        body = _ANNOUNCEMENT.pack(_VERSION, self.mother, self.object_id, self.length, self.burst, self.container_crc, 0)
        return protect(body, ANNOUNCEMENT_ID, len(body))


def unprotect_announcement(coded: bytes) -> Announcement | None:
    """The announcement, or None if the information is none or inconsistent."""
    body = unprotect(coded, ANNOUNCEMENT_ID, len(coded) - CRC_BYTES)
    if body is None:
        return None
    version, mother, object_id, length, burst, crc, zero = _ANNOUNCEMENT.unpack(body)
    if version != _VERSION or mother >= _N_MOTHER_RATES or object_id >= ANNOUNCEMENT_ID or zero:
        return None
    if length < MIN_CONTAINER_BYTES or burst % ANNOUNCEMENT_PERIOD:
        return None
    return Announcement(mother, object_id, length, burst, crc)


# -- containers --------------------------------------------------------------------------------------------------------


def pack_container(name: str, data: bytes) -> bytes:
    """Pack a file for sending, deflated if that is shorter.

    Raises:
        UsageError: the name is empty, holds a folder, or is too long.
    """
    encoded = name.encode("utf-8")
    if not 1 <= len(encoded) <= _MAX_NAME_BYTES or "/" in name or "\\" in name:
        raise UsageError(f"a file's name has 1 to {_MAX_NAME_BYTES} bytes and no folder (got {name!r})", "rename it")
    compressor = zlib.compressobj(9, zlib.DEFLATED, -15)
    deflated = compressor.compress(data) + compressor.flush()
    flags, body = (_DEFLATED, deflated) if len(deflated) < len(data) else (0, data)
    return pack_parts(encoded, len(data), _sha256(data), flags, body)


def _sha256(data: bytes) -> bytes:
    import hashlib  # loads OpenSSL, which pictures without a whole file do without

    return hashlib.sha256(data).digest()


def pack_parts(name: bytes, length: int, digest: bytes, flags: int, body: bytes) -> bytes:
    """Assemble a container from its fields."""
    head = _CONTAINER_HEAD.pack(_MAGIC, _VERSION, flags, len(name))
    return head + name + _CONTAINER_TAIL.pack(length, digest) + body


@dataclass(frozen=True, slots=True)
class Container:
    """A file from its container, with a valid hash."""

    name: str
    data: bytes
    sha256: str


class ContainerError(ValueError):
    """The container is malformed or inconsistent."""


def unpack_container(container: bytes, max_bytes: int) -> Container:
    """Unpack the file in a container.

    Args:
        container: all its bytes.
        max_bytes: largest accepted original length.

    Raises:
        ContainerError: the container is malformed, too large, or its SHA-256 does not fit.
    """
    if len(container) < MIN_CONTAINER_BYTES:
        raise ContainerError(f"the container has {len(container)} bytes, fewer than any file needs")
    magic, version, flags, name_length = _CONTAINER_HEAD.unpack_from(container)
    if magic != _MAGIC or version != _VERSION or flags & ~_DEFLATED or not name_length:
        raise ContainerError("the container's head is not one of version 1")
    at = _CONTAINER_HEAD.size + name_length
    if at + _CONTAINER_TAIL.size > len(container):
        raise ContainerError("the container ends within its head")
    length, digest = _CONTAINER_TAIL.unpack_from(container, at)
    body = container[at + _CONTAINER_TAIL.size :]
    if length > max_bytes:
        raise ContainerError(f"the file's stated length is {length} bytes, more than the accepted {max_bytes}")
    data = _inflated(body, length) if flags & _DEFLATED else body
    if len(data) != length:
        relation = "more" if len(data) > length else "fewer"
        raise ContainerError(f"the file has {relation} bytes than its stated length of {length}")
    found = _sha256(data)
    if found != digest:
        raise ContainerError("the file's SHA-256 does not fit")
    name = container[_CONTAINER_HEAD.size : at].decode("utf-8", "replace")
    return Container(safe_name(name), data, found.hex())


def _inflated(body: bytes, length: int) -> bytes:
    """Inflate the body to at most one byte more than `length`."""
    inflater = zlib.decompressobj(-15)
    try:
        data = inflater.decompress(body, length + 1)
    except zlib.error as error:
        raise ContainerError(f"the file's deflate stream is broken ({error})") from None
    if len(data) <= length and (not inflater.eof or inflater.unused_data):
        raise ContainerError("the file's deflate stream does not end with the container")
    return data


_DEVICES = frozenset(
    ["con", "prn", "aux", "nul", "conin$", "conout$"] + [f"{d}{n}" for d in ("com", "lpt") for n in "0123456789¹²³"]
)
#: Longest name that every file system accepts, with room for a number, bytes.
_MAX_SAFE_BYTES = 200


def safe_name(name: str) -> str:
    """Make a name harmless: no folder, no control or bidirectional character, no device, no hidden file."""
    name = name.replace("\\", "/").rsplit("/", 1)[-1]
    name = "".join(c for c in name if unicodedata.category(c) not in ("Cc", "Cf", "Cs", "Zl", "Zp"))
    name = "".join("_" if c in ':*?"<>|' else c for c in name)
    name = name.lstrip(".- ").rstrip(". ")
    while len(name.encode("utf-8")) > _MAX_SAFE_BYTES:
        stem, dot, suffix = name.rpartition(".")
        name = f"{stem[:-1]}{dot}{suffix}" if stem and len(suffix) < 20 else name[:-1]
    if name.split(".")[0].strip().casefold() in _DEVICES:
        name = f"_{name}"
    return name or "unnamed"
