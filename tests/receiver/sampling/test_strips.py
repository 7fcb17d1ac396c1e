"""Strips of tracked frames: cells added up by words are the sums of their pixels, and strips show what is there."""

from __future__ import annotations

import numpy as np
import pytest

from rxcli.receiver.sampling.tracked import _sums, map_strips, sample_strips
from rxcli.types import Frame, Outlines


@pytest.mark.parametrize("cell_px", [4, 8, 12, 16, 20, 24, 40, 256])
def test_sums_of_words_are_those_of_pixels(cell_px: int) -> None:
    """White pixels too, which fill every number to the brim; rows in a wider picture, as decoders give them."""
    rng = np.random.default_rng(cell_px)
    pixels = rng.integers(0, 256, (300, 1024), dtype=np.uint8)
    pixels[:9] = 255
    n = 1000 // cell_px
    part = pixels[:, : n * cell_px]
    assert (_sums(part, cell_px) == part.reshape(300, n, cell_px).sum(axis=2)).all()


def outlines(n_columns: int, n_strips: int, strip_px: float, n_rows: int, left: float = 8.0) -> Outlines:
    edges = left + strip_px * np.arange(n_columns * n_strips + 1)
    return Outlines(
        rows=np.arange(10, 10 + n_rows),
        edges_x=np.broadcast_to(edges[:, None], (edges.size, n_rows)).copy(),
        inside=np.ones((n_columns, n_strips, n_rows), bool),
        sensor_row=None,
    )


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("strip_px", [5.0, 13.0, 20.6, 41.0])
def test_strips_show_the_light_at_their_middle(dtype: type[np.uint8] | type[np.uint16], strip_px: float) -> None:
    """A slope of light across: read exactly at the middle of every strip, up to the rounding of pixels."""
    white, n_rows = (200.0, 12) if dtype == np.uint8 else (1000.0, 12)
    where = outlines(3, 2, strip_px, n_rows)
    width = int(where.edges_x.max()) + 40
    slope = (np.arange(width) + 0.5) / width * white
    frame = Frame(np.tile(np.round(slope).astype(dtype), (40, 1)), "a.mp4", 0, black=0.0, white=white)
    strips = map_strips(where, frame, lambda coded: coded)
    middles = (where.edges_x[1:, 0] + where.edges_x[:-1, 0]) / 2 + 0.5
    light = sample_strips(frame, strips)
    assert light.shape == (3, 2, n_rows)
    expected = (middles / width).reshape(3, 2, 1)
    # Cells at the picture's edge are half beyond it.
    np.testing.assert_allclose(light[:, 1:], np.broadcast_to(expected[:, 1:], light[:, 1:].shape), atol=0.012)
