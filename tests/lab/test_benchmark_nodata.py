"""Pictures without data, and what is counted of them."""

from __future__ import annotations

import numpy as np
import pytest

from rxcli.lab.benchmark.nodata import draw, offenders, packets_of, rows
from rxcli.lab.simulate.no_data import EVEN_KINDS, NO_DATA_KINDS, STRIPED_KINDS, draw_no_data


@pytest.mark.parametrize("kind", NO_DATA_KINDS)
def test_every_kind_is_drawn_and_drawn_again(kind: str) -> None:
    one, again = (draw_no_data(kind, np.random.default_rng(4), 2) for _ in range(2))
    assert one.frames[0].dtype == np.uint8
    assert one.frames[0].std() > 0.5
    assert all(np.array_equal(a, b) for a, b in zip(one.frames, again.frames, strict=True))


def test_switched_light_moves_from_frame_to_frame_and_slats_do_not() -> None:
    """Rows of the frames: those of a lamp are at another place of its period, those of slats are where they were."""

    def likeness(kind: str) -> float:
        first, second = draw_no_data(kind, np.random.default_rng(11), 2).frames
        by_row = [np.diff(frame.astype(np.float64).mean(axis=1)) for frame in (first, second)]
        return float(np.corrcoef(*by_row)[0, 1])

    assert likeness("blinds") > 0.9
    assert likeness("pwm") < 0.8


def test_every_other_picture_is_striped() -> None:
    kinds = [draw(3, number).made.kind for number in range(12)]
    assert set(kinds[::2]) <= set(STRIPED_KINDS)
    assert set(kinds[1::2]) <= set(EVEN_KINDS)


def test_a_picture_is_received_and_counted() -> None:
    record = packets_of({"seed": 2_000_001, "camera": "known", "n_frames": 1})
    assert record["number"] == 1
    assert not record["striped"]
    assert record["confidences"] == []
    gave = {**record, "number": 8, "kind": "pwm", "striped": True, "about": {"duty": 0.3}, "confidences": [0.4, 0.95]}
    last = rows([record, gave])[-1]
    assert (last["n"], last["gave_packets"], last["packets"]) == (2, 1, 2)
    assert (last["packets_0.5"], last["packets_0.9"], last["packets_0.99"]) == (1, 1, 0)
    (offender,) = offenders([record, gave])
    assert (offender["number"], offender["packets"], offender["surest"]) == (8, 2, 0.95)
