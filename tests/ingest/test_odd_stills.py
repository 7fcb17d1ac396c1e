"""Stills that are not as their standards ask are read as plain files of the same pixels; damage is still reported."""

import io
import lzma
import re
import struct
import tracemalloc
from pathlib import Path
from types import SimpleNamespace

import imagecodecs
import numpy as np
import odd_stills
import pytest
import tifffile
from ingest_files import BAYER, one_frame, read_all, write_dng
from PIL import Image

from rxcli.ingest import KNOWN_SUFFIXES
from rxcli.ingest.heif import _bytes_a_pixel
from rxcli.ingest.metadata import exif_metadata
from rxcli.types import Metadata

Y, X = np.mgrid[:48, :80]
GREY = (3 * Y + X + 20 * (Y < 10) * (X > 60)).astype(np.uint8)
PICTURE = np.repeat(GREY[:, :, None], 3, axis=2)
JPEGS = odd_stills.odd_jpegs(PICTURE)
PNGS, TIFFS = odd_stills.odd_pngs(PICTURE), odd_stills.odd_tiffs(PICTURE)
ORIENTATIONS, UNCOMMON = odd_stills.orientations(PICTURE), odd_stills.uncommon_jpegs(GREY)
NOISE = np.repeat(np.random.default_rng(4).integers(0, 255, (96, 160, 1), dtype=np.uint8), 3, axis=2)


def written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("name", JPEGS)
def test_jpeg(tmp_path: Path, name: str) -> None:
    odd, plain = (one_frame(written(tmp_path / "a.jpg", data)) for data in JPEGS[name])
    np.testing.assert_array_equal(odd.pixels, plain.pixels)
    assert odd.metadata == plain.metadata


@pytest.mark.parametrize("name", ["no_end", "no_end_progressive", "sampled", "no_end_trailer"])
@pytest.mark.parametrize("kept", [0.5, 0.9])
@pytest.mark.parametrize("end", [b"", b"\xff\xd9", bytes(3000)], ids=["cut", "ended", "filled"])
def test_a_cut_jpeg_still_says_so(tmp_path: Path, name: str, kept: float, end: bytes) -> None:
    data = odd_stills.odd_jpegs(NOISE)[name][0]
    size = data.index(b"SEFH") if "trailer" in name else len(data)
    frames, error = read_all(written(tmp_path / "a.jpg", data[: int(kept * size)] + end))
    assert not frames
    assert ("is damaged" if end == b"\xff\xd9" else "is cut: ") in str(error)


@pytest.mark.parametrize("name", PNGS)
def test_png_with_a_wrong_check_sum_that_decides_no_pixel(
    tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    frame = one_frame(written(tmp_path / "a.png", PNGS[name]))
    np.testing.assert_array_equal(frame.pixels, GREY)
    assert frame.metadata.orientation == (3 if name == "eXIf" else 1)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("name", TIFFS)
def test_tiff(tmp_path: Path, name: str) -> None:
    frame = one_frame(written(tmp_path / "a.tif", TIFFS[name]))
    shown = GREY * (255 / GREY.max()) if frame.linear else GREY
    np.testing.assert_allclose(frame.pixels * (255 / frame.white), shown, atol=2 if name == "jpeg" else 0.5)
    assert frame.linear is name.startswith("float")
    assert frame.metadata.make in (None, "Example")


@pytest.mark.parametrize(("name", "options"), [("a.webp", {"lossless": True}), ("a.webp", {}), ("a.jfif", {})])
def test_orientation_is_that_of_the_exif(tmp_path: Path, name: str, options: dict[str, bool]) -> None:
    exif = odd_stills.exif_bytes(orientation=3)
    Image.fromarray(GREY).save(tmp_path / name, "JPEG" if "jfif" in name else "WEBP", exif=exif, **options)
    frame = one_frame(tmp_path / name)
    assert frame.metadata.orientation == 3
    np.testing.assert_allclose(frame.pixels, GREY, atol=20)


@pytest.mark.parametrize("name", ORIENTATIONS)
def test_orientation_wherever_and_however_it_is_stated(tmp_path: Path, name: str) -> None:
    frame = one_frame(written(tmp_path / name, ORIENTATIONS[name]))
    assert frame.metadata.orientation == 3
    np.testing.assert_allclose(frame.pixels, GREY, atol=20)


def test_exif_goes_before_xmp_and_the_first_before_later_ones() -> None:
    upright, turned = (odd_stills.tiff_header((0x0112, 3, 1, bytes((number, 0, 0, 0)))) for number in (1, 6))
    assert exif_metadata(upright, odd_stills.XMP["attribute"].encode()).orientation == 1
    assert exif_metadata(turned, upright).orientation == 6
    told = odd_stills.xmp('tiff:Model="Phone" exif:ExposureTime="1/24000" exif:FocalLength="52/10">').encode()
    assert exif_metadata(upright, told) == Metadata(model="Phone", exposure_s=1 / 24000, focal_length_mm=5.2)


@pytest.mark.parametrize("name", UNCOMMON)
def test_jpeg_of_many_bits_or_without_loss_or_with_its_height_last(tmp_path: Path, name: str) -> None:
    frame = one_frame(written(tmp_path / "a.jpg", UNCOMMON[name]))
    np.testing.assert_allclose(255.0 * (frame.pixels / frame.white), GREY, atol=8)


@pytest.mark.parametrize("name", UNCOMMON)
def test_an_uncommon_jpeg_that_is_cut_is_refused(tmp_path: Path, name: str) -> None:
    frames, error = read_all(written(tmp_path / "a.jpg", UNCOMMON[name][: 2 * len(UNCOMMON[name]) // 3]))
    assert not frames
    assert re.search("is cut: |decoded as JPEG|header is damaged|80 x 0 pixels", str(error))


@pytest.mark.parametrize("stray", [b"\xef\xbb\xbf", b"\r\n", bytes(16)], ids=["mark", "line", "zeros"])
def test_stray_bytes_before_a_picture(tmp_path: Path, stray: bytes) -> None:
    jpeg, png = JPEGS["icc"][1], PNGS["eXIf"]
    for name, data in (("a.jpg", jpeg), ("a.png", png)):
        plain, odd = (one_frame(written(tmp_path / name, before + data)) for before in (b"", stray))
        np.testing.assert_array_equal(odd.pixels, plain.pixels)
        assert odd.metadata == plain.metadata


@pytest.mark.parametrize("orientation", range(1, 9))
def test_turns_of_avif_and_jpeg_xl(tmp_path: Path, orientation: int) -> None:
    exif, avif, jpeg = odd_stills.exif_bytes(orientation), io.BytesIO(), io.BytesIO()
    Image.fromarray(GREY).save(avif, "AVIF", exif=exif, quality=95)
    Image.fromarray(GREY).save(jpeg, "JPEG", exif=exif, quality=95)
    files = {"a.avif": avif.getvalue(), "b.avif": avif.getvalue().replace(b"ftypavif", b"ftypmif1")}
    for name, data in (files | {"a.jxl": imagecodecs.jpegxl_encode_jpeg(jpeg.getvalue(), usecontainer=True)}).items():
        frame = one_frame(written(tmp_path / name, data))
        assert (frame.metadata.orientation, frame.metadata.make) == (orientation, "Example")
        np.testing.assert_allclose(frame.pixels, GREY, atol=6)


def test_avif_of_several_tiles(tmp_path: Path) -> None:
    luma = np.tile(GREY, (4, 4))
    frame = one_frame(written(tmp_path / "a.avif", odd_stills.tiled_avif(luma)))
    assert np.abs(frame.pixels.astype(int) - luma).mean() < 3


@pytest.mark.parametrize(
    ("pixels", "options"),
    [
        (GREY, {}),
        (PICTURE, {"usecontainer": True}),
        (GREY.astype(np.uint16) * 4, {"bitspersample": 10}),
        (GREY.astype(np.uint16) * 257, {}),
        (GREY / np.float32(255), {}),
        ((GREY / 255).astype(np.float16), {}),
        (np.tile(GREY, (30, 1)), {}),
    ],
    ids=["grey", "boxes", "10 bits", "16 bits", "floats", "short floats", "high"],
)
def test_jpeg_xl(tmp_path: Path, pixels: np.ndarray, options: dict[str, int]) -> None:
    data = imagecodecs.jpegxl_encode(pixels, lossless=True, **options)
    frame = one_frame(written(tmp_path / "a.jxl", data))
    expected = np.tile(GREY, (frame.pixels.shape[0] // len(GREY), 1))
    np.testing.assert_allclose(255.0 * (frame.pixels / frame.white), expected, atol=1)
    _, error = read_all(written(tmp_path / "a.jxl", data[: len(data) // 2]))
    assert "is damaged or cut" in str(error)


def test_jpeg_xl_larger_than_memory_is_refused_before_it_is_unfolded(tmp_path: Path) -> None:
    def bits(*fields: tuple[int, int]) -> bytes:
        number, at = 0, 0
        for value, width in fields:
            number, at = number | value << at, at + width
        return number.to_bytes(32, "little")

    header = bits((0, 1), (3, 2), (59_999, 30), (0, 3), (3, 2), (39_999, 30), (0, 1), (1, 1), (5, 3))
    frames, error = read_all(written(tmp_path / "a.jxl", b"\xff\n" + header))
    assert not frames
    assert "claims 40000 x 60000 pixels" in str(error)


@pytest.mark.parametrize("dtype", [np.float32, np.uint32])
def test_few_samples_far_above_all_others_leave_these_their_levels(tmp_path: Path, dtype: type) -> None:
    light = np.tile(GREY, (4, 4)).astype(dtype) * 1000
    for name, hot in (("plain.tif", 0), ("hot.tif", 5)):
        light[7, :hot] = 4e9
        tifffile.imwrite(tmp_path / name, light)
    plain, hot = (one_frame(tmp_path / name) for name in ("plain.tif", "hot.tif"))
    ratio = hot.pixels[20:].astype(float).mean() / plain.pixels[20:].mean()
    assert 0.2 < ratio <= 1


def test_a_heic_that_is_not_turned_itself_keeps_its_order_and_says_so(tmp_path: Path) -> None:
    pillow_heif = pytest.importorskip("pillow_heif", reason="needs the extra `heic`")
    out, exif = io.BytesIO(), [odd_stills.exif_bytes(orientation) for orientation in (1, 3)]
    pillow_heif.from_pillow(Image.fromarray(PICTURE)).save(out, exif=exif[0])
    frame = one_frame(written(tmp_path / "a.heic", out.getvalue().replace(*exif)))
    assert frame.metadata.orientation == 1
    assert "EXIF orientation 3" in frame.metadata.not_believed[0]


def test_a_heic_of_108_megapixels_fits_in_half_a_gigabyte() -> None:
    file = SimpleNamespace(mode="RGB", has_alpha=False, info={"bit_depth": 8, "chroma": 420})
    assert 12_000 * 9_000 * _bytes_a_pixel(file, is_turned=False) < 0.5e9
    deep = SimpleNamespace(mode="RGB;16", has_alpha=False, info={"bit_depth": 10, "chroma": 420})
    assert 12_000 * 9_000 * _bytes_a_pixel(deep, is_turned=False) < 1.25e9


@pytest.mark.parametrize(
    ("compression", "part", "n_parts", "tile_px", "reason"),
    [
        (8, odd_stills.unfolding(200), 1, 0, "cannot be read"),
        (8, odd_stills.unfolding(40), 10, 0, "cannot be read"),
        (8, odd_stills.unfolding(1), 1, 65520, "would take 4.3 GB"),
        (34925, lzma.compress(bytes(1 << 27), preset=0), 4, 0, None),
        (
            7,
            odd_stills.grey_jpeg(GREY).replace(struct.pack(">HH", *GREY.shape), b"\xff\xd0" * 2),
            1,
            0,
            "a JPEG larger",
        ),
        (34712, b"x", 1, 0, "compression is JPEG2000"),
    ],
)
def test_a_tiff_unfolds_to_its_size_at_most(
    tmp_path: Path, compression: int, part: bytes, n_parts: int, tile_px: int, reason: str | None
) -> None:
    path = written(tmp_path / "a.tif", odd_stills.bomb_tiff(compression, part, n_parts, tile_px))
    one_frame(written(tmp_path / "b.tif", TIFFS["packbits"]))  # imports
    tracemalloc.start()
    frames, error = read_all(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 16e6
    assert reason in str(error) if reason else frames[0].pixels.shape == (1000, 1000)


def test_strips_that_share_their_bytes_are_read_once(tmp_path: Path) -> None:
    data = odd_stills.bomb_tiff(1, bytes(100_000), 500)
    at = data.index(struct.pack("<II", *([100_000] * 2))) - 4 * 500
    shared = data[:at] + data[at : at + 4] * 500 + data[at + 4 * 500 :]
    _, error = read_all(written(tmp_path / "a.tif", shared[: len(data) - 499 * 100_000]))
    assert "claim more than the file holds" in str(error)


def test_a_dng_of_jpeg_xl_is_not_told_to_become_one(tmp_path: Path) -> None:
    path = write_dng(tmp_path / "a.dng", np.full((64, 96), 500, np.uint16), BAYER)
    entry = struct.Struct("<HHIH")
    written(path, path.read_bytes().replace(entry.pack(259, 3, 1, 1), entry.pack(259, 3, 1, 52546)))
    _, error = read_all(path)
    assert "compressed as JPEG XL, which LibRaw does not read; set the camera's RAW files" in str(error)


def test_folders_hold_pictures_of_these_names() -> None:
    assert {".jfif", ".mpo", ".hif"} <= KNOWN_SUFFIXES


def test_collected_files_are_as_their_plain_twin(shared_cases: Path) -> None:
    folder = shared_cases / "stills"
    plain = one_frame(folder / "plain.jpg").pixels
    for path in sorted(folder.iterdir()):
        frame = one_frame(path)
        if path.name == "heic_108mp.heic":
            assert frame.pixels.shape == (9000, 12000)
            continue
        values = frame.pixels / frame.white
        if frame.linear:  # light of a gamma of 2.2, as shares of the brightest
            values = (values / values.max()) ** (1 / 2.2) * plain.max() / 255
        assert np.abs(255 * values - plain).mean() < 4, path.name


def test_collected_files_of_programs_are_as_their_twin(shared_cases: Path) -> None:
    folder = shared_cases / "round5" / "stills"
    twins = [one_frame(folder / name).pixels for name in ("twin.jpg", "twin6.jpg")]
    for path in sorted({*folder.iterdir()} - {*folder.glob("*.sh"), *folder.glob("*.md")}):
        frame = one_frame(path)
        [twin] = [pixels for pixels in twins if pixels.shape == frame.pixels.shape]
        values = frame.pixels / frame.white
        if frame.linear:
            values = np.minimum((values / np.quantile(values, 0.99)) ** (1 / 2.2) * np.quantile(twin, 0.99) / 255, 1)
        assert np.abs(255 * values - twin).mean() < 4, path.name
        assert frame.metadata.orientation == (3 if re.search("orientation|exif", path.name) else 1), path.name
