"""Why a picture cannot be received: what it looks like, and the next step."""

import numpy as np

from rxcli.numerics import TINY
from rxcli.receiver.camera.proposals import stripe_rows
from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.strips import ColumnStrips, levelled
from rxcli.types import BoolArray, Float32Array, FloatArray

NO_HEADERS = (
    "there are stripes but no packet header where it should be; the screen may show less than one packet (send more "
    "photos, film, or move closer), the picture may be merged from several exposures (switch HDR off), or the screen "
    "is none of those tried"
)


def why_not(strips: ColumnStrips) -> str:
    """Why no clock was found: what the picture looks like, and the next step."""
    likeness, lit = stripe_likeness(strips)
    striped = lit & (likeness > SETTINGS.striped_likeness)
    if not lit.any():
        return "the screen is dark; show a brighter picture or raise the exposure"
    if not striped.any():
        return (
            "no stripes of a modulated backlight show, or too faint ones; photograph a screen that sends, show a "
            "brighter picture on it, and use the electronic shutter, HDR and night mode off (a mechanical or global "
            "shutter sees no slots)"
        )
    if striped[lit].mean() < SETTINGS.striped_share:
        return (
            "only a part of the screen's height shows stripes; the picture may be merged from several exposures or "
            "taken with flash: switch HDR and flash off, or use a manual-camera app"
        )
    width = stripe_rows(strips)
    if width < SETTINGS.half_width_slots[0] * SETTINGS.min_rows_per_slot:
        return (
            f"the stripes are about {width:.1f} rows wide, too few to separate slots (at least "
            f"{SETTINGS.min_rows_per_slot} rows a slot); use the picture in its full size, or a slower slot rate"
        )
    return NO_HEADERS


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
