"""Reasons for a refusal: light without data, or nothing received.

A periodic waveform or a single lamp may explain the light as well as packets do.
"""

from dataclasses import replace

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.protocol import PREAMBLE_SLOTS
from rxcli.receiver.camera.advice import NO_HEADERS
from rxcli.receiver.decode import assemble
from rxcli.receiver.decode.steady import is_common_light, periodic_share
from rxcli.receiver.frame.acquisition import noise_of
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.frame.passes import Reception, dark_columns, shows_steady_light
from rxcli.receiver.frame.result import Failure
from rxcli.receiver.frame.settings import SETTINGS as PASSES
from rxcli.receiver.screen.stripes import MIN_LEAN, stripe_lean
from rxcli.receiver.search.hypothesis import Hypothesis
from rxcli.receiver.search.outlines import NO_COLUMNS, too_small
from rxcli.receiver.search.propose import Proposer
from rxcli.receiver.search.settings import SETTINGS
from rxcli.receiver.still import as_one_column
from rxcli.receiver.sync import clock as sync
from rxcli.types import BELIEVABLE, Frame, FrameResult, RowProfiles

_NEXT = "point the camera at the screen that sends, or check that it does"
STEADY_LIGHT = (
    f"this light is switched on and off steadily (PWM), as lamps and dimmed screens do, and carries no data; {_NEXT}"
)
_ONE_LAMP = f"all columns show the same light and no packets in it, as of a single lamp; {_NEXT}"
_UNSURE = "no packet is sure; show a brighter picture or move closer"
_SHORTER = (
    "drag the camera app's exposure down until the picture is nearly dark, or expose for 1/8000 s or less, with the "
    "electronic shutter, HDR and night mode off"
)
_NO_HEADER = "a screen was found but no packet header; check that it sends, the shutter is electronic and HDR is off"


def likeliest_reason(frame: Frame, result: FrameResult, options: ReceiverOptions) -> str | None:
    """Message of a refusal that begins with what is likeliest: no screen that sends, or a long exposure.

    Args:
        frame: the picture.
        result: without a believable packet.
        options: with the screens that were tried.
    """
    message, exposure_s = result.message or _UNSURE, frame.metadata.exposure_s or 0.0
    # A packet of an uncertain column is still a packet.
    is_sent = any(packet.confidence > BELIEVABLE * result.column_certainty for packet in result.packets)
    if is_sent or message.startswith((STEADY_LIGHT, _ONE_LAMP)) or frame.mosaic is not None:
        return result.message
    slots = exposure_s * min(screen.slot_rate_hz for screen in options.screens)
    fades = ""
    if slots > SETTINGS.max_named_slots:
        stated = f"{1e6 * exposure_s:.0f} us" if exposure_s < 1e-3 else f"{1e3 * exposure_s:.3g} ms"
        fades = f"the exposure of {stated} that the file states lasts {slots:.0f} slots or more, in which stripes fade"
        fades += f" (a screen of at most {SETTINGS.max_named_slots / exposure_s:.0f} slots a second suits it)"
    reason, _, advice = message.partition("; ")
    if result.status == "no_screen":
        return f"{reason}, and {fades}; {advice}" if fades and reason.endswith(NO_COLUMNS) else message
    if stripe_lean(frame.pixels) < MIN_LEAN:
        doubt = "the picture may show no screen that sends: no stripes run across it"
        return f"{doubt}, and {fades}; {_SHORTER}" if fades else f"{doubt}; if it does, {message}"
    return f"{fades}; {_SHORTER}" if fades else result.message


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
        lit = reception.column_llr[~dark_columns(reception.snr)]
        if lit.size and float(np.median(lit)) > PASSES.min_packets_llr:
            return None
        joint = as_one_column(reception)
        no_header = bool(np.any(assemble.find_headerless(joint.posteriors.header_llr)))
        if float(joint.column_llr.max()) > PASSES.min_packets_llr and not no_header:
            return None
        return Failure("no_signal", STEADY_LIGHT if shows_steady_light(reception) else _ONE_LAMP)


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


def why_no_packets(proposer: Proposer, nearest: Hypothesis | None, failure: Failure | None) -> Failure:
    """Reason why a screen gave no packets.

    Args:
        proposer: of the frame.
        nearest: the likeliest hypothesis, or None if no camera was proposed.
        failure: reason why there were no cameras.
    """
    if nearest is None:
        return replace(failure or Failure("no_signal", NO_HEADERS), outline=proposer.families()[0])
    context = proposer.context(nearest)
    profiles = sync.binned_strips(context.sample_columns(nearest.screen.columns))
    if is_switched(context, profiles):
        message = STEADY_LIGHT
    elif context.camera.hypothesis is not None:
        message = failure.message if failure else NO_HEADERS
    else:
        shortest = min(context.screens, key=lambda screen: screen.packet_s)
        message = too_small(context, shortest) or _NO_HEADER
    return Failure("no_signal", message, outline=nearest.outline, context=context)
