"""Maps of a picture that tell why a screen was found where it was, or was not: stripes, and grids of columns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rxcli.results.overlay import encoded_jpeg
from rxcli.types import FloatArray, Frame

if TYPE_CHECKING:
    from rxcli.receiver.screen.grid import Grid

#: Width of a map, pixels, and grids that are drawn.
_WIDTH, _MAX_GRIDS = 640, 3
_QUALITY = 85
#: Grey levels of nothing and of all.
_LOW, _RANGE = 20, 215


def stripe_map(frame: Frame) -> dict[str, Any] | None:
    """Where the picture has stripes that neighbouring pixels share; None for tiny pictures."""
    from rxcli.receiver.corners import levels_of
    from rxcli.receiver.screen.picture import MIN_SIZE, Picture, reduce
    from rxcli.receiver.screen.stripes import find_stripes

    if min(frame.width, frame.height) < MIN_SIZE:
        return None
    levels = levels_of(frame)
    plane = reduce(Picture(frame.pixels, levels["black"], levels["white"], levels.get("mosaic_period", 1)))
    striped = find_stripes(plane).striped
    return {
        "title": "Where the picture has stripes",
        "told": f"Stripes were found in {100 * float(striped.mean()):.0f} % of the picture.",
        "caption": "White: light that changes from row to row alike in neighbouring pixels, as only a flickering light "
        "does. The search for the screen begins with this map.",
        **_drawn(frame, striped),
    }


def column_map(frame: Frame) -> dict[str, Any] | None:
    """Coherent strips, with the grids of columns that may be; None for tiny pictures."""
    from rxcli.receiver.corners import levels_of
    from rxcli.receiver.screen.coherence import measure_coherence
    from rxcli.receiver.screen.columns import ColumnLayout, likely_grids
    from rxcli.receiver.screen.picture import MIN_SIZE
    from rxcli.receiver.screen.waveforms import StripLight

    if min(frame.width, frame.height) < MIN_SIZE:
        return None
    coherence = measure_coherence(frame.pixels, mosaic_period=int(levels_of(frame).get("mosaic_period", 1)))
    light = StripLight.of(coherence, ColumnLayout().sigma, None)
    grids = likely_grids(coherence, light, None)[:_MAX_GRIDS]
    told = f"{len(grids)} possible grids of columns." if len(grids) != 1 else "One possible grid of columns."
    scale = _WIDTH / frame.width
    return {
        "title": "Where the columns may be",
        "told": told if grids else "No grid of columns stands out: strips of pixels change alike nowhere.",
        "caption": "Bright: neighbouring strips of pixels change alike from row to row, as they do in front of a "
        "backlight however dark the picture is. Lines: borders of columns, across which they do not. Packets decide "
        "between rival grids.",
        **_drawn(frame, coherence.lit),
        "grids": [
            {
                "pitch_px": grid.pitch_px,
                "share": grid.likelihood / grids[0].likelihood,
                "lines": [(line * scale).round(1) for line in _borders(grid, frame.width, frame.height)],
            }
            for grid in grids
        ],
    }


def _drawn(frame: Frame, shares: Any) -> dict[str, Any]:
    """Shares 0..1 of any grid over the frame as a picture."""
    height = round(_WIDTH * frame.height / frame.width)
    places = [np.arange(n) * size // n for n, size in zip((height, _WIDTH), shares.shape, strict=True)]
    levels = (_LOW + _RANGE * shares[np.ix_(*places)].astype(np.float64)).astype(np.uint8)
    return {"jpeg": encoded_jpeg(levels, _QUALITY), "width": _WIDTH, "height": height, "corners": [], "outlines": []}


def _borders(grid: Grid, width: int, height: int) -> list[FloatArray]:
    """(n, 2) pixels along every border of a grid's columns in a picture."""
    y = np.linspace(0, height - 1, 13)
    x = np.linspace(0, width - 1, 120)
    u = grid.columns_at(np.stack(np.meshgrid(x, y), axis=-1))
    lines = []
    for border in range(int(np.ceil(u.min())), int(np.floor(u.max())) + 1):
        at = np.array([np.interp(border, row, x, np.nan, np.nan) for row in u])
        seen = np.isfinite(at)
        if seen.sum() > 1:
            lines.append(np.stack([at[seen], y[seen]], axis=-1))
    return lines
