"""What travels together through the reception of a frame: frame, outline, camera and timer; and failures."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from rxcli.profiles import ScreenProfile
from rxcli.receiver.camera import CameraHypothesis
from rxcli.receiver.sampling import RowStore
from rxcli.types import FloatArray, Frame, Lens

DEFAULT_TONE = "srgb"
#: Certainty from which the number of a column is likely.
_LIKELY = 0.5


@dataclass(frozen=True, slots=True)
class Outline:
    """Where the screen is."""

    #: (4, 2) pixels of the stored picture, the viewer's top left first.
    corners: FloatArray
    #: Probability that its columns are numbered as the screen's.
    certainty: float = 1.0
    #: Sides of the stored picture that show no light.
    inferred: tuple[str, ...] = ()
    #: Column of the screen that is the first; None where that is not sure, or columns are counted from the left of what
    #: is seen.
    column_offset: int | None = 0
    log_odds: float = 0.0
    #: Outlines of one family are alike but for the first column.
    family: int = 0
    #: Whether light reaches to both ends of the picture.
    fills: bool = False
    #: Corners that it has with other rows, likeliest first.
    other_rows: tuple[FloatArray, ...] = ()
    #: Columns whose borders were found on it, many of them; None: not asked, or few, of which many may have been taken.
    n_columns: int | None = None

    @property
    def is_counted_from_left(self) -> bool:
        """Whether no side is in view that tells which column is the first."""
        return self.fills and self.column_offset is None and self.certainty < _LIKELY

    @property
    def result_fields(self) -> dict[str, Any]:
        """What a result says of it, by the names of its fields."""
        return {
            "corners": self.corners,
            "column_certainty": self.certainty,
            "inferred_sides": self.inferred,
            "column_offset": self.column_offset,
        }


@dataclass(frozen=True, slots=True)
class Failure:
    """Reception ends here: its status, the reason and the next step."""

    status: Literal["no_screen", "no_signal"]
    message: str
    #: What was estimated of the camera all the same: name -> (value, standard deviation).
    estimated: dict[str, tuple[float, float]] = field(default_factory=dict)
    #: The outline and the camera that came nearest.
    outline: Outline | None = None
    context: FrameContext | None = None
    #: Every hypothesis that was tried, see `search.Tried`.
    tried: tuple[Any, ...] = ()


class Timer:
    """Wall time by stage; and what was read of the frame's pixels meanwhile."""

    def __init__(self) -> None:
        self.timing_ms: dict[str, float] = {}
        self.rows = RowStore()
        self._start = time.perf_counter()

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = 1e3 * (time.perf_counter() - start)
            self.timing_ms[name] = self.timing_ms.get(name, 0.0) + elapsed

    def total(self) -> dict[str, float]:
        return {**self.timing_ms, "total": 1e3 * (time.perf_counter() - self._start)}


@dataclass(frozen=True, slots=True)
class Camera:
    """What is known of the camera that took a frame."""

    #: None for a camera that was estimated from the frame itself.
    profile: str | None
    line_delay_s: float
    exposure_s: float
    lens: Lens | None
    tone: str
    #: True where the stored rows run against the readout.
    reversed: bool = False
    #: What was estimated: name -> (value, standard deviation).
    estimated: dict[str, tuple[float, float]] = field(default_factory=dict)
    #: What it was estimated to be, until its slots were fitted; None for a known camera.
    hypothesis: CameraHypothesis | None = None

    @property
    def result_fields(self) -> dict[str, Any]:
        """What a result says of it, by the names of its fields."""
        return {
            "camera_profile": self.profile,
            "line_delay_s": self.line_delay_s,
            "exposure_s": self.exposure_s,
            "estimated": self.estimated,
        }

    def without_tone_estimate(self) -> Camera:
        """The camera without its estimated tone curve."""
        estimated = {name: value for name, value in self.estimated.items() if name != "tone_exponent"}
        return replace(self, estimated=estimated)


@dataclass(frozen=True, slots=True)
class FrameContext:
    """A frame of which it is known where the screen is and which camera took it."""

    frame: Frame
    #: (4, 2) image pixels, top-left first, clockwise as a viewer sees the screen.
    corners: FloatArray
    camera: Camera
    #: Screens that it may be, at least one.
    screens: tuple[ScreenProfile, ...]
    timer: Timer

    @property
    def n_columns(self) -> int:
        """Columns of the coarsest screen that it may be: those that are read first."""
        return min(screen.columns for screen in self.screens)
