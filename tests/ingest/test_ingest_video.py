"""Clips: luma planes, levels, times, orientation, and what is left of a clip that breaks off."""

import gc
import struct
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from ingest_files import HEIGHT, N_FRAMES, RATE, WIDTH, read_all, write_clip

from rxcli.errors import ExitCode
from rxcli.ingest import open_source
from rxcli.types import Metadata

CODECS = [
    ("libx264", "yuv420p", 16, 235),
    ("libx264", "yuvj420p", 0, 255),
    ("libx264", "yuv422p10le", 64, 940),
    ("libx265", "yuv420p", 16, 235),
    ("libx265", "yuv420p10le", 64, 940),
    ("mjpeg", "yuvj422p", 0, 255),
]


@pytest.mark.parametrize("suffix", ["mp4", "mov", "mkv", "avi"])
@pytest.mark.parametrize(("codec", "form", "black", "white"), CODECS, ids=str)
def test_luma_levels_and_times(tmp_path: Path, suffix: str, codec: str, form: str, black: int, white: int) -> None:
    if suffix == "avi" and codec == "libx265":
        pytest.skip("AVI holds no HEVC")
    planes = write_clip(tmp_path / f"a.{suffix}", codec, form, encoder={"bf": "0"})
    frames, error = read_all(tmp_path / f"a.{suffix}")
    assert error is None
    assert [frame.index for frame in frames] == list(range(N_FRAMES))
    steps = np.diff([frame.time_s for frame in frames])
    np.testing.assert_allclose(steps, 1 / RATE, atol=1.1e-3)  # Matroska rounds to milliseconds
    assert {(frame.black, frame.white) for frame in frames} == {(black, white)}
    for frame, plane in zip(frames, planes, strict=True):
        assert frame.pixels.shape == (HEIGHT, WIDTH)
        assert frame.pixels.dtype == (np.uint16 if "10" in form else np.uint8)
        assert np.abs(frame.pixels.astype(float) - plane).mean() < 0.03 * (white - black)


def test_pixels_are_views_that_stay(tmp_path: Path) -> None:
    """The decoder's pool must not reuse a plane that is still looked at."""
    planes = write_clip(tmp_path / "a.mp4", encoder={"qp": "0"})
    frames = [frame.pixels for frame in open_source(tmp_path / "a.mp4")]
    gc.collect()
    assert not any(pixels.flags.owndata or pixels.flags.writeable for pixels in frames)
    for pixels, plane in zip(frames, planes, strict=True):
        np.testing.assert_array_equal(pixels, plane)


@pytest.mark.parametrize(
    ("name", "options", "expected"),
    [
        *(
            (f"{turn}.mp4", {"rotation": turn}, Metadata(orientation=o))
            for turn, o in ((0, 1), (180, 3), (90, 8), (-90, 6))
        ),
        ("a.mkv", {"tags": {"MAKE": "FUJIFILM", "MODEL": "X-S10"}}, Metadata("FUJIFILM", "X-S10")),
    ],
)
def test_camera_and_rotation_are_noted(tmp_path: Path, name: str, options: dict[str, Any], expected: Metadata) -> None:
    write_clip(tmp_path / name, **options)
    frames, _ = read_all(tmp_path / name)
    assert {frame.metadata for frame in frames} == {expected}
    assert frames[0].pixels.shape == (HEIGHT, WIDTH)  # never turned


def gpmf_entry(key: bytes, kind: bytes, data: bytes) -> bytes:
    size = 1 if kind == b"\0" else len(data)
    return struct.pack(">4scBH", key, kind, size, len(data) // size) + data + bytes(-len(data) % 4)


def box(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I4s", len(data) + 8, name) + data


def gpmf(*entries: bytes) -> bytes:
    """A payload of GoPro's metadata: a name, whose length is no multiple of four, and a stream."""
    stream = gpmf_entry(b"STRM", b"\0", b"".join(entries))
    return gpmf_entry(b"DEVC", b"\0", gpmf_entry(b"DVNM", b"c", b"Hero7 Black") + stream)


READOUT = gpmf_entry(b"SROT", b"f", struct.pack(">f", 15.12))


@pytest.mark.parametrize(
    ("in_track", "in_header", "expected"),
    [
        (gpmf(gpmf_entry(b"TSMP", b"L", bytes(4)), READOUT), b"", 15.12e-3),
        (gpmf(), gpmf(READOUT), 15.12e-3),
        (gpmf(), gpmf(), None),
        (gpmf(READOUT)[:-2], b"", None),
        (gpmf(gpmf_entry(b"SROT", b"f", struct.pack(">f", 15e3))), b"", None),
    ],
    ids=["track", "header", "none", "cut", "absurd"],
)
def test_the_readout_that_a_gopro_states(
    tmp_path: Path, in_track: bytes, in_header: bytes, expected: float | None
) -> None:
    path = tmp_path / "a.mp4"
    write_clip(path, payload=in_track)
    if in_header:  # the index is the last box of the file, so that it may grow
        data = path.read_bytes()
        index = data.rindex(b"moov") + 4
        path.write_bytes(data[: index - 8] + box(b"moov", box(b"udta", box(b"GPMF", in_header)) + data[index:]))
    frames, error = read_all(path)
    assert error is None
    assert len(frames) == N_FRAMES
    assert frames[0].metadata.readout_s == (expected and pytest.approx(expected))


LAYOUTS = [
    ("mp4", {"movflags": "faststart"}),
    ("mp4", {"movflags": "frag_keyframe+empty_moov"}),
    ("mov", {"movflags": "faststart"}),
    ("mkv", {}),
    ("avi", {}),
]


@pytest.mark.parametrize("codec", ["libx264", "mjpeg"])
@pytest.mark.parametrize(("suffix", "container"), LAYOUTS, ids=["mp4", "fragments", "mov", "mkv", "avi"])
@pytest.mark.parametrize("share", [0.5, 0.8])
def test_cut_clip_gives_what_is_there(
    tmp_path: Path, suffix: str, container: dict[str, str], codec: str, share: float
) -> None:
    form = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    path = tmp_path / f"a.{suffix}"
    write_clip(path, codec, form, container=container, encoder={"bf": "0", "g": "4"}, noise=True)
    whole, error = read_all(path)
    assert error is None
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    frames, error = read_all(path)
    assert error.exit_code == ExitCode.UNREADABLE
    assert f"breaks off at {frames[-1].time_s:.3f} s" in str(error)
    assert 0.3 * share * N_FRAMES < len(frames) < N_FRAMES
    for frame, original in zip(frames, whole, strict=False):
        np.testing.assert_array_equal(frame.pixels, original.pixels)


def test_clips_without_index_or_pictures(tmp_path: Path) -> None:
    path, sound = tmp_path / "a.mp4", tmp_path / "b.mp4"
    write_clip(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with av.open(str(sound), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    for name, reason in ((path, "its index is missing"), (sound, "b.mp4: no video in it")):
        frames, error = read_all(name)
        assert not frames
        assert reason in str(error)


def test_damaged_frame_is_left_out_and_told(tmp_path: Path) -> None:
    write_clip(tmp_path / "a.avi", "mjpeg", "yuvj420p")
    data = bytearray((tmp_path / "a.avi").read_bytes())
    at = [i for i in range(len(data)) if data[i : i + 3] == b"\xff\xd8\xff"][N_FRAMES // 2]
    data[at + 2 : at + 40] = bytes(38)
    (tmp_path / "a.avi").write_bytes(data)
    frames, error = read_all(tmp_path / "a.avi")
    assert len(frames) == N_FRAMES - 1
    assert "1 frames are damaged, the first after 0.367 s" in str(error)
