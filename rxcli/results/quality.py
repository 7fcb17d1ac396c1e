"""How well each column is driven, from its light about decided slots: levels, edges, jitter, signal to noise."""

from dataclasses import dataclass

import numpy as np

from rxcli.results.inspection import PER_SLOT, Inspection, Trace
from rxcli.types import FloatArray

#: Share of an exposure in lit slots up to which a sample is dark, and from which it is lit.
_DARK, _LIT = 0.05, 0.95
#: Share in the middle of an edge; one half is that of a sample, up to rounding.
_MIDDLE = 0.5 - 1e-4
#: Fewest samples of a level, and edges of a mean edge.
_MIN_SAMPLES, _MIN_EDGES = 10, 4


@dataclass(frozen=True, slots=True)
class Quality:
    """Figures of one column; NaN where too few slots show them."""

    column: int
    #: Light of lit slots, 1 is white.
    brightness: float
    #: (lit - dark) / (lit + dark).
    contrast: float
    #: Step from dark to lit over the standard deviation of either.
    snr_db: float
    #: Levels of the second slot of a pair relative to a lit one: dark after dark, dark after lit, and so on.
    dark_after_dark: float
    dark_after_lit: float
    lit_after_dark: float
    lit_after_lit: float
    #: From 10 to 90 % of an edge, the exposure included, and standard deviation of the edges' times.
    rise_s: float
    fall_s: float
    jitter_s: float


def qualities(known: Inspection, slot_s: float) -> list[Quality]:
    """Figures of every column with decided slots.

    Args:
        known: light and slots of the columns.
        slot_s: duration of a slot.
    """
    return [_quality(trace, slot_s) for trace in known.traces if np.isfinite(trace.share).any()]


def _quality(trace: Trace, slot_s: float) -> Quality:
    share, light = trace.share, trace.relative
    is_lit, is_dark = share > _LIT, share < _DARK
    lit, dark = _level(light[is_lit]), _level(light[is_dark])
    noise = float(np.sqrt((np.nanvar(light[is_lit]) + np.nanvar(light[is_dark])) / 2)) if lit > dark else np.nan
    settled = (light - dark) / (lit - dark)
    rise_s, early = _edges(settled, share, slot_s)
    fall_s, late = _edges(1 - settled, 1 - share, slot_s)
    times = np.concatenate([early, late])
    return Quality(
        trace.column.column,
        _level(trace.light[is_lit]),
        (lit - dark) / (lit + dark),
        20 * float(np.log10((lit - dark) / noise)),
        _level(light[PER_SLOT:][is_dark[PER_SLOT:] & is_dark[:-PER_SLOT]]),
        _level(light[PER_SLOT:][is_dark[PER_SLOT:] & is_lit[:-PER_SLOT]]),
        _level(light[PER_SLOT:][is_lit[PER_SLOT:] & is_dark[:-PER_SLOT]]),
        _level(light[PER_SLOT:][is_lit[PER_SLOT:] & is_lit[:-PER_SLOT]]),
        rise_s,
        fall_s,
        float(np.std(times)) if times.size >= _MIN_EDGES else np.nan,
    )


def _level(light: FloatArray) -> float:
    return float(np.nanmean(light)) if np.isfinite(light).sum() >= _MIN_SAMPLES else np.nan


def _edges(light: FloatArray, share: FloatArray, slot_s: float) -> tuple[float, FloatArray]:
    """Duration of the mean rising edge, and (k,) how much later than it each edge is, seconds."""
    at = np.flatnonzero(np.diff((share > _MIDDLE).astype(int)) == 1) + 1
    at = at[(at >= PER_SLOT) & (at < share.size - PER_SLOT)]
    at = at[(share[at - PER_SLOT] < _DARK) & (share[at + PER_SLOT - 1] > _LIT)]
    edges = light[at[:, None] + np.arange(-PER_SLOT, PER_SLOT)]
    edges = edges[np.isfinite(edges).all(axis=1)]
    if len(edges) < _MIN_EDGES:
        return np.nan, np.empty(0)
    mean, sample_s = edges.mean(axis=0), slot_s / PER_SLOT
    # Outwards from the middle, so that noise of the levels is none of the edge.
    lower, upper = np.minimum.accumulate(mean[:PER_SLOT][::-1])[::-1], np.maximum.accumulate(mean[PER_SLOT:])
    start, end = np.interp((0.1, 0.9), np.concatenate([lower, upper]), np.arange(mean.size))
    slope = np.gradient(mean)
    return float(end - start) * sample_s, (mean - edges) @ slope / (slope @ slope) * sample_s
