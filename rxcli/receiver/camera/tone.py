"""The tone curve of a picture whose slots are known.

Rows see every share of a slot, and where values follow light their values lie on a line over those shares. A curve that
was undone wrongly bends that line: light to the power of p is bent by what w^p is above or below w.
"""

from __future__ import annotations

import numpy as np

from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.strips import Strips
from rxcli.receiver.camera.waves import Surroundings, residual_of
from rxcli.types import Float32Array, FloatArray

#: Exponent that makes light of values, as nearly as a power of them does, by the tone curve.
_EXPONENTS = {"srgb": 2.2, "linear": 1.0}


def tone_exponent(strips: Strips, wave: Float32Array, window: int) -> tuple[float, float] | None:
    """The exponent that makes light of the picture's values, and its standard deviation.

    Args:
        strips: in readout order; sampled with the curve `strips.tone` undone.
        wave: (M, R) share 0..1 of the slots' light that every row sees.
        window: rows over which the picture may be taken as constant.

    Returns:
        About 2.2 for sRGB, 1.9 for BT.709 and 1 for values that follow light; of dark pictures more, because sRGB has
        a straight toe. None where values are known to follow light, or no row sees shares between none and all.
    """
    if strips.tone is None:
        return None
    inside = strips.inside
    around = Surroundings.of(strips.light, inside, window)
    near = around.moments(wave)
    _, spread = residual_of(strips, near, near.gain, wave, window)
    weight = inside / spread

    def about(values: Float32Array) -> Float32Array:
        centred: Float32Array = (values - around.mean_of(values)) * near.gain
        return centred

    def by_column(values: Float32Array) -> FloatArray:
        summed: FloatArray = (values * weight).reshape(strips.n_columns, -1).sum(axis=1, dtype=np.float64)
        return summed

    line, arc, light = about(wave), about(wave * (1 - wave)), strips.light - near.value
    on_line = by_column(arc * line) / np.maximum(by_column(line * line), 1e-9)
    pull = by_column(arc * light) - on_line * by_column(line * light)
    information = by_column(arc * arc) - on_line * by_column(arc * line)
    if information.sum() <= 0:
        return None
    curvature = pull.sum() / information.sum()
    sd = np.hypot(np.linalg.norm(pull - curvature * information) / information.sum(), SETTINGS.tone_bend_sd)
    half = max(0.5 + curvature / 4, SETTINGS.least_half)
    power = -np.log2(half)
    exponent = _EXPONENTS[strips.tone] / power
    return float(exponent), float(exponent * sd / (4 * np.log(2) * half * power))


def is_linear(tone: tuple[float, float] | None) -> bool:
    """Whether a picture of some exponent is read as one whose values follow light."""
    return tone is not None and tone[0] < SETTINGS.linear_below
