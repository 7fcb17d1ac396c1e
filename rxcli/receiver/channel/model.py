"""What is the same all over a frame: exposure, light spread, floor and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.numerics import exposure_shares
from rxcli.types import Clock, FloatArray, SlotSamples

#: Positions in the packet of the header's middle dark slot, where only the floor is seen.
_DARK_FROM, _DARK_TO = 5.9, 7.1
#: Light over the floor up to which a sample counts as dark.
_DARK_MARGIN = 0.002


@dataclass(frozen=True, slots=True)
class LightModel:
    """What is the same all over the frame."""

    #: Light of a dark slot: room light, sensor floor.
    black_level: float
    #: Standard deviation of a sample of no light.
    sigma: float
    #: Variance of a sample per unit of light.
    shot_gain: float
    #: (S, 3) share of the light of the columns to the left, of the column itself and to the right, in each strip.
    crosstalk: FloatArray
    #: (Q, memory + 1) weight of the slots n - memory .. n in sample q of metric n.
    taps: FloatArray

    @property
    def isi_memory(self) -> int:
        """Slots before a metric's own that it depends on."""
        return int(self.taps.shape[1]) - 1


def isi_memory_for(exposure_slots: float) -> int:
    """Slots of memory that cover an exposure; odd, so that metrics sit between samples."""
    return 1 if exposure_slots <= 1.3 else 3 if exposure_slots <= 2.6 else 5


def exposure_taps(exposure_slots: float, blur_slots: float, isi_memory: int, samples_per_slot: int) -> FloatArray:
    """Weight of each slot in the samples of a metric, (Q, memory + 1).

    Sample q of metric n has its exposure's centre at n - memory/2 + (q + 1/2) / Q. A slot is seen through a box of the
    exposure and one of `blur_slots` (a row, and the sample's own length).

    Args:
        exposure_slots: exposure in slots.
        blur_slots: width of the further box.
        memory: slots of memory.
        samples_per_slot: samples a slot, Q.
    """
    n_fine = 32
    offsets = ((np.arange(n_fine) + 0.5) / n_fine - 0.5) * max(blur_slots, 1e-3)
    centres = -isi_memory / 2 + (np.arange(samples_per_slot) + 0.5) / samples_per_slot
    slots = np.arange(-isi_memory, 1)
    fine = (centres[:, None] + offsets)[:, None, :]
    return np.asarray(exposure_shares(fine, slots[:, None], max(exposure_slots, 1e-3)).mean(axis=2))


def crosstalk_matrix(n_strips: int, light_spread: float) -> FloatArray:
    """(S, 3) shares of columns -1, 0, +1 in the light of each strip, for a Gaussian of sigma `light_spread` pitches.

    Shares, because the picture takes up any common factor; so a spread of 0 is no crosstalk, not no light.
    """
    fine = 16
    across = (np.arange(n_strips * fine) + 0.5) / (n_strips * fine) - 0.5
    distance = across[:, None] - np.arange(-1, 2)
    exponent = (-(distance**2) / (2 * max(light_spread, 1e-3) ** 2)).reshape(n_strips, -1, 3)
    # A strip sees the mean over its width: one that is a whole column has twice the crosstalk of the column's middle.
    weight = np.exp(exponent - exponent.max(axis=(1, 2), keepdims=True)).mean(axis=1)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))


def estimate_black_level(samples: SlotSamples, clock: Clock) -> float:
    """Light of a dark slot: the median of what is seen in the middle of the headers' three dark slots."""
    q = samples.samples_per_slot
    position = (np.arange(samples.light.shape[-1]) / q + clock.first_slot) % clock.packet_slots
    dark = (position >= _DARK_FROM) & (position < _DARK_TO)
    observed = samples.light[..., dark][samples.valid[..., dark] > 0]
    return float(np.median(observed)) if observed.size else 0.0


def estimate_sigma(samples: SlotSamples, black_level: float, least: float) -> float:
    """Noise of a dark sample, from second differences where it is dark; at least `least`."""
    light = samples.light
    mean = (light[..., 2:] + light[..., 1:-1] + light[..., :-2]) / 3
    dark = (mean < black_level + _DARK_MARGIN) & (samples.valid[..., 2:] * samples.valid[..., :-2] > 0)
    bend = (light[..., 2:] - 2 * light[..., 1:-1] + light[..., :-2])[dark]
    if bend.size < 50:
        return least
    return max(float(np.median(np.abs(bend)) / (0.6745 * np.sqrt(6.0))), least)
