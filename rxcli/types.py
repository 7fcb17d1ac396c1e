"""The frozen dataclasses that pass between stages.

Two conventions hold everywhere. Integer pixel coordinates are pixel centres, x to the right and y downwards in the
stored picture, which is never rotated. The time of a sensor row is the start of its exposure: row `r` integrates from
`start_time_s + r * line_delay_s` for `exposure_s`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Metadata:
    """What a file says of its picture; None where it is silent."""

    make: str | None = None
    model: str | None = None
    lens: str | None = None
    exposure_s: float | None = None
    iso: float | None = None
    focal_length_mm: float | None = None
    focal_length_35mm: float | None = None
    #: EXIF orientation, 1..8; 1 where the file has none.
    orientation: int = 1


@dataclass(frozen=True, slots=True)
class Mosaic:
    """Colour filter array and levels of a RAW frame."""

    #: (h, w) uint8: colour (0 red, 1 green, 2 blue) of pixel (y % h, x % w), anchored at the frame's first pixel.
    pattern: NDArray[np.uint8]
    #: Gains of red, green, blue that make a grey surface grey; green is 1.
    gains: tuple[float, float, float]
    #: Level of no light, per colour (red, green, blue), in raw units.
    black: tuple[float, float, float]
    #: Level at which the sensor saturates, in raw units.
    white: float


@dataclass(frozen=True, slots=True)
class Frame:
    """One camera picture as stored: luma, or the sensor's mosaic."""

    #: (height, width) uint8 or uint16, rows in readout order as the file stores them.
    pixels: NDArray[np.uint8] | NDArray[np.uint16]
    #: Path or device.
    source: str
    #: Number of this frame in its source, from 0.
    index: int = 0
    #: Presentation time in the source, seconds.
    time_s: float = 0.0
    metadata: Metadata = field(default_factory=Metadata)
    #: Levels of black and white in `pixels` (16 and 235 for limited-range video); a mosaic has its own.
    black: float = 0.0
    white: float = 255.0
    #: None for a developed picture, whose values then follow a tone curve.
    mosaic: Mosaic | None = None
    #: True where developed values are proportional to light (linear TIFF).
    linear: bool = False

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.pixels.shape[0])

    @property
    def width(self) -> int:
        """Columns of pixels."""
        return int(self.pixels.shape[1])


FrameStatus = Literal["ok", "partial", "no_screen", "no_signal", "unreadable"]
ColumnStatus = Literal["ok", "weak", "dark", "no_packet"]


@dataclass(frozen=True, slots=True)
class PacketResult:
    """One packet of one column."""

    #: Sensor row, at the column's centre, where the header of the first visible copy starts; may be negative.
    first_row: float
    #: Visible slots over slots of a packet.
    copies: float
    payload_bits: int
    #: Hex, first bit most significant, zero-padded to whole bytes.
    payload: str
    #: Estimated probability that every bit is right.
    confidence: float
    #: Expected share of wrong bits.
    ber_hat: float
    #: Wrong bits against the truth, None where no truth is known.
    bit_errors: int | None = None
    #: Burst counter over the clip; None for stills.
    burst: int | None = None
    #: Frames of the clip in which the burst was seen; None for stills.
    frames: tuple[int, ...] | None = None


@dataclass(frozen=True, slots=True)
class ColumnResult:
    """What became of one column."""

    column: int
    status: ColumnStatus
    w: int | None = None
    snr_db: float | None = None
    denoised: bool = False
    #: Delay against the common clock.
    delay_slots: float | None = None
    packets: tuple[PacketResult, ...] = ()
    #: Reason and next step where nothing was decoded.
    message: str | None = None


@dataclass(frozen=True, slots=True)
class FrameResult:
    """What became of one frame; `rxcli.report` turns it into JSON and tables."""

    source: str
    frame: int
    time_s: float
    status: FrameStatus
    #: Reason and next step of a failure.
    message: str | None = None
    screen_profile: str | None = None
    #: (4, 2) image pixels, top-left first, clockwise as a viewer sees the screen.
    corners: FloatArray | None = None
    camera_profile: str | None = None
    line_delay_s: float | None = None
    exposure_s: float | None = None
    #: What was estimated blindly of the camera: name -> (value, standard deviation).
    estimated: dict[str, tuple[float, float]] = field(default_factory=dict)
    columns: tuple[ColumnResult, ...] = ()
    #: Wall time by stage, milliseconds.
    timing_ms: dict[str, float] = field(default_factory=dict)
    #: What was skipped: name -> count.
    skipped: dict[str, int] = field(default_factory=dict)
    #: What the auto-encoder did, None where it did not run.
    denoiser: dict[str, Any] | None = None
