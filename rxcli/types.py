"""The frozen dataclasses that pass between stages.

Two conventions hold everywhere. Integer pixel coordinates are pixel centres, x to the right and y downwards in the
stored picture, which is never rotated. The time of a sensor row is the start of its exposure: row `r` integrates from
`start_time_s + r * line_delay_s` for `exposure_s`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

#: EXIF orientations that mirror the picture.
_MIRRORED = (2, 4, 5, 7)
_FRONT = re.compile(r"\b(front|facetime|selfie)\b", re.IGNORECASE)
FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


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
    #: What the file says and no camera does, in words; it is None above.
    not_believed: tuple[str, ...] = ()

    @property
    def names_front_camera(self) -> bool:
        """Whether the file comes from a front camera, whose pictures are often mirrored."""
        return self.orientation in _MIRRORED or bool(_FRONT.search(f"{self.model} {self.lens}"))


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
    #: True where the source's own times do not advance, so that `time_s` is by its nominal frame rate.
    nominal_time: bool = False

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.pixels.shape[0])

    @property
    def width(self) -> int:
        """Columns of pixels."""
        return int(self.pixels.shape[1])


@dataclass(frozen=True, slots=True)
class LightPlane:
    """What is read of a frame, every pixel once: running sums along its rows at the borders of cells of some pixels."""

    #: (N + 1, R) float32: sum of the values left of each border, on every row; a mosaic's are linear light already.
    sums: Float32Array
    #: Width of a cell, pixels; N cells across the picture, a last part of a cell left out.
    cell_px: int
    #: Pixels of a row.
    width: int
    #: Values of black and white.
    black: float
    white: float
    #: Whether values are proportional to light.
    is_linear: bool

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.sums.shape[1])


@dataclass(frozen=True, slots=True)
class Lens:
    """OpenCV's lens model of one picture, in its own pixels."""

    #: (3, 3) float64.
    camera_matrix: FloatArray
    #: (n,) float64: k1 k2 p1 p2 k3, then as OpenCV orders them.
    dist_coeffs: FloatArray
    #: True where the picture was already corrected: straight lines are straight, stripes are bent.
    corrected: bool


@dataclass(frozen=True, slots=True)
class Outlines:
    """Where each strip of each column lies on the picture, row by row. C columns of S strips, R picture rows."""

    #: (R,) int: picture rows that the screen touches, adjacent and ascending.
    rows: NDArray[np.int64]
    #: (C*S + 1, R) float32: x of the strips' edges, pixels; column 0 is the viewer's leftmost.
    edges_x: Float32Array
    #: (C, S, R) bool: the strip's middle is on the screen and in the picture.
    inside: BoolArray
    #: (C, S, R) float64: sensor row at the strip's middle; None where it is the picture row itself.
    sensor_row: FloatArray | None


@dataclass(frozen=True, slots=True)
class RowProfiles:
    """Linear light of every strip on every row: all that the later stages see of the picture."""

    #: (C, S, R) float32: mean light, 1 is white; 0 outside the screen.
    light: Float32Array
    #: (C, S, R) bool: the strip is on the screen there.
    inside: BoolArray
    #: (R,) int: picture rows.
    rows: NDArray[np.int64]
    #: (C, S, R) float64: sensor rows, None where they are `rows`.
    sensor_row: FloatArray | None
    #: (C, S) float32: pixels behind each mean, median over the rows.
    count: Float32Array
    #: A pixel of light x has variance noise_floor + noise_slope * x.
    noise_floor: float
    noise_slope: float

    def variance(self) -> Float32Array:
        """(C, S, R) variance of `light` by the noise model."""
        pixel = self.noise_floor + self.noise_slope * np.maximum(self.light, 0)
        return np.asarray(pixel / np.maximum(self.count, 1.0)[:, :, None], np.float32)


@dataclass(frozen=True, slots=True)
class Clock:
    """The link's time on the sensor. Grid slot `n` of column `c` is position `(n + first_slot) % packet_slots` of copy
    `(n + first_slot) // packet_slots`; a copy is one sending of a packet."""

    rows_per_slot: float
    #: Exposure in slots.
    exposure_slots: float
    packet_slots: int
    #: Sensor row whose exposure's centre is the start of grid slot 0 of a column without delay.
    row0: float
    #: Slots of the grid.
    n_slots: int
    #: Position of grid slot 0 in its packet; grid slot 0 belongs to copy 0.
    first_slot: int
    #: (n_copies,) int: burst of each copy, from 0 in time order.
    burst: NDArray[np.int64]
    #: (C,) float64: delay of each column, slots.
    delay_slots: FloatArray
    #: Height of the header peak over the strongest one elsewhere.
    header_peak_ratio: float

    @property
    def n_copies(self) -> int:
        """Copies that the grid touches."""
        return int(self.burst.size)

    @property
    def places(self) -> IntArray:
        """(N,) position of every grid slot in its packet."""
        return np.asarray((np.arange(self.n_slots) + self.first_slot) % self.packet_slots)

    def to_copies(self, slots: NDArray[Any]) -> NDArray[Any]:
        """(..., N) slot values of the grid as (..., n_copies, packet_slots), 0 where the grid does not reach."""
        out = np.zeros((*slots.shape[:-1], self.n_copies * self.packet_slots), slots.dtype)
        out[..., self.first_slot : self.first_slot + self.n_slots] = slots
        return out.reshape(*slots.shape[:-1], self.n_copies, self.packet_slots)

    def on_grid(self, slots: NDArray[Any]) -> NDArray[Any]:
        """(C, N) values of the grid's slots from those of bursts (B, C, packet_slots)."""
        copies = slots[self.burst].transpose(1, 0, 2)
        return np.asarray(copies.reshape(copies.shape[0], -1)[:, self.first_slot : self.first_slot + self.n_slots])


@dataclass(frozen=True, slots=True)
class SlotSamples:
    """Row profiles resampled to Q samples a slot: C columns, S strips, N slots."""

    #: (C, S, N * Q) float32: light, sample i covers (i .. i + 1) / Q slots of exposure centre; 0 where not valid.
    light: Float32Array
    #: (C, S, N * Q) float32: 1 where the sample lies on the screen, else 0.
    valid: Float32Array
    samples_per_slot: int


@dataclass(frozen=True, slots=True)
class BurstPosteriors:
    """What the detector knows of B bursts of C columns; N payload symbols of up to K bits."""

    #: (C,) int: weight of each column.
    w: NDArray[np.int64]
    #: (C, 9) float64: log evidence of w = 1..9, normalised to a sum of 1 in probability.
    w_log_prob: FloatArray
    #: (C,) float64: log evidence of the column's slots being packets, over the weights that were considered.
    log_evidence: FloatArray
    #: (B, C, 20 + 10 N) float32: probability that the slot is lit.
    lit: Float32Array
    #: (B, C, N) int64: most probable codebook index of every symbol.
    index: NDArray[np.int64]
    #: (B, C, N) float64: log probability of that index.
    log_prob: FloatArray
    #: (B, C, N, 7) float64: ln p(1)/p(0) of the symbol's bits, first bit first; nan where w has fewer bits.
    bit_llr: FloatArray
    #: (B, C) float64: log-likelihood of the headers as they must be, over slots of any kind; 0 where none is seen.
    header_llr: FloatArray

    def of_columns(self, columns: IntArray) -> BurstPosteriors:
        """Those of some columns."""
        return BurstPosteriors(*(getattr(self, f.name)[_columns_of(f.name, columns)] for f in fields(self)))

    def with_columns(self, columns: IntArray, some: BurstPosteriors) -> BurstPosteriors:
        """All columns, with `some` in the place of those named."""

        def merged(name: str) -> Any:
            out = getattr(self, name).copy()
            out[_columns_of(name, columns)] = getattr(some, name)
            return out

        return BurstPosteriors(*(merged(f.name) for f in fields(self)))


def _columns_of(name: str, columns: IntArray) -> Any:
    """Index of some columns in a field of the posteriors; bursts come first in all but the weights and the evidence."""
    return columns if name in ("w", "w_log_prob", "log_evidence") else (slice(None), columns)


FrameStatus = Literal["ok", "partial", "no_screen", "no_signal", "unreadable"]
ColumnStatus = Literal["ok", "weak", "dark", "no_packet"]


#: A packet of at least this confidence is believed: it counts as received, and its column is not weak.
BELIEVABLE = 0.5


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
    #: What the confidence was made of, see `rxcli.receiver.decode.assemble`; for fits, not for reports.
    confidence_features: tuple[float, ...] = ()

    @property
    def is_believable(self) -> bool:
        """Whether the packet is more likely right than wrong."""
        return self.confidence >= BELIEVABLE

    @property
    def payload_bytes(self) -> bytes:
        """The payload, first bit most significant, zero-padded to whole bytes."""
        return bytes.fromhex(self.payload)


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
class FrameSoftBits:
    """What one frame, or one burst, says of the payload's bits: B bursts, N payload symbols, C columns."""

    #: (B,) int64 number of every burst in its epoch, ascending.
    burst: NDArray[np.int64]
    #: (B, N, C, 7) float32 ln p(1)/p(0) of every label's bits, first bit first; 0 or NaN where nothing is known.
    llr: Float32Array
    #: Burst numbers of one epoch count on one clock; those of different epochs cannot be compared.
    epoch: int = 0
    source: str = ""
    frame: int = 0
    time_s: float = 0.0


MessageKind = Literal["raw", "text", "uri"]


@dataclass(frozen=True, slots=True)
class Message:
    """A short message that came."""

    kind: MessageKind
    data: bytes
    source: str
    #: Frame in which it was complete.
    frame: int
    time_s: float

    @property
    def text(self) -> str | None:
        """Text or URI; None for raw bytes."""
        return None if self.kind == "raw" else self.data.decode("utf-8")


@dataclass(frozen=True, slots=True)
class ReceivedObject:
    """A file that came whole; its SHA-256 fits."""

    #: Safe to be used as a file's name.
    name: str
    #: Its bytes; empty where a report was read back.
    data: bytes
    size: int
    sha256: str
    object_id: int
    n_blocks: int
    source: str
    #: Frame in which it was complete.
    frame: int
    time_s: float
    #: Where it was written, None where it was not.
    path: str | None = None


#: Memory of all files that are being received at a time where nothing else is said, 2^20 bytes.
FILE_MEMORY_MB = 512


@dataclass(frozen=True, slots=True)
class ObjectProgress:
    """A file under way."""

    object_id: int
    #: Bytes of the container, a little more or less than the file's.
    container_bytes: int
    n_blocks: int
    blocks_done: int
    #: Of what must be seen, 0..1.
    share: float
    #: More seconds of such a clip that would do; None where nothing says how many.
    seconds_left: float | None


@dataclass(frozen=True, slots=True)
class SearchStep:
    """A hypothesis that the search of a photograph tried."""

    #: Screen, columns, rows of the outline, rows per slot, direction of readout and bursts, in words.
    hypothesis: str
    log_prior: float
    #: Log-likelihood ratio of packets over slots of any kind; 0 where there was no clock.
    evidence: float
    score: float
    #: "won"; "lost"; "half": its middle columns left it too far behind for a whole pass; "no clock"; "no data": it
    #: scored best, but light without data explains it.
    fate: str


@dataclass(frozen=True, slots=True)
class FrameResult:
    """What became of one frame; `rxcli.results.report` turns it into JSON and tables."""

    source: str
    frame: int
    time_s: float
    status: FrameStatus
    #: Reason and next step of a failure.
    message: str | None = None
    screen_profile: str | None = None
    #: (4, 2) image pixels, top-left first, clockwise as a viewer sees the screen.
    corners: FloatArray | None = None
    #: Probability that the columns are numbered as the screen's; the packets' confidence has it in it.
    column_certainty: float = 1.0
    #: Sides of the stored picture (top, right, bottom, left) that were not seen but inferred.
    inferred_sides: tuple[str, ...] = ()
    #: The screen's column that column 0 of the result is; None where columns are counted from the left of what is seen.
    column_offset: int | None = 0
    #: Whether the picture is mirrored, and columns count from its right: on request, or because a text or a file can
    #: only be read so. None: it may be, for the file names a front camera.
    mirrored: bool | None = False
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
    #: Every hypothesis that was tried, in order, of a photograph; never part of a report.
    search: tuple[SearchStep, ...] = ()
    #: For the link layer, where it was asked for; never part of a report.
    soft_bits: FrameSoftBits | None = None
    #: What the link layer has complete with this frame.
    messages: tuple[Message, ...] = ()
    objects: tuple[ReceivedObject, ...] = ()
    #: In the last result of a source: files under way, and sentences about what was refused.
    progress: tuple[ObjectProgress, ...] = ()
    link_notes: tuple[str, ...] = ()
    #: The process that decoded the source was ended from outside: a run that is resumed tries the source again.
    retry: bool = False

    @property
    def packets(self) -> tuple[PacketResult, ...]:
        """Those of all columns."""
        return tuple(packet for column in self.columns for packet in column.packets)

    def with_columns_mirrored(self) -> FrameResult:
        """The result with its columns, corners and soft bits counted from the other side."""
        soft = self.soft_bits
        return replace(
            self,
            corners=None if self.corners is None else self.corners[[1, 0, 3, 2]],
            columns=tuple(replace(c, column=len(self.columns) - 1 - c.column) for c in reversed(self.columns)),
            soft_bits=None if soft is None else replace(soft, llr=soft.llr[:, :, ::-1]),
            mirrored=not self.mirrored,
        )
