"""Soft bits to messages and files: over whole transfers, from anywhere, and from what is no transfer at all."""

import pickle
import struct
import tracemalloc
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from rxcli.errors import UsageError
from rxcli.lab.benchmark.goodput import detect
from rxcli.link import ldpc
from rxcli.link.collector import Collector, PhotoCollector
from rxcli.link.encoder import FileSending, MessageSending, file_object, message, packet_slots_of
from rxcli.link.files import FilesUnderWay
from rxcli.link.formats import protect
from rxcli.link.layout import announcement_layout
from rxcli.link.receiver import LinkReceiver
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.protocol import encode_packet, indices_to_bits
from rxcli.types import FrameResult, FrameSoftBits, Message, ReceivedObject

COLUMNS, SYMBOLS = 20, 24
BRIGHT = (16.0,) * COLUMNS


def clip(
    sending: FileSending | MessageSending,
    first: int,
    n_frames: int,
    rng: np.random.Generator,
    snr_db: tuple[float, ...] = BRIGHT,
    symbols: int = SYMBOLS,
    epoch: int = 0,
    w: int = 5,
) -> Iterator[FrameSoftBits]:
    """Frames that show a burst and most of its neighbours, then miss two."""
    for frame in range(n_frames):
        bursts = first + 5 * frame + np.arange(3)
        llr = detect(sending.labels(bursts, len(snr_db), symbols), w, snr_db, rng)
        llr[0, : symbols // 3] = 0
        llr[2, symbols // 2 :] = 0
        yield FrameSoftBits(bursts - first + 1000, llr, epoch, frame=frame, time_s=frame / 30)


def receive(frames: Iterator[FrameSoftBits], receiver: LinkReceiver | None = None) -> list[Message | ReceivedObject]:
    receiver = receiver or LinkReceiver(COLUMNS, SYMBOLS)
    events = [event for frame in frames for event in receiver.add(frame)]
    return events + receiver.finish()


def contents(events: Iterable[Message | ReceivedObject]) -> list[str | bytes | None]:
    """Texts of messages, data of files."""
    return [event.text if isinstance(event, Message) else event.data for event in events]


@pytest.mark.parametrize(
    ("first", "mother", "size", "n_frames"),
    [
        *((first, 2, 6000, 60) for first in (0, 1, 31, 32, 100_003, (1 << 32) - 400)),
        *((5, mother, 30_000, 90) for mother in range(3)),
    ],
)
def test_a_file_comes_at_every_rate_from_a_clip_that_begins_anywhere(
    first: int, mother: int, size: int, n_frames: int
) -> None:
    rng = np.random.default_rng(first)
    data = rng.bytes(size)
    assert contents(receive(clip(file_object("a.bin", data, mother=mother), first, n_frames, rng))) == [data]


def test_what_was_seen_before_the_first_announcement_counts() -> None:
    rng = np.random.default_rng(3)
    data = rng.bytes(2000)
    frames = list(clip(file_object("a.bin", data), 33, 40, rng))
    receiver = LinkReceiver(COLUMNS, SYMBOLS)
    complete_at = next(n for n, frame in enumerate(frames) if receiver.add(frame))
    # Burst 64 announces; the frame that shows it is enough, for all before it was kept.
    assert frames[complete_at].burst[0] - 1000 + 33 <= 64 <= frames[complete_at].burst[-1] - 1000 + 33


def test_columns_in_the_dark_and_small_weights() -> None:
    rng = np.random.default_rng(4)
    data = rng.bytes(3000)
    dark = tuple(-np.inf if c in (0, 7, 8) else 12.0 for c in range(COLUMNS))
    assert contents(receive(clip(file_object("a.bin", data), 9, 120, rng, dark, w=2))) == [data]


@pytest.mark.parametrize("length", [1, 7, 8, 31, 63, 127, 199])
@pytest.mark.parametrize("symbols", [24, 11, 5])
def test_messages_of_every_length(length: int, symbols: int) -> None:
    rng = np.random.default_rng(length)
    frames = clip(message("x" * length), int(rng.integers(0, 1000)), 6, rng, symbols=symbols)
    events = receive(frames, LinkReceiver(COLUMNS, symbols))
    assert contents(events) == ["x" * length]


def test_photos_of_one_beacon_are_combined() -> None:
    rng = np.random.default_rng(6)
    sending, receiver = message("z" * 150), LinkReceiver(COLUMNS, 11)
    came = []
    for photo in range(8):
        burst = int(rng.integers(0, 100))
        llr = detect(sending.labels(np.arange(burst, burst + 1), COLUMNS, 11), 5, (7.0,) * COLUMNS, rng)
        llr[:, rng.permutation(11)[:4]] = 0
        came.append(receiver.add(FrameSoftBits(np.arange(1), llr, epoch=photo)))
    assert came[0] == []
    assert [e.text for events in came for e in events if isinstance(e, Message)] == ["z" * 150]


@pytest.mark.parametrize("ways", ["from its start", "where it was left", "by one clock"])
def test_two_files_sent_by_turns_both_arrive(ways: str) -> None:
    """What lies between the last announcement of one and the first of the other may be of either."""
    rng = np.random.default_rng(17)
    data = [rng.bytes(12_000), rng.bytes(12_000)]
    sendings = [file_object("a", data[0], 1), file_object("b", data[1], 2)]
    shown = []
    for turn in range(24):
        first = {"from its start": 0, "where it was left": 100 * (turn // 2), "by one clock": 100 * turn}[ways]
        shown += [(sendings[turn % 2], first + k) for k in range(100)]
    receiver, came = LinkReceiver(COLUMNS, SYMBOLS), {}
    for at in range(0, len(shown) - 3, 5):
        labels = [sending.labels(np.array([burst]), COLUMNS, SYMBOLS) for sending, burst in shown[at : at + 3]]
        llr = detect(np.concatenate(labels), 5, BRIGHT, rng)
        events = receiver.add(FrameSoftBits(np.arange(at, at + 3), llr, 0, frame=at, time_s=at / 150))
        came |= {event.name: event.data for event in events if isinstance(event, ReceivedObject)}
    assert came == {"a": data[0], "b": data[1]}


def test_clips_of_an_object_whose_start_is_not_shared_add_up() -> None:
    """Two clips of one object: each needs an announcement of its own, and then what both saw is added."""
    rng = np.random.default_rng(9)
    data = rng.bytes(12_000)
    sending, receiver = file_object("a", data), LinkReceiver(COLUMNS, SYMBOLS)
    events = receive(clip(sending, 20, 14, rng, epoch=1), receiver)
    events += receive(clip(sending, 5000, 25, rng, epoch=2), receiver)
    assert contents(events) == [data]


@pytest.mark.parametrize("n_clips", [2, 3])
def test_clips_that_show_parts_of_a_file_complete_it_together(n_clips: int) -> None:
    """As the chapters that a camera writes; they come as processes send them."""
    rng, screen = np.random.default_rng(8), load_profile("data-17k3", ScreenProfile)
    columns, symbols = screen.columns, screen.payload_symbols
    data = rng.bytes(14_000)
    frames = list(clip(file_object("a.bin", data), 5, 60, rng, (16.0,) * columns, symbols))
    together, came = PhotoCollector([screen]), []
    for number in range(n_clips):
        alone, [*others, last] = Collector([screen]), frames[number * 60 // n_clips : (number + 1) * 60 // n_clips]
        for soft in others:
            alone.add(FrameResult(f"{number}.mp4", soft.frame, soft.time_s, "ok", soft_bits=soft))
        result = alone.finish(alone.add(FrameResult(f"{number}.mp4", last.frame, 0.0, "ok", soft_bits=last)))
        assert (result.objects, len(result.progress)) == ((), 1)
        came.append(together.add(pickle.loads(pickle.dumps(result))))
    assert [[file.data for file in result.objects] for result in came] == [[]] * (n_clips - 1) + [[data]]
    assert [len(result.progress) for result in came] == [1] * (n_clips - 1) + [0]
    assert came[-1].objects[0].source == f"{n_clips - 1}.mp4"


def test_progress_says_what_is_missing() -> None:
    rng = np.random.default_rng(10)
    receiver = LinkReceiver(COLUMNS, SYMBOLS)
    assert receive(clip(file_object("a", rng.bytes(100_000)), 0, 30, rng), receiver) == []
    (progress,) = receiver.progress
    assert 0.1 < progress.share < 0.9
    assert 0.2 < progress.seconds_left < 20


# -- what is no transfer -----------------------------------------------------------------------------------------------


def noise(rng: np.random.Generator, n: int, symbols: int = SYMBOLS) -> FrameSoftBits:
    scale = rng.choice([0.5, 2.0, 8.0])
    llr = rng.normal(0, scale, (n, symbols, COLUMNS, 7)).astype(np.float32)
    return FrameSoftBits(np.arange(n), np.clip(llr, -9, 9))


@pytest.mark.parametrize("symbols", [24, 5])
def test_noise_gives_nothing(symbols: int) -> None:
    rng = np.random.default_rng(11)
    receiver = LinkReceiver(COLUMNS, symbols)
    for epoch in range(60):
        soft = noise(rng, 3, symbols)
        assert receiver.add(FrameSoftBits(soft.burst, soft.llr, epoch)) == []
    assert receiver.finish() == []
    assert not receiver.messages
    assert not receiver.progress


def announced(fields: tuple[int, ...], rng: np.random.Generator) -> FrameSoftBits:
    layout = announcement_layout(COLUMNS, SYMBOLS)
    coded = protect(struct.pack(">BBHIIII", *fields), 0xFFFE, 20)
    (buffer,) = ldpc.encode(layout.code, np.unpackbits(np.frombuffer(coded, np.uint8))[None])
    labels = (buffer[layout.places[0]] @ (1 << np.arange(6, -1, -1))).astype(np.uint8)
    return FrameSoftBits(np.array([0]), detect(labels[None], 5, BRIGHT, rng))


def test_an_announcement_of_four_gigabytes_takes_no_memory() -> None:
    rng = np.random.default_rng(12)
    receiver = LinkReceiver(COLUMNS, SYMBOLS)
    tracemalloc.start()
    assert receiver.add(announced((1, 2, 5, 0xFFFFFFFF, 32, 1, 0), rng)) == []
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 32 << 20
    assert any("4294967295 bytes" in note for note in receiver.notes)
    assert not receiver.progress


def test_the_least_complete_of_many_files_are_dropped() -> None:
    """A sender that announces file after file costs no more than the bound, and not the file that comes."""
    rng = np.random.default_rng(18)
    data = rng.bytes(12_000)
    frames = list(clip(file_object("wanted", data, 1), 0, 60, rng))
    receiver = LinkReceiver(COLUMNS, SYMBOLS, under_way=FilesUnderWay(memory_mb=120))
    events = []
    for number, frame in enumerate(frames):
        epoch = 1000 + number
        bait = announced((1, 2, 3 + number, 2 << 20, 32, 1, 0), rng)  # version, mother, id, length, CRC, burst
        events += receiver.add(frame)
        assert receiver.add(replace(bait, epoch=epoch)) == []
        assert sum(file.n_bytes for file in receiver._files.files.values() if file.under_way) <= 120 << 20
    assert contents(events) == [data]
    [note] = receiver.notes
    assert "incomplete files were dropped: together they would take more than 120 MB (--file-memory)" in note


def test_a_file_that_would_take_more_than_all_may_is_refused() -> None:
    receiver = LinkReceiver(COLUMNS, SYMBOLS, under_way=FilesUnderWay(memory_mb=16))
    receiver.add(announced((1, 2, 5, 8 << 20, 32, 1, 0), np.random.default_rng(19)))
    assert not receiver.progress
    assert any("MB to receive; it was not received (--file-memory)" in note for note in receiver.notes)


def test_memory_is_bounded_while_no_announcement_comes() -> None:
    rng = np.random.default_rng(13)
    receiver = LinkReceiver(COLUMNS, SYMBOLS)
    soft = noise(rng, 3)
    tracemalloc.start()
    for frame in range(0, 12_000, 3000):
        # Four jumps of the clock stand for as many thousand bursts each.
        receiver._files._open += receiver._files._open[:1] * 3000
        receiver.add(FrameSoftBits(soft.burst + frame, soft.llr))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert sum(burst.llr.size for burst in receiver._files._open) <= 32 << 20
    assert peak < 64 << 20


def test_a_container_that_is_not_what_was_announced_gives_no_file() -> None:
    rng = np.random.default_rng(14)
    sending = file_object("a", rng.bytes(900))
    sending._crc ^= 1
    receiver = LinkReceiver(COLUMNS, SYMBOLS)
    assert receive(clip(sending, 0, 20, rng), receiver) == []
    assert any("not what was sent" in note for note in receiver.notes)


def test_ratios_that_are_no_numbers_are_erasures() -> None:
    rng = np.random.default_rng(15)
    frames = list(clip(message("hello"), 0, 2, rng))
    frames[0].llr[:, :, 3] = np.nan
    frames[0].llr[:, 1] = np.copysign(np.inf, frames[0].llr[:, 1])
    frames[0].llr[1:, 0] = -np.nan
    assert contents(receive(iter(frames))) == ["hello"]


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="llr must be"):
        LinkReceiver(COLUMNS, SYMBOLS).add(noise(np.random.default_rng(0), 2, symbols=5))


# -- sending -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("w", range(1, 10))
def test_slots_are_packets_of_the_air_interface(w: int) -> None:
    labels = np.random.default_rng(w).integers(0, 128, (2, SYMBOLS, 3), dtype=np.uint8)
    slots = packet_slots_of(labels, np.full(3, w))
    k = (3, 5, 6, 7, 7, 7, 6, 5, 3)[w - 1]
    index = labels[1, :, 2].astype(np.int64) >> (7 - k)
    assert np.array_equal(slots[1, 2], encode_packet(indices_to_bits(index, w), w))


def test_what_cannot_work_is_refused_with_what_would() -> None:
    with pytest.raises(UsageError, match="1958 bits a round"):
        message("y" * 190).check(np.full(20, 1), 24)
    with pytest.raises(UsageError, match=r"at least \d+ such columns"):
        file_object("x", b"x").check(np.full(4, 5), 5)
    file_object("x", b"x").check(np.full(20, 5), 5)
    with pytest.raises(UsageError, match="at most 199 bytes"):
        message("x" * 200)
    with pytest.raises(UsageError, match="object id"):
        file_object("a", b"x", 0xFFFE)
