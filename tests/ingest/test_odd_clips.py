"""Clips as cameras, recorders and programs write them, not as the book says: every whole frame, and no other."""

import struct
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
import simplejpeg
from av.stream import Disposition
from ingest_files import HEIGHT, N_FRAMES, RATE, WIDTH, read_all, write_clip, write_palette_clip, write_sizes
from numpy.typing import NDArray

from rxcli.ingest import video
from rxcli.ingest.times import FrameTimes

Planes = list[NDArray[Any]]


def changed(path: Path, change: Callable[[bytes], bytes]) -> None:
    path.write_bytes(change(path.read_bytes()))


def remuxed(source: Path, path: Path, change: Callable[[int, av.Packet], bool]) -> None:
    """Copy the packets of a clip, those for which `change` is true."""
    with av.open(str(source)) as found, av.open(str(path), "w") as made:
        stream = made.add_stream_from_template(found.streams.video[0])
        for number, packet in enumerate(packet for packet in found.demux(video=0) if packet.size):
            if change(number, packet):
                packet.stream = stream
                made.mux(packet)


def tagged(path: Path) -> Planes:
    planes = write_clip(path, tags={"title": "12345678", "MODEL": "X-S10"})
    changed(path, lambda data: data.replace(b"12345678", "行车记录".encode("gbk")))
    return planes


def with_another_stream_first(
    path: Path, size: int = 64, n_frames: int = 1, disposition: Disposition = Disposition.attached_pic
) -> Planes:
    clip = path.with_name("clip.mp4")
    planes = write_clip(clip)
    with av.open(str(clip)) as found, av.open(str(path), "w") as made:
        first = made.add_stream("mjpeg", rate=RATE)
        first.width, first.height, first.pix_fmt, first.disposition = size, size, "yuvj420p", disposition
        second = made.add_stream_from_template(found.streams.video[0])
        for number in range(n_frames):
            picture = av.VideoFrame(size, size, "yuvj420p")
            picture.pts = number
            made.mux(first.encode(picture))
        for packet in found.demux(video=0):
            if packet.size:
                packet.stream = second
                made.mux(packet)
    return planes


def with_dropped_frames(path: Path) -> Planes:
    """Chunks of 0 bytes before frame 0, after frame 5 and at the end."""
    planes = write_clip(path, "mjpeg", "yuvj420p")
    data = path.read_bytes()
    chunks = [at for at in range(len(data)) if data[at : at + 4] == b"00dc" and data[at + 8 : at + 10] == b"\xff\xd8"]
    for at in (data.index(b"idx1"), chunks[6], chunks[0]):
        data = data[:at] + b"00dc\0\0\0\0" + data[at:]
    out = bytearray(data[: data.rindex(b"idx1")])
    for place in (4, out.index(b"movi") - 4):
        out[place : place + 4] = struct.pack("<I", len(out) - place - 4)
    at = out.index(b"strh") + 40
    out[at : at + 4] = struct.pack("<I", N_FRAMES + 3)
    path.write_bytes(out)
    return planes


def pictures(n_frames: int = N_FRAMES, height: int = HEIGHT, width: int = WIDTH) -> Planes:
    rng = np.random.default_rng(2)
    shape = (n_frames, height // 8, 1)
    return list(rng.integers(16, 236, shape, dtype=np.uint8).repeat(8, 1).repeat(width, 2))


def with_palette(path: Path, is_bottom_up: bool) -> Planes:
    planes = pictures()
    write_palette_clip(path, planes, is_bottom_up)
    return planes


def jpeg(pixels: NDArray[Any]) -> bytes:
    return simplejpeg.encode_jpeg(np.ascontiguousarray(pixels[..., None]), 98, "GRAY", "Gray")


def jpegs_in_a_row(path: Path, in_parts: bool = False) -> Planes:
    planes = pictures()
    pieces = list(map(jpeg, planes))
    if in_parts:
        head = b"--next\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n"
        pieces = [head % len(piece) + piece + b"\r\n" for piece in pieces]
    path.write_bytes(b"".join(pieces))
    return planes


def joined(path: Path, codec: str) -> Planes:
    planes = write_clip(path, codec)
    changed(path, lambda data: data + data)
    return planes + planes


def with_a_long_last_frame(path: Path) -> Planes:
    planes = write_clip(path.with_name("clip.mp4"), encoder={"bf": "0"})

    def hold(number: int, packet: av.Packet) -> bool:
        packet.duration = int(1 / packet.time_base) if number == N_FRAMES - 1 else packet.duration
        return True

    remuxed(path.with_name("clip.mp4"), path, hold)
    return planes


def with_edits(path: Path, *edits: tuple[int, int, float]) -> Planes:
    """A clip with B frames, and how players are to show it: duration in milliseconds, begin in frames, rate."""
    planes = write_clip(path, container={"use_editlist": "0"}, encoder={"bf": "2"})
    unit = 15360 // RATE

    def insert(data: bytes) -> bytes:
        """After the header of the track; the index is the last box of the file."""
        entries = b"".join(struct.pack(">IiI", ms, begin * unit, int(rate * 65536)) for ms, begin, rate in edits)
        listed = struct.pack(">I4sII", len(entries) + 16, b"elst", 0, len(edits)) + entries
        more = struct.pack(">I4s", len(listed) + 8, b"edts") + listed
        for name in (b"moov", b"trak"):
            at = data.rindex(name) - 4
            data = data[:at] + struct.pack(">I", struct.unpack_from(">I", data, at)[0] + len(more)) + data[at + 4 :]
        at = data.rindex(b"tkhd") - 4
        end = at + struct.unpack_from(">I", data, at)[0]
        return data[:end] + more + data[end:]

    changed(path, insert)
    return planes


def with_odd_note(path: Path, codec: str, note: bytes) -> Planes:
    """A raw stream that holds a note (SEI) of a hundred bytes of which one is there."""
    planes = write_clip(path, codec)
    changed(path, lambda data: b"\0\0\0\1" + note + b"\1\x64\xff" + data)
    return planes


def at_the_time_of_day(path: Path, codec: str) -> Planes:
    clip = path.with_name("clip.mp4")
    planes = write_clip(clip, codec, *["yuvj420p"] * (codec == "mjpeg"))

    def later(_: int, packet: av.Packet) -> bool:
        packet.pts += int(1_700_000_000 / packet.time_base)
        packet.dts += int(1_700_000_000 / packet.time_base)
        return True

    remuxed(clip, path, later)
    return planes


def with_a_tail(path: Path) -> Planes:
    planes = write_clip(path, "mjpeg", "yuvj420p")
    changed(path, lambda data: data + bytes(300_000))
    return planes


KINDS: dict[str, Callable[[Path], Planes]] = {
    "tagged.mkv": tagged,
    "tagged.mp4": tagged,
    "cover.mp4": with_another_stream_first,
    "preview.mov": lambda path: with_another_stream_first(path, 96, 8, Disposition(0)),
    "photo.mov": lambda path: with_another_stream_first(path, 320, 1, Disposition(0)),
    "dropped.avi": with_dropped_frames,
    "bottom_up.avi": lambda path: with_palette(path, True),
    "top_down.avi": lambda path: with_palette(path, False),
    "row.mjpeg": jpegs_in_a_row,
    "parts.mjpg": lambda path: jpegs_in_a_row(path, in_parts=True),
    "joined.ts": lambda path: joined(path, "libx264"),
    "joined_hevc.ts": lambda path: joined(path, "libx265"),
    "joined_mpeg2.ts": lambda path: joined(path, "mpeg2video"),
    "long_last.mkv": with_a_long_last_frame,
    "trimmed.mp4": lambda path: with_edits(path, (500, 7, 1)),
    "slowed.mov": lambda path: with_edits(path, (200, 2, 1), (2400, 8, 1 / 8), (200, 17, 1)),
    "looped.mp4": lambda path: with_edits(path, *[(300, 4, 1)] * 5),
    "frozen.mov": lambda path: with_edits(path, (400, 2, 1), (5000, 14, 0)),
    "cut_out.mp4": lambda path: with_edits(path, (200, 2, 1), (200, 18, 1)),
    "reversed.mp4": lambda path: with_edits(path, (200, 15, 1), (200, 2, 1)),
    "delayed.mp4": lambda path: with_edits(path, (700, 0, 1)),
    "cut_to_pieces.mp4": lambda path: with_edits(path, *[(1, 20, 1), (1, 3, 1)] * 200),
    "note.hevc": lambda path: with_odd_note(path, "libx265", b"\x4e\1"),
    "last_note.265": lambda path: with_odd_note(path, "libx265", b"\x50\1"),
    "note.h264": lambda path: with_odd_note(path, "libx264", b"\6"),
    "time_of_day.mkv": lambda path: at_the_time_of_day(path, "libx264"),
    "a.flv": lambda path: write_clip(path, "libx264"),
    "a.mpeg": lambda path: write_clip(path, "mpeg2video", encoder={"b": "9M"}),
    "row_nameless": jpegs_in_a_row,
    "parts_nameless": lambda path: jpegs_in_a_row(path, in_parts=True),
    "tail.avi": with_a_tail,
    "tail.mkv": with_a_tail,
    "tail.ts": lambda path: (write_clip(path), changed(path, lambda data: data + bytes(1000)))[0],
}


@pytest.mark.parametrize("name", KINDS)
def test_every_frame_the_right_way_up(tmp_path: Path, name: str) -> None:
    planes = KINDS[name](tmp_path / name)
    frames, error = read_all(tmp_path / name)
    assert error is None
    assert len(frames) == len(planes)
    for frame, plane in zip(frames, planes, strict=True):
        assert np.abs(frame.pixels.astype(float) - plane).mean() < 8
    assert (np.diff([frame.time_s for frame in frames]) > 0).all()
    is_nominal = any(part in name for part in ("row", "parts", "note"))
    assert [frame.nominal_time for frame in frames[1:]] == [is_nominal] * (len(frames) - 1)


def test_times_count_from_the_first_frame_and_gaps_stay(tmp_path: Path) -> None:
    at_the_time_of_day(tmp_path / "a.mkv", "mjpeg")
    remuxed(tmp_path / "a.mkv", tmp_path / "b.mkv", lambda number, _: number not in (5, 6))
    frames, _ = read_all(tmp_path / "b.mkv")
    left = np.delete(np.arange(N_FRAMES), (5, 6))
    np.testing.assert_allclose([frame.time_s for frame in frames], left / RATE, atol=1.1e-3)
    assert not frames[-1].metadata.not_believed


def test_edits_leave_times_as_they_are(tmp_path: Path) -> None:
    with_edits(tmp_path / "a.mov", (200, 2, 1), (2400, 8, 1 / 8), (200, 17, 1))
    frames, _ = read_all(tmp_path / "a.mov")
    np.testing.assert_allclose([frame.time_s for frame in frames], np.arange(N_FRAMES) / RATE, atol=1e-6)


def test_a_photo_with_further_pictures_is_a_photo(tmp_path: Path) -> None:
    jpegs_in_a_row(tmp_path / "a.jpg")
    changed(tmp_path / "a.jpg", lambda data: data[:2] + b"\xff\xe2\0\6MPF\0" + data[2:])
    frames, error = read_all(tmp_path / "a.jpg")
    assert (len(frames), error) == (1, None)


@pytest.mark.parametrize("name", ["a.avi", "a.mkv", "a.flv", "a.h264"])
def test_a_tail_without_packets_is_read_no_further_than_the_next_could_be(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_clip(tmp_path / name)
    changed(tmp_path / name, lambda data: data + bytes(1 << 22))
    monkeypatch.setattr(video, "_SEARCHED_BYTES", 1 << 20)
    read, sizes = video._ClipFile.read, list[int]()

    def counted(file: Any, size: int) -> bytes:
        data = read(file, size)
        sizes.append(len(data))
        return data

    monkeypatch.setattr(video._ClipFile, "read", counted)
    frames, error = read_all(tmp_path / name)
    assert (len(frames), error) == (N_FRAMES, None)
    assert sum(sizes) < 3 << 20


# -- damage ------------------------------------------------------------------------------------------------------------


def spoiled(path: Path, number: int) -> None:
    """Overwrite the middle of a packet; of a transport stream, take out one of its packets there."""
    with av.open(str(path)) as container:
        packets = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    (start, size), data = packets[number], bytearray(path.read_bytes())
    if path.suffix == ".ts":
        at = (start // 188 + 1 + size // 376) * 188
        del data[at : at + 188]
    else:
        data[start + size // 3 : start + size // 2] = b"\xff" * (size // 2 - size // 3)
    path.write_bytes(data)


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "ts", "avi"])
@pytest.mark.parametrize(
    ("codec", "encoder"),
    [("libx264", {"bf": "0"}), ("libx264", {"x264-params": "open-gop=1:bframes=2"}), ("mpeg2video", {"b": "9M"})],
    ids=["h264", "open-gop", "mpeg2"],
)
def test_damage_reaches_to_the_next_key_frame(
    tmp_path: Path, suffix: str, codec: str, encoder: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other frames are bit for bit those of the whole clip."""
    monkeypatch.setattr(video, "_DECODER_THREADS", 1)  # with more, FFmpeg may flag a frame too late
    path = tmp_path / f"a.{suffix}"
    write_clip(path, codec, encoder={"g": "6", "sc_threshold": "0", **encoder}, noise=True)
    whole, data = [frame.pixels.tobytes() for frame in read_all(path)[0]], path.read_bytes()
    for number in (int(suffix == "ts"), 7, 13):  # FFmpeg does not say that the first packet has a gap
        path.write_bytes(data)
        spoiled(path, number)
        frames, error = read_all(path)
        left = iter(whole)
        assert all(frame.pixels.tobytes() in left for frame in frames)
        assert N_FRAMES // 2 <= len(frames) < N_FRAMES
        assert f"{N_FRAMES - len(frames)} frames are damaged, the first after" in str(error)


def p_frames(path: Path) -> list[bytes]:
    """Write a clip with a key frame every sixth; its frames as they are read."""
    write_clip(path, encoder={"bf": "0", "g": "6", "sc_threshold": "0"}, noise=True)
    return [frame.pixels.tobytes() for frame in read_all(path)[0]]


def test_a_packet_that_gives_no_frame_is_damage(tmp_path: Path) -> None:
    whole, data = p_frames(tmp_path / "a.mp4"), (tmp_path / "a.mp4").read_bytes()
    with av.open(str(tmp_path / "a.mp4")) as container:
        place, size = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size][8]
    # A NAL unit of a type that no decoder knows.
    (tmp_path / "a.mp4").write_bytes(data[:place] + struct.pack(">IB", size - 4, 0x1F) + data[place + 5 :])
    frames, error = read_all(tmp_path / "a.mp4")
    assert [frame.pixels.tobytes() for frame in frames] == whole[:8] + whole[12:]
    assert [frame.index for frame in frames] == [*range(8), *range(12, N_FRAMES)]
    assert "4 frames are damaged, the first after 0.233 s" in str(error)


def test_a_clip_that_begins_between_key_frames_is_whole_from_the_first_on(tmp_path: Path) -> None:
    whole = p_frames(tmp_path / "a.mp4")
    remuxed(tmp_path / "a.mp4", tmp_path / "later.mkv", lambda number, _: number > 1)
    frames, error = read_all(tmp_path / "later.mkv")
    assert error is None
    assert [frame.pixels.tobytes() for frame in frames] == whole[6:]


class Pipe(bytearray):
    """Takes what is written, and cannot go back to state sizes."""

    name = "a"

    def write(self, data: bytes) -> int:
        self.extend(data)
        return len(data)


@pytest.mark.parametrize(("form", "options"), [("matroska", {}), ("webm", {"live": "1"}), ("flv", {})], ids=str)
def test_a_recording_that_is_still_written_breaks_off(tmp_path: Path, form: str, options: dict[str, str]) -> None:
    pipe = Pipe()
    with av.open(pipe, "w", format=form, options=options) as container:
        stream = container.add_stream("libvpx" if form == "webm" else "libx264", rate=RATE)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for picture in pictures():
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "gray").reformat(format="yuv420p")))
        container.mux(stream.encode())
    path = tmp_path / "a.bin"
    path.write_bytes(pipe)
    frames, error = read_all(path)
    assert (len(frames), error) == (N_FRAMES, None)
    for share in (0.4, 0.6, 0.8):
        path.write_bytes(pipe[: int(len(pipe) * share)])
        frames, error = read_all(path)
        assert 0 < len(frames) < N_FRAMES
        assert f"breaks off at {frames[-1].time_s:.3f} s" in str(error)


# -- fields, sizes, times ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lower_first", [False, True])
@pytest.mark.parametrize("are_two", [True, False])
def test_fields_are_frames_where_they_are_two_pictures(tmp_path: Path, lower_first: bool, are_two: bool) -> None:
    path, fields = tmp_path / "a.ts", pictures(2 * N_FRAMES)
    with av.open(str(path), "w") as container:
        order = "bff=1" if lower_first else "tff=1"
        stream = container.add_stream("libx264", rate=RATE, options={"x264-params": order, "qp": "1"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for earlier, later in zip(fields[::2], fields[1::2], strict=True):
            picture = earlier.copy()
            if are_two:
                picture[int(not lower_first) :: 2] = later[::2]
            frame = av.VideoFrame.from_ndarray(picture, "gray").reformat(format="yuv420p", src_color_range=1)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    frames, error = read_all(path)
    assert error is None
    assert len(frames) == (2 * N_FRAMES if are_two else N_FRAMES)
    for frame, field in zip(frames, fields if are_two else fields[::2], strict=True):
        assert frame.pixels.shape == ((HEIGHT // 2 if are_two else HEIGHT), WIDTH)
        shown = field[::2] if are_two else field
        assert np.corrcoef(frame.pixels[:, 5], shown[:, 5])[0, 1] > 0.99
    np.testing.assert_allclose(np.diff([frame.time_s for frame in frames]), 0.5 / RATE if are_two else 1 / RATE)
    assert any("interlaced" in doubt for doubt in frames[-1].metadata.not_believed) != are_two


@pytest.mark.parametrize(("suffix", "codec"), [("avi", "mjpeg"), ("mkv", "mjpeg"), ("webm", "libvpx-vp9")])
def test_frames_of_changing_size(tmp_path: Path, suffix: str, codec: str) -> None:
    sizes = [(160, 96), (320, 192), (64, 64), (160, 96)]
    write_sizes(tmp_path / f"a.{suffix}", codec, sizes, np.zeros((8, 8, 3), np.uint8))
    frames, error = read_all(tmp_path / f"a.{suffix}")
    assert error is None
    assert [(frame.width, frame.height) for frame in frames] == sizes


def test_frames_larger_than_the_clip_says_are_bounded(tmp_path: Path) -> None:
    """Before they unfold: several are decoded at a time."""
    data = jpeg(np.zeros((96, 160), np.uint8))
    at = data.index(b"\xff\xc0") + 5
    huge = data[:at] + struct.pack(">HH", 15_000, 15_000) + data[at + 4 :]
    (tmp_path / "a.mjpeg").write_bytes(data + huge + data)
    frames, error = read_all(tmp_path / "a.mjpeg")
    assert [frame.pixels.shape for frame in frames] == [(96, 160)] * 2
    assert "1 frames are damaged, the first after 0.000 s (15000 x 15000 pixels would take" in str(error)


@pytest.mark.parametrize("n_threads", [1, 16])
@pytest.mark.parametrize(("n_frames", "is_read"), [(30, True), (7, False)])
def test_one_bound_whatever_the_cores(
    tmp_path: Path, n_threads: int, n_frames: int, is_read: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_clip(tmp_path / "a.mp4")
    monkeypatch.setattr(video, "_DECODER_THREADS", n_threads)
    for module in (video, sys.modules["rxcli.ingest.sniff"]):  # where a function of that name hides it
        monkeypatch.setattr(module, "MAX_BYTES", n_frames * WIDTH * HEIGHT * 3 // 2)
    frames, error = read_all(tmp_path / "a.mp4")
    assert len(frames) == (N_FRAMES if is_read else 0)
    assert is_read or "160 x 96 pixels would take" in str(error)


def test_streams_that_begin_within_a_file_are_passed_over() -> None:
    """PyAV does not know them, and ends with an error."""
    packets = iter([*"ab", IndexError(), *"cd"])

    def demux(_: object) -> Iterator[SimpleNamespace]:
        for packet in packets:
            if isinstance(packet, IndexError):
                raise packet
            yield SimpleNamespace(size=1, name=packet)

    progress = video._Progress()
    found = video._content(SimpleNamespace(demux=demux), None, progress)
    assert ("".join(packet.name for packet in found), progress.cut) == ("abcd", False)


def times_of(stamps: list[float | None]) -> list[tuple[float, bool]]:
    times = FrameTimes()
    return [times.next(stamp, 0.1) for stamp in stamps]


def test_times_after_a_joint_go_on() -> None:
    times, nominal = zip(*times_of([5.0, 5.1, 5.2, 0.0, 0.2, 0.3]), strict=True)
    np.testing.assert_allclose(times, [5.0, 5.1, 5.2, 5.3, 5.5, 5.6])
    assert not any(nominal)
    assert sum(is_nominal for _, is_nominal in times_of([0.0] * 30)) == 29
