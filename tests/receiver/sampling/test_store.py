"""Row profiles that were read already."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rxcli.receiver import sampling
from rxcli.receiver.sampling import RowStore, store
from rxcli.receiver.screen.geometry import column_outlines
from rxcli.types import Frame, Lens, Outlines, RowProfiles

CORNERS = np.array([[10.0, 5.0], [229.0, 7.0], [228.0, 112.0], [11.0, 114.0]])
CORRECTED = Lens(np.array([[240.0, 0, 120], [0, 240, 60], [0, 0, 1]]), np.array([0.1, -0.1, 0, 0, 0]), corrected=True)


def _frame(seed: int = 0) -> Frame:
    return Frame(np.random.default_rng(seed).integers(0, 255, (120, 240), np.uint8), "memory")


def _outlines(columns: slice | None = None, lens: Lens | None = None, shift: float = 0.0) -> Outlines:
    return column_outlines(CORNERS + np.array([shift, 0.0]), 4, 3, 240, 120, lens, columns)


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Grows by one whenever pixels are read."""
    seen: list[str] = []

    def counted(frame: Frame, *rest: Any, **options: Any) -> RowProfiles:
        seen.append(frame.source)
        return sampling.sample_rows(frame, *rest, **options)

    monkeypatch.setattr(store, "sample_rows", counted)
    return seen


def test_an_outline_is_read_once_and_its_sensor_rows_are_those_asked_for(reads: list[str]) -> None:
    frame, rows = _frame(), RowStore()
    first = rows.sample(frame, _outlines(), "srgb")
    bent = _outlines(lens=CORRECTED)
    again = rows.sample(frame, bent, "srgb", noise=(1.0, 2.0))
    assert len(reads) == 1
    assert first.sensor_row is None
    np.testing.assert_array_equal(again.light, first.light)
    np.testing.assert_array_equal(again.sensor_row, bent.sensor_row)
    assert (again.noise_floor, again.noise_slope) == (1.0, 2.0)


def test_some_columns_are_part_of_what_was_read(reads: list[str]) -> None:
    frame, rows = _frame(), RowStore()
    whole = rows.sample(frame, _outlines(), "srgb")
    part = rows.sample(frame, _outlines(slice(1, 3)), "srgb", noise=(1.0, 2.0), first_column=1)
    assert len(reads) == 1
    np.testing.assert_array_equal(part.light, whole.light[1:3])
    fresh = sampling.sample_rows(frame, _outlines(slice(1, 3)), "srgb", noise=(1.0, 2.0))
    np.testing.assert_allclose(part.light, fresh.light, atol=2e-3)


def test_what_is_elsewhere_or_otherwise_is_read_anew(reads: list[str]) -> None:
    frame, rows = _frame(), RowStore()
    rows.sample(frame, _outlines(), "srgb")
    rows.sample(frame, _outlines(shift=1.0), "srgb")
    rows.sample(frame, _outlines(), "linear")
    rows.sample(frame, _outlines(), "srgb", quick=True)
    assert len(reads) == 4


def test_another_frame_is_read_and_the_one_before_forgotten(reads: list[str]) -> None:
    one, other, rows = _frame(0), replace(_frame(1), source="other"), RowStore()
    light = [rows.sample(frame, _outlines(), "srgb").light for frame in (one, other, one)]
    assert reads == ["memory", "other", "memory"]
    np.testing.assert_array_equal(light[0], light[2])
    assert np.abs(light[0] - light[1]).max() > 0.01
