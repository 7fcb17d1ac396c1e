"""Packets without a header in view: soft bits for each start that the picture leaves open."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rxcli.profiles import ScreenProfile
from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL
from rxcli.receiver.frame.acquisition import Acquisition
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.frame.passes import Reception, dark_columns, soft_bits
from rxcli.receiver.light import LONG_EXPOSURE_SLOTS
from rxcli.receiver.search import evidence
from rxcli.receiver.search.settings import SETTINGS
from rxcli.receiver.still import decode, detected_on, initial_pass
from rxcli.receiver.sync import clock as sync
from rxcli.types import Clock, FrameSoftBits

#: Passes made over cut packets: all columns with light.
_SKIP = frozenset({"dark_columns"})


def cut_packets(context: FrameContext) -> tuple[FrameSoftBits, ...]:
    """Soft bits of a frame that shows less than a packet and no header, for its likeliest clocks.

    Args:
        context: the frame with its camera and screens.
    """
    screens = {(s.slot_rate_hz, s.packet_slots, s.columns): s for s in context.screens}.values()
    with context.timer("detect"):
        candidates = [candidate for screen in screens for candidate in _candidates(context, screen)]
        likeliest = sorted(candidates, key=lambda candidate: -candidate[0])[: SETTINGS.cut_clocks]
        found = [_soft_bits(context, acquisition, initial) for _, acquisition, initial in likeliest]
    return tuple(sorted(found, key=_certainty, reverse=True)[: SETTINGS.max_cut])


def _certainty(soft: FrameSoftBits) -> float:
    """Expected number of right bits above chance: slots and symbols out of phase leave words in doubt."""
    return float(np.tanh(np.abs(soft.llr) / 2).sum())


def _candidates(context: FrameContext, screen: ScreenProfile) -> Iterator[tuple[float, Acquisition, Reception]]:
    """Evidence, clock and initial pass for every phase of slots and symbols."""
    profiles = context.sample_columns(screen.columns)
    rows_per_slot = 1 / (screen.slot_rate_hz * context.camera.line_delay_s)
    exposure_slots = context.camera.exposure_s * screen.slot_rate_hz
    top, bottom = sync.row_span(profiles)
    payload_slots, n_visible = screen.packet_slots - PREAMBLE_SLOTS, (bottom - top) / rows_per_slot
    if not SETTINGS.cut_symbols * SLOTS_PER_SYMBOL < n_visible < payload_slots or exposure_slots > LONG_EXPOSURE_SLOTS:
        return
    for part in range(SETTINGS.cut_phases):
        row0 = top - part / SETTINGS.cut_phases * rows_per_slot
        for phase in range(SLOTS_PER_SYMBOL):
            clock = Clock(
                rows_per_slot=rows_per_slot,
                exposure_slots=exposure_slots,
                packet_slots=screen.packet_slots,
                row0=row0,
                n_slots=min(int(np.ceil((bottom - row0) / rows_per_slot)), payload_slots - phase),
                first_slot=PREAMBLE_SLOTS + phase,
                burst=np.zeros(1, np.int64),
                delay_slots=np.zeros(screen.columns),
                header_peak_ratio=0.0,
            )
            acquisition = Acquisition(screen, profiles, clock, (screen,))
            initial = initial_pass(acquisition)
            yield evidence.log_evidence(initial), acquisition, initial


def _soft_bits(context: FrameContext, acquisition: Acquisition, initial: Reception) -> FrameSoftBits:
    """Soft bits of a cut packet, where its start is open unless its dimming symbol shows."""
    starts = [detected_on(initial, clock) for clock in _starts(initial.clock)]
    best = max(starts, key=evidence.log_evidence)
    is_open = evidence.log_evidence(best) < evidence.log_evidence(initial) + SETTINGS.cut_start
    reception = decode(acquisition, _SKIP, initial if is_open else best)
    return replace(soft_bits(context.frame, reception, dark_columns(reception.snr)), open_start=is_open)


def _starts(clock: Clock) -> Iterator[Clock]:
    """The clock with each start of packets that has a part of header or dimming symbol in view."""
    n, phase = clock.packet_slots, clock.first_slot % SLOTS_PER_SYMBOL
    for first_slot in range(phase, n, SLOTS_PER_SYMBOL):
        if first_slot < PREAMBLE_SLOTS or first_slot + clock.n_slots > n:
            n_copies = -(-(first_slot + clock.n_slots) // n)
            yield replace(clock, first_slot=first_slot, burst=np.arange(n_copies))
