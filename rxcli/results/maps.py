"""Map of a picture that explains the found or missing screen: coherence and the column grid."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rxcli.results.overlay import drawing
from rxcli.types import FloatArray, Frame

if TYPE_CHECKING:
    from rxcli.receiver.screen.grid import Grid

#: Width of a map, pixels.
_WIDTH = 640
_QUALITY = 85
#: Grey levels of nothing and of all.
_LOW, _RANGE = 20, 215


def column_map(frame: Frame) -> dict[str, Any] | None:
    """Coherent strips, with the grid of columns that was found; None for tiny pictures."""
    from rxcli.options import ReceiverOptions
    from rxcli.receiver.plane import read_plane
    from rxcli.receiver.screen.bright import bright_quadrilateral
    from rxcli.receiver.screen.find import MIN_SIZE_PX, find_screens
    from rxcli.receiver.screen.strips import read_strips
    from rxcli.receiver.search.outlines import layouts_of

    if min(frame.width, frame.height) < MIN_SIZE_PX:
        return None
    plane = read_plane(frame)
    screens = find_screens(plane, layouts_of(ReceiverOptions()), bright=bright_quadrilateral(plane))
    grids = [screen[0].grid for screen in screens[:1] if screen[0].grid is not None]
    scale = _WIDTH / frame.width
    return {
        "title": "Where the columns may be",
        "text": "A grid of columns was found."
        if grids
        else "No grid of columns stands out: no strips of pixels change together.",
        "caption": "Bright: neighbouring strips of pixels change together from row to row, as they do in front of a "
        "backlight however dark the picture is. Lines: borders of columns, across which they do not.",
        **_drawn(frame, read_strips(plane).coherence),
        "grids": [
            {
                "pitch_px": grid.pitch_px,
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
    return drawing(levels, _QUALITY)


def _borders(grid: Grid, width: int, height: int) -> list[FloatArray]:
    """(n, 2) pixels along every border of a grid's columns in a picture."""
    y = np.linspace(0, height - 1, 13)
    x = np.linspace(0, width - 1, 120)
    u = grid.columns_at(np.stack(np.meshgrid(x, y), axis=-1))
    lines = []
    for border in range(int(np.ceil(u.min())), int(np.floor(u.max())) + 1):
        at = np.array([np.interp(border, row, x, np.nan, np.nan) for row in u])
        finite = np.isfinite(at)
        if finite.sum() > 1:
            lines.append(np.stack([at[finite], y[finite]], axis=-1))
    return lines
