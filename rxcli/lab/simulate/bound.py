"""The genie-aided bound: maximum likelihood per symbol with all but that symbol known.

The genie knows outline, clock, picture, room light and the other slots of the same column and of all others. What is
left of a row for column `c` is the share `m` of its exposure that the column was lit, seen by every pixel with known
gain `a` and noise variance `v`: the log-likelihood is `Q m - P m^2 / 2`, with `P = sum a^2 / v` and
`Q = sum a (e - b) / v` over the row's pixels. So two numbers per row and column hold all information of the sensor.
Where a part of the red light lags, it has a share and a gain of its own: `m` and `Q` are pairs, `P` is a matrix.
"""

import numpy as np
from numpy.typing import NDArray

from rxcli.lab.simulate.camera import DECAY_TIMES, Band, Exposure, column_light
from rxcli.lab.simulate.optics import Float32Array, FloatArray, grid_nodes
from rxcli.lab.simulate.shutter import slot_shares
from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, codebook


class Oracle:
    """Sufficient statistics of one frame's sensor values, gathered as its bands are read, and what the genie knows.

    Args:
        exposure: the truth.
    """

    def __init__(self, exposure: Exposure) -> None:
        shape = (len(exposure.decays), exposure.scene.sensor.height, exposure.link.screen.columns)
        self.exposure = exposure
        #: (kinds, kinds, height, columns) `P`: information on the lit share of each row's exposure, by kind of light.
        self.information: FloatArray = np.zeros((shape[0], *shape))
        #: (kinds, height, columns) `Q` of the noise alone: all light taken off.
        self.noise: FloatArray = np.zeros(shape)

    def about_slots(self, column: int, start_slot: int) -> tuple[FloatArray, FloatArray]:
        """What the sensor holds about the ten slots of a symbol that begins at slot `start_slot`.

        Returns:
            (10,) matched filter of the noise; (10, 10) information that two slots share.
        """
        exposure, slots = self.exposure, start_slot + np.arange(SLOTS_PER_SYMBOL, dtype=np.float64)
        start = exposure.row_start_slots - exposure.delays[column]
        end_slot = start_slot + SLOTS_PER_SYMBOL + DECAY_TIMES * exposure.decays[-1]
        rows = slice(*np.searchsorted(start, [start_slot - exposure.exposure_slots, end_slot]))
        shares = [slot_shares(start[rows], exposure.exposure_slots, slots, decay) for decay in exposure.decays]
        noise, information = self.noise[:, rows, column], self.information[:, :, rows, column]
        matched = np.einsum("irs,ir->s", shares, noise)
        return matched, np.einsum("irs,ijr,jrt->st", shares, information, shares, optimize=True)

    def decide(self, column: int, burst: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
        """Decide the payload symbols of one packet, each with all other slots known.

        Returns:
            (N,) decided codebook indices, (N,) sent ones, (N,) whether the symbol was observed at all.
        """
        exposure, link = self.exposure, self.exposure.link
        words = codebook(int(link.weights[column])).astype(np.float64)
        sent = link.packets(burst)[column, PREAMBLE_SLOTS:].reshape(-1, SLOTS_PER_SYMBOL).astype(np.float64)
        score, information = np.zeros((len(sent), len(words))), np.zeros(len(sent))
        begin, end = exposure.row_start_slots[[0, -1]] - exposure.delays[column]
        copies = burst * link.burst_slots + np.arange(link.screen.repeats) * link.screen.packet_slots
        starts = copies[:, None] + PREAMBLE_SLOTS + np.arange(len(sent)) * SLOTS_PER_SYMBOL
        whole = (starts >= np.floor(begin)) & (starts + SLOTS_PER_SYMBOL <= np.ceil(end + exposure.exposure_slots))
        for copy, symbol in np.argwhere(whole):
            matched, own = self.about_slots(column, int(starts[copy, symbol]))
            # `matched` is of the noise alone: the light of the symbol that was sent is added, all other light is known.
            score[symbol] += words @ (matched + own @ sent[symbol]) - 0.5 * np.einsum("ki,ij,kj->k", words, own, words)
            information[symbol] += np.trace(own)
        return np.argmax(score, axis=1), np.argmax(words @ sent.T, axis=0), information > 0

    def visit(self, band: Band, electrons: Float32Array) -> None:
        """Take in one band of expected and read electrons."""
        sensor, pitch = self.exposure.scene.sensor, self.exposure.grid_pitch
        mean = band.mean_e
        variance = mean + np.float32(sensor.read_noise_e**2) + (np.float32(sensor.prnu) * mean) ** 2
        noise = electrons - mean
        if sensor.row_noise_e:
            # Hundreds of pixels of other columns give away the noise that all pixels of a row share.
            across = tuple(range(1, noise.ndim))
            whole = (noise / variance).sum(across) / ((1 / variance).sum(across) + 1 / sensor.row_noise_e**2)
            noise -= whole.reshape(-1, *(1,) * len(across))
        gain_noise = np.stack([_cells(a * noise / variance, pitch) for a in band.pictures])
        gain2 = np.stack([[_cells(a * b / variance, pitch) for b in band.pictures] for a in band.pictures])
        x = grid_nodes(sensor.width, pitch)[1:-1]
        step = self.exposure.grid_rows
        # The columns' light hardly changes over a cell of the grid: its value in the middle stands for all its rows.
        middles = band.top + np.arange(0, mean.shape[0], step, dtype=np.float64) + (step - 1) / 2
        light = column_light(self.exposure, x, middles, self.exposure.drive).astype(np.float64)
        for number, own in enumerate(light):
            part = slice(number * step, min((number + 1) * step, mean.shape[0]))
            rows = slice(band.top + part.start, band.top + part.stop)
            self.information[:, :, rows] = gain2[:, :, part] @ (own**2).T
            self.noise[:, rows] = gain_noise[:, part] @ own.T


def _cells(values: NDArray[np.floating], pitch: int) -> FloatArray:
    """Sums over cells of `pitch` pixels across (and over colours); (rows, cells)."""
    flat = values if values.ndim == 2 else values.sum(axis=2)
    return np.asarray(np.add.reduceat(flat.astype(np.float64), np.arange(0, flat.shape[1], pitch), axis=1))
