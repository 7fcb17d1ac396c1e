"""Whether the sides that were found are those of the columns: a quick look at the columns' borders between them.

Between the right sides the borders of the columns stand where they should; between others they do not, be it by a
tenth of the screen. One distance of strips and a part of the rows tell.
"""

from __future__ import annotations

import numpy as np

from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.coherence import Pixels, strip_changes
from rxcli.receiver.screen.comb import likeness
from rxcli.types import FloatArray, Lens

#: Distance of the strips, columns; rows that are read, of so many; and parts of the screen that must agree each.
_APART, _PART, _PARTS = 0.72, 3, 4
#: Height of the comb over what it should be, and over chance, in every part; and how far its phase may be off, columns.
_LEAST_HEIGHT, _LEAST_SCORE, _MOST_OFF = 0.45, 5.0, 0.1


def sides_agree(
    pixels: Pixels,
    corners: FloatArray,
    n_columns: int,
    sigma: float,
    *,
    mosaic_period: int = 1,
    lens: Lens | None = None,
) -> bool:
    """Whether columns have their borders where the corners of a screen put them.

    Args:
        pixels: (height, width): luma or mosaic.
        corners: (4, 2) the screen's corners, pixels, by turns from the stored picture's top left.
        n_columns: columns of the screen.
        sigma: its light spread, column pitches.
        mosaic_period: pixels after which the colours of a mosaic repeat; 1 for luma.
        lens: of the picture, where it is known.
    """
    scaled, x, y = strip_changes(pixels, mosaic_period=mosaic_period, part=_PART)
    flat = corners if lens is None or lens.corrected else geometry.undistort(corners, lens)
    inverse = np.linalg.inv(geometry.homography(flat))
    points = np.stack(np.meshgrid(x, y), axis=-1)
    points = points if lens is None or lens.corrected else geometry.undistort(points, lens)
    seen = np.concatenate([points, np.ones_like(points[..., :1])], axis=-1) @ inverse.T
    u, v = n_columns * seen[..., 0] / seen[..., 2], seen[..., 1] / seen[..., 2]
    width = float(np.linalg.norm(corners[1] - corners[0])) / n_columns
    apart = max(1, round(_APART * width / float(x[1] - x[0])))
    pairs = np.mean(scaled[:, :, apart:] * scaled[:, :, :-apart], axis=1)
    ui, uj = u[:, :-apart], u[:, apart:]
    inside = (np.minimum(ui, uj) > 0) & (np.maximum(ui, uj) < n_columns) & (np.abs(v[:, apart:] - 0.5) < 0.5)
    return all(_agrees(pairs, (ui + uj) / 2, inside & part, sigma, scaled.shape[1]) for part in _parts(ui, n_columns))


def _parts(u: FloatArray, n_columns: int) -> list[FloatArray]:
    """Masks of equal parts of the screen, from left to right."""
    part = np.floor(u * _PARTS / n_columns)
    return [part == number for number in range(_PARTS)]


def _agrees(pairs: FloatArray, middle: FloatArray, where: FloatArray, sigma: float, n_rows: int) -> bool:
    """Whether pairs are least alike at the borders, and as much as they should be."""
    if where.sum() < 20:
        return False
    values, phase = pairs[where], np.exp(2j * np.pi * middle[where])
    comb = complex(2 * ((values - values.mean()) * phase).mean())
    tables = likeness(sigma)
    step = int(tables.step(np.array(_APART)))
    full = float(tables.harmonic[step] / tables.mean[step]) * float(values.mean())
    chance = np.sqrt(2 * 1.5 / (values.size * n_rows * 2 / 3))
    return bool(
        full < 0
        and abs(comb) > _LEAST_HEIGHT * abs(full)
        and abs(comb) > _LEAST_SCORE * chance
        and abs(np.angle(comb / full)) < 2 * np.pi * _MOST_OFF
    )
