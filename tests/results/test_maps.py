"""The map of coherent strips with the grid of columns, on pictures drawn here."""

from __future__ import annotations

import numpy as np
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


def test_borders_of_the_grid_are_drawn_where_one_stands_out() -> None:
    shown, nothing = (column_map(Frame(drawn(light), "drawn")) for light in (40.0, 0.0))
    assert shown is not None
    assert nothing is not None
    assert len(shown["grids"][0]["lines"]) >= 15
    assert round(shown["grids"][0]["pitch_px"]) == 45
    assert nothing["grids"] == []
    assert "No grid of columns stands out" in nothing["text"]
    assert column_map(Frame(np.zeros((64, 400), np.uint8), "tiny")) is None
