"""The screen: local dimming, light spread, compensated picture, and the slots of every column.

Everything here is written from the air interface (sections 2 to 4) and shares only the codebook and the packet layout
with the receiver.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import UsageError
from rxcli.profiles import ScreenProfile
from rxcli.protocol import SLOTS_PER_SYMBOL, WEIGHTS, bits_per_symbol, encode_packet, payload_bits

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]

#: Exponent of the panel: light = (grey / 255) ** PANEL_GAMMA.
PANEL_GAMMA = 2.2
#: (256,) light of every grey level.
_PANEL_LIGHT = (np.arange(256) / 255.0) ** PANEL_GAMMA
#: What a black pixel of the panel still lets through (contrast 1000 : 1).
PANEL_LEAKAGE = 1e-3
#: A column of weight w sends the first k(w) bits of a label.
LABEL_BITS = 7

Weights = int | tuple[int, ...] | Literal["dimming"]
Waveform = Callable[[FloatArray], FloatArray]
Dimming = Literal["max", "none"]


#: Standard deviation of the wide part of the light spread, segment pitches.
_TAIL_SIGMA = 1.0


def light_spread(positions: FloatArray, n_segments: int, sigma: float, tails: float = 0.0) -> FloatArray:
    """Light that unit segments throw on places along one axis of the screen.

    A segment's light integrates to one segment pitch, so equal drive gives a mean of one far from the edges.

    Args:
        positions: (n,) places in 0..1 across the screen; the spread goes on outside.
        n_segments: segments along the axis.
        sigma: of the Gaussian, in segment pitches; 0 for a sharp segment.
        tails: share of the light in a second, wide Gaussian.

    Returns:
        (n, n_segments) float64.
    """
    if tails:
        near, wide = (light_spread(positions, n_segments, s) for s in (sigma, _TAIL_SIGMA))
        return np.asarray((1 - tails) * near + tails * wide)
    offset = np.asarray(positions)[..., None] * n_segments - (np.arange(n_segments) + 0.5)
    if sigma == 0:
        return np.asarray((offset >= -0.5) & (offset < 0.5), np.float64)
    return np.asarray(np.exp(-0.5 * (offset / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi)))


def dimming_levels(picture: NDArray[Any], rows: int, columns: int) -> NDArray[Any]:
    """Local dimming by the "max" rule: the brightest subpixel under each segment.

    Args:
        picture: (height, width, 3) grey levels or light.
        rows: segments along the height.
        columns: segments across.

    Returns:
        (rows, columns), of the picture's type and unit.
    """
    tops = np.arange(rows) * picture.shape[0] // rows
    lefts = np.arange(columns) * picture.shape[1] // columns
    by_rows = np.maximum.reduceat(picture, tops, axis=0)
    return np.asarray(np.maximum.reduceat(by_rows, lefts, axis=1).max(axis=2))


@dataclass(frozen=True)
class Drive:
    """What the screen is driven with for one picture."""

    #: (height_px, width_px, 3) uint8, compensated grey levels.
    grey: NDArray[np.uint8]
    #: (segment rows, columns) average light of each segment, 0..1.
    levels: FloatArray
    #: (columns,) lit slots per symbol.
    weights: NDArray[np.int64]

    @cached_property
    def transmittance(self) -> Float32Array:
        """(height_px, width_px, 3) what the panel lets through, per colour."""
        return (PANEL_LEAKAGE + (1 - PANEL_LEAKAGE) * _PANEL_LIGHT).astype(np.float32)[self.grey]

    @cached_property
    def lit_light(self) -> FloatArray:
        """(segment rows, columns) light of each segment while lit; its average is `levels`."""
        return self.levels * (SLOTS_PER_SYMBOL / self.weights)


def choose_weights(weights: Weights, levels: FloatArray) -> NDArray[np.int64]:
    """Lit slots per symbol of every column.

    Args:
        weights: one for all, one per column, or "dimming": each column follows its brightest segment.
        levels: (segment rows, columns) average light, 0..1.

    Raises:
        UsageError: a weight outside 1..9, or a wrong number of them.
    """
    columns = levels.shape[1]
    if weights == "dimming":
        wanted = np.rint(levels.max(axis=0) * SLOTS_PER_SYMBOL)
        return np.asarray(np.clip(wanted, WEIGHTS[0], WEIGHTS[-1]), np.int64)
    values = np.atleast_1d(np.asarray(weights, np.int64))
    if values.size not in (1, columns):
        reason = f"w must be one number or one for each of {columns} columns (got {values.size})"
        raise UsageError(reason, "give one number, a list as long as the screen has columns, or 'dimming'")
    if values.min() < WEIGHTS[0] or values.max() > WEIGHTS[-1]:
        raise UsageError(f"w must be in 1..9 (got {values.tolist()})", "choose from 1..9")
    return np.array(np.broadcast_to(values, columns))


def drive_screen(
    screen: ScreenProfile,
    picture: NDArray[np.uint8],
    weights: Weights,
    dimming: Dimming = "max",
    spread_tails: float = 0.0,
) -> Drive:
    """Local dimming, weights and compensated grey levels for a picture.

    Args:
        screen: what is driven.
        picture: (height_px, width_px, 3) uint8 grey levels as they should appear.
        weights: see `choose_weights`.
        dimming: "max", or "none" for a backlight that is fully on everywhere.
        spread_tails: see `Scene`.
    """
    shape = (screen.segment_rows, screen.columns)
    # The brightest grey level is the brightest light: the picture itself can be searched.
    levels = _PANEL_LIGHT[dimming_levels(picture, *shape)] if dimming == "max" else np.ones(shape)
    backlight = backlight_average(levels, screen, picture.shape[0], picture.shape[1], spread_tails)
    needed = _PANEL_LIGHT.astype(np.float32)[picture] / np.maximum(backlight, 1e-6)[..., None].astype(np.float32)
    grey = np.rint(255 * np.clip(needed, 0, 1) ** np.float32(1 / PANEL_GAMMA)).astype(np.uint8)
    return Drive(grey, levels, choose_weights(weights, levels))


def backlight_average(levels: FloatArray, screen: ScreenProfile, height: int, width: int, tails: float) -> FloatArray:
    """(height, width) average light behind every pixel of the panel."""
    across = light_spread((np.arange(width) + 0.5) / width, screen.columns, screen.light_spread, tails)
    along = light_spread((np.arange(height) + 0.5) / height, screen.segment_rows, screen.light_spread, tails)
    return np.asarray(along @ levels @ across.T)


class LabelSource(Protocol):
    """What gives labels of 7 bits to send, one a payload symbol."""

    def labels(self, bursts: NDArray[np.int64], columns: int, payload_symbols: int) -> NDArray[np.uint8]:
        """(n, N, C) uint8 labels of bursts `bursts` (n,)."""
        ...


@dataclass(frozen=True)
class Link:
    """The endless stream of bursts that the columns send; burst 0 starts at slot 0, before it all is dark."""

    screen: ScreenProfile
    #: (columns,) lit slots per symbol.
    weights: NDArray[np.int64]
    #: Seed of random payloads.
    seed: int
    #: Sent over and over, burst by burst and column by column; None for random bits.
    message: bytes | None = None
    #: What to send instead of it; None for `message`.
    labels: LabelSource | None = None
    #: Light 0..1 by slot number, (n,) of all columns or (columns, n), instead of packets; None for packets.
    waveform: Waveform | None = None
    #: Lit slots per symbol by burst, where they follow a film; None for `weights` all the time.
    weights_of: Callable[[int], NDArray[np.int64]] | None = None

    @property
    def burst_slots(self) -> int:
        """Slots of one burst."""
        return self.screen.packet_slots * self.screen.repeats

    def weights_in(self, burst: int) -> NDArray[np.int64]:
        """(columns,) lit slots per symbol of a burst."""
        return self.weights if self.weights_of is None else self.weights_of(burst)

    def bits_per_column(self, burst: int = 0) -> list[int]:
        """Payload bits of every column's packet in a burst."""
        return [payload_bits(int(w), self.screen.payload_symbols) for w in self.weights_in(burst)]

    def payload(self, burst: int) -> list[NDArray[np.uint8]]:
        """Payload bits of one burst, per column."""
        if self.labels is not None:
            # The first bits of every symbol's label, as many as the column's weight carries.
            label = self.labels.labels(np.array([burst]), self.screen.columns, self.screen.payload_symbols)[0]
            sent = ((label[..., None] >> np.arange(LABEL_BITS - 1, -1, -1)) & 1).astype(np.uint8)
            return [sent[:, c, : bits_per_symbol(int(w))].ravel() for c, w in enumerate(self.weights_in(burst))]
        bits_per_column = self.bits_per_column(burst)
        total = sum(bits_per_column)
        if self.message is None:
            rng = np.random.Generator(np.random.Philox(np.random.SeedSequence([self.seed, burst])))
            bits = rng.integers(0, 2, total, dtype=np.uint8)
        else:
            message = np.unpackbits(np.frombuffer(self.message, np.uint8))
            bits = np.take(message, np.arange(burst * total, (burst + 1) * total), mode="wrap")
        return np.split(bits, np.cumsum(bits_per_column)[:-1])

    def packets(self, burst: int) -> NDArray[np.uint8]:
        """(columns, packet slots) 0/1, one packet of `burst`."""
        bits = self.payload(burst)
        return np.stack([encode_packet(b, int(w)) for b, w in zip(bits, self.weights_in(burst), strict=True)])

    def slots(self, start: int, stop: int) -> NDArray[Any]:
        """(columns, stop - start) 0/1 slots from `start` on; dark before slot 0."""
        if self.waveform is not None:
            light = self.waveform(np.arange(start, stop, dtype=np.float64))
            return np.broadcast_to(light, (self.screen.columns, stop - start))
        bursts = range(max(start, 0) // self.burst_slots, max(stop - 1, 0) // self.burst_slots + 1)
        sent = np.concatenate([np.tile(self.packets(b), self.screen.repeats) for b in bursts], axis=1)
        origin = bursts[0] * self.burst_slots
        dark = np.zeros((sent.shape[0], max(0, min(-start, stop - start))), np.uint8)
        return np.concatenate([dark, sent[:, max(start, 0) - origin : max(stop, 0) - origin]], axis=1)


#: What `export_picture` writes.
PICTURE_FILES = ("levels.csv", "lit_light.csv", "picture.png")


def export_picture(drive: Drive, folder: Path) -> None:
    """Write what a laboratory needs beside the slots to drive a real screen.

    `levels.csv` holds the average light of every segment, `lit_light.csv` its light while lit (1 is the full average);
    `picture.png` is the compensated picture.
    """
    from rxcli.outputs import encode_png

    names = ",".join(f"column_{c}" for c in range(drive.levels.shape[1]))
    for name, light in zip(PICTURE_FILES, (drive.levels, drive.lit_light), strict=False):
        np.savetxt(folder / name, light, fmt="%.6f", delimiter=",", header=names, comments="")
    (folder / PICTURE_FILES[-1]).write_bytes(encode_png(np.ascontiguousarray(drive.grey[..., ::-1])))
