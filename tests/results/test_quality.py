"""How well a column is driven, of light whose levels, edges, jitter and noise are known."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rxcli.results.inspection import PER_SLOT, Trace
from rxcli.results.quality import Quality, qualities

SLOT_S, EXPOSURE, FINE = 5e-5, 0.6, 200


def driven(jitter: float = 0.0, noise: float = 0.02, dark: float = 0.1, n_slots: int = 600) -> Quality:
    """A column of random slots; jitter in slots, levels relative to a lit slot."""
    rng = np.random.default_rng(1)
    slots = rng.integers(0, 2, n_slots)
    edges = np.arange(n_slots) + jitter * rng.standard_normal(n_slots)
    fine = (np.arange(n_slots * FINE) + 0.5) / FINE

    def mean_over_exposure(lit: Any) -> Any:
        total = np.concatenate([[0], np.cumsum(lit)]) / FINE
        start = np.arange((n_slots - 1) * PER_SLOT) * FINE // PER_SLOT
        return (total[start + round(EXPOSURE * FINE)] - total[start]) / EXPOSURE

    share = mean_over_exposure(slots[fine.astype(int)])
    shifted = mean_over_exposure(slots[np.clip(np.searchsorted(edges, fine) - 1, 0, None)])
    light = dark + (1 - dark) * shifted + noise * rng.standard_normal(share.size)
    column: Any = SimpleNamespace(column=3)
    trace = Trace(column, np.arange(share.size), 0.5 * light, share, share, light, np.empty(0), np.empty((0, 2)))
    known: Any = SimpleNamespace(traces=[trace])
    [found] = qualities(known, SLOT_S)
    return found


def test_levels_and_edges_of_an_ideal_switch() -> None:
    found = driven()
    assert found.column == 3
    assert found.contrast == pytest.approx(0.9 / 1.1, rel=0.02)
    assert found.brightness == pytest.approx(0.5, rel=0.02)
    assert found.snr_db == pytest.approx(20 * np.log10(0.9 / 0.02), abs=0.7)
    assert found.rise_s == pytest.approx(0.8 * EXPOSURE * SLOT_S, rel=0.1)
    assert found.fall_s == pytest.approx(0.8 * EXPOSURE * SLOT_S, rel=0.1)
    assert found.dark_after_lit == pytest.approx(0.1, abs=0.02)
    assert found.jitter_s < 0.02 * SLOT_S


def test_jitter_is_that_of_the_edges() -> None:
    assert driven(jitter=0.08).jitter_s == pytest.approx(0.08 * SLOT_S, rel=0.25)


def test_what_too_few_slots_show_is_left_open() -> None:
    found = driven(n_slots=4)
    assert np.isnan(found.rise_s)
    assert np.isnan(found.jitter_s)
