"""Detect flickering light without data: lamps, and screens dimmed by switching.

A periodic waveform with a period far below a packet's has few free parameters. If it explains the light better than the
decided slots, the slots are no evidence of packets. Headers and dimming symbols break every such period, so packets
whose payload repeats one symbol are not refused.

Columns are independent transmitters. If all of them show the same light, it comes from one lamp, and their evidence
counts once.
"""

import numpy as np

from rxcli.numerics import TINY
from rxcli.receiver.decode.settings import SETTINGS
from rxcli.types import BoolArray, Float32Array, FloatArray

#: Oversampling of spectra, relative to the resolution of the light's length.
_OVERSAMPLING = 4


def is_steady(value: Float32Array, weight: Float32Array, lit: Float32Array, packet_slots: int) -> bool:
    """Whether light is a steady periodic waveform rather than packets.

    Args:
        value: (C, N * Q) light of every column between its extremes, Q samples a slot.
        weight: (C, N * Q) its weight; 0 where nothing is visible.
        lit: (C, N) decided slots, 0..1.
        packet_slots: slots of a packet.
    """
    samples_per_slot = value.shape[1] // lit.shape[1]
    observed = weight > 0
    level = (value - _mean(value, observed)) * observed
    if not level.any():
        return False
    # A period of more than half of what is visible explains anything.
    n_visible = int(np.count_nonzero(observed.any(axis=0)))
    steady = periodic_share(level, min(packet_slots * samples_per_slot, n_visible))
    return steady > SETTINGS.min_periodic_share and steady > _share_of_slots(level, observed, lit, samples_per_slot)


def is_common_light(value: Float32Array, weight: Float32Array, shared: float, reach: int = 0) -> bool:
    """Whether columns half a screen apart show the same light.

    Args:
        value, weight: see `is_steady`.
        shared: share of the light that all columns have in common, i.e. that of the headers.
        reach: largest shift between columns, samples.
    """
    n_columns, n = value.shape
    if n_columns < SETTINGS.min_compared_columns:
        return False
    half = n_columns // 2
    observed = weight > 0
    level = (value - _mean(value, observed)) * observed
    level = level / np.maximum(np.sqrt(np.square(level).sum(axis=1, keepdims=True)), TINY)
    spectrum = np.fft.rfft(level, n + reach, axis=1)
    moved = np.fft.irfft(spectrum[:half] * np.conj(spectrum[-half:]), n + reach, axis=1)
    similarity = np.concatenate([moved[:, : reach + 1], moved[:, moved.shape[1] - reach :]], axis=1).max(axis=1)
    return bool(np.median(similarity) > shared + (1 - shared) * SETTINGS.min_similarity)


def _mean(value: Float32Array, observed: BoolArray) -> FloatArray:
    return np.asarray((value * observed).sum(axis=1, keepdims=True) / np.maximum(observed.sum(1, keepdims=True), 1))


def periodic_share(level: FloatArray | Float32Array, packet_samples: int) -> float:
    """Share of the variance of columns (C, n) that one period explains; each column has its own waveform."""
    n = level.shape[1]
    size = 1 << int(np.ceil(np.log2(_OVERSAMPLING * n)))
    power = (np.abs(np.fft.rfft(level, size, axis=1)) ** 2).sum(axis=0) * (2 / (n * float((level**2).sum())))
    # A line may lie between two grid frequencies.
    near = np.maximum(power, np.maximum(np.roll(power, 1), np.roll(power, -1)))
    fundamental = np.arange(int(np.ceil(size / (SETTINGS.max_period_packets * packet_samples))), size // 2)
    share = np.zeros(fundamental.size)
    for line in range(1, SETTINGS.n_harmonics + 1):
        inside = line * fundamental <= size // 2
        share[inside] += near[line * fundamental[inside]]
    return float(share.max(initial=0.0))


def _share_of_slots(level: FloatArray, observed: BoolArray, lit: Float32Array, samples_per_slot: int) -> float:
    """Share of the variance that the decided slots explain; each column has its own exposure response."""
    slots = np.repeat(lit, samples_per_slot, axis=1)
    reach = SETTINGS.max_shift_slots * samples_per_slot
    left = 0.0
    for light, shown, column in zip(level, observed, slots, strict=True):
        moved = np.stack([np.ones(column.size), *(np.roll(column, s) for s in range(-reach, reach + 1))], axis=1)[shown]
        fit, *_ = np.linalg.lstsq(moved, light[shown], rcond=None)
        left += float(((light[shown] - moved @ fit) ** 2).sum())
    return 1 - left / float((level**2).sum())
