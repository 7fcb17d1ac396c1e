"""The first frames of a clip: they agree on where the screen is, and the surest of their cameras counts.

The strips of a whole clip lie where its first frame has the screen, and the outline of a single frame may be wrong by
many pixels. The texture of the picture gives the motion of the screen from the first frame to the next ones. The
outlines found in these are carried back, and their median is used. Where the first frame shows plain packets, the next
ones are not searched: the outline is followed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rxcli.receiver.clip.camera import ClipCamera, Located
from rxcli.receiver.clip.common_clock import shows_little
from rxcli.receiver.clip.scene import followed_outline
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.result import Failure
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.screen.registration import ScreenTexture
from rxcli.receiver.search import screen_in_changes
from rxcli.types import FloatArray, Frame


@dataclass(frozen=True, slots=True, eq=False)
class FirstFrames:
    """The first frames that show screen and camera."""

    frames: tuple[Frame, ...]
    #: Where the screen is in the first of them, with the surest of their cameras.
    located: Located
    #: Of the screen; None where there is nothing to compare an outline with, or the user gave the corners.
    texture: ScreenTexture | None
    #: Corners (4, 2) that were found in each frame, carried back to the first, less those found there.
    differences: tuple[FloatArray, ...]
    #: Whether the screen was found in what changed from the first to the second.
    is_in_changes: bool = False

    @classmethod
    def begin(cls, frame: Frame, camera: ClipCamera) -> FirstFrames | Failure:
        """Search the first frame."""
        located = camera.locate(FrameCache(frame))
        return located if isinstance(located, Failure) else cls._at(frame, camera, located)

    @classmethod
    def in_changes(cls, frame: Frame, following: Frame, camera: ClipCamera) -> FirstFrames | None:
        """Search the first frame by what changed from it to the next; None where that shows no screen."""
        cache = FrameCache(frame)
        outlines = screen_in_changes(cache, following, camera.options)
        located = camera.locate(cache, outlines) if outlines else None
        if not isinstance(located, Located):
            return None
        return replace(cls._at(frame, camera, located), is_in_changes=True)

    @classmethod
    def _at(cls, frame: Frame, camera: ClipCamera, located: Located) -> FirstFrames:
        corners = located.context.sampled_corners
        texture = None if camera.options.corners is not None else ScreenTexture(frame, corners, None)
        return cls((frame,), located, texture, (np.zeros_like(corners),))

    @property
    def shows_little(self) -> bool:
        """Whether each shows too few packets to find its clock alone, or leaves their length open."""
        return shows_little(self.located.context) or self.located.framing < SETTINGS.sure_framing

    @property
    def are_enough(self) -> bool:
        """Whether no further frame is needed: the outline and, where each shows little, camera and clock are sure."""
        is_unsure = self.located.camera_error == np.inf
        n_needed = SETTINGS.first_frames if self.shows_little or is_unsure else 1
        if self.shows_little and is_unsure:
            n_needed = SETTINGS.frames_in_doubt
        return self._agree and len(self.frames) >= n_needed

    @property
    def _agree(self) -> bool:
        """Whether no further outline is needed."""
        return self.texture is None or len(self.differences) >= SETTINGS.n_outlines

    def agreed(self) -> Located:
        """The first frame with the outline on which all of them agree."""
        return self.located.moved_to(self.located.context.sampled_corners + np.median(self.differences, axis=0))

    def with_frame(self, frame: Frame, camera: ClipCamera) -> FirstFrames:
        """These frames and one more; it is searched for its outline and its camera as far as they are unsure."""
        is_first = len(self.frames) == 1
        if is_first and self.texture is not None and not (self.is_in_changes or self.located.is_plain):
            by_changes = FirstFrames.in_changes(self.frames[0], frame, camera)
            if by_changes is not None and (self.located.is_open or by_changes.located.evidence > self.located.evidence):
                return by_changes.with_frame(frame, camera)
        outlines = [self.located.outline] if self.is_in_changes else None
        longer, located, found = replace(self, frames=(*self.frames, frame)), self.located, None
        unsure = located.camera_error == np.inf or (located.camera_error > 0 and self.shows_little)
        if unsure or not (self._agree or located.is_plain):
            found = (camera if unsure else replace(camera, context=located.context)).locate(FrameCache(frame), outlines)
            longer = replace(longer, located=located.with_surer_camera(found) if unsure else located)
        if self._agree or (self.is_in_changes and is_first):
            return longer
        if self.is_in_changes:
            changes = screen_in_changes(FrameCache(self.frames[-1]), frame, camera.options)
            return longer._compared(self.frames[-1], changes[0] if changes else None)
        return longer._compared(frame, None if found is None else found.outline, is_followed=found is None)

    def _compared(self, frame: Frame, outline: Outline | None, *, is_followed: bool = False) -> FirstFrames:
        """The same with the outline of a further frame, less its motion since the first; or one that is followed."""
        assert self.texture is not None
        context = self.located.context
        moved = self.texture.find(frame)
        if not moved.is_precise:
            moved = replace(moved, corners=context.sampled_corners)
        corners = None if outline is None else outline.corners
        if is_followed:
            corners = followed_outline(frame, moved.corners + self.differences[-1], context.screens[0])
        reach = float(np.ptp(context.sampled_corners[:, 0])) / 2
        if corners is None or not moved.fits or np.abs(corners - moved.corners).max() > reach:
            return replace(self, texture=None)
        self.texture.learn(frame, moved)
        return replace(self, differences=(*self.differences, corners - moved.corners))
