"""Frames without the texture that they have in common."""

from dataclasses import replace

import numpy as np
import pytest

from rxcli.receiver.plane.texture import CommonTexture, shows_same
from rxcli.types import Frame

SLOTS = 1 + 0.2 * np.sign(np.sin(np.arange(120) / 3))


def _frame(x: int = 0, y: int = 0, stripes: bool = False) -> Frame:
    """A picture of blocks, moved to the left and up by some pixels; its light with stripes that stay where they are."""
    blocks = np.kron(np.random.default_rng(2).uniform(0.1, 0.8, (30, 40)), np.ones((6, 6)))[y : y + 120, x : x + 160]
    light = blocks * SLOTS[:, None] if stripes else blocks
    return Frame(np.rint(light * 65535).astype(np.uint16), "clip", 0, 0.0, white=65535.0, linear=True)


def _flat(*frames: Frame, number: int = 0) -> Frame:
    return CommonTexture(frames, "srgb").removed_from(number)


@pytest.mark.parametrize(("motion", "number"), [((0, 0), 0), ((0, 0), 2), ((8, 4), 0), ((8, 4), 2)])
def test_stripes_are_left_of_a_picture_that_moves(motion: tuple[int, int], number: int) -> None:
    frames = [_frame(), _frame(*motion), _frame()]
    frames[number] = _frame(stripes=True)
    light = _flat(*frames, number=number).pixels[10:-10, 10:-20] / 65535
    changes, expected = np.diff(np.log(light), axis=0), np.diff(np.log(SLOTS[10:-10]))
    assert np.corrcoef(changes.T, expected)[-1, :-1].min() > 0.9


def test_another_picture_is_no_texture_in_common() -> None:
    wall = replace(_frame(), pixels=np.full_like(_frame().pixels, 9000))
    assert shows_same(_frame(stripes=True), _flat(_frame(stripes=True), _frame()), "srgb")
    assert not shows_same(wall, _flat(wall, _frame(), _frame()), "srgb")


def test_how_far_texture_has_moved() -> None:
    shifts = CommonTexture((_frame(8, 4), _frame(), _frame(8, 4, stripes=True)), "srgb").shifts
    np.testing.assert_allclose(shifts, [(0, 0), (8, 4), (0, 0)], atol=0.2)
