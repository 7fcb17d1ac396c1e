"""Row profiles of a link whose every slot is known, made without a picture; its own equations, not the receiver's."""

from dataclasses import dataclass

import numpy as np
from made_stages import profiles_of
from numpy.typing import NDArray

from rxcli.protocol import encode_packet, payload_bits
from rxcli.types import RowProfiles

FloatArray = NDArray[np.float64]
REPEATS = 3


@dataclass(frozen=True)
class Link:
    """What the columns send: bursts of three copies, the next burst right after, without end."""

    #: (B, C, bits of the column) payload bits, nested as bursts get drawn.
    bits: list[list[NDArray[np.uint8]]]
    w: list[int]
    n_symbols: int

    @property
    def packet_slots(self) -> int:
        return 20 + 10 * self.n_symbols

    def slots(self) -> NDArray[np.uint8]:
        """(C, n) all slots, burst 0 first."""
        bursts = [
            np.stack([np.tile(encode_packet(bits, w), REPEATS) for bits, w in zip(burst, self.w, strict=True)])
            for burst in self.bits
        ]
        return np.concatenate(bursts, axis=1)


def random_link(rng: np.random.Generator, w: list[int], n_symbols: int, n_bursts: int = 3) -> Link:
    bits = [
        [rng.integers(0, 2, payload_bits(weight, n_symbols), dtype=np.uint8) for weight in w] for _ in range(n_bursts)
    ]
    return Link(bits, w, n_symbols)


@dataclass(frozen=True)
class Shot:
    """How the rows see the link."""

    rows_per_slot: float = 5.0
    exposure_slots: float = 1.0
    #: Slot of the link, from its first one, at the middle of the exposure of row 0.
    start_slot: float = 40.0
    n_rows: int = 700
    n_strips: int = 4
    first_row: int = 0
    #: Relative standard deviation of the picture's texture, and its length in rows.
    texture: float = 0.0
    texture_rows: float = 20.0
    #: Light of a lit row, of room light, and standard deviation of the noise.
    level: float = 0.5
    ambient: float = 0.01
    sigma: float = 0.002
    #: Share of a neighbouring column's light.
    crosstalk: float = 0.0


def exposed(slots: NDArray[np.uint8], centre: FloatArray, exposure_slots: float) -> FloatArray:
    """(C, R) mean of the slots over exposures (R,) around `centre`; slots are 0 before the first and after the last."""
    total = np.concatenate([np.zeros((slots.shape[0], 1)), np.cumsum(slots, axis=1)], axis=1)
    border = np.arange(total.shape[1])
    low, high = centre - exposure_slots / 2, centre + exposure_slots / 2
    return np.stack([np.interp(high, border, t) - np.interp(low, border, t) for t in total]) / exposure_slots


def row_profiles(
    link: Link, shot: Shot, rng: np.random.Generator, delay_slots: FloatArray | None = None
) -> RowProfiles:
    """The light of every strip on every row."""
    slots = link.slots()
    n_columns = slots.shape[0]
    delays = np.zeros(n_columns) if delay_slots is None else delay_slots
    rows = np.arange(shot.n_rows)
    centre = shot.start_slot + rows / shot.rows_per_slot
    seen = np.concatenate(
        [exposed(slots[c : c + 1], centre - delays[c], shot.exposure_slots) for c in range(n_columns)]
    )
    mixed = seen.copy()
    mixed[1:] += shot.crosstalk * seen[:-1]
    mixed[:-1] += shot.crosstalk * seen[1:]
    shape = (n_columns, shot.n_strips, shot.n_rows)
    light = shot.ambient + shot.level * picture(shape, shot, rng) * mixed[:, None]
    light += rng.normal(0, shot.sigma, shape)
    return profiles_of(light, shot.sigma**2, rows=shot.first_row + rows)


def picture(shape: tuple[int, int, int], shot: Shot, rng: np.random.Generator) -> FloatArray:
    """Transmittance: one, or smooth positive texture that differs between strips."""
    if shot.texture == 0:
        return np.ones(shape)
    n_knots = int(shape[2] / shot.texture_rows) + 2
    knots = rng.normal(0, shot.texture, (*shape[:2], n_knots))
    at = np.arange(shape[2]) / shot.texture_rows
    flat = [np.interp(at, np.arange(n_knots), k) for k in knots.reshape(-1, n_knots)]
    return np.exp(np.reshape(flat, shape))


def sigma_of(profiles: RowProfiles) -> float:
    return float(np.sqrt(profiles.noise_floor))
