"""Quasi-cyclic LDPC codes of 3GPP TS 38.212, section 5.3.2: encoder and layered min-sum decoder.

A code of `k` information bits has base graph 1 or 2 lifted by `z`. Block column c, lane i is coded bit c * z + i; the
first 2 z bits are never sent and filler bits are known zeros; all others, in order, are the *buffer*.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_INFORMATION_COLUMNS = {1: 22, 2: 10}
#: Lifting sizes are a * 2**i up to 384; the index of a is the number of the set.
_LIFTING_BASES, _MAX_LIFTING = (2, 3, 5, 7, 9, 11, 13, 15), 384
_CORE_ROWS = 4
#: Punctured block columns.
_PUNCTURED = 2
#: Step of the decoder's log-likelihood ratios; input is limited to 127 steps.
LLR_STEP = 1 / 8
_MAX_INPUT = 127
#: Limit of messages, so that the sum of all messages at a bit (30 at most) stays within 16 bits.
_MAX_MESSAGE = 1000
#: Log-likelihood ratio of filler bits, which are known.
_KNOWN = 8000

Bits = NDArray[np.uint8]
Edge = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Code:
    """A code; rows are lists of (block column, shift)."""

    graph: int
    k: int
    z: int
    rows: tuple[tuple[Edge, ...], ...]

    @property
    def information_columns(self) -> int:
        """Block columns of information and filler bits."""
        return _INFORMATION_COLUMNS[self.graph]

    @property
    def filler(self) -> int:
        """Number of known zeros after the information bits."""
        return self.information_columns * self.z - self.k

    @property
    def first_sent(self) -> int:
        """First information bit that is sent; the buffer begins with it."""
        return _PUNCTURED * self.z

    @property
    def n_columns(self) -> int:
        """Block columns."""
        return self.information_columns + len(self.rows)

    @property
    def buffer_bits(self) -> int:
        """Bits that may be sent."""
        return (self.n_columns - _PUNCTURED) * self.z - self.filler

    def rows_for(self, buffer_bits: int) -> int:
        """Rows that involve the first `buffer_bits` bits of the buffer."""
        last = _PUNCTURED * self.z + buffer_bits + self.filler
        return min(len(self.rows), max(_CORE_ROWS, -(-last // self.z) - self.information_columns))


@cache
def _base_graph(graph: int) -> NDArray[np.int64]:
    text = Path(__file__).with_name(f"nr_base_graph_{graph}.csv").read_text(encoding="ascii")
    return np.array([[int(v) for v in line.split(",")] for line in text.split()[1:]], np.int64)


def _lifting(k: int, graph: int) -> tuple[int, int]:
    """The smallest lifting size that holds `k` bits, and its set."""
    sizes = ((a << i, number) for number, a in enumerate(_LIFTING_BASES) for i in range(8) if a << i <= _MAX_LIFTING)
    return min((z, number) for z, number in sizes if _INFORMATION_COLUMNS[graph] * z >= k)


@cache
def nr_code(graph: int, k: int) -> Code:
    """Build the code of base graph 1 or 2 for `k` information bits.

    Raises:
        ValueError: `k` is too large for the lifting sizes, or smaller than the number of punctured bits.
    """
    if not 0 < k <= _INFORMATION_COLUMNS[graph] * _MAX_LIFTING:
        raise ValueError(f"k must be in 1..{_INFORMATION_COLUMNS[graph] * _MAX_LIFTING} for graph {graph} (got {k})")
    z, lifting_set = _lifting(k, graph)
    if k < _PUNCTURED * z:
        raise ValueError(f"k must be at least {_PUNCTURED * z} (got {k})")
    table = _base_graph(graph)
    rows: list[list[Edge]] = [[] for _ in range(int(table[:, 0].max()) + 1)]
    for row, column, *shifts in table.tolist():
        rows[row].append((column, shifts[lifting_set] % z))
    return Code(graph, k, z, tuple(tuple(row) for row in rows))


def encode(code: Code, information: Bits) -> Bits:
    """Encode blocks to the buffers of their codewords.

    Args:
        code: the code.
        information: (batch, k) uint8 of 0/1.

    Returns:
        (batch, code.buffer_bits) uint8.
    """
    batch = information.shape[0]
    coded = np.zeros((batch, code.n_columns, code.z), np.uint8)
    kb = code.information_columns
    coded[:, :kb] = np.pad(information, ((0, 0), (0, code.filler))).reshape(batch, kb, code.z)
    _solve_core(code, coded)
    for number, row in enumerate(code.rows[_CORE_ROWS:], _CORE_ROWS):
        coded[:, kb + number] = _sum(coded, [edge for edge in row if edge[0] != kb + number])
    flat = coded.reshape(batch, -1)
    return np.concatenate([flat[:, _PUNCTURED * code.z : code.k], flat[:, kb * code.z :]], axis=1)


def _sum(coded: Bits, edges: list[Edge]) -> Bits:
    """(batch, z) sum over some edges of a row, modulo 2."""
    total = np.zeros((coded.shape[0], coded.shape[2]), np.uint8)
    for column, shift in edges:
        total ^= np.roll(coded[:, column], -shift, axis=1)
    return total


def _solve_core(code: Code, coded: Bits) -> None:
    """Solve for the four core parity columns: the sum of the four rows contains only a shift of the first column."""
    kb = code.information_columns
    core = code.rows[:_CORE_ROWS]
    shifts = [shift for row in core for column, shift in row if column == kb]
    (left,) = {shift for shift in shifts if shifts.count(shift) % 2}
    known = [edge for row in core for edge in row if edge[0] < kb]
    coded[:, kb] = np.roll(_sum(coded, known), left, axis=1)
    solved = set(range(kb + 1))
    while len(solved) < kb + _CORE_ROWS:
        for row in core:
            missing = [edge for edge in row if edge[0] not in solved]
            if len(missing) == 1:
                (column, shift), *_ = missing
                coded[:, column] = np.roll(_sum(coded, [e for e in row if e[0] in solved]), shift, axis=1)
                solved.add(column)


#: Acceptance test of hard decisions: (batch indices (n,), information bits (n, k)) -> (n,) bool.
Accept = Callable[[NDArray[np.int64], Bits], NDArray[np.bool_]]


def quantised(llr: NDArray[np.floating]) -> NDArray[np.int8]:
    """Quantise log-likelihood ratios to steps of `LLR_STEP`."""
    return np.asarray(np.clip(np.rint(llr / LLR_STEP), -_MAX_INPUT, _MAX_INPUT), np.int8)


#: Iterations after which a block is given up as no codeword, and the least ratio of its share of unsatisfied checks to
#: that after the first iteration at which it is; both again for a block with this share of nearly certain bits.
_PATIENCE, _MAX_RATIO = 6, 0.95
_PATIENCE_CERTAIN, _MAX_RATIO_CERTAIN, _CERTAIN_BITS, _CERTAIN_LLR = 2, 0.4, 0.9, 3.0


def decode(
    code: Code,
    buffer_llr: NDArray[np.int8],
    accept: Accept,
    max_iterations: int = 22,
    gives_up: bool = False,
    unsent_llr: NDArray[np.int8] | None = None,
) -> NDArray[np.bool_]:
    """Decode a batch of blocks by layered normalised min-sum in 16-bit numbers, until `accept` accepts them.

    Parity is no stopping rule, because bits without observation need not satisfy it.

    Args:
        code: the code.
        buffer_llr: (batch, M) int8: ln p(1)/p(0) in steps of `LLR_STEP` of the first M bits of the buffer, 0 unknown.
        accept: called after every iteration with batch indices and information bits.
        max_iterations: maximum number of iterations.
        gives_up: whether a block that looks like no codeword is given up before all iterations.
        unsent_llr: (batch, first_sent) likewise of the bits that are never sent, if anything is known of them.

    Returns:
        (batch,) which blocks were accepted.
    """
    n_rows = code.rows_for(buffer_llr.shape[1])
    total = _decoder_input(code, buffer_llr, n_rows)
    if unsent_llr is not None:
        total[: code.first_sent] = -unsent_llr.T.astype(np.int16)
    layers = _Layers(code, n_rows, total)
    places = np.arange(buffer_llr.shape[0])
    accepted = np.zeros(places.size, bool)
    still = np.ones(places.size, bool)
    is_certain = (np.abs(buffer_llr) > _CERTAIN_LLR / LLR_STEP).mean(axis=1) > _CERTAIN_BITS
    first_share = np.ones(places.size)
    for iteration in range(1, max_iterations + 1):
        layers.update()
        if iteration == 1 and gives_up:
            first_share = layers.unsatisfied()
        if iteration == 1 and max_iterations > 1:
            continue
        which = np.flatnonzero(still)
        good = accept(places[which], layers.information(which))
        accepted[places[which[good]]] = True
        still[which[good]] = False
        if gives_up and iteration in (_PATIENCE_CERTAIN, _PATIENCE):
            max_ratio = np.where(is_certain, _MAX_RATIO_CERTAIN, _MAX_RATIO)
            still &= (layers.unsatisfied() < max_ratio * first_share) | ((iteration < _PATIENCE) & ~is_certain)
        if not still.any():
            break
        if still.mean() < _CROWDED:
            layers.keep(still)
            places, first_share = places[still], first_share[still]
            is_certain, still = is_certain[still], still[still]
    return accepted


#: Finished blocks are removed when the share of unfinished ones falls below this, since removal costs time.
_CROWDED = 0.7


def _decoder_input(code: Code, buffer_llr: NDArray[np.int8], n_rows: int) -> NDArray[np.int16]:
    """(block columns * z, batch) int16 ln p(0)/p(1), with filler bits known to be zero."""
    batch, n_bits = buffer_llr.shape
    kb, z = code.information_columns, code.z
    flat = np.zeros(((kb + n_rows) * z, batch), np.int16)
    systematic = min(n_bits, code.k - _PUNCTURED * z)
    flat[_PUNCTURED * z : _PUNCTURED * z + systematic] = -buffer_llr[:, :systematic].T.astype(np.int16)
    flat[code.k : kb * z] = _KNOWN
    flat[kb * z : kb * z + n_bits - systematic] = -buffer_llr[:, systematic:].T.astype(np.int16)
    return flat


@cache
def _places(code: Code) -> list[NDArray[np.intp]]:
    """Of each row of checks: (edges, z) coded bits."""
    lanes = np.arange(code.z)
    return [np.stack([column * code.z + (lanes + shift) % code.z for column, shift in row]) for row in code.rows]


class _Layers:
    """Decoder state of a batch.

    Args:
        code: the code.
        n_rows: rows in use.
        total: (block columns * z, batch) int16 ln p(0)/p(1).
    """

    def __init__(self, code: Code, n_rows: int, total: NDArray[np.int16]) -> None:
        self._code, self._rows = code, _places(code)[:n_rows]
        self._begin(total, [np.zeros((*row.shape, total.shape[1]), np.int16) for row in self._rows])

    def _begin(self, total: NDArray[np.int16], messages: list[NDArray[np.int16]]) -> None:
        self._total, self._messages = total, messages
        # Allocating arrays of this size costs more than the computation.
        degree = max(len(row) for row in self._rows)
        self._incoming = np.empty((degree, self._code.z, total.shape[1]), np.int16)
        self._work = np.empty_like(self._incoming)

    def keep(self, blocks: NDArray[np.bool_]) -> None:
        """Continue with some blocks of the batch."""
        total = np.ascontiguousarray(self._total[:, blocks])
        self._begin(total, [np.ascontiguousarray(message[:, :, blocks]) for message in self._messages])

    def information(self, blocks: NDArray[np.int64]) -> Bits:
        """(n, k) hard decisions of some blocks of the batch."""
        return np.asarray((self._total[: self._code.k] < 0).T[blocks], np.uint8)

    def unsatisfied(self) -> NDArray[np.float64]:
        """(batch,) share of checks that the hard decisions violate."""
        count = np.zeros(self._total.shape[1])
        for row in self._rows:
            parity = np.bitwise_xor.reduce(self._gather(row), axis=0) < 0
            count += np.count_nonzero(parity, axis=0)
        return count / (len(self._rows) * self._code.z)

    def _gather(self, places: NDArray[np.intp]) -> NDArray[np.int16]:
        return self._total.take(places, axis=0, out=self._incoming[: len(places)], mode="clip")

    def update(self) -> None:
        """Run one iteration: each row of checks in turn sends new messages to its bits."""
        for row, message in zip(self._rows, self._messages, strict=True):
            self._update_row(row, message)

    def _update_row(self, row: NDArray[np.intp], message: NDArray[np.int16]) -> None:
        incoming, work = self._gather(row), self._work[: len(row)]
        incoming -= message
        parity = np.bitwise_xor.reduce(incoming, axis=0)
        np.abs(incoming, out=work)
        smallest, second = _two_smallest(work)
        # The smallest magnitude goes to all bits except its source, which gets the second smallest. `work` becomes -1
        # where a magnitude is larger than the smallest and 0 elsewhere, then the magnitude sent, then its signed value.
        np.subtract(smallest, work, out=work)
        work >>= 15
        if_smallest = _normalised(second)
        work &= if_smallest ^ _normalised(smallest)
        work ^= if_smallest
        np.bitwise_xor(incoming, parity, out=message)
        message >>= 15
        work ^= message
        np.subtract(work, message, out=message)
        incoming += message
        self._total[row] = incoming


def _two_smallest(magnitude: NDArray[np.int16]) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
    """Smallest and second smallest value along the first axis; equal for ties."""
    smallest = np.minimum(magnitude[0], magnitude[1])
    second = np.maximum(magnitude[0], magnitude[1])
    for values in magnitude[2:]:
        np.minimum(second, np.maximum(smallest, values), out=second)
        np.minimum(smallest, values, out=smallest)
    return smallest, second


def _normalised(magnitude: NDArray[np.int16]) -> NDArray[np.int16]:
    """Three quarters of a message, within the limit."""
    limited = np.minimum(magnitude, _MAX_MESSAGE)
    return np.asarray(limited - (limited >> 2), np.int16)
