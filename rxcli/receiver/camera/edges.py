"""Rows per slot by the edges alone: they fall between slots, so their power has a line at the rate of the slots."""

from __future__ import annotations

import numpy as np

from rxcli.numerics import local_mean
from rxcli.protocol import EXTREMES_SLOTS
from rxcli.receiver.camera.curvature import curvature_terms
from rxcli.receiver.camera.estimates import BlindEstimate
from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.strips import Strips, levelled
from rxcli.types import Float32Array, FloatArray


def edge_power(columns: Float32Array) -> Float32Array:
    """(C, R - 1) squared steps of columns (C, R) from row to row, less their mean thereabouts."""
    steps = np.diff(columns, axis=1)
    square = np.asarray(steps * steps, np.float32)
    return square - local_mean(square, SETTINGS.edge_level_rows)


def line_evidence(strips: Strips, rows_per_slot: float, curvature: FloatArray) -> float:
    """Nats by which edges keep to a grid of some period on stripes of some bend, over chance.

    Args:
        strips: as the picture has them.
        rows_per_slot: of the grid.
        curvature: (4,) of the stripes.
    """
    level, weight = levelled(strips.light, strips.inside, round(EXTREMES_SLOTS * rows_per_slot), strips.noise)
    shape = (strips.n_columns, -1, strips.rows.size)
    power = edge_power((level * weight).reshape(shape).sum(axis=1))
    rows = strips.rows + np.tensordot(curvature, curvature_terms(strips.x, strips.rows, strips.width, strips.height), 1)
    middle = rows.reshape(shape).mean(axis=1)
    turned = power * np.exp(1j * np.pi / rows_per_slot * (middle[:, 1:] + middle[:, :-1]))
    return float(np.abs(turned.sum()) ** 2 / max(float((power * power).sum()), 1e-30))


def edge_nats(strips: Strips, rows_per_slot: float, curvature: FloatArray) -> float:
    """The same where it is beyond doubt, else 0.

    A period twice as long, to which edges keep too, has it as its harmonic.
    """
    nats, double = (line_evidence(strips, n * rows_per_slot, curvature) for n in (1, 2))
    return nats if nats > SETTINGS.line_beyond_doubt_nats > double else 0.0


def by_edges(strips: Strips, estimates: list[BlindEstimate]) -> BlindEstimate | None:
    """The estimate whose period the edges keep to beyond doubt, None without one."""
    nats = [edge_nats(strips, one.rows_per_slot, one.curvature * one.corrected) for one in estimates]
    return estimates[int(np.argmax(nats))] if any(nats) else None
