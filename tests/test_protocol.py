"""The air interface against literal values of its specification."""

from collections.abc import Callable
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


#: Hex that is short or none, and the bits that are asked for.
SHORT = (("ff", 9), ("", 1), ("f", 4), ("zz", 8))
packets = st.tuples(st.integers(0, 2**32 - 1), st.sampled_from(range(1, 10)), st.integers(1, 30))


def test_bits_per_symbol_of_every_weight() -> None:
    assert [protocol.bits_per_symbol(w) for w in range(1, 10)] == [3, 5, 6, 7, 7, 7, 6, 5, 3]


@pytest.mark.parametrize("w", range(1, 10))
def test_codebook_holds_the_smallest_words_in_order(w: int) -> None:
    of_weight = [format(value, "010b") for value in range(1024) if value.bit_count() == w]
    assert len(of_weight) == comb(10, w)
    assert protocol.codebook(w).tolist() == [word(text) for text in of_weight[: 1 << protocol.bits_per_symbol(w)]]
    with pytest.raises(ValueError, match="read-only"):
        protocol.codebook(w)[0, 0] = 1


def test_a_packet_written_by_hand() -> None:
    bits = np.array(word("000000000000011111111"), np.uint8)
    slots = "00111000111111100000000001111100001011111000010111"
    assert protocol.encode_packet(bits, 5).tolist() == word(slots)
    dimming = {1: "1000000000", 5: "1111100000", 9: "1111111110"}
    assert {w: protocol.dimming_symbol(w).tolist() for w in dimming} == {w: word(text) for w, text in dimming.items()}


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
def test_bits_survive_the_codebook(packet: tuple[int, int, int]) -> None:
    seed, w, n_symbols = packet
    bits = random_bits(seed, w, n_symbols)
    slots = protocol.encode_packet(bits, w)
    assert slots.reshape(-1, 10).sum(axis=1).tolist() == [5, *[w] * (n_symbols + 1)]
    payload = slots[20:].reshape(-1, 10)
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


@pytest.mark.parametrize(
    ("call", "reason"),
    [
        (lambda: protocol.encode_packet(np.zeros(8, np.uint8), 5), r"multiple of 7 for w=5 \(got 8\)"),
        *((lambda text=text, n=n: protocol.hex_to_bits(text, n), "at least|hexadecimal") for text, n in SHORT),
    ],
)
def test_bits_that_do_not_fit(call: Callable[[], object], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        call()
