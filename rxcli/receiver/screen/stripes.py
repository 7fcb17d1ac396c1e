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
#: Width of a line and distance of a pair that show whether all columns have one light, as shares of the picture; and
#: lengths over which lines are levelled then, so that exposures of many slots have no stripes.
_BROAD, _FAR, _N_LEVELS = 1 / 40, 1 / 10, 64


def stripe_lean(pixels: NDArray[Any]) -> float:
    """Correlation of neighbouring columns of pixels less that of neighbouring rows, -2..2.

    Positive: stripes run across the picture; negative: they run downwards; near 0: the picture has no stripes.
    """
    if min(pixels.shape) <= (_MIN_GAP_PX + _LINE_PX) / (1 - 2 * _MARGIN):
        return 0.0
    return _correlation(pixels) - _correlation(pixels.T)


def _correlation(pixels: NDArray[Any]) -> float:
    """Correlation of columns of pixels some pixels apart; those of much contrast count the more."""
    width = pixels.shape[1]
    gap = max(int(_GAP * width), _MIN_GAP_PX)
    starts = np.linspace(_MARGIN * width, (1 - _MARGIN) * width - gap - _LINE_PX, _PAIRS).astype(int)
    near, far = (_levelled(pixels, start, _LINE_PX, _LEVEL_PX) for start in (starts, starts + gap))
    return float((near * far).sum() / (np.sqrt((near * near).sum() * (far * far).sum()) + TINY))


def common_stripes(pixels: NDArray[Any]) -> tuple[float, Float32Array]:
    """Correlation of columns of pixels far apart, where contrast is strongest; and their mean, levelled.

    Columns that send have little in common; of a screen on its side, or of one lamp, all rows have one light.
    """
    height, width = pixels.shape
    line, gap = max(int(_BROAD * width), 1), int(_FAR * width)
    starts = np.linspace(0, width - gap - line, _PAIRS).astype(int)
    near, far = (_levelled(pixels, start, line, max(height // _N_LEVELS, 1)) for start in (starts, starts + gap))
    contrast = np.sqrt((near * near).sum(axis=1) * (far * far).sum(axis=1))
    strongest = np.argsort(contrast)[-_PAIRS // 4 :]
    product = (near * far)[strongest].sum()
    return float(product / (contrast[strongest].sum() + TINY)), (near + far)[strongest].mean(axis=0)


def _levelled(pixels: NDArray[Any], starts: NDArray[np.int64], line_px: int, level_px: int) -> Float32Array:
    lines = np.stack([pixels[:, start : start + line_px].mean(axis=1, dtype=np.float32) for start in starts.tolist()])
    return np.asarray(lines - local_mean(lines, level_px), np.float32)
