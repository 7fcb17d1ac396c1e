"""Strips of tracked frames show the light that is there."""

import numpy as np
import pytest

from rxcli.receiver.plane.tracked import map_strips, sample_strips
from rxcli.types import Frame, Outlines


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
    np.testing.assert_allclose(light[:, 1:], np.broadcast_to(expected[:, 1:], light[:, 1:].shape), atol=0.012)
