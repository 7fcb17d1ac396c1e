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


@dataclass(frozen=True, slots=True)
class Failure:
    """Reception ends here: its status, the reason and the next step."""

    status: Literal["no_screen", "no_signal"]
    message: str
    #: What was estimated of the camera all the same: name -> (value, standard deviation).
    estimated: dict[str, tuple[float, float]] = field(default_factory=dict)


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
    def facts(self) -> dict[str, Any]:
        """What a result says of it, by the names of its fields."""
        return {
            "camera_profile": self.profile,
            "line_delay_s": self.line_delay_s,
            "exposure_s": self.exposure_s,
            "estimated": self.estimated,
        }

    def without_tone(self) -> Camera:
        """The camera, its tone curve not told."""
        denoised = {name: found for name, found in self.estimated.items() if name != "tone_exponent"}
        return replace(self, estimated=denoised)


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
    #: What was worked out of it already, see `screen_choice.quick_look`; another context begins anew.
    kept: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def n_columns(self) -> int:
        """Columns of the coarsest screen that it may be: those that are read first."""
        return min(screen.columns for screen in self.screens)
