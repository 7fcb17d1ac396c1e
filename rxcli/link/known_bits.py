"""What is known of a beacon's bits before it is decoded: zeros fill up its body, and texts are mostly ASCII.

A text of 34 bytes lies in a body of 64, so that nearly half of the bits that its code protects are known as soon as the
soft bits show where the zeros begin.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from rxcli.link.formats import KINDS
from rxcli.link.layout import BEACON_ID, BEACON_LENGTHS, BeaconLayout
from rxcli.link.sequences import whiten
from rxcli.link.softbits import MAX_LLR, Float32, information

#: Log-odds of a text of other letters than ASCII; and limit of the log-likelihood ratio of a byte's first bit, as a
#: text may hold some other letters.
_OTHER_LETTERS, _MAX_FIRST_BIT = 1.0, 4.0


@dataclass(frozen=True, slots=True, eq=False)
class KnownBits:
    """Log-likelihood ratios of the bits of beacons, to be added to those of the light."""

    #: (n, first_sent) of the bits that are never sent; (n, n_bits) of the buffer.
    unsent: Float32
    sent: Float32
    #: (n,) expected number of known bits.
    n_bits: NDArray[np.float64]
    #: (n,) log-likelihood ratio of zeros at the end of the body, however many, against bits of any kind.
    llr: NDArray[np.float64]

    def of(self, which: NDArray[np.int64]) -> KnownBits:
        """Those of some beacons."""
        return KnownBits(self.unsent[which], self.sent[which], self.n_bits[which], self.llr[which])

    def information(self, buffers: Float32) -> NDArray[np.float64]:
        """(n,) bits of information, with those of the light (n, n_bits)."""
        return np.asarray(information(buffers + self.sent).sum(axis=1) + information(self.unsent).sum(axis=1))


def known_bits(layout: BeaconLayout, buffers: Float32) -> KnownBits:
    """What is known of the bits of beacons.

    Args:
        layout: of the beacons.
        buffers: (n, n_bits) log-likelihood ratios of the light, from which the number of zeros is inferred.
    """
    length, first_sent = layout.length, layout.code.first_sent
    sign = _signs(length)
    coded = np.pad(buffers, ((0, 0), (first_sent, 0)))[:, : 8 * length]
    of_zero = (np.log(2) - np.logaddexp(0, -(coded * sign).astype(np.float64))).reshape(len(buffers), length, 8)
    # Zeros from each byte on that a shorter body would not hold; or none.
    shortest = max((n for n in BEACON_LENGTHS if n < length), default=1) + 1
    zeros = np.pad(np.cumsum(of_zero[:, : shortest - 1 : -1].sum(axis=2), axis=1)[:, ::-1], ((0, 0), (0, 1)))
    top = zeros.max(axis=1, keepdims=True)
    weight = np.exp(zeros - top)
    total = weight.sum(axis=1, keepdims=True)
    # The first of them may be a letter that is seen in part.
    share = np.pad(np.cumsum(weight / total, axis=1), ((0, 0), (shortest + 1, 0)))[:, :length]
    is_letter = (1 - share) * (np.arange(length) > 0)
    odds = (of_zero[..., 0] * is_letter).sum(axis=1, keepdims=True) - _OTHER_LETTERS
    is_ascii = 1 / (1 + np.exp(-np.clip(odds, -MAX_LLR, MAX_LLR)))
    known = np.repeat(share[..., None], 8, axis=2)
    limit = np.expm1(_MAX_FIRST_BIT) / (np.exp(_MAX_FIRST_BIT) + 1)
    known[..., 0] = np.maximum(known[..., 0], limit * is_ascii * is_letter)
    known[:, 0, : 8 - len(KINDS).bit_length()] = 1.0
    llr = np.log1p(known) - np.log(np.maximum(1 - known, np.exp(-MAX_LLR)))
    llr = (llr.reshape(len(buffers), 8 * length) * sign).astype(np.float32)
    sent = np.pad(llr[:, first_sent:], ((0, 0), (0, layout.n_bits + first_sent - 8 * length)))
    of_zeros = top[:, 0] + np.log(total[:, 0] / zeros.shape[1])
    return KnownBits(llr[:, :first_sent], sent, known.sum(axis=(1, 2)), of_zeros)


@cache
def _signs(length: int) -> NDArray[np.float32]:
    """(8 L,) 1 where whitening makes a one of a zero, otherwise -1."""
    white = np.unpackbits(np.frombuffer(whiten(bytes(length), BEACON_ID, length), np.uint8))
    return np.where(white > 0, 1, -1).astype(np.float32)
