"""Direction of the stripes in a picture: a screen that sends shows them across its columns."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import TINY, local_mean
from rxcli.types import Float32Array

#: Lean from which stripes have a direction: sending screens lean by 0.2 or more, photographs mostly by less than 0.1.
MIN_LEAN = 0.12
#: Pairs of lines that are compared, pixels that are averaged to a line, and pixels over which lines are levelled.
_PAIRS, _LINE_PX, _LEVEL_PX = 32, 2, 64
#: Margin of the picture that is left out, and distance of a pair, both as shares of the picture; the least in pixels.
_MARGIN, _GAP, _MIN_GAP_PX = 0.1, 1 / 160, 8


def stripe_lean(pixels: NDArray[Any]) -> float:
    """Correlation of neighbouring columns of pixels less that of neighbouring rows, -2..2.

    Positive: stripes run across the picture; negative: they run downwards; near 0: the picture has no stripes.
    """
    return _correlation(pixels) - _correlation(pixels.T)


def _correlation(pixels: NDArray[Any]) -> float:
    """Correlation of columns of pixels some pixels apart; those of much contrast count the more."""
    width = pixels.shape[1]
    gap = max(int(_GAP * width), _MIN_GAP_PX)
    starts = np.linspace(_MARGIN * width, (1 - _MARGIN) * width - gap - _LINE_PX, _PAIRS).astype(int)
    near, far = (_levelled(pixels, start) for start in (starts, starts + gap))
    return float((near * far).sum() / (np.sqrt((near * near).sum() * (far * far).sum()) + TINY))


def _levelled(pixels: NDArray[Any], starts: NDArray[np.int64]) -> Float32Array:
    lines = np.stack([pixels[:, start : start + _LINE_PX].mean(axis=1, dtype=np.float32) for start in starts.tolist()])
    return np.asarray(lines - local_mean(lines, _LEVEL_PX), np.float32)
