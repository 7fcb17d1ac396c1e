"""The grid of columns from the coherence of strips, on pictures drawn here: no side of the screen need show."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.agreement import sides_agree
from rxcli.receiver.screen.coherence import measure_coherence
from rxcli.receiver.screen.columns import ColumnLayout, ColumnSearch, find_columns
from rxcli.receiver.screen.comb import find_combs, likeness
from rxcli.receiver.screen.drive import explained_with_drive
from rxcli.receiver.screen.grid import grid_between
from rxcli.receiver.screen.numbering import first_columns, light_profile
from rxcli.receiver.screen.rows import lit_range
from rxcli.receiver.screen.waveforms import StripLight, refine_by_waveforms, with_light
from rxcli.types import FloatArray

LAYOUT = ColumnLayout()
HEIGHT, WIDTH, ROWS_PER_SLOT = 1600, 1200, 10.0
#: Tilted, turned, and away from the picture's middle.
CORNERS = np.array([[150.0, 320.0], [1105.0, 290.0], [1130.0, 880.0], [120.0, 850.0]])


def draw(picture: str, *, corners: FloatArray = CORNERS, seed: int = 0, noise: float = 4.0) -> NDArray[np.uint8]:
    """Luma of a screen whose columns send random slots behind a picture, in a dark room, with row noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    seen = np.linalg.inv(geometry.homography(corners)).astype(np.float32)
    below = seen[2, 0] * x + seen[2, 1] * y + seen[2, 2]
    u, v = (
        (seen[0, 0] * x + seen[0, 1] * y + seen[0, 2]) / below,
        (seen[1, 0] * x + seen[1, 1] * y + seen[1, 2]) / below,
    )
    lit = rng.integers(0, 2, (int(HEIGHT / ROWS_PER_SLOT) + 2, 20)).astype(np.float32)
    now = lit[(np.arange(HEIGHT) / ROWS_PER_SLOT).astype(int)]
    light = np.zeros_like(u)
    for column in range(20):
        light += np.exp(-((20 * u - column - 0.5) ** 2) / (2 * 0.45**2)) * now[:, column, None]
    light *= shown(picture, u, v, rng) * ((u > 0) & (u < 1) & (v > 0) & (v < 1))
    luma = 150 * light + 12 + rng.normal(0, noise, u.shape) + rng.normal(0, 0.5, (HEIGHT, 1))
    return np.clip(luma, 0, 255).astype(np.uint8)


def shown(
    picture: str, u: NDArray[np.float32], v: NDArray[np.float32], rng: np.random.Generator
) -> NDArray[np.float32] | float:
    """What a picture lets through of the light."""
    if picture == "white":
        return 1.0
    if picture == "letterbox":
        return ((v > 0.13) & (v < 0.87)).astype(np.float32)
    if picture == "round":
        return (np.hypot((u - 0.5) * 16 / 9, v - 0.5) < 0.88).astype(np.float32)
    if "window" in picture:
        ground = 0.0 if picture == "window on black" else 0.06
        return np.where((u > 0.07) & (u < 0.8) & (v > 0.2) & (v < 0.7), 0.9, ground).astype(np.float32)
    return (0.15 + 0.85 * (np.sin(23 * u + 9 * v) * np.sin(17 * v - 5 * u) > 0)).astype(np.float32)


@lru_cache(maxsize=8)
def found(picture: str) -> ColumnSearch:
    return find_columns(draw(picture), LAYOUT)


def apart(search: ColumnSearch, number: int = 0) -> FloatArray:
    """Columns between a grid that was found and the true one, over the screen."""
    u, v = np.meshgrid(np.linspace(0.02, 0.98, 15), np.linspace(0.02, 0.98, 9), indexing="ij")
    points = geometry.screen_to_picture(np.stack([u, v], axis=-1), CORNERS, None)
    return search.numberings[number].grid.columns_at(points) - 20 * u


@pytest.mark.parametrize("picture", ["white", "letterbox", "round", "window", "blobs"])
def test_the_grid_is_found_whatever_the_picture(picture: str) -> None:
    search = found(picture)
    off = apart(search)
    assert np.abs(off - np.round(np.median(off))).mean() < 0.1
    assert any(round(float(np.median(apart(search, n)))) == 0 for n in range(len(search.numberings)))


@pytest.mark.parametrize("picture", ["white", "letterbox", "blobs", "window"])
def test_where_all_columns_have_light_the_first_is_plain(picture: str) -> None:
    search = found(picture)
    assert np.abs(apart(search)).mean() < 0.1
    assert len(search.numberings) == 1 or search.numberings[1].log_odds < -3


def test_where_the_outer_columns_are_dark_others_are_handed_on() -> None:
    search = found("window on black")
    assert len(search.numberings) > 1
    assert search.numberings[1].log_odds > -5


def test_corners_follow_from_the_columns_and_the_light() -> None:
    corners = found("white").numberings[0].corners[0]
    assert np.abs(corners[:, 0] - CORNERS[:, 0]).max() < 0.2 * 50
    assert np.abs(corners[:, 1] - CORNERS[:, 1]).max() < 0.05 * 590


def test_where_bars_are_other_rows_are_handed_on() -> None:
    tall = [corners[2:, 1].mean() - corners[:2, 1].mean() for corners in found("letterbox").numberings[0].corners]
    true = CORNERS[2:, 1].mean() - CORNERS[:2, 1].mean()
    assert tall[0] == pytest.approx(true, rel=0.05)
    assert min(tall) < 0.9 * true


def strips_of(picture: str) -> StripLight:
    search = found(picture)
    assert search.coherence is not None
    return StripLight.of(search.coherence, LAYOUT.sigma, None)


def test_columns_without_light_are_told_from_those_with() -> None:
    light = light_profile(strips_of("window"), grid_between(CORNERS, 20, (WIDTH, HEIGHT), None))
    inside, outside = (light.place > 3) & (light.place < 14), (light.place < -0.2) | (light.place > 20.2)
    assert light.significance[inside].min() > 2 * light.significance[outside].max()


def test_the_first_column_is_where_light_begins_on_a_border() -> None:
    grid = grid_between(CORNERS, 20, (WIDTH, HEIGHT), None)
    start = first_columns(light_profile(strips_of("letterbox"), grid), grid, 20)
    assert start.first[start.log_odds.argmax()] == 0
    assert np.sort(start.log_odds)[-2] < -3


def test_the_true_grid_explains_more_than_others_and_is_reached_from_near() -> None:
    strips, true = strips_of("blobs"), grid_between(CORNERS, 20, (WIDTH, HEIGHT), None)
    own = with_light(strips, true)
    for factor in (0.8, 0.95, 1.05, 1.3):
        wide = true.shifted(0.0).numbers * np.array([factor, factor, factor, 1, 1, 1])
        assert with_light(strips, replace(true, numbers=wide)).likelihood < own.likelihood
    near = replace(true, numbers=true.numbers * np.array([1, 1.015, 1, 1, 1, 1]) + np.array([0.1, 0, 0.2, 0, 0, 0]))
    off = refine_by_waveforms(strips, near).numbers[:3] - true.numbers[:3]
    assert np.abs(off - np.array([round(off[0]), 0, 0])).max() < 0.3


def lamps(seed: int) -> NDArray[np.uint8]:
    """Luma of a screen whose columns are lit unlike one another, by up to some ten times."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(WIDTH, dtype=np.float64), np.arange(HEIGHT, dtype=np.float64))
    u = grid_between(CORNERS, 20, (WIDTH, HEIGHT), None).columns_at(np.stack([x, y], axis=-1))
    lit = rng.integers(0, 2, (int(HEIGHT / ROWS_PER_SLOT) + 2, 20))[(np.arange(HEIGHT) / ROWS_PER_SLOT).astype(int)]
    drive = np.exp(rng.normal(0, 1.2, 20))
    light = sum(drive[k] * np.exp(-((u - k - 0.5) ** 2) / (2 * 0.45**2)) * lit[:, k, None] for k in range(20))
    light = light * ((u > 0) & (u < 20) & (y > 330) & (y < 850))
    luma = 60 * light + 12 + rng.normal(0, 4, u.shape) + rng.normal(0, 0.5, (HEIGHT, 1))
    return np.clip(luma, 0, 255).astype(np.uint8)


def test_columns_of_unlike_drive_speak_for_the_true_grid_when_their_drive_is_estimated() -> None:
    strips = StripLight.of(measure_coherence(lamps(0)), LAYOUT.sigma, None)
    true = grid_between(CORNERS, 20, (WIDTH, HEIGHT), None)
    plain, driven = [with_light(strips, true).explained], [explained_with_drive(strips, true)]
    for factor in (0.9, 0.95, 1.06):
        numbers = true.numbers * np.array([factor, factor, factor, 1, 1, 1])
        other = refine_by_waveforms(strips, replace(true, numbers=numbers))
        plain.append(other.explained)
        driven.append(explained_with_drive(strips, other))
    assert np.argmax(driven) == 0
    # More is explained of all of them, and most of the true one.
    assert min(np.subtract(driven, plain)) > 0
    assert np.argmax(np.subtract(driven, plain)) == 0


@pytest.mark.parametrize("seed", range(3))
def test_a_picture_without_data_has_no_comb(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = 20 * np.sin(np.arange(HEIGHT) / rng.uniform(1, 6))[:, None]
    still = 100 + 1500 * cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH)), (0, 0), 12)
    luma = still + (rows if seed else 0) + rng.normal(0, 4, still.shape) + rng.normal(0, 1, (HEIGHT, 1))
    found = find_columns(np.clip(luma, 0, 255).astype(np.uint8), LAYOUT)
    assert not found.numberings


def test_the_true_sides_agree_with_the_columns_and_others_do_not() -> None:
    luma = draw("blobs")
    assert sides_agree(luma, CORNERS, LAYOUT)
    # Two columns cut off on the right: eighteen would be read as twenty.
    points = np.array([[0.0, 0.0], [0.9, 0.0], [0.9, 1.0], [0.0, 1.0]])
    assert not sides_agree(luma, geometry.screen_to_picture(points, CORNERS, None), LAYOUT)
    assert not sides_agree(luma, CORNERS + np.array([25.0, 0.0]), LAYOUT)


def test_light_ends_where_bars_begin_and_takes_no_more_than_a_screen() -> None:
    v = (np.arange(320) + 0.5) / 320 * 2.2 - 0.6
    rng = np.random.default_rng(1)
    for low, high in ((0.0, 1.0), (0.15, 0.85)):
        top, bottom = lit_range(v, 0.5 * ((v > low) & (v < high)) + rng.normal(0, 0.03, v.size))
        assert abs(top - low) < 0.04
        assert abs(bottom - high) < 0.04
    top, bottom = lit_range(v, np.full(v.size, 0.5))
    assert bottom - top == pytest.approx(1, abs=0.02)


def test_likeness_is_the_mean_cosine_of_two_places_light() -> None:
    tables, k = likeness(0.45), np.arange(-8, 9) + 0.5
    for distance in (0.5, 0.72, 1.2):
        cosines = []
        for u in np.arange(0, 1, 0.05):
            one, other = (np.exp(-((u + side * distance / 2 - k) ** 2) / (2 * 0.45**2)) for side in (-1, 1))
            cosines.append(one @ other / np.sqrt((one @ one) * (other @ other)))
        step = int(tables.step(np.array(distance)))
        assert tables.mean[step] == pytest.approx(np.mean(cosines), abs=0.01)
        assert tables.harmonic[step] == pytest.approx(
            2 * np.mean(cosines * np.cos(2 * np.pi * np.arange(0, 1, 0.05))), abs=0.02
        )


def test_coherence_of_independent_strips_is_chance() -> None:
    rng = np.random.default_rng(4)
    luma = np.clip(100 + rng.normal(0, 10, (HEIGHT, WIDTH)), 0, 255).astype(np.uint8)
    coherence = measure_coherence(luma)
    pairs = coherence.pairs[:, 10:-60, 5:40]
    assert abs(float(pairs.mean())) < 0.01
    assert float(pairs.std()) == pytest.approx(coherence.n_rows**-0.5, rel=0.3)
    assert not [comb for comb in find_combs(coherence, 0.45) if comb.score > 7]
