"""Analysis of a decoded frame with the decided slots: light against slots, stage by stage."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from rxcli.receiver.light import SlotLight
from rxcli.types import Clock, ColumnResult, FloatArray, FrameResult, RowProfiles

#: Slots over which a column's picture is taken for even, and over which one clock residual is measured.
_PICTURE_SLOTS, _RESIDUAL_SLOTS = 40, 30
#: Bins of histogram and eye diagram; times of one slot before and after.
BINS, EYE_TIMES = 40, 40
#: Light relative to that of a lit slot, from and to.
RANGE = (-0.4, 1.6)
#: Share of an exposure in decided slots from which a row is compared with them.
_ALL = 0.999


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


def inspect_frame(taps: Mapping[str, Any], result: FrameResult) -> Inspection:
    """Light of every column against its decided slots.

    Args:
        taps: arrays at the stage boundaries of the frame, see `receive`.
        result: what became of it.
    """
    clock: Clock = taps["clock"]
    profiles, lit = _profiles(taps), _lit(taps, clock)
    traces = []
    for column in result.columns:
        own = -1 - column.column if result.mirrored else column.column
        slots = lit[own] if column.packets else np.full(clock.n_slots, np.nan)
        start = clock.row0 + float(clock.delay_slots[own]) * clock.rows_per_slot
        traces.append(_trace(column, *_column_light(profiles, own), slots, replace(clock, row0=start)))
    eye = _eye(traces, clock.rows_per_slot)
    return Inspection(clock.rows_per_slot, tuple(traces), _histogram(traces), eye, _crosstalk(traces))


def _profiles(taps: Mapping[str, Any]) -> RowProfiles:
    """The sampled rows of a frame, tracked or not."""
    if "sampling" in taps:
        return cast("RowProfiles", taps["sampling"])
    light, inside, rows = (taps[f"sampling.{name}"] for name in ("light", "inside", "rows"))
    return RowProfiles(light, inside, rows, None, inside.sum(axis=2), 0.0, 0.0)


def _lit(taps: Mapping[str, Any], clock: Clock) -> FloatArray:
    """(C, N) 1 where a slot was decided as lit, 0 as dark; NaN where its burst goes on in the next frame."""
    if "detect" in taps:
        return np.asarray(clock.on_grid(taps["detect"].lit) > 0.5, np.float64)
    ended = {number: taps.get(f"detect.{number}") for number in taps["bursts.number"].tolist()}
    unknown = np.full((len(taps["channel.metrics"]), clock.packet_slots), np.nan, np.float32)
    bursts = [unknown if posteriors is None else np.round(posteriors.lit[0]) for posteriors in ended.values()]
    return np.asarray(clock.on_grid(np.stack(bursts)), np.float64)


def _trace(column: ColumnResult, rows: FloatArray, light: FloatArray, slots: FloatArray, clock: Clock) -> Trace:
    """Light of a column on its rows (n,) and what its slots (N,) explain of it; `clock` is the column's."""
    order = np.argsort(rows, kind="stable")
    rows, light, unknown = rows[order], light[order], np.full(rows.size, np.nan)
    known = np.isfinite(slots)
    if not known.any():
        return Trace(column, rows, light, unknown, unknown, unknown)
    exposed = SlotLight(np.stack([np.where(known, slots, 0.0), known]).astype(np.float32)).mean_over(
        ((rows - clock.row0) / clock.rows_per_slot)[None], clock.exposure_slots
    )
    share = np.where(exposed[1] > _ALL, exposed[0], np.nan).astype(np.float64)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], slots == 1, [0]]))).reshape(-1, 2)
    spans = clock.row0 + edges * clock.rows_per_slot
    starts = np.flatnonzero(np.diff(clock.burst, prepend=-1)) * clock.packet_slots - clock.first_slot
    shown = [start for start in starts.tolist() if known[np.clip(start, 0, known.size - 1)]]
    borders = clock.row0 + (np.array(shown) + clock.exposure_slots / 2) * clock.rows_per_slot
    trace = Trace(column, rows, light, unknown, share, unknown, tuple(borders.tolist()), tuple(map(tuple, spans)))
    return _with_model(trace, clock.rows_per_slot)


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


def _column_light(profiles: RowProfiles, column: int) -> tuple[FloatArray, FloatArray]:
    """Sensor rows (n,) and mean light (n,) of one column, where it is on the screen."""
    inside = profiles.inside[column]
    on_screen = inside.any(axis=0)
    light = (profiles.light[column] * inside).sum(axis=0)[on_screen] / inside.sum(axis=0)[on_screen]
    rows = profiles.rows.astype(np.float64) if profiles.sensor_row is None else profiles.sensor_row[column].mean(axis=0)
    return rows[on_screen], light.astype(np.float64)
