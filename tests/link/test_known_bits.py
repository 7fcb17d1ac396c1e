"""Bits of a message that are known before it is decoded: zeros after it, and the letters of a text."""

import numpy as np
import pytest

from rxcli.link import ldpc
from rxcli.link.beacons import read_words
from rxcli.link.formats import beacon_body, protect_beacon, unprotect_beacon
from rxcli.link.known_bits import KnownBits, known_bits
from rxcli.link.layout import beacon_layout
from rxcli.link.softbits import Float32, information

LAYOUT = beacon_layout(64, 20, 11)
SHORT, OTHER, FULL = "Platform 4: the 10:42 leaves here", "Поезд с пути 4 в 10:42", "x" + "Platform 4: " * 5


def buffers(text: str, sigma: float, n: int = 12) -> Float32:
    """Soft bits of the first seven symbols of a packet, in noise."""
    rng = np.random.default_rng(7)
    bits = np.unpackbits(np.frombuffer(protect_beacon(beacon_body("text", text.encode())), np.uint8))
    sent = 2.0 * ldpc.encode(LAYOUT.code, bits[None])[0, : LAYOUT.n_bits] - 1
    shown = np.zeros(LAYOUT.n_bits, bool)
    shown[LAYOUT.places[:, :7]] = True
    return np.asarray(2 / sigma**2 * (sent + rng.normal(0, sigma, (n, sent.size))) * shown, np.float32)


def read(observed: Float32, known: KnownBits | None = None) -> list[tuple[str, bytes] | None]:
    return read_words(LAYOUT.code, observed, lambda _, word: unprotect_beacon(word), known)  # type: ignore[return-value]


@pytest.mark.parametrize(("text", "sigma"), [(SHORT, 0.95), (OTHER, 0.8), (FULL, 0.75)])
def test_known_bits_help_and_never_mislead(text: str, sigma: float) -> None:
    observed = buffers(text, sigma)
    known = known_bits(LAYOUT, observed)
    words = read(observed, known)
    assert set(words) == {("text", text.encode())}
    assert words.count(None) <= read(observed).count(None)


def test_a_text_is_read_from_fewer_bits_than_its_code_protects() -> None:
    observed = buffers(SHORT, 0.95)
    assert information(observed).sum(axis=1).max() < LAYOUT.code.k
    assert (known_bits(LAYOUT, observed).llr > 20).all()


def test_noise_shows_no_zeros() -> None:
    noise = np.random.default_rng(8).normal(0, 3, (50, LAYOUT.n_bits)).astype(np.float32)
    assert known_bits(LAYOUT, noise).llr.max() < 8
    assert not any(read(noise, known_bits(LAYOUT, noise)))
