"""Times of frames that advance: by the nominal rate where a source gives none, or equal or earlier ones."""

from dataclasses import dataclass

#: A time that is earlier by more frames than are ever out of order begins another clip, joined to the one before.
_JOINT_FRAMES = 8


@dataclass(slots=True)
class FrameTimes:
    """Times of the frames of a source, in order of presentation."""

    #: Of the last frame, and its own one; None before any.
    last_s: float | None = None
    _own_s: float | None = None
    #: What is added to the times of a clip that was joined.
    _later_s: float = 0.0

    def next(self, own_s: float | None, step_s: float) -> tuple[float, bool]:
        """Time of the next frame, and whether it is by the nominal rate.

        Args:
            own_s: the frame's own time, None where it has none.
            step_s: nominal time since the last frame.
        """
        expected_s = None if self.last_s is None else self.last_s + step_s
        if own_s is not None:
            if expected_s is not None and self._own_s is not None and own_s < self._own_s - _JOINT_FRAMES * step_s:
                self._later_s = expected_s - own_s
            self._own_s, own_s = own_s, own_s + self._later_s
        nominal = self.last_s is not None and (own_s is None or own_s <= self.last_s)
        self.last_s = expected_s if expected_s is not None and nominal else (own_s or 0.0)
        return self.last_s, nominal
