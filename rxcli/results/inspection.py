"""Light of a frame against its decided slots: the arrays of its stages, and the receiver's own light model of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from rxcli.receiver.channel import estimate_black_level
from rxcli.receiver.channel.picture import PictureSums, by_place, in_time, predict_picture
from rxcli.receiver.channel.settings import SETTINGS
from rxcli.receiver.light import Exposure, dark_sigma
from rxcli.receiver.sync.clock import sample_slots
from rxcli.types import BoolArray, Clock, ColumnResult, Float32Array, FloatArray, FrameResult, RowProfiles, SlotSamples

#: Samples of a slot, and slots over which one clock residual is measured.
PER_SLOT, _RESIDUAL_SLOTS = 10, 30
#: Bins of histogram and eye diagram; times of one slot before and after.
BINS, EYE_TIMES = 40, 2 * PER_SLOT
#: Light relative to that of a lit slot, from and to.
RANGE = (-0.4, 1.6)
#: Share of an exposure in decided slots from which a sample is compared with them.
_ALL = 0.999
#: Least standard deviation of a sample, 1 is white.
_MIN_SIGMA = 1e-4


@dataclass(frozen=True, slots=True)
class Trace:
    """One column's light in order of time, with what was decided."""

    column: ColumnResult
    #: (n,) sensor rows of the samples on the screen, and light there, 1 is white.
    rows: FloatArray
    light: FloatArray
    #: (n,) light predicted from the decided slots; NaN without decided slots.
    model: FloatArray
    #: (n,) share of the exposure in lit slots, 0..1, and light over the picture's own; NaN likewise.
    share: FloatArray
    relative: FloatArray
    #: Sensor rows on which decided packets start, and rows [from, to) of their lit slots.
    borders: FloatArray
    lit_spans: FloatArray


@dataclass(frozen=True, slots=True)
class Inspection:
    """All that is drawn of a frame beside its result."""

    rows_per_slot: float
    traces: tuple[Trace, ...]
    #: (2, BINS) samples of dark and of lit slots by their light, over RANGE.
    histogram: NDArray[np.int64]
    #: (BINS, EYE_TIMES) how often light and time within two slots meet.
    eye: NDArray[np.int64]
    #: (m, 2) sensor row and clock residual there, slots.
    residuals: FloatArray
    #: (C, 3) light of the left neighbour, the column itself, and the right one, shares; NaN where not measured.
    crosstalk: FloatArray


def inspect_frame(taps: Mapping[str, Any], result: FrameResult) -> Inspection:
    """Light of every column against its decided slots.

    Args:
        taps: arrays at the stage boundaries of the frame, see `receive`.
        result: what became of it.
    """
    clock: Clock = taps["clock"]
    columns = np.array([-1 - column.column if result.mirrored else column.column for column in result.columns])
    silent = np.array([not column.packets for column in result.columns])
    lit = np.where(silent[:, None], np.nan, _lit(taps, clock)[columns])
    samples = sample_slots(_profiles(taps), clock, PER_SLOT)
    black_level = estimate_black_level(samples, clock) or 0.0
    samples, exposure = samples.of_columns(columns), Exposure.of(clock.exposure_slots, PER_SLOT)
    mean = exposure.mean_light(np.nan_to_num(lit).astype(np.float32))
    known = exposure.mean_light(np.isfinite(lit).astype(np.float32)) > _ALL
    light, picture = _light_and_picture(samples, mean, known, black_level)
    share = np.where(np.isfinite(picture), mean, np.nan).astype(np.float64)
    relative = light / picture

    places = (np.arange(share.shape[1]) + 0.5) / PER_SLOT
    row0 = clock.row0 + clock.delay_slots[columns] * clock.rows_per_slot
    rows = row0[:, None] + places * clock.rows_per_slot
    by_column = np.stack([rows, light + black_level, picture * share + black_level, share, relative])
    starts = np.flatnonzero(np.diff(clock.burst, prepend=-1)) * clock.packet_slots - clock.first_slot
    traces = []
    for number, (column, slots, shown) in enumerate(
        zip(result.columns, lit, np.asarray(samples.valid.any(axis=1)), strict=True)
    ):
        begun = starts[np.isfinite(slots[np.clip(starts, 0, clock.n_slots - 1)])] + clock.exposure_slots / 2
        edges = np.flatnonzero(np.diff(slots == 1, prepend=False, append=False)).reshape(-1, 2)
        marks = (row0[number] + each * clock.rows_per_slot for each in (begun, edges))
        traces.append(Trace(column, *by_column[:, number, shown], *marks))
    bounded = np.clip(relative, *RANGE)
    return Inspection(
        clock.rows_per_slot,
        tuple(traces),
        np.stack([np.histogram(bounded[kind], BINS, RANGE)[0] for kind in (share < 0.05, share > 0.95)]),
        _eye(bounded, places - clock.exposure_slots / 2),
        _residuals(rows, relative, share),
        _crosstalk(traces),
    )


def _light_and_picture(
    samples: SlotSamples, mean: Float32Array, known: BoolArray, black_level: float
) -> tuple[FloatArray, FloatArray]:
    """(C, n) light over black, and the picture as the channel predicts it by the slots; NaN where it does not."""
    light = (samples.light - np.float32(black_level)) * samples.valid
    sums = PictureSums.of(
        *(by_place(each, PER_SLOT) for each in (light, mean[:, None], samples.valid * known[:, None]))
    )
    sigma = dark_sigma(light, samples.valid, 0.0, _MIN_SIGMA)
    prediction = predict_picture(sums, sigma**2, SETTINGS.picture_scales[-1:], one_sided=False)
    picture = in_time(prediction.at_samples(PER_SLOT)) * samples.valid
    light, picture = (each.sum(axis=1) / np.maximum(samples.valid.sum(axis=1), 1) for each in (light, picture))
    return light, np.where(known & (picture > sigma), picture, np.nan)


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
    unknown = np.full((len(taps["channel.llr"]), clock.packet_slots), np.nan, np.float32)
    bursts = [unknown if posteriors is None else np.round(posteriors.lit[0]) for posteriors in ended.values()]
    return np.asarray(clock.on_grid(np.stack(bursts)), np.float64)


def _eye(relative: FloatArray, places: FloatArray) -> NDArray[np.int64]:
    good = np.isfinite(relative)
    times = np.broadcast_to(places % 2, relative.shape)[good]
    return np.histogram2d(relative[good], times, (BINS, EYE_TIMES), (RANGE, (0, 2)))[0].astype(np.int64)


def _residuals(rows: FloatArray, relative: FloatArray, share: FloatArray) -> FloatArray:
    """(m, 2) row and how much later than the clock the light is there, slots: one Gauss-Newton step per window."""
    size = _RESIDUAL_SLOTS * PER_SLOT
    slope = np.gradient(share, 1 / PER_SLOT, axis=1)
    error = np.where(np.isfinite(slope), relative - share, np.nan)
    whole = rows.shape[1] // size * size
    rows, slope, error = (values[:, :whole].reshape(-1, size) for values in (rows, slope, error))
    power = np.nansum(slope**2, axis=1)
    good = (np.isfinite(error).sum(axis=1) > size / 2) & (power > 0)
    late = -np.nansum(slope * error, axis=1) / np.maximum(power, _MIN_SIGMA)
    return np.column_stack([rows.mean(axis=1)[good], late[good]])


def _crosstalk(traces: Sequence[Trace]) -> FloatArray:
    """How much of a column's light follows the slots of its neighbours: least squares on the rows that all show."""
    shares = np.full((len(traces), 3), np.nan)
    for number, trace in enumerate(traces):
        beside = [side for side in (0, 2) if 0 <= number + side - 1 < len(traces)]
        used = {1: trace.share} | {
            side: np.interp(trace.rows, neighbour.rows, neighbour.share, np.nan, np.nan)
            for side in beside
            if np.isfinite((neighbour := traces[number + side - 1]).share).any()
        }
        design = np.column_stack([*used.values(), np.ones(trace.rows.size)])
        good = np.isfinite(design).all(axis=1) & np.isfinite(trace.relative)
        if good.sum() >= 20 * design.shape[1]:
            shares[number, list(used)] = np.linalg.lstsq(design[good], trace.relative[good], rcond=None)[0][:-1]
    return shares
