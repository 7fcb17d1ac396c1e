"""Small screens as row profiles, without pixels: thousands of columns a minute.

The physics is the air interface's (sections 2 to 5), written for strips instead of pixels: a picture's rows behind each
strip, slots through the exposure, light of the neighbours, shot and read noise, then what developing does along a
column: noise reduction, tone curve, sharpening, rounding. What is missing (demosaicing, JPEG blocks, errors of outline
and clock beyond a small shift) comes from whole simulated frames, which training mixes in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rxcli.denoise import SAMPLES_PER_SLOT, Scene
from rxcli.protocol import bits_per_symbol, encode_packet
from rxcli.training.scenes import Picture
from rxcli.types import Clock, Float32Array, FloatArray, SlotSamples

N_COLUMNS, N_SLOTS = 4, 160
#: Slots before and after, so that every exposure is defined.
_LEAD = 6
#: Slot rates (Hz) as panel rows that pass during a slot when the screen fills the frame.
_PANEL_ROWS_PER_SLOT = (0.9, 1.8, 3.6)
_PANEL_COLUMN_PX = 1366 / 20
_GAMMA = 2.2


@dataclass(frozen=True)
class Example:
    """A scene with its truth."""

    scene: Scene
    #: (C, N) 0/1.
    slots: NDArray[np.uint8]


def random_examples(rng: np.random.Generator, picture: Picture, n: int) -> list[Example]:
    """`n` times a few adjacent columns in front of part of a picture.

    Args:
        rng: source of all choices.
        picture: (768, 1366, 3) uint8.
        n: examples.
    """
    table = ((np.arange(256) / 255.0) ** _GAMMA).astype(np.float32)
    grey = table[picture] @ rng.dirichlet((3, 6, 2)).astype(np.float32)
    grey /= max(float(np.quantile(grey[::4, ::4], 0.999)), 0.02)
    return [_random_example(rng, grey) for _ in range(n)]


def _random_example(rng: np.random.Generator, grey: Float32Array) -> Example:
    kind = int(rng.choice(3, p=(0.5, 0.37, 0.13)))
    rows_per_slot = (5.0, 10.0, 20.0)[kind] * rng.uniform(0.7, 1.15)
    n_strips = int(rng.choice([3, 4, 5, 6, 8]))
    exposure = rng.uniform(0.4, 1.4) if kind and rng.random() < 0.5 else rng.uniform(1.0, 2.6)
    white_e = 10 ** rng.uniform(0.5, 2.0)
    packet = (260, 130, 70)[kind]
    slots, first = _random_slots(rng, packet)
    n_rows = int(N_SLOTS * rows_per_slot)
    panel = _panel_light(rng, grey, n_strips, n_rows, _PANEL_ROWS_PER_SLOT[kind] / rows_per_slot)
    start = _LEAD + np.arange(n_rows) / rows_per_slot - exposure / 2 + 0.5 / rows_per_slot
    shape = _through_exposure(slots, start, exposure)
    light = panel * _mixed(shape, n_strips, rng.uniform(0.42, 0.5))
    room = 10 ** rng.uniform(-3, -1.0)
    n_pixels = rng.uniform(10, 50)
    seen, sigma, slope = _developed(rng, light + room * 0.12, white_e, n_pixels)
    scene = _scene(rng, seen, slots, rows_per_slot, exposure, (packet, first), room * 0.12, sigma, slope)
    return Example(scene, slots[:, _LEAD:-_LEAD])


def _random_slots(rng: np.random.Generator, packet: int) -> tuple[NDArray[np.uint8], int]:
    """(C, N + 2 lead) slots of repeated packets, and the position of the first after the lead."""
    n_symbols = (packet - 20) // 10
    first = int(rng.integers(0, packet))
    common = int(rng.choice([2, 3, 4, 5, 5, 5, 5, 6, 7, 8]))
    rows = []
    for _ in range(N_COLUMNS):
        w = int(rng.integers(1, 10)) if rng.random() < 0.25 else common
        sent = encode_packet(rng.integers(0, 2, n_symbols * bits_per_symbol(w), dtype=np.uint8), w)
        rows.append(np.resize(np.roll(sent, _LEAD - first), N_SLOTS + 2 * _LEAD))
    return np.stack(rows), first


def _panel_light(
    rng: np.random.Generator, grey: Float32Array, n_strips: int, n_rows: int, panel_rows_per_row: float
) -> FloatArray:
    """(C, S, R) light of the picture behind every strip, 1 at its brightest; from a random, slightly turned part."""
    import cv2

    strip_px = _PANEL_COLUMN_PX / n_strips
    step = 3
    across = np.arange(N_COLUMNS * n_strips * step) * (strip_px / step)
    along = np.arange(n_rows) * panel_rows_per_row * rng.uniform(0.9, 1.3)
    slant = rng.normal(0, 0.02)
    height, width = grey.shape
    x = rng.uniform(0, max(width - across[-1], 1)) + across[:, None] + slant * along
    y = rng.uniform(0, max(height - along[-1], 1)) + along[None] - slant * across[:, None]
    sigma_x, sigma_y = strip_px / step / 2 + 0.2, rng.uniform(0.15, 0.6)
    blurred = cv2.GaussianBlur(grey, (0, 0), sigmaX=sigma_x, sigmaY=sigma_y)
    seen = cv2.remap(
        blurred, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    seen = seen.reshape(N_COLUMNS, n_strips, step, n_rows).mean(axis=2)
    return np.asarray(0.001 + seen, np.float64)


def _through_exposure(slots: NDArray[np.uint8], start: FloatArray, exposure: float) -> FloatArray:
    """(C, R) mean of the slots over exposures that start at `start`."""
    integral = np.concatenate([np.zeros((slots.shape[0], 1)), np.cumsum(slots, axis=1)], axis=1)
    knots = np.arange(integral.shape[1])
    return np.stack([np.interp(start + exposure, knots, i) - np.interp(start, knots, i) for i in integral]) / exposure


def _mixed(shape: FloatArray, n_strips: int, sigma: float) -> FloatArray:
    """(C, S, R) light of all columns behind each strip; columns at the side of the screen lack a neighbour."""
    place = (np.arange(N_COLUMNS * n_strips) + 0.5) / n_strips
    distance = place[:, None] - (np.arange(N_COLUMNS) + 0.5)
    light = np.exp(-0.5 * (distance / sigma) ** 2) @ shape
    return np.asarray(light.reshape(N_COLUMNS, n_strips, -1))


def _developed(
    rng: np.random.Generator, light: FloatArray, white_e: float, n_pixels: float
) -> tuple[FloatArray, float, float]:
    """Noise and what a camera does to light; with the noise's floor (deviation) and slope (variance) of a row."""
    from scipy.ndimage import gaussian_filter1d

    read = rng.uniform(1.2, 4.0)
    floor, slope = read**2 / white_e**2 / n_pixels, 1 / white_e / n_pixels
    seen = light + np.sqrt(floor + slope * light) * rng.standard_normal(light.shape)
    seen += rng.uniform(0, 0.5) / white_e * rng.standard_normal(light.shape[-1]) / 2
    if rng.random() < 0.3:
        return seen, float(np.sqrt(floor)), slope
    gain = rng.uniform(0.5, 1.2)
    smooth = rng.uniform(0.0, 0.8)
    if smooth > 0.2:
        seen = gaussian_filter1d(seen, smooth, axis=-1)
    encoded = np.clip(seen * gain, 0, 1) ** (1 / _GAMMA)
    if rng.random() < 0.5:
        encoded += rng.uniform(0, 1.0) * (encoded - gaussian_filter1d(encoded, 1.2, axis=-1))
    encoded += rng.uniform(0, 2.0) / 255 / np.sqrt(n_pixels) * rng.standard_normal(light.shape)
    return np.clip(encoded, 0, 1) ** _GAMMA / gain, float(np.sqrt(floor)), slope


def _scene(
    rng: np.random.Generator,
    seen: FloatArray,
    slots: NDArray[np.uint8],
    rows_per_slot: float,
    exposure: float,
    packet: tuple[int, int],
    floor: float,
    sigma: float,
    slope: float,
) -> Scene:
    """Resampled to the slot grid, with a small error of the clock; floor and noise as roughly as a receiver knows."""
    samples = _resampled(seen, rows_per_slot, rng.normal(0, 0.04))
    rows = max(rows_per_slot / SAMPLES_PER_SLOT, 1.0)
    scale = rng.uniform(0.05, 0.6)
    clock = Clock(
        rows_per_slot=rows_per_slot,
        exposure_slots=exposure * float(np.exp(rng.normal(0, 0.03))),
        packet_slots=packet[0],
        row0=0.0,
        n_slots=N_SLOTS,
        first_slot=packet[1],
        burst=np.zeros(1, np.int64),
        delay_slots=np.zeros(N_COLUMNS),
        lock=9.0,
    )
    half = np.arange(seen.shape[1]) / seen.shape[1] + 0.5 / seen.shape[1] - 0.5
    spread = np.exp(-((half[:, None] - np.arange(-1, 2)) ** 2) / (2 * 0.45**2))
    return Scene(
        samples=SlotSamples((samples * scale).astype(np.float32), np.ones(samples.shape, np.float32), SAMPLES_PER_SLOT),
        clock=clock,
        lit=_believed(rng, slots[:, _LEAD:-_LEAD]),
        floor=scale * (floor + rng.normal(0, 0.3) * sigma / np.sqrt(rows)),
        sigma=scale * sigma / np.sqrt(rows) * float(np.exp(rng.normal(0, 0.3))),
        shot=scale * slope / rows,
        spread=spread,
    )


def _resampled(seen: FloatArray, rows_per_slot: float, late_slots: float) -> FloatArray:
    """(C, S, N * Q) means over equal parts of slots."""
    total = np.concatenate([np.zeros((*seen.shape[:2], 1)), np.cumsum(seen, axis=-1)], axis=-1)
    borders = np.arange(N_SLOTS * SAMPLES_PER_SLOT + 1) / SAMPLES_PER_SLOT + late_slots
    at = np.clip(borders * rows_per_slot, 0, seen.shape[-1])
    left = np.minimum(at.astype(np.int64), seen.shape[-1] - 1)
    sums = total[..., left] + (total[..., left + 1] - total[..., left]) * (at - left)
    return np.asarray(np.diff(sums, axis=-1) / np.maximum(np.diff(at), 1e-6))


def _believed(rng: np.random.Generator, slots: NDArray[np.uint8]) -> Float32Array:
    """(C, N) what a receiver believes of the slots: mostly right, for some columns partly wrong or unknown."""
    wrong = rng.choice([0.0, 0.0, 0.0, 0.03, 0.2], N_COLUMNS)[:, None]
    flipped = np.where(rng.random(slots.shape) < wrong, 1.0 - slots, slots)
    doubt = rng.random(slots.shape) < 2 * wrong
    return np.where(doubt, 0.5 + (flipped - 0.5) * rng.random(slots.shape), flipped).astype(np.float32)
