"""What a camera and its compression make of exposed slots, fitted frame by frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.receiver.channel.known_picture.exposure import SIDE, Response, exposed
from rxcli.receiver.channel.known_picture.picture import ColumnLight
from rxcli.types import Float32Array, FloatArray, IntArray

#: What is possible of a response in the middle and at a side, and how much less is likelier.
_CENTRE, _AT_SIDE, _RIDGE = (0.3, 1.3), (-0.1, 0.35), 1e-4
#: Groups of rows by their precision, and the contrast that compression may leave of theirs.
_GROUPS, _GAIN = 8, (0.15, 1.3)
#: Steps of the table of what lies between the groups.
_TABLE = 256
#: Rows of columns, about, from which a response is measured, more would tell no more; and the golden ratio, whose
#: multiples fall evenly between whole numbers.
_SAMPLES_OF_RESPONSE, _GOLDEN = 5000, 0.6180339887
#: Largest correction of the clock at a time, slots.
_MAX_LATE = 0.4


@dataclass(frozen=True, slots=True)
class Exposures:
    """Exposed slots of some rows, from which a response is fitted; (C, n) each."""

    #: (n,) index of the rows.
    rows: IntArray
    here: Float32Array
    #: The sum of those a little before and after, and their slope.
    beside: Float32Array
    slope: Float32Array


def exposures(lit: Float32Array, positions: FloatArray, exposure_slots: float) -> Exposures:
    """Of as many rows as tell all there is to know of the response.

    Args:
        lit: (C, N) probability that each slot is lit.
        positions: (C, R) or (1, R) exposure's centre of the rows, in slots.
        exposure_slots: exposure in slots.
    """
    n_rows = positions.shape[1]
    every = max(n_rows * lit.shape[0] / _SAMPLES_OF_RESPONSE, 1.0)
    step = np.arange(int(n_rows / every))
    # Evenly spread, but not evenly spaced: the rows must not fall on the same part of every slot.
    rows = ((step + (step * _GOLDEN if every > 1 else 0) % 1) * every).astype(np.intp)
    some = positions[:, rows]
    before, here, after = (exposed(lit, some + shift, exposure_slots) for shift in (-SIDE, 0.0, SIDE))
    return Exposures(rows, here, before + after, (after - before) * np.float32(0.5 / SIDE))


@dataclass(frozen=True, slots=True)
class Fit:
    """A frame's response, fitted."""

    response: Response
    #: How many slots the clock is late, and how much later at the last row than halfway, as rows are that a camera has
    #: stretched after reading them.
    late: float
    drift: float


def fit_response(observed: ColumnLight, slots: Exposures) -> Fit:
    """The response of a frame by least squares over all columns.

    Args:
        observed: the columns' light.
        slots: what they should have seen.
    """
    value, precision = (values.take(slots.rows, axis=1).ravel() for values in (observed.value, observed.precision))
    down = np.linspace(-1, 1, slots.rows.size, dtype=np.float32)
    terms = [slots.here, slots.beside, np.ones_like(slots.here), slots.slope, slots.slope * down]
    parts = np.stack(terms).reshape(len(terms), -1)
    weighted = parts * precision
    weight = float(precision.sum()) + 1e-9
    normal, right = weighted @ parts.T / weight, weighted @ value / weight
    # Drawn, a little, to no blur.
    usual = np.array([1.0, 0.0, 0.0, 0.0, 0.0])
    fitted = usual + np.linalg.solve(normal + _RIDGE * np.eye(len(usual)), right - normal @ usual)
    centre, side, offset = (float(part) for part in fitted[:3])
    late, drift = np.clip(fitted[3:] / max(centre + 2 * side, 0.3), -_MAX_LATE, _MAX_LATE)
    response = Response(
        float(np.clip(centre, *_CENTRE)), float(np.clip(side, *_AT_SIDE)), float(np.clip(offset, -0.2, 0.2))
    )
    return Fit(response, float(late), float(drift))


def equalized(observed: ColumnLight, slots: Exposures) -> ColumnLight:
    """The light with its contrast put right: compression takes stripes away where they are faint, and only there.

    Rows are grouped by their precision; in each group the contrast that is left is measured against the slots.

    Args:
        observed: the columns' light.
        slots: what they should have seen.
    """
    half = np.float32(0.5)
    level = np.log(np.maximum(observed.precision, np.float32(1e-3)))
    some = level.take(slots.rows, axis=1).ravel()
    shown = np.flatnonzero(some > np.log(2e-3))
    if shown.size < 10 * _GROUPS:
        return observed
    size = shown.size // _GROUPS
    order = shown[np.argpartition(some[shown], size * np.arange(1, _GROUPS))][: size * _GROUPS]
    value = np.clip(observed.value.take(slots.rows, axis=1).ravel()[order] - half, -1.2, 1.2)
    here, beside = slots.here.ravel()[order] - half, slots.beside.ravel()[order] - 1
    model = np.stack([here, beside, np.ones_like(here)]).reshape(3, _GROUPS, size).transpose(1, 0, 2)
    normal = model @ model.transpose(0, 2, 1) / size + np.float32(1e-3) * np.eye(3, dtype=np.float32)
    right = model @ value.reshape(_GROUPS, size, 1) / size + np.float32(1e-3) * np.eye(3, 1, dtype=np.float32)
    centre, side, offset = np.linalg.solve(normal, right)[..., 0].T
    gain, middle = np.clip(centre + 2 * side, *_GAIN), np.median(some[order].reshape(_GROUPS, size), axis=1)
    gains, offsets = _interpolated(level, middle, gain, offset)
    return ColumnLight(
        (observed.value - half - offsets) / gains + half, observed.precision * gains * gains, observed.shrunk
    )


def _interpolated(level: Float32Array, at: FloatArray, *values: FloatArray) -> list[Float32Array]:
    """`values`, known at ascending levels, at every `level`: by a fine table, which is quicker than `np.interp`."""
    steps = np.linspace(at[0], at[-1], _TABLE)
    step = np.float32((_TABLE - 1) / max(at[-1] - at[0], 1e-6))
    place = np.clip((level - np.float32(at[0])) * step + np.float32(0.5), 0, _TABLE - 1).astype(np.intp)
    return [np.interp(steps, at, one).astype(np.float32).take(place) for one in values]
