"""Lamps and dimmed screens are no packets; packets are, whatever their payload repeats."""

import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.protocol import encode_packet, payload_bits
from rxcli.receiver.decode.steady import is_steady
from tests.row_profiles import exposed

Q, N_COLUMNS, N_SLOTS = 2, 6, 330
SYMBOLS = {70: 5, 130: 11}


def shown(slots: NDArray[np.uint8], sigma: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """(C, N * Q) light of slots, Q samples each, through an exposure of a slot."""
    centre = (np.arange(N_SLOTS * Q) + 0.5) / Q
    light = 2 * exposed(slots, centre, 1.0) - 1
    return np.asarray(light + rng.normal(0, sigma, light.shape), np.float32)


def packets(payloads: list[NDArray[np.uint8]], w: int, first: int) -> NDArray[np.uint8]:
    """(C, N_SLOTS) the same packets again and again, from a slot of the first one on."""
    return np.stack([np.tile(encode_packet(bits, w), 8)[first : first + N_SLOTS] for bits in payloads])


@pytest.mark.parametrize("packet_slots", SYMBOLS)
@pytest.mark.parametrize("seed", range(12))
def test_a_dimmed_screen_is_steady(packet_slots: int, seed: int) -> None:
    """Whatever slots are decided: here those that fit best, each by itself, for slots of any phase."""
    rng = np.random.default_rng(seed)
    fine, period, duty = 16, rng.uniform(1.2, 0.45 * packet_slots), rng.uniform(0.1, 0.7)
    on = ((np.arange(N_SLOTS * fine) / fine + rng.uniform(0, period)) % period < duty * period).astype(np.uint8)
    centre = (np.arange(N_SLOTS * Q) + 0.5) / Q * fine
    light = np.repeat(2 * exposed(on[None], centre, 0.8 * fine) - 1, N_COLUMNS, axis=0)
    value = np.asarray(light + rng.normal(0, 0.15, light.shape), np.float32)
    lit = np.asarray(value.reshape(N_COLUMNS, N_SLOTS, Q).mean(axis=2) > 0, np.float32)
    # Codewords follow a waveform of another period only so far.
    lit[rng.random(lit.shape) < 0.15] = 0.5
    assert is_steady(value, np.ones_like(value), lit, packet_slots)


@pytest.mark.parametrize("packet_slots", SYMBOLS)
@pytest.mark.parametrize("w", [1, 2, 5, 8])
@pytest.mark.parametrize("payload", ["random", "alike", "zero"])
@pytest.mark.parametrize("sigma", [0.05, 0.4])
def test_packets_are_not(packet_slots: int, w: int, payload: str, sigma: float) -> None:
    """Also where all columns send the same, and where it is one symbol over and over."""
    rng = np.random.default_rng(packet_slots + w)
    n_bits = payload_bits(w, SYMBOLS[packet_slots])
    bits = [rng.integers(0, 2, n_bits, dtype=np.uint8) for _ in range(N_COLUMNS)]
    if payload != "random":
        bits = [bits[0] * (payload == "alike")] * N_COLUMNS
    slots = packets(bits, w, int(rng.integers(packet_slots)))
    value = shown(slots, sigma, rng)
    assert not is_steady(value, np.ones_like(value), slots.astype(np.float32), packet_slots)


def test_no_light_is_not() -> None:
    nothing = np.zeros((N_COLUMNS, N_SLOTS * Q), np.float32)
    assert not is_steady(nothing, nothing, np.zeros((N_COLUMNS, N_SLOTS), np.float32), 70)
