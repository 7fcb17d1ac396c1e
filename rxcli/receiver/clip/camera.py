"""The camera of a clip: found with the screen, refined by decoded slots, and kept while nothing of it changes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.receiver.clip.common_clock import Start, acquisition_at, shows_little
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.frame.acquisition import Acquisition
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.frame.passes import Reception
from rxcli.receiver.frame.result import Failure
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.search import Found, search
from rxcli.receiver.search.evidence import USUAL_COLUMNS
from rxcli.receiver.search.framing import Framing, framing_of
from rxcli.receiver.search.settings import SETTINGS as search_settings
from rxcli.receiver.still import initial_pass
from rxcli.types import FloatArray, Frame, Remark


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """Where the screen is in a frame, and what the search found there."""

    outline: Outline
    context: FrameContext
    #: None where the frame is to be searched at its outline once more.
    found: Found | Failure | None
    #: How sure the length of packets is, by the frame that showed the camera; None where it shows none.
    framing: Framing | None = None
    #: Rows at the top and at the bottom of the outline that may not be on the screen; None where that is not known.
    dark_ends: tuple[int, int] | None = None
    #: The clock that frames after it show, where it does not by itself.
    start: Start | None = None

    @property
    def camera_error(self) -> float:
        """Relative standard deviation of the line delay; infinite where an estimated camera shows no packets."""
        camera = self.context.camera
        if camera.hypothesis is None:
            return 0.0
        return np.inf if isinstance(self.found, Failure) else camera.estimated["line_delay_s"][1] / camera.line_delay_s

    @property
    def evidence(self) -> float:
        """Of packets in it, or in the frame that shows the clock."""
        if self.start is not None:
            return self.start.log_evidence
        return self.found.best.evidence if isinstance(self.found, Found) else 0.0

    @property
    def shows_packets(self) -> bool:
        """Whether there are packets beyond doubt."""
        return self.evidence >= search_settings.few_packets

    @property
    def is_bent(self) -> bool:
        """Whether stripes seem to be bent, so that the screen cannot be tracked."""
        hypothesis = self.context.camera.hypothesis
        return hypothesis is not None and bool(hypothesis.curvature.any())

    @property
    def is_long(self) -> bool:
        """Whether packets of a long exposure were found."""
        return isinstance(self.found, Found) and self.found.best.reception.is_long

    @property
    def is_open(self) -> bool:
        """Whether there are no packets that settle the outline; those of long exposures show on many outlines."""
        return not isinstance(self.found, Found) or self.is_long

    @property
    def is_plain(self) -> bool:
        """Whether packets settle the outline beyond doubt."""
        return self.evidence >= search_settings.plain and not self.is_open

    @property
    def is_clear(self) -> bool:
        """Whether further frames, from which the texture is known, could show no more of it."""
        is_known = self.context.camera.hypothesis is None
        return self.is_plain or (is_known and (not self.is_open or shows_little(self.context)))

    @property
    def shows_little(self) -> bool:
        """Whether there are too few packets to find the clock, or packets leave their length open."""
        return shows_little(self.context) or (self.framing is not None and self.framing.length < SETTINGS.sure_framing)

    @property
    def needs_surer_camera(self) -> bool:
        """Whether the camera may be that of another frame."""
        return self.camera_error == np.inf or (self.camera_error > 0 and self.shows_little)

    def with_surer_camera(self, located: Located | Failure) -> Located:
        """The same with the camera of another frame, if that camera is more precise."""
        if isinstance(located, Failure) or located.camera_error >= self.camera_error:
            return self
        own = self.context
        context = replace(located.context, cache=own.cache, sampled_corners=own.sampled_corners)
        return replace(self, context=context, found=None, framing=located.framing)


@dataclass(frozen=True, slots=True, eq=False)
class Acquired:
    """A frame whose clock and camera are known, and its initial pass."""

    context: FrameContext
    acquisition: Acquisition
    initial: Reception
    framing: Framing


@dataclass(frozen=True, slots=True, eq=False)
class ClipCamera:
    """What is known of the camera of a clip, and of the screens that it may show."""

    options: ReceiverOptions
    #: A frame with the camera and the screens that remain; None before any.
    context: FrameContext | None = None
    #: Whether the camera's profile was compared with the clip, and a remark about it.
    is_compared: bool = False
    remark: Remark | None = None

    def fits(self, frame: Frame) -> bool:
        """Whether a frame is of the kind that the camera is known for."""
        return self.context is not None and _kind_of(self.context.frame) == _kind_of(frame)

    def of_frame(self, frame: Frame) -> ClipCamera:
        """What is known of the camera of another frame: nothing where it is of another kind."""
        return self if self.fits(frame) and "tracking" in self.options.skip else replace(self, context=None)

    def locate(
        self, cache: FrameCache, outlines: list[Outline] | None = None, *, may_bend: bool = True
    ) -> Located | Failure:
        """Find the screen in a frame, and the camera where it is not known; a failure where there is none.

        `outlines` are of the screen; None: it is looked for. See `search` for `may_bend`.
        """
        found = search(cache, self.options, self.context, outlines=outlines, may_bend=may_bend)
        context = found.best.context if isinstance(found, Found) else found.context or self.context
        if found.outline is None or context is None:
            assert isinstance(found, Failure)
            return found
        framing = _framing_of(found) if isinstance(found, Found) else None
        context = replace(context, cache=cache, sampled_corners=found.outline.corners)
        return Located(found.outline, context, found, framing)

    def locate_again(self, cache: FrameCache, outline: Outline | None, corners: FloatArray | None) -> Located | Failure:
        """The same of a screen that was lost: where it was, or anywhere if that shows more packets.

        Packets of a long exposure show on many outlines, so that it is taken to be where it was; and the border of what
        covers a part of a screen looks like the side of one that reaches out of the picture. If both are the same
        columns, all frames so far know better where they are.

        Args:
            cache: the frame.
            outline: where the screen was found; None: nothing is known.
            corners: (4, 2) of the screen in the last frame that showed it.
        """
        if outline is None or corners is None:
            return self.locate(cache)
        there = self.locate(cache, [replace(outline, corners=corners, strips=None, grid=None)])
        if isinstance(there, Located) and there.is_long:
            return there
        anywhere = self.locate(cache)
        here = there.evidence if isinstance(there, Located) else 0.0
        if isinstance(anywhere, Located) and not anywhere.is_long:
            has_left = _width_in_view(anywhere.outline.corners, cache.frame) < _width_in_view(corners, cache.frame)
            distance_px = np.abs(anywhere.outline.corners - corners)[:, 0].max()
            is_same = distance_px < np.ptp(corners[:, 0]) / (2 * USUAL_COLUMNS)
            if anywhere.evidence > (SETTINGS.moved_gain if has_left or is_same else 1.0) * here:
                return anywhere
        return there

    def acquire(
        self, located: Located, start: Start | None, cache: FrameCache
    ) -> tuple[ClipCamera, Acquired | Failure]:
        """Find the clock of a frame; its camera is known from then on.

        Args:
            located: the frame.
            start: the clock that the first frames agreed on, if any.
            cache: of the frame.
        """
        corners = located.context.sampled_corners
        context = replace(self.context or located.context, cache=cache, sampled_corners=corners)
        camera = replace(self, context=context)
        predicted = None if start is None else acquisition_at(start, replace(context, cache=located.context.cache))
        if predicted is not None:
            initial = initial_pass(predicted)
            return camera, Acquired(context, predicted, initial, framing_of(predicted, initial, self.options.screens))
        # Of the camera's lens, and in no need of refinement.
        outline = replace(located.outline, corners=corners, strips=None, grid=None)
        found = located.found or search(cache, self.options, context, outlines=[outline], may_bend=located.is_bent)
        if isinstance(found, Failure):
            return camera, found
        if not self.is_compared:
            camera, found = camera._compared(found, outline)
        best = found.best
        if best.context.camera.hypothesis is not None:
            context = replace(best.context, cache=cache, camera=replace(best.context.camera, hypothesis=None))
        context = replace(context, sampled_corners=best.context.sampled_corners)
        framing = located.framing if found is located.found else None
        acquired = Acquired(context, best.acquisition, best.reception, framing or _framing_of(found))
        return replace(camera, context=context), acquired

    def _compared(self, found: Found, outline: Outline) -> tuple[ClipCamera, Found]:
        """Estimate the camera of a clip's first frame where that of the profile explains little of it.

        Stabilisation crops and enlarges what was read, so that rows are no longer those of the profile.
        """
        compared, best = replace(self, is_compared=True), found.best
        enough = SETTINGS.unlike_evidence * best.evidence
        if best.context.camera.profile is None or enough >= search_settings.plain:
            return compared, found
        context = best.context
        options = replace(self.options, cameras=(), force_camera=False)
        estimated = search(context.cache, options, outlines=[outline])
        if isinstance(estimated, Failure) or estimated.best.evidence < max(search_settings.few_packets, enough):
            return compared, found
        stretch = context.camera.line_delay_s / estimated.best.context.camera.line_delay_s
        return replace(compared, options=options, remark=Remark("stabilised", {"stretch": stretch})), estimated


def _framing_of(found: Found) -> Framing:
    return framing_of(found.best.acquisition, found.best.reception, found.screens)


def _width_in_view(corners: FloatArray, frame: Frame) -> float:
    """Share of the width of a screen with these corners that is in the picture."""
    return float(np.ptp(np.clip(corners[:, 0], 0, frame.width)) / np.ptp(corners[:, 0]))


def _kind_of(frame: Frame) -> tuple[object, ...]:
    """Properties that camera and place of the picture depend on."""
    return frame.width, frame.height, frame.pixels.dtype.str, frame.black, frame.white, frame.metadata
