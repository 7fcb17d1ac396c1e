"""Quasi-cyclic LDPC codes of 3GPP TS 38.212, section 5.3.2: encoder and layered min-sum decoder.

A code of `k` information bits has base graph 1 or 2 lifted by `z`. Block column c, lane i is coded bit c * z + i; the
first 2 z bits are never sent and filler bits are known zeros; all others, in order, are the *buffer*.
"""

from collections.abc import Callable
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


class Code:
    """A code for `k` information bits.

    Args:
        graph: base graph, 1 or 2.
        k: information bits.

    Raises:
        ValueError: `k` is too large for the lifting sizes.
    """

    def __init__(self, graph: int, k: int) -> None:
        kb = _INFORMATION_COLUMNS[graph]
        if not 0 < k <= kb * _MAX_LIFTING:
            raise ValueError(f"k must be in 1..{kb * _MAX_LIFTING} for graph {graph} (got {k})")
        sizes = (
            (a << i, number) for number, a in enumerate(_LIFTING_BASES) for i in range(8) if a << i <= _MAX_LIFTING
        )
        self.k = k
        self.z, lifting_set = min((z, number) for z, number in sizes if kb * z >= k)
        #: Block columns of information and filler bits, and known zeros after the information bits.
        self.information_columns, self.filler = kb, kb * self.z - k
        #: First information bit that is sent; the buffer begins with it.
        self.first_sent = _PUNCTURED * self.z
        table = _base_graph(graph)
        #: Each row of checks: block column and shift of its edges.
        self.rows: list[list[Edge]] = [[] for _ in range(int(table[:, 0].max()) + 1)]
        for row, column, *shifts in table.tolist():
            self.rows[row].append((column, shifts[lifting_set] % self.z))
        self.n_columns = kb + len(self.rows)
        #: Bits that may be sent.
        self.buffer_bits = (self.n_columns - _PUNCTURED) * self.z - self.filler

    def rows_for(self, buffer_bits: int) -> int:
        """Rows that involve the first `buffer_bits` bits of the buffer."""
        last = self.first_sent + buffer_bits + self.filler
        return min(len(self.rows), max(_CORE_ROWS, -(-last // self.z) - self.information_columns))


nr_code = cache(Code)


@cache
def _base_graph(graph: int) -> NDArray[np.int64]:
    path = Path(__file__).with_name(f"nr_base_graph_{graph}.csv")
    return np.loadtxt(path, np.int64, delimiter=",", skiprows=1)


def encode(code: Code, information: Bits) -> Bits:
    """Encode blocks to the buffers of their codewords.

    Args:
        code: the code.
        information: (batch, k) uint8 of 0/1.

    Returns:
        (batch, code.buffer_bits) uint8.
    """
    batch, kb, core = information.shape[0], code.information_columns, code.rows[:_CORE_ROWS]
    coded = np.zeros((batch, code.n_columns, code.z), np.uint8)
    coded[:, :kb] = np.pad(information, ((0, 0), (0, code.filler))).reshape(batch, kb, code.z)
    # The sum of the four core rows contains only one shift of the first parity column and no other parity.
    shifts = [shift for row in core for column, shift in row if column == kb]
    (left,) = {shift for shift in shifts if shifts.count(shift) % 2}
    coded[:, kb] = np.roll(_sum(coded, [edge for row in core for edge in row if edge[0] < kb]), left, axis=1)
    # Each further row gives the next parity column, without shift.
    for column, row in enumerate(code.rows[: _CORE_ROWS - 1] + code.rows[_CORE_ROWS:], kb + 1):
        coded[:, column] = _sum(coded, [edge for edge in row if edge[0] != column])
    flat = coded.reshape(batch, -1)
    return np.concatenate([flat[:, code.first_sent : code.k], flat[:, kb * code.z :]], axis=1)


def _sum(coded: Bits, edges: list[Edge]) -> Bits:
    """(batch, z) sum over some edges of a row, modulo 2."""
    rolled = [np.roll(coded[:, column], -shift, axis=1) for column, shift in edges]
    return np.asarray(np.bitwise_xor.reduce(rolled))


#: Acceptance test of hard decisions: place in the batch, information bits (k,) -> whether they are right.
Accept = Callable[[int, Bits], bool]


def quantised(llr: NDArray[np.floating]) -> NDArray[np.int8]:
    """Quantise log-likelihood ratios to steps of `LLR_STEP`."""
    return np.asarray(np.clip(np.rint(llr / LLR_STEP), -_MAX_INPUT, _MAX_INPUT), np.int8)


#: Iterations after which a block whose checks do not agree with what was observed is given up: where most bits were
#: observed, and elsewhere; what most are, and from which log-likelihood ratio a bit counts as observed, steps.
_PATIENCE, _MOST, _OBSERVED = (2, 4), 0.65, 16
#: Least agreement, standard deviations; arbitrary bits reach it one time in ten.
_MIN_AGREEMENT, _MAX_PULL = 3.0, 80


def decode(
    code: Code,
    buffer_llr: NDArray[np.int8],
    accept: Accept,
    max_iterations: int = 25,
    unsent_llr: NDArray[np.int8] | None = None,
) -> NDArray[np.bool_]:
    """Decode a batch of blocks by layered normalised min-sum in 16-bit numbers, until `accept` accepts them.

    Parity is no stopping rule, because bits without observation need not satisfy it.

    Args:
        code: the code.
        buffer_llr: (batch, M) int8: ln p(1)/p(0) in steps of `LLR_STEP` of the first M bits of the buffer, 0 unknown.
        accept: called after every iteration but the first with the hard decisions of each block.
        max_iterations: maximum number of iterations; a block that agrees with no checks is given up earlier.
        unsent_llr: (batch, first_sent) likewise of the bits that are never sent, if anything is known of them.

    Returns:
        (batch,) which blocks were accepted.
    """
    batch, n_bits = buffer_llr.shape
    n_rows, z = code.rows_for(n_bits), code.z
    # ln p(0)/p(1) by bit and block; filler bits are known to be zero.
    total = np.zeros(((code.information_columns + n_rows) * z, batch), np.int16)
    total[np.r_[code.first_sent : code.k, code.information_columns * z : len(total)][:n_bits]] = -buffer_llr.T
    total[code.k : code.information_columns * z] = _KNOWN
    if unsent_llr is not None:
        total[: code.first_sent] = -unsent_llr.T
    layers, places, accepted = _Layers(code, n_rows, total), np.arange(batch), np.zeros(batch, bool)
    patience = np.where((np.abs(buffer_llr) > _OBSERVED).mean(axis=1) > _MOST, *_PATIENCE)
    layers.update()
    for iteration in range(2, max_iterations + 1):
        layers.update()
        good = [accept(*block) for block in zip(places.tolist(), layers.information(), strict=True)]
        accepted[places[good]] = True
        still = ~accepted[places]
        if iteration in _PATIENCE:
            still &= (patience[places] != iteration) | (layers.agreement() > _MIN_AGREEMENT)
        if not still.any():
            break
        if not still.all():
            layers.keep(still)
            places = places[still]
    return accepted


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
        messages = [np.zeros((*row.shape, total.shape[1]), np.int16) for row in self._rows]
        self._begin(total, total.copy(), messages)

    def _begin(self, total: NDArray[np.int16], observed: NDArray[np.int16], messages: list[NDArray[np.int16]]) -> None:
        self._total, self._observed, self._messages = total, observed, messages
        # Allocating arrays of this size costs more than the computation.
        degree = max(len(row) for row in self._rows)
        self._incoming = np.empty((degree, self._code.z, total.shape[1]), np.int16)
        self._work = np.empty_like(self._incoming)

    def keep(self, blocks: NDArray[np.bool_]) -> None:
        """Continue with some blocks of the batch."""
        total, observed = (np.ascontiguousarray(values[:, blocks]) for values in (self._total, self._observed))
        self._begin(total, observed, [np.ascontiguousarray(message[:, :, blocks]) for message in self._messages])

    def information(self) -> Bits:
        """(batch, k) hard decisions."""
        return np.asarray((self._total[: self._code.k] < 0).T, np.uint8)

    def agreement(self) -> NDArray[np.float64]:
        """(batch,) agreement of the observed bits with what their checks infer, standard deviations of chance."""
        pull = np.clip(self._total - self._observed, -_MAX_PULL, _MAX_PULL).astype(np.float32)
        pull *= np.sign(self._observed) * (self._observed < _KNOWN)
        return np.asarray(pull.sum(axis=0) / (np.linalg.norm(pull, axis=0) + 1e-6), np.float64)

    def update(self) -> None:
        """Run one iteration: each row of checks in turn sends new messages to its bits."""
        for row, message in zip(self._rows, self._messages, strict=True):
            incoming, work = self._incoming[: len(row)], self._work[: len(row)]
            self._total.take(row, axis=0, out=incoming, mode="clip")
            incoming -= message
            parity = np.bitwise_xor.reduce(incoming, axis=0)
            np.abs(incoming, out=work)
            smallest, second = _two_smallest(work)
            # The smallest magnitude goes to all bits except its source, which gets the second smallest. `work` becomes
            # -1 where a magnitude is larger than the smallest and 0 elsewhere, then the magnitude sent, then signed.
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
