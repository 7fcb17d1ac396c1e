"""Bodies, announcements, containers and names: what is taken and what is refused."""

import hashlib
import struct
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rxcli.errors import UsageError
from rxcli.link import formats
from rxcli.link.formats import (
    Announcement,
    ContainerError,
    beacon_body,
    pack_container,
    pack_parts,
    protect,
    protect_beacon,
    safe_name,
    unpack_container,
    unprotect_announcement,
    unprotect_beacon,
)

BIG = 1 << 20


@given(st.text(min_size=1, max_size=60).filter(lambda t: "\0" not in t and 0 < len(t.encode("utf-8", "ignore")) < 200))
def test_texts_survive(text: str) -> None:
    data = text.encode("utf-8")
    assert unprotect_beacon(protect_beacon(beacon_body("text", data))) == ("text", data)


def test_bodies_are_padded_to_the_smallest_length() -> None:
    lengths = {1: 8, 7: 8, 8: 20, 19: 20, 31: 32, 63: 64, 127: 128, 199: 200}
    assert {n: len(beacon_body("raw", b"x" * n)) for n in lengths} == lengths
    assert unprotect_beacon(protect_beacon(beacon_body("raw", b"ab"))) == ("raw", b"ab" + bytes(5))


@pytest.mark.parametrize(("kind", "data"), [("text", b""), ("text", b"a\0b"), ("uri", b"\0"), ("raw", b"x" * 200)])
def test_bodies_that_cannot_be_are_refused(kind: str, data: bytes) -> None:
    with pytest.raises(UsageError):
        beacon_body(kind, data)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "body", [b"\x03hello\0\0", b"\x01a\0b\0\0\0\0", b"\x01\xff\xfe\0\0\0\0\0", b"\x02" + bytes(7), b"\xffabcdefg"]
)
def test_bodies_of_no_message_are_none(body: bytes) -> None:
    assert unprotect_beacon(protect_beacon(body)) is None


@given(st.integers(0, 8 * 24 - 1))
def test_a_flipped_bit_is_no_announcement(place: int) -> None:
    coded = bytearray(Announcement(2, 7, 100, 32, 1).protected())
    coded[place // 8] ^= 1 << place % 8
    assert unprotect_announcement(bytes(coded)) is None


GOOD = {"version": 1, "mother": 2, "object": 7, "length": 100, "burst": 32, "crc": 5, "zero": 0}


@pytest.mark.parametrize(
    ("field", "value"),
    [("version", 2), ("mother", 3), ("object", 0xFFFE), ("object", 0xFFFF), ("length", 47), ("burst", 33), ("zero", 1)],
)
def test_announcements_that_lie_are_rejected(field: str, value: int) -> None:
    def coded(fields: dict[str, int]) -> bytes:
        return protect(struct.pack(">BBHIIII", *fields.values()), 0xFFFE, 20)

    assert unprotect_announcement(coded(GOOD)) == Announcement(2, 7, 100, 32, 5)
    assert unprotect_announcement(coded(GOOD | {field: value})) is None


@given(st.binary(max_size=3000))
def test_containers_survive(data: bytes) -> None:
    found = unpack_container(pack_container("a b.bin", data), BIG)
    assert (found.name, found.data, found.sha256) == ("a b.bin", data, hashlib.sha256(data).hexdigest())
    assert len(pack_container("z", bytes(10_000))) < 200  # deflated


def container(**change: object) -> bytes:
    fields = {"name": b"a", "length": 4, "digest": hashlib.sha256(b"mini").digest(), "flags": 0, "body": b"mini"}
    return pack_parts(**(fields | change))  # type: ignore[arg-type]


def deflated(data: bytes) -> bytes:
    compressor = zlib.compressobj(9, zlib.DEFLATED, -15)
    return compressor.compress(data) + compressor.flush()


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"flags": 2}, "head"),
        ({"name": b""}, "head"),
        ({"length": 5}, "fewer"),
        ({"length": 3}, "more"),
        ({"length": 1 << 40}, "accepted"),
        ({"digest": bytes(32)}, "SHA-256"),
        ({"flags": 1, "body": b"\xff\xff"}, "deflate"),
        ({"flags": 1, "body": deflated(b"mini") + b"x"}, "end with"),
        ({"flags": 1, "body": deflated(bytes(100_000_000))}, "more"),
    ],
)
def test_containers_that_lie_are_refused(change: dict[str, object], why: str) -> None:
    with pytest.raises(ContainerError, match=why):
        unpack_container(container(**change), BIG)


@pytest.mark.parametrize(
    ("name", "safe"),
    [
        ("photo.jpg", "photo.jpg"),
        ("../../etc/passwd", "passwd"),
        ("C:\\temp\\x.txt", "x.txt"),
        ("/", "unnamed"),
        ("..", "unnamed"),
        (".bashrc", "bashrc"),
        ("--rf", "rf"),
        ("con.txt", "_con.txt"),
        ("LPT1", "_LPT1"),
        ("a:b", "a_b"),
        ("a\u202egpj.exe", "agpj.exe"),
        ("line\nbreak\x1b[31m", "linebreak[31m"),
        ("dots...", "dots"),
        ("größe.txt", "größe.txt"),
    ],
)
def test_names_can_do_no_harm(name: str, safe: str) -> None:
    assert safe_name(name) == safe


@given(st.text(max_size=300))
def test_any_name_is_one_place_in_a_folder(name: str) -> None:
    safe = safe_name(name)
    assert safe not in ("", ".", "..")
    assert not set(safe) & set("/\\:\0")
    assert not safe.startswith((".", "-"))
    assert len(safe.encode("utf-8")) <= 201
    assert formats.safe_name(safe) in (safe, f"_{safe}")
