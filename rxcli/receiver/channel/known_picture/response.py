"""Response of camera and compression to exposed slots, fitted in every frame."""

import numpy as np

from rxcli.numerics import TINY
from rxcli.receiver.channel.known_picture.exposure import Response
from rxcli.receiver.channel.known_picture.picture import ColumnLight
from rxcli.receiver.channel.known_picture.settings import SETTINGS
from rxcli.receiver.light import SlotLight
from rxcli.types import Float32Array, FloatArray

#: Approximate number of values from which a response is fitted; and the golden ratio, whose multiples are spread evenly
#: modulo 1.
_SAMPLES_OF_RESPONSE, _GOLDEN = 2000, 0.6180339887
#: Centre, side, offset and lateness of a response without blur.
_SHARP = np.array([1.0, 0.0, 0.0, 0.0])


def fit_response(observed: ColumnLight, lit: Float32Array, positions: FloatArray, exposure_slots: float) -> Response:
    """Fit the response of a frame by least squares over all columns, on a sufficient number of rows.

    Args:
        observed: the columns' light.
        lit: (C, N) probability that each slot is lit.
        positions: (C, R) or (1, R) exposure's centre of the rows, in slots.
        exposure_slots: exposure in slots.
    """
    every = max(positions.shape[1] * len(lit) / _SAMPLES_OF_RESPONSE, 1.0)
    step = np.arange(int(positions.shape[1] / every))
    # Not evenly spaced, so that the rows do not sample the same phase of every slot.
    rows = ((step + (step * _GOLDEN if every > 1 else 0) % 1) * every).astype(np.intp)
    some, side = positions[:, rows], SETTINGS.side_slots
    exposed = SlotLight(lit).mean_over(np.concatenate([some - side, some, some + side], axis=1), exposure_slots)
    before, here, after = np.split(exposed, 3, axis=1)
    # Centre, sides, offset and slope.
    parts = np.stack([here, before + after, np.ones_like(here), (after - before) * np.float32(0.5 / side)])
    parts = parts.reshape(len(parts), -1)
    value, precision = (values.take(rows, axis=1).ravel() for values in (observed.value, observed.precision))
    weighted = parts * precision
    weight = float(precision.sum()) + TINY
    normal, right = weighted @ parts.T / weight, weighted @ value / weight
    most = np.array(SETTINGS.max_response)
    # Regularised towards no blur.
    fitted = np.linalg.solve(normal + SETTINGS.response_ridge * np.eye(len(normal)), right - normal @ _SHARP)
    fitted[-1] /= max(1 + fitted[0] + 2 * fitted[1], 1 - most[0])
    return Response(*(_SHARP + np.clip(fitted, -most, most)).tolist())
