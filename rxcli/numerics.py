"""Numerical functions shared by all stages."""

import os
from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.protocol import HEADER, SLOTS_PER_SYMBOL
from rxcli.types import Float32Array, FloatArray

#: Lower limit of divisors, far below any significant light, weight or variance.
TINY = 1e-12
#: Lower limit of likelihoods in single precision, so that their logarithm exists.
MIN_FLOAT32 = np.finfo(np.float32).tiny
#: Median of the absolute value of a normal variable of unit variance, and its two-sided 95 % quantile.
NORMAL_MEDIAN, Z95 = 0.6745, 1.959963984540054
#: Change of a header's slots, lit 1 and dark -1, at its borders.
_HEADER_STEPS = np.diff(np.concatenate([[0.0], 2.0 * np.array(HEADER) - 1, [0.0]]))


@lru_cache(maxsize=1)
def _blas() -> Any:
    """Controller of the threads of matrix products; None where there is one anyway."""
    if os.environ.get("OPENBLAS_NUM_THREADS") == "1" and "openblas" in str(np.show_config(mode="dicts")):
        return None
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def one_blas_thread() -> AbstractContextManager[object]:
    """Run matrix products on one thread within the block.

    The products are small, so further threads mostly wait actively and slow down the threads of the decoder.
    """
    controller = _blas()
    return nullcontext() if controller is None else controller.limit(limits=1, user_api="blas")


def box_sums(values: Float32Array, half: int) -> Float32Array:
    """Sum over the samples at most `half` away along the last axis, zero beyond the ends; same shape."""
    import cv2

    flat = np.ascontiguousarray(values.reshape(-1, values.shape[-1]))
    summed = cv2.boxFilter(flat, -1, (2 * half + 1, 1), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(summed, np.float32).reshape(values.shape)


def mean_of_valid(values: Float32Array, valid: Float32Array, half: int) -> Float32Array:
    """Mean over the valid samples at most `half` away along the last axis, 0 where there are none; same shape.

    Args:
        values: 0 where not valid.
        valid: 1 or 0.
        half: samples to each side.
    """
    return np.asarray(box_sums(values, half) / np.maximum(box_sums(valid, half), 1), np.float32)


def local_mean(values: Float32Array, window: int) -> Float32Array:
    """Mean over a window of (at least) `window` samples, mirrored at the ends; (n, samples), same shape."""
    import cv2

    return np.asarray(cv2.blur(values, (window | 1, 1)))


def waves_of(turns: FloatArray) -> NDArray[np.complex64]:
    """exp(2 pi i `turns`), in single precision after whole turns are taken off."""
    angle = np.asarray((turns - np.rint(turns)) * (2 * np.pi), np.float32)
    out = np.empty(angle.shape, np.complex64)
    np.cos(angle, out=out.real)
    np.sin(angle, out=out.imag)
    return out


def best_run(gain: FloatArray) -> tuple[int, int]:
    """The part of `gain` (n,) with the largest sum: its first place, and the one after its last."""
    total = np.concatenate([[0.0], np.cumsum(gain)])
    end = int((total - np.minimum.accumulate(total)).argmax())
    return int(total[: end + 1].argmin()), end


def folded(values: NDArray[Any], period: int) -> NDArray[Any]:
    """(..., period) sums of values (..., n) over all periods."""
    padded = np.zeros((*values.shape[:-1], -(-values.shape[-1] // period) * period), values.dtype)
    padded[..., : values.shape[-1]] = values
    return np.asarray(padded.reshape(*values.shape[:-1], -1, period).sum(axis=-2))


def header_correlation(total: FloatArray, samples_per_slot: int) -> FloatArray:
    """Mean over the slots of a header that starts at each sample, dark slots negated.

    Args:
        total: (..., n + 1) cumulative sums at the borders of samples.
        samples_per_slot: samples per slot.

    Returns:
        (..., n + 1 - samples of a header), in the samples' unit.
    """
    length = SLOTS_PER_SYMBOL * samples_per_slot
    n = total.shape[-1] - length
    out = np.zeros((*total.shape[:-1], n))
    for slot in np.flatnonzero(_HEADER_STEPS):
        out -= _HEADER_STEPS[slot] * total[..., slot * samples_per_slot :][..., :n]
    return out / length


def peak_offset(before: FloatArray, peak: FloatArray, after: FloatArray) -> FloatArray:
    """Offset, in samples, of the top of the parabola through a peak and its neighbours; at most half a sample."""
    return np.asarray(0.5 * (after - before) / np.maximum(2 * peak - before - after, TINY))
