"""Sums over soft bits, their similarity and their information."""

import numpy as np
from numpy.typing import NDArray

from rxcli.link.ldpc import LLR_STEP
from rxcli.types import Message, ReceivedObject

Float32 = NDArray[np.float32]
#: Limit of log-likelihood ratios in the decoder.
MAX_LLR = 127 * LLR_STEP
#: Log-likelihood ratio below which soft bits that were added do not belong to the same bits.
MIN_SIMILARITY = -8.0
#: Information at which a beacon or an announcement is first decoded, relative to its bits.
TRY_FROM = 1.02
LN2 = float(np.log(2.0))

Event = Message | ReceivedObject

# -- sums --------------------------------------------------------------------------------------------------------------


def surprise(llr: Float32, axis: tuple[int, ...] | None = None) -> NDArray[np.float64]:
    """Sum of ln(1 + e^llr) - ln 2 over some axes, or all.

    That of added ratios, less that of the separate ones, is the log-likelihood ratio of equal against independent bits.
    """
    # Single precision suffices for the terms; its logarithm is fast, its log1p is not.
    terms = np.log(1 + np.exp(-np.abs(llr))) + np.maximum(llr, 0) - np.float32(LN2)
    return np.asarray(terms.sum(axis, dtype=np.float64))


def information(llr: NDArray[np.floating]) -> NDArray[np.float64]:
    """Information of log-likelihood ratios, bits: 1 - H2, small where added ratios contradict each other."""
    a = np.minimum(np.abs(np.asarray(llr, np.float64)), 40.0)
    odds = np.exp(-a)
    # H2 of 1 / (1 + e^a), natural logarithm: ln(1 + e^-a) + a / (1 + e^a).
    return np.asarray(1 - (np.log1p(odds) + a * odds / (1 + odds)) / LN2)


#: Information, bits, of a ratio in the decoder's steps, indexed by its value as uint8.
INFORMATION_OF_STEPS = information(np.arange(256, dtype=np.uint8).view(np.int8) * LLR_STEP).astype(np.float32)


def log_likelihood(bits: NDArray[np.uint8], llr: NDArray[np.floating]) -> NDArray[np.float64]:
    """Log-likelihood of bits relative to arbitrary bits, summed over the last axis."""
    signed = np.where(bits > 0, llr, -llr).astype(np.float64)
    return np.asarray((LN2 - np.log1p(np.exp(-np.abs(signed))) + np.minimum(signed, 0)).sum(axis=-1))
