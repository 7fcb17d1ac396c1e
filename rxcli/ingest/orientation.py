"""The eight ways in which a stored picture is turned for viewing (EXIF 2.32, tag 0x0112).

Pixels stay in readout order throughout the receiver; this exists for readers that turn them unasked.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Quarter turns counter-clockwise, and whether then mirrored left to right, of orientations 1 to 8.
_TURNS = ((0, False), (0, True), (2, False), (2, True), (3, True), (3, False), (1, True), (1, False))

#: A picture without any symmetry.
PROBE = np.arange(6).reshape(2, 3)


def as_stored(viewed: NDArray[Any], orientation: int) -> NDArray[Any]:
    """A view of the picture as it is stored, from one as a viewer sees it, (height, width, ...)."""
    turns, mirrored = _TURNS[orientation - 1]
    return np.rot90(viewed[:, ::-1] if mirrored else viewed, -turns)


def orientation_of(probe: NDArray[np.int64]) -> int:
    """The orientation that turns and mirrors pictures as was done to `probe`, which was `PROBE` before."""
    return next(o for o in range(1, 9) if np.array_equal(as_stored(probe, o), PROBE))


def orientation_of_turn(degrees_ccw: float) -> int:
    """The orientation of a display matrix that turns counter-clockwise by a multiple of 90 degrees; 1 for others."""
    return {0: 1, 90: 8, 180: 3, 270: 6}.get(round(degrees_ccw) % 360, 1)
