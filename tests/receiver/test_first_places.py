"""First frames of a clip agree on columns and camera, or are outvoted."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from rxcli.receiver.clip.acquiring import Place, agreeing
from rxcli.receiver.clip.camera import Located

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
