"""Where and how the light of a frame is read: outline, camera and screens."""

from dataclasses import dataclass
from typing import Any

from rxcli.profiles import ScreenProfile
from rxcli.receiver.camera.camera import in_time_order
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.camera import FrameCamera
from rxcli.receiver.frame.timer import Timer
from rxcli.types import FloatArray, Frame, Outlines, RowProfiles


@dataclass(frozen=True, slots=True)
class FrameContext:
    """A frame with its camera and the place where its light is read."""

    cache: FrameCache
    #: (4, 2) stored pixels between which the light is read, the viewer's top left first; see `Outline.corners`.
    sampled_corners: FloatArray
    camera: FrameCamera
    #: Candidate screen profiles, at least one.
    screens: tuple[ScreenProfile, ...]

    @property
    def frame(self) -> Frame:
        """The picture."""
        return self.cache.frame

    @property
    def timer(self) -> Timer:
        """Counts the time of each stage."""
        return self.cache.timer

    @property
    def result_fields(self) -> dict[str, Any]:
        """Fields of a result, by name."""
        fields, red = self.camera.result_fields, self.frame.red_contrast
        return fields if red is None else {**fields, "estimated": {**fields["estimated"], "red_contrast": red}}

    def outlines(self, n_columns: int) -> Outlines:
        """Outlines of the strips of a screen of `n_columns` columns."""
        return self.cache.outlines(self.sampled_corners, n_columns, self.camera.lens)

    def sample_columns(self, n_columns: int) -> RowProfiles:
        """Sample the row profiles of a screen of `n_columns` columns in order of time."""
        with self.timer("sampling"):
            profiles = self.cache.sample(self.outlines(n_columns), self.camera.tone)
            return in_time_order(profiles, self.frame.height) if self.camera.reversed else profiles
