"""The window of a clip: first frames that show where the screen is, its camera and, where each shows little, the clock.

The strips of a whole clip lie where its first frame has the screen. Where that frame shows no packets, or those of a
long exposure, it is searched without its texture as well, which is what it has in common with the frames after it: the
outlines that some of them show so are carried back by the motion of the texture, and their median is used. Of their
cameras the surest counts.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice, takewhile

import numpy as np

from rxcli.receiver.clip.camera import ClipCamera, Located
from rxcli.receiver.clip.common_clock import common_clock, hides_headers, start_by
from rxcli.receiver.clip.ends import dark_ends
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.result import Failure
from rxcli.receiver.plane.texture import CommonTexture, shows_same
from rxcli.receiver.search import Found
from rxcli.receiver.search.cameras import DEFAULT_TONE
from rxcli.types import FloatArray, Frame


class Source:
    """The frames of a clip, read ahead as far as somebody asks for."""

    def __init__(self, frames: Iterable[Frame]) -> None:
        self._frames, self._ahead = iter(frames), deque[Frame]()
        #: Of the frames, raised once those before it were received.
        self.error: Exception | None = None

    def ahead(self, n: int) -> list[Frame]:
        """The next frames: `n`, or fewer where the clip ends or frames of another size follow."""
        try:
            self._ahead.extend(islice(self._frames, max(n - len(self._ahead), 0)))
        except Exception as error:
            self.error = error
        return list(takewhile(self._is_like_next, islice(self._ahead, n)))

    def pop(self) -> Frame:
        """The next frame."""
        return self._ahead.popleft()

    def _is_like_next(self, frame: Frame) -> bool:
        pixels = self._ahead[0].pixels
        return frame.pixels.shape == pixels.shape and frame.pixels.dtype == pixels.dtype


def first_place(source: Source, camera: ClipCamera, *, may_wait: bool) -> tuple[Located | Failure, int]:
    """Search the next frame, with the surest camera and the common clock of as many frames as it takes.

    Args:
        source: of the frames.
        camera: what is known of it.
        may_wait: whether frames that show nothing alone may be searched together.

    Returns:
        What the next frame shows, and how many frames were looked at.
    """
    frames, n_searched = source.ahead(1), 1
    located = camera.locate(FrameCache(frames[0]))
    if may_wait and not (isinstance(located, Located) and located.is_clear):
        frames = source.ahead(SETTINGS.n_for_texture)
        if len(frames) > 1:
            together = _FirstFrames(camera, located, frames, CommonTexture(frames, DEFAULT_TONE))
            if (found := together.without_texture) is not None:
                located, n_searched = found, len(frames)
    while isinstance(located, Located) and n_searched < _n_needed(located):
        frames = source.ahead(max(len(frames), n_searched + 1))
        if n_searched == len(frames):
            break
        if located.needs_surer_camera:
            located = located.with_surer_camera(camera.locate(FrameCache(frames[n_searched])))
        n_searched += 1
    return located if isinstance(located, Failure) else _with_clock(located, frames, camera), len(frames)


def _n_needed(located: Located) -> int:
    """Number of frames that show screen, camera and, where each shows little, the clock."""
    is_unsure = located.camera_error == np.inf
    if located.shows_little and is_unsure:
        return SETTINGS.frames_in_doubt
    return SETTINGS.first_frames if located.shows_little or is_unsure else 1


def _with_clock(located: Located, frames: Sequence[Frame], camera: ClipCamera) -> Located:
    """The first frame with the clock on which the frames agree, where each shows too little of it."""
    is_enough = located.is_plain or located.is_long
    if located.start is None and len(frames) > 1:
        if isinstance(located.found, Found) and hides_headers(located.found):
            located = replace(located, start=start_by(located.found, frames))
        # An estimated camera may have seen any of the screens.
        elif located.shows_little and (agreed := common_clock(frames, located.context, camera.options.screens)):
            start, context = agreed
            located = replace(located, start=start, context=context)
    # Of few packets, a second search finds clock and exposure better.
    return located if is_enough else replace(located, found=None)


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
class _FirstFrames:
    """First frames, the texture that they have in common, and what the first of them shows alone."""

    camera: ClipCamera
    alone: Located | Failure
    frames: Sequence[Frame]
    texture: CommonTexture

    @property
    def without_texture(self) -> Located | None:
        """What the first frame shows without the texture; None where that is no more than it shows alone."""
        alone, found = self.alone, self._agreed_without_texture()
        if isinstance(alone, Located):
            if found is None and isinstance(alone.found, Found) and alone.is_long:
                found = self._agreed_with_following(alone, alone.found)
            elif found is not None and not (alone.is_bent or alone.is_long) and found.evidence <= alone.evidence:
                found = None
        if found is None:
            return None
        return replace(found, dark_ends=dark_ends(self.frames, self.texture.shifts, found.context))

    def _agreed_with_following(self, alone: Located, found: Found) -> Located:
        """The first frame with the outline on which it and some frames after it agree, each searched as it is."""
        knowing, places = replace(self.camera, context=alone.context), [Place.of(alone)]
        n_searched = SETTINGS.first_frames if self.camera.options.corners is None else 1
        for frame, shift in zip(self.frames[1:n_searched], self.texture.shifts[1:], strict=False):
            located = knowing.locate(FrameCache(frame))
            if isinstance(located, Located):
                places.append(Place.of(located, shift))
        corners = np.median([place.corners for place in agreeing(places)], axis=0)
        context = replace(alone.context, sampled_corners=corners)
        start = start_by(found, self.frames) if hides_headers(found) else None
        return Located(replace(alone.outline, corners=corners), context, None, alone.framing, start=start)

    def _agreed_without_texture(self) -> Located | None:
        """The first frame without its texture: surest camera and median outline of some frames that agree.

        None where it shows no packets.
        """
        flat, camera = FrameCache(self.texture.removed_from(0)), self.camera
        if not shows_same(self.frames[0], flat.frame, DEFAULT_TONE):
            return None
        agreed = self._places_that_agree(flat)
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
        if isinstance(there, Located) and self._is_new(there) and Place.of(there).agrees(surest):
            return there
        context = replace(best.context, cache=flat, sampled_corners=outline.corners)
        return Located(outline, context, None, best.framing, start=start_by(best.found, self.frames))

    def _places_that_agree(self, flat: FrameCache) -> list[Place]:
        """What some frames show without their texture and agree on; `flat` is the first of them so."""
        alone = self.alone if isinstance(self.alone, Located) and self.alone.shows_packets else None
        shown = [Place.of(alone)] if alone is not None and alone.is_long and not alone.is_bent else []
        agreed: list[Place] = []
        for share in SETTINGS.searched_frames:
            number = int(share * len(self.frames)) - int(share == 1)
            cache = FrameCache(self.texture.removed_from(number)) if number else flat
            found = self.camera.locate(cache, may_bend=False)
            if isinstance(found, Located) and self._is_new(found):
                shown.append(Place.of(found, self.texture.shifts[number]))
                agreed = agreeing(shown)
            elif alone is not None and not alone.is_long:
                break
            if len(agreed) > 1 and len(shown) > SETTINGS.few_frames:
                break
        return agreed

    def _is_new(self, located: Located) -> bool:
        """Whether packets were found that the first frame does not show alone."""
        return located.shows_packets and (located.is_long or isinstance(self.alone, Failure))
