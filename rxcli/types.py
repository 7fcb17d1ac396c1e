"""Frozen dataclasses that pass between stages.

Two conventions hold everywhere. Integer pixel coordinates are pixel centres, x to the right and y downwards in the
stored picture, which is never rotated. The time of a sensor row is the start of its exposure: row `r` integrates from
`start_time_s + r * line_delay_s` for `exposure_s`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from html import escape
from typing import Any, Literal, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

#: EXIF orientations that mirror the picture.
_MIRRORED = (2, 4, 5, 7)
_FRONT = re.compile(r"\b(front|facetime|selfie)\b", re.IGNORECASE)
FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
_T = TypeVar("_T", bound="RowProfiles | SlotSamples")
#: Is given the arrays at the stage boundaries of a received frame: source, number of the frame, stage -> array or
#: dataclass of arrays.
OnTaps = Callable[[str, int, dict[str, Any]], object]


class Denoiser(Protocol):
    """Interface of a model that corrects slot log-likelihood ratios."""

    @property
    def name(self) -> str:
        """Name for reports."""

    def slot_corrections(self, scene: Any, columns: IntArray) -> Float32Array:
        """(len(columns), N) values to add to ln p(light | lit) - ln p(light | dark) of every slot of `columns`.

        Args:
            scene: `rxcli.receiver.channel.denoise.DenoiserInput`, after `remove_row_noise`.
            columns: numbers of the columns.
        """


@dataclass(frozen=True, slots=True)
class Metadata:
    """Metadata of a picture file; None where the file states nothing."""

    make: str | None = None
    model: str | None = None
    lens: str | None = None
    exposure_s: float | None = None
    iso: float | None = None
    focal_length_mm: float | None = None
    focal_length_35mm: float | None = None
    #: EXIF orientation, 1..8; 1 where the file has none.
    orientation: int = 1
    #: Impossible values in the file, in words; the fields above are then None.
    not_believed: tuple[str, ...] = ()
    #: Time from the first row of a frame to the last, as the camera states it: right to several per cent.
    readout_s: float | None = None

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
class Colours:
    """Read the colours of a developed picture, when they are asked for."""

    #: (h, w, 3) float32: red, green and blue of about every eighth pixel and row, 0 black to 1 white.
    thinned: Callable[[], Float32Array]
    #: (height, width) luma of green and blue alone, with the levels of the luma.
    without_red: Callable[[], NDArray[Any]]
    #: The first rows of `thinned`, about a share of them; None where all take no longer.
    first_rows: Callable[[float], Float32Array] | None = None


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
    #: Of a developed picture; None where nothing but its luma is known.
    colours: Colours | None = field(default=None, repr=False, compare=False)
    #: Contrast of the slots in red relative to green, with its standard deviation, where red was left out.
    red_contrast: tuple[float, float] | None = None

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
    """Position of each strip of each column on every picture row. C columns of S strips, R picture rows."""

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
    """Linear light of every strip on every row, the only input of the later stages."""

    #: (C, S, R) float32: mean light, 1 is white; 0 outside the screen.
    light: Float32Array
    #: (C, S, R) bool: the strip is on the screen there.
    inside: BoolArray
    #: (R,) int: picture rows.
    rows: NDArray[np.int64]
    #: (C, S, R) float64: sensor rows, None where they are `rows`.
    sensor_row: FloatArray | None
    #: (C, S) float32: pixels per mean, median over the rows.
    count: Float32Array
    #: The variance of a pixel of light x is noise_floor + noise_slope * x.
    noise_floor: float
    noise_slope: float
    #: (C, S, R) float32: light of a half-lit row; None where the picture is unknown.
    level: Float32Array | None = None
    #: Whether the sensor's rows are so noisy that it shows.
    has_row_noise: bool = False

    def variance(self) -> Float32Array:
        """(C, S, R) variance of `light` by the noise model."""
        pixel = self.noise_floor + self.noise_slope * np.maximum(self.light, 0)
        return np.asarray(pixel / np.maximum(self.count, 1.0)[:, :, None], np.float32)

    def of_columns(self, columns: IntArray | slice) -> Self:
        """The profiles of some columns."""
        return _with_columns(self, columns, "light", "inside", "sensor_row", "count", "level")


def _with_columns(value: _T, columns: IntArray | slice, *names: str) -> _T:
    """A dataclass with some columns of its named arrays, where they are known."""
    arrays = {name: array for name in names if (array := getattr(value, name)) is not None}
    return replace(value, **{name: array[columns] for name, array in arrays.items()})


@dataclass(frozen=True, slots=True)
class Clock:
    """Time of the link on the sensor.

    Grid slot `n` is position `(n + first_slot) % packet_slots` of copy `(n + first_slot) // packet_slots` in every
    column; a copy is one transmission of a packet.
    """

    rows_per_slot: float
    #: Exposure in slots.
    exposure_slots: float
    packet_slots: int
    #: Sensor row whose exposure is centred at the start of grid slot 0 of a column without delay.
    row0: float
    #: Slots of the grid.
    n_slots: int
    #: Position of grid slot 0 in its packet; grid slot 0 belongs to copy 0.
    first_slot: int
    #: (n_copies,) int: burst of each copy, from 0 in time order.
    burst: NDArray[np.int64]
    #: (C,) float64: delay of each column, slots.
    delay_slots: FloatArray
    #: Ratio of the header peak to its strongest rival.
    header_peak_ratio: float

    @property
    def n_copies(self) -> int:
        """Number of copies on the grid."""
        return int(self.burst.size)

    @property
    def by_copy(self) -> Clock:
        """The same with every copy a burst of its own."""
        return replace(self, burst=np.arange(self.n_copies))

    @property
    def places(self) -> IntArray:
        """(N,) position of every grid slot in its packet."""
        return np.asarray((np.arange(self.n_slots) + self.first_slot) % self.packet_slots)

    def to_copies(self, slots: NDArray[Any]) -> NDArray[Any]:
        """Reshape grid values (..., N) to (..., n_copies, packet_slots), 0 outside the grid."""
        out = np.zeros((*slots.shape[:-1], self.n_copies * self.packet_slots), slots.dtype)
        out[..., self.first_slot : self.first_slot + self.n_slots] = slots
        return out.reshape(*slots.shape[:-1], self.n_copies, self.packet_slots)

    def by_burst(self, slots: NDArray[Any]) -> NDArray[Any]:
        """(B, C, packet_slots) grid values (C, N) added over the copies of each burst."""
        return self.added(self.to_copies(slots))

    def added(self, copies: NDArray[Any]) -> NDArray[Any]:
        """(B, C, ...) values (C, n_copies, ...) added over the copies of each burst."""
        return np.stack([copies[:, self.burst == burst].sum(axis=1) for burst in range(int(self.burst.max()) + 1)])

    def on_grid(self, slots: NDArray[Any]) -> NDArray[Any]:
        """(C, N) values on the grid from values of bursts (B, C, packet_slots)."""
        copies = slots[self.burst].transpose(1, 0, 2)
        return np.asarray(copies.reshape(copies.shape[0], -1)[:, self.first_slot : self.first_slot + self.n_slots])


@dataclass(frozen=True, slots=True)
class SlotSamples:
    """Row profiles resampled to Q samples per slot: C columns, S strips, N slots."""

    #: (C, S, N * Q) float32: light, sample i covers (i .. i + 1) / Q slots of exposure centre; 0 where not valid.
    light: Float32Array
    #: (C, S, N * Q) float32: 1 where the sample lies on the screen, else 0.
    valid: Float32Array
    samples_per_slot: int
    #: (C, S, N * Q) float32: light of a half-lit row; None where the picture is unknown.
    level: Float32Array | None = None

    def of_columns(self, columns: IntArray) -> Self:
        """The samples of some columns."""
        return _with_columns(self, columns, "light", "valid", "level")


@dataclass(frozen=True, slots=True)
class BurstSamples:
    """Samples of the copies of bursts side by side, ordered by the slot in which their exposure starts.

    P slots of a packet, Q samples per slot; lanes: B bursts times C columns; F: copies of a burst times strips.
    """

    #: (P, Q, lanes, F) float32: light over its local mean; variance of its noise; 1 where valid, else 0; and light of
    #: the adjacent columns per unit of picture.
    light: Float32Array
    noise: Float32Array
    valid: Float32Array
    neighbours: Float32Array
    #: (F,) share of a column's own light in its strips.
    own: Float32Array
    exposure_slots: float
    #: (lanes,) log density of the light relative to that of `light`, per sample of a slot.
    log_scale: FloatArray
    n_bursts: int
    #: (lanes, 9) log prior of w = 1..9, or None.
    w_log_prior: FloatArray | None = None

    @property
    def n_columns(self) -> int:
        """Columns, C."""
        return int(self.light.shape[2]) // self.n_bursts


@dataclass(frozen=True, slots=True)
class BurstPosteriors:
    """Posteriors of B bursts of C columns; N payload symbols of up to 7 bits."""

    #: (C,) int: weight of each column.
    w: NDArray[np.int64]
    #: (C, 9) float64: log evidence of w = 1..9, normalised to a sum of 1 in probability.
    w_log_prob: FloatArray
    #: (C,) float64: log evidence of packets in the column, summed over the weights; of a frame, against slots of any
    #: kind.
    log_evidence: FloatArray
    #: (B, C, 20 + 10 N) float32: probability that the slot is lit.
    lit: Float32Array
    #: (B, C, N) int64: most probable codebook index of every symbol.
    index: NDArray[np.int64]
    #: (B, C, N) float64: log probability of that index.
    log_prob: FloatArray
    #: (B, C, N, 7) float64: ln p(1)/p(0) of the symbol's bits, first bit first; nan where w has fewer bits.
    bit_llr: FloatArray
    #: (B, C) float64: log-likelihood ratio of the headers against arbitrary slots; 0 where no header is visible.
    header_llr: FloatArray
    #: (B, C, N, 128) float32: probability of the words of the column's weight; 0 beyond its codebook.
    words: Float32Array

    def of_columns(self, columns: IntArray) -> BurstPosteriors:
        """Posteriors of some columns."""
        return BurstPosteriors(*(getattr(self, f.name)[_columns_of(f.name, columns)] for f in fields(self)))

    def of_burst(self, burst: int) -> BurstPosteriors:
        """Posteriors of one burst."""
        values = ((f.name, getattr(self, f.name)) for f in fields(self))
        return BurstPosteriors(*(value if name in _BY_COLUMN else value[burst, None] for name, value in values))

    def with_columns(self, columns: IntArray, some: BurstPosteriors) -> BurstPosteriors:
        """Replace the posteriors of the named columns by `some`."""

        def merged(name: str) -> Any:
            out = getattr(self, name).copy()
            out[_columns_of(name, columns)] = getattr(some, name)
            return out

        return BurstPosteriors(*(merged(f.name) for f in fields(self)))


#: Fields of posteriors whose first axis is the columns; that of the others is the bursts.
_BY_COLUMN = ("w", "w_log_prob", "log_evidence")


def _columns_of(name: str, columns: IntArray) -> Any:
    """Index of some columns in a field; bursts are the first axis of all fields but weights and evidence."""
    return columns if name in _BY_COLUMN else (slice(None), columns)


FrameStatus = Literal["ok", "partial", "no_screen", "no_signal", "unreadable"]
ColumnStatus = Literal["ok", "weak", "dark", "no_packet"]


#: Minimum confidence of a received packet; a column below it is `weak`.
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
    #: Features of the confidence, see `rxcli.receiver.decode.confidence`; for fits, not for reports.
    confidence_features: tuple[float, ...] = field(default=(), repr=False)

    @property
    def is_believable(self) -> bool:
        """Whether the packet is more likely right than wrong."""
        return self.confidence >= BELIEVABLE

    @property
    def payload_bytes(self) -> bytes:
        """The payload, first bit most significant, zero-padded to whole bytes."""
        return bytes.fromhex(self.payload)


_OfPicture = Literal["black", "saturated", "few_pixels", "too_tall", "no_columns", "lit", "no_columns_dark"]
_OfOutline = Literal["no_columns_striped", "corners_far", "corners_outside", "corners_few_rows"]
_OfStripes = Literal["no_stripes", "part_striped", "narrow_stripes", "no_stripes_across", "long_exposure"]
_OfLight = Literal[
    "steady_light", "one_lamp", "screen_dark", "nothing_lit", "unsure", "no_column", "not_searched", "not_tried"
]
_OfPackets = Literal["no_headers", "no_header", "part_in_view", "screen_fills_little", "packet_too_long"]
_OfColumn = Literal["headerless", "echo", "out_of_view", "goes_on", "withheld", "incomplete", "dark", "uncertain"]
_OfNumbers = Literal["not_read", "column_numbers", "one_column", "column_alone", "all_the_same", "one_screen_tried"]
_OfCamera = Literal["no_readout_mode", "other_camera", "other_exposure", "other_camera_and_exposure", "not_believed"]
_OfRows = Literal[
    "portrait", "on_its_side", "stripes_down", "upside_down", "as_stored", "turned_clockwise", "turned_counterclockwise"
]
_OfClip = Literal["stabilised", "doubled", "certain_before", "nominal_times", "retimed", "slow_motion"]
#: Why a result is as it is; `rxcli.results.reasons` has a sentence for each.
Reason = Literal[
    _OfPicture, _OfOutline, _OfStripes, _OfLight, _OfPackets, _OfColumn, _OfNumbers, _OfCamera, _OfRows, _OfClip
]


@dataclass(frozen=True, slots=True)
class Remark:
    """A reason and what was measured of it."""

    reason: Reason
    #: By the names in the reason's sentence.
    facts: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ColumnResult:
    """Result of one column."""

    column: int
    status: ColumnStatus
    w: int | None = None
    snr_db: float | None = None
    denoised: bool = False
    #: Delay against the common clock.
    delay_slots: float | None = None
    packets: tuple[PacketResult, ...] = ()
    #: Why nothing was decoded; and as a sentence, see `FrameResult.message`.
    remark: Remark | None = None
    message: str | None = None

    @property
    def reason(self) -> Reason | None:
        """Why nothing was decoded."""
        return None if self.remark is None else self.remark.reason


@dataclass(frozen=True, slots=True)
class FrameSoftBits:
    """Soft bits of the payload from one frame or one burst: B bursts, N payload symbols, C columns."""

    #: (B,) int64 number of every burst in its epoch, ascending.
    burst: NDArray[np.int64]
    #: (B, N, C, 7) float32 ln p(1)/p(0) of every label's bits, first bit first; 0 or NaN if unknown.
    llr: Float32Array
    #: Burst numbers of one epoch count on one clock; numbers of different epochs are not comparable.
    epoch: int = 0
    source: str = ""
    frame: int = 0
    time_s: float = 0.0
    #: Whether no header shows where packets start: the symbols in view may be any of their packet, in this order.
    open_start: bool = False
    #: The same picture read with other, less likely clocks.
    alternatives: tuple[FrameSoftBits, ...] = ()
    #: Profile of the screen whose packets they are taken for; None in clips.
    screen_profile: str | None = None


MessageKind = Literal["raw", "text", "uri"]


@dataclass(frozen=True, slots=True)
class Message:
    """A received short message."""

    kind: MessageKind
    data: bytes
    source: str
    #: Frame in which it was complete.
    frame: int
    time_s: float
    #: Photographs that were added up for it, where there are several.
    photos: tuple[str, ...] = ()

    @property
    def text(self) -> str | None:
        """Text or URI; None for raw bytes."""
        return None if self.kind == "raw" else self.data.decode("utf-8")


@dataclass(frozen=True, slots=True)
class ReceivedObject:
    """A complete file with a valid SHA-256."""

    #: Harmless file name.
    name: str
    #: Content; empty if read back from a report.
    data: bytes
    size: int
    sha256: str
    object_id: int
    n_blocks: int
    source: str
    #: Frame in which it was complete.
    frame: int
    time_s: float
    #: Path of the written file, or None.
    path: str | None = None


#: Default memory limit of all incomplete files together, 2^20 bytes.
FILE_MEMORY_MB = 512


@dataclass(frozen=True, slots=True)
class ObjectProgress:
    """Progress of an incomplete file."""

    object_id: int
    #: Bytes of the container, which differ a little from the file's.
    container_bytes: int
    n_blocks: int
    blocks_done: int
    #: Received share of the required information, 0..1.
    share: float
    #: Estimated remaining seconds of such a clip, or None.
    seconds_left: float | None


@dataclass(frozen=True, slots=True)
class SearchStep:
    """A hypothesis scored by the search of a photograph."""

    #: Screen, columns, rows of the outline, rows per slot, direction of readout and bursts, in words.
    hypothesis: str
    log_prior: float
    #: Log-likelihood ratio of packets against arbitrary slots; 0 without a clock.
    evidence: float
    score: float
    #: "won"; "lost"; "half": its middle columns left it too far behind for a whole pass; "no clock"; "no data": it
    #: scored best, but light without data explains it; "not tried": the work for a picture without evidence was done.
    fate: str


@dataclass(frozen=True, slots=True)
class FrameResult:
    """Result of one frame; `rxcli.results.report` converts it to JSON and tables."""

    source: str
    frame: int
    time_s: float
    status: FrameStatus
    #: `remarks` in sentences, reason and next step: written by `rxcli.results.reasons` once the receiver is done.
    message: str | None = None
    screen_profile: str | None = None
    #: (4, 2) image pixels, top-left first, clockwise as a viewer sees the screen.
    corners: FloatArray | None = None
    #: Probability that the column numbers are those of the screen; included in the confidence of the packets.
    column_certainty: float = 1.0
    #: Sides of the screen (top, right, bottom, left of the stored picture) that were inferred, not found.
    inferred_sides: tuple[str, ...] = ()
    #: Screen number of column 0; None if columns are counted from the leftmost visible one.
    column_offset: int | None = 0
    #: Whether the picture is mirrored, with columns counted from its right: on request, or because a text or a file
    #: decoded only that way. None: undecided, since the file names a front camera.
    mirrored: bool | None = False
    #: Quarter turns, counter-clockwise, by which the stored picture was turned to be received; `first_row` is then a
    #: row of the picture so turned.
    quarter_turns: int = 0
    camera_profile: str | None = None
    line_delay_s: float | None = None
    exposure_s: float | None = None
    #: Blind estimates of the camera: name -> (value, standard deviation).
    estimated: dict[str, tuple[float, float]] = field(default_factory=dict)
    columns: tuple[ColumnResult, ...] = ()
    #: Results of further screens in a photograph that packets were received from.
    other_screens: tuple[FrameResult, ...] = ()
    #: Wall time by stage, milliseconds.
    timing_ms: dict[str, float] = field(default_factory=dict)
    #: Skipped steps: name -> count.
    skipped: dict[str, int] = field(default_factory=dict)
    #: Report of the auto-encoder; None if it did not run.
    denoiser: dict[str, Any] | None = None
    #: Scored hypotheses of a photograph, in order; never part of a report.
    search: tuple[SearchStep, ...] = ()
    #: Soft bits for the link layer, on request; never part of a report.
    soft_bits: FrameSoftBits | None = None
    #: Messages and files completed with this frame.
    messages: tuple[Message, ...] = ()
    objects: tuple[ReceivedObject, ...] = ()
    #: In the last result of a source: incomplete files, and sentences about refused ones.
    progress: tuple[ObjectProgress, ...] = ()
    link_notes: tuple[str, ...] = ()
    #: In the last result of a clip: its incomplete files as the link layer keeps them; never part of a report.
    files: tuple[Any, ...] = ()
    #: What there is to know of the result, the reason of a failure first.
    remarks: tuple[Remark, ...] = ()
    #: Whether the decoding process was killed; a resumed run then decodes the source again.
    retry: bool = False

    def __repr__(self) -> str:
        """The result in a line: the rest is in its fields."""
        names = ("source", "frame", "time_s", "status", "message", "screen_profile", "camera_profile")
        known = [f"{name}={value!r}" for name in names if (value := getattr(self, name)) is not None]
        came = [message.text or message.data for message in self.messages] + [file.name for file in self.objects]
        n_packets = f"{len(self.packets)} packets of {len(self.columns)} columns"
        return f"FrameResult({', '.join([*known, n_packets, *map(repr, came)])})"

    def _repr_html_(self) -> str:
        """Texts and packets as a notebook shows them."""
        rows = [(c.column, c.w, f"{p.confidence:.4f}", p.payload) for c in self.columns for p in c.packets]
        cells = ["".join(f"<td>{cell}</td>" for cell in row) for row in rows]
        head = "".join(f"<th>{name}</th>" for name in ("column", "w", "confidence", "payload"))
        table = "".join(f"<tr>{row}</tr>" for row in (head, *cells)) if rows else ""
        return f"<p>{escape(repr(self))}</p><table>{table}</table>"

    @property
    def packets(self) -> tuple[PacketResult, ...]:
        """Packets of all columns."""
        return tuple(packet for column in self.columns for packet in column.packets)

    @property
    def reason(self) -> Reason | None:
        """Why reception failed, or what there is to know of a result."""
        return self.remarks[0].reason if self.remarks else None

    @property
    def gives_camera(self) -> bool:
        """Whether the camera was estimated and half of the columns gave packets, so that it holds for other photos."""
        n_received = sum(any(packet.is_believable for packet in column.packets) for column in self.columns)
        return "line_delay_s" in self.estimated and 2 * n_received >= max(len(self.columns), 1)

    def with_columns_mirrored(self) -> FrameResult:
        """Count columns, corners and soft bits from the opposite side."""
        soft = self.soft_bits
        return replace(
            self,
            corners=None if self.corners is None else self.corners[[1, 0, 3, 2]],
            columns=tuple(replace(c, column=len(self.columns) - 1 - c.column) for c in reversed(self.columns)),
            other_screens=tuple(screen.with_columns_mirrored() for screen in self.other_screens),
            soft_bits=None if soft is None else replace(soft, llr=soft.llr[:, :, ::-1]),
            mirrored=not self.mirrored,
        )
