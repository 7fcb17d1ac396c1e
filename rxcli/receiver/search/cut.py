"""Less than a packet in view: soft bits for each camera, screen, clock and start that the picture leaves open."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL
from rxcli.receiver import channel
from rxcli.receiver.camera.settings import SETTINGS as CAMERA
from rxcli.receiver.decode import detect
from rxcli.receiver.frame.acquisition import Acquisition, distinct_screens, noise_of
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.frame.passes import Reception, dark_columns, soft_bits
from rxcli.receiver.light import LONG_EXPOSURE_SLOTS
from rxcli.receiver.search import evidence
from rxcli.receiver.search.cameras import cameras_by_slots, settle
from rxcli.receiver.search.settings import SETTINGS
from rxcli.receiver.still import decode, detected_on, initial_pass
from rxcli.receiver.sync import clock as sync
from rxcli.types import Clock, FrameSoftBits

#: Passes made over cut packets: all columns with light.
_SKIP = frozenset({"dark_columns"})


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A clock of one camera and screen."""

    context: FrameContext
    acquisition: Acquisition
    #: Of its middle columns; less that of most clocks of the same camera and screen.
    evidence: float
    lead: float = 0.0

    def is_near(self, better: _Candidate) -> bool:
        """Whether its symbols begin where those of a better one do, by the same screen read the same way."""
        if self.acquisition.screen != better.acquisition.screen or self.is_reversed != better.is_reversed:
            return False
        ahead = (self._symbol_phase - better._symbol_phase) % SLOTS_PER_SYMBOL
        return min(ahead, SLOTS_PER_SYMBOL - ahead) < SETTINGS.same_symbols_slots

    @property
    def is_reversed(self) -> bool:
        """Whether rows run against the readout."""
        return self.context.camera.reversed

    @property
    def _symbol_phase(self) -> float:
        """Slots from the beginning of a symbol to the middle row."""
        clock, (top, bottom) = self.acquisition.clock, sync.row_span(self.acquisition.profiles)
        return ((top + bottom) / 2 - clock.row0) / clock.rows_per_slot + clock.first_slot


def cut_packets(context: FrameContext) -> tuple[FrameSoftBits, ...]:
    """Soft bits of a frame that shows less than a packet, likeliest first.

    Args:
        context: the frame with its screens; its camera, or an unknown one.
    """
    with context.timer("detect"):
        candidates = _distinct(c for possible in _contexts(context) for c in _candidates(possible))
        if context.camera.profile is None:
            # Words of weight 5 are as likely read backwards.
            best_of_each_way = {c.is_reversed: c for c in reversed(candidates)}.values()
            candidates = _distinct((*(c for best in best_of_each_way for c in _fitted(best)), *candidates))
        return tuple(_soft_bits(candidate) for candidate in candidates)


def _contexts(context: FrameContext) -> Iterator[FrameContext]:
    """The frame by each camera and screen that it may show."""
    screens = distinct_screens(context.screens)
    if context.camera.profile is not None:
        yield from (replace(context, screens=(screen,)) for screen in screens)
        return
    for screen, camera in cameras_by_slots(context, screens):
        yield replace(context, camera=camera, screens=(screen,))


def _distinct(candidates: Iterable[_Candidate]) -> list[_Candidate]:
    """The likeliest few whose symbols begin at different places."""
    out: list[_Candidate] = []
    for candidate in sorted(candidates, key=lambda candidate: -candidate.lead):
        if len(out) < SETTINGS.max_cut and not any(candidate.is_near(better) for better in out):
            out.append(candidate)
    return out


def _fitted(best: _Candidate) -> list[_Candidate]:
    """Candidates of the best camera, fitted to the slots that were decided with it."""
    found: list[_Candidate] = []
    for _ in range(CAMERA.max_fits):
        initial = initial_pass(best.acquisition)
        camera, moved_slots = settle(best.context, best.acquisition, initial)
        refined = _candidates(replace(best.context, camera=camera))
        likeliest = max(refined, key=lambda candidate: candidate.lead, default=best)
        if likeliest.lead <= best.lead:
            break
        found, best = refined, likeliest
        if moved_slots < CAMERA.matters_slots:
            break
    return found


def _candidates(context: FrameContext) -> list[_Candidate]:
    """Clocks of one camera and screen, with their lead over most of them."""
    found = list(_clocks(context))
    usual = float(np.median([candidate.evidence for candidate in found])) if found else 0.0
    return [replace(candidate, lead=candidate.evidence - usual) for candidate in found]


def _clocks(context: FrameContext) -> Iterator[_Candidate]:
    """Clocks with a header in view, and of every phase of slots and symbols without."""
    (screen,) = context.screens
    profiles = context.sample_columns(screen.columns)
    rows_per_slot = 1 / (screen.slot_rate_hz * context.camera.line_delay_s)
    exposure_slots = context.camera.exposure_s * screen.slot_rate_hz
    top, bottom = sync.row_span(profiles)
    n_visible = (bottom - top) / rows_per_slot
    if n_visible < SETTINGS.cut_symbols * SLOTS_PER_SYMBOL or exposure_slots > LONG_EXPOSURE_SLOTS:
        return

    def candidate(clock: Clock, of_middle: Reception) -> _Candidate:
        acquisition = Acquisition(screen, profiles, clock, (screen,))
        return _Candidate(context, acquisition, evidence.log_evidence(of_middle))

    def middle_pass(clock: Clock) -> Reception:
        acquisition = Acquisition(screen, profiles, clock, (screen,))
        return initial_pass(acquisition.of_columns(acquisition.middle_columns))

    binned = sync.binned_strips(profiles)
    clock = sync.find_clock(binned, rows_per_slot, exposure_slots, screen.packet_slots, noise_of(binned))
    if clock is not None and clock.header_peak_ratio > SETTINGS.min_lead:
        yield candidate(clock, middle_pass(clock))
    payload_slots = screen.packet_slots - PREAMBLE_SLOTS
    for part in range(SETTINGS.cut_phases if n_visible < payload_slots else 0):
        row0 = top - part / SETTINGS.cut_phases * rows_per_slot
        n_shown = int(np.ceil((bottom - row0) / rows_per_slot))
        clock = Clock(
            rows_per_slot=rows_per_slot,
            exposure_slots=exposure_slots,
            packet_slots=screen.packet_slots,
            row0=row0,
            n_slots=min(n_shown, payload_slots - SLOTS_PER_SYMBOL + 1),
            first_slot=PREAMBLE_SLOTS,
            burst=np.zeros(1, np.int64),
            delay_slots=np.zeros(screen.columns),
            header_peak_ratio=0.0,
        )
        # The light of slots is the same wherever symbols begin.
        initial = middle_pass(clock)
        for phase in range(SLOTS_PER_SYMBOL):
            first_slot = PREAMBLE_SLOTS + phase
            n_slots = min(n_shown, payload_slots - phase)
            shifted = detected_on(initial, replace(initial.clock, first_slot=first_slot))
            yield candidate(replace(clock, n_slots=n_slots, first_slot=first_slot), shifted)


def _soft_bits(candidate: _Candidate) -> FrameSoftBits:
    """Soft bits of a cut packet, where its start is open unless header or dimming symbol show in part."""
    acquisition, initial = max(_refined(candidate.acquisition), key=lambda found: evidence.log_evidence(found[1]))
    best, is_open = initial, False
    if initial.clock.header_peak_ratio == 0:
        starts = [detected_on(initial, clock) for clock in _starts(initial.clock)]
        likeliest = max(starts, key=evidence.log_evidence)
        is_open = evidence.log_evidence(likeliest) < evidence.log_evidence(initial) + SETTINGS.cut_start
        best = initial if is_open else likeliest
    ways = [_of_common_weights(best)]
    if is_open:
        ways += [_of_common_weights(initial_pass(acquisition, share)) for share in SETTINGS.cut_room_lights[1:]]
    reception = decode(acquisition, _SKIP, max(ways, key=_n_certain), keeps_weights=True)
    return replace(soft_bits(candidate.context.frame, reception, dark_columns(reception.snr)), open_start=is_open)


def _n_certain(initial: Reception) -> float:
    """Bits that are expected to be right beyond chance, of columns with the commonest weight."""
    common = initial.posteriors.w == np.bincount(initial.posteriors.w).argmax()
    return float(np.tanh(np.abs(np.nan_to_num(initial.posteriors.bit_llr[:, common])) / 2).sum())


def _of_common_weights(initial: Reception) -> Reception:
    """The initial pass with the weights that columns have in common."""
    bursts = channel.by_burst(initial.metrics, initial.clock)
    weights = detect.common_weights(detect.detect(bursts).w_log_prob)
    return replace(initial, posteriors=detect.detect(bursts, weights))


def _refined(acquisition: Acquisition) -> Iterator[tuple[Acquisition, Reception]]:
    """A clock, those a little earlier and later, and the best one corrected by its slots, with their initial passes."""
    clock, found = acquisition.clock, list[tuple[Acquisition, Reception]]()
    for part in (-0.5, 0.0, 0.5):
        row0 = clock.row0 + part / SETTINGS.cut_phases * clock.rows_per_slot
        moved = replace(acquisition, clock=replace(clock, row0=row0))
        found.append((moved, initial_pass(moved)))
    yield from found
    _, best = max(found, key=lambda each: evidence.log_evidence(each[1]))
    corrected = replace(acquisition, clock=replace(best.clock, exposure_slots=clock.exposure_slots))
    yield corrected, initial_pass(corrected)


def _starts(clock: Clock) -> Iterator[Clock]:
    """The clock with each start of packets that has a part of header or dimming symbol in view."""
    n, phase = clock.packet_slots, clock.first_slot % SLOTS_PER_SYMBOL
    for first_slot in range(phase, n, SLOTS_PER_SYMBOL):
        if first_slot < PREAMBLE_SLOTS or first_slot + clock.n_slots > n:
            n_copies = -(-(first_slot + clock.n_slots) // n)
            yield replace(clock, first_slot=first_slot, burst=np.arange(n_copies))
