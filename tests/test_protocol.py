"""The air interface against literal values of its specification."""

from __future__ import annotations

from math import comb

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rxcli import protocol
from rxcli.profiles import ScreenProfile, load_profile


def word(text: str) -> list[int]:
    return [int(slot) for slot in text]


def random_bits(seed: int, w: int, n_symbols: int) -> np.ndarray:
    n_bits = protocol.payload_bits(w, n_symbols)
    return np.random.default_rng(seed).integers(0, 2, n_bits, dtype=np.uint8)


packets = st.tuples(st.integers(0, 2**32 - 1), st.sampled_from(range(1, 10)), st.integers(1, 30))


def test_bits_per_symbol_of_every_weight() -> None:
    assert [protocol.bits_per_symbol(w) for w in range(1, 10)] == [3, 5, 6, 7, 7, 7, 6, 5, 3]


@pytest.mark.parametrize(
    ("w", "index", "slots"),
    [
        (5, 0, "0000011111"),
        (5, 1, "0000101111"),
        (5, 127, "1000010111"),
        (1, 7, "0010000000"),
        (9, 0, "0111111111"),
        (9, 7, "1111111011"),
    ],
)
def test_codewords_of_the_specification(w: int, index: int, slots: str) -> None:
    assert protocol.codebook(w)[index].tolist() == word(slots)


@pytest.mark.parametrize("w", range(1, 10))
def test_codebook_holds_the_smallest_words_in_order(w: int) -> None:
    of_weight = [format(value, "010b") for value in range(1024) if value.bit_count() == w]
    assert len(of_weight) == comb(10, w)
    assert protocol.codebook(w).tolist() == [word(text) for text in of_weight[: 1 << protocol.bits_per_symbol(w)]]


def test_codebook_cannot_be_changed_by_a_caller() -> None:
    with pytest.raises(ValueError, match="read-only"):
        protocol.codebook(5)[0, 0] = 1


def test_header_and_dimming_symbols() -> None:
    assert list(protocol.HEADER) == word("0011100011")
    assert [protocol.dimming_symbol(w).tolist() for w in (1, 5, 9)] == [
        word("1000000000"),
        word("1111100000"),
        word("1111111110"),
    ]


def test_a_packet_written_by_hand() -> None:
    bits = np.array(word("000000000000011111111"), np.uint8)
    slots = "00111000111111100000000001111100001011111000010111"
    assert protocol.encode_packet(bits, 5).tolist() == word(slots)


@pytest.mark.parametrize(
    ("name", "columns", "rate_hz", "n_symbols", "slots", "bits", "paper_kb_s"),
    [
        ("paper-8k65", 20, 8650.0, 5, 70, 35, 42.0),
        ("paper-17k3", 20, 17300.0, 11, 130, 77, 92.4),
        ("paper-34k6", 20, 34600.0, 24, 260, 168, 201.6),
        ("wide-100", 100, 34600.0, 24, 260, 168, 1008.0),
    ],
)
def test_screen_profiles_of_the_specification(
    name: str, columns: int, rate_hz: float, n_symbols: int, slots: int, bits: int, paper_kb_s: float
) -> None:
    screen = load_profile(name, ScreenProfile)
    assert (screen.columns, screen.slot_rate_hz, screen.payload_symbols, screen.repeats) == (
        columns,
        rate_hz,
        n_symbols,
        3,
    )
    assert screen.packet_slots == protocol.packet_slots(n_symbols) == slots
    assert protocol.payload_bits(5, n_symbols) == bits
    assert bits * columns * 60 / 1000 == pytest.approx(paper_kb_s)
    assert screen.packet_s == pytest.approx(slots / rate_hz)


@given(packets)
def test_every_symbol_of_a_packet_has_its_weight(packet: tuple[int, int, int]) -> None:
    seed, w, n_symbols = packet
    slots = protocol.encode_packet(random_bits(seed, w, n_symbols), w)
    assert slots.size == protocol.packet_slots(n_symbols)
    assert slots.reshape(-1, 10).sum(axis=1).tolist() == [5, *[w] * (n_symbols + 1)]


@given(packets)
def test_bits_survive_the_codebook(packet: tuple[int, int, int]) -> None:
    seed, w, n_symbols = packet
    bits = random_bits(seed, w, n_symbols)
    payload = protocol.encode_packet(bits, w)[20:].reshape(-1, 10)
    book = {tuple(slots): index for index, slots in enumerate(protocol.codebook(w).tolist())}
    indices = np.array([book[tuple(slots)] for slots in payload.tolist()])
    assert protocol.indices_to_bits(indices, w).tolist() == bits.tolist()


@given(st.lists(st.integers(0, 1), min_size=1, max_size=200))
def test_bits_survive_hex(bits: list[int]) -> None:
    text = protocol.bits_to_hex(np.array(bits, np.uint8))
    assert len(text) == 2 * -(-len(bits) // 8)
    assert int(text, 16) == int("".join(map(str, bits)), 2) << (-len(bits) % 8)
    assert protocol.hex_to_bits(text, len(bits)).tolist() == bits


def test_slot_patterns_count_with_the_newest_slot_last() -> None:
    assert protocol.slot_patterns(1).tolist() == [[0, 0], [0, 1], [1, 0], [1, 1]]
    assert protocol.slot_patterns(3)[6].tolist() == [0, 1, 1, 0]


@pytest.mark.parametrize("w", [0, 10, -1])
def test_impossible_weight(w: int) -> None:
    for call in (protocol.bits_per_symbol, protocol.codebook, protocol.dimming_symbol):
        with pytest.raises(ValueError, match=rf"w must be in 1..9 \(got {w}\)"):
            call(w)


def test_bits_that_fill_no_symbol() -> None:
    with pytest.raises(ValueError, match=r"multiple of 7 for w=5 \(got 8\)"):
        protocol.encode_packet(np.zeros(8, np.uint8), 5)


@pytest.mark.parametrize(("text", "n_bits"), [("ff", 9), ("", 1), ("f", 4), ("zz", 8)])
def test_hex_that_is_short_or_none(text: str, n_bits: int) -> None:
    with pytest.raises(ValueError, match=r"at least|hexadecimal"):
        protocol.hex_to_bits(text, n_bits)
