"""Rows that show no slots, as a film's bars; and light that does not blink, as a window's reflection.

Neither is a black level, since they are at some places only.
"""

from dataclasses import replace

import numpy as np

from rxcli.numerics import local_mean
from rxcli.receiver.light import sees_dark_header
from rxcli.types import Clock, RowProfiles

#: Slots within which a column is dark at some time; longest exposure, slots, that sees it; slots over which light is
#: averaged; share of the light from which what does not blink counts.
_DARK_WITHIN, _MAX_EXPOSURE, _SMOOTH, _MIN_SHARE = 20, 1.5, 0.5, 0.1
#: Standard deviations, beyond a share of the brightest light, from which there is light at all.
_SURE, _FAINT_SHARE = 5.0, 0.02


def without_steady_light(profiles: RowProfiles, clock: Clock) -> RowProfiles:
    """Row profiles without the light that dark slots have at some places only.

    It is the least light nearby, but at most what the nearest headers show in their dark slots.
    """
    import cv2

    if clock.exposure_slots > _MAX_EXPOSURE:
        return profiles
    shape, rows = profiles.light.shape, max(round(_SMOOTH * clock.rows_per_slot), 1)
    n = shape[2] // rows
    at = profiles.rows if profiles.sensor_row is None else profiles.sensor_row
    top, bottom = (np.s_[..., start : n * rows : rows] for start in (0, rows - 1))
    slot = ((at[top] + at[bottom]) / 2 - clock.row0) / clock.rows_per_slot + clock.first_slot
    inside = profiles.inside[top] & profiles.inside[bottom]
    is_dark = sees_dark_header(slot % clock.packet_slots, clock.exposure_slots + _SMOOTH) & inside
    if not is_dark.any():
        return profiles
    inside, is_dark = inside.reshape(-1, n), is_dark.reshape(-1, n)
    light = profiles.light.reshape(-1, shape[2])[:, : n * rows]
    light = np.asarray(cv2.resize(light, (n, len(light)), interpolation=cv2.INTER_AREA), np.float32)
    black, window = np.float32(np.percentile(light[is_dark], 25)), round(_DARK_WITHIN * clock.rows_per_slot / rows) | 1
    # Of each strip, the light in the dark slots of the last header, and of the next one.
    part = np.arange(n)
    before = np.maximum.accumulate(np.where(is_dark, part, -1), axis=1)
    after = np.minimum.accumulate(np.where(is_dark, part, n)[:, ::-1], axis=1)[:, ::-1]
    padded = np.pad(light - black, ((0, 0), (0, 1)))
    shown = np.maximum(*(np.take_along_axis(padded, place, axis=1) for place in (before, after)))
    least = cv2.erode(np.where(inside, light - black, np.float32(1)), np.ones((1, window), np.uint8))
    steady = np.minimum(np.maximum(shown, 0), local_mean(least, window))
    steady *= inside * (steady > _MIN_SHARE * local_mean(light, window))
    if not steady.any():
        return profiles
    whole = np.pad(np.repeat(steady, rows, axis=1), ((0, 0), (0, shape[2] - n * rows)), mode="edge")
    return replace(profiles, light=profiles.light - whole.reshape(shape) * profiles.inside)


def within_light(profiles: RowProfiles, clock: Clock, sigma: float) -> RowProfiles:
    """Row profiles without the rows before the first light in any column and after the last.

    The bars of a film are as high in all columns, and look like dark slots.

    Args:
        profiles: of the screen's columns.
        clock: of its slots.
        sigma: standard deviation of a dark row of a strip.
    """
    inside = np.asarray(profiles.inside.any(axis=1))
    if not inside.any():
        return profiles
    rows = max(round(_SMOOTH * clock.rows_per_slot), 1)
    light = local_mean(profiles.light.mean(axis=1), rows)
    black, white = np.percentile(light[inside], (5, 95))
    faint = _SURE * sigma / (rows * profiles.light.shape[1]) ** 0.5
    is_lit = inside & (light > black + faint + _FAINT_SHARE * (white - black))
    if not is_lit.any():
        return profiles
    top, n_rows = inside.argmax(axis=1)[:, None], np.maximum(inside.sum(axis=1), 1)[:, None]
    height = (np.arange(inside.shape[1]) - top) / n_rows
    shown = (height >= np.min(height[is_lit])) & (height <= np.max(height[is_lit]))
    return replace(profiles, inside=profiles.inside & shown[:, None])
