"""Data of the reception of a frame: frame, outline, camera and timer; and failures."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

from rxcli.profiles import ScreenProfile
from rxcli.receiver.camera import CameraHypothesis
from rxcli.receiver.plane import PlaneStore
from rxcli.receiver.screen.strips import Strips
from rxcli.types import FloatArray, Frame, Lens, Outlines

DEFAULT_TONE = "srgb"
#: Certainty from which the number of a column is likely.
_LIKELY = 0.5


@dataclass(frozen=True, slots=True)
class Outline:
    """Location of the screen in the picture."""

    #: (4, 2) pixels of the stored picture, the viewer's top left first.
    corners: FloatArray
    #: Probability that its columns are numbered as the screen's.
    certainty: float = 1.0
    #: Sides of the stored picture that show no light.
    inferred: tuple[str, ...] = ()
    #: Screen number of the first column; None if it is uncertain or columns are counted from the left of the visible
    #: ones.
    column_offset: int | None = 0
    log_odds: float = 0.0
    #: Outlines of one family differ only in the first column.
    family: int = 0
    #: Whether light reaches to both ends of the picture.
    fills: bool = False
    #: Whether its columns are plain; if not, only packets show that it is a screen.
    stands_out: bool = True
    #: Strips of the picture on which it was found; None where it was given.
    strips: Strips | None = field(default=None, repr=False, compare=False)
    #: Estimated lens that bends the columns; used where the camera has no known lens.
    lens: Lens | None = None
    #: Number of narrow columns whose borders were found; None if it was not determined or is small.
    n_columns: int | None = None

    @property
    def is_counted_from_left(self) -> bool:
        """Whether columns are counted from the left because no side of the screen is visible."""
        return self.fills and self.column_offset is None and self.certainty < _LIKELY

    @property
    def result_fields(self) -> dict[str, Any]:
        """Fields of a result, by name."""
        return {
            "corners": self.corners,
            "column_certainty": self.certainty,
            "inferred_sides": self.inferred,
            "column_offset": self.column_offset,
        }


@dataclass(frozen=True, slots=True)
class Failure:
    """End of a reception without packets: status, reason and next step."""

    status: Literal["no_screen", "no_signal"]
    message: str
    #: Estimates of the camera: name -> (value, standard deviation).
    estimated: dict[str, tuple[float, float]] = field(default_factory=dict)
    #: The best outline and camera.
    outline: Outline | None = None
    context: FrameContext | None = None
    #: Every hypothesis that was scored, see `search.Tried`.
    tried: tuple[Any, ...] = ()


class Timer:
    """Wall time by stage; and the plane that was read of the frame meanwhile."""

    def __init__(self) -> None:
        self.timing_ms: dict[str, float] = {}
        self.planes = PlaneStore()
        #: Outlines of columns by place and lens, see `acquisition.outlines_of`.
        self.outlines: dict[tuple[Any, ...], Outlines] = {}
        self._start = time.perf_counter()

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.timing_ms[name] = self.timing_ms.get(name, 0.0) + _ms_since(start)

    def total(self) -> dict[str, float]:
        return {**self.timing_ms, "total": _ms_since(self._start)}


def _ms_since(start: float) -> float:
    return 1e3 * (time.perf_counter() - start)


@dataclass(frozen=True, slots=True)
class Camera:
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


@dataclass(frozen=True, slots=True)
class FrameContext:
    """A frame with the location of its screen and its camera."""

    frame: Frame
    #: (4, 2) image pixels, top-left first, clockwise as a viewer sees the screen.
    corners: FloatArray
    camera: Camera
    #: Candidate screen profiles, at least one.
    screens: tuple[ScreenProfile, ...]
    timer: Timer

    @property
    def n_columns(self) -> int:
        """Columns of the candidate screen with the fewest columns, which is sampled first."""
        return min(screen.columns for screen in self.screens)
