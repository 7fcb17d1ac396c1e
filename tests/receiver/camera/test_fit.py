"""An estimated camera fitted to decoded slots."""

from dataclasses import replace

import numpy as np
import pytest
from made_stages import clock_of, hypothesis_of

from rxcli.protocol import encode_packet, payload_bits
from rxcli.receiver.camera.camera import summary
from rxcli.receiver.camera.fit import settle
from rxcli.receiver.camera.proposals import CameraHypothesis
from rxcli.receiver.camera.strips import ColumnStrips
from rxcli.receiver.light import NoiseModel
from rxcli.types import Clock, FloatArray

WIDTH, ROWS, COLUMNS, LENGTH = 1600, 1200, 20, 130
ROWS_PER_SLOT, EXPOSURE, START = 4.2, 1.7, -7.3
BEND = np.array([-0.22, 0.1, 4e-4, -3e-4])
#: Light spread of the screen, column pitches: hardly any.
SPREAD = 0.1


def _strips(rng: np.random.Generator, curvature: FloatArray) -> tuple[ColumnStrips, FloatArray]:
    """Strips of a textured picture whose sensor rows are bent, and the slots (C, N) that they show."""
    bits = [rng.integers(0, 2, payload_bits(w, 11), dtype=np.uint8) for w in rng.integers(3, 8, COLUMNS)]
    lit = np.stack([np.tile(encode_packet(b, _weight(b)), 3)[:300] for b in bits]).astype(np.float64)
    n = 4 * COLUMNS
    x = np.broadcast_to(((np.arange(n) + 0.5) * WIDTH / n)[:, None], (n, ROWS))
    rows = np.arange(ROWS, dtype=np.float64)
    across, down = (x - (WIDTH - 1) / 2) / WIDTH, (rows - (ROWS - 1) / 2) / WIDTH
    square = across**2 + down**2
    k1, k2, p1, p2 = curvature
    moved = WIDTH * (down * (k1 * square + k2 * square**2) + p1 * (square + 2 * down**2) + 2 * p2 * across * down)
    time = (rows + moved - START) / ROWS_PER_SLOT
    light = np.zeros((n, ROWS))
    for offset in (np.arange(40) + 0.5) / 40 - 0.5:
        slot = np.clip(np.floor(time + offset * EXPOSURE).astype(int), 0, lit.shape[1] - 1)
        light += lit[np.arange(n)[:, None] // 4, slot] / 40
    picture = 0.2 * np.exp(np.cumsum(rng.normal(0, 0.01, (n, ROWS)), axis=1))
    light = picture * light + rng.normal(0, 0.003, light.shape)
    strips = ColumnStrips(
        light=light.astype(np.float32),
        inside=np.ones(light.shape, np.float32),
        x=x,
        rows=rows,
        n_columns=COLUMNS,
        noise=NoiseModel(0.003**2, 0.0),
        width=WIDTH,
        height=ROWS,
    )
    return strips, lit


def _weight(bits: np.ndarray) -> int:
    return next(w for w in (3, 4, 5, 6, 7) if payload_bits(w, 11) == bits.size)


def _hypothesis(curvature: FloatArray, reverse: bool = False) -> CameraHypothesis:
    """A first estimate: a period that is off by a thousandth, most of the bend, an exposure too short."""
    known = {"packet_slots": LENGTH, "curvature": 0.9 * _as_stored(curvature, reverse)}
    return hypothesis_of(1.001 * ROWS_PER_SLOT, reversed=reverse, exposure_slots=1.3, **known)


def _as_stored(curvature: FloatArray, reverse: bool) -> FloatArray:
    return curvature * np.array([1.0, 1.0, -1.0, 1.0]) if reverse else curvature


def _settled(strips: ColumnStrips, first: CameraHypothesis, lit: FloatArray) -> tuple[CameraHypothesis, float]:
    return settle(strips, first, _clock(first), lit.astype(np.float32), SPREAD)


def _clock(estimate: CameraHypothesis) -> Clock:
    known = {name: getattr(estimate, name) for name in ("rows_per_slot", "exposure_slots", "packet_slots")}
    return clock_of(COLUMNS, row0=START - 0.6, n_slots=300, burst=np.zeros(3, np.int64), **known)


@pytest.mark.parametrize(("curvature", "reverse"), [(np.zeros(4), False), (BEND, False), (BEND, True)])
def test_decoded_slots_correct_a_first_estimate(curvature: FloatArray, reverse: bool) -> None:
    strips, lit = _strips(np.random.default_rng(11), curvature)
    found, moved_slots = _settled(strips, _hypothesis(curvature, reverse), lit)
    assert found.rows_per_slot == pytest.approx(ROWS_PER_SLOT, rel=2e-4)
    assert abs(found.rows_per_slot - ROWS_PER_SLOT) < 4 * found.rows_per_slot_sd
    assert 1.3 < found.exposure_slots == pytest.approx(EXPOSURE, rel=0.06)
    assert bool(found.curvature.any()) == bool(curvature.any())
    assert 0.1 < moved_slots < 2
    if curvature.any():
        assert found.curvature[0] == pytest.approx(_as_stored(curvature, reverse)[0], abs=0.01)


def test_a_bend_that_is_none_is_taken_out() -> None:
    strips, lit = _strips(np.random.default_rng(12), np.zeros(4))
    found, _ = _settled(strips, replace(_hypothesis(np.zeros(4)), curvature=np.array([0.01, 0.02, 0.0, 0.0])), lit)
    assert not found.curvature.any()
    assert found.rows_per_slot == pytest.approx(ROWS_PER_SLOT, rel=2e-4)


def test_slots_that_explain_nothing_change_nothing() -> None:
    strips, lit = _strips(np.random.default_rng(13), np.zeros(4))
    first = _hypothesis(np.zeros(4))
    found, moved_slots = _settled(strips, first, np.full_like(lit, 0.5))
    assert found is first
    assert moved_slots == 0.0


def test_the_file_states_the_least_exposure() -> None:
    strips, lit = _strips(np.random.default_rng(14), np.zeros(4))
    found, _ = _settled(strips, replace(_hypothesis(np.zeros(4)), stated_exposure_slots=2.0), lit)
    assert found.exposure_slots == 2.0
    assert found.exposure_slots_sd == 0.0
    assert "exposure_s" not in summary(found, 17300.0)


def test_errors_are_as_large_as_their_standard_deviations() -> None:
    """The sum of their squares lies within 99 % of a chi-square of 24; deviations twice or half as large do not."""
    squares = 0.0
    for seed in range(24):
        strips, lit = _strips(np.random.default_rng(seed), np.zeros(4))
        found, _ = _settled(strips, _hypothesis(np.zeros(4)), lit)
        squares += ((found.rows_per_slot - ROWS_PER_SLOT) / found.rows_per_slot_sd) ** 2
    assert 9.9 < squares < 45.6


def test_rows_per_slot_of_a_long_exposure_stay_those_of_the_line() -> None:
    """Many of its slots are wrong, and a fit to these moved the rows by 1 %."""
    strips, lit = _strips(np.random.default_rng(15), np.zeros(4))
    first = replace(_hypothesis(np.zeros(4)), exposure_slots=4.0)
    found, _ = _settled(strips, first, lit)
    assert (found.rows_per_slot, found.rows_per_slot_sd) == (first.rows_per_slot, first.rows_per_slot_sd)
