"""Whether the sides that were found are those of the columns: a quick look at the columns' borders between them.

Between the right sides the borders of the columns stand where they should; between others they do not, be it by a
tenth of the screen. One distance of strips and a part of the rows tell.
"""

from __future__ import annotations

import numpy as np

from rxcli.numerics import TINY
from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.coherence import Pixels, strip_changes
from rxcli.receiver.screen.columns import ColumnLayout
from rxcli.receiver.screen.comb import APART, likeness
from rxcli.types import Float32Array, FloatArray, Lens

#: Parts of the screen.
_PARTS = 4
#: Height of the comb over what it would be without noise, and over chance, were neighbouring pairs and rows
#: independent; how far its phase may be off, columns.
_LEAST_HEIGHT, _LEAST_SCORE, _MOST_OFF = 0.1, 9.0, 0.06
#: Height over chance from which a part of the screen says anything, and how far the phase may be off there, columns.
_SAYS, _MOST_OFF_IN_PART = 4.5, 0.15


def sides_agree(
    pixels: Pixels,
    corners: FloatArray,
    layout: ColumnLayout,
    *,
    mosaic_period: int = 1,
    lens: Lens | None = None,
    part: int = 1,
) -> bool:
    """Whether columns have their borders where the corners of a screen put them.

    Args:
        pixels: (height, width): luma or mosaic.
        corners: (4, 2) the screen's corners, pixels, by turns from the stored picture's top left.
        layout: of its columns.
        mosaic_period: pixels after which the colours of a mosaic repeat; 1 for luma.
        lens: of the picture, where it is known.
        part: read one of so many equal parts of the rows.
    """
    n_columns = layout.n_columns
    scaled, _, x, y = strip_changes(pixels, mosaic_period=mosaic_period, part=part)
    flat = corners if lens is None or lens.corrected else geometry.undistort(corners, lens)
    inverse = np.linalg.inv(geometry.homography(flat))
    points = np.stack(np.meshgrid(x, y), axis=-1)
    points = points if lens is None or lens.corrected else geometry.undistort(points, lens)
    seen = np.concatenate([points, np.ones_like(points[..., :1])], axis=-1) @ inverse.T
    u, v = n_columns * seen[..., 0] / seen[..., 2], seen[..., 1] / seen[..., 2]
    width = float(np.linalg.norm(corners[1] - corners[0])) / n_columns
    apart = max(1, round(APART * width / float(x[1] - x[0])))
    pairs = np.mean(scaled[:, :, apart:] * scaled[:, :, :-apart], axis=1)
    ui, uj = u[:, :-apart], u[:, apart:]
    inside = (np.minimum(ui, uj) > 0) & (np.maximum(ui, uj) < n_columns) & (np.abs(v[:, apart:] - 0.5) < 0.5)
    return _agree(
        pairs, (ui + uj) / 2, np.where(inside, np.floor(ui * _PARTS / n_columns), -1), layout.sigma, scaled.shape[1]
    )


def _agree(pairs: Float32Array, middle: FloatArray, part: FloatArray, sigma: float, n_rows: int) -> bool:
    """Whether pairs are least alike at the borders: over the whole screen, and in each part that says anything."""
    tables = likeness(sigma)
    step = int(tables.step(np.array(APART)))
    depth = float(tables.harmonic[step] / tables.mean[step])
    combs, full, counts = np.zeros(_PARTS, np.complex128), np.zeros(_PARTS), np.zeros(_PARTS)
    for number in range(_PARTS):
        values = pairs[part == number]
        if values.size:
            combs[number] = 2 * ((values - values.mean()) * np.exp(2j * np.pi * middle[part == number])).sum() / depth
            full[number], counts[number] = values.sum(), values.size
    chance = np.sqrt(2 * counts / n_rows) / abs(depth) + TINY
    total, noise = complex(combs.sum()), float(np.sqrt((chance**2).sum()))
    off = np.abs(np.angle(combs)) / (2 * np.pi)
    return bool(
        abs(total) > max(_LEAST_SCORE * noise, _LEAST_HEIGHT * full.sum())
        and abs(np.angle(total)) < 2 * np.pi * _MOST_OFF
        and (off[np.abs(combs) > _SAYS * chance] < _MOST_OFF_IN_PART).all()
        and (np.abs(combs) > _SAYS * chance)[[0, -1]].all()
    )
