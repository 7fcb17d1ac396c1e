"""Photographs that were turned by 90 degrees after they were taken, so that columns lie along the picture's rows."""

from dataclasses import replace
from typing import Any

import numpy as np

from rxcli.types import Colours, FloatArray, Frame, FrameResult

#: Orientations in which the file asks for a quarter turn, and the turns by which a picture may have been turned.
PORTRAIT, QUARTER_TURNS = (5, 6, 7, 8), (1, 3)


def turned_frame(frame: Frame, quarter_turns: int) -> Frame:
    """The frame turned counter-clockwise, as a picture that asks for no turn."""
    pixels: Any = np.ascontiguousarray(np.rot90(frame.pixels, quarter_turns))
    stored = frame.colours
    colours = stored and Colours(
        lambda: np.rot90(stored.thinned(), quarter_turns), lambda: np.rot90(stored.without_red(), quarter_turns)
    )
    return replace(frame, pixels=pixels, metadata=replace(frame.metadata, orientation=1), colours=colours)


def turned_points(points: FloatArray, frame: Frame, quarter_turns: int) -> FloatArray:
    """Points (..., 2) of a frame, where they are once it is turned counter-clockwise by 0, 1 or 3 quarter turns."""
    x, y = points[..., 0], points[..., 1]
    if quarter_turns == 0:
        return points
    return np.stack([y, frame.width - 1 - x] if quarter_turns == 1 else [frame.height - 1 - y, x], axis=-1)


def as_received(frame: Frame, result: FrameResult) -> tuple[Frame, FrameResult]:
    """The frame turned as it was received, and its result with the corners there."""
    if not result.quarter_turns:
        return frame, result
    corners = None if result.corners is None else turned_points(result.corners, frame, result.quarter_turns)
    return turned_frame(frame, result.quarter_turns), replace(result, corners=corners, quarter_turns=0)


def as_stored(turned: Frame, result: FrameResult, quarter_turns: int) -> FrameResult:
    """The result of a turned frame with its corners in the stored frame."""
    back = 4 - quarter_turns
    return replace(
        result,
        corners=None if result.corners is None else turned_points(result.corners, turned, back),
        other_screens=tuple(as_stored(turned, screen, quarter_turns) for screen in result.other_screens),
        quarter_turns=quarter_turns,
    )
