"""The first frames of a clip: they agree on where the screen is, and the surest of their cameras counts.

The strips of a whole clip lie where its first frame has the screen, and the outline of a single frame may be wrong by
many pixels. The texture of the picture gives the motion of the screen from the first frame to the next ones. The
outlines found in these are carried back, and their median is used. Where the first frame shows plain packets, the next
ones are not searched: the outline is followed. Where it shows none, or those of a long exposure, it is searched without
its texture as well, which is what it has in common with the frames after it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rxcli.receiver.clip.camera import ClipCamera, Located
from rxcli.receiver.clip.common_clock import Start, shows_little, start_by
from rxcli.receiver.clip.scene import followed_outline
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.result import Failure
from rxcli.receiver.plane import CommonTexture, shows_same
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.screen.registration import ScreenTexture
from rxcli.receiver.search import Found
from rxcli.receiver.search.cameras import DEFAULT_TONE
from rxcli.types import FloatArray, Frame


@dataclass(frozen=True, slots=True, eq=False)
class HiddenFrames:
    """The first frames, as long as the texture of the picture may hide the slots in them."""

    frames: tuple[Frame, ...]
    #: What the first of them shows by itself.
    alone: Located | Failure
    #: Whether more frames are worth waiting for.
    may_wait: bool = True

    @classmethod
    def begin(cls, frame: Frame, camera: ClipCamera, *, may_wait: bool) -> HiddenFrames:
        """Search the first frame."""
        return cls((frame,), camera.locate(FrameCache(frame)), may_wait)

    @property
    def are_enough(self) -> bool:
        """Whether no further frame is needed."""
        if not self.may_wait or len(self.frames) >= SETTINGS.n_for_texture:
            return True
        alone = self.alone
        if not isinstance(alone, Located):
            return False
        is_known = alone.context.camera.hypothesis is None
        return alone.is_plain or (is_known and (not alone.is_open or shows_little(alone.context)))

    def with_frame(self, frame: Frame, camera: ClipCamera) -> HiddenFrames:
        """These frames and one more."""
        return replace(self, frames=(*self.frames, frame))

    def shown(self, camera: ClipCamera) -> FirstFrames | Failure:
        """The frames with what the first of them shows, by itself or without what all of them have in common."""
        alone, found = self.alone, self._without_texture(camera) if len(self.frames) > 1 else None
        if found is not None and (
            isinstance(alone, Failure) or alone.is_bent or alone.is_long or found.evidence > alone.evidence
        ):
            return found
        if isinstance(alone, Failure):
            return alone
        frames = FirstFrames.begin(self.frames[0], camera, alone)
        for frame in self.frames[1:]:
            further = replace(frames, frames=(*frames.frames, frame))
            frames = further if frames.are_enough else frames.with_frame(frame, camera)
        return frames

    def _without_texture(self, camera: ClipCamera) -> FirstFrames | None:
        """What the first frame shows without its texture: surest camera and median outline of some that agree.

        None where it shows no packets.
        """
        texture = CommonTexture(self.frames, DEFAULT_TONE)
        flat = FrameCache(texture.removed_from(0))
        if not shows_same(self.frames[0], flat.frame, DEFAULT_TONE):
            return None
        agreed = self._places_that_agree(camera, texture, flat)
        if not agreed:
            return None
        surest = max(agreed, key=lambda place: place.located.evidence)
        if surest.located is self.alone:
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
            return FirstFrames(self.frames, there)
        context = replace(best.context, cache=flat, sampled_corners=outline.corners)
        located = Located(outline, context, None, best.framing)
        return FirstFrames(self.frames, located, start=start_by(best.found, self.frames))

    def _places_that_agree(self, camera: ClipCamera, texture: CommonTexture, flat: FrameCache) -> list[Place]:
        """What some frames show without their texture and agree on; `flat` is the first of them so."""
        alone = self.alone if isinstance(self.alone, Located) and self.alone.shows_packets else None
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
        return located.shows_packets and (located.is_long or isinstance(self.alone, Failure))


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
class FirstFrames:
    """The first frames that show screen and camera."""

    frames: tuple[Frame, ...]
    #: Where the screen is in the first of them, with the surest of their cameras.
    located: Located
    #: Of the screen; None where there is nothing to compare an outline with, or the user gave the corners.
    texture: ScreenTexture | None = None
    #: Corners (4, 2) that were found in each frame, carried back to the first, less those found there.
    differences: tuple[FloatArray, ...] = ()
    #: The clock that another of them shows, where the first does not.
    start: Start | None = None

    @classmethod
    def begin(cls, frame: Frame, camera: ClipCamera, located: Located) -> FirstFrames:
        """The first frame, and where the screen is in it."""
        corners = located.context.sampled_corners
        texture = None if camera.options.corners is not None else ScreenTexture(frame, corners, None)
        return cls((frame,), located, texture, (np.zeros_like(corners),))

    @property
    def evidence(self) -> float:
        """Of the packets in the first of them, or in the one that shows the clock."""
        return self.located.evidence if self.start is None else self.start.log_evidence

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
        if not self.differences:
            return self.located
        return self.located.moved_to(self.located.context.sampled_corners + np.median(self.differences, axis=0))

    def with_frame(self, frame: Frame, camera: ClipCamera) -> FirstFrames:
        """These frames and one more; it is searched for its outline and its camera as far as they are unsure."""
        longer, located, found = replace(self, frames=(*self.frames, frame)), self.located, None
        unsure = located.camera_error == np.inf or (located.camera_error > 0 and self.shows_little)
        if unsure or not (self._agree or located.is_plain):
            found = (camera if unsure else replace(camera, context=located.context)).locate(FrameCache(frame))
            longer = replace(longer, located=located.with_surer_camera(found) if unsure else located)
        if self._agree:
            return longer
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
