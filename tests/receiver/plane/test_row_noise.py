"""Row noise: found where there is much, straight or bent by lens correction, and taken out of light and colours."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.ingest.luma import colours_of, luma_of
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.plane import row_noise
from rxcli.receiver.plane.read import read_plane
from rxcli.receiver.plane.row_noise import find_row_noise
from rxcli.receiver.plane.rows import tone_to_light
from rxcli.types import Colours, Frame, Metadata

N_ROWS, N_PIXELS, ROWS_PER_SLOT = 1200, 960, 8
#: k1 of a lens whose distortion was taken out, for a focal length of one picture height.
BENT = 0.15


def picture(noise: float, k1: float = 0.0, red_blinks: float = 1.0, same_slots: bool = False) -> NDArray[np.uint8]:
    """Twenty columns of random slots on a picture that brightens to the right, beside a black part; RGB, sRGB."""
    rng = np.random.default_rng(5)
    x, y = (np.arange(N_PIXELS) + 0.5) / N_PIXELS - 0.5, (np.arange(N_ROWS)[:, None] + 0.5) / N_ROWS - 0.5
    rows = np.clip(np.arange(N_ROWS)[:, None] + N_ROWS * k1 * y * x * x, 0, N_ROWS - 1)
    slots = rng.random((N_ROWS // ROWS_PER_SLOT + 1, 20)) < 0.5
    slots[:, 1:] = slots[:, :1] if same_slots else slots[:, 1:]
    column = np.minimum(np.arange(N_PIXELS) * 20 // (N_PIXELS - 60), 19)
    lit = slots[(rows // ROWS_PER_SLOT).astype(int), column] * np.linspace(0.02, 0.12, N_PIXELS)
    lit[:, -60:] = 0
    level, offset = lit.mean(axis=0), np.interp(rows, np.arange(N_ROWS), rng.normal(0, noise, N_ROWS)) + 0.04
    own = rng.normal(0, 0.003, (3, *lit.shape))
    light = (
        np.stack([level + red_blinks * (lit - level) + own[0], lit + own[1], lit + own[2]], axis=2) + offset[..., None]
    )
    encoded = np.where(light > 0.0031308, 1.055 * np.maximum(light, 1e-6) ** (1 / 2.4) - 0.055, 12.92 * light)
    return np.asarray(np.clip(255 * encoded + 0.5, 0, 255), np.uint8)


def frame_of(rgb: NDArray[np.uint8]) -> Frame:
    """A photograph with its colours."""
    colours = colours_of(rgb)
    assert isinstance(colours, Colours)
    return Frame(pixels=luma_of(rgb), source="drawn", metadata=Metadata(), colours=colours)


def changes(cache: FrameCache) -> NDArray[np.floating]:
    """Light of cells of the screen against that two rows before."""
    cells = np.diff(cache.plane.sums[:: 12 // cache.plane.cell_px], axis=0)[:-6] / 12
    light = tone_to_light("srgb", cells / 255.0)
    return light[:, 2:] - light[:, :-2]


@pytest.mark.parametrize("k1", [0.0, BENT, -BENT])
def test_noise_is_taken_out_along_bent_rows(k1: float) -> None:
    """What is left is near the picture that was drawn without."""
    cache, plain = FrameCache(frame_of(picture(0.015, k1))), FrameCache(frame_of(picture(0.0, k1)))
    noisy = FrameCache(cache.frame)
    noisy.__dict__["plane"] = read_plane(cache.frame)
    left, before = (np.square(changes(each) - changes(plain)).mean() for each in (cache, noisy))
    assert left < 0.5 * before
    outlines = cache.outlines(np.array([[9.0, 9], [890, 9], [890, 1190], [9, 1190]]), 20, None)
    assert [each.sample(outlines, "srgb").has_row_noise for each in (cache, plain)] == [True, False]
    noise = find_row_noise(read_plane(cache.frame))
    # The rows are bent as far as they were drawn.
    x = y = 0.45
    bend = N_ROWS * noise.curvature @ [x**2 * y, x**4 * y, x**2 * y**3, x**2, x * y]
    assert bend == pytest.approx(N_ROWS * k1 * x**2 * y, abs=1.0)


def test_noise_is_found_as_large_as_it_was_drawn() -> None:
    """Cells that follow it halfway in one octave and wholly in the next would keep a part of each."""
    noise = find_row_noise(read_plane(frame_of(picture(0.015))))
    assert noise.light.std() == pytest.approx(0.015, rel=0.15)


@pytest.mark.parametrize("same_slots", [False, True])
def test_slots_are_no_noise(same_slots: bool) -> None:
    """Nor are those that all columns share."""
    assert find_row_noise(read_plane(frame_of(picture(0.0, same_slots=same_slots)))) is None


def test_slots_that_columns_share_are_told_without_a_search_for_bends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(row_noise, "_curvature", lambda *_: pytest.fail("rows were bent"))
    exposed = cv2.blur(picture(0.0, same_slots=True), (1, ROWS_PER_SLOT))
    assert find_row_noise(read_plane(frame_of(np.asarray(exposed, np.uint8)))) is None


@pytest.mark.parametrize("red_blinks", [0.1, 1.0])
def test_red_that_lags_is_told_from_row_noise(red_blinks: float) -> None:
    """Noise of a row is in all colours, as slots are where red does not lag."""
    cache = FrameCache(frame_of(picture(0.02, BENT, red_blinks))).in_blinking_colours()
    assert (cache.frame.red_contrast is not None) == (red_blinks < 1)
