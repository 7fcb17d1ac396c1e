"""Frames without the texture that they have in common."""

from dataclasses import replace

import numpy as np
import pytest

from rxcli.receiver.plane import shift_of_texture, shows_same, without_texture
from rxcli.types import Frame

SLOTS = 1 + 0.2 * np.sign(np.sin(np.arange(120) / 3))


def _frame(x: int = 0, y: int = 0, stripes: bool = False) -> Frame:
    """A picture of blocks, moved to the left and up by some pixels; its light with stripes that stay where they are."""
    blocks = np.kron(np.random.default_rng(2).uniform(0.1, 0.8, (30, 40)), np.ones((6, 6)))[y : y + 120, x : x + 160]
    light = blocks * SLOTS[:, None] if stripes else blocks
    return Frame(np.rint(light * 65535).astype(np.uint16), "clip", 0, 0.0, white=65535.0, linear=True)


@pytest.mark.parametrize("motion", [(0, 0), (8, 4)])
def test_stripes_are_left_of_a_picture_that_moves(motion: tuple[int, int]) -> None:
    light = without_texture(_frame(stripes=True), [_frame(*motion), _frame()], "srgb").pixels[10:-10, 10:-20] / 65535
    changes, expected = np.diff(np.log(light), axis=0), np.diff(np.log(SLOTS[10:-10]))
    assert np.corrcoef(changes.T, expected)[-1, :-1].min() > 0.9


def test_another_picture_is_no_texture_in_common() -> None:
    wall = replace(_frame(), pixels=np.full_like(_frame().pixels, 9000))
    assert shows_same(_frame(stripes=True), without_texture(_frame(stripes=True), [_frame()], "srgb"), "srgb")
    assert not shows_same(wall, without_texture(wall, [_frame(), _frame()], "srgb"), "srgb")


def test_how_far_texture_has_moved() -> None:
    np.testing.assert_allclose(shift_of_texture(_frame(8, 4), _frame(), "srgb"), (8, 4), atol=0.2)
    np.testing.assert_allclose(shift_of_texture(_frame(), _frame(stripes=True), "srgb"), 0, atol=0.1)
