"""Light that is the same over the whole width is that of one lamp: does it say anything? Part of the wiring."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rxcli.protocol import PREAMBLE_SLOTS
from rxcli.receiver import sync
from rxcli.receiver.acquisition import Acquisition, ColumnSampler, noise_of
from rxcli.receiver.context import Failure, FrameContext
from rxcli.receiver.corners import too_small
from rxcli.receiver.decode import assemble
from rxcli.receiver.decode.steady import is_alike, periodic_share
from rxcli.receiver.reception import column_llr, shows_steady_light
from rxcli.receiver.settings import SETTINGS
from rxcli.receiver.still import initial_pass
from rxcli.types import BoolArray, RowProfiles

_NEXT = "point the camera at the screen that sends, or check that it does"
STEADY_LIGHT = (
    f"this light is switched on and off steadily (PWM), as lamps and dimmed screens do, and carries no data; {_NEXT}"
)
_ONE_LAMP = f"all columns show the same light and no packets in it, as of a single lamp; {_NEXT}"


def with_data(
    context: FrameContext, sampler: ColumnSampler, acquisition: Acquisition | Failure
) -> Acquisition | Failure:
    """A screen whose clock was found, unless its light carries no data; and why no clock was found."""
    if all(too_small(context, screen) for screen in context.screens):
        return acquisition  # No packet fits; and light of few rows repeats itself under some period.
    with context.timer("detect"):
        if not isinstance(acquisition, Failure):
            return _without_data(acquisition) or acquisition
        return Failure("no_signal", STEADY_LIGHT) if _is_switched(sampler.profiles, _headers(context)) else acquisition


def _headers(context: FrameContext) -> float:
    """The largest share of headers in what the screens send."""
    return PREAMBLE_SLOTS / min(screen.packet_slots for screen in context.screens)


def _is_switched(profiles: RowProfiles, headers: float) -> bool:
    """Whether one period explains the light of all columns on their rows, of which no clock is known."""
    light, inside = profiles.light, profiles.inside.astype(np.float32)
    value, weight = sync.contrast(light, inside, SETTINGS.smooth_rows, noise_of(profiles))
    level = value * (weight > 0)
    if not is_alike(value, weight, headers):
        return False
    return (
        periodic_share(level - level.mean(axis=1, keepdims=True), 2 * SETTINGS.most_period_rows)
        > SETTINGS.switched_share
    )


def _without_data(acquisition: Acquisition) -> Failure | None:
    """Why light carries no data; None where it may carry some.

    Independent columns are what the link is made of. Where all are alike they are received as one: a screen that sends
    the same in all columns still shows headers, equal copies and words of the codebook there.
    """
    binned = acquisition.binned()
    samples = sync.sample_slots(binned.profiles, binned.clock, SETTINGS.light_samples)
    contrast = sync.contrast(samples.light, samples.valid, SETTINGS.light_samples, noise_of(binned.profiles))
    headers = PREAMBLE_SLOTS / binned.screen.packet_slots
    if not is_alike(*contrast, headers, SETTINGS.apart_slots * SETTINGS.light_samples):
        return None
    reception = initial_pass(_as_one_column(binned))
    if float(column_llr(reception).max()) > SETTINGS.some_packets and not bool(
        np.any(assemble.without_header(reception.posteriors.header_llr))
    ):
        return None
    return Failure("no_signal", STEADY_LIGHT if shows_steady_light(reception) else _ONE_LAMP)


def _as_one_column(acquisition: Acquisition) -> Acquisition:
    """The same with every column a strip of one."""
    sampler = ColumnSampler(_columns_as_strips(acquisition.profiles), is_binned=True)
    clock = replace(acquisition.clock, delay_slots=np.zeros(1))
    return replace(acquisition, sampler=sampler, clock=clock)


def _columns_as_strips(profiles: RowProfiles) -> RowProfiles:
    weight = profiles.inside.astype(np.float32)
    inside: BoolArray = np.any(profiles.inside, axis=1)
    light = (profiles.light * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1)
    sensor_row = None if profiles.sensor_row is None else profiles.sensor_row.mean(axis=1)[None]
    return replace(
        profiles,
        light=np.asarray(light[None], np.float32),
        inside=inside[None],
        count=np.asarray(profiles.count.sum(axis=1)[None], np.float32),
        sensor_row=sensor_row,
    )
