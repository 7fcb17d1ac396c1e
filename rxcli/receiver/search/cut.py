"""Less than a packet in view: soft bits for each screen, direction and start that the picture leaves open."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rxcli.numerics import peak_offset
from rxcli.profiles import ScreenProfile
from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL
from rxcli.receiver.channel import llr_of
from rxcli.receiver.decode import detect
from rxcli.receiver.frame.acquisition import Acquisition, distinct_screens
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.frame.passes import Reception, dark_columns, soft_bits
from rxcli.receiver.light import LONG_EXPOSURE_SLOTS
from rxcli.receiver.screen.find import ColumnLayout
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.screen.pose import corners_by_slots
from rxcli.receiver.search import evidence
from rxcli.receiver.search.cameras import UNKNOWN, cameras_by_slots, estimated_camera, relabelled_camera, settle_slots
from rxcli.receiver.search.settings import SETTINGS
from rxcli.receiver.still import decode, detected, detected_on, initial_pass, slots_of_any_kind
from rxcli.receiver.sync import clock as sync
from rxcli.types import Clock, Float32Array, FrameSoftBits

#: Passes made over cut packets: all columns with light.
_SKIP = frozenset({"dark_columns"})


@dataclass(frozen=True, slots=True)
class _Slots:
    """The slots of a picture by one camera, whatever they send."""

    context: FrameContext
    #: On the clock of a long packet whose payload is all that is in view.
    acquisition: Acquisition
    #: (C, N) probability that each slot is lit; log evidence of a slot against the unlikeliest phase.
    lit: Float32Array
    lead: float
    #: Screens that may send them.
    screens: Sequence[ScreenProfile]


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A start of the packets of one screen."""

    context: FrameContext
    acquisition: Acquisition
    #: See `evidence.fit`; a header in view has to earn its place.
    fit: float
    is_open: bool

    def is_near(self, better: _Candidate) -> bool:
        """Whether its symbols begin where those of a better one do, by the same screen read the same way."""
        own, known = self.acquisition, better.acquisition
        is_same = own.screen == known.screen and self.context.camera.reversed == better.context.camera.reversed
        return is_same and (own.clock.first_slot - known.clock.first_slot) % SLOTS_PER_SYMBOL == 0


def cut_packets(context: FrameContext, outlines: Sequence[Outline]) -> tuple[FrameSoftBits, ...]:
    """Soft bits of a frame that shows less than a packet, likeliest first.

    Args:
        context: the frame with its screens; its camera, or an unknown one.
        outlines: that its screen may have.
    """
    with context.timer("detect"):
        candidates = (candidate for slots in _best(context, outlines) for candidate in _candidates(slots))
        return tuple(_soft_bits(candidate) for candidate in _distinct(candidates))


def _best(context: FrameContext, outlines: Sequence[Outline]) -> Iterator[_Slots]:
    """The slots that stand out most, of each rate by a known camera, in two directions by an unknown one."""
    found = _found(context, outlines)
    if context.camera.profile is not None and all(slots.lead < SETTINGS.poor_lead for slots, _ in found):
        # What a profile states is off by a per cent.
        found += _found(replace(context, camera=UNKNOWN), outlines)
    best: dict[float, tuple[_Slots, Outline]] = {}
    for slots, outline in sorted(found, key=lambda each: each[0].lead):
        best[0.0 if slots.context.camera.hypothesis else slots.screens[0].slot_rate_hz] = slots, outline
    for each in best.values():
        slots = _settled(*each)
        yield slots
        if slots.context.camera.hypothesis is not None:
            yield _backwards(slots)


def _found(context: FrameContext, outlines: Sequence[Outline]) -> list[tuple[_Slots, Outline]]:
    """The slots by every outline and camera, and the outline; unlikelier cameras where none stands out."""
    found: list[tuple[_Slots, Outline]] = []
    for outline in outlines:
        for by_camera in _cameras(replace(context, sampled_corners=outline.corners)):
            found += [(slots, outline) for slots in _slots_by(_exposures(by_camera))]
            if by_camera.camera.hypothesis and found and found[-1][0].lead > SETTINGS.poor_lead:
                break
    return found


def _cameras(context: FrameContext) -> Iterable[FrameContext]:
    """The frame by each camera, with the screens that it may have seen."""
    screens = distinct_screens(context.screens)
    if context.camera.profile is not None:
        rates = dict.fromkeys(screen.slot_rate_hz for screen in screens)
        return [replace(context, screens=tuple(s for s in screens if s.slot_rate_hz == rate)) for rate in rates]
    ways: dict[int, FrameContext] = {}
    for screen, camera in cameras_by_slots(context, screens):
        # The light of slots looks the same backwards.
        if camera.hypothesis is not None and not camera.reversed:
            way = ways.get(camera.hypothesis.number, replace(context, camera=camera, screens=()))
            ways[camera.hypothesis.number] = replace(way, screens=(*way.screens, screen))
    return ways.values()


def _exposures(context: FrameContext) -> list[FrameContext]:
    """The frame under each slot rate of its screens: an exposure stated in seconds is other slots in each."""
    if context.camera.hypothesis is None or not context.frame.metadata.exposure_s:
        return [context]
    rates = dict.fromkeys(screen.slot_rate_hz for screen in context.screens)
    groups = [tuple(screen for screen in context.screens if screen.slot_rate_hz == rate) for rate in rates]
    cameras = [relabelled_camera(context.camera, screens[0], context.frame) for screens in groups]
    return [replace(context, camera=camera, screens=own) for camera, own in zip(cameras, groups, strict=True)]


def _slots_by(contexts: Sequence[FrameContext]) -> Iterator[_Slots]:
    """The slots by the exposure that the light shows, at their likeliest phase, if it stands out and they are a part.

    Args:
        contexts: the frame by each exposure; they differ in nothing else but their screens.
    """
    screen, camera = contexts[0].screens[0], contexts[0].camera
    profiles = contexts[0].sample_columns(screen.columns)
    rows_per_slot = 1 / (screen.slot_rate_hz * camera.line_delay_s)
    top, bottom = sync.row_span(profiles)
    n_slots = int(np.ceil((bottom - top) / rows_per_slot)) + 1
    # Where a whole header is in view, the search would have found it.
    exposed = [
        (context, context.camera.exposure_s * context.screens[0].slot_rate_hz)
        for context in contexts
        if n_slots < max(possible.packet_slots for possible in context.screens) + PREAMBLE_SLOTS
    ]
    exposed = [each for each in exposed if each[1] <= LONG_EXPOSURE_SLOTS]
    if n_slots <= SETTINGS.cut_symbols * SLOTS_PER_SYMBOL or not exposed:
        return
    clock = Clock(
        rows_per_slot=rows_per_slot,
        exposure_slots=exposed[0][1],
        packet_slots=PREAMBLE_SLOTS + -(-n_slots // SLOTS_PER_SYMBOL) * SLOTS_PER_SYMBOL,
        row0=top,
        n_slots=n_slots,
        first_slot=PREAMBLE_SLOTS,
        burst=np.zeros(1, np.int64),
        delay_slots=np.zeros(screen.columns),
        header_peak_ratio=0.0,
    )
    n, step = SETTINGS.cut_phases, rows_per_slot / SETTINGS.cut_phases
    acquisition = Acquisition(screen, profiles, clock, (screen,))
    # The brighter half of the columns shows the phase as well.
    bright = acquisition.of_columns(acquisition.bright_columns)
    clocks = [
        replace(bright.clock, exposure_slots=slots, row0=top - part * step) for _, slots in exposed for part in range(n)
    ]
    by_phase = np.array([log_evidence for _, log_evidence in slots_of_any_kind(bright, clocks)]).reshape(-1, n)
    by_phase *= screen.columns / bright.clock.delay_slots.size
    leads, tops = np.ptp(by_phase, axis=1) / n_slots, by_phase.max(axis=1)
    likely = np.flatnonzero((leads >= SETTINGS.cut_lead) & (tops > tops.max() - SETTINGS.cut_reach))
    if not likely.size:
        return
    likely = likely[np.argsort(-tops[likely], kind="stable")]
    likeliest, best = int(likely[0]), int(by_phase[likely[0]].argmax())
    beside = peak_offset(*np.take(by_phase[likeliest], [best - 1, best, best + 1], mode="wrap"))
    row0 = top - (best + float(np.clip(beside, -0.5, 0.5))) * step
    clock = replace(clock, exposure_slots=exposed[likeliest][1], row0=row0)
    ((lit, _),) = slots_of_any_kind(acquisition, [clock])
    screens = tuple(possible for number in likely for possible in exposed[number][0].screens)
    context = replace(exposed[likeliest][0], screens=screens)
    yield _Slots(context, replace(acquisition, clock=clock), clock.on_grid(lit[None]), float(leads[likeliest]), screens)


def _settled(slots: _Slots, outline: Outline) -> _Slots:
    """The slots by camera and outline as they show them, if these were not given."""
    context = slots.context
    for _ in range(SETTINGS.cut_fits if context.camera.hypothesis or outline.strips else 0):
        acquisition, lens = slots.acquisition, context.camera.lens or outline.lens
        clock, screen = acquisition.clock, acquisition.screen
        camera, _moved = settle_slots(context, acquisition, clock, slots.lit)
        if outline.strips is not None:
            layout = ColumnLayout(screen.columns, screen.light_spread, screen.aspect)
            outline = replace(outline, corners=corners_by_slots(outline, layout, clock, slots.lit, lens))
        context = replace(context, camera=camera, sampled_corners=outline.corners)
        better = next(_slots_by([context]), slots)
        if better.lead <= slots.lead:
            break
        slots = better
    return slots


def _backwards(slots: _Slots) -> _Slots:
    """The slots of a picture whose rows run against the readout."""
    context, screen, clock = slots.context, slots.acquisition.screen, slots.acquisition.clock
    assert context.camera.hypothesis is not None
    hypothesis = replace(context.camera.hypothesis, reversed=True)
    context = replace(context, camera=estimated_camera(hypothesis, screen.slot_rate_hz, context.frame))
    row0 = context.frame.height - 1 - clock.row0 - clock.n_slots * clock.rows_per_slot
    acquisition = replace(
        slots.acquisition, profiles=context.sample_columns(screen.columns), clock=replace(clock, row0=row0)
    )
    return replace(slots, context=context, acquisition=acquisition, lit=slots.lit[:, ::-1])


def _candidates(slots: _Slots) -> Iterator[_Candidate]:
    """Starts of packets: at every phase of a symbol, without and with a header in view."""
    clock = slots.acquisition.clock
    for screen in (screen for screen in slots.screens if clock.n_slots < 2 * screen.packet_slots):
        camera, n = relabelled_camera(slots.context.camera, screen, slots.context.frame), screen.packet_slots
        context = replace(slots.context, camera=camera, screens=(screen,))
        clock = replace(clock, exposure_slots=camera.exposure_s * screen.slot_rate_hz)
        acquisition = replace(slots.acquisition, screen=screen, variants=(screen,), clock=clock)
        initial = initial_pass(acquisition)
        initial = replace(initial, llr=(initial.llr + llr_of(slots.lit)) * np.float32(0.5))
        for phase in range(SLOTS_PER_SYMBOL):
            first_slots = range(phase, n, SLOTS_PER_SYMBOL)
            # A header is in view, at least in part; the last slot of the clock lies beyond the picture.
            shown = [slot for slot in first_slots if slot < PREAMBLE_SLOTS or slot + clock.n_slots > n + 1]
            shown.sort(key=lambda first_slot: -_header_fit(initial, first_slot, n))
            starts = [(slot, _fit(initial, slot, n) - SETTINGS.cut_start) for slot in shown[:2]]
            if len(shown) < len(first_slots):
                # Packets of any length: longer by a symbol than what is in view, as the first may begin before it.
                longer = clock.packet_slots + SLOTS_PER_SYMBOL
                starts.append((PREAMBLE_SLOTS + phase, _fit(initial, PREAMBLE_SLOTS + phase, longer)))
            for first_slot, fit in starts:
                moved = replace(acquisition, clock=_started(clock, first_slot, n))
                yield _Candidate(context, moved, fit, is_open=first_slot not in shown)


def _header_fit(initial: Reception, first_slot: int, packet_slots: int) -> float:
    """How well the header fits where packets of some length begin elsewhere."""
    bursts = _started(initial.clock, first_slot, packet_slots).by_burst(initial.llr)
    return float(np.maximum(detect.header_llr(bursts).sum(axis=0), -SETTINGS.cut_start).sum())


def _fit(initial: Reception, first_slot: int, packet_slots: int) -> float:
    """See `evidence.fit`: with packets of some length, in which the clock begins with slot `first_slot`."""
    return evidence.fit(detected_on(initial, _started(initial.clock, first_slot, packet_slots)))


def _started(clock: Clock, first_slot: int, packet_slots: int) -> Clock:
    """The clock with packets of some length that begin elsewhere, every copy in a burst of its own."""
    n_copies = -(-(first_slot + clock.n_slots) // packet_slots)
    return replace(clock, packet_slots=packet_slots, first_slot=first_slot, burst=np.arange(n_copies))


def _distinct(candidates: Iterable[_Candidate]) -> list[_Candidate]:
    """The likeliest few whose symbols begin at different places; none that fits no better than noise."""
    out: list[_Candidate] = []
    for candidate in sorted(candidates, key=lambda candidate: -candidate.fit):
        least = max(SETTINGS.cut_fit, out[0].fit - SETTINGS.cut_reach if out else -np.inf)
        if candidate.fit < least or len(out) == SETTINGS.max_cut:
            break
        if not any(candidate.is_near(better) for better in out):
            out.append(candidate)
    return out


def _soft_bits(candidate: _Candidate) -> FrameSoftBits:
    """Soft bits of a cut packet."""
    acquisition = candidate.acquisition
    initial = initial_pass(acquisition)
    corrected = replace(acquisition, clock=replace(initial.clock, exposure_slots=acquisition.clock.exposure_slots))
    acquisition, initial = max(
        ((acquisition, initial), (corrected, initial_pass(corrected))), key=lambda found: evidence.fit(found[1])
    )
    ways = [_of_common_weights(initial)]
    if candidate.is_open:
        ways += [_of_common_weights(initial_pass(acquisition, share)) for share in SETTINGS.cut_room_lights[1:]]
    reception = decode(acquisition, _SKIP, max(ways, key=_n_certain), keeps_weights=True)
    found = soft_bits(candidate.context.frame, acquisition.screen, reception, dark_columns(reception.snr))
    return replace(found, open_start=candidate.is_open)


def _n_certain(initial: Reception) -> float:
    """Bits that are expected to be right beyond chance, of columns with the commonest weight."""
    common = initial.posteriors.w == np.bincount(initial.posteriors.w).argmax()
    return float(np.tanh(np.abs(np.nan_to_num(initial.posteriors.bit_llr[:, common])) / 2).sum())


def _of_common_weights(initial: Reception) -> Reception:
    """The initial pass with the weights that columns have in common."""
    weights = detect.common_weights(initial.posteriors.w_log_prob)
    return replace(initial, posteriors=detected(initial.llr, initial.clock, weights))
