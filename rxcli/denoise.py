"""The convolutional auto-encoder: a second opinion on slots where the model-based path is unsure.

The network sees what the light model sees, the lateral strips of a column on the slot grid and what the neighbours are
believed to send, but it needs no idea of the column's own slots: it has learned what pictures look like. So it serves
where the iteration of picture and slots went astray. It returns log-odds of every slot, from which the iteration starts
once more; the more plausible end is kept (that is the pipeline's business).

One model serves every camera, slot rate, number of columns and number of strips: time is measured in slots, light in
multiples of the local level, strips are treated alike and pooled.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rxcli.protocol import HEADER, SLOTS_PER_SYMBOL
from rxcli.types import Clock, Float32Array, FloatArray, SlotSamples

#: The model that is used unless another is named.
DEFAULT_MODEL = "strips"
#: Version of the input contract that `network_inputs` makes.
CONTRACT = 1
SAMPLES_PER_SLOT = 4
#: Names of the features of a strip and of a column, in order; a name with `[4]` stands for one feature a sample.
STRIP_FEATURES = ("light[4]", "log_light[4]", "neighbours[4]", "valid", "noise", "shot", "own", "exposure", "known")
COLUMN_FEATURES = ("known", "phase[10]")
N_STRIP_FEATURES, N_COLUMN_FEATURES = 18, 11
#: Slots on either side over which the local level is averaged.
_LEVEL_SLOTS = 10
_MODEL_FORMAT = 1
_MAX_MODEL_BYTES = 2_000_000


@dataclass(frozen=True, slots=True)
class Scene:
    """What a frame's columns look like to the network; C columns of S strips, N slots of Q samples."""

    samples: SlotSamples
    clock: Clock
    #: (C, N) probability that each slot is lit, by the model-based path; only neighbours' are looked at.
    lit: Float32Array
    #: Light of a dark slot.
    floor: float
    #: Standard deviation of a sample of no light.
    sigma: float
    #: Variance of a sample per unit of light.
    shot: float
    #: (S, 3) share of the light of columns -1, 0, +1 in each strip.
    spread: FloatArray


class Denoiser(Protocol):
    """Something that tells lit slots from dark ones by the light alone."""

    @property
    def name(self) -> str:
        """Name for reports."""

    def slot_log_odds(self, scene: Scene, columns: NDArray[np.int64]) -> Float32Array:
        """(len(columns), N) ln p(lit)/p(dark) of every slot of `columns`."""


def network_inputs(scene: Scene, columns: NDArray[np.int64]) -> tuple[Float32Array, Float32Array]:
    """The input contract.

    Args:
        scene: the frame.
        columns: columns to look at, B of them.

    Returns:
        (B, S, 18, N) features of the strips, and (B, 11, N) of the columns; float32.
    """
    q = scene.samples.samples_per_slot
    valid = scene.samples.valid[columns]
    light = (scene.samples.light[columns] - np.float32(scene.floor)) * valid
    level = _local_level(light, valid, q)
    sigma = np.float32(max(scene.sigma, 1e-7))
    relative = np.clip(light / (level + 2 * sigma), -1, 4)
    base = 0.02 * level + 2 * sigma
    log_light = np.log((np.maximum(light, 0) + base) / (level + base))
    shape = (*light.shape[:2], -1, q)
    known = _known_slots(scene.clock)
    features = [
        *np.moveaxis(relative.reshape(shape), -1, 0),
        *np.moveaxis(log_light.reshape(shape), -1, 0),
        *np.moveaxis(_from_neighbours(scene, columns, q).reshape(shape), -1, 0),
        valid.reshape(shape).mean(axis=-1),
        *_noise_features(level.reshape(shape)[..., 0], sigma, np.float32(scene.shot)),
        scene.spread[None, :, 1, None],
        np.float32(scene.clock.exposure_slots),
        known,
    ]
    whole = features[0].shape
    strips = np.stack([np.broadcast_to(feature, whole) for feature in features], axis=2).astype(np.float32)
    return strips, np.broadcast_to(_column_features(known, scene.clock), (columns.size, N_COLUMN_FEATURES, whole[-1]))


def _local_level(light: Float32Array, valid: Float32Array, q: int) -> Float32Array:
    """(B, S, n) mean light of the valid samples around."""
    import cv2

    size = (2 * _LEVEL_SLOTS * q + 1, 1)
    flat = (-1, light.shape[-1])
    border = cv2.BORDER_CONSTANT
    total = cv2.boxFilter(light.reshape(flat), -1, size, normalize=False, borderType=border)
    count = cv2.boxFilter(valid.reshape(flat), -1, size, normalize=False, borderType=border)
    return np.maximum(total / np.maximum(count, 1), 0).reshape(light.shape).astype(np.float32)


def _noise_features(level: Float32Array, sigma: np.float32, shot: np.float32) -> tuple[Float32Array, Float32Array]:
    """Noise of a dark and of an average sample against the level, decades."""
    whole = level + sigma
    return np.log10(sigma / whole), np.log10(np.sqrt(sigma * sigma + shot * level) / whole)


def _known_slots(clock: Clock) -> Float32Array:
    """(N,) 1 lit, -1 dark in headers, 0 where nothing is known."""
    position = (np.arange(clock.n_slots) + clock.first_slot) % clock.packet_slots
    header = 2 * np.array(HEADER, np.float32) - 1
    return np.where(position < len(HEADER), header[np.minimum(position, len(HEADER) - 1)], 0).astype(np.float32)


def _column_features(known: Float32Array, clock: Clock) -> Float32Array:
    """(11, N): known slots, and the place in the symbol as one of ten."""
    place = (np.arange(clock.n_slots) + clock.first_slot) % SLOTS_PER_SYMBOL
    return np.concatenate([known[None], np.arange(SLOTS_PER_SYMBOL)[:, None] == place]).astype(np.float32)


def _from_neighbours(scene: Scene, columns: NDArray[np.int64], q: int) -> Float32Array:
    """(B, S, N * Q) light that the adjacent columns should shed into each strip, per unit of picture."""
    n_columns = scene.lit.shape[0]
    out = np.zeros((columns.size, *scene.samples.light.shape[1:]), np.float32)
    centres = (np.arange(out.shape[-1]) + 0.5) / q
    for side, share in ((-1, scene.spread[:, 0]), (1, scene.spread[:, 2])):
        for row, column in enumerate(columns):
            other = int(column) + side
            if 0 <= other < n_columns:
                ahead = scene.clock.delay_slots[column] - scene.clock.delay_slots[other]
                out[row] += share[:, None] * _exposed(scene.lit[other], centres + ahead, scene.clock.exposure_slots)
    return out


def _exposed(lit: Float32Array, centres: FloatArray, exposure_slots: float) -> FloatArray:
    """Mean of slots over exposures centred at `centres` (in slots); slots beyond the grid are half lit."""
    margin = int(np.ceil(exposure_slots)) + 4
    padded = np.pad(lit.astype(np.float64), margin, constant_values=0.5)
    integral = np.concatenate([[0.0], np.cumsum(padded)])
    knots = np.arange(integral.size) - margin
    half = max(exposure_slots, 0.25) / 2
    return np.asarray(
        (np.interp(centres + half, knots, integral) - np.interp(centres - half, knots, integral)) / (2 * half)
    )
