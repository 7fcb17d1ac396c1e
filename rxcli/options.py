"""What the user asks of the receiver."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from rxcli.profiles import CameraProfile, ScreenProfile
from rxcli.types import FloatArray

CaeMode = Literal["auto", "always", "never"]
#: Names of the shortcuts that `ReceiverOptions.skip` may hold; every one is counted in the report.
SKIPS = ("no_screen", "dark_columns", "certain_columns", "tracking")


@dataclass(frozen=True, slots=True)
class ReceiverOptions:
    """What the user asks of the receiver; picklable, so that worker processes can have it."""

    #: Screens to try; the one whose clock fits best is taken.
    screens: tuple[ScreenProfile, ...]
    #: Cameras to choose from by make, model and size; empty: estimate everything blindly.
    cameras: tuple[CameraProfile, ...] = ()
    #: Take `cameras[0]` whatever the file says of itself.
    force_camera: bool = False
    #: (4, 2) image pixels, top-left first, clockwise as a viewer sees the screen; None: find them.
    corners: FloatArray | None = None
    cae: CaeMode = "auto"
    #: Packets below this confidence are not reported.
    min_confidence: float = 0.0
    #: Shortcuts in use.
    skip: frozenset[str] = field(default_factory=lambda: frozenset(SKIPS))
    #: Pass over frames of a clip all of whose bursts are certain already.
    stop_when_certain: bool = False
    #: Folder for the arrays of every stage boundary; None: none are written.
    dump_dir: Path | None = None
