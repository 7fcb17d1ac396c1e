"""The light of the columns on every row, from that of their strips: a small linear system per row.

Strips of a column receive light of its two neighbours, so the normal equations A m = b of a row have two bands beside
the diagonal. They are factored as A = L D L' for all rows at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.receiver.channel.known_picture.settings import SETTINGS
from rxcli.types import Float32Array


@dataclass(frozen=True, slots=True)
class RowEquations:
    """Factored normal equations of all rows; arrays (C, R)."""

    #: (C, S, R): gain of a strip's light; and (S, 3) share of each column in it.
    gain: Float32Array
    crosstalk: Float32Array
    #: Inverse of D, and the bands of L.
    inverse: Float32Array
    next: Float32Array
    next_but_one: Float32Array
    #: Information of the light on each column, without the prior.
    precision: Float32Array

    @classmethod
    def of(cls, picture: Float32Array, gain: Float32Array, crosstalk: Float32Array) -> RowEquations:
        """Factor the equations of a picture (C, S, R), whose strips count with a `gain` of picture over variance."""
        left, own, right = crosstalk.T
        products = np.stack([own * own, left * left, right * right, own * right, left * own, left * right])
        of_own, of_left, of_right, own_right, left_own, left_right = (products @ (gain * picture)).swapaxes(0, 1)
        middle = of_own + np.float32(SETTINGS.prior_precision)
        middle[:-1] += of_left[1:]
        middle[1:] += of_right[:-1]
        beside, beyond = np.zeros_like(middle), np.zeros_like(middle)
        beside[:-1] = own_right[:-1] + left_own[1:]
        beyond[:-2] = left_right[1:-1]
        inverse, band_1, band_2, precision = _factored(middle, beside, beyond)
        precision = np.maximum(precision - np.float32(SETTINGS.prior_precision), 0)
        return cls(gain, crosstalk, inverse, band_1, band_2, precision)

    def solve(self, light: Float32Array) -> Float32Array:
        """(C, R) light of the columns from that of the strips (C, S, R), shrunk towards 0.5 by the prior."""
        observed = self.crosstalk.T @ (self.gain * light)
        out = observed[:, 1] + np.float32(SETTINGS.prior_precision / 2)
        out[1:] += observed[:-1, 2]
        out[:-1] += observed[1:, 0]
        for i in range(1, len(out)):
            out[i] -= self.next[i - 1] * out[i - 1]
            if i >= 2:
                out[i] -= self.next_but_one[i - 2] * out[i - 2]
        out *= self.inverse
        for i in range(len(out) - 2, -1, -1):
            out[i] -= self.next[i] * out[i + 1]
            if i + 2 < len(out):
                out[i] -= self.next_but_one[i] * out[i + 2]
        return out


def _factored(
    middle: Float32Array, beside: Float32Array, beyond: Float32Array
) -> tuple[Float32Array, Float32Array, Float32Array, Float32Array]:
    """1 / D, the two bands of L, and the inverse of the diagonal of A^-1, of symmetric systems (C, R) with two bands.

    A^-1 by the recursion of Takahashi, Fagan and Chin (1973): from the last column up.
    """
    n, _ = middle.shape
    diagonal, eliminated = middle.copy(), beside.copy()
    reciprocal, band_1, band_2 = np.zeros((3, *middle.shape), np.float32)
    for i in range(n):
        if i >= 1:
            diagonal[i] -= band_1[i - 1] * eliminated[i - 1]
            eliminated[i] -= band_2[i - 1] * eliminated[i - 1]
        if i >= 2:
            diagonal[i] -= band_2[i - 2] * beyond[i - 2]
        reciprocal[i] = 1 / diagonal[i]
        band_1[i], band_2[i] = eliminated[i] * reciprocal[i], beyond[i] * reciprocal[i]
    # Diagonal of A^-1 and the negative of its first band, with two more rows of zeros for the ends.
    inverse, near = np.zeros((2, n + 2, middle.shape[1]), np.float32)
    for i in range(n - 1, -1, -1):
        far = band_1[i] * near[i + 1] - band_2[i] * inverse[i + 2]
        near[i] = band_1[i] * inverse[i + 1] - band_2[i] * near[i + 1]
        inverse[i] = reciprocal[i] + band_1[i] * near[i] - band_2[i] * far
    return reciprocal, band_1, band_2, np.asarray(1 / inverse[:n], np.float32)
