"""Maths that stages share, against what it is short for."""

import numpy as np
import pytest

from rxcli.numerics import header_correlation
from rxcli.protocol import HEADER
from rxcli.receiver.light import SlotLight, exposure_shares

FINE = 2000


def _mean_of_slots(slots: np.ndarray, centre: float, exposure: float, beyond: float) -> float:
    """Mean over an exposure, by the middle of many short steps."""
    instants = centre + ((np.arange(FINE) + 0.5) / FINE - 0.5) * exposure
    number = np.floor(instants).astype(int)
    inside = (number >= 0) & (number < slots.size)
    return float(np.where(inside, slots[np.clip(number, 0, slots.size - 1)], beyond).mean())


@pytest.mark.parametrize("exposure", [0.3, 1.0, 2.7])
def test_slots_are_seen_as_their_mean_over_the_exposure(exposure: float) -> None:
    rng = np.random.default_rng(1)
    slots = rng.random((3, 40)).astype(np.float32)
    positions = rng.uniform(-2, 42, (3, 50))
    wanted = [
        [_mean_of_slots(row, centre, exposure, 0.5) for centre in at] for row, at in zip(slots, positions, strict=True)
    ]
    light = SlotLight(slots)
    np.testing.assert_allclose(light.mean_over(positions, exposure), wanted, atol=2e-3)
    alike = light.mean_over(positions[:1], exposure)
    np.testing.assert_array_equal(alike[0], light.mean_over(positions, exposure)[0])
    assert alike.shape == (3, 50)


def test_the_slope_is_the_change_with_time() -> None:
    rng = np.random.default_rng(2)
    light, positions, step = SlotLight(rng.random((2, 30)).astype(np.float32)), rng.uniform(2, 28, (2, 40)), 1e-3
    seen, slope = light.mean_and_slope(positions, 0.8)
    np.testing.assert_array_equal(seen, light.mean_over(positions, 0.8))
    change = (light.mean_over(positions + step / 2, 0.8) - light.mean_over(positions - step / 2, 0.8)) / step
    # Where an edge of the exposure crosses that of a slot within the step, both are right.
    assert (np.abs(change - slope) < 0.02).mean() > 0.95


@pytest.mark.parametrize("exposure", [0.4, 1.5])
def test_shares_of_an_exposure_add_up_to_all_of_it(exposure: float) -> None:
    centre = np.random.default_rng(3).uniform(0, 9, 20)
    share = exposure_shares(centre[:, None], np.arange(-3, 13), exposure)
    np.testing.assert_allclose(share.sum(axis=1), 1.0)
    slots = np.random.default_rng(4).random(16)
    wanted = [_mean_of_slots(slots, c + 3, exposure, 0.0) for c in centre]
    np.testing.assert_allclose(share @ slots, wanted, atol=2e-3)


def test_the_header_is_correlated_by_running_sums() -> None:
    light = np.random.default_rng(5).random((2, 90))
    total = np.pad(np.cumsum(light, axis=1), ((0, 0), (1, 0)))
    template = np.repeat(2.0 * np.array(HEADER) - 1, 3) / (3 * len(HEADER))
    wanted = [np.correlate(row, template, "valid") for row in light]
    np.testing.assert_allclose(header_correlation(total, 3), wanted, atol=1e-12)
