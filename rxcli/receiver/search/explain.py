"""Reason why nothing was received, from the results of the search."""

from __future__ import annotations

from dataclasses import replace

from rxcli.receiver.acquisition import sample_columns
from rxcli.receiver.camera.advice import NO_HEADERS
from rxcli.receiver.context import Failure
from rxcli.receiver.corners import too_small
from rxcli.receiver.search.hypothesis import Hypothesis
from rxcli.receiver.search.nulls import STEADY_LIGHT, is_switched
from rxcli.receiver.search.propose import Proposer

_NO_HEADER = "a screen was found but no packet header; check that it sends, the shutter is electronic and HDR is off"


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
    profiles = sample_columns(context, nearest.screen.columns).binned
    if is_switched(context, profiles):
        message = STEADY_LIGHT
    elif context.camera.hypothesis is not None:
        message = failure.message if failure else NO_HEADERS
    else:
        shortest = min(context.screens, key=lambda screen: screen.packet_s)
        message = too_small(context, shortest) or _NO_HEADER
    return Failure("no_signal", message, outline=nearest.outline, context=context)
