"""How many columns a screen has, between screens that share a clock."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rxcli.numerics import TINY
from rxcli.profiles import ScreenProfile
from rxcli.protocol import EXTREMES_SLOTS, PREAMBLE_SLOTS
from rxcli.receiver.camera.strips import levelled
from rxcli.receiver.light import NoiseModel, column_light
from rxcli.types import BoolArray, Clock, FloatArray, RowProfiles


def columns_misfit(profiles: RowProfiles, clock: Clock, screens: Sequence[ScreenProfile]) -> dict[int, float]:
    """How badly each number of columns explains up to which distance strips are similar: squared error by columns.

    Strips at u and v see the columns c with weights g(u - c) and g(v - c), so that their slots correlate by the
    product of both, summed over c. Header and dimming symbol are the same everywhere and must be left out.

    Args:
        profiles: C columns of S strips, C any; at least one strip a column of every screen.
        clock: the clock that the screens share.
        screens: screens that differ in their columns.
    """
    payload = np.flatnonzero(clock.places >= PREAMBLE_SLOTS)
    borders = np.asarray(clock.row0 + clock.rows_per_slot * np.stack([payload, payload + 1], axis=1).ravel(), float)
    slots, observed = _strip_slots(profiles, borders)
    n_strips = slots.shape[0]
    reach = max(2, min(n_strips - 1, round(1.5 * n_strips / min(screen.columns for screen in screens))))
    measured = np.array([_mean_likeness(slots, observed, distance) for distance in range(1, reach)])
    misfit = {}
    for screen in screens:
        # Codewords are not quite random, so that distant strips are slightly correlated too, by a constant.
        basis = np.stack([_expected_likeness(n_strips, reach, screen), np.ones(reach - 1)], axis=1)
        fit, *_ = np.linalg.lstsq(basis, measured, rcond=None)
        left = measured - basis @ fit if fit[0] > 0 else measured
        misfit[screen.columns] = float((left**2).sum()) + TINY
    return misfit


def _strip_slots(profiles: RowProfiles, borders: FloatArray) -> tuple[FloatArray, BoolArray]:
    """(M, n) mean light of slots in every strip, levelled over the slots around; and whether it is on the screen."""
    n_rows = profiles.rows.size
    light = profiles.light.reshape(-1, n_rows).astype(np.float64)
    inside = profiles.inside.reshape(light.shape)
    if profiles.sensor_row is None:
        place = np.broadcast_to(np.clip(borders - profiles.rows[0] + 0.5, 0, n_rows), (light.shape[0], borders.size))
    else:
        index = np.arange(n_rows) + 0.5
        rows = profiles.sensor_row.reshape(light.shape)
        place = np.stack([np.interp(borders, row, index, left=0, right=n_rows) for row in rows])
    low = np.minimum(place.astype(np.int64), n_rows - 1)

    def integral(values: FloatArray) -> FloatArray:
        total = np.concatenate([np.zeros((values.shape[0], 1)), np.cumsum(values, axis=1)], axis=1)
        below = np.take_along_axis(total, low, 1)
        at = below + (np.take_along_axis(total, low + 1, 1) - below) * (place - low)
        return np.asarray((at[:, 1::2] - at[:, ::2]) / np.maximum(place[:, 1::2] - place[:, ::2], 1e-6))

    observed = integral(inside.astype(np.float64)) > 0.99
    means = (integral(light) * observed).astype(np.float32)
    level, _ = levelled(means, observed.astype(np.float32), EXTREMES_SLOTS, NoiseModel(1e-8, 0.0))
    return level.astype(np.float64), observed


def _mean_likeness(slots: FloatArray, observed: BoolArray, distance: int) -> float:
    both = observed[:-distance] & observed[distance:]
    return float((slots[:-distance] * slots[distance:] * both).sum() / max(int(both.sum()), 1))


def _expected_likeness(n_strips: int, reach: int, screen: ScreenProfile) -> FloatArray:
    """(reach - 1,) correlation of strips 1, 2, .. apart, averaged over the screen."""
    light = column_light(n_strips, screen.columns, screen.light_spread)
    light /= np.linalg.norm(light, axis=1, keepdims=True)
    return np.array([float((light[:-d] * light[d:]).sum(axis=1).mean()) for d in range(1, reach)])
