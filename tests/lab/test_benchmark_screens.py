"""Dark pictures, and screens searched in them."""

from __future__ import annotations

import numpy as np
import pytest

from rxcli.lab.benchmark.screens import rows, scene_of
from rxcli.lab.simulate.dark_pictures import DARK_KINDS, draw_dark_picture


@pytest.mark.parametrize("kind", DARK_KINDS)
def test_dark_pictures_are_dark_but_not_black(kind: str) -> None:
    picture = draw_dark_picture(kind, np.random.default_rng(3), 683, 384)
    assert picture.shape == (384, 683, 3)
    assert picture.dtype == np.uint8
    assert picture.max() > 60
    assert np.mean(picture.max(axis=2) < 40) > 0.1
    again = draw_dark_picture(kind, np.random.default_rng(3), 683, 384)
    assert np.array_equal(picture, again)


def test_scenes_are_dark_half_of_the_time_and_stand_in_the_picture() -> None:
    kinds = [scene_of(5, number)[1] for number in range(30)]
    assert 6 < sum(kind != "photo" for kind in kinds) < 24


def test_rows_count_packets_numbers_and_confidence() -> None:
    one = {"status": "ok", "error_free": 18, "confident": 10, "confident_wrong": 1, "shift": 1, "numbered": True}
    other = {**one, "error_free": 20, "shift": 0}
    records = [{"kind": "night", "searched": one, "given": other}, {"kind": "photo", "searched": other, "given": other}]
    dark, every = rows(records)[-2:]
    assert (dark["searched"], dark["corners_given"], dark["shifted"], dark["numbered_wrong"]) == (18, 20, 1, 1)
    assert (dark["not_found"], dark["of"]) == (0, 1)
    assert every["share"] == pytest.approx(38 / 40)
