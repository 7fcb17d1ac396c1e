"""The map of coherent strips with the grid of columns, on pictures drawn here."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.results.maps import column_map
from rxcli.types import Frame

HEIGHT, WIDTH = 1200, 1000


def drawn(light: float) -> NDArray[np.uint8]:
    """Luma of columns 45 pixels wide that send random slots of ten rows, in noise."""
    rng = np.random.default_rng(7)
    sent = np.repeat(rng.integers(0, 2, (HEIGHT // 10, 20)), 10, axis=0)
    u = (np.arange(WIDTH) - 50) / 45
    spread = np.exp(-((u[:, None] - np.arange(20) - 0.5) ** 2) / (2 * 0.45**2)) * ((u > 0) & (u < 20))[:, None]
    luma = 20 + light * sent @ spread.T + rng.normal(0, 3, (HEIGHT, WIDTH))
    return np.clip(luma, 0, 255).astype(np.uint8)


def test_borders_of_the_grid_are_drawn() -> None:
    shown = column_map(Frame(drawn(40.0), "drawn"))
    assert shown is not None
    assert len(shown["grids"][0]["lines"]) >= 15
    assert round(shown["grids"][0]["pitch_px"]) == 45


def test_where_no_grid_stands_out_the_map_says_so() -> None:
    shown = column_map(Frame(drawn(0.0), "drawn"))
    assert shown is not None
    assert shown["grids"] == []
    assert "No grid of columns stands out" in shown["text"]


@pytest.mark.parametrize("shape", [(64, 400), (400, 64)])
def test_tiny_pictures_have_no_map(shape: tuple[int, int]) -> None:
    frame = Frame(np.zeros(shape, np.uint8), "tiny")
    assert column_map(frame) is None
