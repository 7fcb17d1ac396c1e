"""Reasons for a refusal: light without data, or nothing received.

A periodic waveform or a single lamp may explain the light as well as packets do.
"""

from typing import Any

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.protocol import PREAMBLE_SLOTS
from rxcli.receiver.decode import assemble
from rxcli.receiver.decode.steady import is_common_light, periodic_share
from rxcli.receiver.frame.acquisition import noise_of
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.frame.passes import Reception, dark_columns, shows_steady_light
from rxcli.receiver.frame.result import Failure, Received
from rxcli.receiver.frame.settings import SETTINGS as PASSES
from rxcli.receiver.light import MAX_EXPOSURE_SLOTS
from rxcli.receiver.plane.orientation import PORTRAIT
from rxcli.receiver.screen.stripes import MIN_LEAN, common_stripes
from rxcli.receiver.search import evidence
from rxcli.receiver.search.cameras import known_camera
from rxcli.receiver.search.hypothesis import Found, Hypothesis
from rxcli.receiver.search.outlines import common_light, lean_of, too_small, useless
from rxcli.receiver.search.propose import Proposer
from rxcli.receiver.search.settings import SETTINGS
from rxcli.receiver.still import as_one_column
from rxcli.receiver.sync import clock as sync
from rxcli.types import BELIEVABLE, Frame, FrameResult, Remark, RowProfiles

#: Reasons that nothing makes likelier.
_PLAIN = ("steady_light", "one_lamp", "black", "saturated", "few_pixels", "too_tall", "portrait")


def ruled_out(cache: FrameCache, options: ReceiverOptions) -> Remark | None:
    """Why a picture cannot show packets, before any search: its stated exposure, and no stripes that contradict it."""
    frame = cache.frame
    exposure_s = frame.metadata.exposure_s or 0.0
    slots = exposure_s * min(screen.slot_rate_hz for screen in options.screens)
    if slots < MAX_EXPOSURE_SLOTS or "no_screen" not in options.skip:
        return None
    if (frame.mosaic is None and lean_of(cache) > MIN_LEAN) or useless(frame) is not None:
        return None
    return Remark("long_exposure", {"exposure_s": exposure_s, "slots": slots})


def likeliest_reason(cache: FrameCache, result: FrameResult, options: ReceiverOptions) -> tuple[Remark, ...]:
    """Remarks on a refusal that begin with what is likeliest: a long exposure, a camera on its side, or no such screen.

    Args:
        cache: the picture.
        result: without a believable packet.
        options: with the screens that were tried.
    """
    frame, metadata, remarks = cache.frame, cache.frame.metadata, result.remarks or (Remark("unsure"),)
    # A packet of an uncertain column is still a packet.
    is_sent = any(packet.confidence > BELIEVABLE * result.column_certainty for packet in result.packets)
    if is_sent or result.reason in _PLAIN or frame.mosaic is not None:
        return result.remarks
    exposure_s = metadata.exposure_s or 0.0
    slots = exposure_s * min(screen.slot_rate_hz for screen in options.screens)
    if slots > SETTINGS.max_named_slots:
        return (Remark("long_exposure", {"exposure_s": exposure_s, "slots": slots}),)
    lean = lean_of(cache)
    if lean > MIN_LEAN and metadata.orientation in PORTRAIT:
        return (Remark("portrait", {"orientation": metadata.orientation}),)
    if lean < -MIN_LEAN and common_stripes(frame.pixels.T)[0] > SETTINGS.min_common_light:
        return (Remark("stripes_down"),)
    if result.status == "no_screen":
        return remarks
    if lean < MIN_LEAN:
        return (Remark("no_stripes_across"),)
    common = common_light(frame)
    return remarks if common is None else (common,)


def other_than_stated(frame: Frame, options: ReceiverOptions, found: Found, received: Received) -> Remark | None:
    """Remark on a result whose camera is not as it is stated: what was stated, and what was estimated."""
    known, result = known_camera(frame, options), received.result
    n_stated = 0 if found.stated is None else int(np.count_nonzero(evidence.believable(found.stated.reception)))
    if not found.doubts or received.n_believable <= n_stated:
        return None
    if isinstance(known, Failure):
        return known.remark
    facts: dict[str, Any] = {"n_stated": n_stated, "n_estimated": received.n_believable}
    facts |= {"stated_s": frame.metadata.exposure_s or 0.0, "exposure_s": result.exposure_s or 0.0}
    if known is None:
        return Remark("other_exposure", facts)
    facts |= {"profile": known.profile, "profile_s": known.line_delay_s, "line_delay_s": result.line_delay_s or 0.0}
    is_exposure = found.best.context.frame.metadata.exposure_s is None and frame.metadata.exposure_s is not None
    return Remark("other_camera_and_exposure" if is_exposure else "other_camera", facts)


def light_without_data(context: FrameContext, reception: Reception) -> Failure | None:
    """Failure of a screen with a clock whose light carries no data, or None.

    The link consists of independent columns. If all columns are equal they are received as one: a screen that sends the
    same in all columns still has headers, equal copies and words of the codebook.
    """
    if all(too_small(context, screen) for screen in context.screens):
        return None  # No packet fits, and light of few rows is periodic for some period.
    with context.timer("detect"):
        headers, q = PREAMBLE_SLOTS / reception.clock.packet_slots, reception.samples.samples_per_slot
        if not is_common_light(*reception.contrast, headers, SETTINGS.max_column_shift_slots * q):
            return None
        lit = reception.posteriors.log_evidence[~dark_columns(reception.snr)]
        if lit.size and float(np.median(lit)) > PASSES.min_packets_llr:
            return None
        joint = as_one_column(reception)
        no_header = bool(np.any(assemble.find_headerless(joint.posteriors.header_llr)))
        if float(joint.posteriors.log_evidence.max()) > PASSES.min_packets_llr and not no_header:
            return None
        return Failure(Remark("steady_light" if shows_steady_light(reception) else "one_lamp"))


def is_switched(context: FrameContext, profiles: RowProfiles) -> bool:
    """Whether one period explains the light of all columns; used if no clock was found."""
    if all(too_small(context, screen) for screen in context.screens):
        return False
    light, inside = profiles.light, profiles.inside.astype(np.float32)
    value, weight = sync.contrast(light, inside, SETTINGS.smooth_rows, noise_of(profiles))
    level = value * (weight > 0)
    headers = PREAMBLE_SLOTS / min(screen.packet_slots for screen in context.screens)
    if not is_common_light(value, weight, headers):
        return False
    level -= level.mean(axis=1, keepdims=True)
    return periodic_share(level, 2 * SETTINGS.max_period_rows) > SETTINGS.switched_share


def why_no_packets(proposer: Proposer, nearest: Hypothesis | None, reason: Remark | None) -> Failure:
    """Reason why a screen gave no packets.

    Args:
        proposer: of the frame.
        nearest: the likeliest hypothesis, or None if no camera was proposed.
        reason: why there were no cameras.
    """
    if nearest is None:
        return Failure(reason or Remark("no_headers"), outline=proposer.families()[0])
    context = proposer.context(nearest)
    profiles = sync.binned_strips(context.sample_columns(nearest.screen.columns))
    if is_switched(context, profiles):
        reason = Remark("steady_light")
    elif context.camera.hypothesis is not None:
        reason = reason or Remark("no_headers")
    else:
        shortest = min(context.screens, key=lambda screen: screen.packet_s)
        reason = too_small(context, shortest) or Remark("no_header")
    return Failure(reason, outline=nearest.outline, context=context)
