"""Sums over soft bits, and what they are worth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rxcli.link.ldpc import LLR_STEP
from rxcli.types import Message, ReceivedObject

Float32 = NDArray[np.float32]
#: Ratios beyond this are no surer to the decoder.
MAX_LLR = 127 * LLR_STEP
_LN2 = float(np.log(2.0))


Event = Message | ReceivedObject

# -- sums --------------------------------------------------------------------------------------------------------------


def surprise(llr: Float32) -> Float32:
    """ln(1 + e^llr) - ln 2: what sums of ratios are weighed with, see `alike`."""
    # Single precision does for sums, and has a quick logarithm; log1p has not.
    return np.asarray(np.log(1 + np.exp(-np.abs(llr))) + np.maximum(llr, 0) - np.float32(_LN2), np.float32)


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
    odds = np.exp(-a)
    # H2 of 1 / (1 + e^a), natural logarithm: ln(1 + e^-a) + a / (1 + e^a).
    return np.asarray(1 - (np.log1p(odds) + a * odds / (1 + odds)) / _LN2)


#: Bits of information of a ratio in the decoder's steps, at its value as uint8.
INFORMATION_OF_STEPS = information(np.arange(256, dtype=np.uint8).view(np.int8) * LLR_STEP).astype(np.float32)


def log_likelihood(bits: NDArray[np.uint8], llr: NDArray[np.floating]) -> NDArray[np.float64]:
    """Log-likelihood of bits over bits of any kind, summed over the last axis."""
    signed = np.where(bits > 0, llr, -llr).astype(np.float64)
    return np.asarray((_LN2 - np.log1p(np.exp(-np.abs(signed))) + np.minimum(signed, 0)).sum(axis=-1))
