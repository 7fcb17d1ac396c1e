"""What is no input: one line with file, reason and next step; never another exception, never a warning."""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import simplejpeg
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ingest_files import BAYER, XTRANS, read_all, write_clip, write_dng
from PIL import Image

from rxcli.errors import ExitCode

NOISE = np.random.default_rng(7).integers(0, 255, (64, 96), dtype=np.uint8)


def jpeg(pixels: np.ndarray) -> bytes:
    return simplejpeg.encode_jpeg(pixels[:, :, None].copy(), colorspace="GRAY", colorsubsampling="Gray")


def png(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def tiff(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    tifffile.imwrite(file, pixels)
    return file.getvalue()


def png_bomb() -> bytes:
    """A PNG whose header claims 100,000 x 100,000 pixels."""
    header = b"IHDR" + struct.pack(">IIBBBBB", 100_000, 100_000, 8, 0, 0, 0, 0)
    end = b"IEND"
    chunks = b"".join(struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in (header, end))
    return b"\x89PNG\r\n\x1a\n" + chunks


def jpeg_bomb() -> bytes:
    """A JPEG whose header claims 65,500 x 65,500 pixels."""
    data = bytearray(jpeg(NOISE))
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", 65500, 65500)
    return bytes(data)


BAD = {
    "empty.jpg": (b"", "the file is empty"),
    "text.jpg": (b"this is no picture, whatever its name says", "neither a picture nor a clip"),
    "noise.bin": (np.random.default_rng(8).bytes(4000), "neither a picture nor a clip"),
    "zeros.dat": (bytes(5000), "neither a picture nor a clip"),
    "header.jpg": (jpeg(NOISE)[:100], "header is damaged or cut"),
    "half.jpg": (jpeg(NOISE)[: len(jpeg(NOISE)) // 2], "of 64 rows are there"),
    "half.png": (png(NOISE)[:3000], "the PNG is cut"),
    "bit.png": (png(NOISE)[:2000] + b"\x55\xaa\x55" + png(NOISE)[2003:], "the PNG is damaged"),
    "half.tif": (tiff(NOISE)[:2000], "the TIFF cannot be read"),
    "bomb.png": (png_bomb(), "claims 100000 x 100000 pixels"),
    "bomb.jpg": (jpeg_bomb(), "claims 65500 x 65500 pixels"),
    "text.mp4": (b"this is no clip", "no clip"),
    "text.dng": (b"this is no RAW file" * 100, "no RAW format that LibRaw knows"),
    "head.heic": (b"\0\0\0\x18ftypheic" + bytes(12), "the HEIC picture is damaged"),
    "head.webp": (b"RIFF\x10\0\0\0WEBPVP8 ", "the picture is damaged"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_file(tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]) -> None:
    data, reason = BAD[name]
    (tmp_path / name).write_bytes(data)
    frames, error = read_all(tmp_path / name)
    assert not frames
    assert error is not None
    assert str(error).startswith(f"{tmp_path / name}: ")
    assert reason in str(error)
    assert error.hint
    assert "\n" not in str(error)
    assert error.exit_code == ExitCode.UNREADABLE
    assert capfd.readouterr().err == ""


def test_missing(tmp_path: Path) -> None:
    assert "no such file" in str(read_all(tmp_path / "nothing.jpg")[1])
    (tmp_path / "file").write_bytes(b"x")
    assert "no such file" in str(read_all(tmp_path / "file" / "a.jpg")[1])
    assert "a\\0b" not in str(read_all(Path("a\0b"))[1])


def test_folder_and_pipe(tmp_path: Path) -> None:
    assert "is a folder" in str(read_all(tmp_path)[1])
    os.mkfifo(tmp_path / "pipe.jpg")
    assert "is not a regular file" in str(read_all(tmp_path / "pipe.jpg")[1])


def test_device_that_is_no_camera() -> None:
    assert "/dev/null: is no V4L2 device" in str(read_all(Path("/dev/null"))[1])


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_permission(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(jpeg(NOISE))
    (tmp_path / "a.jpg").chmod(0)
    assert "cannot be read (Permission denied)" in str(read_all(tmp_path / "a.jpg")[1])


@pytest.mark.parametrize("shape", [(1, 1), (1, 96), (64, 1)])
@pytest.mark.parametrize("encode", [jpeg, png, tiff])
def test_tiny_pictures_are_frames(
    tmp_path: Path, shape: tuple[int, int], encode: Callable[[np.ndarray], bytes]
) -> None:
    (tmp_path / "a.jpg").write_bytes(encode(NOISE[: shape[0], : shape[1]]))
    frames, error = read_all(tmp_path / "a.jpg")
    assert error is None
    assert frames[0].pixels.shape == shape


@pytest.mark.parametrize("value", [0, 255])
@pytest.mark.parametrize("encode", [jpeg, png, tiff])
def test_even_pictures_are_frames(tmp_path: Path, value: int, encode: Callable[[np.ndarray], bytes]) -> None:
    (tmp_path / "a.jpg").write_bytes(encode(np.full_like(NOISE, value)))
    frames, error = read_all(tmp_path / "a.jpg")
    assert error is None
    assert (frames[0].pixels == value).all()


# -- fuzz: whatever the bytes, frames or an InputError come out, and nothing else ----------------------------------


@cache
def _valid_files() -> dict[str, bytes]:
    """A small file of every kind, by suffix."""
    import tempfile

    import pillow_heif

    folder = Path(tempfile.mkdtemp(prefix="ingest-"))
    exif = Image.Exif()
    exif[0x0112] = 3
    exif.get_ifd(0x8769)[0x829A] = 0.001
    Image.fromarray(NOISE).save(folder / "a.jpg", exif=exif)
    Image.fromarray(NOISE).save(folder / "a.png", exif=exif)
    Image.fromarray(NOISE).save(folder / "a.tif", tiffinfo={274: 6})
    Image.fromarray(NOISE).save(folder / "b.tif", compression="tiff_lzw")
    Image.fromarray(NOISE).save(folder / "a.webp")
    pillow_heif.from_pillow(Image.fromarray(NOISE).convert("RGB")).save(folder / "a.heic", exif=exif.tobytes())
    mosaic = NOISE.astype(np.uint16) * 10 + 100
    write_dng(folder / "a.dng", mosaic, XTRANS)
    write_dng(folder / "b.dng", mosaic, BAYER)
    write_clip(folder / "a.mp4", container={"movflags": "faststart"})
    write_clip(folder / "a.mkv", "libx265", "yuv420p10le")
    write_clip(folder / "a.avi", "mjpeg", "yuvj420p")
    files = {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    return files


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


def _survives(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    frames, error = read_all(path)
    assert error is None or "\n" not in str(error)
    for frame in frames:
        assert frame.pixels.ndim == 2
        assert frame.pixels.size
        assert frame.pixels.dtype in (np.uint8, np.uint16)
        assert 1 <= frame.metadata.orientation <= 8
        black, white = (max(frame.mosaic.black), frame.mosaic.white) if frame.mosaic else (frame.black, frame.white)
        assert white > black


FUZZ = settings(deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
MAGIC = [b"", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"II*\0", b"MM\0*", b"FUJIFILMCCD-RAW ", b"\0\0\0\x18ftypheic"]
MAGIC += [b"\0\0\0\x18ftypisom", b"\x1a\x45\xdf\xa3", b"RIFF\0\1\0\0AVI LIST", b"\0\0\0\x18ftypcrx ", b"BM", b"IIRO"]


@FUZZ
@given(magic=st.sampled_from(MAGIC), tail=st.binary(max_size=600), suffix=st.sampled_from([".jpg", ".dng", ".mp4", ""]))
def test_random_bytes(folder: Path, magic: bytes, tail: bytes, suffix: str) -> None:
    _survives(folder / f"random{suffix}", magic + tail)


@FUZZ
@given(name=st.sampled_from(sorted(_valid_files())), share=st.floats(0, 1))
def test_cut_files(folder: Path, name: str, share: float) -> None:
    data = _valid_files()[name]
    _survives(folder / name, data[: int(share * len(data))])


@settings(FUZZ, max_examples=300)
@given(
    name=st.sampled_from(sorted(_valid_files())),
    changes=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=30),
    early=st.booleans(),
)
def test_changed_files(folder: Path, name: str, changes: list[tuple[float, int]], early: bool) -> None:
    data = bytearray(_valid_files()[name])
    span = min(len(data), 600) if early else len(data)
    for share, value in changes:
        data[int(share * span)] = value
    _survives(folder / name, bytes(data))
