"""The first frames of a clip: they show where the screen is, and the surest of their cameras counts.

The strips of a whole clip lie where its first frame has the screen. Where that frame shows no packets, or those of a
long exposure, it is searched without its texture as well, which is what it has in common with the frames after it: the
outlines that some of them show so are carried back by the motion of the texture, and their median is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rxcli.profiles import ScreenProfile
from rxcli.receiver.clip.camera import ClipCamera, Located
from rxcli.receiver.clip.common_clock import Start, common_clock, hides_headers, start_by
from rxcli.receiver.clip.ends import dark_ends
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.result import Failure
from rxcli.receiver.plane import CommonTexture, shows_same
from rxcli.receiver.search import Found
from rxcli.receiver.search.cameras import DEFAULT_TONE
from rxcli.types import FloatArray, Frame


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """What a frame shows, and where the screen of it is in the first frame."""

    corners: FloatArray
    located: Located

    @classmethod
    def of(cls, located: Located, motion: FloatArray | float = 0.0) -> Place:
        """From the motion of the screen since the first frame."""
        return cls(located.outline.corners - motion, located)

    def agrees(self, place: Place) -> bool:
        """Whether both have the same columns, read at the same slot rate and in the same direction."""
        own, given = self.located.context, place.located.context
        if own.camera.reversed != given.camera.reversed or own.screens[0].slot_rate_hz != given.screens[0].slot_rate_hz:
            return False
        column = float(np.ptp(self.corners[:, 0])) / own.screens[0].columns
        return float(np.abs(self.corners - place.corners)[:, 0].max()) < column


def agreeing(places: Sequence[Place]) -> list[Place]:
    """The places that agree with a common one, of the largest evidence together."""
    groups = ([place for place in places if place.agrees(centre)] for centre in places)
    return max(groups, key=lambda group: sum(place.located.evidence for place in group))


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """The first frames, until they show screen and camera."""

    frames: tuple[Frame, ...]
    #: What the first of them shows, with the surest of their cameras.
    located: Located | Failure
    #: Whether the texture of the picture may hide slots, so that more frames are worth waiting for.
    is_hidden: bool = False
    #: The clock that another of them shows, where the first does not.
    start: Start | None = None

    @classmethod
    def begin(cls, frame: Frame, camera: ClipCamera, *, may_wait: bool) -> Window:
        """Search the first frame."""
        located = camera.locate(FrameCache(frame))
        return cls((frame,), located, is_hidden=may_wait and not (isinstance(located, Located) and located.is_shown))

    @property
    def n_needed(self) -> int:
        """Number of frames that show screen, camera and, where each shows little, the clock."""
        if self.is_hidden:
            return SETTINGS.n_for_texture
        if isinstance(self.located, Failure):
            return 1
        is_unsure = self.located.camera_error == np.inf
        if self.located.shows_little and is_unsure:
            return SETTINGS.frames_in_doubt
        return SETTINGS.first_frames if self.located.shows_little or is_unsure else 1

    @property
    def is_complete(self) -> bool:
        """Whether the frames are enough."""
        return len(self.frames) >= self.n_needed

    def is_like(self, frame: Frame) -> bool:
        """Whether a frame is as large as these."""
        pixels = self.frames[0].pixels
        return frame.pixels.shape == pixels.shape and frame.pixels.dtype == pixels.dtype

    def with_frame(self, frame: Frame, camera: ClipCamera) -> Window:
        """These frames and one more, which is searched as long as the camera is unsure."""
        located = self.located
        is_enough = self.is_hidden or self.is_complete
        if isinstance(located, Located) and not is_enough and located.needs_surer_camera:
            located = located.with_surer_camera(camera.locate(FrameCache(frame)))
        return replace(self, frames=(*self.frames, frame), located=located)

    def searched(self, camera: ClipCamera, *, are_all: bool) -> Window:
        """The frames with what the first of them shows, once they are enough to take its texture away."""
        if not self.is_hidden or not (self.is_complete or are_all):
            return self
        return self._without_common_texture(camera) or self._alone(camera)

    def with_clock(self, screens: Sequence[ScreenProfile]) -> Window:
        """The window with the clock on which the frames agree, where each shows too little of it.

        An estimated camera may have seen any of the `screens`.
        """
        located, start = self.located, self.start
        assert isinstance(located, Located)
        if start is None and len(self.frames) > 1:
            if isinstance(located.found, Found) and hides_headers(located.found):
                start = start_by(located.found, self.frames)
            elif located.shows_little and (agreed := common_clock(self.frames, located.context, screens)) is not None:
                start, context = agreed
                located = replace(located, context=context)
        if not (located.is_plain or located.is_long):
            located = replace(located, found=None)  # Of few packets, a second search finds clock and exposure better.
        return replace(self, located=located, start=start)

    def _alone(self, camera: ClipCamera) -> Window:
        """The frames with what the first of them shows by itself."""
        shown = Window(self.frames[:1], self.located)
        for frame in self.frames[1:]:
            shown = shown.with_frame(frame, camera)
        return shown

    def _without_common_texture(self, camera: ClipCamera) -> Window | None:
        """The frames with what they show without the texture that all have in common; None where that is not more."""
        alone = self.located
        if len(self.frames) < 2:
            return None
        texture = CommonTexture(self.frames, DEFAULT_TONE)
        found = self._without_texture(camera, texture)
        is_open = isinstance(alone, Failure) or alone.is_bent or alone.is_long
        if found is not None and (is_open or found.evidence > self.evidence):
            return found.with_ends(texture)
        if isinstance(alone, Located) and isinstance(alone.found, Found) and alone.is_long:
            start = start_by(alone.found, self.frames) if hides_headers(alone.found) else None
            located = self._agreed_with_following(alone, camera, texture)
            return Window(self.frames, located, start=start).with_ends(texture)
        return None

    def _agreed_with_following(self, alone: Located, camera: ClipCamera, texture: CommonTexture) -> Located:
        """The first frame with the outline on which it and some frames after it agree, each searched as it is."""
        knowing, places = replace(camera, context=alone.context), [Place.of(alone)]
        n_searched = SETTINGS.first_frames if camera.options.corners is None else 1
        for frame, shift in zip(self.frames[1:n_searched], texture.shifts[1:], strict=False):
            found = knowing.locate(FrameCache(frame))
            if isinstance(found, Located):
                places.append(Place.of(found, shift))
        corners = np.median([place.corners for place in agreeing(places)], axis=0)
        context = replace(alone.context, sampled_corners=corners)
        return Located(replace(alone.outline, corners=corners), context, None, alone.framing)

    @property
    def evidence(self) -> float:
        """Of the packets in the first of them, or in the one that shows the clock."""
        if self.start is not None:
            return self.start.log_evidence
        return self.located.evidence if isinstance(self.located, Located) else 0.0

    def with_ends(self, texture: CommonTexture) -> Window:
        """The same with the ends of the screen by what blinks in the frames."""
        assert isinstance(self.located, Located)
        ends = dark_ends(self.frames, texture.shifts, self.located.context)
        return replace(self, located=replace(self.located, dark_ends=ends))

    def _without_texture(self, camera: ClipCamera, texture: CommonTexture) -> Window | None:
        """What the first frame shows without its texture: surest camera and median outline of some that agree.

        None where it shows no packets.
        """
        flat = FrameCache(texture.removed_from(0))
        if not shows_same(self.frames[0], flat.frame, DEFAULT_TONE):
            return None
        agreed = self._places_that_agree(camera, texture, flat)
        if not agreed:
            return None
        surest = max(agreed, key=lambda place: place.located.evidence)
        if surest.located is self.located:
            return None
        best, corners = surest.located, surest.corners
        assert isinstance(best.found, Found)
        if camera.options.corners is not None:  # They hold for every frame.
            corners = best.outline.corners
        elif len(agreed) > 2:
            corners = np.median([each.corners for each in agreed], axis=0)
        outline = replace(best.outline, corners=corners, strips=None, grid=None)
        there = replace(camera, context=best.context).locate(flat, [outline], may_bend=False)
        if isinstance(there, Located) and self._was_hidden(there) and Place.of(there).agrees(surest):
            return Window(self.frames, there)
        context = replace(best.context, cache=flat, sampled_corners=outline.corners)
        located = Located(outline, context, None, best.framing)
        return Window(self.frames, located, start=start_by(best.found, self.frames))

    def _places_that_agree(self, camera: ClipCamera, texture: CommonTexture, flat: FrameCache) -> list[Place]:
        """What some frames show without their texture and agree on; `flat` is the first of them so."""
        alone = self.located if isinstance(self.located, Located) and self.located.shows_packets else None
        shown = [Place.of(alone)] if alone is not None and alone.is_long and not alone.is_bent else []
        agreed: list[Place] = []
        for share in SETTINGS.searched_frames:
            number = int(share * len(self.frames)) - int(share == 1)
            cache = FrameCache(texture.removed_from(number)) if number else flat
            found = camera.locate(cache, may_bend=False)
            if isinstance(found, Located) and self._was_hidden(found):
                shown.append(Place.of(found, texture.shifts[number]))
                agreed = agreeing(shown)
            elif alone is not None and not alone.is_long:
                break
            if len(agreed) > 1 and len(shown) > SETTINGS.few_frames:
                break
        return agreed

    def _was_hidden(self, located: Located) -> bool:
        """Whether packets were found that the texture had hidden."""
        return located.shows_packets and (located.is_long or isinstance(self.located, Failure))
