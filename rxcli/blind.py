"""What a picture says of the camera that took it: rows per slot, direction of readout, exposure, bend of the stripes.

Four steps on the row profiles, none of which needs to know the camera.

1. **Bend.** Neighbouring strips show the same slots, so the lag between them, over all of the picture, is the slope of
   the stripes. Where a camera has taken the distortion out of its picture, the sensor row of a point p is the y of
   K distort(K^-1 p); with any focal length in K the same map comes out for other coefficients, so that one width is
   taken and k1 k2 p1 p2 are what is sought.
2. **Scan.** Light between its local extremes, averaged over columns, shows the header wherever a packet starts; and a
   packet sent again shows in every column's autocorrelation. Both are looked up over a grid of rows per slot for each
   length of packet. The header read backwards, 1100011100, is its own complement, so the sign tells the direction.
3. **Trial.** The best hypotheses are sliced into slots; header, dimming symbol and the constant weight of all symbols
   decide between them: a wrong one may show a header by chance, but never twenty columns of constant weight.
4. **Refinement.** The slots of the winner, seen through the exposure, predict the light of every strip on every row.
   What is missing is the derivative with respect to time: least squares over all strips gives row and period of the
   clock and the bend at once, with standard deviations from the spread between columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rxcli.profiles import CameraProfile, LensModel, ReadoutMode, ScreenProfile
from rxcli.protocol import HEADER, PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, WEIGHTS
from rxcli.types import BoolArray, Clock, Float32Array, FloatArray, Lens, RowProfiles

#: Rows per slot that are considered.
MIN_ROWS_PER_SLOT, MAX_ROWS_PER_SLOT = 1.2, 60.0

#: Scale of the coefficients k1 k2 p1 p2 for a focal length of one picture width, as a camera may have them.
_BEND_SCALE = np.array([0.3, 0.6, 1.5e-3, 1.5e-3])
#: Strips that a column keeps while its camera is unknown.
_STRIPS = 4
#: Distances of compared strips, in columns; a column's light reaches over its neighbours.
_BEND_DISTANCES = (0.5, 1.0, 2.0)
_BEND_PRECISION = np.concatenate([[0.0, 0.0], _BEND_SCALE**-2])
#: Samples of a slot and strips of a column err alike: so many of them say what one would.
_ALIKE = 10.0
#: Lags looked at, rows; windows of rows; rows over which light is levelled.
_BEND_LAGS, _BEND_WINDOWS, _BEND_LEVEL_ROWS = 24, 20, 100
#: Samples a slot while the clock is sought.
_SAMPLES = 4
#: Rows per slot, at one octave's reduction, that its window of this many reduced rows serves.
_OCTAVE, _OCTAVE_ROWS = (2.4, 4.8), 76
#: Lag, in slots, at which a column is half as like itself: from short exposures to those of three slots.
_HALF_WIDTH = (0.5, 1.8)
#: Copies further apart than this many slots are not compared: the grid of rows per slot would have to be too fine.
_SCAN_SLOTS = 700
#: Rows per slot this close, relative, are one hypothesis.
_ALIKE_ROWS = 0.015
#: Hypotheses that are tried.
_TRIALS = 24
#: Any window of this many slots holds a lit and a dark one.
_EXTREMES_SLOTS = 19
#: Most that repeated packets count, nats.
_MOST_FOR_REPEATS = 40.0
#: Log-likelihood ratio of header and weights, over chance, that a clock must reach.
MIN_EVIDENCE = 30.0


@dataclass(frozen=True, slots=True)
class Strips:
    """Light of M strips on R rows in readout order; the columns' strips lie side by side."""

    #: (M, R) float32: light; and 1 where it is on the screen, else 0.
    light: Float32Array
    inside: Float32Array
    #: (M, R) float64: picture x of the strip's middle.
    x: FloatArray
    #: (R,) float64: rows counted in readout order from the picture's first one read.
    rows: FloatArray
    n_columns: int
    #: Standard deviation of a strip's row of no light.
    sigma: float
    #: Size of the picture.
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A clock that a picture may show."""

    rows_per_slot: float
    packet_slots: int
    #: Where a header starts: rows from the upper edge of the first of the strips' rows, in readout order.
    start_row: float
    #: True where the picture's rows run against the readout.
    reversed: bool
    #: Log-likelihood ratio of header and weights over chance; of the scan while it was not tried.
    evidence: float


@dataclass(frozen=True, slots=True)
class BlindEstimate:
    """What was estimated of a camera, with standard deviations."""

    rows_per_slot: float
    rows_per_slot_sd: float
    packet_slots: int
    reversed: bool
    exposure_slots: float
    exposure_slots_sd: float
    #: (4,) k1 k2 p1 p2 for a focal length of one picture width, of a picture that was corrected in the camera.
    bend: FloatArray
    bend_sd: FloatArray
    #: True where the stripes are bent beyond doubt.
    corrected: bool
    #: Log-likelihood ratio of header and weights over chance.
    evidence: float
    #: Share of the local variance of the light that the slots explain.
    explained: float


def strips_of(profiles: RowProfiles, centre_x: FloatArray, width: int, height: int) -> Strips:
    """Strips for the functions below, from row profiles that were sampled without a lens.

    Args:
        profiles: C columns, S strips, R rows; `sensor_row` None.
        centre_x: (C*S, R) picture x of the strips' middles.
        width: of the picture, pixels.
        height: of the picture, rows.
    """
    n_columns, n_strips, n_rows = profiles.light.shape
    join = n_strips // _STRIPS if n_strips % _STRIPS == 0 else 1
    shape = (n_columns * n_strips // join, join, n_rows)
    inside = profiles.inside.reshape(shape).astype(np.float32).min(axis=1)
    sigma = np.sqrt(profiles.noise_floor / max(float(np.median(profiles.count)), 1.0) / join)
    return Strips(
        light=profiles.light.reshape(shape).mean(axis=1) * inside,
        inside=inside,
        x=centre_x.reshape(shape).mean(axis=1),
        rows=profiles.rows.astype(np.float64),
        n_columns=n_columns,
        sigma=float(sigma),
        width=width,
        height=height,
    )


def in_readout_order(strips: Strips) -> Strips:
    """The strips of a picture whose rows run against the readout, in readout order; its own inverse."""
    return replace(
        strips,
        light=np.ascontiguousarray(strips.light[:, ::-1]),
        inside=np.ascontiguousarray(strips.inside[:, ::-1]),
        x=np.ascontiguousarray(strips.x[:, ::-1]),
        rows=strips.height - 1 - strips.rows[::-1],
    )


def _reversed_bend(bend: FloatArray) -> FloatArray:
    """The coefficients of the same bend with rows counted from the other end."""
    return np.asarray(bend * np.array([1.0, 1.0, -1.0, 1.0]))


# Bend -----------------------------------------------------------------------------------------------------------------


def bend_terms(x: FloatArray, rows: FloatArray, width: int, height: int) -> FloatArray:
    """Rows that a unit of k1, k2, p1, p2 moves the sensor row of a point, for a focal length of one width.

    Args:
        x: (...) picture x.
        rows: (...) picture rows, broadcast against `x`.
        width: of the picture.
        height: of the picture.

    Returns:
        (4, ...) float64.
    """
    across, down = np.broadcast_arrays((x - (width - 1) / 2) / width, (rows - (height - 1) / 2) / width)
    square = across**2 + down**2
    return width * np.stack([down * square, down * square**2, square + 2 * down**2, 2 * across * down])


def estimate_bend(strips: Strips) -> tuple[FloatArray, float]:
    """The bend whose sensor rows make neighbouring strips most alike.

    Returns:
        (4,) k1 k2 p1 p2 for a focal length of one width; and how much better it fits than none, nats.
    """
    lags = [_lag_correlations(strips, distance) for distance in _distances(strips)]
    total = sum(float(correlation[_BEND_LAGS].sum()) for correlation, _ in lags)
    if not lags or total <= 0:
        return np.zeros(4), 0.0
    # The sum of correlations is worth about this many nats: rows times strips, many of which say the same.
    weight = 4000.0 / total
    k1, share = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.4, 0.4, 25), [0.0, 0.8, 1.8]))
    guesses = np.stack([k1, -share * k1, 0 * k1, 0 * k1], axis=1)
    scores = [_likeness(guess, lags[-1:], weight) for guess in guesses]
    found = _climb(guesses[int(np.argmax(scores))], lags, weight)
    return found, _likeness(found, lags, weight) - _likeness(np.zeros(4), lags, weight)


def _distances(strips: Strips) -> list[int]:
    per_column = strips.light.shape[0] // strips.n_columns
    steps = {max(1, round(distance * per_column)) for distance in _BEND_DISTANCES}
    return sorted(step for step in steps if step < strips.light.shape[0])


def _lag_correlations(strips: Strips, distance: int) -> tuple[Float32Array, FloatArray]:
    """Correlation of strips `distance` apart by lag, strip and window of rows; and what lag a unit of bend makes.

    Returns:
        (lags, strips, windows) float32; (4, strips, windows) float64 rows.
    """
    n_rows = strips.light.shape[1]
    level = _levelled(strips.light, strips.inside, _BEND_LEVEL_ROWS, strips.sigma)[0]
    borders = np.linspace(_BEND_LAGS, n_rows - _BEND_LAGS, _BEND_WINDOWS + 1).astype(int)
    middles = (borders[1:] + borders[:-1]) // 2
    rows, x = strips.rows[middles], strips.x[:, middles]
    terms = bend_terms(x, rows, strips.width, strips.height)
    left, right = level[:-distance], level[distance:]
    inner = left[:, _BEND_LAGS : n_rows - _BEND_LAGS]
    out = np.empty((2 * _BEND_LAGS + 1, left.shape[0], _BEND_WINDOWS), np.float32)
    for number, lag in enumerate(range(-_BEND_LAGS, _BEND_LAGS + 1)):
        product = inner * right[:, _BEND_LAGS - lag : n_rows - _BEND_LAGS - lag]
        out[number] = np.add.reduceat(product, borders[:-1] - _BEND_LAGS, axis=1)
    return out, terms[:, distance:] - terms[:, :-distance]


def _at_lag(correlation: Float32Array, lag: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Correlation at fractional lags with first and second derivative, by a Catmull-Rom cubic."""
    place = np.clip(lag + (correlation.shape[0] - 1) / 2, 1, correlation.shape[0] - 2.001)
    low = place.astype(np.int64)
    f = place - low
    a, b, c, d = (np.take_along_axis(correlation, (low + k)[None], 0)[0].astype(np.float64) for k in (-1, 0, 1, 2))
    linear, square, cubic = (c - a) / 2, a - 2.5 * b + 2 * c - 0.5 * d, 1.5 * (b - c) + 0.5 * (d - a)
    value = b + f * (linear + f * (square + f * cubic))
    return value, linear + f * (2 * square + 3 * f * cubic), a - 2 * b + c


def _likeness(bend: FloatArray, lags: list[tuple[Float32Array, FloatArray]], weight: float) -> float:
    total = sum(float(_at_lag(c, np.tensordot(bend, terms, 1))[0].sum()) for c, terms in lags)
    return weight * total - 0.5 * float(((bend / _BEND_SCALE) ** 2).sum())


def _climb(bend: FloatArray, lags: list[tuple[Float32Array, FloatArray]], weight: float, steps: int = 8) -> FloatArray:
    """Newton's method on the likeness, with the prior of `_BEND_SCALE`; never downhill."""
    best, score = bend, _likeness(bend, lags, weight)
    step = 1.0
    for _ in range(steps):
        gradient, hessian = -best / _BEND_SCALE**2, np.diag(1 / _BEND_SCALE**2)
        for correlation, terms in lags:
            _, slope, curvature = _at_lag(correlation, np.tensordot(best, terms, 1))
            flat = terms.reshape(4, -1)
            gradient = gradient + weight * flat @ slope.ravel()
            hessian = hessian + weight * (flat * np.maximum(-curvature, 0).ravel()) @ flat.T
        trial = best + step * np.linalg.solve(hessian, gradient)
        trial_score = _likeness(trial, lags, weight)
        if trial_score > score:
            best, score = trial, trial_score
        else:
            step /= 2
    return best


def _levelled(
    light: Float32Array, inside: Float32Array, window: int, sigma: float
) -> tuple[Float32Array, Float32Array]:
    """Light against mean and spread of the `window` rows around it; and the weight behind it, 0..1."""
    import cv2

    size = (window | 1, 1)
    share = cv2.blur(inside, size) + np.float32(1e-3)
    mean = cv2.blur(light, size) / share
    variance = np.maximum(cv2.blur(light * light, size) / share - mean * mean, 0)
    level = np.clip((light - mean) / np.sqrt(variance + np.float32(9 * sigma**2)), -3, 3) * inside
    return level, variance / (variance + np.float32(16 * sigma**2)) * inside


def straightened(strips: Strips, bend: FloatArray) -> Strips:
    """The strips read along the bent stripes: every row of the result is one sensor row."""
    if not bend.any():
        return strips
    moved = np.tensordot(bend, bend_terms(strips.x, strips.rows, strips.width, strips.height), 1)
    index = np.arange(strips.rows.size)
    # Row r shows sensor row r + moved(r); sensor row s is found at s - moved(s), to first order of a small slope.
    back = np.take_along_axis(moved, np.clip(np.rint(index - moved), 0, index[-1]).astype(np.int64), 1)
    place = np.clip(index - back, 0, index[-1] - 1e-6)
    low = place.astype(np.int64)
    f = (place - low).astype(np.float32)
    light = _between(strips.light, low, f)
    inside = (_between(strips.inside, low, f) > 0.99) & (np.abs(index - back - place) < 0.5)
    return replace(strips, light=light * inside, inside=inside.astype(np.float32))


def _between(values: Float32Array, low: NDArray[np.int64], f: Float32Array) -> Float32Array:
    below, above = (
        np.take_along_axis(values, low, 1),
        np.take_along_axis(values, np.minimum(low + 1, values.shape[1] - 1), 1),
    )
    return np.asarray(below + (above - below) * f, np.float32)


#: Steps of the header, dark before and after.
_HEADER_STEPS = np.diff(np.concatenate([[0.0], 2.0 * np.array(HEADER) - 1, [0.0]]))

# Scan -----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Octave:
    """Columns between their local extremes, reduced by a power of two, for an octave of rows per slot."""

    #: (C, R') float32.
    columns: Float32Array
    #: Rows of one reduced row.
    rows: int
    #: Rows per slot that it serves.
    low: float
    high: float
    #: (R',) deviation of the autocorrelation at every lag from chance, in standard deviations.
    repeats: FloatArray


def _octaves(strips: Strips) -> list[_Octave]:
    """All octaves whose slots, by the columns' autocorrelation at short lags, may be of its length."""
    out = []
    light, inside, rows = strips.light, strips.inside, 1
    low, high = _OCTAVE
    bounds = [(1, MIN_ROWS_PER_SLOT, low)]
    while low * (1 << (len(bounds) - 1)) < MAX_ROWS_PER_SLOT:
        reduce = 1 << (len(bounds) - 1)
        bounds.append((reduce, low * reduce, min(high * reduce, MAX_ROWS_PER_SLOT)))
    for reduce, least, most in bounds:
        if reduce > rows:
            light, inside, rows = _halved(light), _halved(inside), reduce
        if light.shape[1] * rows < 2 * PREAMBLE_SLOTS * least:
            break
        window = round(_OCTAVE_ROWS * most / (_OCTAVE[1] * rows))
        noise = strips.sigma / np.sqrt(rows)
        columns = _pooled(light, (inside > 0.99).astype(np.float32), window, noise, strips.n_columns)
        correlation = _autocorrelation(columns)
        width = _half_width(correlation) * rows
        least, most = max(least, width / _HALF_WIDTH[1]), min(most, width / _HALF_WIDTH[0])
        if least < most:
            out.append(
                _Octave(columns, rows, least, most, _surprise(correlation, round(PREAMBLE_SLOTS * least / rows)))
            )
    return out


def _halved(values: Float32Array) -> Float32Array:
    even = values.shape[1] // 2 * 2
    return np.asarray((values[:, 0:even:2] + values[:, 1:even:2]) / 2, np.float32)


def _pooled(light: Float32Array, inside: Float32Array, window: int, sigma: float, n_columns: int) -> Float32Array:
    """(C, R) mean of the levelled strips of each column, small where little light is behind it."""
    level, weight = _levelled(light, inside, window, sigma)
    total = weight.reshape(n_columns, -1, weight.shape[1]).sum(axis=1)
    summed = (level * weight).reshape(n_columns, -1, weight.shape[1]).sum(axis=1)
    return np.asarray(summed / (total + 0.01) * (total / (total + 1)), np.float32)


def _autocorrelation(columns: Float32Array) -> FloatArray:
    """(R,) sum over columns of the product with the same column later."""
    n = columns.shape[1]
    size = 1 << int(np.ceil(np.log2(2 * n)))
    spectrum = np.fft.rfft(columns, size, axis=1)
    return np.asarray(np.fft.irfft((spectrum * spectrum.conj()).real.sum(axis=0), size)[:n])


def _half_width(correlation: FloatArray) -> float:
    """Lag at which the correlation falls to half of that at the shortest lag."""
    top = correlation[1] if correlation.size > 2 else 0.0
    below = np.flatnonzero(correlation[1:] < top / 2)
    if top <= 0 or below.size == 0:
        return 0.0
    lag = int(below[0]) + 1
    return float(lag - (top / 2 - correlation[lag]) / max(correlation[lag - 1] - correlation[lag], 1e-12))


def _surprise(correlation: FloatArray, shortest: int) -> FloatArray:
    n = correlation.size
    scaled = correlation / np.sqrt(np.arange(n, 0, -1))
    part = scaled[min(shortest, n // 2) : max(n - 10, n // 2 + 1)]
    middle = float(np.median(part))
    spread = 1.4826 * float(np.median(np.abs(part - middle))) + 1e-9
    out = np.maximum(scaled - middle, 0) / spread
    out[-10:] = 0
    return np.asarray(out)


def _header_response(total: FloatArray, rows_per_slot: float) -> FloatArray:
    """Correlation with a header that starts at each quarter of a slot, the first one a header's length before row 0.

    Args:
        total: (R + 1,) running sum of the columns' mean.
        rows_per_slot: rows a slot.

    Returns:
        (2, n): of the light as it is, and of its negative, which shows the header read backwards.
    """
    lead = SLOTS_PER_SYMBOL * _SAMPLES
    starts = int((total.size - 1) / rows_per_slot * _SAMPLES) + lead
    grid = np.arange(-lead, starts + 1) * (rows_per_slot / _SAMPLES)
    summed = np.interp(grid, np.arange(total.size), total)
    out = np.zeros(starts)
    for edge in np.flatnonzero(_HEADER_STEPS):
        out -= _HEADER_STEPS[edge] * summed[edge * _SAMPLES : edge * _SAMPLES + starts]
    out /= SLOTS_PER_SYMBOL * rows_per_slot
    return np.stack([out, -out])


def _comb(response: FloatArray, packet_slots: int) -> tuple[FloatArray, NDArray[np.int64]]:
    """Best sums of responses (k, n) over copies of a packet, over the root of their number; and their samples, (k,)."""
    n_signs, n = response.shape
    period, lead = packet_slots * _SAMPLES, SLOTS_PER_SYMBOL * _SAMPLES
    folded = np.zeros((n_signs, -(-n // period) * period))
    folded[:, lead : n - lead] = response[:, lead : n - lead]
    phase = np.arange(period)
    count = (n - lead - 1 - phase) // period - (lead - 1 - phase) // period
    score = folded.reshape(n_signs, -1, period).sum(axis=1) / np.sqrt(np.maximum(count, 1))
    best = score.argmax(axis=1)
    return score[np.arange(n_signs), best], best


def find_clocks(strips: Strips, packet_lengths: Sequence[int]) -> list[Hypothesis]:
    """Clocks that the picture may show, best first.

    Args:
        strips: straightened strips.
        packet_lengths: slots of a packet, of every screen in question.
    """
    octaves = _octaves(strips)
    found = [(h, o) for o in octaves for h in _scan_octave(o, strips.rows.size, packet_lengths)]
    found.sort(key=lambda pair: -pair[0].evidence)
    distinct: list[tuple[Hypothesis, _Octave]] = []
    for one, octave in found:
        if len(distinct) < _TRIALS and not any(_alike(one, other) for other, _ in distinct):
            distinct.append((one, octave))
    return sorted((_try(*pair) for pair in distinct), key=lambda hypothesis: -hypothesis.evidence)


def _alike(one: Hypothesis, other: Hypothesis) -> bool:
    return one.packet_slots == other.packet_slots and _same_slots(one, other)


def _scan_octave(octave: _Octave, n_rows: int, packet_lengths: Sequence[int]) -> list[Hypothesis]:
    import cv2

    out = []
    total = _running_mean_sum(octave)
    rows_per_slot = octave.low
    around = np.ones((1, 2 * _SAMPLES + 1), np.uint8)
    while rows_per_slot < octave.high:
        response = _header_response(total, rows_per_slot / octave.rows)
        spread = 1.4826 * float(np.median(np.abs(response[0]))) + 1e-6
        # The largest response within a slot: the grid may then miss copies by a slot.
        near = cv2.dilate(response, around)
        for packet_slots in packet_lengths:
            repeats = _repeats_near(octave, rows_per_slot, packet_slots)
            for number, (score, sample) in enumerate(zip(*_comb(near, packet_slots), strict=True)):
                start = (float(sample) / _SAMPLES - SLOTS_PER_SYMBOL) * rows_per_slot
                evidence = float(score / spread) ** 2 + repeats**2
                out.append(Hypothesis(rows_per_slot, packet_slots, start, number == 1, evidence))
        rows_per_slot *= 1 + 2.0 / min(n_rows / rows_per_slot, _SCAN_SLOTS)
    return out


def _running_mean_sum(octave: _Octave) -> FloatArray:
    mean = octave.columns.mean(axis=0).astype(np.float64)
    return np.concatenate([[0.0], np.cumsum(mean)])


def _repeats_near(octave: _Octave, rows_per_slot: float, packet_slots: int) -> float:
    """Surprise of the autocorrelation at lags within a slot of one packet."""
    lag, slot = rows_per_slot * packet_slots / octave.rows, max(rows_per_slot / octave.rows, 1.0)
    return float(octave.repeats[int(lag - slot) : int(lag + slot) + 2].max(initial=0.0))


# Trial ----------------------------------------------------------------------------------------------------------------


def _try(hypothesis: Hypothesis, octave: _Octave) -> Hypothesis:
    """The hypothesis with the clock that fits best thereabouts, and the evidence of its slots."""
    fine = _fine_clock(hypothesis, octave)
    columns = octave.columns[:, ::-1] if fine.reversed else octave.columns
    rows_per_slot = fine.rows_per_slot / octave.rows
    start = fine.start_row / octave.rows
    if fine.reversed:
        start = columns.shape[1] - start - SLOTS_PER_SYMBOL * rows_per_slot
    before = int(start // rows_per_slot)
    first = start - before * rows_per_slot
    borders = np.arange(first, columns.shape[1], rows_per_slot)
    total = np.concatenate([np.zeros((columns.shape[0], 1)), np.cumsum(columns, axis=1)], axis=1)
    evidence = structure_evidence(_slot_means(total, borders), -before % fine.packet_slots, fine.packet_slots)
    return replace(fine, start_row=start * octave.rows, evidence=evidence)


def _slot_means(total: FloatArray, borders: FloatArray) -> FloatArray:
    """(C, N) means between borders, from (C, R + 1) running sums."""
    place = np.clip(borders, 0, total.shape[1] - 1 - 1e-9)
    low = place.astype(np.int64)
    at = total[:, low] + (total[:, low + 1] - total[:, low]) * (place - low)
    return np.asarray(np.diff(at, axis=1) / np.maximum(np.diff(place), 1e-6))


def _fine_clock(hypothesis: Hypothesis, octave: _Octave) -> Hypothesis:
    """The clock near the hypothesis with the highest header peaks."""
    total = _running_mean_sum(octave)
    sign = int(hypothesis.reversed)
    n_rows = octave.columns.shape[1] * octave.rows
    step = 0.3 / min(n_rows / hypothesis.rows_per_slot, _SCAN_SLOTS)
    best, best_score = hypothesis, -np.inf
    for rows_per_slot in hypothesis.rows_per_slot * (1 + step * np.arange(-8, 9)):
        response = _header_response(total, rows_per_slot / octave.rows)[sign : sign + 1]
        (score,), (sample,) = _comb(response, hypothesis.packet_slots)
        score += 0.03 * _repeats_at(octave, rows_per_slot, hypothesis.packet_slots)
        if score > best_score:
            start = (float(sample) / _SAMPLES - SLOTS_PER_SYMBOL) * rows_per_slot
            best = replace(hypothesis, rows_per_slot=float(rows_per_slot), start_row=float(start))
            best_score = score
    return best


def _repeats_at(octave: _Octave, rows_per_slot: float, packet_slots: int) -> float:
    lag = rows_per_slot * packet_slots / octave.rows
    return float(np.interp(lag, np.arange(octave.repeats.size), octave.repeats, right=0.0))


def structure_evidence(slots: FloatArray | Float32Array, first_slot: int, packet_slots: int) -> float:
    """Log-likelihood ratio of slots being packets, over slots lit at random.

    Headers must read 0011100011, and every other symbol of a column must have the same number of lit slots; a column
    may be too dark to say anything. A packet may come again.

    Args:
        slots: (C, N) light of every slot, any scale.
        first_slot: position of slot 0 in its packet.
        packet_slots: slots of a packet.
    """
    n_columns, n = slots.shape
    if n < _EXTREMES_SLOTS:
        return -np.inf
    lit = _sliced(slots)
    position = (np.arange(n) + first_slot) % packet_slots
    in_header = position < SLOTS_PER_SYMBOL
    agree = lit[:, in_header] == np.array(HEADER, bool)[position[in_header]]
    header = agree.sum(axis=1) * np.log(0.9 / 0.1) + in_header.sum() * np.log(0.1 / 0.5)
    starts: NDArray[np.int64] = np.flatnonzero((position % SLOTS_PER_SYMBOL == 0) & ~in_header)
    starts = starts[starts + SLOTS_PER_SYMBOL <= n]
    symbols: BoolArray = lit[:, starts[:, None] + np.arange(SLOTS_PER_SYMBOL)]
    count = np.count_nonzero(symbols, axis=2)
    weight = _weight_evidence(count, lit.mean(axis=1))
    dimming = _dimming_evidence(lit, position)
    best = (weight + dimming).max(axis=1)
    columns = float(np.logaddexp(header + best, 0.0).sum() - n_columns * np.log(2.0))
    return columns + _repeat_evidence(lit, position, packet_slots)


def _repeat_evidence(lit: BoolArray, position: NDArray[np.int64], packet_slots: int) -> float:
    """Log-likelihood ratio of copies being followed by the same packet, over other packets; bursts may end anywhere."""
    payload: NDArray[np.int64] = np.flatnonzero(position[: max(position.size - packet_slots, 0)] >= PREAMBLE_SLOTS)
    if payload.size == 0:
        return 0.0
    share = np.clip(lit.mean(axis=1, keepdims=True), 0.1, 0.9)
    chance = share**2 + (1 - share) ** 2
    same = lit[:, payload] == lit[:, payload + packet_slots]
    # Errors come in runs and columns share light: a third of the slots' say.
    ratio = np.where(same, np.log(0.92 / chance), np.log(0.08 / (1 - chance))).sum(axis=0) / 3
    copy = np.cumsum(np.diff(position[payload], prepend=position[payload[0]]) < 0)
    by_copy = np.bincount(copy, ratio)
    # Half the rows per slot repeat as well, with twice the slots: this may decide a draw, no more.
    return min(float(np.logaddexp(by_copy + np.log(2 / 3), np.log(1 / 3)).sum()), _MOST_FOR_REPEATS)


def _sliced(slots: FloatArray | Float32Array) -> BoolArray:
    """Whether every slot is nearer to the lightest or to the darkest of those around it."""
    windows = np.pad(slots, ((0, 0), (_EXTREMES_SLOTS // 2, _EXTREMES_SLOTS // 2)), mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(windows, _EXTREMES_SLOTS, axis=1)
    return np.asarray(slots > (around.max(axis=2) + around.min(axis=2)) / 2)


def _weight_evidence(count: NDArray[np.int64], share: FloatArray) -> FloatArray:
    """(C, 9) log-likelihood ratio of every weight for the lit slots (C, n) of symbols, over chance."""
    weights = np.arange(SLOTS_PER_SYMBOL + 1)
    off = np.abs(weights[:, None] - np.array(WEIGHTS))
    likely = np.select([off == 0, off == 1, off == 2], [0.72, 0.1, 0.02], 0.005)
    p = np.clip(share, 0.1, 0.9)[:, None]
    ways = np.array([1, 10, 45, 120, 210, 252, 210, 120, 45, 10, 1])
    chance = ways * p**weights * (1 - p) ** (SLOTS_PER_SYMBOL - weights)
    seen = (count[..., None] == weights).sum(axis=1)
    return np.asarray(seen @ np.log(likely) - (seen * np.log(chance)).sum(axis=1, keepdims=True) - np.log(len(WEIGHTS)))


def _dimming_evidence(lit: BoolArray, position: NDArray[np.int64]) -> FloatArray:
    """(C, 9) log-likelihood ratio of the dimming symbols' slots for every weight, over chance."""
    inside = (position >= SLOTS_PER_SYMBOL) & (position < PREAMBLE_SLOTS)
    expected = position[inside] - SLOTS_PER_SYMBOL < np.array(WEIGHTS)[:, None]
    agree = (lit[:, None, inside] == expected).sum(axis=2)
    n = int(inside.sum())
    return np.asarray(agree * np.log(0.9 / 0.5) + (n - agree) * np.log(0.1 / 0.5))


# Refinement -----------------------------------------------------------------------------------------------------------

#: Exposures that are compared, slots.
_EXPOSURES = np.array([0.15, 0.3, 0.45, 0.6, 0.8, 1.0, 1.2, 1.4, 1.7, 2.0, 2.35, 2.7, 3.1])
#: Slots over which the light of a strip may be taken as constant.
_LOCAL_SLOTS = 15
_REFINE_STEPS = 8
#: Steps at which the exposure is estimated.
_EXPOSURE_STEPS = (1, 3)
#: The descent ends when no row moves by more slots than this.
_CONVERGED = 0.003
#: Chi-square of the four coefficients that a bend beyond doubt has; unbent pictures stay below 35.
_BENT_CHI_SQUARE = 80.0
#: Keeps the clock of a row-time map and drops its bend.
_FLAT = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0])
#: Rows of one block of the normal equations; the bend does not change within.
_BLOCK_ROWS = 32


@dataclass(frozen=True, slots=True)
class _Grid:
    """Where slot 0 stands in its packet."""

    first_slot: int
    packet_slots: int

    def header(self, n: int) -> tuple[NDArray[np.int64], BoolArray]:
        """Slots of the headers among slots 0..n, and whether they are lit."""
        position = (np.arange(n) + self.first_slot) % self.packet_slots
        slots = np.flatnonzero(position < SLOTS_PER_SYMBOL)
        return slots, np.array(HEADER, bool)[position[slots]]


@dataclass(frozen=True, slots=True)
class _Timing:
    """Row-time map: slot position of row s is (s + bend - start) / rows_per_slot."""

    #: start, rows_per_slot, k1, k2, p1, p2.
    values: FloatArray
    #: (6, 6) covariance of the values.
    covariance: FloatArray
    exposure_slots: float
    exposure_sd: float
    #: Log-likelihood ratio of header and weights over chance.
    evidence: float
    #: Share of the strips' local variance that the slots explain.
    explained: float


def refine(
    strips: Strips, hypothesis: Hypothesis, bend: FloatArray, exposure_slots: float | None = None
) -> BlindEstimate:
    """The clock, the bend and the exposure that fit all light of the picture best.

    Args:
        strips: the strips as the picture has them, not straightened.
        hypothesis: a clock found on the straightened strips.
        bend: the bend they were straightened with.
        exposure_slots: exposure, None to estimate it.
    """
    ordered, bend = (in_readout_order(strips), _reversed_bend(bend)) if hypothesis.reversed else (strips, bend)
    ordered = _thinned(ordered, hypothesis.rows_per_slot)
    timing, corrected = _fit_timing(ordered, hypothesis, bend, exposure_slots)
    found, sd = timing.values[2:], np.sqrt(np.diag(timing.covariance))
    return BlindEstimate(
        rows_per_slot=float(timing.values[1]),
        rows_per_slot_sd=float(sd[1]),
        packet_slots=hypothesis.packet_slots,
        reversed=hypothesis.reversed,
        exposure_slots=timing.exposure_slots,
        exposure_slots_sd=timing.exposure_sd,
        bend=_reversed_bend(found) if hypothesis.reversed else found,
        bend_sd=sd[2:],
        corrected=corrected,
        evidence=timing.evidence,
        explained=timing.explained,
    )


def _thinned(strips: Strips, rows_per_slot: float) -> Strips:
    """Neighbouring rows averaged as far as a slot keeps at least four."""
    join = max(1, int(rows_per_slot // 4))
    if join == 1:
        return strips
    n = strips.rows.size // join

    def mean(values: FloatArray | Float32Array) -> FloatArray:
        return np.asarray(values[..., : n * join].reshape(*values.shape[:-1], n, join).mean(axis=-1))

    inside = (mean(strips.inside) > 0.99).astype(np.float32)
    return replace(
        strips,
        light=mean(strips.light).astype(np.float32),
        inside=inside,
        x=mean(strips.x),
        rows=mean(strips.rows),
        sigma=strips.sigma / np.sqrt(join),
    )


def _fit_timing(
    strips: Strips, hypothesis: Hypothesis, bend: FloatArray, exposure_slots: float | None
) -> tuple[_Timing, bool]:
    """The row-time map, with a bend only where it is beyond doubt: one that is free for nothing blurs the period."""
    first_row = strips.rows[0] - 0.5 * (strips.rows[1] - strips.rows[0])
    before = int(hypothesis.start_row // hypothesis.rows_per_slot) + 2
    start = first_row + hypothesis.start_row - before * hypothesis.rows_per_slot
    grid = _Grid(-before % hypothesis.packet_slots, hypothesis.packet_slots)
    values = np.concatenate([[start, hypothesis.rows_per_slot], bend])
    bent = _descend(strips, grid, values, exposure_slots, n_free=6)
    if _is_bent(bent):
        return bent, True
    values = np.concatenate([[start, hypothesis.rows_per_slot], np.zeros(4)]) if not bend.any() else bent.values * _FLAT
    flat = _descend(strips, grid, values, bent.exposure_slots, n_free=2)
    return replace(flat, exposure_sd=bent.exposure_sd), False


def _descend(strips: Strips, grid: _Grid, values: FloatArray, exposure_slots: float | None, n_free: int) -> _Timing:
    """Gauss-Newton on the first `n_free` values of the row-time map, deciding the slots anew at every step."""
    terms = _time_terms(strips)
    exposure, exposure_sd = exposure_slots or 1.0, 0.0
    for step in range(_REFINE_STEPS):
        time = _slot_time(strips, terms, values)
        waves = _column_waves(strips, time, values[1])
        if exposure_slots is None and step in _EXPOSURE_STEPS:
            exposure, exposure_sd = _estimate_exposure(waves, grid)
        lit = _decide(waves, exposure, grid)
        change, covariance, explained = _gauss_newton(strips, terms, values, time, lit, exposure, n_free)
        values = values + change
        moved = float(np.abs(_slot_time(strips, terms, values)[:, ::_BLOCK_ROWS] - time[:, ::_BLOCK_ROWS]).max())
        if moved < _CONVERGED and step >= max(_EXPOSURE_STEPS):
            break
    # Headers that were taken as known are no evidence: they are looked at anew.
    seen = _decide(waves, exposure, None).astype(np.float64)
    evidence = structure_evidence(seen, grid.first_slot, grid.packet_slots)
    return _Timing(values, covariance, exposure, exposure_sd, evidence, explained)


def _time_terms(strips: Strips) -> FloatArray:
    """(4, M, blocks + 1) bend terms at the borders of blocks of rows."""
    n = strips.rows.size
    nodes = np.minimum(np.arange(-(-n // _BLOCK_ROWS) + 1) * _BLOCK_ROWS, n - 1)
    return bend_terms(strips.x[:, nodes], strips.rows[nodes], strips.width, strips.height)


def _slot_time(strips: Strips, terms: FloatArray, values: FloatArray) -> Float32Array:
    """(M, R) slot position of every strip's row; the bend is interpolated between the blocks' borders."""
    n = strips.rows.size
    start, rows_per_slot = values[:2]
    moved = np.tensordot(values[2:], terms, 1)
    index = np.arange(n)
    low = index // _BLOCK_ROWS
    width = np.minimum((low + 1) * _BLOCK_ROWS, n - 1) - low * _BLOCK_ROWS
    f = (index - low * _BLOCK_ROWS) / np.maximum(width, 1)
    bent = moved[:, low] + (moved[:, low + 1] - moved[:, low]) * f
    return np.asarray((strips.rows + bent - start) / rows_per_slot, np.float32)


@dataclass(frozen=True, slots=True)
class _Waves:
    """Light of the columns on a grid of _SAMPLES samples a slot."""

    #: (C, n) float32: levelled light, and its weight.
    value: Float32Array
    weight: Float32Array


def _column_waves(strips: Strips, time: Float32Array, rows_per_slot: float) -> _Waves:
    """Levelled light of every column by slot position."""
    window = round(_EXTREMES_SLOTS * rows_per_slot / (strips.rows[1] - strips.rows[0]))
    level, weight = _levelled(strips.light, strips.inside, window, strips.sigma)
    n = (int(time.max()) + 2) * _SAMPLES
    per_column = strips.light.shape[0] // strips.n_columns
    column = np.arange(strips.light.shape[0]) // per_column
    place = np.clip((time * _SAMPLES).astype(np.int64), 0, n - 1) + (column * n)[:, None]
    total = np.bincount(place.ravel(), weight.ravel(), strips.n_columns * n)
    summed = np.bincount(place.ravel(), (level * weight).ravel(), strips.n_columns * n)
    value = (summed / (total + 1e-3)).reshape(strips.n_columns, n)
    return _Waves(value.astype(np.float32), total.reshape(value.shape).astype(np.float32))


def _slot_values(waves: _Waves) -> Float32Array:
    """(C, N) mean of every slot."""
    shape = (waves.value.shape[0], -1, _SAMPLES)
    weight = waves.weight.reshape(shape)
    summed = (waves.value.reshape(shape) * weight).sum(axis=2)
    return np.asarray(summed / (weight.sum(axis=2) + np.float32(1e-3)), np.float32)


def _decide(waves: _Waves, exposure_slots: float, grid: _Grid | None) -> BoolArray:
    """(C, N) lit slots: the nearer of the extremes, then with the neighbours' share through the exposure taken off.

    The headers of `grid` are taken as known; None where they are to be seen.
    """
    mean = _slot_values(waves)
    n = mean.shape[1]
    windows = np.pad(mean, ((0, 0), (_EXTREMES_SLOTS // 2, _EXTREMES_SLOTS // 2)), mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(windows, _EXTREMES_SLOTS, axis=1)
    high, low = around.max(axis=2), around.min(axis=2)
    value = (2 * mean - high - low) / (high - low + np.float32(1e-3))
    header, lit_header = grid.header(n) if grid else (np.zeros(0, np.int64), np.zeros(0, bool))
    state = np.sign(value)
    state[:, header] = np.where(lit_header, 1, -1)
    taps = _slot_taps(exposure_slots)
    reach = taps.size // 2
    for sweep in range(8):
        padded = np.pad(state, ((0, 0), (reach, reach)))
        others = sum(taps[k] * padded[:, k : k + n] for k in range(taps.size) if k != reach)
        turn = slice(sweep % 2, None, 2)
        state[:, turn] = np.where(value - others >= 0, 1, -1)[:, turn]
        state[:, header] = np.where(lit_header, 1, -1)
    return np.asarray(state > 0)


def _slot_taps(exposure_slots: float) -> FloatArray:
    """Share of each slot in the mean over a slot of the light seen through the exposure, odd length."""
    fine = 40
    box = np.ones(max(round(exposure_slots * fine), 1))
    shape = np.convolve(np.convolve(box / box.size, np.ones(fine)), np.ones(fine) / fine)
    reach = int(np.ceil((exposure_slots + 1) / 2))
    lags = np.arange(-reach, reach + 1)
    centre = (shape.size - 1) / 2
    return np.asarray(np.interp(centre + lags * fine, np.arange(shape.size), shape, left=0, right=0))


def _seen(
    lit: BoolArray, time: FloatArray | Float32Array, column: NDArray[np.int64], exposure_slots: float
) -> tuple[Float32Array, Float32Array]:
    """Light 0..1 of slots through the exposure at slot positions (n, m) of columns (n,); and its change per slot."""
    n = lit.shape[1]
    total = np.zeros((lit.shape[0], n + 2), np.float32)
    np.cumsum(lit, axis=1, out=total[:, 1 : n + 1])
    total[:, n + 1] = total[:, n]
    flat, base = total.ravel(), (column * (n + 2))[:, None]
    late, late_slope = _running(flat, base, time + np.float32(exposure_slots / 2), n)
    early, early_slope = _running(flat, base, time - np.float32(exposure_slots / 2), n)
    scale = np.float32(1 / exposure_slots)
    return (late - early) * scale, (late_slope - early_slope) * scale


def _running(
    flat: Float32Array, base: NDArray[np.int64], time: FloatArray | Float32Array, n: int
) -> tuple[Float32Array, Float32Array]:
    place: FloatArray = np.clip(np.asarray(time, np.float64), 0, n + 0.999)
    low = place.astype(np.int64)
    index = low + base
    below: Float32Array = np.asarray(flat.take(index), np.float32)
    step: Float32Array = np.asarray(flat.take(index + 1), np.float32) - below
    return np.asarray(below + step * (place - low), np.float32), step


def _local(values: Float32Array, window: int) -> Float32Array:
    import cv2

    return np.asarray(cv2.blur(values, (window | 1, 1)))


def _gauss_newton(
    strips: Strips,
    terms: FloatArray,
    values: FloatArray,
    time: Float32Array,
    lit: BoolArray,
    exposure_slots: float,
    n_free: int,
) -> tuple[FloatArray, FloatArray, float]:
    """Step of the row-time map, its covariance, and the share of variance explained before the step."""
    per_column = strips.light.shape[0] // strips.n_columns
    column = np.arange(strips.light.shape[0]) // per_column
    wave, slope = _seen(lit, time, column, exposure_slots)
    pitch = float(strips.rows[1] - strips.rows[0])
    window = round(_LOCAL_SLOTS * values[1] / pitch)
    inside = strips.inside
    share = _local(inside, window) + np.float32(1e-3)
    mean_light, mean_wave = _local(strips.light * inside, window) / share, _local(wave * inside, window) / share
    covariance = _local(strips.light * wave * inside, window) / share - mean_light * mean_wave
    variance = _local(wave * wave * inside, window) / share - mean_wave * mean_wave
    gain = np.maximum(covariance, 0) / (variance + np.float32(0.02))
    residual = (strips.light - mean_light - gain * (wave - mean_wave)) * inside
    spread = _local(residual * residual, window) / share + np.float32(strips.sigma**2)
    power = gain * slope
    weight = inside / spread
    fit = residual * weight * power
    blocks = np.arange(0, strips.rows.size, _BLOCK_ROWS)
    information = np.add.reduceat(weight * power * power, blocks, axis=1).astype(np.float64)
    pull = np.add.reduceat(fit, blocks, axis=1).astype(np.float64)
    jacobian = _jacobian(terms, values, time, blocks)
    step, covariance_matrix = _solve(jacobian, information, pull, values, strips.n_columns, n_free)
    light_power = float((gain * gain * variance * weight).sum())
    left = float((residual * residual * weight).sum())
    return step, covariance_matrix, light_power / max(light_power + left, 1e-9)


def _jacobian(terms: FloatArray, values: FloatArray, time: Float32Array, blocks: NDArray[np.int64]) -> FloatArray:
    """(6, M, blocks) change of the slot position with start, rows per slot and bend."""
    rows_per_slot = values[1]
    middle = np.minimum(blocks + _BLOCK_ROWS // 2, time.shape[1] - 1)
    out = np.empty((6, terms.shape[1], blocks.size))
    out[0] = -1 / rows_per_slot
    out[1] = -time[:, middle] / rows_per_slot
    out[2:] = (terms[:, :, :-1] + terms[:, :, 1:]) / 2 / rows_per_slot
    return out


def _solve(
    jacobian: FloatArray, information: FloatArray, pull: FloatArray, values: FloatArray, n_columns: int, n_free: int
) -> tuple[FloatArray, FloatArray]:
    """Step and covariance; the spread of the columns' pulls stands for all that makes residuals alike."""
    free = jacobian[:n_free]
    flat = free.reshape(n_free, -1)
    prior = (_ALIKE * _BEND_PRECISION)[:n_free]
    hessian = (flat * information.ravel()) @ flat.T + np.diag(prior)
    inverse = np.linalg.inv(hessian)
    by_column = (free * pull).reshape(n_free, n_columns, -1).sum(axis=2)
    spread = by_column - by_column.mean(axis=1, keepdims=True)
    step, covariance = np.zeros(6), np.zeros((6, 6))
    step[:n_free] = inverse @ (flat @ pull.ravel() - prior * values[:n_free])
    covariance[:n_free, :n_free] = inverse @ (spread @ spread.T) @ inverse * n_columns / max(n_columns - 1, 1)
    return step, covariance


def _estimate_exposure(waves: _Waves, grid: _Grid) -> tuple[float, float]:
    """Exposure in slots by the blur of the slots' edges, and its standard deviation."""
    errors = np.array([_misfit(waves, exposure, _decide(waves, exposure, grid)) for exposure in _EXPOSURES])
    best = int(np.clip(errors.argmin(), 1, _EXPOSURES.size - 2))
    bend, slope, _ = np.polyfit(_EXPOSURES[best - 1 : best + 2], np.log(errors[best - 1 : best + 2]), 2)
    if bend <= 0:
        return float(_EXPOSURES[errors.argmin()]), 0.3
    found = float(np.clip(-slope / (2 * bend), _EXPOSURES[0], _EXPOSURES[-1]))
    independent = waves.value.size / _SAMPLES
    return found, float(np.clip(np.sqrt(1 / (bend * independent)), 0.02, 0.5))


def _misfit(waves: _Waves, exposure_slots: float, lit: BoolArray) -> float:
    """Weighted square of what the slots through this exposure leave of the waves, as a share."""
    centres = np.broadcast_to((np.arange(waves.value.shape[1]) + 0.5) / _SAMPLES, waves.value.shape)
    wave, _ = _seen(lit, centres, np.arange(lit.shape[0]), exposure_slots)
    window = _LOCAL_SLOTS * _SAMPLES
    weight = waves.weight
    share = _local(weight, window) + np.float32(1e-3)
    mean_value, mean_wave = _local(waves.value * weight, window) / share, _local(wave * weight, window) / share
    covariance = _local(waves.value * wave * weight, window) / share - mean_value * mean_wave
    variance = _local(wave * wave * weight, window) / share - mean_wave * mean_wave
    gain = np.maximum(covariance, 0) / (variance + np.float32(0.02))
    residual = waves.value - mean_value - gain * (wave - mean_wave)
    total = float((weight * (waves.value - mean_value) ** 2).sum())
    return float((weight * residual * residual).sum()) / max(total, 1e-9)


def _is_bent(timing: _Timing) -> bool:
    """Whether the bend is beyond doubt; columns share too much for its chi-square to be taken at its word."""
    bend, covariance = timing.values[2:], timing.covariance[2:, 2:]
    return float(bend @ np.linalg.solve(covariance + 1e-8 * np.diag(_BEND_SCALE**2), bend)) > _BENT_CHI_SQUARE


# All together ---------------------------------------------------------------------------------------------------------

#: A bend that fits this many nats better than none is tried; from the second on, it alone.
_BEND_GAINS = (5.0, 25.0)
#: Hypotheses that are refined, and the share of the best one's evidence that another needs.
_REFINED, _CLOSE_EVIDENCE = 3, 0.3
#: Below this evidence, more of them.
_WEAK_EVIDENCE, _REFINED_IF_WEAK = 120.0, 8


@dataclass(frozen=True, slots=True)
class BlindSearch:
    """What was estimated, or why nothing was."""

    estimate: BlindEstimate | None
    #: Why not: thing, reason and next step. Empty where an estimate was found.
    reason: str = ""


def estimate_camera(strips: Strips, screens: Sequence[ScreenProfile], exposure_s: float | None = None) -> BlindSearch:
    """Estimate the camera from one picture of a sending screen.

    Args:
        strips: see `strips_of`.
        screens: screens that it may be.
        exposure_s: exposure, None where the file does not tell it.

    Raises:
        ValueError: no screens.
    """
    if not screens:
        raise ValueError("screens must name at least one screen (got none)")
    rates = {screen.packet_slots: screen.slot_rate_hz for screen in reversed(screens)}
    bend, gain = estimate_bend(strips)
    bends = [bend] if gain > _BEND_GAINS[1] else [np.zeros(4), bend] if gain > _BEND_GAINS[0] else [np.zeros(4)]
    found = [(clock, b) for b in bends for clock in find_clocks(straightened(strips, b), sorted(rates))]
    found.sort(key=lambda pair: -pair[0].evidence)
    estimates: list[BlindEstimate] = []
    for clock, b in _worth_refining(found):
        exposure = exposure_s * rates[clock.packet_slots] if exposure_s else None
        estimates.append(refine(strips, clock, b, exposure))
    best = max(estimates, key=lambda estimate: _plausibility(estimate, strips, estimates[0]), default=None)
    if best is None or best.evidence < MIN_EVIDENCE:
        return BlindSearch(None, why_not(strips))
    return BlindSearch(best)


def _worth_refining(found: list[tuple[Hypothesis, FloatArray]]) -> list[tuple[Hypothesis, FloatArray]]:
    """The best hypothesis, and others of another period, packet, direction or bend that come close."""
    chosen: list[tuple[Hypothesis, FloatArray]] = []
    most = _REFINED_IF_WEAK if found and found[0][0].evidence < _WEAK_EVIDENCE else _REFINED
    for clock, bend in found:
        if len(chosen) == most or clock.evidence < _CLOSE_EVIDENCE * found[0][0].evidence:
            break
        if not any(_alike(clock, other) and bend is b for other, b in chosen):
            chosen.append((clock, bend))
    return chosen or found[:1]


def _same_slots(one: Hypothesis, other: Hypothesis) -> bool:
    near = abs(np.log(one.rows_per_slot / other.rows_per_slot)) < _ALIKE_ROWS
    return near and one.reversed == other.reversed


def _plausibility(estimate: BlindEstimate, strips: Strips, first: BlindEstimate) -> float:
    """Evidence of the slots' structure and of the light that they explain, nats."""
    slots = strips.n_columns * strips.rows.size / first.rows_per_slot
    return estimate.evidence - 0.5 * slots / _ALIKE * float(np.log(max(1 - estimate.explained, 1e-3)))


def lens_of(estimate: BlindEstimate, width: int, height: int) -> Lens | None:
    """The lens model of a picture that was corrected in the camera; None where no bend was seen."""
    if not estimate.corrected:
        return None
    matrix = np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1.0]])
    return Lens(matrix, np.append(estimate.bend, 0.0), corrected=True)


def in_time_order(profiles: RowProfiles, height: int) -> RowProfiles:
    """Row profiles of a picture whose rows run against the readout, with rows counted from the first one read.

    Args:
        profiles: C columns, S strips, R rows.
        height: rows of the picture.
    """
    sensor_row = None if profiles.sensor_row is None else height - 1 - profiles.sensor_row[..., ::-1]
    return replace(
        profiles,
        light=np.ascontiguousarray(profiles.light[..., ::-1]),
        inside=np.ascontiguousarray(profiles.inside[..., ::-1]),
        rows=height - 1 - profiles.rows[::-1],
        sensor_row=sensor_row,
    )


def summary(estimate: BlindEstimate, slot_rate_hz: float) -> dict[str, tuple[float, float]]:
    """What was estimated: name -> (value, standard deviation)."""
    line_delay_s = 1 / (estimate.rows_per_slot * slot_rate_hz)
    relative = estimate.rows_per_slot_sd / estimate.rows_per_slot
    out = {
        "rows_per_slot": (estimate.rows_per_slot, estimate.rows_per_slot_sd),
        "line_delay_s": (line_delay_s, line_delay_s * relative),
        "readout_reversed": (float(estimate.reversed), 0.0),
    }
    if estimate.exposure_slots_sd > 0:
        out["exposure_s"] = (estimate.exposure_slots / slot_rate_hz, estimate.exposure_slots_sd / slot_rate_hz)
    if estimate.corrected:
        names = ("k1", "k2", "p1", "p2")
        out |= {n: (float(v), float(sd)) for n, v, sd in zip(names, estimate.bend, estimate.bend_sd, strict=True)}
    return out


def camera_profile(
    estimated: dict[str, tuple[float, float]], name: str, make: str | None, model: str | None, width: int, height: int
) -> CameraProfile:
    """A camera profile of what was estimated, for the next pictures of this camera and size.

    Args:
        estimated: see `summary`; `FrameResult.estimated`.
        name: of the profile.
        make: of the camera, None where the file does not tell it.
        model: of the camera, None where the file does not tell it.
        width: of the picture.
        height: of the picture.

    Raises:
        KeyError: no line delay among what was estimated.
    """
    lens = None
    if "k1" in estimated:
        k = tuple(estimated[key][0] for key in ("k1", "k2", "p1", "p2"))
        centre_x, centre_y, focal = (width - 1) / 2, (height - 1) / 2, float(width)
        matrix = ((focal, 0.0, centre_x), (0.0, focal, centre_y), (0.0, 0.0, 1.0))
        lens = LensModel(
            width=width,
            height=height,
            camera_matrix=matrix,
            dist_coeffs=(*k, 0.0),
            distortion_already_corrected=True,
        )
    line_delay_s, sd = estimated["line_delay_s"]
    mode = ReadoutMode(
        name=f"{width}x{height}",
        width=width,
        height=height,
        line_delay_s=line_delay_s,
        exposure_s=estimated["exposure_s"][0] if "exposure_s" in estimated else None,
    )
    return CameraProfile(
        format=1,
        kind="camera",
        name=name,
        make=make or "",
        models=(model,) if model else (),
        modes=(mode,),
        lens=lens,
        description=f"estimated from one picture; line delay to {100 * sd / line_delay_s:.2g} %",
    )


# What cannot work -----------------------------------------------------------------------------------------------------

#: Likeness of neighbouring strips, over the light's own variance, below which a picture has no stripes.
_STRIPED = 0.25
#: Share of the screen's height that must be striped.
_STRIPED_SHARE = 0.7
_LIKENESS_BANDS = 16


def why_not(strips: Strips) -> str:
    """Why no clock was found: what the picture looks like, and the next step."""
    likeness, lit = stripe_likeness(strips)
    striped = lit & (likeness > _STRIPED)
    if not lit.any():
        return "the screen is dark; show a brighter picture or raise the exposure"
    if not striped.any():
        return (
            "the screen shows no stripes, or too faint ones; check that it sends, show a brighter picture, and take it "
            "with the electronic shutter, HDR and night mode off (a mechanical or global shutter sees no slots)"
        )
    if striped[lit].mean() < _STRIPED_SHARE:
        return (
            "only a part of the screen's height shows stripes; the picture may be merged from several exposures or "
            "taken with flash: switch HDR and flash off, or use a manual-camera app"
        )
    level, weight = _levelled(strips.light, strips.inside, 38, strips.sigma)
    columns = (level * weight).reshape(strips.n_columns, -1, strips.rows.size).mean(axis=1)
    width = _half_width(_autocorrelation(columns))
    if width < _HALF_WIDTH[0] * MIN_ROWS_PER_SLOT:
        return (
            f"the stripes are about {width:.1f} rows wide, too few to tell slots apart (at least "
            f"{MIN_ROWS_PER_SLOT} rows a slot); use the picture in its full size, or a slower slot rate"
        )
    return (
        "there are stripes but no packet header among them; the screen may show less than one packet (move closer), "
        "the picture may be merged from several exposures (switch HDR off), or the screen is none of those tried"
    )


def stripe_likeness(strips: Strips) -> tuple[FloatArray, BoolArray]:
    """Correlation of neighbouring strips in bands of rows, 0..1; and whether a band is lit."""
    level, weight = _levelled(strips.light, strips.inside, _BEND_LEVEL_ROWS, strips.sigma)
    blocks = np.linspace(0, strips.rows.size, _LIKENESS_BANDS + 1).astype(int)[:-1]
    step = _distances(strips)[0] if _distances(strips) else 1

    def summed(values: Float32Array) -> FloatArray:
        return np.asarray(np.add.reduceat(values, blocks, axis=1), np.float64)

    # Strips without light have no say.
    level = level * weight
    product = summed(level[:-step] * level[step:]).sum(axis=0)
    power = np.sqrt(summed(level[:-step] ** 2).sum(axis=0) * summed(level[step:] ** 2).sum(axis=0))
    likeness = product / np.maximum(power, 1e-9)
    lit = summed(weight).max(axis=0) > 0.2 * strips.rows.size / _LIKENESS_BANDS
    lit |= summed(strips.light).max(axis=0) > 0.02 * strips.rows.size / _LIKENESS_BANDS
    return np.asarray(likeness), np.asarray(lit)


# Columns --------------------------------------------------------------------------------------------------------------


def likely_columns(profiles: RowProfiles, clock: Clock, screens: Sequence[ScreenProfile]) -> ScreenProfile:
    """The screen whose columns are as wide as the picture's, by how far strips are alike.

    Strips at u and v see the columns c with weights g(u - c) and g(v - c), so that their slots correlate by the
    product of both, summed over c. Header and dimming symbol are the same everywhere and must be left out.

    Args:
        profiles: C columns of S strips, C any; at least one strip a column of every screen.
        clock: the clock that the screens share.
        screens: screens that differ in their columns.
    """
    number = np.arange(clock.n_slots)
    payload = number[(number + clock.first_slot) % clock.packet_slots >= PREAMBLE_SLOTS]
    borders = clock.row0 + clock.rows_per_slot * np.stack([payload, payload + 1], axis=1).ravel()
    slots, seen = _strip_slots(profiles, borders)
    n_strips = slots.shape[0]
    reach = max(2, min(n_strips - 1, round(1.5 * n_strips / min(screen.columns for screen in screens))))
    measured = np.array([_mean_likeness(slots, seen, distance) for distance in range(1, reach)])
    misfit = []
    for screen in screens:
        # Codewords are not quite random, so that strips far apart are a little alike too: a constant.
        basis = np.stack([_expected_likeness(n_strips, reach, screen), np.ones(reach - 1)], axis=1)
        fit, *_ = np.linalg.lstsq(basis, measured, rcond=None)
        misfit.append(float(((measured - basis @ fit) ** 2).sum()) if fit[0] > 0 else np.inf)
    return screens[int(np.argmin(misfit))]


def _strip_slots(profiles: RowProfiles, borders: FloatArray) -> tuple[FloatArray, BoolArray]:
    """(M, n) mean light of slots in every strip, levelled over the slots around; and whether it is on the screen."""
    n_rows = profiles.rows.size
    light = profiles.light.reshape(-1, n_rows).astype(np.float64)
    inside = profiles.inside.reshape(light.shape)
    if profiles.sensor_row is None:
        place = np.broadcast_to(np.clip(borders - profiles.rows[0] + 0.5, 0, n_rows), (light.shape[0], borders.size))
    else:
        index = np.arange(n_rows) + 0.5
        rows = profiles.sensor_row.reshape(light.shape)
        place = np.stack([np.interp(borders, row, index, left=0, right=n_rows) for row in rows])
    low = np.minimum(place.astype(np.int64), n_rows - 1)

    def integral(values: FloatArray) -> FloatArray:
        total = np.concatenate([np.zeros((values.shape[0], 1)), np.cumsum(values, axis=1)], axis=1)
        below = np.take_along_axis(total, low, 1)
        at = below + (np.take_along_axis(total, low + 1, 1) - below) * (place - low)
        return np.asarray((at[:, 1::2] - at[:, ::2]) / np.maximum(place[:, 1::2] - place[:, ::2], 1e-6))

    seen = integral(inside.astype(np.float64)) > 0.99
    means = (integral(light) * seen).astype(np.float32)
    level, _ = _levelled(means, seen.astype(np.float32), _EXTREMES_SLOTS, 1e-4)
    return level.astype(np.float64), seen


def _mean_likeness(slots: FloatArray, seen: BoolArray, distance: int) -> float:
    both = seen[:-distance] & seen[distance:]
    return float((slots[:-distance] * slots[distance:] * both).sum() / max(int(both.sum()), 1))


def _expected_likeness(n_strips: int, reach: int, screen: ScreenProfile) -> FloatArray:
    """(reach - 1,) correlation of strips 1, 2, .. apart, averaged over the screen."""
    u = (np.arange(n_strips) + 0.5) / n_strips * screen.columns
    offset = u[:, None] - (np.arange(screen.columns) + 0.5)
    light = np.exp(-(offset**2) / (2 * max(screen.light_spread, 1e-3) ** 2))
    light /= np.linalg.norm(light, axis=1, keepdims=True)
    return np.array([float((light[:-d] * light[d:]).sum(axis=1).mean()) for d in range(1, reach)])
