"""What the rows of a picture show of slots that are known.

A sensor row sees its slots through the shutter, at its own instant. What a picture's row holds is a mix of sensor rows:
demosaicing and noise reduction take in the neighbours, sharpening takes them off again, and the correction of a
distortion interpolates between two. With two rows a slot that mix is no function of the time of the picture's row: an
edge between two sensor rows lies where the two meet, wherever it was. So light is worked out for sensor rows and mixed
as the picture mixes them, by a symmetric kernel that is fitted to all of the picture's light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.strips import Strips
from rxcli.receiver.camera.waves import Surroundings, column_shares, residual_of
from rxcli.receiver.light import SlotLight
from rxcli.types import Float32Array, FloatArray, IntArray

#: Weights of a row, of its two neighbours together, and of the two next to those: of developed pictures in general, and
#: how far they differ.
_KERNEL = np.array([0.75, 0.4, -0.15])


@dataclass(frozen=True, slots=True)
class RowModel:
    """How slots become the light of a picture's rows."""

    #: Slots that a sensor row integrates.
    shutter_slots: float
    #: (3,) weights of a sensor row, of its neighbours, and of those next to them; their sum is 1.
    kernel: FloatArray

    def observed(
        self, strips: Strips, time: Float32Array, values: FloatArray, lit: Float32Array
    ) -> tuple[Float32Array, Float32Array]:
        """(M, R) light 0..1 of every strip's rows, and its change per slot of time.

        Args:
            strips: in readout order.
            time: (M, R) slot positions of the strips' rows.
            values: start and rows per slot of the clock, and more.
            lit: (C, N) probability that each slot is lit.
        """
        rows = _SensorRows.of(strips, time, values)
        light, slope = (
            rows.read(_mixed(table, self.kernel)) for table in rows.seen(strips, values, lit, self.shutter_slots)
        )
        return light, slope


def fit_rows(
    strips: Strips,
    time: Float32Array,
    values: FloatArray,
    lit: Float32Array,
    exposure_slots: float,
    window: int,
    shutter_slots: float = 0.0,
) -> RowModel:
    """The shutter and the mix of rows that explain the light best.

    Args:
        strips: in readout order.
        time: (M, R) slot positions of the strips' rows.
        values: start and rows per slot of the clock, and more.
        lit: (C, N) probability that each slot is lit.
        exposure_slots: exposure as it is seen, all blur taken for exposure.
        window: rows over which the picture may be taken as constant.
        shutter_slots: exposure that the file tells, 0 where it does not.
    """
    tried = (shutter_slots,) if shutter_slots else [share * exposure_slots for share in SETTINGS.shutter_shares]
    rows, fits = _SensorRows.of(strips, time, values), []
    around = Surroundings.of(strips.light, strips.inside, window)
    for shutter in tried:
        table, _ = rows.seen(strips, values, lit, shutter)
        light = np.stack([rows.read(_mixed(table, part)) for part in np.eye(_KERNEL.size)])
        kernel = _KERNEL
        for _ in range(SETTINGS.kernel_rounds):
            kernel, misfit = _fit_kernel(strips, around, light, kernel)
        fits.append((misfit, RowModel(shutter, kernel)))
    return min(fits, key=lambda fit: fit[0])[1]


@dataclass(frozen=True, slots=True)
class _SensorRows:
    """Where every strip's rows lie among successive sensor rows."""

    #: Number of the first of the sensor rows, and how many there are; so many rows were averaged to one of a strip.
    first: int
    n: int
    join: int
    #: (M, R) sensor row below, counted through a table (M, n), and how far above it.
    low: IntArray
    fraction: Float32Array

    @staticmethod
    def of(strips: Strips, time: Float32Array, values: FloatArray) -> _SensorRows:
        """The sensor rows of strips whose rows stand at slot positions (M, R) of a clock."""
        start, rows_per_slot = values[:2]
        join = max(round(float(strips.rows[1] - strips.rows[0])), 1)
        place: FloatArray = time.astype(np.float64) * rows_per_slot + start - (join - 1) / 2
        reach = _KERNEL.size - 1
        first = int(np.floor(place.min())) - reach
        n = int(np.ceil(place.max())) + 2 + reach - first
        place -= first
        low: IntArray = place.astype(np.int64)
        fraction = (place - low).astype(np.float32)
        low += (np.arange(low.shape[0]) * n)[:, None]
        return _SensorRows(first, n, join, low, fraction)

    def seen(
        self, strips: Strips, values: FloatArray, lit: Float32Array, shutter_slots: float
    ) -> tuple[Float32Array, Float32Array]:
        """(M, n) light of the sensor rows in every strip; and its change per slot."""
        start, rows_per_slot = values[:2]
        time = (self.first + np.arange(self.n + self.join - 1) - start) / rows_per_slot
        tables = SlotLight(lit, 0.0).seen_with_slope(time[None], shutter_slots)
        shares = column_shares(strips).astype(np.float32)
        light, slope = (shares @ _joined(table, self.join) for table in tables)
        return light, slope

    def read(self, table: Float32Array) -> Float32Array:
        """(M, R) values of a table (M, n) between two sensor rows."""
        flat = table.ravel()
        below = flat.take(self.low)
        return np.asarray(below + (flat.take(self.low + 1) - below) * self.fraction, np.float32)


def _joined(table: Float32Array, join: int) -> Float32Array:
    """Means of `join` rows from every row on, as the strips' rows were joined."""
    n = table.shape[1] - join + 1
    return np.asarray(sum(table[:, k : k + n] for k in range(join)), np.float32) / np.float32(join)


def _mixed(table: Float32Array, kernel: FloatArray) -> Float32Array:
    """(M, n) every row of a table mixed with the rows on either side."""
    weights = kernel.astype(np.float32)
    out = weights[0] * table
    for reach, weight in enumerate(weights[1:], 1):
        if weight:
            padded = np.pad(table, ((0, 0), (reach, reach)), mode="edge")
            out += (weight / 2) * (padded[:, : -2 * reach] + padded[:, 2 * reach :])
    return np.asarray(out, np.float32)


def _fit_kernel(
    strips: Strips, around: Surroundings, parts: Float32Array, kernel: FloatArray
) -> tuple[FloatArray, float]:
    """The kernel by least squares, with gains and levels of another one; and the share of the light that it leaves."""
    wave = np.tensordot(kernel.astype(np.float32), parts, 1)
    near = around.moments(wave)
    _, spread = residual_of(strips, near, near.gain, wave, around.window)
    weight = strips.inside / np.sqrt(spread)
    basis = np.stack([((part - around.mean_of(part)) * near.gain * weight).ravel() for part in parts])
    target = ((strips.light - near.value) * weight).ravel()
    information, pull = (basis @ basis.T).astype(np.float64), (basis @ target).astype(np.float64)
    prior = SETTINGS.samples_as_one / SETTINGS.kernel_sd**2
    found = np.linalg.solve(information + prior * np.eye(kernel.size), pull + prior * _KERNEL)
    power = float(target @ target)
    misfit = (power - 2 * found @ pull + found @ information @ found) / max(power, 1e-9)
    return found / max(found.sum(), 0.2), float(misfit)
