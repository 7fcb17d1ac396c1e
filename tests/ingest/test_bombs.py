"""Small files that would fill the memory or take minutes, refused before either; and claims that are not believed."""

from __future__ import annotations

import logging
import struct
import warnings
import zlib
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import av
import cv2
import numpy as np
import pytest
import tifffile
from ingest_files import read_all, write_clip
from PIL import Image

from rxcli.ingest import video
from rxcli.ingest.sniff import check_size


def chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png(width: int, height: int, depth: int, colour: int, *more: bytes) -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(more) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def directory(entries: list[tuple[int, int, int, int]], length: int) -> bytes:
    """A TIFF of one directory, filled up with zeros."""
    body = b"II*\0\x08\0\0\0" + struct.pack("<H", len(entries))
    return (body + b"".join(struct.pack("<HHII", *entry) for entry in entries) + bytes(4)).ljust(length, b"\0")


SQUARE = [(256, 4, 1, 64), (257, 4, 1, 64), (258, 3, 1, 16), (259, 3, 1, 1), (262, 3, 1, 32803), (277, 3, 1, 1)]
MANY = [*SQUARE, *[(273, 4, 200_000, 100)] * 3000, (278, 4, 1, 64), (279, 4, 1, 8192), (50706, 1, 4, 0x401)]
BIG_TIFF = [(256, 4, 1, 15000), (257, 4, 1, 15000), (258, 3, 1, 16), (259, 3, 1, 8), (262, 3, 1, 2)]
BIG_TIFF += [(273, 4, 1, 8), (277, 3, 1, 4), (278, 4, 1, 15000), (279, 4, 1, 100)]

BOMBS = {
    "rgba16.png": (png(20_000, 20_000, 16, 6), "would take"),
    "palette.png": (png(19_000, 19_000, 8, 3), "would take"),
    "zlib.tif": (directory(BIG_TIFF, 4000), "would take"),
    "strips.dng": (directory(MANY, 900_000), "claim more than the file holds"),
    "strips.tif": (directory(MANY, 900_000), "claim more than the file holds"),
    "entries.tif": (directory([(273, 4, 1, 100)] * 60_000, 800_000), "claim more than the file holds"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_before_it_goes_off(tmp_path: Path, name: str) -> None:
    data, reason = BOMBS[name]
    (tmp_path / name).write_bytes(data)
    frames, error = read_all(tmp_path / name)
    assert not frames
    assert reason in str(error)


def test_a_progressive_jpeg_of_many_scans_or_of_giant_size(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    Image.fromarray(np.zeros((64, 64, 3), np.uint8)).save(path, progressive=True)
    data = path.read_bytes()
    assert len(read_all(path)[0]) == 1
    at = data.index(b"\xff\xc2")
    path.write_bytes(data[: at + 5] + struct.pack(">HH", 15_000, 15_000) + data[at + 9 :])
    assert "would take" in str(read_all(path)[1])
    scan = data[data.index(b"\xff\xda") : -2]
    path.write_bytes(data[:-2] + scan * 200 + data[-2:])
    assert "scans" in str(read_all(path)[1])


def test_a_jpeg_of_one_scan_ends_with_it(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    noise = np.random.default_rng(0).integers(0, 255, (256, 256, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path)
    data = path.read_bytes()
    scan = data[data.index(b"\xff\xda") : -2]
    path.write_bytes(data[:-2] + scan * 200 + data[-2:])
    frames, error = read_all(path)
    assert not frames
    assert "more than one scan" in str(error)


def test_an_exif_block_that_claims_a_thousandfold_is_passed_over(tmp_path: Path) -> None:
    block = directory([(0x010F, 2, 900_000, 8)] * 4000, 1_000_000)
    picture = cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes()
    (tmp_path / "a.png").write_bytes(picture[:33] + chunk(b"eXIf", block) + picture[33:])
    [frame], error = read_all(tmp_path / "a.png")
    assert error is None
    assert frame.metadata.make is None


def test_sizes_that_cameras_have_pass() -> None:
    check_size("a 150 MP picture of 16-bit colour", 14204, 10652, 8)
    check_size("a 200 MP phone", 16320, 12240, 1, 60_000_000)


@pytest.mark.parametrize("exposure_s", [4000.0, 100_000.0, 1e-9])
def test_an_exposure_that_no_receiver_can_use_is_a_claim(
    tmp_path: Path, exposure_s: float, caplog: pytest.LogCaptureFixture
) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0x829A] = exposure_s
    Image.fromarray(np.zeros((64, 96), np.uint8)).save(tmp_path / "a.jpg", exif=exif)
    [frame], _ = read_all(tmp_path / "a.jpg")
    assert frame.metadata.exposure_s is None
    [doubt] = frame.metadata.not_believed
    assert doubt.startswith("exposure of ")
    from rxcli.cli.main import run

    with caplog.at_level(logging.WARNING, "rxcli"):
        logging.getLogger("rxcli").addHandler(caplog.handler)
        run(["decode", str(tmp_path / "a.jpg"), "--quiet"])
        logging.getLogger("rxcli").removeHandler(caplog.handler)
    assert f"a.jpg: not believed, and taken as unknown: {doubt}" in caplog.text


@pytest.mark.parametrize("top", [200, 4000, 1 << 20, (1 << 32) - 1])
def test_a_tiff_of_32_bits_is_no_black_picture(tmp_path: Path, top: int) -> None:
    ramp = np.linspace(0, top, 64 * 96).reshape(64, 96).astype(np.uint32)
    tifffile.imwrite(tmp_path / "a.tif", ramp)
    [frame], error = read_all(tmp_path / "a.tif")
    assert error is None
    assert frame.pixels.max() > 0.45 * frame.white
    assert (np.diff(frame.pixels.ravel().astype(int)) >= 0).all()


@pytest.mark.parametrize(
    "values", [[0.0, 1e300, 5e299], [0.0, 1e-320, 5e-321], [np.nan, np.inf, 3.0], [-1e308, 1e308, 0]]
)
def test_a_float_tiff_of_any_numbers_warns_of_nothing(tmp_path: Path, values: list[float]) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.resize(np.array(values), (8, 9)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        [frame], error = read_all(tmp_path / "a.tif")
    assert error is None
    assert frame.pixels.max() == 65535


def test_a_cut_transport_stream_says_so(tmp_path: Path) -> None:
    path = tmp_path / "a.ts"
    write_clip(path)
    frames, error = read_all(path)
    assert error is None
    n_whole = len(frames)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3 // 188 * 188 + 100])
    frames, error = read_all(path)
    assert 0 < len(frames) < n_whole
    assert "breaks off" in str(error)


def test_times_of_years_are_not_believed() -> None:
    codec = SimpleNamespace(framerate=Fraction(30))
    stream = SimpleNamespace(time_base=Fraction(1, 30), codec_context=codec, guessed_rate=None, average_rate=None)
    progress = video._Progress()
    found = [video._time_s(SimpleNamespace(pts=pts), stream, progress) for pts in (60, 90, 1 << 60, -(1 << 60))]
    assert [nominal for _, nominal in found] == [False, False, True, True]
    assert [time_s for time_s, _ in found] == pytest.approx([2.0, 3.0, 3.0 + 1 / 30, 3.0 + 2 / 30])


@pytest.mark.parametrize("first_s", [0, 2_000_000], ids=["later", "at once"])
def test_a_clip_with_times_of_years_says_so(first_s: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("mjpeg", rate=1000)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuvj420p"
        for number, time_s in enumerate((first_s, first_s + 1, 3_000_000)):
            frame = av.VideoFrame.from_ndarray(np.full((64, 96), 9 * number, np.uint8), "gray").reformat(
                format="yuvj420p"
            )
            frame.pts, frame.time_base = 1000 * time_s, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    frames, error = read_all(tmp_path / "a.mkv")
    assert error is None
    assert max(frame.time_s for frame in frames) < 10
    from rxcli.cli.main import run

    run(["decode", str(tmp_path / "a.mkv"), "--quiet"])
    claimed = 2_000_000 if first_s else 3_000_000
    said = capsys.readouterr().err
    assert said.count(f"a.mkv: not believed, and taken as unknown: a frame's time of {claimed:.6g} s") == 1


def test_libraries_keep_their_lines_to_themselves(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    noise = np.random.default_rng(1).integers(0, 255, (64, 96), dtype=np.uint8)
    good = cv2.imencode(".png", noise)[1].tobytes()
    at = good.index(b"IDAT")
    length = int.from_bytes(good[at - 4 : at])
    spoilt = bytearray(good[at + 4 : at + 4 + length])
    spoilt[length // 2] ^= 0xFF
    head, tail = good[: at - 4], good[at + 8 + length :]
    (tmp_path / "a.png").write_bytes(head + chunk(b"IDAT", bytes(spoilt)) + tail)
    (tmp_path / "b.png").write_bytes(head + chunk(b"iCCP", b"x\0\0" + b"no profile") + good[at - 4 :])
    Image.fromarray(noise).save(tmp_path / "c.tif", compression="tiff_lzw")
    data = bytearray((tmp_path / "c.tif").read_bytes())
    data[200:400] = bytes(200)
    (tmp_path / "c.tif").write_bytes(data)
    for name in ("a.png", "b.png", "c.tif"):
        read_all(tmp_path / name)
    assert capfd.readouterr().err == ""
