"""Where the screen is in the first frame of a clip, by more frames than that one.

The strips of a whole clip lie where its first frame has the screen, and a single dark frame may be wrong by twenty
pixels there. The texture of the picture says how the screen moved from the first frame to the next ones; what the
search finds in these is carried back, and the median of a few counts. Where the second agrees, two are enough.
"""

from __future__ import annotations

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.context import FrameContext, Timer
from rxcli.receiver.screen.registration import ScreenTexture
from rxcli.receiver.search import search
from rxcli.types import FloatArray, Frame


class FirstOutline:
    """The outline in the first frame.

    Args:
        frame: the first.
        corners: (4, 2) of the screen as found there.
        options: where they name the corners, there is nothing to find.
        known: that frame with its camera, where it is known already.
    """

    def __init__(
        self, frame: Frame, corners: FloatArray, options: ReceiverOptions, known: FrameContext | None = None
    ) -> None:
        self._options, self._known = options, known
        self._first = corners
        self._width = float(np.linalg.norm(corners[1] - corners[0]))
        self._differences = [np.zeros_like(corners)]
        self._texture = None if options.corners is not None else ScreenTexture(frame, corners, None)

    @property
    def settled(self) -> bool:
        """Whether no further frame is asked."""
        if self._texture is None or len(self._differences) >= SETTINGS.max_searches:
            return True
        return len(self._differences) == 2 and bool(
            np.abs(self._differences[1]).max() < SETTINGS.outlines_agree * self._width
        )

    @property
    def corners(self) -> FloatArray:
        """(4, 2) in the first frame, by all frames so far."""
        return self._first + np.median(self._differences, axis=0)

    def take(self, frame: Frame) -> None:
        """Search the next frame, too."""
        if self.settled or self._texture is None:
            return
        moved = self._texture.find(frame)
        if not moved.tells:
            moved = self._texture.with_outline(moved, self._first)
        found = search(frame, self._options, Timer(), self._known)
        outline = found.outline
        if outline is None or not moved.fits or self._is_far(outline.corners - moved.corners):
            # Nothing to compare with: what was found so far must do.
            self._texture = None
            return
        self._texture.learn(frame, moved)
        self._differences.append(outline.corners - moved.corners)

    def _is_far(self, difference: FloatArray) -> bool:
        return bool(np.abs(difference).max() > self._width / 2)
