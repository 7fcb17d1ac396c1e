"""Bright spots in a dark picture: small lamps."""

import cv2
import numpy as np
from numpy.typing import NDArray

#: Cells along the picture's longer side, and minimum size of a cell, pixels: mostly longer than a stripe.
_CELLS, _MIN_CELL_PX = 128, 4
#: Levels at which a spot is outlined, as shares of its peak over the background. The inner outline separates spots that
#: run into each other.
_LEVELS = (0.25, 0.85)
#: Minimum height of a spot over the background: share of the brightest spot's, and standard deviations.
_MIN_HEIGHT, _MIN_DEVIATIONS = 0.02, 5.0
#: The picture is dark where this share of its cells lies below `_DARK_LEVEL` of the peak.
_DARK_SHARE, _DARK_LEVEL = 0.3, 0.2
_MAX_SPOTS = 16
#: Quantile of the light that is background.
_BACKGROUND = 0.25
#: Longest dark stripe in a spot: the picture's length over this.
_GAP = 5


def find_spots(picture: NDArray[np.float32] | NDArray[np.float64], axis: int) -> list[tuple[int, int, int, int]]:
    """Boxes around the spots of a dark picture, brightest first, and then around their inner parts.

    Args:
        picture: (height, width) light.
        axis: along which stripes may cut a spot into pieces: 0 down, 1 across.

    Returns:
        Left, top, right, bottom of each, pixels, right and bottom outside; none where the picture is not dark.
    """
    height, width = picture.shape
    cell = max(max(picture.shape) // _CELLS, _MIN_CELL_PX)
    shape = max(width // cell, 1), max(height // cell, 1)
    light = cv2.resize(np.asarray(picture, np.float32), shape, interpolation=cv2.INTER_AREA)
    # Stripes longer than a cell would cut a spot into pieces.
    length = max(light.shape[axis] // _GAP, 1)
    light = cv2.morphologyEx(light, cv2.MORPH_CLOSE, np.ones((length, 1) if axis == 0 else (1, length), np.uint8))
    light = cv2.GaussianBlur(light, (0, 0), 1.5)
    background = float(np.quantile(light, _BACKGROUND))
    light -= background
    peak, noise = float(light.max()), 1.4826 * float(np.median(np.abs(light)))
    if peak <= 0 or np.mean(light < _DARK_LEVEL * peak) < _DARK_SHARE:
        return []
    scale_x, scale_y = width / shape[0], height / shape[1]
    boxes = []
    for level in _LEVELS:
        free, taken, found = light > max(_MIN_HEIGHT * peak, _MIN_DEVIATIONS * noise), light > np.inf, 0
        while free.any() and found < _MAX_SPOTS:
            at = np.unravel_index(int(np.argmax(np.where(free, light, 0))), light.shape)
            _, labels = cv2.connectedComponents((light > level * light[at]).astype(np.uint8))
            members = labels == labels[at]
            if not np.any(members & taken):
                left, top, across, down = cv2.boundingRect(members.astype(np.uint8))
                edges = left * scale_x, top * scale_y, (left + across) * scale_x, (top + down) * scale_y
                boxes.append((round(edges[0]), round(edges[1]), round(edges[2]), round(edges[3])))
                taken |= members
                found += 1
            free &= ~members
    return boxes
