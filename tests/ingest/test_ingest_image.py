"""Pictures of every kind: luma as stored, levels, metadata, orientation."""

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
import tifffile
from ingest_files import one_frame
from numpy.typing import NDArray
from PIL import Image

from rxcli.errors import InputError
from rxcli.ingest.metadata import exif_metadata, jpeg_metadata
from rxcli.types import Metadata

HEIGHT, WIDTH = 48, 80


@pytest.fixture
def grey() -> NDArray[np.uint8]:
    """A smooth picture without any symmetry."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return (3 * y + x + 20 * (y < 10) * (x > 60)).astype(np.uint8)


def exif_bytes(orientation: int = 1) -> bytes:
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0112] = "FUJIFILM", "X-S10\0", orientation
    inner = exif.get_ifd(0x8769)
    inner[0x829A], inner[0x8827], inner[0x920A], inner[0xA405] = 1 / 32000, 3200, 35.0, 53
    inner[0xA434] = "XF35mmF1.4 R"
    return exif.tobytes()


EXPECTED = Metadata("FUJIFILM", "X-S10", "XF35mmF1.4 R", 1 / 32000, 3200.0, 35.0, 53.0, 3)


class TestJpeg:
    def test_luma_is_that_of_the_file(self, tmp_path: Path, grey: NDArray[np.uint8]) -> None:
        rgb = np.stack([grey, 255 - grey, grey // 2], axis=2)
        data = simplejpeg.encode_jpeg(rgb, quality=95, colorsubsampling="422")
        (tmp_path / "a.jpg").write_bytes(data)
        frame = one_frame(tmp_path / "a.jpg")
        reference = Image.open(io.BytesIO(data))
        reference.draft("L", None)
        np.testing.assert_array_equal(frame.pixels, np.asarray(reference))
        assert (frame.black, frame.white, frame.linear, frame.mosaic) == (0, 255, False, None)

    def test_exif_is_read_and_never_applied(self, tmp_path: Path, grey: NDArray[np.uint8]) -> None:
        Image.fromarray(grey).save(tmp_path / "a.jpg", quality=98, exif=exif_bytes(orientation=3))
        frame = one_frame(tmp_path / "a.jpg")
        assert np.abs(frame.pixels.astype(int) - grey).max() < 8
        assert frame.metadata == EXPECTED

    def test_without_huffman_tables(self, tmp_path: Path, grey: NDArray[np.uint8]) -> None:
        """Motion-JPEG cameras leave the standard tables out."""
        data = simplejpeg.encode_jpeg(grey[:, :, None].copy(), quality=95, colorspace="GRAY", colorsubsampling="Gray")
        at = data.index(b"\xff\xc4")
        while data[at : at + 2] == b"\xff\xc4":
            data = data[:at] + data[at + 2 + struct.unpack_from(">H", data, at + 2)[0] :]
        (tmp_path / "a.jpg").write_bytes(data)
        assert np.abs(one_frame(tmp_path / "a.jpg").pixels.astype(int) - grey).max() < 12

    def test_padding_before_the_end_is_harmless(self, tmp_path: Path, grey: NDArray[np.uint8]) -> None:
        data = simplejpeg.encode_jpeg(grey[:, :, None].copy(), colorspace="GRAY", colorsubsampling="Gray")
        (tmp_path / "a.jpg").write_bytes(data[:-2] + b"\0" * 40 + data[-2:] + b"trailer of some phone")
        assert one_frame(tmp_path / "a.jpg").pixels.shape == (HEIGHT, WIDTH)


class TestPngAndTiff:
    @pytest.mark.parametrize("suffix", ["png", "tif"])
    @pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
    @pytest.mark.parametrize("colour", [False, True])
    def test_depths_and_colours(
        self, tmp_path: Path, grey: NDArray[np.uint8], suffix: str, dtype: type, colour: bool
    ) -> None:
        scale = 257 if dtype == np.uint16 else 1
        pixels = grey.astype(dtype) * dtype(scale)
        if colour:
            pixels = np.stack([pixels, pixels // 2, pixels // 4], axis=2)
        path = tmp_path / f"a.{suffix}"
        _write(path, pixels)
        frame = one_frame(path)
        expected = pixels @ np.array([0.299, 0.587, 0.114]) if colour else pixels
        assert frame.pixels.dtype == dtype
        assert frame.white == np.iinfo(dtype).max
        np.testing.assert_allclose(frame.pixels, expected, rtol=0, atol=2)

    @pytest.mark.parametrize("compression", [None, "tiff_lzw", "tiff_adobe_deflate"])
    @pytest.mark.parametrize("orientation", [1, 3, 6])
    def test_tiff_is_never_turned(
        self, tmp_path: Path, grey: NDArray[np.uint8], compression: str | None, orientation: int
    ) -> None:
        Image.fromarray(grey).save(tmp_path / "a.tif", compression=compression, tiffinfo={274: orientation})
        frame = one_frame(tmp_path / "a.tif")
        np.testing.assert_array_equal(frame.pixels, grey)
        assert frame.metadata.orientation == orientation

    def test_float_tiff_is_linear_light(self, tmp_path: Path, grey: NDArray[np.uint8]) -> None:
        light = grey.astype(np.float32) / 1000
        light[0, 0] = np.nan
        tifffile.imwrite(tmp_path / "a.tif", light)
        frame = one_frame(tmp_path / "a.tif")
        assert frame.linear
        assert frame.pixels[0, 0] == 0
        np.testing.assert_allclose(frame.pixels[1:] / 65535, light[1:] / light[1:].max(), atol=1e-5)

    def test_exif_of_a_png_under_another_name(self, tmp_path: Path, grey: NDArray[np.uint8]) -> None:
        Image.fromarray(grey).save(tmp_path / "a.jpg", "PNG", exif=exif_bytes(orientation=3))
        frame = one_frame(tmp_path / "a.jpg")
        np.testing.assert_array_equal(frame.pixels, grey)
        assert frame.metadata == EXPECTED

    @pytest.mark.parametrize(
        ("name", "mode", "options"),
        [
            ("a.png", "P", {}),
            ("a.png", "RGBA", {}),
            ("a.tif", "P", {"compression": "tiff_lzw"}),
            ("a.bmp", "RGB", {}),  # what messengers send
            ("a.webp", "RGB", {"lossless": True}),
        ],
    )
    def test_other_modes_and_formats(
        self, tmp_path: Path, grey: NDArray[np.uint8], name: str, mode: str, options: dict[str, Any]
    ) -> None:
        Image.fromarray(grey).convert(mode).save(tmp_path / name, **options)
        np.testing.assert_array_equal(one_frame(tmp_path / name).pixels, grey)


class TestHeif:
    @pytest.mark.parametrize("orientation", range(1, 9))
    def test_turn_is_undone(self, tmp_path: Path, grey: NDArray[np.uint8], orientation: int) -> None:
        pillow_heif = pytest.importorskip("pillow_heif", reason="needs the extra `heic`")
        exif = exif_bytes(orientation)
        pillow_heif.from_pillow(Image.fromarray(grey).convert("RGB")).save(tmp_path / "a.heic", exif=exif, quality=99)
        frame = one_frame(tmp_path / "a.heic")
        assert frame.pixels.shape == grey.shape
        assert np.abs(frame.pixels.astype(int) - grey).mean() < 3
        assert frame.metadata.orientation == orientation
        assert frame.metadata.model == "X-S10"

    def test_missing_extra(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(__import__("sys").modules, "pillow_heif", None)
        (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic" + b"\0" * 40)
        with pytest.raises(InputError, match=r"a\.heic: HEIC needs pillow-heif; run `pip install pillow-heif`"):
            one_frame(tmp_path / "a.heic")


@pytest.mark.parametrize(
    ("main", "inner", "expected"),
    [
        ({0x0112: 77, 0x010F: "\0\0"}, {0x829A: (0, 0), 0x8827: 0}, Metadata()),
        ({}, {0x8827: 65535, 0x8832: 102400}, Metadata(iso=102400)),
    ],
    ids=["nonsense is unknown", "ISO beyond 16 bits"],
)
def test_odd_values(main: dict[int, Any], inner: dict[int, Any], expected: Metadata) -> None:
    exif = Image.Exif()
    exif.update(main)
    exif.get_ifd(0x8769).update(inner)
    block = exif.tobytes()
    assert jpeg_metadata(b"\xff\xd8\xff\xe1" + struct.pack(">H", len(block) + 2) + block + b"\xff\xda") == expected


def _write(path: Path, pixels: NDArray[np.generic]) -> None:
    if path.suffix == ".tif":
        tifffile.imwrite(path, pixels, photometric="rgb" if pixels.ndim == 3 else "minisblack")
        return
    import cv2

    cv2.imwrite(str(path), pixels[:, :, ::-1] if pixels.ndim == 3 else pixels)


def test_exif_whose_second_directory_has_no_pointer_after_it_is_read() -> None:
    """Some cameras end the EXIF directory where its values begin: what stands there is no next directory."""
    entry = struct.Struct(">HHII")
    first = b"".join(
        [
            entry.pack(0x0112, 3, 1, 3 << 16),  # orientation 3
            entry.pack(0x8769, 4, 1, 38),  # the EXIF directory
        ]
    )
    second = struct.pack(">H", 1) + entry.pack(0x829A, 5, 1, 52)  # the exposure's value follows at once
    exif = b"MM\0*\0\0\0\x08" + struct.pack(">H", 2) + first + bytes(4) + second + struct.pack(">II", 1, 24000)
    found = exif_metadata(exif)
    assert found.orientation == 3
    assert found.exposure_s == pytest.approx(1 / 24000)


@pytest.mark.parametrize(
    ("kind", "value", "exposure_s"),
    [
        (5, struct.pack("<II", 1, 24000), 1 / 24000),
        (5, struct.pack("<II", 1, 0), None),
        (10, struct.pack("<ii", 1, 500), 1 / 500),
        (12, struct.pack("<d", 0.002), 0.002),
        (5, b"\1\0", None),
    ],
)
def test_exposures_of_every_type_of_number(kind: int, value: bytes, exposure_s: float | None) -> None:
    """Fractions, signed ones too, floats; what is infinite or cut is unknown."""
    exif = b"II*\0\x08\0\0\0" + struct.pack("<HHHIII", 1, 0x829A, kind, 1, 26, 0) + value
    assert exif_metadata(exif).exposure_s == exposure_s
