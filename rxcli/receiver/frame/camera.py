"""The camera of a frame: from its profile, or from an estimate."""

from dataclasses import dataclass, field
from typing import Any

from rxcli.receiver.camera.proposals import CameraHypothesis
from rxcli.types import Lens


@dataclass(frozen=True, slots=True)
class FrameCamera:
    """Camera parameters of a frame."""

    #: Name of the profile; None for a camera that was estimated from the frame.
    profile: str | None
    line_delay_s: float
    exposure_s: float
    lens: Lens | None
    tone: str
    #: True where the stored rows run against the readout.
    reversed: bool = False
    #: Estimated parameters: name -> (value, standard deviation).
    estimated: dict[str, tuple[float, float]] = field(default_factory=dict)
    #: The estimate before decided slots were fitted; None for a known camera.
    hypothesis: CameraHypothesis | None = None

    @property
    def result_fields(self) -> dict[str, Any]:
        """Fields of a result, by name."""
        return {
            "camera_profile": self.profile,
            "line_delay_s": self.line_delay_s,
            "exposure_s": self.exposure_s,
            "estimated": self.estimated,
        }
