"""What goes into the link layer's receiver, what comes out of it, and sums over soft bits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rxcli.link.formats import MessageKind
from rxcli.link.ldpc import LLR_STEP

Float32 = NDArray[np.float32]
#: Ratios beyond this are no surer to the decoder.
MAX_LLR = 127 * LLR_STEP
_LN2 = float(np.log(2.0))


@dataclass(frozen=True, slots=True)
class FrameSoftBits:
    """What one frame, or one burst, says of the payload's bits: B bursts, N payload symbols, C columns."""

    #: (B,) int64 number of every burst in its epoch, ascending.
    burst: NDArray[np.int64]
    #: (B, N, C, 7) float32 ln p(1)/p(0) of every label's bits, first bit first; 0 or NaN where nothing is known.
    llr: Float32
    #: Burst numbers of one epoch count on one clock; those of different epochs cannot be compared.
    epoch: int = 0
    source: str = ""
    frame: int = 0
    time_s: float = 0.0

    @classmethod
    def of_columns(
        cls,
        burst: NDArray[np.int64],
        bit_llr: NDArray[np.floating],
        limit: NDArray[np.floating] | float = MAX_LLR,
        epoch: int = 0,
        source: str = "",
        frame: int = 0,
        time_s: float = 0.0,
    ) -> FrameSoftBits:
        """From a detector's ratios, (B, C, N, 7), limited to `limit`, a number or (B, C)."""
        most = np.broadcast_to(np.asarray(limit, np.float32), bit_llr.shape[:2])[..., None, None]
        limited = np.clip(np.nan_to_num(bit_llr, nan=0.0, posinf=MAX_LLR, neginf=-MAX_LLR), -most, most)
        llr = np.ascontiguousarray(limited.transpose(0, 2, 1, 3), np.float32)
        return cls(np.asarray(burst, np.int64), llr, epoch, source, frame, time_s)


@dataclass(frozen=True, slots=True)
class Message:
    """A short message that came."""

    kind: MessageKind
    data: bytes
    source: str
    #: Frame in which it was complete.
    frame: int
    time_s: float

    @property
    def text(self) -> str | None:
        """Text or URI; None for raw bytes."""
        return None if self.kind == "raw" else self.data.decode("utf-8")


@dataclass(frozen=True, slots=True)
class ReceivedObject:
    """A file that came whole; its SHA-256 fits."""

    #: Safe to be used as a file's name.
    name: str
    data: bytes
    sha256: str
    object_id: int
    n_blocks: int
    source: str
    #: Frame in which it was complete.
    frame: int
    time_s: float


@dataclass(frozen=True, slots=True)
class ObjectProgress:
    """A file under way."""

    object_id: int
    #: Bytes of the container, a little more or less than the file's.
    container_bytes: int
    n_blocks: int
    blocks_done: int
    #: Of what must be seen, 0..1.
    share: float
    #: More seconds of such a clip that would do; None where nothing says how many.
    seconds_left: float | None


Event = Message | ReceivedObject

# -- sums --------------------------------------------------------------------------------------------------------------


def surprise(llr: Float32) -> Float32:
    """ln(1 + e^llr) - ln 2: what sums of ratios are weighed with, see `alike`."""
    return np.asarray(np.log1p(np.exp(-np.abs(llr))) + np.maximum(llr, 0) - np.float32(_LN2), np.float32)


def alike(together: Float32, alone: float) -> float:
    """Log-likelihood that ratios that were added are of the same bits, over bits that differ by chance.

    Args:
        together: the sums.
        alone: sum of `surprise` of every ratio alone.
    """
    return float(surprise(together).sum(dtype=np.float64)) - alone


def information(llr: NDArray[np.floating]) -> NDArray[np.float64]:
    """Bits of information that ratios hold, 1 - H2; what contradicts itself holds little."""
    a = np.minimum(np.abs(np.asarray(llr, np.float64)), 40.0)
    # H2 of 1 / (1 + e^a), in nats: ln(1 + e^-a) + a / (1 + e^a).
    return np.asarray(1 - (np.log1p(np.exp(-a)) + a / (1 + np.exp(a))) / _LN2)


#: Bits of information of a ratio in the decoder's steps, at its value as uint8.
INFORMATION_OF_STEPS = information(np.arange(256, dtype=np.uint8).view(np.int8) * LLR_STEP).astype(np.float32)


def log_likelihood(bits: NDArray[np.uint8], llr: NDArray[np.floating]) -> NDArray[np.float64]:
    """Log-likelihood of bits over bits of any kind, summed over the last axis."""
    signed = np.where(bits > 0, llr, -llr).astype(np.float64)
    return np.asarray((_LN2 - np.log1p(np.exp(-np.abs(signed))) + np.minimum(signed, 0)).sum(axis=-1))
