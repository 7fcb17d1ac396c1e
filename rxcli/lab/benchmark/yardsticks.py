"""Two yardsticks on the receiver's own frames: what no receiver can beat, and the paper's pipeline taken literally."""

from collections.abc import Iterator, Sequence
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from rxcli import protocol
from rxcli.lab.benchmark.trial import SOURCE, Trial, corrected_corners
from rxcli.profiles import ScreenProfile
from rxcli.protocol import HEADER, PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, WEIGHTS, codebook, payload_bits
from rxcli.results.undistort import undistorted
from rxcli.types import ColumnResult, FloatArray, FrameResult, Lens, PacketResult

#: A header is taken for one where at least this share of its rows agrees with the template.
_HEADER_AGREEMENT = 0.9
#: Two headers belong to one packet where their distance is this close to a packet's length.
_LENGTH_TOLERANCE = 0.02
#: The threshold is the mean over this many slots.
_THRESHOLD_SLOTS = 3 * SLOTS_PER_SYMBOL
#: Share of a slot, in its middle, whose rows vote for its state.
_SLOT_MIDDLE = 0.5


def bound_result(trial: Trial) -> FrameResult:
    """The genie, who knows outline, clock, light, picture and all other slots, and decides symbol by symbol.

    Args:
        trial: simulated with its oracle.
    """
    oracle, truth = trial.capture.oracle, trial.truth
    assert oracle is not None, "the bound needs a trial with oracle=True"
    columns = []
    for column, w in enumerate(truth.w):
        decisions = [oracle.decide(column, burst.burst) for burst in truth.frames[0].bursts]
        columns.append((w, tuple(_packet(decided, w) for decided, _, observed in decisions if observed.all())))
    return _result(columns, trial)


def paper_result(trial: Trial) -> FrameResult:
    """The paper's pipeline, given the outline and the camera, on pixel values as they are stored.

    Undistort the whole frame, rectify the screen, average every column's pixels, threshold against the local mean, take
    what lies between two headers one packet apart, and choose the codeword of least Hamming distance.
    """
    waves, rows_per_slot = column_waves(trial)
    lit = threshold(waves, rows_per_slot)
    screen = trial.capture.scene.screen
    return _result([(None, tuple(_between_headers(row, rows_per_slot, screen))) for row in lit], trial)


def column_waves(trial: Trial) -> tuple[FloatArray, float]:
    """Mean pixel value of every column on every row of the rectified screen, in readout order.

    Returns:
        (columns, rows) float64; rows per slot, by the camera's line delay.
    """
    scene, view, frame = trial.capture.scene, trial.capture.exposure.view, trial.frame
    picture = undistorted(frame, Lens(view.camera_matrix, np.array(scene.lens.distortion), scene.is_corrected))
    # Corners where a lens without distortion would show them.
    plane = corrected_corners(view)
    top_left, top_right, bottom_right, bottom_left = plane
    width = max(round(float(np.linalg.norm(top_right - top_left))), scene.screen.columns)
    height = max(round(float(np.linalg.norm(bottom_left - top_left))), 2)
    target = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], np.float32)
    matrix = cv2.getPerspectiveTransform(plane.astype(np.float32), target)
    rectified = cv2.warpPerspective(picture, matrix, (width, height), flags=cv2.INTER_LINEAR)
    edges = np.linspace(0, width, scene.screen.columns + 1).round().astype(int)
    waves = np.stack([rectified[:, a:b].mean(axis=1) for a, b in pairwise(edges)])
    sensor_rows = float(abs(bottom_left[1] + bottom_right[1] - top_left[1] - top_right[1])) / 2
    rows_per_slot = height / max(sensor_rows, 1.0) / (scene.sensor.line_delay_s * scene.screen.slot_rate_hz)
    upside_down = bottom_left[1] < top_left[1]
    return waves[:, ::-1] if upside_down else waves, rows_per_slot


def threshold(waves: FloatArray, rows_per_slot: float) -> NDArray[np.bool_]:
    """Rows brighter than the mean of their surroundings; (columns, rows)."""
    length = 2 * int(_THRESHOLD_SLOTS * rows_per_slot / 2) + 1
    return np.asarray(waves > cv2.blur(waves, (length, 1), borderType=cv2.BORDER_REFLECT))


def _between_headers(lit: NDArray[np.bool_], rows_per_slot: float, screen: ScreenProfile) -> Iterator[PacketResult]:
    """Packets between headers one packet length apart: the pair that agrees best, and those in step with it."""
    starts, agreement = find_headers(lit, rows_per_slot)
    length = screen.packet_slots * rows_per_slot
    distance = starts - starts[:, None]
    begin, end = np.nonzero(np.abs(distance - length) <= _LENGTH_TOLERANCE * length)
    if begin.size == 0:
        return
    best = starts[begin[(agreement[begin] + agreement[end]).argmax()]]
    steps = (starts[begin] - best) / length
    for pair in np.flatnonzero(np.abs(steps - steps.round()) <= _LENGTH_TOLERANCE):
        slots = _read_slots(lit, starts[begin[pair]], starts[end[pair]], screen.packet_slots)
        yield _nearest_packet(slots, screen.payload_symbols)


def find_headers(lit: NDArray[np.bool_], rows_per_slot: float) -> tuple[FloatArray, FloatArray]:
    """Rows at which a header starts, ascending, and its agreement with the template, 0..1; (n,) float64 each."""
    edges = np.arange(0, SLOTS_PER_SYMBOL * rows_per_slot)
    template = np.array(HEADER)[np.minimum((edges / rows_per_slot).astype(int), SLOTS_PER_SYMBOL - 1)]
    if template.size > lit.size:
        return np.empty(0), np.empty(0)
    agreement = 0.5 + np.correlate(lit - 0.5, template - 0.5, "valid") * 2 / template.size
    reach = max(round(2 * rows_per_slot), 1)
    highest = np.lib.stride_tricks.sliding_window_view(np.pad(agreement, reach), 2 * reach + 1).max(axis=1)
    places = np.flatnonzero((agreement >= _HEADER_AGREEMENT) & (agreement == highest))
    # A flat top is one header: its middle.
    groups = [g for g in np.split(places, np.flatnonzero(np.diff(places) > reach) + 1) if g.size]
    return np.array([g.mean() for g in groups]), np.array([agreement[g[0]] for g in groups])


def _read_slots(lit: NDArray[np.bool_], begin: float, end: float, n_slots: int) -> NDArray[np.uint8]:
    """Majority of the rows in the middle of each of the slots between two headers."""
    step = (end - begin) / n_slots
    offsets = np.linspace(-_SLOT_MIDDLE / 2, _SLOT_MIDDLE / 2, 5) * step
    rows = begin + (np.arange(n_slots)[:, None] + 0.5) * step - 0.5 + offsets
    values = lit[np.clip(rows.round().astype(int), 0, lit.size - 1)]
    lit_slots: NDArray[np.uint8] = (values.mean(axis=1) > 0.5).astype(np.uint8)
    return lit_slots


def _nearest_packet(slots: NDArray[np.uint8], payload_symbols: int) -> PacketResult:
    w = int(np.clip(slots[SLOTS_PER_SYMBOL:PREAMBLE_SLOTS].sum(), WEIGHTS[0], WEIGHTS[-1]))
    symbols = slots[PREAMBLE_SLOTS:].reshape(payload_symbols, SLOTS_PER_SYMBOL)
    distance = (symbols[:, None] != codebook(w)).sum(axis=2)
    return _packet(distance.argmin(axis=1), w)


def _packet(index: NDArray[np.int64], w: int) -> PacketResult:
    payload = protocol.bits_to_hex(protocol.indices_to_bits(index, w))
    # A yardstick claims nothing of its decisions.
    return PacketResult(0.0, 1.0, payload_bits(w, index.size), payload, confidence=0.0, ber_hat=0.0)


def _result(columns: Sequence[tuple[int | None, tuple[PacketResult, ...]]], trial: Trial) -> FrameResult:
    results = [
        ColumnResult(column, "ok" if packets else "no_packet", w=w, packets=packets, message="none found")
        for column, (w, packets) in enumerate(columns)
    ]
    return FrameResult(SOURCE, trial.capture.frame, 0.0, "ok", columns=tuple(results))
