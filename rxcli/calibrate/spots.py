"""Spots of light in a dark picture: where lamps may be that are small beside the whole."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rxcli.types import BoolArray, FloatArray

#: Cells along the picture's longer side, and the fewest pixels of a cell: some periods of the stripes, mostly.
_CELLS = 128
_MIN_CELL_PX = 4
#: Shares of a spot's own peak, over the background, down to which it reaches: where spots run into each other, their
#: inner parts do not.
_REACHES = (0.25, 0.6)
#: A spot stands above the background by this share of the brightest one's height, and by so many deviations.
_MIN_HEIGHT, _MIN_DEVIATIONS = 0.02, 5.0
#: The picture is dark where this share of its cells lies below `_DARK_LEVEL` of the peak.
_DARK_SHARE, _DARK_LEVEL = 0.6, 0.2
_MAX_SPOTS = 16


def find_spots(picture: NDArray[np.float32] | NDArray[np.float64]) -> list[tuple[int, int, int, int]]:
    """Boxes around the spots of a dark picture, brightest first, and around the inner parts of joined ones.

    Args:
        picture: (height, width) light.

    Returns:
        Left, top, right, bottom of each, pixels, right and bottom outside; none where the picture is not dark.
    """
    import cv2

    height, width = picture.shape
    cell = max(max(picture.shape) // _CELLS, _MIN_CELL_PX)
    shape = max(width // cell, 1), max(height // cell, 1)
    light = cv2.resize(np.asarray(picture, np.float32), shape, interpolation=cv2.INTER_AREA)
    # What is left of the stripes in cells shorter than a period would cut a spot into pieces.
    light = np.asarray(cv2.GaussianBlur(light, (0, 0), 1.5), np.float64)
    outer, inner = ([_box(members) for members in _peaks(light, reach)] for reach in _REACHES)
    joined = [whole for whole in outer if sum(_holds(whole, part) for part in inner) > 1]
    boxes = outer + [part for part in inner if any(_holds(whole, part) for whole in joined)]
    scale = np.array([width / shape[0], height / shape[1]] * 2)
    return [tuple(int(v) for v in np.round(np.array(box) * scale)) for box in boxes]  # type: ignore[misc]


def _peaks(light: FloatArray, reach: float) -> list[BoolArray]:
    """(rows, columns) members of each spot: the cells about a maximum that it outshines, joined to it."""
    background = float(np.median(light))
    height = float(light.max()) - background
    noise = 1.4826 * float(np.median(np.abs(light - background)))
    least = background + max(_MIN_HEIGHT * height, _MIN_DEVIATIONS * noise)
    if height <= 0 or np.mean(light < background + _DARK_LEVEL * height) < _DARK_SHARE:
        return []
    free = light > least
    found: list[BoolArray] = []
    while free.any() and len(found) < _MAX_SPOTS:
        top = np.unravel_index(int(np.argmax(np.where(free, light, -np.inf))), light.shape)
        members = _joined(light > background + reach * (light[top] - background), top)
        if not np.any([members & other for other in found]):
            found.append(members)
        free &= ~members
        free[top] = False
    return found


def _joined(cells: BoolArray, at: tuple[np.intp, ...]) -> BoolArray:
    """The connected part of `cells` that holds `at`."""
    import cv2

    _, labels = cv2.connectedComponents(cells.astype(np.uint8))
    return np.asarray(labels == labels[at])


def _holds(whole: tuple[int, int, int, int], part: tuple[int, int, int, int]) -> bool:
    return whole[0] <= part[0] and whole[1] <= part[1] and whole[2] >= part[2] and whole[3] >= part[3]


def _box(members: BoolArray) -> tuple[int, int, int, int]:
    rows, columns = np.flatnonzero(members.any(axis=1)), np.flatnonzero(members.any(axis=0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
