"""Whole transfers over simulated slots: how fast text and files come, byte for byte, from clips that begin anywhere.

Every slot that a frame shows is lit or dark in white noise, every symbol is detected over its codebook, and the ratios
go to the link layer as the receiver's would. Pixels are left out: they are measured on captures.
"""

import time
from collections.abc import Sequence
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.link.encoder import file_object, message
from rxcli.link.receiver import LinkReceiver
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, bits_per_symbol, codebook
from rxcli.types import Float32Array, FloatArray, FrameSoftBits

#: Bytes up to which a transfer is a message.
_MESSAGE_BYTES = 199
#: Lit slots of a symbol.
_W = 5
#: A detector trusts no bit further than this.
_MAX_LLR = 9.0
#: Latest start of clips after an object's start, seconds; and their maximum length relative to the required one.
_START_WITHIN_S, _MAX_TIMES = 900.0, 6.0
#: What the required length allows for besides the data: head and name of a file, bytes, and its announcement, seconds;
#: and frames that every clip may have besides.
_HEAD_BYTES, _ANNOUNCED_S, _FURTHER_FRAMES = 200, 0.5, 40


def snr_db_of(picture: str, columns: int) -> FloatArray:
    """(columns,) slot signal-to-noise ratio (on - off)^2 / variance; -inf for a dark column.

    `bright` has 16 dB everywhere, as measured of a sky; `china` three dark columns, the others 8 to 18 dB.
    """
    if picture == "bright":
        return np.full(columns, 16.0)
    db = np.linspace(8.0, 18.0, columns)[np.random.default_rng(7).permutation(columns)]
    db[[1, columns // 2, columns - 2]] = -np.inf
    return db


def transferred(
    *, seed: Sequence[int], size: int, picture: str, frame_rate_hz: float, readout: float, screen: str = "data-34k6"
) -> dict[str, Any]:
    """Transfer a file or text from a random start until it is complete.

    Args:
        seed: of start, data and noise.
        size: bytes.
        picture: see `snr_db_of`.
        frame_rate_hz: of the clip.
        readout: share of a frame's time in which rows that show the screen are read.
        screen: name of its profile.
    """
    profile, rng = load_profile(screen, ScreenProfile), np.random.default_rng(seed)
    data, snr_db = rng.bytes(size), snr_db_of(picture, profile.columns)
    sending = message(data, "raw") if size <= _MESSAGE_BYTES else file_object("data.bin", data)
    receiver = LinkReceiver(profile.columns, profile.payload_symbols)
    start_s, readout_s = float(rng.uniform(0, _START_WITHIN_S)), readout / frame_rate_hz
    burst_s, burst_bits = profile.packet_s * profile.repeats, bits_per_symbol(_W) * int(np.isfinite(snr_db).sum())
    needed_s = 8 * (size + _HEAD_BYTES) / (burst_bits * profile.payload_symbols / burst_s * readout) + _ANNOUNCED_S
    visible, cpu_s = 0, 0.0
    came: dict[str, Any] = {"exact": False, "seconds": 0.0}
    for frame in range(ceil(_MAX_TIMES * needed_s * frame_rate_hz) + _FURTHER_FRAMES):
        begin_s = start_s + frame / frame_rate_hz
        bursts = np.arange(int(begin_s / burst_s), int((begin_s + readout_s) / burst_s) + 1)
        observed = _observed(bursts, begin_s, begin_s + readout_s, profile)
        labels = sending.labels(bursts, profile.columns, profile.payload_symbols)
        llr = detect(labels, _W, snr_db, rng) * observed[:, :, None, None]
        visible += int(observed.sum()) * burst_bits
        shown = FrameSoftBits(bursts - int(start_s / burst_s), llr, time_s=frame / frame_rate_hz, frame=frame)
        start = time.process_time()
        events = receiver.add(shown)
        cpu_s += time.process_time() - start
        if events:
            seconds = shown.time_s + readout_s
            came = {"exact": events[0].data[:size] == data, "seconds": seconds}
            break
    if came["exact"]:
        came |= {"kbps": 8 * size / came["seconds"] / 1e3, "of_visible": 8 * size / visible}
    return {**came, "cpu_s": cpu_s, "packets": []}


def detect(
    labels: NDArray[np.uint8], w: int, snr_db: Sequence[float] | FloatArray, rng: np.random.Generator
) -> Float32Array:
    """Ratios (n, N, C, 7) of labels (n, N, C) that were sent with weight `w` and seen in white noise."""
    k, words = bits_per_symbol(w), codebook(w).astype(np.float32)
    amplitude = (10 ** (np.asarray(snr_db, np.float32) / 20))[:, None].astype(np.float32)
    sent = words[labels >> (7 - k)]
    observed = amplitude * sent + rng.standard_normal(sent.shape, np.float32)
    score = (amplitude * (observed - amplitude / 2)) @ words.T
    likely = np.exp(score - score.max(axis=-1, keepdims=True))
    bits = ((np.arange(1 << k)[:, None] >> np.arange(k - 1, -1, -1)) & 1).astype(np.float32)
    out = np.zeros((*labels.shape, 7), np.float32)
    out[..., :k] = np.log(likely @ bits + 1e-12) - np.log(likely @ (1 - bits) + 1e-12)
    return np.clip(out, -_MAX_LLR, _MAX_LLR)


def _observed(bursts: NDArray[np.int64], begin: float, end: float, screen: ScreenProfile) -> NDArray[np.bool_]:
    """(B, N) symbols that lie within a frame as a whole, in any copy."""
    slot_s = 1 / screen.slot_rate_hz
    symbol = (PREAMBLE_SLOTS + SLOTS_PER_SYMBOL * np.arange(screen.payload_symbols)) * slot_s
    copy = bursts[:, None] * screen.repeats + np.arange(screen.repeats)
    at = (copy * screen.packet_s)[..., None] + symbol
    inside = (at >= begin) & (at + SLOTS_PER_SYMBOL * slot_s <= end)
    return np.asarray(inside.any(axis=1))
