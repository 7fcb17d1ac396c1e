"""The genie-aided bound: maximum likelihood per symbol with all but that symbol known.

The genie knows outline, clock, picture, room light and the other slots of the same column and of all others. What is
left of a row for column `c` is the share `m` of its exposure that the column was lit, seen by every pixel with known
gain `a` and noise variance `v`: the log-likelihood is `Q m - P m^2 / 2`, with `P = sum a^2 / v` and
`Q = sum a (e - b) / v` over the row's pixels. So two numbers per row and column hold all information of the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rxcli.lab.simulate.camera import Band, Exposure, column_light
from rxcli.lab.simulate.optics import grid_nodes
from rxcli.lab.simulate.shutter import overlaps
from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, codebook

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]


@dataclass(frozen=True)
class Oracle:
    """Sufficient statistics of one frame's sensor values, and the truth that the genie knows."""

    exposure: Exposure
    #: (height, columns) `P`: information on the lit share of each row's exposure.
    information: FloatArray
    #: (height, columns) `Q`: matched filter output, the column's own light not taken off.
    matched: FloatArray

    def slot_statistics(self, column: int) -> tuple[int, FloatArray, FloatArray]:
        """Statistics of a column's slots instead of its rows.

        Returns:
            Number of the first slot; (n,) matched filter of each slot; (n, taps) information shared by slot `s` and
            slot `s + tap`.
        """
        exposure = self.exposure
        start = exposure.row_start_slots - exposure.delays[column]
        first, share = overlaps(start, exposure.exposure_slots)
        origin, taps = int(first[0]), share.shape[1]
        n = int(first[-1]) - origin + taps
        matched, shared = np.zeros(n + taps), np.zeros((n + taps, taps))
        p, q = self.information[:, column], self.matched[:, column]
        for i in range(taps):
            np.add.at(matched, first - origin + i, q * share[:, i])
            for j in range(i, taps):
                np.add.at(shared[:, j - i], first - origin + i, p * share[:, i] * share[:, j])
        return origin, matched[:n], shared[:n]

    def decide(self, column: int, burst: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
        """Decide the payload symbols of one packet, each with all other slots known.

        Returns:
            (N,) decided codebook indices, (N,) sent ones, (N,) whether the symbol was seen at all.
        """
        link = self.exposure.link
        origin, matched, shared = self.slot_statistics(column)
        sent = link.slots(origin, origin + matched.size)[column].astype(np.float64)
        words = codebook(int(link.weights[column])).astype(np.float64)
        score = np.zeros((link.screen.payload_symbols, words.shape[0]))
        seen = np.zeros(score.shape[0])
        for symbol, at in self._occurrences(burst, origin, matched.size):
            inside = slice(at, at + SLOTS_PER_SYMBOL)
            own = _band_matrix(shared, at)
            others = _expected(shared, sent, at) - own @ sent[inside]
            score[symbol] += words @ (matched[inside] - others) - 0.5 * np.einsum("ki,ij,kj->k", words, own, words)
            seen[symbol] += np.trace(own)
        truth = link.packets(burst)[column, PREAMBLE_SLOTS:].reshape(-1, SLOTS_PER_SYMBOL)
        sent_index = np.argmax(words @ truth.T, axis=0)
        return np.argmax(score, axis=1), sent_index, seen > 0

    def _occurrences(self, burst: int, origin: int, n: int) -> list[tuple[int, int]]:
        """Symbol number and place of every payload symbol of `burst` whose slots all lie in the frame's window."""
        screen = self.exposure.link.screen
        found = []
        for copy in range(screen.repeats):
            packet = burst * self.exposure.link.burst_slots + copy * screen.packet_slots - origin
            for symbol in range(screen.payload_symbols):
                at = packet + PREAMBLE_SLOTS + symbol * SLOTS_PER_SYMBOL
                if at >= 0 and at + SLOTS_PER_SYMBOL <= n:
                    found.append((symbol, at))
        return found


def _band_matrix(shared: FloatArray, at: int) -> FloatArray:
    """(10, 10) information among the slots of one symbol, from the banded store."""
    matrix = np.zeros((SLOTS_PER_SYMBOL, SLOTS_PER_SYMBOL))
    for tap in range(min(shared.shape[1], SLOTS_PER_SYMBOL)):
        values = shared[at : at + SLOTS_PER_SYMBOL - tap, tap]
        rows = np.arange(values.size)
        matrix[rows, rows + tap] = matrix[rows + tap, rows] = values
    return matrix


def _expected(shared: FloatArray, sent: FloatArray, at: int) -> FloatArray:
    """(10,) matched filter output that the sent slots alone would give in one symbol's slots."""
    total = np.zeros(SLOTS_PER_SYMBOL)
    for i in range(SLOTS_PER_SYMBOL):
        slot = at + i
        for tap in range(shared.shape[1]):
            if slot + tap < sent.size:
                total[i] += shared[slot, tap] * sent[slot + tap]
            if tap and slot - tap >= 0:
                total[i] += shared[slot - tap, tap] * sent[slot - tap]
    return total


class OracleRecorder:
    """Gathers an `Oracle` while bands are read out."""

    def __init__(self, exposure: Exposure) -> None:
        shape = (exposure.scene.sensor.height, exposure.link.screen.columns)
        self._exposure = exposure
        self._information, self._noise = np.zeros(shape), np.zeros(shape)

    def visit(self, band: Band, electrons: Float32Array) -> None:
        """Take in one band of expected and read electrons."""
        sensor, pitch = self._exposure.scene.sensor, self._exposure.grid_pitch
        mean = band.mean_e
        variance = mean + np.float32(sensor.read_noise_e**2) + (np.float32(sensor.prnu) * mean) ** 2
        gain2 = _cells(band.picture**2 / variance, pitch)
        gain_noise = _cells(band.picture * (electrons - mean) / variance, pitch)
        x = grid_nodes(sensor.width, pitch)[1:-1]
        step = self._exposure.grid_rows
        # The columns' light hardly changes over a cell of the grid: its value in the middle stands for all its rows.
        middles = band.top + np.arange(0, mean.shape[0], step, dtype=np.float64) + (step - 1) / 2
        light = column_light(self._exposure, x, middles).astype(np.float64)
        for number, own in enumerate(light):
            part = slice(number * step, min((number + 1) * step, mean.shape[0]))
            rows = slice(band.top + part.start, band.top + part.stop)
            self._information[rows] = gain2[part] @ (own**2).T
            self._noise[rows] = gain_noise[part] @ own.T

    def finish(self) -> Oracle:
        """The oracle of the frame that was visited."""
        matched = self._noise + self._information * self._exposure.lit
        return Oracle(self._exposure, self._information, matched)


def _cells(values: NDArray[np.floating], pitch: int) -> FloatArray:
    """Sums over cells of `pitch` pixels across (and over colours); (rows, cells)."""
    flat = values if values.ndim == 2 else values.sum(axis=2)
    missing = -flat.shape[1] % pitch
    padded = np.pad(flat, ((0, 0), (0, missing))).astype(np.float64)
    return np.asarray(padded.reshape(flat.shape[0], -1, pitch).sum(axis=2))
