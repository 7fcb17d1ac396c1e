"""Why a picture cannot be received: what it looks like."""

import numpy as np

from rxcli.numerics import TINY
from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.stripes import Stripes
from rxcli.receiver.camera.strips import ColumnStrips, levelled
from rxcli.types import BoolArray, Float32Array, FloatArray, Remark


def why_not(stripes: Stripes) -> Remark:
    """Why no clock was found, by what the picture looks like."""
    likeness, lit = stripe_likeness(stripes.strips)
    striped = lit & (likeness > SETTINGS.striped_likeness)
    if not lit.any():
        return Remark("screen_dark")
    if not striped.any():
        return Remark("no_stripes")
    if striped[lit].mean() < SETTINGS.striped_share:
        return Remark("part_striped")
    if (width := stripes.half_width) < SETTINGS.half_width_slots[0] * SETTINGS.min_rows_per_slot:
        return Remark("narrow_stripes", {"rows": width, "min_rows_per_slot": SETTINGS.min_rows_per_slot})
    return Remark("no_headers")


def stripe_likeness(strips: ColumnStrips) -> tuple[FloatArray, BoolArray]:
    """Correlation of neighbouring strips in bands of rows, 0..1; and whether a band is lit."""
    level = levelled(strips.light, strips.inside, strips.rows.size // SETTINGS.likeness_bands)
    blocks = np.linspace(0, strips.rows.size, SETTINGS.likeness_bands + 1).astype(int)[:-1]

    def summed(values: Float32Array) -> FloatArray:
        return np.asarray(np.add.reduceat(values, blocks, axis=1), np.float64)

    product = summed(level[:-1] * level[1:]).sum(axis=0)
    power = np.sqrt(summed(level[:-1] ** 2).sum(axis=0) * summed(level[1:] ** 2).sum(axis=0))
    lit = summed(strips.light).max(axis=0) > 0.02 * strips.rows.size / SETTINGS.likeness_bands
    return np.asarray(product / np.maximum(power, TINY)), np.asarray(lit)
