"""The genie-aided bound: maximum likelihood per symbol with all but that symbol known.

The genie knows outline, clock, picture, room light and the other slots of the same column and of all others. What is
left of a row for column `c` is the share `m` of its exposure that the column was lit, seen by every pixel with known
gain `a` and noise variance `v`: the log-likelihood is `Q m - P m^2 / 2`, with `P = sum a^2 / v` and
`Q = sum a (e - b) / v` over the row's pixels. So two numbers per row and column hold all information of the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.lab.simulate.camera import Band, Exposure, column_light
from rxcli.lab.simulate.optics import Float32Array, FloatArray, grid_nodes
from rxcli.lab.simulate.shutter import overlaps
from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, codebook


@dataclass(frozen=True)
class Oracle:
    """Sufficient statistics of one frame's sensor values, and the truth that the genie knows."""

    exposure: Exposure
    #: (height, columns) `P`: information on the lit share of each row's exposure.
    information: FloatArray
    #: (height, columns) `Q`: matched filter output, the column's own light not taken off.
    matched: FloatArray

    def slot_statistics(self, column: int) -> tuple[int, FloatArray, Any]:
        """Statistics of a column's slots instead of its rows.

        Returns:
            Number of the first slot; (n,) matched filter of each slot; sparse (n, n) information that two slots share.
        """
        from scipy.sparse import csr_array, diags_array

        start = self.exposure.row_start_slots - self.exposure.delays[column]
        first_slot, share = overlaps(start, self.exposure.exposure_slots)
        slots = first_slot[:, None] - first_slot[0] + np.arange(share.shape[1])
        exposed = csr_array((share.ravel(), slots.ravel(), np.arange(0, share.size + 1, share.shape[1])))
        shared = exposed.T @ diags_array(self.information[:, column]) @ exposed
        return int(first_slot[0]), exposed.T @ self.matched[:, column], shared.tocsr()

    def decide(self, column: int, burst: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
        """Decide the payload symbols of one packet, each with all other slots known.

        Returns:
            (N,) decided codebook indices, (N,) sent ones, (N,) whether the symbol was observed at all.
        """
        link = self.exposure.link
        origin, matched, shared = self.slot_statistics(column)
        sent = link.slots(origin, origin + matched.size)[column].astype(np.float64)
        words = codebook(int(link.weights[column])).astype(np.float64)
        score = np.zeros((link.screen.payload_symbols, words.shape[0]))
        information = np.zeros(score.shape[0])
        copies = burst * link.burst_slots - origin + np.arange(link.screen.repeats) * link.screen.packet_slots
        starts = copies[:, None] + PREAMBLE_SLOTS + np.arange(score.shape[0]) * SLOTS_PER_SYMBOL
        for copy, symbol in np.argwhere((starts >= 0) & (starts + SLOTS_PER_SYMBOL <= matched.size)):
            inside = slice(starts[copy, symbol], starts[copy, symbol] + SLOTS_PER_SYMBOL)
            own = shared[inside, inside].toarray()
            expected = shared[inside] @ sent - own @ sent[inside]
            score[symbol] += words @ (matched[inside] - expected) - 0.5 * np.einsum("ki,ij,kj->k", words, own, words)
            information[symbol] += np.trace(own)
        truth = link.packets(burst)[column, PREAMBLE_SLOTS:].reshape(-1, SLOTS_PER_SYMBOL)
        sent_index = np.argmax(words @ truth.T, axis=0)
        return np.argmax(score, axis=1), sent_index, information > 0


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
