"""Where a screen ends, by what blinks from frame to frame: texture, which hides the ends in one frame, stays."""

from collections.abc import Sequence

import numpy as np

from rxcli.numerics import TINY
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.plane import tracked
from rxcli.receiver.plane.rows import tone_to_light
from rxcli.receiver.screen import geometry
from rxcli.types import Float32Array, FloatArray, Frame


def dark_ends(frames: Sequence[Frame], shifts: Sequence[FloatArray], context: FrameContext) -> tuple[int, int]:
    """Rows at the top and at the bottom of an outline up to where it blinks, as it may reach beyond the screen.

    Args:
        frames: of a clip.
        shifts: of each, (2,) pixels x and y by which the screen has moved since the first of them.
        context: of the first of them; its outline is at most `end_slots` slots too long.
    """
    camera, screen = context.camera, context.screens[0]
    n_rows = max(round(SETTINGS.end_slots / (screen.slot_rate_hz * camera.line_delay_s)), 1)
    by_end = np.stack(
        [_ends_of(frame, shift, context, 2 * n_rows) for frame, shift in zip(frames, shifts, strict=True)]
    )
    blinking = by_end.std(axis=0) / (by_end.mean(axis=0) + np.float32(TINY))
    # The outline may be turned against the screen: halves of the columns end elsewhere.
    by_half = np.stack([np.median(half, axis=1) for half in np.array_split(blinking, 2, axis=1)])
    is_lit = by_half > np.median(by_half[..., n_rows:], axis=-1, keepdims=True) / 2
    top, bottom = (is_lit.argmax(axis=-1).max(axis=0) + SETTINGS.end_rows).tolist()
    return top, bottom


def _ends_of(frame: Frame, shift: FloatArray, context: FrameContext, n_rows: int) -> Float32Array:
    """(2, C, n_rows) light of each column from its top down, and from its bottom up."""
    n_columns, lens, tone = context.screens[0].columns, context.camera.lens, context.camera.tone
    corners = context.sampled_corners + shift
    outlines = geometry.column_outlines(corners, n_columns, 1, frame.width, frame.height, lens)
    strips = tracked.map_strips(outlines, frame, lambda coded: tone_to_light(tone, coded))
    light, inside = tracked.sample_strips(frame, strips)[:, 0], outlines.inside[:, 0]
    ends = []
    for values, shown in ((light, inside), (light[:, ::-1], inside[:, ::-1])):
        rows = shown.argmax(axis=1)[:, None] + np.arange(n_rows)
        ends.append(np.take_along_axis(values, np.minimum(rows, values.shape[1] - 1), axis=1))
    return np.stack(ends)
