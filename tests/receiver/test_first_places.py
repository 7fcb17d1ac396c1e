"""First frames of a clip agree on columns and camera, or are outvoted."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from rxcli.receiver.clip.camera import Located
from rxcli.receiver.clip.ends import dark_ends
from rxcli.receiver.clip.window import Place, agreeing
from rxcli.types import Frame

CORNERS = np.array([[100.0, 50.0], [1700.0, 60.0], [1690.0, 950.0], [110.0, 940.0]])


def place(evidence: float, left: float = 0.0, *, rate_hz: float = 8650.0, is_reversed: bool = False) -> Place:
    """What a frame shows, the left side `left` pixels off."""
    context: Any = SimpleNamespace(
        camera=SimpleNamespace(reversed=is_reversed), screens=(SimpleNamespace(columns=20, slot_rate_hz=rate_hz),)
    )
    located = cast(Located, SimpleNamespace(evidence=evidence, context=context))
    return Place(CORNERS + np.array([[left, 30.0], [0, -30.0], [0, 0], [left, 0]]), located)


def test_outlines_with_the_same_columns_outvote_a_surer_one() -> None:
    here, there, squeezed = place(58.0), place(90.0, left=20.0), place(120.0, left=640.0)
    assert agreeing([here, squeezed, there]) == [here, there]
    assert agreeing([here, squeezed]) == [squeezed]


def test_cameras_that_read_slots_in_different_ways_do_not_agree() -> None:
    right, twice, upwards = place(60.0), place(45.0, rate_hz=17300.0), place(45.0, is_reversed=True)
    assert agreeing([twice, right, upwards]) == [right]


def test_a_screen_ends_where_rows_blink_no_more() -> None:
    """An outline that is 9 rows too long at the top and 4 at the bottom, of a picture with texture, in a hand."""
    rng = np.random.default_rng(3)
    texture, n_frames, columns = rng.uniform(60, 200, (240, 160)), 12, 4
    corners = np.array([[8.0, 21.0], [152.0, 21.0], [152.0, 204.0], [8.0, 204.0]])
    shifts = [np.array([k % 3, k % 4], float) for k in range(n_frames)]
    frames = []
    for shift in shifts:
        lit = np.ones((240, 160))
        lit[30:200, 8:152] = rng.uniform(0.3, 1, (17, columns)).repeat(10, axis=0).repeat(36, axis=1)
        moved = np.roll(texture * lit, shift.astype(int)[::-1], axis=(0, 1))
        frames.append(Frame(np.rint(moved).astype(np.uint8), "clip", len(frames), 0.0))
    context: Any = SimpleNamespace(
        camera=SimpleNamespace(lens=None, tone="linear", line_delay_s=1e-5),
        screens=(SimpleNamespace(columns=columns, slot_rate_hz=1e4),),
        sampled_corners=corners,
    )
    top, bottom = dark_ends(frames, shifts, context)
    assert top == pytest.approx(9 + 2, abs=1)
    assert bottom == pytest.approx(4 + 2, abs=1)
