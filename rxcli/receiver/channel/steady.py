"""Light on the screen that does not blink, as a window's reflection: no black level, as it is at some places only."""

from dataclasses import replace

import numpy as np

from rxcli.numerics import local_mean
from rxcli.receiver.light import sees_dark_header
from rxcli.types import Clock, RowProfiles

#: Slots within which a column is dark at some time; longest exposure, slots, that sees it; slots over which light is
#: averaged; share of the light from which what does not blink counts.
_DARK_WITHIN, _MAX_EXPOSURE, _SMOOTH, _MIN_SHARE = 20, 1.5, 0.5, 0.1


def without_steady_light(profiles: RowProfiles, clock: Clock) -> RowProfiles:
    """Row profiles without the light that dark slots have at some places only.

    It is the least light nearby, but at most what the nearest headers show in their dark slots.
    """
    import cv2

    shape, at = profiles.light.shape, profiles.rows if profiles.sensor_row is None else profiles.sensor_row
    slot = np.broadcast_to((at - clock.row0) / clock.rows_per_slot + clock.first_slot, shape)
    is_dark = sees_dark_header(slot % clock.packet_slots, clock.exposure_slots + _SMOOTH) & profiles.inside
    if clock.exposure_slots > _MAX_EXPOSURE or not is_dark.any():
        return profiles
    black = np.float32(np.percentile(profiles.light[is_dark], 25))
    light, inside = profiles.light.reshape(-1, shape[2]), profiles.inside.reshape(-1, shape[2])
    is_dark = is_dark.reshape(light.shape)
    window = round(_DARK_WITHIN * clock.rows_per_slot) | 1
    smooth = local_mean(light - black, max(round(_SMOOTH * clock.rows_per_slot), 1))
    # Of each strip, the light in the dark slots of the last header, and of the next one.
    row = np.arange(shape[2])
    before, after = np.where(is_dark, row, -1), np.where(is_dark, row, shape[2])
    before = np.maximum.accumulate(before, axis=1)
    after = np.minimum.accumulate(after[:, ::-1], axis=1)[:, ::-1]
    padded = np.pad(smooth, ((0, 0), (0, 1)))
    shown = np.maximum(*(np.take_along_axis(padded, place, axis=1) for place in (before, after)))
    least = cv2.erode(np.where(inside, smooth, np.float32(1)), np.ones((1, window), np.uint8))
    steady = np.minimum(np.maximum(shown, 0), local_mean(least, window))
    steady *= inside * (steady > _MIN_SHARE * local_mean(light, window))
    return replace(profiles, light=profiles.light - steady.reshape(shape))
