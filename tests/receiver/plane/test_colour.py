"""Colours that blink: red that lags behind the slots is left out."""

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import av
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.ingest import open_source
from rxcli.ingest.jpeg import colours_of as jpeg_colours_of
from rxcli.ingest.luma import BT601, BT709, colours_of, luma_of, without_red
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.plane.colour import in_blinking_colours, in_one_mix, may_lag, red_contrast
from rxcli.receiver.plane.orientation import turned_frame
from rxcli.receiver.plane.read import read_plane
from rxcli.types import Frame, Mosaic
from tests.ingest_files import BAYER, XTRANS

HEIGHT, WIDTH, SLOT = 640, 768, 9


def striped(red_blinks: float, seed: int = 0) -> NDArray[np.uint8]:
    """Stripes of slots over a textured picture in which red blinks with a share of the others' contrast."""
    rng = np.random.default_rng(seed)
    slots = rng.integers(0, 2, (HEIGHT // SLOT + 1, 8)).repeat(SLOT, 0)[:HEIGHT].repeat(WIDTH // 8, 1)
    lit = slots[..., None] * np.array([red_blinks, 1, 1]) + np.array([0.6 * (1 - red_blinks), 0, 0])
    picture = cv2.GaussianBlur(rng.uniform(0.2, 1, (HEIGHT, WIDTH, 3)), (0, 0), 5)
    light = np.clip(lit * picture + 0.002, 0, 1)
    return np.clip(225 * light ** (1 / 2.2) + rng.normal(0, 2, light.shape), 0, 255).astype(np.uint8)


def frame_of(rgb: NDArray[Any]) -> Frame:
    return Frame(luma_of(rgb), "memory", colours=colours_of(rgb))


def mosaic_of(rgb: NDArray[np.uint8], pattern: NDArray[np.uint8]) -> Frame:
    tiled = np.tile(pattern, (HEIGHT // len(pattern) + 1, WIDTH // len(pattern) + 1))[:HEIGHT, :WIDTH]
    light = np.take_along_axis((rgb / 255) ** 2.2, tiled[..., None], axis=2)[..., 0]
    mosaic = Mosaic(pattern, (2.0, 1.0, 1.5), (256.0,) * 3, 4095.0)
    return Frame((256 + 3839 * light).astype(np.uint16), "memory", mosaic=mosaic)


@pytest.mark.parametrize("make", [frame_of, lambda rgb: mosaic_of(rgb, BAYER), lambda rgb: mosaic_of(rgb, XTRANS)])
@pytest.mark.parametrize("red_blinks", [0.1, 1.0])
def test_red_that_lags_is_left_out(make: Any, red_blinks: float) -> None:
    frame = make(striped(red_blinks))
    contrast = red_contrast(frame)
    assert abs(contrast[0] - red_blinks) < 0.25
    cache = FrameCache(frame).in_blinking_colours()
    assert (cache.frame is frame) == (red_blinks == 1)
    assert cache.frame.red_contrast == (None if red_blinks == 1 else contrast)


@pytest.mark.parametrize(("red_blinks", "is_whole_read"), [(1.0, False), (0.1, True)])
def test_the_first_rows_of_a_jpeg_show_that_red_blinks(red_blinks: float, is_whole_read: bool) -> None:
    jpeg = cv2.imencode(".jpg", striped(red_blinks)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
    stored = jpeg_colours_of(jpeg.tobytes())
    first_rows, every = stored.first_rows(0.5), stored.thinned()
    assert 0.4 * len(every) < len(first_rows) < 0.6 * len(every)
    np.testing.assert_array_equal(first_rows, every[: len(first_rows)])
    whole = Mock(side_effect=stored.thinned)
    red_contrast(Frame(np.zeros((8, 8), np.uint8), "memory", colours=replace(stored, thinned=whole)), 0.5)
    assert whole.called == is_whole_read


def test_what_is_left_is_luma_of_green_and_blue() -> None:
    rgb = striped(0.1)
    cache = FrameCache(frame_of(rgb)).in_blinking_colours()
    left = (0.587 * rgb[..., 1] + 0.114 * rgb[..., 2].astype(float)) / 0.701
    assert np.abs(cache.frame.pixels - left).max() <= 1
    # Of a Bayer mosaic whose rows hold red or blue, every row then measures green alone.
    mosaic = in_blinking_colours(mosaic_of(rgb, BAYER), (0.1, 0.01))
    bare = mosaic_of(rgb * np.array([0, 1, 0], np.uint8), BAYER)
    np.testing.assert_allclose(read_plane(mosaic).sums, read_plane(replace(bare, mosaic=mosaic.mosaic)).sums)
    assert np.diff(read_plane(mosaic).sums, axis=0).max() > 0.1


@pytest.mark.parametrize("name", ["noise", "flat", "grey", "small", "no colours", "one row"])
def test_a_picture_that_shows_no_slots_stays_as_it_is(name: str) -> None:
    rng = np.random.default_rng(3)
    frame = {
        "noise": frame_of(rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)),
        "flat": frame_of(np.full((HEIGHT, WIDTH, 3), 90, np.uint8)),
        "grey": frame_of(striped(1.0)[..., 1]),
        "small": frame_of(striped(0.1)[:40, :60]),
        "no colours": Frame(striped(0.1)[..., 1], "memory"),
        "one row": frame_of(striped(0.1)[:1]),
    }[name]
    assert red_contrast(frame) is None
    assert FrameCache(frame).in_blinking_colours().frame is frame


def test_a_file_that_changed_since_keeps_its_luma() -> None:
    frame, other = frame_of(striped(0.1)), frame_of(striped(0.1)[:-16])
    assert in_blinking_colours(replace(frame, colours=other.colours), (0.1, 0.01)).pixels is frame.pixels


def test_dark_slots_decide_whether_colours_are_read() -> None:
    assert may_lag(read_plane(frame_of(striped(0.1))))
    assert not may_lag(read_plane(frame_of(striped(1.0))))
    assert not may_lag(read_plane(frame_of(striped(0.1)[:50])))


def test_colours_turn_with_the_picture() -> None:
    sideways = np.rot90(striped(0.1), -1).copy()
    frame = turned_frame(frame_of(sideways), 1)
    upright = FrameCache(frame).in_blinking_colours().frame
    np.testing.assert_array_equal(upright.pixels, luma_of(striped(0.1), without_red(BT601)))


def test_the_first_frame_with_slots_decides_for_a_clip() -> None:
    dark, lag, plain = (frame_of(rgb) for rgb in (np.zeros((HEIGHT, WIDTH, 3), np.uint8), striped(0.1), striped(1)))
    received = [frame.red_contrast is not None for frame in in_one_mix([dark, lag, plain, dark])]
    assert received == [False, True, True, True]
    assert all(a is b for a, b in zip(in_one_mix([dark, plain, lag]), [dark, plain, lag], strict=True))


def write(path: Path, rgb: NDArray[np.uint8]) -> Path:
    if path.suffix != ".mp4":
        cv2.imwrite(str(path), rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98] if path.suffix == ".jpg" else [])
        return path
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "4"})
        stream.width, stream.height, stream.pix_fmt, stream.codec_context.colorspace = WIDTH, HEIGHT, "yuv420p", 1
        frame = av.VideoFrame.from_ndarray(rgb, "rgb24").reformat(format="yuv420p", dst_colorspace="ITU709")
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize(("name", "error"), [("a.png", 0), ("a.tif", 0), ("a.webp", 12), ("a.jpg", 3), ("a.mp4", 4)])
def test_files_keep_their_colours(tmp_path: Path, name: str, error: float) -> None:
    rgb = striped(0.1)
    (frame,) = open_source(write(tmp_path / name, rgb))
    weights = without_red(BT709 if name == "a.mp4" else BT601)
    left = (frame.colours.without_red() - frame.black) * (255 / (frame.white - frame.black))
    assert np.abs(left - luma_of(rgb, weights)).mean() <= error
    assert red_contrast(frame) == pytest.approx(red_contrast(frame_of(rgb)), abs=0.1)
