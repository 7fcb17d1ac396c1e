"""Map of a picture that explains the found or missing screen: coherence, and the columns as they were found."""

from typing import Any

import numpy as np

from rxcli.results.cameras import Reception
from rxcli.results.overlay import drawing, outlines_of
from rxcli.types import Frame

#: Width of a map, pixels, and points along a border.
_WIDTH, _POINTS = 640, 13
_QUALITY = 85
#: Grey levels of nothing and of all.
_LOW, _RANGE = 20, 215


def column_map(shown: Reception) -> dict[str, Any] | None:
    """Coherent strips, with the columns of the screen that was found; None for tiny pictures."""
    from rxcli.receiver.plane.read import read_plane
    from rxcli.receiver.screen.find import MIN_SIZE_PX
    from rxcli.receiver.screen.strips import read_strips

    turned = shown.turned
    frame, corners = turned.frame, turned.result.corners
    if min(frame.width, frame.height) < MIN_SIZE_PX:
        return None
    grids, outlines = [], outlines_of(turned)
    if outlines is not None and corners is not None:
        pitch_px = float(np.linalg.norm(corners[1] - corners[0])) / (len(outlines.edges_x) - 1)
        places = np.linspace(0, outlines.rows.size - 1, _POINTS).astype(int)
        scale = _WIDTH / frame.width
        lines = [(np.column_stack([x[places], outlines.rows[places]]) * scale).round(1) for x in outlines.edges_x]
        grids = [{"pitch_px": pitch_px, "lines": lines}]
    return {
        "title": "Where the columns may be",
        "text": "No grid of columns stands out: no strips of pixels change together."
        if corners is None
        else "The screen was found.",
        "caption": "Bright: neighbouring strips of pixels change together from row to row, as they do in front of a "
        "backlight however dark the picture is. Lines: borders of columns, across which they do not.",
        **_drawn(frame, read_strips(read_plane(frame)).coherence),
        "grids": grids,
    }


def _drawn(frame: Frame, shares: Any) -> dict[str, Any]:
    """Shares 0..1 of any grid over the frame as a picture."""
    height = round(_WIDTH * frame.height / frame.width)
    places = [np.arange(n) * size // n for n, size in zip((height, _WIDTH), shares.shape, strict=True)]
    levels = (_LOW + _RANGE * shares[np.ix_(*places)].astype(np.float64)).astype(np.uint8)
    return drawing(levels, _QUALITY)
