"""The map of coherent strips with the grid of columns, on pictures drawn here."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.profiles import ScreenProfile, load_profile
from rxcli.results.cameras import Reception
from rxcli.results.maps import column_map
from rxcli.types import Frame, FrameResult

HEIGHT, WIDTH = 1200, 1000


def drawn(light: float) -> NDArray[np.uint8]:
    """Luma of columns 45 pixels wide that send random slots of ten rows, in noise."""
    rng = np.random.default_rng(7)
    sent = np.repeat(rng.integers(0, 2, (HEIGHT // 10, 20)), 10, axis=0)
    u = (np.arange(WIDTH) - 50) / 45
    spread = np.exp(-((u[:, None] - np.arange(20) - 0.5) ** 2) / (2 * 0.45**2)) * ((u > 0) & (u < 20))[:, None]
    luma = 20 + light * sent @ spread.T + rng.normal(0, 3, (HEIGHT, WIDTH))
    return np.clip(luma, 0, 255).astype(np.uint8)


def test_borders_of_the_columns_are_drawn_where_a_screen_was_found() -> None:
    screen, corners = (
        load_profile("paper-17k3", ScreenProfile),
        np.array([[50, 0], [950, 0], [950, 1199], [50, 1199.0]]),
    )
    frame, nothing = Frame(drawn(40.0), "drawn"), FrameResult("drawn", 0, 0.0, "no_screen")
    shown = column_map(Reception(frame, replace(nothing, status="ok", corners=corners), screen, None))
    missing = column_map(Reception(frame, nothing, None, None))
    tiny = Frame(np.zeros((64, 400), np.uint8), "tiny")
    [grid] = shown["grids"]
    assert len(grid["lines"]) == 21
    assert grid["pitch_px"] == pytest.approx(45)
    np.testing.assert_allclose([line[0, 0] for line in grid["lines"]], 0.64 * (50 + 45 * np.arange(21)), atol=0.1)
    assert missing["grids"] == []
    assert "No grid of columns stands out" in missing["text"]
    assert shown["jpeg"] == missing["jpeg"]
    assert column_map(Reception(tiny, nothing, None, None)) is None
