"""The grid of columns from the coherence of strips, on pictures drawn here: no side of the screen need show."""

from __future__ import annotations

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
from rxcli.receiver.screen.grid import light_map
from rxcli.receiver.screen.rows import lit_range
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
    if picture == "window":
        return np.where((u > 0.07) & (u < 0.8) & (v > 0.2) & (v < 0.7), 0.9, 0.06).astype(np.float32)
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


@pytest.mark.parametrize("picture", ["white", "letterbox", "blobs"])
def test_where_all_columns_have_light_the_first_is_plain(picture: str) -> None:
    search = found(picture)
    assert np.abs(apart(search)).mean() < 0.1
    assert len(search.numberings) == 1 or search.numberings[1].log_odds < -3


def test_where_the_outer_columns_are_dark_others_are_handed_on() -> None:
    search = found("window")
    assert len(search.numberings) > 1
    assert search.numberings[1].log_odds > -5


def test_corners_follow_from_the_columns_and_the_light() -> None:
    corners = found("white").numberings[0].corners
    assert np.abs(corners[:, 0] - CORNERS[:, 0]).max() < 0.2 * 50
    assert np.abs(corners[:, 1] - CORNERS[:, 1]).max() < 0.05 * 590


def test_columns_without_light_are_told_from_those_with() -> None:
    search = found("window")
    assert search.coherence is not None
    light = light_map(search.coherence, search.numberings[0].grid)
    shift = round(float(np.median(apart(search))))
    number = light.first + np.arange(light.significance.size) - shift
    assert light.significance[(number >= 3) & (number < 14)].min() > 3 * light.significance[number < -1].max(
        initial=1.0
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_picture_without_data_has_no_comb(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = 20 * np.sin(np.arange(HEIGHT) / rng.uniform(1, 6))[:, None]
    still = 100 + 1500 * cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH)), (0, 0), 12)
    luma = still + (rows if seed else 0) + rng.normal(0, 4, still.shape) + rng.normal(0, 1, (HEIGHT, 1))
    found = find_columns(np.clip(luma, 0, 255).astype(np.uint8), LAYOUT)
    assert not [numbering for numbering in found.numberings if numbering.grid.gain > 30]


def test_the_true_sides_agree_with_the_columns_and_others_do_not() -> None:
    luma = draw("blobs")
    assert sides_agree(luma, CORNERS, LAYOUT)
    # Two columns cut off on the right: eighteen would be read as twenty.
    points = np.array([[0.0, 0.0], [0.9, 0.0], [0.9, 1.0], [0.0, 1.0]])
    assert not sides_agree(luma, geometry.screen_to_picture(points, CORNERS, None), LAYOUT)
    assert not sides_agree(luma, CORNERS + np.array([25.0, 0.0]), LAYOUT)


def test_rows_are_left_out_where_bars_are() -> None:
    v = (np.arange(320) + 0.5) / 320 * 2.2 - 0.6
    rng = np.random.default_rng(1)
    for low, high in ((0.0, 1.0), (0.15, 0.85)):
        top, bottom = lit_range(v, 0.5 * ((v > low) & (v < high)) + rng.normal(0, 0.03, v.size))
        assert abs(top - low) < 0.04
        assert abs(bottom - high) < 0.04


def test_likeness_is_the_cosine_of_two_places_light() -> None:
    tables, k = likeness(0.45), np.arange(-8, 9) + 0.5
    for u, distance in ((0.0, 0.5), (0.3, 0.72), (0.5, 1.2)):
        one, other = (np.exp(-((u + side * distance / 2 - k) ** 2) / (2 * 0.45**2)) for side in (-1, 1))
        want = one @ other / np.sqrt((one @ one) * (other @ other))
        got = tables.cosine.ravel()[int(tables.place(np.array(u), np.array(distance)))]
        assert got == pytest.approx(want, abs=0.03)


def test_coherence_of_independent_strips_is_chance() -> None:
    rng = np.random.default_rng(4)
    luma = np.clip(100 + rng.normal(0, 10, (HEIGHT, WIDTH)), 0, 255).astype(np.uint8)
    coherence = measure_coherence(luma)
    pairs = coherence.pairs[:, 10:-60, 5:40]
    assert abs(float(pairs.mean())) < 0.01
    assert float(pairs.std()) == pytest.approx(coherence.n_rows**-0.5, rel=0.3)
    assert not [comb for comb in find_combs(coherence, 0.45) if comb.score > 7]
