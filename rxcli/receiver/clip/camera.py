"""The camera of a clip: found with the screen, refined by decoded slots, and kept while nothing of it changes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile
from rxcli.receiver.acquisition import Acquisition
from rxcli.receiver.cameras import has_profile
from rxcli.receiver.clip.acquiring import Start, agree, shows_little
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.context import Failure, FrameContext, Outline, Timer
from rxcli.receiver.reception import Reception, has_clear_packets
from rxcli.receiver.search import Found, search
from rxcli.receiver.search.refusal import light_without_data
from rxcli.receiver.still import decode_photograph, doubtful_columns, initial_pass
from rxcli.receiver.unknown_camera import settle
from rxcli.types import FloatArray, Frame

_UNLIKE = (
    "rows are {:.3f} times as quick as the named camera's, as in clips that were stabilised or cropped: the camera was "
    "estimated instead; switch stabilisation off for the best"
)


@dataclass(frozen=True, slots=True, eq=False)
class Settled:
    """A frame whose clock and camera are known."""

    context: FrameContext
    acquisition: Acquisition
    #: Its initial pass, where there was one; what was decoded to refine its camera, where that was estimated.
    initial: Reception | None = None
    reception: Reception | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """Where the screen is in a frame, and what the search found there."""

    outline: Outline
    context: FrameContext
    #: None where the screen was moved since, or the camera is another one.
    found: Found | Failure | None = None

    def moved_to(self, corners: FloatArray) -> Located:
        """The same with the screen at the corners (4, 2)."""
        if corners is self.context.corners:
            return self
        return Located(replace(self.outline, corners=corners), replace(self.context, corners=corners))

    @property
    def camera_error(self) -> float:
        """Relative standard deviation of the line delay; infinite where an estimated camera shows no packets."""
        camera = self.context.camera
        if camera.hypothesis is None:
            return 0.0
        return camera.estimated["line_delay_s"][1] / camera.line_delay_s if isinstance(self.found, Found) else np.inf

    def with_surer_camera(self, located: Located | Failure) -> Located:
        """The same with the camera of another frame, if that camera is more precise."""
        if isinstance(located, Failure) or located.camera_error >= self.camera_error:
            return self
        context = replace(located.context, frame=self.context.frame, corners=self.context.corners)
        return replace(self, context=context, found=located.found)


@dataclass(frozen=True, slots=True, eq=False)
class ClipCamera:
    """What is known of the camera of a clip, and of the screens that it may show."""

    options: ReceiverOptions
    #: A frame with the camera and the screens that remain; None before any.
    context: FrameContext | None = None
    #: Properties of the frames that the camera is known for.
    frame_kind: tuple[object, ...] = ()
    #: Whether the camera's profile was compared with the clip, and a message about it.
    profile_tried: bool = False
    message: str | None = None

    def fits(self, frame: Frame) -> bool:
        """Whether a frame is of the kind that the camera is known for."""
        return self.frame_kind == _kind_of(frame)

    def for_frame(self, frame: Frame) -> ClipCamera:
        """What is known of the camera of another frame: nothing where it is of another kind."""
        return self if self.fits(frame) and "tracking" in self.options.skip else replace(self, context=None)

    def found_with(self, located: Located, frame: Frame) -> ClipCamera:
        """The camera that was found with the screen, unless one is known."""
        if self.context is not None:
            return self
        return replace(self, context=located.context, frame_kind=_kind_of(frame))

    def locate(self, frame: Frame, timer: Timer) -> Located | Failure:
        """Find the screen in a frame, and the camera where it is not known."""
        return _located(search(frame, self.options, timer, self.context))

    def _search_at(self, context: FrameContext, known: FrameContext | None = None) -> Found | Failure:
        """Search a frame whose corners are known."""
        at = replace(self.options, corners=context.corners)
        return search(context.frame, at, context.timer, known)

    # -- the first frames ------------------------------------------------------------------------------------------

    def read_in_time(self, located: Located, frames: Sequence[Frame]) -> tuple[ClipCamera, Located]:
        """Replace an estimated camera that would need longer than a frame's time to read it.

        An estimate gives rows per slot; with a slower screen than the right one the camera seems slower, too.
        """
        context, period_s, little = located.context, _shortest_period_s(frames), shows_little(located.context)
        if context.camera.hypothesis is None or period_s is None:
            return self, located
        too_long = _readout_periods(context, period_s)
        if too_long <= 1 and not little:
            return self, located
        min_rate_hz = too_long * max(screen.slot_rate_hz for screen in context.screens)
        screens = tuple(screen for screen in self.options.screens if screen.slot_rate_hz >= min_rate_hz)
        quicker = replace(self, options=replace(self.options, screens=screens))
        found = quicker._search_at(context) if too_long > 1 and screens else None
        if not isinstance(found, Found):
            return (quicker if screens and little else self), located
        return quicker, replace(located, context=found.best.context, found=found)

    def with_common_clock(self, located: Located, frames: Sequence[Frame]) -> tuple[Located, Start | None]:
        """Find the clock that the first frames share, with the reading of the first frame's camera that leads.

        Less than a packet gives rows per slot, but perhaps another screen, or the wrong direction of the readout.
        """
        original = located.context
        readings = [original]
        if original.camera.hypothesis is not None:
            period_s = _shortest_period_s(frames) or np.inf
            readings += _readings_of(original, self.options.screens)
            readings = [estimate for estimate in readings if _readout_periods(estimate, period_s) <= 1]
        starts = [(agree(frames, estimate), estimate) for estimate in readings]
        agreed = [(start.lead, start, estimate) for start, estimate in starts if start is not None]
        if not agreed:
            return located, None
        _, start, chosen = max(agreed, key=lambda candidate: candidate[0])
        return (located if chosen is original else replace(located, context=chosen, found=None)), start

    # -- a frame received like a photograph ------------------------------------------------------------------------

    def settled(self, located: Located, predicted: Acquisition | None = None) -> tuple[ClipCamera, Settled | Failure]:
        """The frame's clock; and where its camera was estimated, the camera that its slots give, from then on.

        Args:
            located: the frame.
            predicted: its clock, where other frames have shown it.
        """
        context = located.context
        if predicted is not None:
            initial = initial_pass(predicted)
            return self, light_without_data(context, initial) or Settled(context, predicted, initial)
        found = located.found or self._search_at(context, context)
        if isinstance(found, Failure):
            return self, found
        best = found.best
        if context.camera.hypothesis is None:
            return self, Settled(context, best.acquisition, best.reception)
        with context.timer("detect"):
            reception = decode_photograph(best.acquisition, self.options.skip, best.reception)
        camera, _ = settle(best.context, best.acquisition, reception)
        context = replace(context, camera=replace(camera, hypothesis=None))
        return replace(self, context=context), Settled(context, best.acquisition, best.reception, reception)

    def estimated(self, context: FrameContext, reception: Reception) -> tuple[ClipCamera, Settled | None]:
        """A clip's first frame by a camera estimated from it, where that of the profile explains nothing of it.

        Stabilisation crops and enlarges what was read, so that rows are no longer those of the profile.
        """
        tried = replace(self, profile_tried=True)
        named = not self.profile_tried and has_profile(context.frame, self.options)
        if not named or _shows_packets(reception, SETTINGS.unlike_doubt):
            return tried, None
        unnamed = replace(tried, options=replace(self.options, cameras=(), force_camera=False))
        located = _located(unnamed._search_at(context))
        unnamed, found = (unnamed, located) if isinstance(located, Failure) else unnamed.settled(located)
        if isinstance(found, Failure) or not _shows_packets(
            found.reception or initial_pass(found.acquisition), SETTINGS.like_doubt
        ):
            return tried, None
        stretch = context.camera.line_delay_s / found.context.camera.line_delay_s
        return replace(unnamed, context=found.context, message=_UNLIKE.format(stretch)), found


def _readings_of(context: FrameContext, screens: Sequence[ScreenProfile]) -> Iterator[FrameContext]:
    """A frame whose camera was estimated, for every screen and direction of readout that its rows may be of."""
    camera, rate_hz = context.camera, context.screens[0].slot_rate_hz
    for slot_rate_hz in dict.fromkeys(screen.slot_rate_hz for screen in screens):
        scale = rate_hz / slot_rate_hz
        delay_s, exposure_s = scale * camera.line_delay_s, scale * camera.exposure_s
        same_rate = tuple(screen for screen in screens if screen.slot_rate_hz == slot_rate_hz)
        for reverse in (False, True):
            estimated = {**camera.estimated, "line_delay_s": (delay_s, scale * camera.estimated["line_delay_s"][1])}
            scaled = replace(camera, line_delay_s=delay_s, exposure_s=exposure_s, reversed=reverse, estimated=estimated)
            yield replace(context, camera=scaled, screens=same_rate)


def _readout_periods(context: FrameContext, period_s: float) -> float:
    """Time of the readout, in parts of the longest that fits a frame period."""
    return context.camera.line_delay_s * context.frame.height / (period_s * SETTINGS.readout_slack)


def _shortest_period_s(frames: Sequence[Frame]) -> float | None:
    """The shortest time from one frame to the next by their time stamps, or None."""
    passed = [
        after.time_s - before.time_s
        for before, after in pairwise(frames)
        if not after.nominal_time and after.time_s > before.time_s
    ]
    return min(passed, default=None)


def _located(found: Found | Failure) -> Located | Failure:
    """Where a search found the screen; a failure where it found no camera."""
    if isinstance(found, Found):
        return Located(found.outline, found.best.context, found)
    if found.outline is None or found.context is None:
        return found
    return Located(found.outline, found.context, found)


def _doubt_of(reception: Reception) -> float:
    """Share of the columns of a frame that are in doubt."""
    return float(doubtful_columns(reception).size / reception.snr.shape[0])


def _shows_packets(reception: Reception, doubt: float) -> bool:
    """Whether a camera explains a frame.

    If packets are complete, the share of doubtful columns must be below `doubt`; else the slots must resemble packets.
    """
    return _doubt_of(reception) < doubt if reception.is_complete.any() else has_clear_packets(reception)


def _kind_of(frame: Frame) -> tuple[object, ...]:
    """Properties that camera and place of the picture depend on."""
    return frame.width, frame.height, frame.pixels.dtype.str, frame.black, frame.white, frame.metadata
