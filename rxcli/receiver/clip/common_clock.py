"""The clock that the first frames of a clip share, where each shows too little to find its own.

A frame that shows less than two packets may show no whole header, or show payload that looks like one. Over several
frames the headers come back at the same place in the packet's length, and nothing else does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from rxcli.profiles import ScreenProfile
from rxcli.receiver.acquisition import (
    Acquisition,
    distinct_screens,
    noise_of,
    sample_columns,
    variants_of,
)
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.context import Camera, FrameContext
from rxcli.receiver.sync import clock as sync
from rxcli.receiver.sync.settings import SETTINGS as sync_settings
from rxcli.receiver.sync.tracking import LinkTime
from rxcli.types import Clock, FloatArray, Frame, RowProfiles

#: Errors of the frames' period that are tried, in slots over all frames: times are rounded to milliseconds.
_DRIFTS = np.linspace(-6, 6, 25)


@dataclass(frozen=True, slots=True)
class Start:
    """What the first frames agree on."""

    screen: ScreenProfile
    #: The screen and others that differ only in the number of copies per burst.
    variants: tuple[ScreenProfile, ...]
    time: LinkTime
    #: How much likelier the headers' place is than the best elsewhere.
    lead: float


def shows_little(context: FrameContext) -> bool:
    """Whether a frame shows too few packets to find its clock alone."""
    corners, height = context.corners, context.frame.height
    shown = min(float(corners[:, 1].max()), height - 1.0) - max(float(corners[:, 1].min()), 0.0)
    return shown * context.camera.line_delay_s < SETTINGS.few_packets * min(
        screen.packet_s for screen in context.screens
    )


def common_clock(
    frames: Sequence[Frame], context: FrameContext, screens: Sequence[ScreenProfile]
) -> tuple[Start, FrameContext] | None:
    """Find the clock on which the headers of several frames agree, and the frame's context by which they do so best.

    Less than a packet gives rows per slot, but perhaps another screen, or the wrong direction of the readout.

    Args:
        frames: the first frames.
        context: of the first of them.
        screens: that an estimated camera may have seen.
    """
    starts = ((_agreed(frames, candidate), candidate) for candidate in _candidates(frames, context, screens))
    agreed = [(start, candidate) for start, candidate in starts if start is not None]
    return max(agreed, key=lambda each: each[0].lead, default=None)


def _candidates(
    frames: Sequence[Frame], context: FrameContext, screens: Sequence[ScreenProfile]
) -> Iterator[FrameContext]:
    """A frame as it is; if its camera was estimated, for every screen and direction of readout that fit the frames."""
    camera, rate_hz = context.camera, context.screens[0].slot_rate_hz
    if camera.hypothesis is None:
        yield context
        return
    longest_s = _shortest_period_s(frames) * SETTINGS.readout_slack
    for slot_rate_hz in dict.fromkeys([rate_hz, *(screen.slot_rate_hz for screen in screens)]):
        scale = rate_hz / slot_rate_hz
        delay_s, exposure_s = scale * camera.line_delay_s, scale * camera.exposure_s
        same_rate = tuple(screen for screen in screens if screen.slot_rate_hz == slot_rate_hz)
        estimated = {**camera.estimated, "line_delay_s": (delay_s, scale * camera.estimated["line_delay_s"][1])}
        for is_reversed in (camera.reversed, not camera.reversed):
            scaled = replace(
                camera, line_delay_s=delay_s, exposure_s=exposure_s, reversed=is_reversed, estimated=estimated
            )
            if delay_s * context.frame.height <= longest_s:
                yield replace(context, camera=scaled, screens=same_rate)


def _shortest_period_s(frames: Sequence[Frame]) -> float:
    """The shortest time from one frame to the next by their time stamps; infinite if these do not show it."""
    passed = [
        after.time_s - before.time_s
        for before, after in pairwise(frames)
        if not after.nominal_time and after.time_s > before.time_s
    ]
    return min(passed, default=np.inf)


def _agreed(frames: Sequence[Frame], context: FrameContext) -> Start | None:
    """The clock on which the headers of several frames agree, None where they do not; `context` is of the first."""
    best: Start | None = None
    profiles_of = {
        n_columns: [sample_columns(replace(context, frame=frame), n_columns) for frame in frames]
        for n_columns in {screen.columns for screen in context.screens}
    }
    for screen in distinct_screens(context.screens):
        lead, slot, period = _phase(frames, profiles_of[screen.columns], screen, context.camera)
        if lead > SETTINGS.min_lead and (best is None or lead > best.lead):
            time = LinkTime(screen.packet_slots, screen.slot_rate_hz)
            time.begin(frames[0].index, frames[0].time_s, slot, period)
            best = Start(screen, variants_of(screen, context.screens), time, lead)
    return best


def acquisition_at(start: Start, context: FrameContext) -> Acquisition | None:
    """What the clip's clock predicts for a frame; None where nothing of the screen is in the picture."""
    screen, frame, camera = start.screen, context.frame, context.camera
    profiles = sample_columns(context, screen.columns)
    rows = np.flatnonzero(profiles.inside.any(axis=(0, 1)))
    if rows.size == 0:
        return None
    rows_per_slot = 1 / (screen.slot_rate_hz * camera.line_delay_s)
    template = Clock(
        rows_per_slot=rows_per_slot,
        exposure_slots=camera.exposure_s * screen.slot_rate_hz,
        packet_slots=screen.packet_slots,
        row0=0.0,
        n_slots=0,
        first_slot=0,
        burst=np.zeros(0, np.int64),
        delay_slots=np.zeros(screen.columns),
        header_peak_ratio=1.0,
    )
    n_slots = int(np.ceil((rows[-1] - rows[0] + 1) / rows_per_slot)) + 1
    top = float(profiles.rows[rows[0]]) - 0.5
    clock = start.time.clock_at(frame.index, frame.time_s, template, n_slots, top)
    return None if clock is None else Acquisition(screen, profiles, clock, variants=start.variants)


def _phase(
    frames: Sequence[Frame], profiles_of: Sequence[RowProfiles], screen: ScreenProfile, camera: Camera
) -> tuple[float, float, float]:
    """Lead of the best place of the headers; slot of row 0 of the first frame; slots from frame to frame."""
    rows_per_slot = 1 / (screen.slot_rate_hz * camera.line_delay_s)
    responses = [_response(profiles, rows_per_slot) for profiles in profiles_of]
    times = np.array([frame.time_s for frame in frames])
    numbers = np.array([frame.index for frame in frames])
    slope = float(np.polyfit(numbers - numbers[0], times - times[0], 1)[0])
    most, best = 0.0, (0.0, 0.0, slope * screen.slot_rate_hz)
    for drift in _DRIFTS:
        period = slope * screen.slot_rate_hz + drift / max(len(frames) - 1, 1)
        starts = (numbers - numbers[0]) * period
        power, lead, place = _fold(responses, starts, screen.packet_slots)
        if power > most:
            most, best = power, (lead, -place, period)
    return best


def _response(profiles: RowProfiles, rows_per_slot: float) -> tuple[FloatArray, FloatArray]:
    """Slots since the exposure of sensor row 0, and how much a header seems to start there."""
    shown = np.flatnonzero(profiles.inside.any(axis=(0, 1)))
    if shown.size == 0:
        return np.zeros(0), np.zeros(0)
    q = sync_settings.search_samples
    top, step = float(profiles.rows[shown[0]]) - 0.5, rows_per_slot / q
    light, valid = sync.resample(profiles, top, step, int(shown.size / step))
    pooled, weight = sync.contrast(
        light, valid, sync_settings.search_samples, noise_of(profiles) / np.sqrt(max(step, 1.0))
    )
    response = sync.header_response(pooled, weight, sync_settings.search_samples).mean(axis=0)
    return top / rows_per_slot + np.arange(response.size) / sync_settings.search_samples, np.maximum(response, 0) ** 2


def _fold(
    responses: Sequence[tuple[FloatArray, FloatArray]], starts: FloatArray, packet_slots: int
) -> tuple[float, float, float]:
    """Power of the best place of a header in the packet's length, its lead, and that place in slots."""
    q = sync_settings.search_samples
    n = packet_slots * q
    score = np.zeros(n)
    for (slots, response), start in zip(responses, starts, strict=True):
        place = np.round((slots + start) * q).astype(np.int64) % n
        np.add.at(score, place, response)
    # Stamps are rounded to milliseconds: neighbouring places are equivalent.
    score = (score + np.roll(score, 1) + np.roll(score, -1)) / 3
    place, lead = sync.header_comb(score, q)
    return float(score.max()), lead, place / q
