"""What is no input, would fill the memory, or claims what cannot be: one line with file, reason and next step; never
another exception, never a warning."""

import logging
import os
import random
import struct
import warnings
import zlib
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import simplejpeg
import tifffile
from ingest_files import read_all, write_clip
from mutated_files import make_samples, mutated
from PIL import Image

from rxcli.cli.main import run
from rxcli.errors import ExitCode
from rxcli.ingest.sniff import check_size

NOISE = np.random.default_rng(7).integers(0, 255, (64, 96), dtype=np.uint8)


def jpeg(pixels: np.ndarray) -> bytes:
    return simplejpeg.encode_jpeg(pixels[:, :, None].copy(), colorspace="GRAY", colorsubsampling="Gray")


def png(pixels: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".png", pixels)[1])


def tiff(pixels: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".tif", pixels, [cv2.IMWRITE_TIFF_COMPRESSION, 1])[1])


def chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def claiming_png(width: int, height: int, depth: int, colour: int) -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def claiming_jpeg(data: bytes, frame: bytes, size: int) -> bytes:
    """A JPEG whose frame header, at the marker `frame`, claims `size` rows and columns."""
    at = data.index(frame)
    return data[: at + 5] + struct.pack(">HH", size, size) + data[at + 9 :]


def with_scans(data: bytes) -> bytes:
    """A JPEG with 200 scans more."""
    return data[:-2] + data[data.index(b"\xff\xda") : -2] * 200 + data[-2:]


def directory(entries: list[tuple[int, int, int, int]], length: int) -> bytes:
    """A TIFF of one directory, filled up with zeros."""
    body = b"II*\0\x08\0\0\0" + struct.pack("<H", len(entries))
    return (body + b"".join(struct.pack("<HHII", *entry) for entry in entries) + bytes(4)).ljust(length, b"\0")


SQUARE = [(256, 4, 1, 64), (257, 4, 1, 64), (258, 3, 1, 16), (259, 3, 1, 1), (262, 3, 1, 32803), (277, 3, 1, 1)]
MANY = [*SQUARE, *[(273, 4, 200_000, 100)] * 3000, (278, 4, 1, 64), (279, 4, 1, 8192), (50706, 1, 4, 0x401)]
BIG_TIFF = [(256, 4, 1, 15000), (257, 4, 1, 15000), (258, 3, 1, 16), (259, 3, 1, 8), (262, 3, 1, 2)]
BIG_TIFF += [(273, 4, 1, 8), (277, 3, 1, 4), (278, 4, 1, 15000), (279, 4, 1, 100)]
PROGRESSIVE = bytes(cv2.imencode(".jpg", np.zeros((64, 64, 3), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1])

BAD = {
    "empty.jpg": (b"", "the file is empty"),
    "text.jpg": (b"this is no picture, whatever its name says", "neither a picture nor a clip"),
    "noise.bin": (np.random.default_rng(8).bytes(4000), "neither a picture nor a clip"),
    "zeros.dat": (bytes(5000), "neither a picture nor a clip"),
    "header.jpg": (jpeg(NOISE)[:100], "header is damaged or cut"),
    "half.jpg": (jpeg(NOISE)[: len(jpeg(NOISE)) // 2], "of 64 rows are there"),
    "half.png": (png(NOISE)[:3000], "the PNG is damaged or cut"),
    "bit.png": (png(NOISE)[:2000] + b"\x55\xaa\x55" + png(NOISE)[2003:], "the PNG is damaged or cut ("),
    "half.tif": (tiff(NOISE)[:2000], "the TIFF"),
    "text.mp4": (b"this is no clip", "no clip"),
    "text.dng": (b"this is no RAW file" * 100, "no RAW format that LibRaw knows"),
    "head.heic": (b"\0\0\0\x18ftypheic" + bytes(12), "the HEIC picture is damaged"),
    "head.webp": (b"RIFF\x10\0\0\0WEBPVP8 ", "the picture is damaged"),
    "size.png": (claiming_png(100_000, 100_000, 8, 0), "claims 100000 x 100000 pixels"),
    "size.jpg": (claiming_jpeg(jpeg(NOISE), b"\xff\xc0", 65500), "claims 65500 x 65500 pixels"),
    "rgba16.png": (claiming_png(20_000, 20_000, 16, 6), "would take"),
    "palette.png": (claiming_png(19_000, 19_000, 8, 3), "would take"),
    "zlib.tif": (directory(BIG_TIFF, 4000), "would take"),
    "strips.dng": (directory(MANY, 900_000), "claim more than the file holds"),
    "strips.tif": (directory(MANY, 900_000), "claim more than the file holds"),
    "entries.tif": (directory([(273, 4, 1, 100)] * 60_000, 800_000), "claim more than the file holds"),
    "progressive.jpg": (claiming_jpeg(PROGRESSIVE, b"\xff\xc2", 15_000), "would take"),
    "scans.jpg": (with_scans(PROGRESSIVE), "more than 100 scans"),
    "segments.jpg": (b"\xff\xd8" + b"\xff\xfe\0\2" * 20_000 + PROGRESSIVE[2:], "header is damaged or cut"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_file(tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]) -> None:
    data, reason = BAD[name]
    (tmp_path / name).write_bytes(data)
    frames, error = read_all(tmp_path / name)
    assert not frames
    assert str(error).startswith(f"{tmp_path / name}: ")
    assert reason in str(error)
    assert error.hint
    assert "\n" not in str(error)
    assert error.exit_code == ExitCode.UNREADABLE
    assert capfd.readouterr().err == ""


def test_what_is_no_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"x")
    os.mkfifo(tmp_path / "pipe.jpg")
    (tmp_path / "link.jpg").symlink_to("nowhere.jpg")
    for path, reason in (
        (tmp_path / "nothing.jpg", "no such file"),
        (tmp_path / "file" / "a.jpg", "no such file"),
        (tmp_path, "is a folder"),
        (tmp_path / "pipe.jpg", "is not a regular file"),
        (tmp_path / "link.jpg", "is a link to nowhere.jpg, which is not there"),
        (Path("https://host/a.jpg"), "https://host/a.jpg: is an address, and nothing is fetched"),
        (Path("/dev/null"), "/dev/null: is no V4L2 device"),
        (Path("a\0b"), "cannot be looked at"),
    ):
        assert reason in str(read_all(path)[1])


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_permission(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(jpeg(NOISE))
    (tmp_path / "a.jpg").chmod(0)
    assert "cannot be read (Permission denied)" in str(read_all(tmp_path / "a.jpg")[1])


@pytest.mark.parametrize("pixels", [NOISE[:1, :1], NOISE[:1], NOISE[:, :1], NOISE * 0, NOISE * 0 + 255])
@pytest.mark.parametrize("encode", [jpeg, png, tiff])
def test_tiny_and_even_pictures_are_frames(
    tmp_path: Path, pixels: np.ndarray, encode: Callable[[np.ndarray], bytes]
) -> None:
    (tmp_path / "a.jpg").write_bytes(encode(pixels))
    [frame], error = read_all(tmp_path / "a.jpg")
    assert error is None
    np.testing.assert_allclose(frame.pixels, pixels, atol=30 if pixels.size < NOISE.size else 0)


def test_sizes_that_cameras_have_pass() -> None:
    check_size("a 150 MP picture of 16-bit colour", 14204, 10652, 8)
    check_size("a 200 MP phone", 16320, 12240, 1, 60_000_000)


def test_mutated_files_give_frames_or_one_line(tmp_path: Path) -> None:
    samples = make_samples(tmp_path / "samples", np.repeat(NOISE[:, :, None], 3, axis=2))
    for seed in range(600):
        rng = random.Random(seed)
        path = tmp_path / rng.choice(sorted(samples))
        path.write_bytes(mutated(samples[path.name], rng))
        frames, error = read_all(path)
        assert error is None or "\n" not in str(error)
        for frame in frames:
            assert frame.pixels.ndim == 2
            assert frame.pixels.size
            assert frame.pixels.dtype in (np.uint8, np.uint16)
            assert 1 <= frame.metadata.orientation <= 8
            of = frame.mosaic or frame
            assert of.white > np.max(of.black)


# -- claims that are not believed --------------------------------------------------------------------------------------


def test_an_exif_block_that_claims_a_thousandfold_is_passed_over(tmp_path: Path) -> None:
    block = directory([(0x010F, 2, 900_000, 8)] * 4000, 1_000_000)
    picture = png(np.zeros((8, 8), np.uint8))
    (tmp_path / "a.png").write_bytes(picture[:33] + chunk(b"eXIf", block) + picture[33:])
    [frame], error = read_all(tmp_path / "a.png")
    assert error is None
    assert frame.metadata.make is None


@pytest.mark.parametrize("exposure_s", [4000.0, 1e-9])
def test_an_exposure_that_no_receiver_can_use_is_a_claim(
    tmp_path: Path, exposure_s: float, caplog: pytest.LogCaptureFixture
) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0x829A] = exposure_s
    Image.fromarray(NOISE * 0).save(tmp_path / "a.jpg", exif=exif)
    [frame], _ = read_all(tmp_path / "a.jpg")
    assert frame.metadata.exposure_s is None
    [doubt] = frame.metadata.not_believed
    assert doubt.startswith("exposure of ")
    with caplog.at_level(logging.WARNING, "rxcli"):
        logging.getLogger("rxcli").addHandler(caplog.handler)
        run(["decode", str(tmp_path / "a.jpg"), "--quiet"])
        logging.getLogger("rxcli").removeHandler(caplog.handler)
    assert f"a.jpg: not believed, and taken as unknown: {doubt}" in caplog.text


@pytest.mark.parametrize("top", [200, 4000, 1 << 20, (1 << 32) - 1])
def test_a_tiff_of_32_bits_is_no_black_picture(tmp_path: Path, top: int) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.linspace(0, top, 64 * 96).reshape(64, 96).astype(np.uint32))
    [frame], error = read_all(tmp_path / "a.tif")
    assert error is None
    assert frame.pixels.max() > 0.45 * frame.white
    assert (np.diff(frame.pixels.ravel().astype(int)) >= 0).all()


@pytest.mark.parametrize(
    "values", [[0.0, 1e300, 5e299], [0.0, 1e-320, 5e-321], [np.nan, np.inf, 3.0], [-1e308, 1e308, 0]]
)
def test_a_float_tiff_of_any_numbers_warns_of_nothing(tmp_path: Path, values: list[float]) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.resize(np.array(values), (8, 9)))
    with warnings.catch_warnings(action="error"):
        [frame], error = read_all(tmp_path / "a.tif")
    assert error is None
    assert frame.pixels.max() == 65535


def test_a_cut_transport_stream_says_so(tmp_path: Path) -> None:
    path = tmp_path / "a.ts"
    write_clip(path)
    whole, error = read_all(path)
    assert error is None
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3 // 188 * 188 + 100])
    frames, error = read_all(path)
    assert 0 < len(frames) < len(whole)
    assert "breaks off" in str(error)


@pytest.mark.parametrize("first_s", [0, 2_000_000], ids=["later", "at once"])
def test_a_clip_with_times_of_years_says_so(first_s: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("mjpeg", rate=1000)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuvj420p"
        for time_s in (first_s, first_s + 1, 3_000_000):
            frame = av.VideoFrame.from_ndarray(NOISE, "gray").reformat(format="yuvj420p")
            frame.pts, frame.time_base = 1000 * time_s, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    frames, error = read_all(tmp_path / "a.mkv")
    assert error is None
    assert max(frame.time_s for frame in frames) < 10
    run(["decode", str(tmp_path / "a.mkv"), "--quiet"])
    claimed = 3_000_000 - first_s  # from the first frame
    said = capsys.readouterr().err
    assert said.count(f"a.mkv: not believed, and taken as unknown: a frame's time of {claimed:.6g} s") == 1


def test_libraries_keep_their_lines_to_themselves(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    good = png(NOISE)
    at = good.index(b"IDAT")
    end = at + 4 + int.from_bytes(good[at - 4 : at])
    spoilt = bytearray(good[at + 4 : end])
    spoilt[len(spoilt) // 2] ^= 0xFF
    head = good[: at - 4]
    (tmp_path / "a.png").write_bytes(head + chunk(b"IDAT", bytes(spoilt)) + good[end + 4 :])
    (tmp_path / "b.png").write_bytes(head + chunk(b"iCCP", b"x\0\0" + b"no profile") + good[at - 4 :])
    Image.fromarray(NOISE).save(tmp_path / "c.tif", compression="tiff_lzw")
    data = bytearray((tmp_path / "c.tif").read_bytes())
    data[200:400] = bytes(200)
    (tmp_path / "c.tif").write_bytes(data)
    for name in ("a.png", "b.png", "c.tif"):
        read_all(tmp_path / name)
    assert capfd.readouterr().err == ""
