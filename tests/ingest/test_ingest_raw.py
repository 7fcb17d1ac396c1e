"""RAW files: the sensor's mosaic, its crop, pattern, levels and gains; nothing demosaiced, nothing turned."""

import gc
import struct
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tifffile
from ingest_files import BAYER, XTRANS, one_frame, write_dng
from numpy.typing import NDArray
from PIL import Image

from rxcli.errors import InputError
from rxcli.ingest.metadata import raw_metadata
from rxcli.ingest.raw import _mosaic, default_crop
from rxcli.types import Frame, Mosaic

HEIGHT, WIDTH = 300, 400


@pytest.fixture
def noise() -> NDArray[np.uint16]:
    return np.random.default_rng(2).integers(90, 4000, (HEIGHT, WIDTH), dtype=np.uint16)


def mosaic_of(frame: Frame) -> Mosaic:
    assert frame.mosaic is not None
    return frame.mosaic


@pytest.mark.parametrize("pattern", [BAYER, XTRANS], ids=["bayer", "xtrans"])
class TestMosaic:
    def test_values_levels_and_gains(
        self, tmp_path: Path, noise: NDArray[np.uint16], pattern: NDArray[np.uint8]
    ) -> None:
        frame = one_frame(write_dng(tmp_path / "a.dng", noise, pattern, (274, "H", 1, 3, True)))
        mosaic = mosaic_of(frame)
        gc.collect()  # the pixels outlive the decoder
        np.testing.assert_array_equal(frame.pixels, noise)
        assert not frame.pixels.flags.owndata
        assert not frame.pixels.flags.writeable
        assert frame.metadata.orientation == 3  # noted, not applied
        np.testing.assert_array_equal(mosaic.pattern, pattern)
        assert mosaic.black == (100, 100, 100)
        assert mosaic.white == 4000
        assert mosaic.gains == pytest.approx((1 / 0.55, 1, 1 / 0.65))
        assert frame.metadata.exposure_s == pytest.approx(1 / 32000)
        assert (frame.metadata.make, frame.metadata.model) == ("Synthetic", "cam")

    @pytest.mark.parametrize("active", [(0, 0, 290, 390), (4, 6, 290, 390)])
    @pytest.mark.parametrize("crop", [None, (6, 8, 370, 260), (7, 5, 301, 203)])
    def test_margins_and_default_crop(
        self,
        tmp_path: Path,
        noise: NDArray[np.uint16],
        pattern: NDArray[np.uint8],
        active: tuple[int, int, int, int],
        crop: tuple[int, int, int, int] | None,
    ) -> None:
        more: list[tuple[Any, ...]] = [(50829, "I", 4, active, True)]
        top, left, bottom, right = active
        if crop:
            more += [(50719, "I", 2, crop[:2], True), (50720, "I", 2, crop[2:], True)]
            top, left = top + crop[1], left + crop[0]
            bottom, right = top + crop[3], left + crop[2]
        if pattern.shape == (2, 2):  # LibRaw moves an odd crop of a Bayer sensor inwards, to a whole tile
            top, left = top + top % 2, left + left % 2
        frame = one_frame(write_dng(tmp_path / "a.dng", noise, pattern, *more))
        np.testing.assert_array_equal(frame.pixels, noise[top:bottom, left:right])
        on_sensor = np.roll(pattern, active[:2], (0, 1))  # a DNG's pattern starts at the active area
        expected = np.roll(on_sensor, (-top, -left), (0, 1))
        np.testing.assert_array_equal(mosaic_of(frame).pattern, expected)


def test_linear_dng_gives_green(tmp_path: Path, noise: NDArray[np.uint16]) -> None:
    rgb = np.stack([noise, noise // 2 + 200, noise // 4 + 300], axis=2)
    tags = [(50706, "B", 4, b"\x01\x04\0\0", True), (50708, "s", 0, "Synthetic cam", True)]
    tags += [(50714, "H", 3, (100,) * 3, True), (50717, "I", 3, (4000,) * 3, True)]
    tifffile.imwrite(tmp_path / "a.dng", rgb, photometric=34892, planarconfig=1, extratags=tags, metadata=None)
    frame = one_frame(tmp_path / "a.dng")
    assert frame.mosaic is None
    assert frame.linear
    np.testing.assert_array_equal(frame.pixels, rgb[:, :, 1])
    assert (frame.black, frame.white) == (100, 4000)


@pytest.mark.parametrize("is_dng", [True, False])
def test_content_decides_and_not_the_name(tmp_path: Path, noise: NDArray[np.uint16], is_dng: bool) -> None:
    path = tmp_path / ("a.jpg" if is_dng else "a.dng")
    if is_dng:
        write_dng(tmp_path / "b.dng", noise, XTRANS).rename(path)
    else:
        tifffile.imwrite(path, noise, metadata=None)
    frame = one_frame(path)
    assert (frame.mosaic is not None) == is_dng
    np.testing.assert_array_equal(frame.pixels, noise)


def test_cut_file(tmp_path: Path, noise: NDArray[np.uint16]) -> None:
    path = write_dng(tmp_path / "a.dng", noise, XTRANS)
    size = path.stat().st_size
    path.write_bytes(path.read_bytes()[: size // 2])
    with pytest.raises(InputError, match=rf"a\.dng: the RAW file is cut: {size // 2} of at least {size} bytes"):
        one_frame(path)


@pytest.mark.parametrize(
    ("crop", "expected"),
    [
        ((13, 6, 4160, 6240), (13, 6, 4160, 6240)),
        ((13, 6, 4160, 0), (5, 0, 4176, 6252)),
        ((13, 65535, 4160, 6240), (5, 0, 4176, 6252)),
        ((13, 6, 4170, 6240), (5, 0, 4176, 6252)),
    ],
)
def test_a_crop_that_is_nonsense_means_the_active_area(crop: tuple[int, ...], expected: tuple[int, ...]) -> None:
    """The geometry of the X-S10, as LibRaw gives it."""
    names = ("crop_top_margin", "crop_left_margin", "crop_height", "crop_width")
    active = {"top_margin": 5, "left_margin": 0, "height": 4176, "width": 6252}
    assert default_crop(SimpleNamespace(**active, **dict(zip(names, crop, strict=True)))) == expected


def _raf(exif: bytes, cfa: tuple[int, int] = (0, 0)) -> bytes:
    jpeg = b"\xff\xd8\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + b"\xff\xda\xff\xd9"
    head = b"FUJIFILMCCD-RAW 0201FF159502X-S10".ljust(84, b"\0")
    return head + struct.pack(">II", 160, len(jpeg)) + b"\0" * 8 + struct.pack(">II", *cfa) + b"\0" * 52 + jpeg


class TestMetadataOfRaw:
    def test_raf(self, tmp_path: Path) -> None:
        exif = Image.Exif()
        exif[0x010F], exif[0x0110], exif[0x0112] = "FUJIFILM", "X-S10", 3
        exif.get_ifd(0x8769)[0x829A] = 1 / 32000
        (tmp_path / "a.raf").write_bytes(_raf(exif.tobytes()))
        metadata = raw_metadata(tmp_path / "a.raf")
        assert (metadata.make, metadata.model, metadata.orientation) == ("FUJIFILM", "X-S10", 3)
        assert metadata.exposure_s == pytest.approx(1 / 32000)

    def test_raf_length(self, tmp_path: Path) -> None:
        (tmp_path / "a.raf").write_bytes(_raf(b"", cfa=(1000, 50_000_000)))
        with pytest.raises(InputError, match="cut: 170 of at least 50001000 bytes"):
            one_frame(tmp_path / "a.raf")

    @pytest.mark.parametrize("wrap", [lambda b: b"IIRO" + b[4:], lambda b: b"IIU\0" + b[4:]], ids=["orf", "rw2"])
    def test_tiff_with_another_magic_number(self, tmp_path: Path, wrap: Callable[[bytes], bytes]) -> None:
        exif = Image.Exif()
        exif.endian = "<"
        exif[0x010F], exif[0x0110] = "OM Digital", "OM-1"
        (tmp_path / "a.orf").write_bytes(wrap(exif.tobytes().removeprefix(b"Exif\0\0")))
        assert raw_metadata(tmp_path / "a.orf").model == "OM-1"


def test_a_real_file_whole_and_cut(shared_real: Path, tmp_path: Path) -> None:
    path = shared_real / "raw/_DSC2164.ARW"
    frame = one_frame(path)
    mosaic, metadata = mosaic_of(frame), frame.metadata
    assert frame.pixels.shape == (3448, 5168)
    np.testing.assert_array_equal(mosaic.pattern, BAYER)
    assert mosaic.black == (512, 512, 512)
    assert (metadata.make, metadata.model, metadata.lens) == ("SONY", "ILCE-7RM3", "E 55-210mm F4.5-6.3 OSS")
    assert (metadata.iso, metadata.exposure_s) == (3200, pytest.approx(1 / 640))
    assert (metadata.focal_length_mm, metadata.focal_length_35mm) == (129, 193)
    (tmp_path / "a.arw").write_bytes(path.read_bytes()[:9_000_000])
    with pytest.raises(InputError, match="the RAW file is cut"):
        one_frame(tmp_path / "a.arw")


def test_a_capture_with_an_xtrans_mosaic(shared_captures: Path) -> None:
    frame = one_frame(shared_captures / "xs10_flower_34k6.dng")
    mosaic = mosaic_of(frame)
    assert frame.pixels.shape == (4160, 6240)
    np.testing.assert_array_equal(mosaic.pattern, XTRANS)
    assert (mosaic.black, mosaic.white) == ((1022, 1022, 1022), 16383)
    assert frame.metadata.model == "xs10"


@pytest.mark.parametrize(
    ("tags", "reason"),
    [
        ([(50719, "I", 2, (0, 0), True), (50720, "I", 2, (9, 200), True)], "the picture is 9 x 200 pixels"),
        ([(50714, "H", 1, 65535, True)], "a black level of 65535"),
    ],
)
def test_changed_tags_are_refused(
    tags: list[tuple[Any, ...]], reason: str, tmp_path: Path, noise: NDArray[np.uint16]
) -> None:
    """They ended in internal errors of the receiver."""
    with pytest.raises(InputError, match=reason):
        one_frame(write_dng(tmp_path / "a.dng", noise, BAYER, *tags))


@pytest.mark.parametrize(
    ("names", "channels"), [(b"RGB", (0, 1, 2, 3)), (b"RGRG", (0, 1, 2, 3)), (b"RGBG", (0, 1, 2, 7))]
)
def test_colours_that_a_file_does_not_name_are_refused(names: bytes, channels: tuple[int, ...]) -> None:
    raw = SimpleNamespace(
        raw_color=lambda y, x: channels[2 * (y % 2) + x % 2],
        color_desc=names,
        black_level_per_channel=[0] * 4,
        white_level=4000,
        camera_white_level_per_channel=None,
    )
    with pytest.raises(InputError, match="colours"):
        _mosaic(raw, 0, 0, Path("a.dng"))
