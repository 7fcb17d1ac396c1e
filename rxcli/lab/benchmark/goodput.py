"""Whole transfers over simulated slots: how fast text and files come, byte for byte, from clips that begin anywhere.

Every slot that a frame shows is lit or dark in white noise, every symbol is detected over its codebook, and the ratios
go to the link layer as the receiver's would. Pixels are left out: they are measured on captures.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.link.encoder import FileSending, MessageSending, file_object, message
from rxcli.link.receiver import LinkReceiver
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, bits_per_symbol, codebook
from rxcli.types import Float32Array, FloatArray, FrameSoftBits

#: Bytes up to which a transfer is a message.
_MESSAGE_BYTES = 199
#: A detector trusts no bit further than this.
_MAX_LLR = 9.0
#: Latest start of clips after an object's start, seconds; and their maximum length relative to the required one.
_START_WITHIN_S, _MAX_TIMES = 900.0, 6.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Transfer:
    """A file or text that a clip of slots is to bring."""

    size: int
    picture: str
    frame_rate_hz: float
    #: Share of a frame's time in which rows that show the screen are read.
    readout: float
    screen: ScreenProfile
    mother: int = 2
    w: int = 5

    @property
    def snr_db(self) -> FloatArray:
        """(C,) slot signal-to-noise ratio (on - off)^2 / variance; -inf for a dark column.

        `bright` has 16 dB everywhere, as measured of a sky; `china` three dark columns, the others 8 to 18 dB.
        """
        columns = self.screen.columns
        if self.picture == "bright":
            return np.full(columns, 16.0)
        db = np.linspace(8.0, 18.0, columns)[np.random.default_rng(7).permutation(columns)]
        db[[1, columns // 2, columns - 2]] = -np.inf
        return db

    @property
    def n_lit(self) -> int:
        """Columns that are not dark."""
        return int(np.isfinite(self.snr_db).sum())


def transferred(*, seed: Sequence[int], screen: str = "data-34k6", **point: Any) -> dict[str, Any]:
    """One transfer from a random start until it is complete.

    Args:
        seed: of start, data and noise.
        screen: name of its profile.
        point: other fields of `Transfer`.
    """
    transfer, rng = Transfer(**point, screen=load_profile(screen, ScreenProfile)), np.random.default_rng(seed)
    data = rng.bytes(transfer.size)
    small = transfer.size <= _MESSAGE_BYTES
    sending = message(data, "raw") if small else file_object("data.bin", data, mother=transfer.mother)
    receiver = LinkReceiver(transfer.screen.columns, transfer.screen.payload_symbols)
    visible = 0
    exact, seconds, cpu_s = False, 0.0, 0.0
    for shown, observed in _frames(transfer, sending, rng):
        visible += int(observed.sum()) * transfer.n_lit * bits_per_symbol(transfer.w)
        start = time.process_time()
        events = receiver.add(shown)
        cpu_s += time.process_time() - start
        if events:
            seconds = shown.time_s + transfer.readout / transfer.frame_rate_hz
            exact = events[0].data[: transfer.size] == data
            break
    came = {"exact": exact, "seconds": seconds, "cpu_s": cpu_s, "packets": []}
    if not exact:
        return came
    bits = 8 * transfer.size
    return {**came, "kbps": bits / seconds / 1e3, "of_visible": bits / visible}


def detect(
    labels: NDArray[np.uint8], w: int, snr_db: Sequence[float] | FloatArray, rng: np.random.Generator
) -> Float32Array:
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
    return np.clip(out, -_MAX_LLR, _MAX_LLR)


def _frames(
    point: Transfer, sending: FileSending | MessageSending, rng: np.random.Generator
) -> Iterator[tuple[FrameSoftBits, NDArray[np.bool_]]]:
    """Frames of a clip: soft bits, and symbols that were observed (B, N)."""
    screen = point.screen
    burst_s = screen.packet_s * screen.repeats
    start_s = float(rng.uniform(0, _START_WITHIN_S))
    first = int(start_s / burst_s)
    for frame in range(_max_frames(point)):
        begin = start_s + frame / point.frame_rate_hz
        end = begin + point.readout / point.frame_rate_hz
        bursts = np.arange(int(begin / burst_s), int(end / burst_s) + 1)
        observed = _observed(bursts, begin, end, screen)
        labels = sending.labels(bursts, screen.columns, screen.payload_symbols)
        llr = detect(labels, point.w, point.snr_db, rng) * observed[:, :, None, None]
        yield FrameSoftBits(bursts - first, llr, time_s=frame / point.frame_rate_hz, frame=frame), observed


def _observed(bursts: NDArray[np.int64], begin: float, end: float, screen: ScreenProfile) -> NDArray[np.bool_]:
    """(B, N) symbols that lie within a frame as a whole, in any copy."""
    slot_s = 1 / screen.slot_rate_hz
    symbol = (PREAMBLE_SLOTS + SLOTS_PER_SYMBOL * np.arange(screen.payload_symbols)) * slot_s
    copy = bursts[:, None] * screen.repeats + np.arange(screen.repeats)
    at = (copy * screen.packet_s)[..., None] + symbol
    inside = (at >= begin) & (at + SLOTS_PER_SYMBOL * slot_s <= end)
    return np.asarray(inside.any(axis=1))


def _max_frames(point: Transfer) -> int:
    screen = point.screen
    rate = bits_per_symbol(point.w) * screen.payload_symbols * point.n_lit / (screen.packet_s * screen.repeats)
    needed_s = 8 * (point.size + 200) / (rate * point.readout) + 0.5
    return ceil(_MAX_TIMES * needed_s * point.frame_rate_hz) + 40
