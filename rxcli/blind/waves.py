"""Light of the columns by slot position, and the slots decided from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rxcli.blind.strips import EXTREMES_SLOTS, SAMPLES, Strips, levelled
from rxcli.protocol import HEADER, SLOTS_PER_SYMBOL
from rxcli.types import BoolArray, Float32Array, FloatArray

#: Exposures that are compared, slots.
_EXPOSURES = np.array([0.15, 0.3, 0.45, 0.6, 0.8, 1.0, 1.2, 1.4, 1.7, 2.0, 2.35, 2.7, 3.1])

#: Slots over which the light of a strip may be taken as constant.
LOCAL_SLOTS = 15


@dataclass(frozen=True, slots=True)
class Grid:
    """Where slot 0 stands in its packet."""

    first_slot: int
    packet_slots: int

    def header(self, n: int) -> tuple[NDArray[np.int64], BoolArray]:
        """Slots of the headers among slots 0..n, and whether they are lit."""
        position = (np.arange(n) + self.first_slot) % self.packet_slots
        slots = np.flatnonzero(position < SLOTS_PER_SYMBOL)
        return slots, np.array(HEADER, bool)[position[slots]]


@dataclass(frozen=True, slots=True)
class Waves:
    """Light of the columns on a grid of SAMPLES samples a slot."""

    #: (C, n) float32: levelled light, and its weight.
    value: Float32Array
    weight: Float32Array


def column_waves(strips: Strips, time: Float32Array, rows_per_slot: float) -> Waves:
    """Levelled light of every column by slot position."""
    window = round(EXTREMES_SLOTS * rows_per_slot / (strips.rows[1] - strips.rows[0]))
    level, weight = levelled(strips.light, strips.inside, window, strips.sigma)
    n = (int(time.max()) + 2) * SAMPLES
    per_column = strips.light.shape[0] // strips.n_columns
    column = np.arange(strips.light.shape[0]) // per_column
    place = np.clip((time * SAMPLES).astype(np.int64), 0, n - 1) + (column * n)[:, None]
    total = np.bincount(place.ravel(), weight.ravel(), strips.n_columns * n)
    summed = np.bincount(place.ravel(), (level * weight).ravel(), strips.n_columns * n)
    value = (summed / (total + 1e-3)).reshape(strips.n_columns, n)
    return Waves(value.astype(np.float32), total.reshape(value.shape).astype(np.float32))


def _slot_values(waves: Waves) -> Float32Array:
    """(C, N) mean of every slot."""
    shape = (waves.value.shape[0], -1, SAMPLES)
    weight = waves.weight.reshape(shape)
    summed = (waves.value.reshape(shape) * weight).sum(axis=2)
    return np.asarray(summed / (weight.sum(axis=2) + np.float32(1e-3)), np.float32)


def decide(waves: Waves, exposure_slots: float, grid: Grid | None) -> BoolArray:
    """(C, N) lit slots: the nearer of the extremes, then with the neighbours' share through the exposure taken off.

    The headers of `grid` are taken as known; None where they are to be seen.
    """
    mean = _slot_values(waves)
    n = mean.shape[1]
    windows = np.pad(mean, ((0, 0), (EXTREMES_SLOTS // 2, EXTREMES_SLOTS // 2)), mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(windows, EXTREMES_SLOTS, axis=1)
    high, low = around.max(axis=2), around.min(axis=2)
    value = (2 * mean - high - low) / (high - low + np.float32(1e-3))
    header, lit_header = grid.header(n) if grid else (np.zeros(0, np.int64), np.zeros(0, bool))
    state = np.sign(value)
    state[:, header] = np.where(lit_header, 1, -1)
    taps = _slot_taps(exposure_slots)
    reach = taps.size // 2
    for sweep in range(8):
        padded = np.pad(state, ((0, 0), (reach, reach)))
        others = sum(taps[k] * padded[:, k : k + n] for k in range(taps.size) if k != reach)
        turn = slice(sweep % 2, None, 2)
        state[:, turn] = np.where(value - others >= 0, 1, -1)[:, turn]
        state[:, header] = np.where(lit_header, 1, -1)
    return np.asarray(state > 0)


def _slot_taps(exposure_slots: float) -> FloatArray:
    """Share of each slot in the mean over a slot of the light seen through the exposure, odd length."""
    fine = 40
    box = np.ones(max(round(exposure_slots * fine), 1))
    shape = np.convolve(np.convolve(box / box.size, np.ones(fine)), np.ones(fine) / fine)
    reach = int(np.ceil((exposure_slots + 1) / 2))
    lags = np.arange(-reach, reach + 1)
    centre = (shape.size - 1) / 2
    return np.asarray(np.interp(centre + lags * fine, np.arange(shape.size), shape, left=0, right=0))


def seen_through(
    lit: BoolArray, time: FloatArray | Float32Array, column: NDArray[np.int64], exposure_slots: float
) -> tuple[Float32Array, Float32Array]:
    """Light 0..1 of slots through the exposure at slot positions (n, m) of columns (n,); and its change per slot."""
    n = lit.shape[1]
    total = np.zeros((lit.shape[0], n + 2), np.float32)
    np.cumsum(lit, axis=1, out=total[:, 1 : n + 1])
    total[:, n + 1] = total[:, n]
    flat, base = total.ravel(), (column * (n + 2))[:, None]
    late, late_slope = _running(flat, base, time + np.float32(exposure_slots / 2), n)
    early, early_slope = _running(flat, base, time - np.float32(exposure_slots / 2), n)
    scale = np.float32(1 / exposure_slots)
    return (late - early) * scale, (late_slope - early_slope) * scale


def _running(
    flat: Float32Array, base: NDArray[np.int64], time: FloatArray | Float32Array, n: int
) -> tuple[Float32Array, Float32Array]:
    place: FloatArray = np.clip(np.asarray(time, np.float64), 0, n + 0.999)
    low = place.astype(np.int64)
    index = low + base
    below: Float32Array = np.asarray(flat.take(index), np.float32)
    step: Float32Array = np.asarray(flat.take(index + 1), np.float32) - below
    return np.asarray(below + step * (place - low), np.float32), step


def local_mean(values: Float32Array, window: int) -> Float32Array:
    import cv2

    return np.asarray(cv2.blur(values, (window | 1, 1)))


def estimate_exposure(waves: Waves, grid: Grid) -> tuple[float, float]:
    """Exposure in slots by the blur of the slots' edges, and its standard deviation."""
    errors = np.array([_misfit(waves, exposure, decide(waves, exposure, grid)) for exposure in _EXPOSURES])
    best = int(np.clip(errors.argmin(), 1, _EXPOSURES.size - 2))
    bend, slope, _ = np.polyfit(_EXPOSURES[best - 1 : best + 2], np.log(errors[best - 1 : best + 2]), 2)
    if bend <= 0:
        return float(_EXPOSURES[errors.argmin()]), 0.3
    found = float(np.clip(-slope / (2 * bend), _EXPOSURES[0], _EXPOSURES[-1]))
    independent = waves.value.size / SAMPLES
    return found, float(np.clip(np.sqrt(1 / (bend * independent)), 0.02, 0.5))


def _misfit(waves: Waves, exposure_slots: float, lit: BoolArray) -> float:
    """Weighted square of what the slots through this exposure leave of the waves, as a share."""
    centres = np.broadcast_to((np.arange(waves.value.shape[1]) + 0.5) / SAMPLES, waves.value.shape)
    wave, _ = seen_through(lit, centres, np.arange(lit.shape[0]), exposure_slots)
    window = LOCAL_SLOTS * SAMPLES
    weight = waves.weight
    share = local_mean(weight, window) + np.float32(1e-3)
    mean_value, mean_wave = local_mean(waves.value * weight, window) / share, local_mean(wave * weight, window) / share
    covariance = local_mean(waves.value * wave * weight, window) / share - mean_value * mean_wave
    variance = local_mean(wave * wave * weight, window) / share - mean_wave * mean_wave
    gain = np.maximum(covariance, 0) / (variance + np.float32(0.02))
    residual = waves.value - mean_value - gain * (wave - mean_wave)
    total = float((weight * (waves.value - mean_value) ** 2).sum())
    return float((weight * residual * residual).sum()) / max(total, 1e-9)
