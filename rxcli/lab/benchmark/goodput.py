"""Whole transfers over simulated slots: how fast text and files come, byte for byte, from clips that begin anywhere.

Every slot that a frame shows is lit or dark in white noise, every symbol is detected over its codebook, and the ratios
go to the link layer as the receiver's would. Pixels are left out: they are measured on captures. Beside it stands what
a CRC in every packet under a perfect erasure code would have delivered from the same frames.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import ceil

import numpy as np
from numpy.typing import NDArray

from rxcli.lab.benchmark.tables import Row
from rxcli.link.encoder import FileSending, MessageSending, file_object, message
from rxcli.link.receiver import LinkReceiver
from rxcli.link.softbits import information
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, bits_per_symbol, codebook
from rxcli.types import Float32Array, FrameSoftBits

#: Bytes up to which a transfer is a message.
_MESSAGE_BYTES = 199
_CRC_BITS = 32
#: A detector trusts no bit further than this.
_MOST_LLR = 9.0
#: Clips begin within so many seconds of an object's start, and last at most so many times what is needed.
_START_WITHIN_S, _MOST_TIMES = 900.0, 6.0


@dataclass(frozen=True, slots=True)
class Picture:
    """How well the slots of every column are seen."""

    name: str
    #: (C,) slot signal-to-noise ratio (on - off)^2 / variance in dB; -inf for a dark column.
    snr_db: tuple[float, ...]


def picture(name: str, columns: int) -> Picture:
    """`bright`: 16 dB everywhere, as measured of a sky; `china`: three dark columns, the others 8 to 18 dB."""
    if name == "bright":
        return Picture(name, (16.0,) * columns)
    db = np.linspace(8.0, 18.0, columns)[np.random.default_rng(7).permutation(columns)]
    db[[1, columns // 2, columns - 2]] = -np.inf
    return Picture(name, tuple(db.tolist()))


@dataclass(frozen=True, slots=True)
class Point:
    """One point of the benchmark."""

    screen: ScreenProfile
    picture: Picture
    frame_rate_hz: float
    #: Share of a frame's time in which rows that show the screen are read.
    readout: float
    size: int
    mother: int = 2
    w: int = 5


@dataclass(frozen=True, slots=True)
class Transfer:
    """One transfer."""

    #: Whether every byte came.
    exact: bool
    seconds: float
    #: Bits of whole symbols of lit columns that were seen, information in the ratios, and what packets with a CRC hold.
    visible_bits: int
    information_bits: float
    packet_crc_bits: int
    link_cpu_s: float


def detect(labels: NDArray[np.uint8], w: int, snr_db: Sequence[float], rng: np.random.Generator) -> Float32Array:
    """Ratios (n, N, C, 7) of labels (n, N, C) that were sent with weight `w` and seen in white noise."""
    k, words = bits_per_symbol(w), codebook(w).astype(np.float32)
    amplitude = (10 ** (np.asarray(snr_db, np.float32) / 20))[:, None].astype(np.float32)
    sent = words[labels >> (7 - k)]
    seen = amplitude * sent + rng.standard_normal(sent.shape, np.float32)
    score = (amplitude * (seen - amplitude / 2)) @ words.T
    likely = np.exp(score - score.max(axis=-1, keepdims=True))
    bits = ((np.arange(1 << k)[:, None] >> np.arange(k - 1, -1, -1)) & 1).astype(np.float32)
    out = np.zeros((*labels.shape, 7), np.float32)
    out[..., :k] = np.log(likely @ bits + 1e-12) - np.log(likely @ (1 - bits) + 1e-12)
    return np.clip(out, -_MOST_LLR, _MOST_LLR)


def transfer(point: Point, rng: np.random.Generator) -> Transfer:
    """One transfer from a random start until it is complete."""
    data = rng.bytes(point.size)
    small = point.size <= _MESSAGE_BYTES
    sending = message(data, "raw") if small else file_object("data.bin", data, mother=point.mother)
    receiver = LinkReceiver(point.screen.columns, point.screen.payload_symbols)
    lit = np.isfinite(point.picture.snr_db)
    visible = crc_bits = 0
    held = cpu_s = 0.0
    for shown, observed, labels in _frames(point, sending, rng):
        visible += int(observed.sum()) * int(lit.sum()) * bits_per_symbol(point.w)
        held += float(information(shown.llr).sum())
        crc_bits += _packet_crc_bits(shown, observed, labels, point)
        start = time.process_time()
        events = receiver.add(shown)
        cpu_s += time.process_time() - start
        if events:
            seconds = shown.time_s + point.readout / point.frame_rate_hz
            came = events[0].data[: point.size]
            return Transfer(came == data, seconds, visible, held, crc_bits, cpu_s)
    return Transfer(False, shown.time_s, visible, held, crc_bits, cpu_s)


def _frames(
    point: Point, sending: FileSending | MessageSending, rng: np.random.Generator
) -> Iterator[tuple[FrameSoftBits, NDArray[np.bool_], NDArray[np.uint8]]]:
    """Frames of a clip: soft bits, symbols that were observed (B, N), and labels (B, N, C)."""
    screen = point.screen
    burst_s = screen.packet_s * screen.repeats
    start_s = float(rng.uniform(0, _START_WITHIN_S))
    first = int(start_s / burst_s)
    for frame in range(_most_frames(point)):
        begin = start_s + frame / point.frame_rate_hz
        end = begin + point.readout / point.frame_rate_hz
        bursts = np.arange(int(begin / burst_s), int(end / burst_s) + 1)
        observed = _observed(bursts, begin, end, screen)
        labels = sending.labels(bursts, screen.columns, screen.payload_symbols)
        llr = detect(labels, point.w, point.picture.snr_db, rng) * observed[:, :, None, None]
        yield FrameSoftBits(bursts - first, llr, time_s=frame / point.frame_rate_hz, frame=frame), observed, labels


def _observed(bursts: NDArray[np.int64], begin: float, end: float, screen: ScreenProfile) -> NDArray[np.bool_]:
    """(B, N) symbols that lie within a frame as a whole, in any copy."""
    slot_s = 1 / screen.slot_rate_hz
    symbol = (PREAMBLE_SLOTS + SLOTS_PER_SYMBOL * np.arange(screen.payload_symbols)) * slot_s
    copy = bursts[:, None] * screen.repeats + np.arange(screen.repeats)
    at = (copy * screen.packet_s)[..., None] + symbol
    inside = (at >= begin) & (at + SLOTS_PER_SYMBOL * slot_s <= end)
    return np.asarray(inside.any(axis=1))


def _packet_crc_bits(shown: FrameSoftBits, observed: NDArray[np.bool_], labels: NDArray[np.uint8], point: Point) -> int:
    """Bits of whole packets without a wrong bit, less a CRC each."""
    k = bits_per_symbol(point.w)
    bits = (labels[..., None] >> np.arange(6, 6 - k, -1)) & 1
    agree = np.asarray((shown.llr[..., :k] > 0) == bits)
    right = agree.all(axis=(1, 3)) & observed.all(axis=1, keepdims=True)
    return int(right.sum()) * max(k * point.screen.payload_symbols - _CRC_BITS, 0)


def _most_frames(point: Point) -> int:
    lit = sum(np.isfinite(point.picture.snr_db))
    screen = point.screen
    rate = bits_per_symbol(point.w) * screen.payload_symbols * lit / (screen.packet_s * screen.repeats)
    needed_s = 8 * (point.size + 200) / (rate * point.readout) + 0.5
    return ceil(_MOST_TIMES * needed_s * point.frame_rate_hz) + 40


def measure(point: Point, starts: int, seed: int) -> list[Transfer]:
    """Transfers of one point from random starts."""
    return [transfer(point, np.random.default_rng([seed, start])) for start in range(starts)]


def row(point: Point, transfers: Sequence[Transfer]) -> Row:
    """The figures of one point: goodput in kb/s, median and worst."""
    done = [t for t in transfers if t.exact]
    bits = 8 * point.size
    rates = [bits / t.seconds / 1e3 for t in done]
    sums = {name: sum(getattr(t, name) for t in done) for name in ("visible_bits", "information_bits", "seconds")}
    crc = sum(t.packet_crc_bits for t in done) / max(sums["seconds"], 1e-9) / 1e3
    median = float(np.median(rates)) if rates else 0.0
    worst = min(rates) if len(done) == len(transfers) and rates else 0.0
    return {
        "screen": point.screen.name,
        "picture": point.picture.name,
        "fps": point.frame_rate_hz,
        "readout": point.readout,
        "bytes": point.size,
        "exact": f"{len(done)}/{len(transfers)}",
        "s_median": float(np.median([t.seconds for t in done])) if done else None,
        "s_worst": max(t.seconds for t in done) if done else None,
        "kbps_median": median,
        "kbps_worst": worst,
        "median_over_worst": median / worst if worst else None,
        "of_visible": len(done) * bits / sums["visible_bits"] if done else None,
        "of_information": len(done) * bits / sums["information_bits"] if done else None,
        "packet_crc_kbps": crc,
        "over_packet_crc": len(done) * bits / sums["seconds"] / 1e3 / crc if crc else None,
        "cpu_over_time": sum(t.link_cpu_s for t in done) / max(sums["seconds"], 1e-9),
    }


#: Cameras: frames a second and share of a frame's time that the screen is read in.
CAMERAS = ((30.0, 0.5), (30.0, 0.61), (30.0, 0.7), (30.0, 0.9), (60.0, 0.76))


def points(
    screens: Sequence[str], pictures: Sequence[str], cameras: Sequence[tuple[float, float]], sizes: Sequence[int]
) -> list[Point]:
    """All points of a grid."""
    out = []
    for name in screens:
        screen = load_profile(name, ScreenProfile)
        for shown in pictures:
            base = Point(screen, picture(shown, screen.columns), 30.0, 0.61, 100)
            out += [
                replace(base, frame_rate_hz=rate, readout=readout, size=size)
                for rate, readout in cameras
                for size in sizes
            ]
    return out
