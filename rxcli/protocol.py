"""Air interface: MPPM codebook, packet layout, bit order. Pure functions, shared by receiver and simulator.

A *slot* is the shortest on/off interval, a *symbol* is ten slots with `w` lit ones, a *packet* is header, dimming
symbol and payload symbols, a *burst* is one packet sent several times back to back.
"""

from functools import cache
from math import comb

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import UsageError

SLOTS_PER_SYMBOL = 10
#: Window length, slots, that always contains a lit and a dark slot, whatever the symbols.
EXTREMES_SLOTS = 2 * SLOTS_PER_SYMBOL - 1
WEIGHTS = range(1, SLOTS_PER_SYMBOL)
HEADER: tuple[int, ...] = (0, 0, 1, 1, 1, 0, 0, 0, 1, 1)
#: Slots of a packet without payload: header and dimming symbol.
PREAMBLE_SLOTS = 2 * SLOTS_PER_SYMBOL


def bits_per_symbol(w: int) -> int:
    """Bits that one symbol of weight `w` carries: floor(log2 C(10, w)).

    Raises:
        ValueError: `w` is not in 1..9.
    """
    if w not in WEIGHTS:
        raise ValueError(f"w must be in 1..9 (got {w})")
    return comb(SLOTS_PER_SYMBOL, w).bit_length() - 1


@cache
def codebook(w: int) -> NDArray[np.uint8]:
    """Codewords of weight `w`, (2**k, 10) uint8 of 0/1, first-sent slot first, in order of index; read-only."""
    n_words = 1 << bits_per_symbol(w)
    values = np.arange(1 << SLOTS_PER_SYMBOL)
    shifts = np.arange(SLOTS_PER_SYMBOL - 1, -1, -1)
    slots = ((values[:, None] >> shifts) & 1).astype(np.uint8)
    words: NDArray[np.uint8] = slots[slots.sum(axis=1) == w][:n_words]
    words.flags.writeable = False
    return words


@cache
def codewords() -> tuple[NDArray[np.uint8], list[int]]:
    """(n, 10) uint8 codewords of all weights, one codebook after the other, read-only; and the first word of each."""
    books = [codebook(w) for w in WEIGHTS]
    words = np.concatenate(books)
    words.flags.writeable = False
    return words, np.cumsum([0, *map(len, books[:-1])]).tolist()


def slot_patterns(isi_memory: int) -> NDArray[np.uint8]:
    """(2**(memory+1), memory+1) uint8 patterns of a slot and its `isi_memory` predecessors, the slot itself last."""
    values = np.arange(1 << (isi_memory + 1))
    return ((values[:, None] >> np.arange(isi_memory, -1, -1)) & 1).astype(np.uint8)


def dimming_symbol(w: int) -> NDArray[np.uint8]:
    """(10,) uint8 symbol after the header: `w` lit slots, then dark ones."""
    bits_per_symbol(w)
    return (np.arange(SLOTS_PER_SYMBOL) < w).astype(np.uint8)


def packet_slots(payload_symbols: int) -> int:
    """Slots of one packet with `payload_symbols` payload symbols."""
    return PREAMBLE_SLOTS + SLOTS_PER_SYMBOL * payload_symbols


def payload_bits(w: int, payload_symbols: int) -> int:
    """Payload bits of one packet of one column."""
    return bits_per_symbol(w) * payload_symbols


def bits_to_indices(bits: NDArray[np.uint8], w: int) -> NDArray[np.int64]:
    """Codebook indices of payload `bits` (multiple of k, first bit most significant)."""
    k = bits_per_symbol(w)
    if bits.size % k:
        raise ValueError(f"the number of payload bits must be a multiple of {k} for w={w} (got {bits.size})")
    return bits.reshape(-1, k).astype(np.int64) @ (1 << np.arange(k - 1, -1, -1))


def indices_to_bits(indices: NDArray[np.int64], w: int) -> NDArray[np.uint8]:
    """Payload bits of codebook `indices`, first bit most significant; the inverse of `bits_to_indices`."""
    k = bits_per_symbol(w)
    return ((indices[:, None] >> np.arange(k - 1, -1, -1)) & 1).astype(np.uint8).ravel()


def encode_packet(bits: NDArray[np.uint8], w: int) -> NDArray[np.uint8]:
    """(20 + 10 N,) uint8 slots of 0/1 of a packet with payload `bits`.

    Raises:
        UsageError: `bits` are no row of 0 and 1.
        ValueError: there are too few or too many of them for symbols of weight `w`, or `w` is none.
    """
    bits = np.asarray(bits)
    if bits.ndim != 1 or bits.dtype.kind not in "biu" or not np.isin(bits, (0, 1)).all():
        raise UsageError("the bits of a packet must be a row of 0 and 1", "give payload_bits(w, n_symbols) of them")
    payload = codebook(w)[bits_to_indices(bits, w)].ravel()
    return np.concatenate([np.array(HEADER, np.uint8), dimming_symbol(w), payload])


def bits_to_hex(bits: NDArray[np.uint8]) -> str:
    """Hex of `bits`, first bit most significant, zero-padded to whole bytes."""
    return np.packbits(bits).tobytes().hex()


def hex_to_bits(text: str, n_bits: int) -> NDArray[np.uint8]:
    """The first `n_bits` bits of `text`; the inverse of `bits_to_hex`.

    Raises:
        ValueError: `text` is no hex or too short.
    """
    bits = np.unpackbits(np.frombuffer(bytes.fromhex(text), np.uint8))
    if bits.size < n_bits:
        raise ValueError(f"payload must hold at least {n_bits} bits (got {bits.size})")
    return bits[:n_bits]
