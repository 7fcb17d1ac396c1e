"""What rows show of slots: the mix of sensor rows, and the line of the slots' rate in the edges' power."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rxcli.receiver import camera as blind
from rxcli.receiver.camera.edges import by_edges, line_evidence
from rxcli.receiver.camera.rows import RowModel, fit_rows
from rxcli.receiver.camera.views import slot_time, time_terms
from rxcli.receiver.light import NoiseModel
from rxcli.types import Float32Array, FloatArray

WIDTH, ROWS, COLUMNS = 1600, 900, 20
ROWS_PER_SLOT, START, SHUTTER = 2.3, -4.6, 0.6
KERNEL = np.array([0.7, 0.5, -0.2])
BEND = np.array([-0.2, 0.05, 0.0, 0.0])


def _sensor_rows(slots: Float32Array, rows: FloatArray) -> FloatArray:
    """(C, n) light of whole sensor rows through the shutter, in steps of a hundredth of it."""
    time = (rows - START) / ROWS_PER_SLOT + SHUTTER * ((np.arange(100) + 0.5) / 100 - 0.5)[:, None]
    return np.asarray(slots[:, np.floor(time).astype(int)].mean(axis=1))


def _picture(rng: np.random.Generator, curvature: FloatArray) -> tuple[blind.Strips, Float32Array]:
    """Strips of a picture that mixes sensor rows and then takes its rows from between them; and the slots (C, N)."""
    slots = rng.integers(0, 2, (COLUMNS, 420)).astype(np.float32)
    lit = np.repeat(slots, 4, axis=0)
    x = np.broadcast_to(((np.arange(4 * COLUMNS) + 0.5) * WIDTH / (4 * COLUMNS))[:, None], (4 * COLUMNS, ROWS))
    rows = np.arange(ROWS, dtype=np.float64)
    place = rows + np.tensordot(curvature, blind.curvature_terms(x, rows, WIDTH, ROWS), 1)
    first = int(np.floor(place.min())) - 3
    sensor = _sensor_rows(lit, np.arange(first, int(place.max()) + 5, dtype=np.float64))
    mixed = sum(weight / 2 * (np.roll(sensor, k, 1) + np.roll(sensor, -k, 1)) for k, weight in enumerate(KERNEL))
    low = np.floor(place).astype(int) - first
    below, above = (np.take_along_axis(np.asarray(mixed), low + k, 1) for k in (0, 1))
    light = below + (above - below) * (place - first - low)
    light = 0.2 * light * np.exp(rng.normal(0, 0.05, light.shape)) + rng.normal(0, 0.002, light.shape)
    ones, noise = np.ones(light.shape, np.float32), NoiseModel(0.002**2, 0.0)
    return blind.Strips(light.astype(np.float32), ones, x, rows, COLUMNS, noise, WIDTH, ROWS), slots


@pytest.mark.parametrize("curvature", [np.zeros(4), BEND])
def test_the_mix_of_rows_is_found(curvature: FloatArray, monkeypatch: pytest.MonkeyPatch) -> None:
    # Every column on its own: the spread of light has no part in this.
    monkeypatch.setattr("rxcli.receiver.camera.rows.column_shares", lambda _: np.repeat(np.eye(COLUMNS), 4, axis=0))
    strips, slots = _picture(np.random.default_rng(5), curvature)
    values = np.concatenate([[START, ROWS_PER_SLOT], curvature])
    time = slot_time(strips, time_terms(strips), values)
    found = fit_rows(strips, time, values, slots, 1.2 * SHUTTER, 60)
    assert found.shutter_slots == pytest.approx(SHUTTER, rel=0.2)
    np.testing.assert_allclose(found.kernel, KERNEL, atol=0.08)
    light, slope = RowModel(SHUTTER, KERNEL).observed(strips, time, values, slots)
    residual = strips.light - 0.2 * light
    assert residual.std() < 0.1 * strips.light.std()
    assert np.abs(slope).max() <= np.abs(KERNEL).sum() / SHUTTER + 1e-4


def test_edges_tell_the_period_alone() -> None:
    strips, _ = _picture(np.random.default_rng(6), BEND)
    assert line_evidence(strips, ROWS_PER_SLOT, BEND) > 50
    assert line_evidence(strips, 1.01 * ROWS_PER_SLOT, BEND) < 10
    assert line_evidence(strips, ROWS_PER_SLOT, 0 * BEND) < 0.5 * line_evidence(strips, ROWS_PER_SLOT, BEND)


def test_an_estimate_that_edges_do_not_keep_to_is_none() -> None:
    strips, _ = _picture(np.random.default_rng(7), BEND)
    right = blind.BlindEstimate(
        rows_per_slot=ROWS_PER_SLOT,
        rows_per_slot_sd=0.001,
        packet_slots=130,
        reversed=False,
        exposure_slots=SHUTTER,
        exposure_slots_sd=0.05,
        curvature=BEND,
        curvature_sd=np.full(4, 1e-3),
        corrected=True,
        log_evidence=-5.0,
        explained=0.1,
    )
    wrong = replace(right, rows_per_slot=1.02 * ROWS_PER_SLOT)
    harmonic = replace(right, rows_per_slot=ROWS_PER_SLOT / 2)
    assert by_edges(strips, [wrong, right]) is right
    assert by_edges(strips, [wrong, harmonic]) is None
    curvature = {"k1", "k2", "p1", "p2", "distortion_corrected"}
    assert set(blind.summary_of_rows(right)) == {"rows_per_slot", *curvature}
