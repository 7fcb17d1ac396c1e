"""Where packets start among slots that were read without knowing it, and hypotheses that are tried by reading them."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from rxcli.protocol import HEADER, PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, WEIGHTS, codebook, encode_packet, payload_bits
from rxcli.receiver import camera as blind
from rxcli.receiver.camera.reading import over_weights, read, start_evidence
from rxcli.receiver.camera.strips import SAMPLES
from rxcli.receiver.camera.views import Views
from rxcli.receiver.camera.waves import WORD_SHARES, Waves, read_freely
from rxcli.receiver.decode.detect import free_log_evidence
from rxcli.receiver.light import NoiseModel
from rxcli.types import Float32Array, FloatArray

LENGTHS = [70, 130, 260]


def _sent(rng: np.random.Generator, weights: list[int], n_symbols: int, first: int, n: int) -> FloatArray:
    """(C, n) slots from position `first` of the first packet on; every column sends its packet again and again."""
    packets = [encode_packet(rng.integers(0, 2, payload_bits(w, n_symbols), dtype=np.uint8), w) for w in weights]
    return np.stack([np.tile(packet, 4)[first : first + n] for packet in packets]).astype(np.float64)


def _brute(log_odds: FloatArray, start: int, packet_slots: int) -> float:
    """The evidence of one start, slot by slot."""
    total = 0.0
    for column in log_odds:
        packets, free = [], []
        for w in WEIGHTS:
            symbol = np.clip(np.arange(SLOTS_PER_SYMBOL) < w, 0.02, 0.98)
            known = np.concatenate([np.clip(HEADER, 0.02, 0.98), symbol])
            place = (np.arange(column.size) - start) % packet_slots
            share = np.where(
                place < PREAMBLE_SLOTS, known[np.minimum(place, 19)], WORD_SHARES[w][place % SLOTS_PER_SYMBOL]
            )
            packets.append(np.log(1 - share + share * np.exp(column)).sum())
            free.append(np.log(1 - w / 10 + w / 10 * np.exp(column)).sum())
        total += np.logaddexp(np.logaddexp.reduce(packets) - np.logaddexp.reduce(free), 0) - np.log(2)
    return float(total)


@pytest.mark.parametrize(("packet_slots", "n"), [(70, 95), (70, 61), (130, 240), (260, 245)])
def test_evidence_is_that_of_every_slot_on_its_own(packet_slots: int, n: int) -> None:
    log_odds = np.clip(np.random.default_rng(n).normal(0, 2, (3, n)), -5, 5)
    (by_weight,) = start_evidence(log_odds, [packet_slots])
    assert by_weight.shape == (3, 9, packet_slots)
    found = over_weights(by_weight)
    assert found.shape == (packet_slots,)
    for start in (0, 1, 9, 37, 50, 69, packet_slots - 1):
        assert found[start] == pytest.approx(_brute(log_odds, start, packet_slots), abs=1e-9)


@pytest.mark.parametrize(("n_symbols", "first"), [(5, 0), (5, 63), (11, 37), (24, 101)])
def test_packets_start_where_they_were_sent(n_symbols: int, first: int) -> None:
    rng = np.random.default_rng(first)
    sent = _sent(rng, [3, 4, 5, 5, 6, 7], n_symbols, first, 340)
    log_odds = 2.0 * (2 * sent - 1) + rng.normal(0, 2.0, sent.shape)
    log_evidence = dict(zip(LENGTHS, map(over_weights, start_evidence(log_odds, LENGTHS)), strict=True))
    right = PREAMBLE_SLOTS + 10 * n_symbols
    assert max(log_evidence, key=lambda length: float(log_evidence[length].max())) == right
    assert int(log_evidence[right].argmax()) == -first % right
    assert log_evidence[right].max() > 60
    noise = rng.normal(0, 2.0, sent.shape)
    assert max(over_weights(one).max() for one in start_evidence(noise, LENGTHS)) < 20


def test_first_slots_of_words_are_dark_more_often() -> None:
    for w in WEIGHTS:
        np.testing.assert_allclose(WORD_SHARES[w], np.clip(codebook(w).mean(axis=0), 0.01, 0.99))
    assert WORD_SHARES[2:6, 0].max() < 0.02


@pytest.mark.parametrize("exposure", [0.8, 1.5])
def test_slots_are_read_without_knowing_anything_of_packets(exposure: float) -> None:
    rng = np.random.default_rng(3)
    sent = _sent(rng, [3, 5, 5, 7], 11, 50, 250)
    seen = _through(sent, exposure, SAMPLES)
    seen = (seen - seen.mean(axis=1, keepdims=True)) / seen.std(axis=1, keepdims=True)
    noisy = (seen + rng.normal(0, 0.2, seen.shape)).astype(np.float32)
    _, log_odds = read_freely(Waves(noisy, np.ones_like(noisy)), exposure)
    assert log_odds.shape == sent.shape
    assert np.mean((log_odds > 0) != (sent > 0.5)) < 0.06


def _through(slots: FloatArray, exposure: float, samples: int) -> Float32Array:
    """(C, n * samples) light of slots through an exposure."""
    fine = np.repeat(slots, 40, axis=1)
    box = np.ones(round(exposure * 40))
    step = 40 // samples
    rows = [np.convolve(row, box / box.size, "same")[step // 2 :: step] for row in fine]
    return np.stack(rows).astype(np.float32)


def test_a_hypothesis_is_read_whatever_length_and_start_it_came_with() -> None:
    rng = np.random.default_rng(8)
    n_slots, rows_per_slot, strips = 200, 4, 4
    sent = _sent(rng, [3, 4, 5, 5, 6, 7, 5, 4], 11, 37, n_slots)
    light = np.repeat(0.2 + _through(sent, 1.9, rows_per_slot), strips, axis=0)
    light = (light + rng.normal(0, 0.08, light.shape)).astype(np.float32)
    n_rows = light.shape[1]
    x = np.repeat(np.linspace(50, 950, light.shape[0])[:, None], n_rows, axis=1)
    rows = np.arange(n_rows, dtype=np.float64)
    noise = NoiseModel(0.0064, 0.0)
    picture = blind.Strips(light, np.ones_like(light), x, rows, sent.shape[0], noise, 1000, n_rows)
    views = Views(picture)
    # Another length, another start; and 1.5 slots off by the end of the picture.
    near = blind.Hypothesis(4.0, 70, 41.0, reversed=False, log_evidence=-10.0)
    reading = read(views, near, np.zeros(4), LENGTHS)
    best = reading.packets[0]
    assert best.packet_slots == 130
    row = reading.values[0] + best.start * reading.values[1]
    assert row % (130 * 4) == pytest.approx((130 - 37) * 4, abs=4)
    assert best.log_evidence == reading.log_evidence > 50
    assert [one.packet_slots for one in reading.packets] != LENGTHS
    off = blind.Hypothesis(4.03, 70, 41.0, reversed=False, log_evidence=-10.0)
    assert best.log_evidence > 1.2 * read(views, off, np.zeros(4), LENGTHS).log_evidence
    wrong = blind.Hypothesis(5.3, 130, 12.0, reversed=False, log_evidence=-5.0)
    assert best.log_evidence > 2 * read(views, wrong, np.zeros(4), LENGTHS).log_evidence


@pytest.mark.parametrize("memory", [1, 2, 3])
def test_free_evidence_is_that_of_all_sequences(memory: int) -> None:
    rng = np.random.default_rng(memory)
    n, share = 6, np.array([0.3, 0.7])
    metrics = rng.normal(0, 2, (2, n, 2 << memory))
    total = np.zeros(2)
    for bits in product((0, 1), repeat=n + memory):
        pattern = [int("".join(map(str, bits[k : k + memory + 1])), 2) for k in range(n)]
        lit = np.array(bits[memory:])
        # The slots before the first one are any.
        prior = np.prod(np.where(lit, share[:, None], 1 - share[:, None]), axis=1) / 2**memory
        total += prior * np.exp(metrics[:, np.arange(n), pattern].sum(axis=1))
    np.testing.assert_allclose(free_log_evidence(metrics, share), np.log(total), rtol=1e-9)
