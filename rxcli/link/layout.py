"""Mapping of code bits to blocks, bursts and payload symbols.

A *label* is the 7 bits of payload symbol (burst b, symbol s, column c); a column of weight w sends the first k(w).
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from rxcli.link.ldpc import Code, nr_code
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


def _rotation(passes: Places) -> Places:
    """(..., 7) order in which the seven bits of a label are sent in a pass."""
    return np.asarray((np.arange(LABEL_BITS) + 3 * passes[..., None]) % LABEL_BITS)


@dataclass(frozen=True)
class BeaconLayout:
    """Beacons of body length `length`, and announcements, on a screen of C columns and N payload symbols."""

    length: int
    columns: int
    payload_symbols: int
    #: Of an announcement, whose every burst stands alone.
    single: bool = False

    @cached_property
    def code(self) -> Code:
        """LDPC code."""
        return nr_code(2, 8 * (self.length + CRC_BYTES))

    @cached_property
    def period(self) -> int:
        """P: bursts of a round."""
        if self.single:
            return 1
        return max(1, -(-5 * self.code.k // (4 * LABEL_BITS * self.payload_symbols * self.columns)))

    @cached_property
    def n_labels(self) -> int:
        """Y: different labels."""
        units = self.period * self.payload_symbols * self.columns
        return largest_coprime(min(self.code.buffer_bits // LABEL_BITS, units), self.columns)

    @cached_property
    def n_bits(self) -> int:
        """Bits of the buffer that are sent."""
        return LABEL_BITS * self.n_labels

    @cached_property
    def places(self) -> Places:
        """(P, N, C, 7) buffer position of every bit of a round's labels."""
        unit = np.arange(self.period * self.payload_symbols * self.columns).reshape(
            self.period, self.payload_symbols, self.columns
        )
        label = unit * stride(self.n_labels) % self.n_labels
        return LABEL_BITS * label[..., None] + _rotation(unit // self.n_labels)


@lru_cache(maxsize=64)
def beacon_layout(length: int, columns: int, payload_symbols: int, single: bool = False) -> BeaconLayout:
    """The cached layout."""
    return BeaconLayout(length, columns, payload_symbols, single)


def announcement_layout(columns: int, payload_symbols: int) -> BeaconLayout:
    """The layout of announcements."""
    return beacon_layout(ANNOUNCEMENT_LENGTH, columns, payload_symbols, True)


@dataclass(frozen=True)
class FileLayout:
    """Layout of a container of `length` bytes, object `object_id`, on a screen of C columns and N payload symbols."""

    object_id: int
    length: int
    mother: int
    columns: int
    payload_symbols: int

    @cached_property
    def n_blocks(self) -> int:
        """B: blocks."""
        return -(-self.length // BLOCK_BYTES)

    @cached_property
    def block_bytes(self) -> int:
        """Bytes of a block without its CRC."""
        return min(self.length, BLOCK_BYTES)

    @cached_property
    def code(self) -> Code:
        """The code of every block."""
        return nr_code(1, 8 * (self.block_bytes + CRC_BYTES))

    @cached_property
    def n_labels(self) -> int:
        """Y: labels of a block."""
        return _EXPANSION_HALVES[self.mother] * self.code.k // (2 * LABEL_BITS)

    @cached_property
    def n_bits(self) -> int:
        """M: bits of a block's buffer that are sent."""
        return LABEL_BITS * self.n_labels

    @cached_property
    def _window(self) -> int:
        """W: largest shift of passes, labels."""
        return min(self.n_labels, -(-4 * self.payload_symbols * self.columns // self.n_blocks))

    @property
    def ready(self) -> float:
        """Bits of information at which a block is decoded."""
        return READY[self.mother] * self.code.k

    def _first_unit(self, bursts: Places) -> Places:
        data = bursts - bursts // ANNOUNCEMENT_PERIOD - 1
        return np.asarray(data * (self.payload_symbols * self.columns))

    def all_differ(self, bursts: Places) -> bool:
        """Whether data bursts `bursts` lie within one pass, so that no bit is sent twice."""
        unit, per_pass = self._first_unit(bursts), self.n_blocks * self.n_labels
        return bool(unit.min() // per_pass == (unit.max() + self.payload_symbols * self.columns - 1) // per_pass)

    def labels(self, bursts: Places) -> tuple[Places, Places, Places]:
        """Block, label and pass (n, N, C) of every symbol of data bursts `bursts` (n,)."""
        shape = (self.payload_symbols, self.columns)
        unit = self._first_unit(bursts)[:, None, None] + np.arange(shape[0] * shape[1]).reshape(shape)
        cycle, turn = np.divmod(unit, self.n_blocks)
        number, label = np.divmod(cycle, self.n_labels)
        shift = (splitmix64(number.astype(np.uint64)) % np.uint64(self._window)).astype(np.int64)
        return self._blocks(cycle, turn), (label + shift) * stride(self.n_labels) % self.n_labels, number

    @staticmethod
    def bits_of(label: Places, number: Places) -> Places:
        """(..., 7) buffer positions of the bits of labels in their passes."""
        return LABEL_BITS * label[..., None] + _rotation(number)

    def places(self, bursts: Places) -> tuple[Places, Places]:
        """Blocks (n, N, C) and buffer positions (n, N, C, 7) of data bursts `bursts` (n,)."""
        blocks, label, number = self.labels(bursts)
        return blocks, self.bits_of(label, number)

    def _blocks(self, cycle: Places, turn: Places) -> Places:
        if self.n_blocks == 1:
            return np.zeros_like(turn)
        different, place = np.unique(cycle, return_inverse=True)
        seeds = (np.uint64(self.object_id) << np.uint64(48)) | ((different & 0xFFFF).astype(np.uint64) << np.uint64(32))
        order = splitmix64(seeds[:, None] | np.arange(self.n_blocks, dtype=np.uint64))
        return np.asarray(np.argsort(order, axis=1, kind="stable")[place.reshape(cycle.shape), turn], np.int64)
