"""The values that any implementation must give, from an independent one."""

import hashlib
import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rxcli.link import ldpc
from rxcli.link.encoder import FileSending, MessageSending, file_object, message
from rxcli.link.formats import Announcement, pack_parts, protect, unprotect_announcement
from rxcli.link.layout import announcement_layout, beacon_layout
from rxcli.link.sequences import whiten

VECTORS = json.loads((Path(__file__).parent / "vectors.json").read_text(encoding="utf-8"))
SCREENS = {"data-34k6": (20, 24), "data-17k3": (20, 11), "data-8k65": (20, 5), "wide-100": (100, 24)}


def check_labels(labels: np.ndarray, expected: dict[str, Any]) -> None:
    assert list(labels.shape) == expected["shape"]
    assert labels.ravel()[: len(expected["first40"])].tolist() == expected["first40"]
    assert hashlib.sha256(np.ascontiguousarray(labels).tobytes()).hexdigest() == expected["sha256"]


@pytest.mark.parametrize("case", sorted(VECTORS["whitening"]))
def test_whitening(case: str) -> None:
    o, i, n = (part.split("=")[-1] for part in case.replace(",", "").split()[:3])
    assert whiten(bytes(int(n)), int(o, 0), int(i)).hex() == VECTORS["whitening"][case]


def test_beacon_information_and_buffer() -> None:
    case = VECTORS["beacon"]
    sending = message(case["text"])
    assert sending.body.hex() == case["body"]
    whitened = protect(sending.body, 0xFFFF, len(sending.body))
    assert whitened.hex() == case["whitened"]
    assert whiten(whitened, 0xFFFF, 20).hex() == case["information"]
    code = ldpc.nr_code(2, 8 * len(whitened))
    buffer = ldpc.encode(code, np.unpackbits(np.frombuffer(whitened, np.uint8))[None])[0]
    assert (code.z, buffer.size) == (case["Z"], case["buffer_bits"])
    assert np.packbits(buffer).tobytes().hex() == case["buffer_packed"]


@pytest.mark.parametrize("name", [k for k in VECTORS["beacon"] if k.startswith("labels")])
def test_beacon_labels(name: str) -> None:
    screen = next(part.strip() for part in name.split(",") if part.strip() in SCREENS)
    long = "'y' 190 times" in name
    sending: MessageSending = message("y" * 190 if long else VECTORS["beacon"]["text"])
    expected = VECTORS["beacon"][name]
    check_labels(sending.labels(np.arange(expected["shape"][0]), *SCREENS[screen]), expected)


def announcement() -> Announcement:
    case = VECTORS["announcement"]["tuple"]
    return Announcement(case["mother"], case["oid"], case["length"], case["b"], case["ccrc"])


def test_announcement() -> None:
    case = VECTORS["announcement"]
    coded = announcement().protected()
    assert whiten(coded, 0xFFFE, 20).hex() == case["information"]
    assert unprotect_announcement(coded) == announcement()
    code = announcement_layout(20, 24).code
    buffer = ldpc.encode(code, np.unpackbits(np.frombuffer(coded, np.uint8))[None])[0]
    assert np.packbits(buffer).tobytes().hex() == case["buffer_packed"]
    for screen in ("data-34k6", "data-17k3", "data-8k65"):
        places = announcement_layout(*SCREENS[screen]).places[0]
        check_labels(np.asarray(buffer[places] @ (1 << np.arange(6, -1, -1)), np.uint8), case[f"labels {screen}"])


def big_file(mother: int) -> FileSending:
    data = bytes(7 * i % 251 for i in range(3000))
    case = VECTORS["file"]
    container = pack_parts(case["name"].encode(), 3000, hashlib.sha256(data).digest(), case["flags"], data)
    assert len(container) == case["container_length"]
    assert hashlib.sha256(container).hexdigest() == case["container_sha256"]
    assert f"{zlib.crc32(container):08x}" == case["container_crc32"]
    return FileSending(container, case["object"], mother, case["name"])


@pytest.mark.parametrize(("mother", "rate"), [(0, "1/1.5"), (1, "1/2"), (2, "1/3")])
def test_file(mother: int, rate: str) -> None:
    sending, expected = big_file(mother), VECTORS["file"][f"data-34k6, mother {rate}"]
    layout = sending.layout(20, 24)
    assert (layout.n_bits, layout.code.k, layout.code.z) == (expected["M"], expected["K"], expected["Z"])
    blocks, _ = layout.places(np.array([1]))
    assert blocks.ravel()[:30].tolist() == VECTORS["file"]["block of units 0..29"]
    labels = sending.labels(np.arange(64), 20, 24)
    check_labels(labels, expected)
    assert labels[1].ravel()[:40].tolist() == expected["first_data_burst40"]
    assert labels[63].ravel()[:40].tolist() == expected["burst_63_first40"]


def test_small_file() -> None:
    case = VECTORS["small file"]
    sending = FileSending(bytes.fromhex(case["container"]), case["object"], 2, case["name"])
    assert file_object("b.bin", b"mini", 2).container == sending.container
    layout = sending.layout(20, 5)
    assert (layout.code.k, layout.code.z, layout.n_bits) == (case["K"], case["Z"], case["M"])
    check_labels(sending.labels(np.arange(8), 20, 5), case["labels"])


def test_beacons_fit_their_rounds() -> None:
    assert [beacon_layout(200, 20, n).period for n in (24, 11, 5)] == [1, 2, 3]
