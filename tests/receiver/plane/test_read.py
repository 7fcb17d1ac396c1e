"""The plane: sums of pixels, read once."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rxcli.receiver.frame import cache
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.plane.read import read_plane, turned
from rxcli.receiver.plane.rows import sample_rows
from rxcli.receiver.screen.geometry import column_outlines
from rxcli.types import Frame, Lens, LightPlane, Outlines

CORNERS = np.array([[10.0, 5.0], [229.0, 7.0], [228.0, 112.0], [11.0, 114.0]])
CORRECTED = Lens(np.array([[240.0, 0, 120], [0, 240, 60], [0, 0, 1]]), np.array([0.1, -0.1, 0, 0, 0]), corrected=True)


def frame_of(width: int = 240, height: int = 120, dtype: Any = np.uint8, seed: int = 0) -> Frame:
    values = np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, (height, width), dtype)
    return Frame(values, "memory", white=float(np.iinfo(dtype).max))


def outlines(lens: Lens | None = None, shift: float = 0.0) -> Outlines:
    return column_outlines(CORNERS + np.array([shift, 0.0]), 4, 3, 240, 120, lens)


@pytest.mark.parametrize(("width", "cell_px"), [(240, 1), (3001, 2), (6243, 4), (12001, 8), (24001, 16)])
def test_sums_of_8_bits_are_exact(width: int, cell_px: int) -> None:
    frame = frame_of(width, 7)
    plane = read_plane(frame)
    n = width // cell_px
    assert (plane.cell_px, plane.width, plane.height) == (cell_px, width, 7)
    expected = np.cumsum(frame.pixels[:, : n * cell_px].astype(np.int64), axis=1)[:, cell_px - 1 :: cell_px]
    np.testing.assert_array_equal(plane.sums[1:], expected.T)
    assert not plane.sums[0].any()


@pytest.mark.parametrize("width", [240, 6243, 12001])
def test_sums_of_16_bits_are_near(width: int) -> None:
    frame = frame_of(width, 7, np.uint16)
    means = np.diff(read_plane(frame).sums, axis=0) / read_plane(frame).cell_px
    n, cell_px = means.shape[0], read_plane(frame).cell_px
    expected = frame.pixels[:, : n * cell_px].reshape(7, n, cell_px).mean(axis=2)
    np.testing.assert_allclose(means, expected.T, atol=10)


def test_pixels_that_do_not_lie_side_by_side_are_read_alike() -> None:
    frame = frame_of(3100, 70)
    mirrored = replace(frame, pixels=frame.pixels[:, ::-1])
    same = replace(frame, pixels=np.ascontiguousarray(frame.pixels[:, ::-1]))
    np.testing.assert_array_equal(read_plane(mirrored).sums, read_plane(same).sums)


@pytest.mark.parametrize(("width", "height", "cell_px"), [(300, 30, 1), (3600, 2406, 3)])
def test_a_turned_plane_is_that_of_the_turned_picture(width: int, height: int, cell_px: int) -> None:
    light = np.random.default_rng(1).integers(0, 255, (height, width // 4), np.uint8).repeat(4, axis=1)
    upright = read_plane(Frame(light, "memory"))
    plane, size = turned(upright), upright.cell_px
    assert (plane.height, plane.width, plane.cell_px) == (width // size, height // size, cell_px)
    expected = light[:, ::size].T.reshape(width // size, -1, cell_px * size).mean(axis=2)
    np.testing.assert_allclose(np.diff(plane.sums, axis=0).T / cell_px, expected, atol=0.01)


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Grows by one whenever pixels are read or an outline is sampled."""
    seen: list[str] = []

    def counted_read(frame: Frame) -> LightPlane:
        seen.append("read")
        return read_plane(frame)

    def counted_sample(*args: Any) -> Any:
        seen.append("sample")
        return sample_rows(*args)

    monkeypatch.setattr(cache, "read_plane", counted_read)
    monkeypatch.setattr(cache, "sample_rows", counted_sample)
    return seen


def test_an_outline_is_sampled_once_and_its_sensor_rows_are_those_asked_for(reads: list[str]) -> None:
    known = FrameCache(frame_of())
    first = known.sample(outlines(), "srgb")
    bent = outlines(lens=CORRECTED)
    again = known.sample(bent, "srgb")
    assert reads == ["read", "sample"]
    assert first.sensor_row is None
    np.testing.assert_array_equal(again.light, first.light)
    np.testing.assert_array_equal(again.sensor_row, bent.sensor_row)


def test_what_is_elsewhere_or_of_another_tone_is_sampled_from_the_same_plane(reads: list[str]) -> None:
    known = FrameCache(frame_of())
    known.sample(outlines(), "srgb")
    known.sample(outlines(shift=1.0), "srgb")
    known.sample(outlines(), "linear")
    assert reads == ["read", "sample", "sample", "sample"]
