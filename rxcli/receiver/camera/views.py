"""Strips as clocks of some period need them, worked out once for all: in readout order, thinned, levelled."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rxcli.protocol import EXTREMES_SLOTS
from rxcli.receiver.camera.curvature import curvature_terms, reversed_curvature
from rxcli.receiver.camera.strips import Strips, in_readout_order, levelled
from rxcli.types import Float32Array, FloatArray

#: Rows of one block of the normal equations; the bend is straight within, which in longer ones changes the period.
BLOCK_ROWS = 16


@dataclass(frozen=True, slots=True)
class View:
    """Strips in readout order, with no more rows a slot than its timing needs."""

    strips: Strips
    #: (4, M, blocks + 1) bend terms at the borders of blocks of rows.
    terms: FloatArray
    #: (M, R) float32: levelled light times its weight, and the weight.
    light: Float32Array
    weight: Float32Array
    #: Whether the picture's rows run against the readout.
    reversed: bool

    def curvature(self, values: FloatArray) -> FloatArray:
        """The bend of a picture from that of the view, or the other way round."""
        return reversed_curvature(values) if self.reversed else values


class Views:
    """All views of a picture's strips that were asked for so far."""

    def __init__(self, strips: Strips) -> None:
        self.strips = strips
        self._ordered: dict[tuple[bool, int], tuple[Strips, FloatArray]] = {}
        self._views: dict[tuple[bool, int, int], View] = {}

    def at(self, rows_per_slot: float, is_reversed: bool) -> View:
        """The strips for clocks of about some period, in one direction of readout."""
        join = _rows_joined(rows_per_slot)
        window = levelling_rows(rows_per_slot / join)
        key = (is_reversed, join, window)
        if key not in self._views:
            strips, terms = self._thinned(is_reversed, join, rows_per_slot)
            level, weight = levelled(strips.light, strips.inside, window, strips.noise)
            self._views[key] = View(strips, terms, level * weight, weight, is_reversed)
        return self._views[key]

    def _thinned(self, is_reversed: bool, join: int, rows_per_slot: float) -> tuple[Strips, FloatArray]:
        if (is_reversed, join) not in self._ordered:
            ordered = in_readout_order(self.strips) if is_reversed else self.strips
            ordered = thinned(ordered, rows_per_slot)
            self._ordered[is_reversed, join] = ordered, time_terms(ordered)
        return self._ordered[is_reversed, join]


def levelling_rows(rows_per_slot: float) -> int:
    """Rows around one that hold a lit and a dark slot whatever was sent."""
    return round(EXTREMES_SLOTS * rows_per_slot)


def _rows_joined(rows_per_slot: float) -> int:
    return max(1, int(rows_per_slot // 4))


def thinned(strips: Strips, rows_per_slot: float) -> Strips:
    """Neighbouring rows averaged as far as a slot keeps at least four."""
    join = _rows_joined(rows_per_slot)
    if join == 1:
        return strips
    n = strips.rows.size // join

    def mean(values: FloatArray | Float32Array) -> FloatArray:
        return np.asarray(values[..., : n * join].reshape(*values.shape[:-1], n, join).mean(axis=-1))

    inside = (mean(strips.inside) > 0.99).astype(np.float32)
    return replace(
        strips,
        light=mean(strips.light).astype(np.float32),
        inside=inside,
        x=mean(strips.x),
        rows=mean(strips.rows),
        noise=strips.noise.over(join),
    )


def time_terms(strips: Strips) -> FloatArray:
    """(4, M, blocks + 1) bend terms at the borders of blocks of rows."""
    n = strips.rows.size
    nodes = np.minimum(np.arange(-(-n // BLOCK_ROWS) + 1) * BLOCK_ROWS, n - 1)
    return curvature_terms(strips.x[:, nodes], strips.rows[nodes], strips.width, strips.height)


def slot_time(strips: Strips, terms: FloatArray, values: FloatArray) -> Float32Array:
    """(M, R) slot position of every strip's row; the bend is interpolated between the blocks' borders."""
    n = strips.rows.size
    start, rows_per_slot = values[:2]
    moved = (np.tensordot(values[2:], terms, 1) / rows_per_slot).astype(np.float32)[..., None]
    rows = np.minimum(np.arange(moved.shape[1]) * BLOCK_ROWS, n - 1)
    along = np.arange(BLOCK_ROWS) / np.maximum(np.diff(rows), 1)[:, None]
    bent = moved[:, :-1] + np.diff(moved, axis=1) * along.astype(np.float32)
    out: Float32Array = bent.reshape(len(bent), -1)[:, :n]
    out += ((strips.rows - start) / rows_per_slot).astype(np.float32)
    return out
