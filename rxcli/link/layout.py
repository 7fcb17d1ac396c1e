"""Mapping of code bits to blocks, bursts and payload symbols.

A *label* is the 7 bits of payload symbol (burst b, symbol s, column c); a column of weight w sends the first k(w).
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rxcli.link.ldpc import nr_code
from rxcli.link.sequences import largest_coprime, splitmix64, stride

LABEL_BITS = 7
CRC_BYTES = 4
#: Possible lengths of a beacon's body, bytes.
BEACON_LENGTHS = (8, 20, 32, 64, 128, 200)
ANNOUNCEMENT_LENGTH = 20
#: Burst b with b mod 32 = 0 announces the file; the others carry it.
ANNOUNCEMENT_PERIOD = 32
#: Length of a file's block without its CRC, bytes.
BLOCK_BYTES = 1052
#: Object ids for the whitening of beacons and announcements.
BEACON_ID, ANNOUNCEMENT_ID = 0xFFFF, 0xFFFE
#: Mother rates as the announcement numbers them: coded bits per information bit, in halves.
_EXPANSION_HALVES = (3, 4, 6)
#: Information at which a block is decoded, relative to its bits.
READY = (1.075, 1.10, 1.14)

Places = NDArray[np.int64]


def _bits_of(label: Places, passes: Places) -> Places:
    """(..., 7) buffer positions of the bits of labels, in the order in which they are sent in their passes."""
    rotated = (np.arange(LABEL_BITS) + 3 * passes[..., None]) % LABEL_BITS
    return np.asarray(LABEL_BITS * label[..., None] + rotated)


class BeaconLayout:
    """Beacons of body length `length` on a screen of C columns and N payload symbols.

    Args:
        length: of the body, bytes.
        columns: C.
        payload_symbols: N.
        single: whether every burst stands alone, as an announcement does.
    """

    def __init__(self, length: int, columns: int, payload_symbols: int, single: bool = False) -> None:
        self.length, self.code = length, nr_code(2, 8 * (length + CRC_BYTES))
        n_units = payload_symbols * columns
        #: P: bursts of a round.
        self.period = 1 if single else max(1, -(-5 * self.code.k // (4 * LABEL_BITS * n_units)))
        unit = np.arange(self.period * n_units).reshape(self.period, payload_symbols, columns)
        n_labels = largest_coprime(min(self.code.buffer_bits // LABEL_BITS, unit.size), columns)
        #: Bits of the buffer that are sent.
        self.n_bits = LABEL_BITS * n_labels
        #: (P, N, C, 7) buffer position of every bit of a round's labels.
        self.places = _bits_of(unit * stride(n_labels) % n_labels, unit // n_labels)


beacon_layout = lru_cache(maxsize=64)(BeaconLayout)


def announcement_layout(columns: int, payload_symbols: int) -> BeaconLayout:
    """The layout of announcements."""
    return beacon_layout(ANNOUNCEMENT_LENGTH, columns, payload_symbols, True)


class FileLayout:
    """Layout of a container of `length` bytes, object `object_id`, on a screen of C columns and N payload symbols."""

    def __init__(self, object_id: int, length: int, mother: int, columns: int, payload_symbols: int) -> None:
        self.object_id, self.length, self._shape = object_id, length, (payload_symbols, columns)
        #: B: blocks, and bytes of each without its CRC.
        self.n_blocks, self.block_bytes = -(-length // BLOCK_BYTES), min(length, BLOCK_BYTES)
        #: The code of every block.
        self.code = nr_code(1, 8 * (self.block_bytes + CRC_BYTES))
        #: Y: labels of a block; M: bits of its buffer that are sent.
        self.n_labels = _EXPANSION_HALVES[mother] * self.code.k // (2 * LABEL_BITS)
        self.n_bits = LABEL_BITS * self.n_labels
        #: Bits of information at which a block is decoded.
        self.ready = READY[mother] * self.code.k
        # W: largest shift of passes, labels.
        self._window = min(self.n_labels, -(-4 * payload_symbols * columns // self.n_blocks))

    def places(self, bursts: Places) -> tuple[Places, Places]:
        """Blocks (n, N, C) and buffer positions (n, N, C, 7) of data bursts `bursts` (n,)."""
        n_units = self._shape[0] * self._shape[1]
        data = bursts - bursts // ANNOUNCEMENT_PERIOD - 1
        unit = data[:, None, None] * n_units + np.arange(n_units).reshape(self._shape)
        cycle, turn = np.divmod(unit, self.n_blocks)
        number, label = np.divmod(cycle, self.n_labels)
        shift = (splitmix64(number.astype(np.uint64)) % np.uint64(self._window)).astype(np.int64)
        return self._blocks(cycle, turn), _bits_of((label + shift) * stride(self.n_labels) % self.n_labels, number)

    def _blocks(self, cycle: Places, turn: Places) -> Places:
        if self.n_blocks == 1:
            return np.zeros_like(turn)
        different, place = np.unique(cycle, return_inverse=True)
        seeds = (np.uint64(self.object_id) << np.uint64(48)) | ((different & 0xFFFF).astype(np.uint64) << np.uint64(32))
        order = splitmix64(seeds[:, None] | np.arange(self.n_blocks, dtype=np.uint64))
        return np.asarray(np.argsort(order, axis=1, kind="stable")[place.reshape(cycle.shape), turn], np.int64)
