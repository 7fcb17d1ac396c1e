"""The clock that the first frames of a clip share, where each shows too little to find its own.

A frame that shows less than two packets may show no whole header, or show payload that looks like one. Frames put one
after the other, as far apart as in time, show the headers of all of them at the same place in the packet's length.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rxcli.numerics import NORMAL_MEDIAN, TINY
from rxcli.profiles import ScreenProfile
from rxcli.protocol import SLOTS_PER_SYMBOL
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.frame.acquisition import Acquisition, distinct_screens, noise_of, variants_of
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.search import Found
from rxcli.receiver.sync import clock as sync
from rxcli.receiver.sync.settings import SETTINGS as sync_settings
from rxcli.receiver.sync.tracking import LinkTime, slot_of_row_0
from rxcli.types import Clock, FloatArray, Frame, IntArray, RowProfiles


@dataclass(frozen=True, slots=True)
class Start:
    """What the first frames agree on."""

    screen: ScreenProfile
    #: The screen and others that differ only in the number of copies per burst.
    variants: tuple[ScreenProfile, ...]
    time: LinkTime
    #: How much likelier the headers' place is than the best elsewhere.
    lead: float
    #: Log-likelihood of headers there, against none; and probability of this length against the others compared.
    log_evidence: float
    certainty: float = 1.0


def shows_little(context: FrameContext) -> bool:
    """Whether a frame shows too few packets to find its clock alone."""
    corners, height = context.sampled_corners, context.frame.height
    shown = min(float(corners[:, 1].max()), height - 1.0) - max(float(corners[:, 1].min()), 0.0)
    shortest_s = min(screen.packet_s for screen in context.screens)
    return shown * context.camera.line_delay_s < SETTINGS.few_packets * shortest_s


def hides_headers(found: Found) -> bool:
    """Whether exposures are so long that the light itself does not show where a header is."""
    return found.best.reception.clock.exposure_slots > SLOTS_PER_SYMBOL / 2


def common_clock(
    frames: Sequence[Frame], context: FrameContext, screens: Sequence[ScreenProfile]
) -> tuple[Start, FrameContext] | None:
    """Find the clock on which the headers of several frames agree, and the frame's context by which they do so best.

    Args:
        frames: the first frames.
        context: of the first of them.
        screens: that an estimated camera may have seen.
    """
    found = [(start, at) for at in _possible_contexts(frames, context, screens) for start in _starts(frames, at)]
    start, at = max(found, key=lambda each: each[0].log_evidence)
    if start.lead <= SETTINGS.min_lead:
        return None
    # Screens that differ in their columns alone share a clock; so do some stretches of the time stamps.
    rivals: dict[tuple[float, int], float] = {}
    for each, _ in sorted(found, key=lambda each: each[0].log_evidence):
        rivals[each.screen.slot_rate_hz, each.screen.packet_slots] = each.log_evidence
    certainty = 1 / np.exp(np.array(list(rivals.values())) - start.log_evidence).sum()
    return replace(start, certainty=float(certainty)), at


def start_by(found: Found, frames: Sequence[Frame]) -> Start:
    """The clock of the first of some frames by that which is found in any of them."""
    best = found.best
    screen, clock, frame = best.acquisition.screen, best.reception.clock, best.context.frame
    period = _period_s(frames) * screen.slot_rate_hz
    slot = slot_of_row_0(clock) - (frame.index - frames[0].index) * period
    time = LinkTime(screen.packet_slots, screen.slot_rate_hz)
    time.begin(frames[0].index, frames[0].time_s, slot, period)
    return Start(screen, best.acquisition.variants, time, clock.header_peak_ratio, best.evidence)


def _period_s(frames: Sequence[Frame]) -> float:
    times_s, numbers = np.array([(frame.time_s, frame.index) for frame in frames]).T
    return float(np.polyfit(numbers - numbers[0], times_s, 1)[0])


def _possible_contexts(
    frames: Sequence[Frame], context: FrameContext, screens: Sequence[ScreenProfile]
) -> Iterator[FrameContext]:
    """The context as it is; if its camera was estimated, by every slot rate that fits the frames.

    Less than a packet shows the rows of a slot, but perhaps another screen's.
    """
    camera, rate_hz = context.camera, context.screens[0].slot_rate_hz
    if camera.hypothesis is None:
        yield context
        return
    periods_s = np.diff([frame.time_s for frame in frames if not frame.nominal_time])
    longest_s = SETTINGS.readout_slack * periods_s[periods_s > 0].min(initial=np.inf)
    for slot_rate_hz in dict.fromkeys([rate_hz, *(screen.slot_rate_hz for screen in screens)]):
        scale = rate_hz / slot_rate_hz
        delay_s, exposure_s = scale * camera.line_delay_s, scale * camera.exposure_s
        estimated = {**camera.estimated, "line_delay_s": (delay_s, scale * camera.estimated["line_delay_s"][1])}
        scaled = replace(camera, line_delay_s=delay_s, exposure_s=exposure_s, estimated=estimated)
        if delay_s * context.frame.height <= longest_s:
            same_rate = tuple(screen for screen in screens if screen.slot_rate_hz == slot_rate_hz)
            yield replace(context, camera=scaled, screens=same_rate)


def _starts(frames: Sequence[Frame], context: FrameContext) -> Iterator[Start]:
    """The clock of each screen that all frames together show; `context` is of the first of them."""
    line_delay_s, q = context.camera.line_delay_s, sync_settings.search_samples
    period_s, numbers = _period_s(frames), np.array([frame.index - frames[0].index for frame in frames])
    for screen in distinct_screens(context.screens):
        each = (replace(context, cache=FrameCache(frame, context.timer)) for frame in frames)
        profiles = [of_frame.sample_columns(screen.columns) for of_frame in each]
        readout_s, variants = profiles[0].rows.size * line_delay_s, variants_of(screen, context.screens)
        power, first_slot = _header_power(profiles, 1 / (screen.slot_rate_hz * line_delay_s))
        for stretch in range(1, min(sync_settings.max_stretch, max(int(period_s / readout_s), 1)) + 1):
            period = period_s / stretch * screen.slot_rate_hz
            starts = np.round(numbers[:, None] * period * q).astype(np.int64)
            place, lead, log_evidence = _first_header(power, starts, screen.packet_slots * q)
            time = LinkTime(screen.packet_slots, screen.slot_rate_hz, stretch)
            time.begin(frames[0].index, frames[0].time_s, -(first_slot + place / q), period)
            log_evidence -= sync_settings.settled_llr * (stretch > 1)
            yield Start(screen, variants, time, lead, log_evidence)


def _header_power(profiles: Sequence[RowProfiles], rows_per_slot: float) -> tuple[FloatArray, float]:
    """(frames, samples) log-likelihood of a header that starts at each sample of a frame, and slot of the first sample.

    Samples begin a header before the frame, so that a header that began before it counts by its end. Payloads of many
    columns add up to noise, against which every header that is in view counts.
    """
    q, before = sync_settings.search_samples, SLOTS_PER_SYMBOL
    spans, step = [sync.row_span(each) for each in profiles], rows_per_slot / q
    top, bottom = min(top for top, _ in spans), max(bottom for _, bottom in spans)
    n_samples = before * q + int((bottom - top) / step)
    sampled = [sync.resample(each, top - before * rows_per_slot, step, n_samples) for each in profiles]
    light, valid = (np.concatenate(values, axis=2) for values in zip(*sampled, strict=True))
    pooled, weight = sync.search_contrast(light, valid, noise_of(profiles[0]) / np.sqrt(max(step, 1.0)))
    response = sync.header_response(pooled, weight, q).mean(axis=0)
    shown = response[response != 0]
    noise = np.square(np.median(np.abs(shown)) / NORMAL_MEDIAN) + TINY if shown.size else 1.0
    power = np.maximum(response, 0) ** 2 / (2 * noise)
    return power.reshape(len(profiles), -1), top / rows_per_slot - before


def _first_header(power: FloatArray, starts: IntArray, period: int) -> tuple[float, float, float]:
    """Sample of the first header, how much likelier that place is, and the log-likelihood of headers there.

    Args:
        power: (frames, samples), see `_header_power`.
        starts: (frames, 1) samples from the start of the first frame to that of each.
        period: samples of a packet.
    """
    places = (starts + np.arange(power.shape[1])) % period
    total = np.bincount(places.ravel(), power.ravel(), period)
    # Time stamps are rounded to milliseconds: neighbouring places are equivalent.
    near = (total + np.roll(total, 1) + np.roll(total, -1)) / 3
    place, lead = sync.header_comb(near, sync_settings.search_samples)
    best = float(near.max())
    return place, lead, best + float(np.log(np.exp(near - best).sum() / near.size))


def acquisition_at(start: Start, context: FrameContext) -> Acquisition | None:
    """What the clip's clock predicts for a frame; None where nothing of the screen is in the picture."""
    screen, frame, camera = start.screen, context.frame, context.camera
    profiles = context.sample_columns(screen.columns)
    top, bottom = sync.row_span(profiles)
    if top == bottom:
        return None
    rows_per_slot = 1 / (screen.slot_rate_hz * camera.line_delay_s)
    like = Clock(
        rows_per_slot=rows_per_slot,
        exposure_slots=camera.exposure_s * screen.slot_rate_hz,
        packet_slots=screen.packet_slots,
        row0=0.0,
        n_slots=0,
        first_slot=0,
        burst=np.zeros(0, np.int64),
        delay_slots=np.zeros(screen.columns),
        header_peak_ratio=start.lead,
    )
    n_slots = int(np.ceil((bottom - top) / rows_per_slot)) + 1
    clock = start.time.clock_at(frame.index, frame.time_s, like, n_slots, top)
    return None if clock is None else Acquisition(screen, profiles, clock, variants=start.variants)
