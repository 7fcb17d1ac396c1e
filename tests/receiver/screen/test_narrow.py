"""The grid of a hundred columns, of which half are dark, on a picture drawn here."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.receiver.screen import geometry, narrow, waveforms
from rxcli.receiver.screen.coherence import measure_coherence
from rxcli.receiver.screen.columns import ColumnLayout, ColumnSearch, find_columns
from rxcli.receiver.screen.grid import Grid, grid_between
from rxcli.receiver.screen.narrow import shows_narrow_columns
from rxcli.receiver.screen.waveforms import StripLight, predicted_light, refine_by_waveforms, with_light
from rxcli.types import FloatArray

HEIGHT, WIDTH, ROWS_PER_SLOT, COLUMNS = 1120, 1680, 5.0, 100
WIDE, NARROW = ColumnLayout(), ColumnLayout(COLUMNS, 0.5)
CORNERS = np.array([[110.0, 120.0], [1575.0, 150.0], [1560.0, 985.0], [95.0, 950.0]])


@lru_cache(maxsize=2)
def drawn(first: float = 15.0, last: float = 85.0, n_columns: int = COLUMNS) -> NDArray[np.uint8]:
    """Luma of a screen of many columns that shows light between two of a hundred places across."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    seen = np.linalg.inv(geometry.homography(CORNERS)).astype(np.float32)
    below = seen[2, 0] * x + seen[2, 1] * y + seen[2, 2]
    u, v = ((row[0] * x + row[1] * y + row[2]) / below for row in seen[:2])
    sent = rng.integers(0, 2, (int(HEIGHT / ROWS_PER_SLOT) + 2, n_columns + 6)).astype(np.float32)
    now = sent[(np.arange(HEIGHT) / ROWS_PER_SLOT).astype(int)]
    light, own = np.zeros_like(u), np.clip(np.floor(n_columns * u), 0, n_columns - 1).astype(int)
    for beside in (-2, -1, 0, 1, 2):
        spread = np.exp(-((n_columns * u - own - beside - 0.5) ** 2) / (2 * 0.5**2))
        light += spread * np.take_along_axis(now, own + beside + 3, axis=1)
    light *= (100 * u > first) & (100 * u < last) & (v > 0) & (v < 1)
    luma = 110 * light + 12 + rng.normal(0, 4, u.shape) + rng.normal(0, 0.5, (HEIGHT, 1))
    return np.clip(luma, 0, 255).astype(np.uint8)


@lru_cache(maxsize=1)
def search() -> ColumnSearch:
    return find_columns(drawn(), WIDE, NARROW)


def across(numbering_grid_columns: FloatArray) -> FloatArray:
    """How far columns lie from where the true corners put them."""
    u = np.linspace(0.01, 0.99, 11)
    return np.asarray(numbering_grid_columns - COLUMNS * u[:, None])


def test_a_grid_of_a_hundred_columns_is_found_in_a_film_with_bars() -> None:
    found = search()
    assert found.layout == NARROW
    u, v = np.meshgrid(np.linspace(0.01, 0.99, 11), np.linspace(0.1, 0.9, 5), indexing="ij")
    points = geometry.screen_to_picture(np.stack([u, v], axis=-1), CORNERS, None)
    off = across(found.numberings[0].grid.columns_at(points))
    assert np.abs(off - np.round(np.median(off))).max() < 0.35
    # The film lies in the middle, and so do its columns.
    assert abs(np.median(off)) < 0.35


def test_corners_of_a_hundred_columns_follow_from_them() -> None:
    grid = grid_between(CORNERS, COLUMNS, (WIDTH, HEIGHT), None)
    corners = search().numberings[0].corners[0]
    np.testing.assert_allclose(grid.columns_at(corners), [0, 100, 100, 0], atol=0.5)
    np.testing.assert_allclose(corners[:, 1], CORNERS[:, 1], atol=25)


def test_wide_columns_are_not_taken_for_narrow_ones() -> None:
    assert shows_narrow_columns(measure_coherence(drawn()))
    assert not shows_narrow_columns(measure_coherence(drawn(n_columns=20)))


def test_a_picture_without_a_screen_shows_no_narrow_columns() -> None:
    luma = np.random.default_rng(2).normal(60, 8, (HEIGHT, WIDTH)).clip(0, 255).astype(np.uint8)
    assert not find_columns(luma, WIDE, NARROW).numberings
    assert not find_columns(luma, NARROW).numberings


def test_what_blocks_of_columns_explain_is_what_all_columns_explain(monkeypatch: pytest.MonkeyPatch) -> None:
    coherence = measure_coherence(drawn(), n_strips=1000, reach=0.02)
    strips = StripLight.of(coherence, NARROW.sigma, None)
    grid = grid_between(CORNERS, COLUMNS, (WIDTH, HEIGHT), None)
    near = grid.shifted(0.1)
    in_blocks = predicted_light(strips, grid.columns_at(np.stack(np.meshgrid(coherence.x, coherence.y), axis=-1)))
    parts, moved = with_light(strips, grid), refine_by_waveforms(strips, near)
    monkeypatch.setattr(waveforms, "_MANY_COLUMNS", 1000)
    at_once = predicted_light(strips, grid.columns_at(np.stack(np.meshgrid(coherence.x, coherence.y), axis=-1)))
    whole, moved_at_once = with_light(strips, grid), refine_by_waveforms(strips, near)
    assert np.corrcoef(in_blocks.ravel(), at_once.ravel())[0, 1] > 0.9995
    assert parts.explained == pytest.approx(whole.explained, rel=2e-3)
    assert parts.contrast == pytest.approx(whole.contrast, rel=1e-2)
    np.testing.assert_allclose(moved.numbers, moved_at_once.numbers, atol=0.02)


def test_strips_are_compared_with_those_near_them() -> None:
    coherence = measure_coherence(drawn(), n_strips=700, reach=0.02)
    assert coherence.widest * 10 < coherence.x.size
    changes = coherence.changes
    for apart in (0, 1, coherence.widest):
        n = coherence.x.size - apart
        product = (changes[:, :, :n] * changes[:, :, apart:]).mean(axis=1)
        np.testing.assert_allclose(coherence.pairs[:, :n, apart], product, atol=2e-5)
        assert not coherence.pairs[:, n:, apart].any()


def test_a_grid_that_is_none_is_not_followed_through_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    noise = np.random.default_rng(4).normal(60, 8, (HEIGHT, WIDTH)).clip(0, 255).astype(np.uint8)
    asked: list[int] = []
    original = narrow.with_light

    def counted(strips: StripLight, grid: Grid) -> Grid:
        asked.append(strips.x.shape[1])
        return original(strips, grid)

    monkeypatch.setattr(narrow, "with_light", counted)
    coherence, _, grids = narrow.find_narrow_columns(noise, NARROW.sigma)
    assert not grids
    assert max(asked) < 0.7 * coherence.x.size


def test_any_number_of_strips_is_searched() -> None:
    picture = drawn()
    for width in (WIDTH, WIDTH - 2, WIDTH - 15):
        coherence, _, grids = narrow.find_narrow_columns(np.ascontiguousarray(picture[:, :width]), NARROW.sigma)
        assert len(grids) == 1
        parts = narrow._combs_of_parts(coherence, NARROW.sigma)
        assert all(first % 2 == 0 and last <= coherence.x.size for _, first, last in parts)
