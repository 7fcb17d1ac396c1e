"""Analysis of a decoded frame with the decided slots: light against slots, stage by stage."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rxcli.profiles import CameraProfile, ScreenProfile
from rxcli.protocol import bits_per_symbol, encode_packet, hex_to_bits
from rxcli.receiver import camera as blind
from rxcli.receiver import plane
from rxcli.receiver.decode import assemble
from rxcli.receiver.plane.orientation import as_received
from rxcli.results.overlay import outlines_of
from rxcli.types import ColumnResult, FloatArray, Frame, FrameResult, RowProfiles

#: Slots over which a column's picture is taken for even, and over which one clock residual is measured.
_PICTURE_SLOTS, _RESIDUAL_SLOTS = 40, 30
#: Bins of histogram and eye diagram; times of one slot before and after.
BINS, EYE_TIMES = 40, 40
#: Light relative to that of a lit slot, from and to.
RANGE = (-0.4, 1.6)


@dataclass(frozen=True, slots=True)
class Trace:
    """One column's light over the sensor rows, with what was decided."""

    column: ColumnResult
    #: (n,) sensor rows, and light there, 1 is white.
    rows: FloatArray
    light: FloatArray
    #: (n,) light predicted from the decided slots; NaN without decided slots.
    model: FloatArray
    #: (n,) share of the exposure in lit slots, 0..1, and light over the picture's own; NaN likewise.
    share: FloatArray
    relative: FloatArray
    #: Sensor rows on which decided packets start, and rows [from, to) of their lit slots.
    borders: tuple[float, ...] = ()
    lit_spans: tuple[tuple[float, float], ...] = ()
    #: (m, 2) sensor row and clock residual there, slots.
    residuals: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class Inspection:
    """All that is drawn of a frame beside its result."""

    rows_per_slot: float
    traces: tuple[Trace, ...]
    #: (2, BINS) slots of dark and of lit ones by their light, over RANGE.
    histogram: NDArray[np.int64]
    #: (BINS, EYE_TIMES) how often light and time within two slots meet.
    eye: NDArray[np.int64]
    #: (C, 3) light of the left neighbour, the column itself, and the right one, shares; NaN where not measured.
    crosstalk: FloatArray


def inspect_frame(
    frame: Frame, result: FrameResult, screen: ScreenProfile, camera: CameraProfile | None
) -> Inspection | None:
    """Light of every column against its decided slots; None where no clock is known.

    Args:
        frame: the picture.
        result: what became of it; its corners are known.
        screen: the profile that it names.
        camera: the profile that it names, or the estimated one.
    """
    frame, result = as_received(frame, result)
    if result.corners is None or not result.line_delay_s or not result.columns:
        return None
    width_px = float(np.linalg.norm(result.corners[1] - result.corners[0])) / screen.columns
    outlines = outlines_of(result.corners, screen.columns, frame, camera, plane.strips_per_column(width_px))
    tone = "srgb" if camera is None or camera.tone == "auto" else camera.tone
    profiles, columns = _in_time_order(frame, result, plane.sample_rows(plane.read_plane(frame), outlines, tone))
    rows_per_slot = 1 / (screen.slot_rate_hz * result.line_delay_s)
    exposure_rows = (result.exposure_s or 0.0) / result.line_delay_s
    traces = [_trace(profiles, column, screen, rows_per_slot, exposure_rows) for column in columns]
    eye = _eye(traces, rows_per_slot)
    return Inspection(rows_per_slot, tuple(traces), _histogram(traces), eye, _crosstalk(traces))


def _trace(
    profiles: RowProfiles, column: ColumnResult, screen: ScreenProfile, rows_per_slot: float, exposure_rows: float
) -> Trace:
    rows, light = column_light(profiles, column.column)
    order = np.argsort(rows, kind="stable")
    rows, light = rows[order], light[order]
    unknown = np.full(rows.size, np.nan)
    share, borders, spans = unknown.copy(), [], []
    for start, slots in decided_slots(column, screen, rows_per_slot, rows):
        borders.append(start)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], slots, [0]]))).reshape(-1, 2)
        # A row shows most of a slot where its exposure is half over.
        spans += [(start + rows_per_slot * float(a), start + rows_per_slot * float(b)) for a, b in edges - 0.0]
        total = np.concatenate([[0.0], np.cumsum(slots)])
        grid = np.arange(slots.size + 1, dtype=np.float64)
        start_slots = (rows - start) / rows_per_slot
        length = max(exposure_rows, 1.0) / rows_per_slot
        inside = (start_slots >= 0) & (start_slots + length <= slots.size)
        lit = np.interp(start_slots + length, grid, total) - np.interp(start_slots, grid, total)
        share[inside] = lit[inside] / length
    spans = [(a - exposure_rows / 2, b - exposure_rows / 2) for a, b in spans]
    trace = Trace(column, rows, light, unknown, share, unknown, tuple(borders), tuple(spans))
    return _with_model(trace, rows_per_slot) if borders and np.isfinite(share).sum() > 3 * rows_per_slot else trace


def _with_model(trace: Trace, rows_per_slot: float) -> Trace:
    """The trace with the light that its slots should give: the picture is taken for even over some slots."""
    known = np.isfinite(trace.share)
    share, light = np.where(known, trace.share, 0), np.where(known, trace.light, 0)
    size = max(int(_PICTURE_SLOTS * rows_per_slot), 3)
    n, s, ss, y, ys = (_box(v, size) for v in (known.astype(float), share, share**2, light, light * share))
    determinant = n * ss - s**2
    gain = np.where(determinant > 1e-9, (n * ys - s * y) / np.maximum(determinant, 1e-9), np.nan)
    offset = (y - gain * s) / np.maximum(n, 1)
    good = known & (gain > 0)
    model = np.where(good, offset + gain * share, np.nan)
    relative = np.where(good, (trace.light - offset) / np.where(good, gain, 1), np.nan)
    share = np.where(good, trace.share, np.nan)
    residuals = _residuals(trace.rows, relative, share, rows_per_slot)
    return replace(trace, model=model, share=share, relative=relative, residuals=residuals)


def _box(values: FloatArray, size: int) -> FloatArray:
    """Sums over `size` neighbours, fewer at the ends."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    at = np.arange(values.size)
    return np.asarray(total[np.minimum(at + size // 2 + 1, values.size)] - total[np.maximum(at - size // 2, 0)])


def _residuals(rows: FloatArray, relative: FloatArray, share: FloatArray, rows_per_slot: float) -> FloatArray | None:
    """(m, 2) row and how much later than the clock the light is there, slots: one Gauss-Newton step per window."""
    size = int(_RESIDUAL_SLOTS * rows_per_slot)
    found = []
    for top in range(0, rows.size - size + 1, max(size, 1)):
        part = slice(top, top + size)
        slope = np.gradient(share[part])
        good = np.isfinite(slope) & np.isfinite(relative[part])
        power = float(np.sum(slope[good] ** 2))
        if good.sum() > size / 2 and power > 1e-6:
            late_rows = -float(np.sum(slope[good] * (relative[part] - share[part])[good])) / power
            found.append((float(rows[part].mean()), late_rows / rows_per_slot))
    return np.array(found) if found else None


def _histogram(traces: list[Trace]) -> NDArray[np.int64]:
    counts = np.zeros((2, BINS), np.int64)
    for trace in traces:
        for kind, chosen in enumerate((trace.share < 0.05, trace.share > 0.95)):
            values = np.clip(trace.relative[chosen], *RANGE)
            counts[kind] += np.histogram(values, BINS, RANGE)[0]
    return counts


def _eye(traces: list[Trace], rows_per_slot: float) -> NDArray[np.int64]:
    counts = np.zeros((BINS, EYE_TIMES), np.int64)
    for trace in traces:
        for start in trace.borders[:1]:
            good = np.isfinite(trace.relative)
            time = ((trace.rows[good] - start) / rows_per_slot) % 2
            values = np.clip(trace.relative[good], *RANGE)
            counts += np.histogram2d(values, time, (BINS, EYE_TIMES), (RANGE, (0, 2)))[0].astype(np.int64)
    return counts


def _crosstalk(traces: list[Trace]) -> FloatArray:
    """How much of a column's light follows the slots of its neighbours: least squares on the rows that all show."""
    shares = np.full((len(traces), 3), np.nan)
    for number, trace in enumerate(traces):
        sides = [side for side in (0, 2) if 0 <= number + side - 1 < len(traces)]
        parts = {1: trace.share} | {side: _on(trace.rows, traces[number + side - 1]) for side in sides}
        used = {side: part for side, part in parts.items() if np.isfinite(part).any()}
        design = np.column_stack([*used.values(), np.ones(trace.rows.size)])
        good = np.isfinite(design).all(axis=1) & np.isfinite(trace.relative)
        if 1 in used and good.sum() >= 20 * design.shape[1]:
            shares[number, list(used)] = np.linalg.lstsq(design[good], trace.relative[good], rcond=None)[0][:-1]
    return shares


def _on(rows: FloatArray, trace: Trace) -> FloatArray:
    """A neighbour's slots on the rows of a column; NaN where they are not decided."""
    if not np.isfinite(trace.share).any():
        return np.full(rows.size, np.nan)
    return np.asarray(np.interp(rows, trace.rows, trace.share, left=np.nan, right=np.nan))


def _in_time_order(
    frame: Frame, result: FrameResult, profiles: RowProfiles
) -> tuple[RowProfiles, tuple[ColumnResult, ...]]:
    """Row profiles and columns with rows counted as they were read out, not as software may have turned them."""
    if not result.estimated.get("readout_reversed", (0.0, 0.0))[0]:
        return profiles, result.columns
    columns = tuple(assemble.in_stored_rows(column, frame.height) for column in result.columns)
    return blind.in_time_order(profiles, frame.height), columns


def column_light(profiles: RowProfiles, column: int) -> tuple[FloatArray, FloatArray]:
    """Sensor rows (n,) and mean light (n,) of one column, where it is on the screen."""
    inside = profiles.inside[column]
    on_screen = inside.any(axis=0)
    light = (profiles.light[column] * inside).sum(axis=0)[on_screen] / inside.sum(axis=0)[on_screen]
    rows = profiles.rows.astype(np.float64) if profiles.sensor_row is None else profiles.sensor_row[column].mean(axis=0)
    return rows[on_screen], light.astype(np.float64)


def decided_slots(
    column: ColumnResult, screen: ScreenProfile, rows_per_slot: float, rows: FloatArray
) -> Iterator[tuple[float, NDArray[np.uint8]]]:
    """Decided slots of each packet of a column, over the copies that are visible on its sensor rows (n,).

    Yields:
        Sensor row where the first slot starts, and the slots, 0 or 1.
    """
    if column.w is None or rows.size == 0 or not column.packets:
        return
    ends = [packet.first_row for packet in column.packets[1:]] + [float(rows.max())]
    for packet, end in zip(column.packets, ends, strict=True):
        if packet.payload_bits != bits_per_symbol(column.w) * screen.payload_symbols:
            continue  # no packet of this weight and screen
        slots = encode_packet(hex_to_bits(packet.payload, packet.payload_bits), column.w)
        # After the counted copies another burst may begin that is hardly visible.
        hidden = max(float(rows.min()) - packet.first_row, 0.0) / rows_per_slot
        longest = min(hidden + packet.copies * slots.size, screen.repeats * slots.size)
        n_slots = math.ceil(min((end - packet.first_row) / rows_per_slot, longest))
        if n_slots > 0:
            yield packet.first_row, np.resize(slots, n_slots)
