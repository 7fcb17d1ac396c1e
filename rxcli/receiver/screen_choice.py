"""Which screen a frame shows, and its clock: by headers, and where these leave doubt by packets. Part of the wiring."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rxcli.profiles import ScreenProfile
from rxcli.receiver import camera as blind
from rxcli.receiver import sync
from rxcli.receiver.acquisition import Acquisition, ColumnSampler, noise_of, sample_columns
from rxcli.receiver.context import Failure, FrameContext
from rxcli.receiver.corners import too_small
from rxcli.receiver.reception import packet_llr
from rxcli.receiver.settings import SETTINGS
from rxcli.receiver.still import initial_pass
from rxcli.types import Clock, RowProfiles


def quick_look(context: FrameContext) -> Acquisition | Failure:
    """The screen and the clock by a quick look at the columns; taken once for a context."""
    if "quick" not in context.kept:
        context.kept["quick"] = acquire(context, quick_sampler(context))
    kept: Acquisition | Failure = context.kept["quick"]
    return kept


def quick_sampler(context: FrameContext) -> ColumnSampler:
    """What a quick look samples of the columns; sampled once for a context."""
    if "sampler" not in context.kept:
        context.kept["sampler"] = sample_columns(context, context.n_columns, quick=True)
    kept: ColumnSampler = context.kept["sampler"]
    return kept


def acquire(context: FrameContext, sampler: ColumnSampler) -> Acquisition | Failure:
    """The screen profile and the clock that fit best, from the columns of `context.n_columns`.

    Screens that differ in nothing but their columns share a clock: which of them it is, is asked last.
    """
    n_columns = context.n_columns
    with context.timer("clock"):
        pooled = sync.pooled_strips(sampler.binned())
        different = told_apart_by_clock(context.screens)
        rates = {(s.slot_rate_hz, s.packet_slots): s for s in reversed(different)}
        clocks = {rate: found for rate, screen in rates.items() if (found := _clock_of(context, screen, pooled))}
        clocks = {rate: found for rate, found in clocks.items() if found.header_peak_ratio >= SETTINGS.min_peak_ratio}
        if not clocks:
            return Failure("no_signal", _why_no_signal(context))
        structure = {rate: _structure(pooled, found) for rate, found in clocks.items()} if len(clocks) > 1 else {}
    first: dict[tuple[float, int], Acquisition] = {}
    if _is_plain(list(structure.values())):
        rate = max(clocks, key=lambda rate: structure.get(rate, 0.0))
    else:
        # Each has an initial pass; where none shows packets, the clocks' structure is all there is.
        first = {
            rate: _acquired(context, screen, sampler, clocks[rate]) for rate, screen in rates.items() if rate in clocks
        }
        rate = max(clocks, key=lambda rate: (_packets(context, first[rate]), structure[rate]))
    alike = [screen for screen in different if (screen.slot_rate_hz, screen.packet_slots) == rate]
    acquisitions = []
    if alike[0].columns == n_columns:
        coarse = first.get(rate) or _acquired(context, alike[0], sampler, clocks[rate])
        if len(alike) == 1 or _has_few_columns(coarse, alike):
            return coarse
        acquisitions = [coarse]
    for screen in alike[len(acquisitions) :]:
        finer = sample_columns(context, screen.columns, quick=sampler.read is not None)
        with context.timer("clock"):
            found = _clock_of(context, screen, sync.pooled_strips(finer.binned()))
        if found:
            acquisitions.append(_acquired(context, screen, finer, found))
    if not acquisitions:
        return Failure("no_signal", _why_no_signal(context))
    return acquisitions[0] if len(acquisitions) == 1 else _with_likely_columns(acquisitions)


def _shape_of(screen: ScreenProfile) -> tuple[float, int, int]:
    return screen.slot_rate_hz, screen.packet_slots, screen.columns


def told_apart_by_clock(screens: Sequence[ScreenProfile]) -> list[ScreenProfile]:
    """The screens without those that differ in nothing but how often a packet is sent: the one that does it most."""
    by_shape: dict[tuple[float, int, int], ScreenProfile] = {}
    for screen in screens:
        known = by_shape.setdefault(_shape_of(screen), screen)
        if screen.repeats > known.repeats:
            by_shape[_shape_of(screen)] = screen
    return list(by_shape.values())


def variants_of(screen: ScreenProfile, screens: Sequence[ScreenProfile]) -> tuple[ScreenProfile, ...]:
    """The screen, and others that differ in nothing but how often a packet is sent; the one that does it most first."""
    others = {s.repeats: s for s in reversed(screens) if _shape_of(s) == _shape_of(screen)}
    others[screen.repeats] = screen
    return tuple(others[repeats] for repeats in sorted(others, reverse=True))


def _acquired(context: FrameContext, screen: ScreenProfile, sampler: ColumnSampler, clock: Clock) -> Acquisition:
    return Acquisition(screen, sampler, clock, variants_of(screen, context.screens))


def _structure(profiles: RowProfiles, clock: Clock) -> float:
    """How much the strips, each on its own, look like packets on this clock."""
    samples = sync.sample_slots(profiles, clock, 1)
    slots = samples.light.reshape(-1, clock.n_slots).astype(np.float64)
    return blind.structure_llr(slots, clock.first_slot, clock.packet_slots)


def _is_plain(structure: Sequence[float]) -> bool:
    """Whether one clock's slots look like packets beyond doubt, or there is but one clock."""
    best = sorted(structure, reverse=True)
    return len(best) < 2 or (best[0] > SETTINGS.plain_structure and best[0] - best[1] > SETTINGS.plain_structure)


def _packets(context: FrameContext, acquisition: Acquisition) -> float:
    """Log-likelihood ratio of packets on an initial pass."""
    with context.timer("detect"):
        return packet_llr(initial_pass(acquisition))


def _has_few_columns(coarse: Acquisition, screens: Sequence[ScreenProfile]) -> bool:
    """Whether strips of the coarsest screen's columns tell already that it has no more columns than these."""
    likely = blind.likely_columns(coarse.sampler.binned(), coarse.clock, screens)
    return likely.columns == coarse.screen.columns


def _with_likely_columns(acquisitions: list[Acquisition]) -> Acquisition:
    """Among screens of one clock, the one whose columns are as wide as seen."""
    finest = max(
        acquisitions, key=lambda acquisition: acquisition.profiles.light.shape[0] * acquisition.profiles.light.shape[1]
    )
    likely = blind.likely_columns(finest.profiles, finest.clock, [acquisition.screen for acquisition in acquisitions])
    return next(acquisition for acquisition in acquisitions if acquisition.screen is likely)


def _clock_of(context: FrameContext, screen: ScreenProfile, profiles: RowProfiles) -> Clock | None:
    rows_per_slot = 1 / (screen.slot_rate_hz * context.camera.line_delay_s)
    exposure_slots = context.camera.exposure_s * screen.slot_rate_hz
    return sync.find_clock(profiles, rows_per_slot, exposure_slots, screen.packet_slots, noise_of(profiles))


def _why_no_signal(context: FrameContext) -> str:
    shortest = min(context.screens, key=lambda screen: screen.packet_s)
    return too_small(context, shortest) or (
        "a screen was found but no packet header; check that it sends, the shutter is electronic and HDR is off"
    )
