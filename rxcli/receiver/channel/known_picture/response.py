"""Response of camera and compression to exposed slots, fitted in every frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rxcli.receiver.channel.known_picture.exposure import Response
from rxcli.receiver.channel.known_picture.picture import ColumnLight
from rxcli.receiver.channel.known_picture.settings import SETTINGS
from rxcli.receiver.light import SlotLight
from rxcli.types import Float32Array, FloatArray, IntArray

#: Approximate number of values from which a response is fitted; and the golden ratio, whose multiples are spread evenly
#: modulo 1.
_SAMPLES_OF_RESPONSE, _GOLDEN = 2000, 0.6180339887
#: (2, 4) lower and upper limits of centre, side, offset and lateness.
_BOUNDS = np.transpose(SETTINGS.response_bounds)


@dataclass(frozen=True, slots=True)
class Exposures:
    """Exposed slots of some rows, from which a response is fitted; (C, n) each."""

    #: (n,) index of the rows.
    rows: IntArray
    here: Float32Array
    #: Sum of the light half a slot before and after, and slope.
    beside: Float32Array
    slope: Float32Array


def exposures(lit: Float32Array, positions: FloatArray, exposure_slots: float) -> Exposures:
    """Compute exposed slots on a sufficient number of rows for fitting the response.

    Args:
        lit: (C, N) probability that each slot is lit.
        positions: (C, R) or (1, R) exposure's centre of the rows, in slots.
        exposure_slots: exposure in slots.
    """
    n_rows = positions.shape[1]
    every = max(n_rows * lit.shape[0] / _SAMPLES_OF_RESPONSE, 1.0)
    step = np.arange(int(n_rows / every))
    # Not evenly spaced, so that the rows do not sample the same phase of every slot.
    rows = ((step + (step * _GOLDEN if every > 1 else 0) % 1) * every).astype(np.intp)
    some, side = positions[:, rows], SETTINGS.side_slots
    exposed = SlotLight(lit).mean_over(np.concatenate([some - side, some, some + side], axis=1), exposure_slots)
    before, here, after = np.split(exposed, 3, axis=1)
    return Exposures(rows, here, before + after, (after - before) * np.float32(0.5 / side))


@dataclass(frozen=True, slots=True)
class Fit:
    """Fitted response of a frame."""

    response: Response
    #: Lateness of the clock, slots.
    late: float


def fit_response(observed: ColumnLight, slots: Exposures) -> Fit:
    """Fit the response of a frame by least squares over all columns.

    Args:
        observed: the columns' light.
        slots: exposed slots of the rows.
    """
    value, precision = (values.take(slots.rows, axis=1).ravel() for values in (observed.value, observed.precision))
    terms = [slots.here, slots.beside, np.ones_like(slots.here), slots.slope]
    parts = np.stack(terms).reshape(len(terms), -1)
    weighted = parts * precision
    weight = float(precision.sum()) + 1e-9
    normal, right = weighted @ parts.T / weight, weighted @ value / weight
    # Regularised towards no blur.
    fitted = np.linalg.solve(normal + SETTINGS.response_ridge * np.eye(len(normal)), right - normal[:, 0])
    fitted[0] += 1
    fitted[3] /= max(fitted[0] + 2 * fitted[1], SETTINGS.response_bounds[0][0])
    *response, late = np.clip(fitted, *_BOUNDS).tolist()
    return Fit(Response(*response), late)
