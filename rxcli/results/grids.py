"""The map of coherent strips with the column grids that may be: why a screen was found where it was, or was not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rxcli.results.overlay import jpeg_address
from rxcli.types import FloatArray, Frame

if TYPE_CHECKING:
    from rxcli.receiver.screen.grid import Grid

#: Width of the map, pixels; grids that are drawn, and their colours.
_WIDTH, _MOST = 640, 3
_COLOURS = ("#ffd43b", "#4dabf7", "#ff8787")


def rival_grids(frame: Frame) -> str:
    """HTML of the map of a frame's coherent strips, rival grids of columns drawn on it; empty for tiny pictures."""
    from rxcli.receiver.corners import levels_of
    from rxcli.receiver.screen.coherence import measure_coherence
    from rxcli.receiver.screen.columns import ColumnLayout, likely_grids
    from rxcli.receiver.screen.picture import MIN_SIZE
    from rxcli.receiver.screen.waveforms import StripLight

    if min(frame.width, frame.height) < MIN_SIZE:
        return ""
    coherence = measure_coherence(frame.pixels, mosaic_period=int(levels_of(frame).get("mosaic_period", 1)))
    grids = likely_grids(coherence, StripLight.of(coherence, ColumnLayout().sigma, None), None)[:_MOST]
    height = round(_WIDTH * frame.height / frame.width)
    places = [(np.arange(n) * len(axis) // n) for n, axis in ((height, coherence.y), (_WIDTH, coherence.x))]
    map_ = (20 + 215 * coherence.lit[np.ix_(*places)]).astype(np.uint8)
    scale = _WIDTH / frame.width
    lines, legend = [], []
    for number, (grid, colour) in enumerate(zip(grids, _COLOURS, strict=False)):
        lines += [
            f'<polyline points="{" ".join(f"{x * scale:.1f},{y * scale:.1f}" for x, y in line)}" fill="none" '
            f'stroke="{colour}" stroke-width="1.5"/>'
            for line in _borders(grid, frame.width, frame.height)
        ]
        share = 100 * grid.likelihood / grids[0].likelihood
        legend.append(
            f'<li><span style="color:{colour}" aria-hidden="true">■</span> Grid {number + 1}: columns '
            f"{grid.pitch_px:.0f} pixels wide, explains {share:.1f} % of what the best one does</li>"
        )
    told = f"{len(grids)} possible grids of columns" if len(grids) != 1 else "One possible grid of columns"
    if not grids:
        told = "No grid of columns stands out: strips of pixels change alike nowhere, or do not change at borders"
    return (
        "<details><summary>Where the columns may be</summary><figure>"
        f'<div class="view"><img src="{jpeg_address(map_, 85)}" width="{_WIDTH}" '
        f'height="{height}" alt="{told}."><svg viewBox="0 0 {_WIDTH} {height}" aria-hidden="true">{"".join(lines)}'
        f"</svg></div><figcaption>{told}. Bright: neighbouring strips of pixels change alike from row to row, as they "
        "do in front of a backlight however dark the picture is. Lines: borders of columns, across which they do not. "
        "Packets decide between rival grids.</figcaption></figure>"
        f'<ul class="legend">{"".join(legend)}</ul></details>'
    )


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
