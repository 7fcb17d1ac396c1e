"""The light model: picture, crosstalk and exposure, estimated blindly together with the slots.

What strip s of column c sees at exposure centre g (in slots) is

    z = floor + T * (sum over k of K[s, k] * m[c + k](g)),      m(g) = sum over slots n of lit[n] * h(g - n)

with T the picture there (textured, different in every strip), K the light spread from column c + k into the strip
(smooth, known from the screen), h a slot seen through the exposure (a trapezoid) and m the same for all strips. The
picture is predicted at every sample from the samples before it, from those after it and from both, never from the slot
itself. Each prediction is made on several scales at once; the scale that has predicted best thereabouts is taken, and
its error is the variance of the prediction. The likelihood of a sample is the mixture over the three predictions
(where the picture has an edge, one side alone tells) of a Student-t density (an edge in one strip must not outweigh
seven others). The metric of a slot pattern is the sum of its logarithm over strips and samples.

The slots themselves are needed to predict the picture, so model and detection are iterated, from a first guess that
compares every sample to the extremes around it.

These metrics take every slot by itself, the picture being predicted with all others as believed. Where a symbol stays
in doubt, its likeliest words are weighed as a whole (`word_corrections`): the picture is then a random process along
time, followed by a Kalman filter through the symbol and the slots around it, and the likelihood of a word is that of
its innovations.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, slot_patterns
from rxcli.types import BurstPosteriors, Clock, Float32Array, FloatArray, SlotSamples

#: Scales, in slots, over which the picture is predicted: fine texture to plain sky.
PICTURE_SCALES = (0.3, 0.8, 2.5, 6.0)
_QUICK_SCALES = (0.6, 2.5)
#: Prior of the predictions from both sides, from before, from after.
_SIDES = (0.5, 0.25, 0.25)
#: Samples closer than this many slots to a sample say nothing of its picture: they show the same slot.
_HOLE_SLOTS = 0.7
#: The error of the prediction is averaged over this many slots.
_ERROR_SLOTS = 28
#: Degrees of freedom of the Student-t likelihood; `_density` is written for four.
_DEGREES = 4.0
#: Densities are taken to be at least this, so that their logarithm exists.
_LEAST_DENSITY = np.float32(1e-37)
#: Samples of one slot and strips of one column err alike: the log-likelihoods of a slot's samples, added over the
#: strips, count as much as this many samples of one strip would.
_TEMPER = 0.64
#: Bounds on the relative variance of a predicted picture.
_TEXTURE_BOUNDS = (0.003, 2.0)
#: Log-likelihood ratio of a slot that the first guess sees at full contrast in all strips.
_FIRST_GUESS_LLR = 8.0
#: Strips of full contrast at which the first guess is as sure as it gets.
_FIRST_GUESS_STRIPS = 3.0
#: Positions in the packet of the header's middle dark slot, where only the floor is seen.
_DARK_FROM, _DARK_TO = 5.9, 7.1
#: Light over the floor up to which a sample counts as dark.
_DARK_MARGIN = 0.002

#: Kinds of picture, smooth to rough: relative standard deviation about the local mean, and slots after which it is
#: another one (Ornstein-Uhlenbeck). Each strip may be of any.
_PICTURE_KINDS = ((0.06, 0.7), (0.25, 2.0), (0.7, 3.0))
#: The local mean is taken over this many slots on either side; a word is weighed with so many slots around it.
_MEAN_SLOTS, _AROUND_SLOTS = 10, 3
#: Variance of the mean of two adjacent samples against that of one: samples are interpolated, so they err alike.
_PAIR_NOISE = 0.75
#: Strips of a column err alike: what they say of a word, added, counts so much; and at most so many nats.
_WORD_TEMPER, _WORD_NATS = 0.3, 12.0
#: Ridge of the slots' corrections that make up a word's.
_WORD_RIDGE = 0.05

#: Samples worked on at a time: what fits the cache.
_SAMPLES_AT_A_TIME = 60_000
#: NumPy works outside the interpreter's lock; more threads than this gain nothing on a few columns. Of fewer parts
#: than these threads spend more on waiting for that lock than they gain.
_THREADS, _MANY_PARTS = 2, 4


@dataclass(frozen=True, slots=True)
class LightModel:
    """What is the same all over the frame."""

    #: Light of a dark slot: room light, sensor floor.
    floor: float
    #: Standard deviation of a sample of no light.
    sigma: float
    #: Variance of a sample per unit of light.
    shot: float
    #: (S, 3) share of the light of the columns to the left, of the column itself and to the right, in each strip.
    spread: FloatArray
    #: (Q, memory + 1) weight of the slots n - memory .. n in sample q of metric n.
    taps: FloatArray

    @property
    def memory(self) -> int:
        """Slots before a metric's own that it depends on."""
        return int(self.taps.shape[1]) - 1


def memory_for(exposure_slots: float) -> int:
    """Slots of memory that cover an exposure; odd, so that metrics sit between samples."""
    return 1 if exposure_slots <= 1.3 else 3 if exposure_slots <= 2.6 else 5


def exposure_taps(exposure_slots: float, blur_slots: float, memory: int, samples_per_slot: int) -> FloatArray:
    """Weight of each slot in the samples of a metric, (Q, memory + 1).

    Sample q of metric n has its exposure's centre at n - memory/2 + (q + 1/2) / Q. A slot is seen through a box of the
    exposure and one of `blur_slots` (a row, and the sample's own length).

    Args:
        exposure_slots: exposure in slots.
        blur_slots: width of the further box.
        memory: slots of memory.
        samples_per_slot: samples a slot, Q.
    """
    n_fine = 32
    offsets = ((np.arange(n_fine) + 0.5) / n_fine - 0.5) * max(blur_slots, 1e-3)
    centres = -memory / 2 + (np.arange(samples_per_slot) + 0.5) / samples_per_slot
    slots = np.arange(-memory, 1)
    fine = (centres[:, None] + offsets)[:, None, :]
    exposure = max(exposure_slots, 1e-3)
    low = np.maximum(fine - exposure / 2, slots[:, None])
    high = np.minimum(fine + exposure / 2, slots[:, None] + 1)
    return np.asarray(np.maximum(high - low, 0).mean(axis=2) / exposure)


def spread_matrix(n_strips: int, light_spread: float) -> FloatArray:
    """(S, 3) shares of columns -1, 0, +1 in the light of each strip, for a Gaussian of sigma `light_spread` pitches.

    Shares, because the picture takes up any common factor; so a spread of 0 is no crosstalk, not no light.
    """
    fine = 16
    across = (np.arange(n_strips * fine) + 0.5) / (n_strips * fine) - 0.5
    distance = across[:, None] - np.arange(-1, 2)
    exponent = (-(distance**2) / (2 * max(light_spread, 1e-3) ** 2)).reshape(n_strips, -1, 3)
    # A strip sees the mean over its width: one that is a whole column has twice the crosstalk of the column's middle.
    weight = np.exp(exponent - exponent.max(axis=(1, 2), keepdims=True)).mean(axis=1)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))


def estimate_floor(samples: SlotSamples, clock: Clock) -> float:
    """Light of a dark slot: the median of what is seen in the middle of the headers' three dark slots."""
    q = samples.samples_per_slot
    position = (np.arange(samples.light.shape[-1]) / q + clock.first_slot) % clock.packet_slots
    dark = (position >= _DARK_FROM) & (position < _DARK_TO)
    seen = samples.light[..., dark][samples.valid[..., dark] > 0]
    return float(np.median(seen)) if seen.size else 0.0


def estimate_sigma(samples: SlotSamples, floor: float, least: float) -> float:
    """Noise of a dark sample, from second differences where it is dark; at least `least`."""
    light = samples.light
    mean = (light[..., 2:] + light[..., 1:-1] + light[..., :-2]) / 3
    dark = (mean < floor + _DARK_MARGIN) & (samples.valid[..., 2:] * samples.valid[..., :-2] > 0)
    bend = (light[..., 2:] - 2 * light[..., 1:-1] + light[..., :-2])[dark]
    if bend.size < 50:
        return least
    return max(float(np.median(np.abs(bend)) / (0.6745 * np.sqrt(6.0))), least)


def first_metrics(pooled: Float32Array, weight: Float32Array, taps: FloatArray) -> FloatArray:
    """First guess of the metrics (C, N + memory, patterns), from contrast alone.

    Args:
        pooled: (C, N * Q) light between its local extremes, -1 dark to 1 lit.
        weight: (C, N * Q) strips of full contrast behind it.
        taps: (Q, memory + 1), see `LightModel`.
    """
    # Squared errors, so weighted that a slot seen right in all samples has the log-likelihood ratio of the constant.
    most = np.float32(_FIRST_GUESS_LLR / 4 / taps.shape[0])
    trust = np.minimum(weight / np.float32(_FIRST_GUESS_STRIPS), 1) * most
    value = np.clip(pooled, -1.5, 1.5)
    return _by_pattern(taps, pooled.shape[1], lambda levels: -np.square(value - (2 * levels - 1)) * trust)


def _by_pattern(taps: FloatArray, n: int, of_levels: Callable[[Float32Array], Float32Array]) -> FloatArray:
    """(C, N + memory, patterns) sums over the samples of a metric of what (C, n) samples say of every pattern.

    Args:
        taps: (Q, memory + 1).
        n: samples.
        of_levels: from the (n,) levels between dark and lit that a pattern has in every sample, to (C, n).
    """
    q, memory = taps.shape[0], taps.shape[1] - 1
    lead = memory * q // 2
    sums = []
    for levels in slot_patterns(memory) @ taps.T:
        # Sample i belongs to metric (i + lead) // q.
        values = of_levels(np.tile(np.roll(levels, -(lead % q)).astype(np.float32), -(-n // q))[:n])
        padded = np.zeros((values.shape[0], n + memory * q), np.float32)
        padded[:, lead : lead + n] = values
        sums.append(_by_slot(padded, q))
    return np.stack(sums, axis=2).astype(np.float64)


def metrics_of(llr: Float32Array, memory: int) -> FloatArray:
    """Metrics (C, N + memory, patterns) of slots (C, N) that are independent, given their log-likelihood ratios."""
    padded = np.pad(llr, ((0, 0), (0, memory)))
    return np.asarray(padded[..., None] / 2 * (2.0 * slot_patterns(memory)[:, -1] - 1))


def lit_on_grid(posteriors: BurstPosteriors, clock: Clock) -> Float32Array:
    """(C, N) probability that each slot of the grid is lit."""
    return on_grid(posteriors.lit, clock)


def on_grid(lit: Float32Array, clock: Clock) -> Float32Array:
    """(C, N) slots of the grid from those of bursts (B, C, packet)."""
    copies = lit[clock.burst].transpose(1, 0, 2)
    flat = copies.reshape(copies.shape[0], -1)
    return flat[:, clock.first_slot : clock.first_slot + clock.n_slots]


def by_burst(metrics: FloatArray, clock: Clock, memory: int) -> FloatArray:
    """Metrics of the grid (C, N + memory, patterns) added over the copies of each burst.

    Returns:
        (B, C, packet + memory, patterns); see `detect.detect`.
    """
    n_columns, _, n_patterns = metrics.shape
    length = clock.packet_slots
    padded = np.zeros((n_columns, clock.n_copies * length + memory, n_patterns))
    end = min(clock.first_slot + metrics.shape[1], padded.shape[1])
    padded[:, clock.first_slot : end] = metrics[:, : end - clock.first_slot]
    out = np.zeros((int(clock.burst.max()) + 1, n_columns, length + memory, n_patterns))
    for copy, burst in enumerate(clock.burst):
        out[burst] += padded[:, copy * length : (copy + 1) * length + memory]
    out[:, :, :memory] = 0
    return out


@dataclass(frozen=True, slots=True)
class Prediction:
    """The picture at every sample from other samples, (C, S, n) float32 each."""

    picture: Float32Array
    variance: Float32Array


@dataclass(frozen=True, slots=True)
class SlotLikelihoods:
    """What the light says of the slots of some columns."""

    #: (C, N + memory, patterns) float64: log-likelihood of every pattern of slots n - memory .. n.
    metrics: FloatArray
    #: (C, N) float32: (lit minus dark) squared over the noise's variance, of a slot.
    snr: Float32Array
    #: (C, 2) float64: correlation of the residual with its change by the clock, and that change's power; their ratio is
    #: how many slots the column's clock is late.
    timing: FloatArray


@dataclass(frozen=True, slots=True)
class _Expected:
    """What C columns should show, per unit of picture; arrays (C, S, n) or broadcasting to it."""

    others: Float32Array
    own: Float32Array
    #: (C, 1, n): exposure over the expected slots of the column itself.
    shape: Float32Array
    #: Change of the whole by a slot of time.
    slope: Float32Array

    @property
    def whole(self) -> Float32Array:
        return self.others + self.own * self.shape


def slot_likelihoods(
    samples: SlotSamples,
    clock: Clock,
    model: LightModel,
    lit: Float32Array,
    columns: NDArray[np.int64],
    thorough: bool = True,
) -> SlotLikelihoods:
    """Log-likelihood of every slot pattern at every slot, given the present idea of all slots.

    Args:
        samples: of the columns to look at, S strips, N slots of Q samples.
        clock: the clock.
        model: the light model.
        lit: (C, N) probability that each slot is lit, of all columns.
        columns: which columns the samples are of; the result has these alone.
        thorough: predict the picture from each side too, and on all scales; else from both sides together, on the
            middle scales, which is several times quicker and enough for a plain picture.
    """
    shape = _shape_on_grid(lit, model)
    slope = np.zeros_like(shape)
    slope[:, 1:-1] = (shape[:, 2:] - shape[:, :-2]) * np.float32(samples.samples_per_slot / 2)
    others = _from_neighbours(shape, model, clock, columns)
    others_slope = _from_neighbours(slope, model, clock, columns)
    own = model.spread[None, :, 1, None].astype(np.float32)

    def of_part(part: NDArray[np.int64]) -> SlotLikelihoods:
        these = columns[part]
        expected = _Expected(others[part], own, shape[these, None], others_slope[part] + own * slope[these, None])
        return _likelihoods(samples.light[part], samples.valid[part], expected, model, thorough)

    n_parts = int(np.clip(round(samples.light.size / _SAMPLES_AT_A_TIME), 1, columns.size))
    if n_parts == 1:
        return of_part(np.arange(columns.size))
    parts = np.array_split(np.arange(columns.size), n_parts)
    if n_parts < _MANY_PARTS:
        done = [of_part(part) for part in parts]
    else:
        with ThreadPoolExecutor(_THREADS) as pool:
            done = list(pool.map(of_part, parts))
    return SlotLikelihoods(
        np.concatenate([d.metrics for d in done]),
        np.concatenate([d.snr for d in done]),
        np.concatenate([d.timing for d in done]),
    )


def _likelihoods(
    light: Float32Array, valid: Float32Array, expected: _Expected, model: LightModel, thorough: bool
) -> SlotLikelihoods:
    light = (light - np.float32(model.floor)) * valid
    predictions = predict_picture(light, expected.whole, valid, model.sigma, model.taps.shape[0], thorough)
    metrics = _pattern_metrics(light, valid, predictions, expected, model)
    timing = _timing(light, valid, predictions[0], expected, model)
    return SlotLikelihoods(metrics, _slot_snr(valid, predictions[0], expected.own, model), timing)


def _slot_snr(valid: Float32Array, prediction: Prediction, own: Float32Array, model: LightModel) -> Float32Array:
    """(C, N) squared contrast over variance of a slot, as far as strips and samples are independent."""
    contrast = prediction.picture * own
    noise = np.float32(model.sigma**2) + np.float32(model.shot) * contrast + prediction.variance * own * own
    q = model.taps.shape[0]
    ratio = (contrast * contrast / noise * valid).sum(axis=1) * np.float32(_TEMPER / q)
    return _by_slot(ratio, q)


def _timing(
    light: Float32Array, valid: Float32Array, prediction: Prediction, expected: _Expected, model: LightModel
) -> FloatArray:
    """(C, 2) numerator and denominator of each column's lateness: one Gauss-Newton step, samples weighted robustly."""
    whole = prediction.picture * expected.whole
    change = prediction.picture * expected.slope
    spread = np.float32(model.sigma**2) + np.float32(model.shot) * whole + prediction.variance * expected.whole**2
    residual = light - whole
    weight = valid / (spread + residual * residual / np.float32(_DEGREES))
    numerator = (weight * residual * change).sum(axis=(1, 2), dtype=np.float64)
    return np.stack([numerator, (weight * change * change).sum(axis=(1, 2), dtype=np.float64)], axis=1)


def _shape_on_grid(lit: Float32Array, model: LightModel) -> Float32Array:
    """(C, N * Q) mean of the exposure over the expected slots; unknown slots beyond the grid are half lit."""
    memory, q = model.memory, model.taps.shape[0]
    padded = np.full((lit.shape[0], lit.shape[1] + 2 * memory), 0.5, np.float32)
    padded[:, memory : memory + lit.shape[1]] = lit
    n_metrics = lit.shape[1] + memory
    repeated = np.repeat(padded, q, axis=1)
    shape = np.zeros((lit.shape[0], n_metrics * q), np.float32)
    for place, weights in enumerate(model.taps.T.astype(np.float32)):
        shape += repeated[:, place * q :][:, : n_metrics * q] * np.tile(weights, n_metrics)
    skip = memory * q // 2
    return np.ascontiguousarray(shape[:, skip : skip + lit.shape[1] * q])


def _from_neighbours(shape: Float32Array, model: LightModel, clock: Clock, columns: NDArray[np.int64]) -> Float32Array:
    """(len(columns), S, N * Q) light that the adjacent columns shed into each strip, per unit of picture."""
    left, right = np.zeros_like(shape), np.zeros_like(shape)
    left[1:], right[:-1] = shape[:-1], shape[1:]
    if clock.delay_slots.any():
        ahead = np.diff(clock.delay_slots) * model.taps.shape[0]
        left[1:] = _shifted(left[1:], ahead)
        right[:-1] = _shifted(right[:-1], -ahead)
    spread = model.spread.astype(np.float32)
    return left[columns, None] * spread[None, :, 0, None] + right[columns, None] * spread[None, :, 2, None]


def _shifted(rows: Float32Array, by: FloatArray) -> Float32Array:
    """Each row read `by` samples later, linearly interpolated."""
    index = np.arange(rows.shape[1])
    return np.stack([np.interp(index + b, index, row) for row, b in zip(rows, by, strict=True)]).astype(np.float32)


def _box(values: Float32Array, half: int) -> Float32Array:
    """Sum over the samples at most `half` away; last axis."""
    import cv2

    flat = np.ascontiguousarray(values.reshape(-1, values.shape[-1]))
    summed = cv2.boxFilter(flat, -1, (2 * half + 1, 1), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(summed).reshape(values.shape)


def predict_picture(
    light: Float32Array,
    expected: Float32Array,
    valid: Float32Array,
    sigma: float,
    samples_per_slot: int,
    thorough: bool = True,
) -> list[Prediction]:
    """The picture at every sample from both sides, from before and from after; on each the best of all scales.

    Args:
        light: (C, S, n) light over the floor, 0 where not valid.
        expected: (C, S, n) light per unit of picture, by the present idea of the slots.
        valid: (C, S, n) 1 or 0.
        sigma: standard deviation of a sample of no light.
        samples_per_slot: samples a slot.
        thorough: else from both sides alone, on the middle scales.
    """
    weighted = expected * valid
    numerator, denominator = weighted * light, weighted * expected
    hole = max(int(np.ceil(_HOLE_SLOTS * samples_per_slot)) - 1, 0)
    texture = _Texture(light, expected, valid, sigma, samples_per_slot)
    pictures: list[Float32Array] = []
    variances: list[Float32Array] = []
    scales = PICTURE_SCALES if thorough else _QUICK_SCALES
    for half in dict.fromkeys(max(int(scale * samples_per_slot), 1) for scale in scales):
        sides = _sides if thorough else _both_sides
        sums = zip(sides(_box(numerator, half), half, hole), sides(_box(denominator, half), half, hole), strict=True)
        for side, (light_seen, seen) in enumerate(sums):
            guess = np.maximum(light_seen, 0, out=light_seen)
            guess /= seen + np.float32(1e-4)
            # Which scale is best is asked once a slot, in its middle.
            variance = np.square(guess[..., samples_per_slot // 2 :: samples_per_slot]) * texture.of(guess)
            variance += np.float32(sigma * sigma) / (
                seen[..., samples_per_slot // 2 :: samples_per_slot] + np.float32(1e-6)
            )
            if len(pictures) <= side:
                pictures.append(guess)
                variances.append(variance)
                continue
            # Arithmetic picks several times quicker than a masked copy.
            better = (variance < variances[side]).astype(np.float32)
            guess -= pictures[side]
            guess *= np.repeat(better, samples_per_slot, axis=-1)
            pictures[side] += guess
            np.minimum(variances[side], variance, out=variances[side])
    return [
        Prediction(picture, np.repeat(variance, samples_per_slot, axis=-1))
        for picture, variance in zip(pictures, variances, strict=True)
    ]


def _both_sides(boxes: Float32Array, half: int, hole: int) -> tuple[Float32Array]:
    """Sums over both sides of a hole, from sums centred on samples."""
    away = hole + half + 1
    both = np.zeros_like(boxes)
    both[..., away:] = boxes[..., :-away]
    both[..., :-away] += boxes[..., away:]
    return (both,)


def _sides(boxes: Float32Array, half: int, hole: int) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Sums over both sides of a hole, over the side before it, over the side after, from sums centred on samples."""
    away = hole + half + 1
    before, after = np.zeros_like(boxes), np.zeros_like(boxes)
    before[..., away:] = boxes[..., :-away]
    after[..., :-away] = boxes[..., away:]
    return before + after, before, after


class _Texture:
    """Relative variance of a prediction thereabouts, beyond the noise.

    Every other sample tells it, averaged slot by slot, which is fine enough.
    """

    def __init__(
        self, light: Float32Array, expected: Float32Array, valid: Float32Array, sigma: float, samples_per_slot: int
    ) -> None:
        self._q = samples_per_slot
        self._step = 2 if samples_per_slot % 2 == 0 else 1
        self._light = np.ascontiguousarray(light[..., :: self._step])
        self._expected = expected[..., :: self._step] * valid[..., :: self._step]
        count = self._around(np.ascontiguousarray(valid[..., :: self._step]))
        self._noise = np.float32(sigma * sigma) * count
        self._least = np.float32(1e-5) * count + np.float32(1e-9)

    def of(self, picture: Float32Array) -> Float32Array:
        """(C, S, N) relative variance of `picture`, slot by slot."""
        predicted = picture[..., :: self._step] * self._expected
        residual = self._light - predicted
        error = self._around(np.square(residual, out=residual)) - self._noise
        power = self._around(np.square(predicted, out=predicted)) + self._least
        low, high = _TEXTURE_BOUNDS
        return np.asarray(np.clip(error / power, np.float32(low), np.float32(high)))

    def _around(self, values: Float32Array) -> Float32Array:
        return _box(_by_slot(values, self._q // self._step), _ERROR_SLOTS // 2)


def _by_slot(values: Float32Array, samples_per_slot: int) -> Float32Array:
    """Sums over the samples of each slot, last axis; adding slices is far quicker than a sum over a short axis."""
    total = values[..., ::samples_per_slot].copy()
    for offset in range(1, samples_per_slot):
        total += values[..., offset::samples_per_slot]
    return total


def _pattern_metrics(
    light: Float32Array,
    valid: Float32Array,
    predictions: list[Prediction],
    expected: _Expected,
    model: LightModel,
) -> FloatArray:
    """Mixture log-likelihoods summed over strips and the samples of a metric; (C, N + memory, patterns)."""
    weight = np.float32(_TEMPER / model.taps.shape[0]) * valid
    priors = _SIDES if len(predictions) > 1 else (1.0,)

    def log_likelihood(levels: Float32Array) -> Float32Array:
        whole = expected.others + expected.own * levels
        density = np.zeros_like(light)
        for prediction, prior in zip(predictions, priors, strict=True):
            density += _density(light, whole, prediction, model, prior)
        np.log(np.maximum(density, _LEAST_DENSITY, out=density), out=density)
        density *= weight
        return np.asarray(density.sum(axis=1))

    return _by_pattern(model.taps, light.shape[2], log_likelihood)


def _density(
    light: Float32Array, whole: Float32Array, prediction: Prediction, model: LightModel, prior: float
) -> Float32Array:
    """Student-t density of the light times a prior, up to a constant.

    With four degrees of freedom, variance v and residual r it is v^2 / (v + r^2 / 4)^2.5: a root, and no logarithm.
    """
    variance = prediction.variance * whole
    variance += np.float32(model.shot) * prediction.picture
    variance *= whole
    variance += np.float32(model.sigma**2)
    wide = light - prediction.picture * whole
    np.square(wide, out=wide)
    wide *= np.float32(1 / _DEGREES)
    wide += variance
    variance /= wide
    np.square(variance, out=variance)
    variance *= np.float32(prior)
    variance /= np.sqrt(wide, out=wide)
    return variance


@dataclass(frozen=True, slots=True)
class _Halves:
    """Light of some columns at two samples a slot; (C, S, 2 N) float32."""

    #: Light over the floor.
    light: Float32Array
    #: Mean picture around.
    mean: Float32Array
    #: Light of the adjacent columns per unit of picture.
    others: Float32Array
    #: Whether both samples are seen.
    seen: NDArray[np.bool_]


def word_corrections(
    samples: SlotSamples,
    clock: Clock,
    model: LightModel,
    lit: Float32Array,
    columns: NDArray[np.int64],
    places: NDArray[np.int64],
    words: NDArray[np.uint8],
    likely: NDArray[np.bool_],
) -> Float32Array:
    """What to add to the log-likelihood ratio of every slot, so that words count as the light as a whole has them.

    Args:
        samples: of the columns to look at, S strips, N slots of four samples.
        clock: the clock.
        model: the light model.
        lit: (C, N) probability that each slot is lit, of all columns.
        columns: which columns the samples are of.
        places: (J, 3) burst, place in `columns` and number of each symbol in doubt.
        words: (J, K, 10) its likeliest words, best first.
        likely: (J, K) which of them to weigh; the first always.

    Returns:
        (len(columns), N); 0 for symbols that are not in doubt.
    """
    out = np.zeros((columns.size, clock.n_slots), np.float32)
    symbol, start = _occurrences(places, clock)
    if symbol.size == 0:
        return out
    halves = _halves(samples, clock, model, lit, columns)
    item, word = np.nonzero(likely[symbol])
    levels = _word_levels(lit[columns[places[symbol[item], 1]]], start[item], words[symbol[item], word], model)
    seen = _process_likelihood(halves, places[symbol[item], 1], start[item], levels, model)
    score = np.zeros(likely.shape)
    np.add.at(score, (symbol[item], word), seen)
    slots = _as_slots(_WORD_TEMPER * score, words, likely)
    _share_among_copies(out, slots, symbol, places[symbol, 1], start)
    return out


def _share_among_copies(
    out: Float32Array,
    slots: FloatArray,
    symbol: NDArray[np.int64],
    column: NDArray[np.int64],
    start: NDArray[np.int64],
) -> None:
    """Put the corrections (J, 10) of symbols on the grid, each shared alike among the copies that show the slot."""
    at = start[:, None] + np.arange(SLOTS_PER_SYMBOL)
    inside = (at >= 0) & (at < out.shape[1])
    count = np.zeros(slots.shape)
    np.add.at(count, symbol, inside)
    share = (slots / np.maximum(count, 1))[symbol]
    rows = np.broadcast_to(column[:, None], at.shape)
    out[rows[inside], at[inside]] = share[inside]


def _occurrences(places: NDArray[np.int64], clock: Clock) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Of every copy of the symbols on the grid: which symbol, and its first slot."""
    symbol, copy = np.nonzero(places[:, :1] == clock.burst)
    start = copy * clock.packet_slots + PREAMBLE_SLOTS + SLOTS_PER_SYMBOL * places[symbol, 2] - clock.first_slot
    there = (start > -SLOTS_PER_SYMBOL) & (start < clock.n_slots)
    return symbol[there], start[there]


def _halves(
    samples: SlotSamples, clock: Clock, model: LightModel, lit: Float32Array, columns: NDArray[np.int64]
) -> _Halves:
    shape, q = _shape_on_grid(lit, model), samples.samples_per_slot
    others = _from_neighbours(shape, model, clock, columns)
    light: Float32Array = (samples.light - np.float32(model.floor)) * samples.valid
    own = model.spread[None, :, 1, None].astype(np.float32) * shape[columns, None]
    weight = (others + own) * samples.valid
    light_around, seen_around = (_box(part * weight, _MEAN_SLOTS * q) for part in (light, weight))
    mean = np.maximum(light_around, np.float32(0)) / np.maximum(seen_around, np.float32(1e-3))
    return _Halves(_paired(light), _paired(mean.astype(np.float32)), _paired(others), _paired(samples.valid) > 0.9)


def _paired(values: Float32Array) -> Float32Array:
    """Means of the two samples of every half of a slot, last axis."""
    return np.asarray((values[..., ::2] + values[..., 1::2]) * np.float32(0.5), np.float32)


def _word_levels(
    lit: Float32Array, start: NDArray[np.int64], words: NDArray[np.uint8], model: LightModel
) -> Float32Array:
    """(R, W) mean of the exposure over a word and the slots around it, as believed, at two samples a slot.

    Args:
        lit: (R, N) probability that each slot of the word's column is lit.
        start: (R,) first slot of the word.
        words: (R, 10).
        model: the light model.
    """
    lead = _AROUND_SLOTS + model.memory
    at = start[:, None] + np.arange(-lead, SLOTS_PER_SYMBOL + lead)
    slots = np.take_along_axis(lit, np.clip(at, 0, lit.shape[1] - 1), axis=1)
    slots[(at < 0) | (at >= lit.shape[1])] = 0.5
    slots[:, lead : lead + SLOTS_PER_SYMBOL] = words
    windows = np.lib.stride_tricks.sliding_window_view(slots, model.memory + 1, axis=1)
    levels = (windows @ model.taps.T.astype(np.float32)).reshape(start.size, -1)
    q = model.taps.shape[0]
    skip = model.memory * q // 2
    return _paired(np.asarray(levels[:, skip : skip + (SLOTS_PER_SYMBOL + 2 * _AROUND_SLOTS) * q], np.float32))


def _process_likelihood(
    halves: _Halves, column: NDArray[np.int64], start: NDArray[np.int64], levels: Float32Array, model: LightModel
) -> FloatArray:
    """(R,) log-likelihood of the light by R words, strips added, whatever kind of picture each shows."""
    n, width = halves.light.shape[2], levels.shape[1]
    at = 2 * (start[:, None] - _AROUND_SLOTS) + np.arange(width)
    index = (column[None, :, None], np.arange(halves.light.shape[1])[None, None], np.clip(at, 0, n - 1).T[:, :, None])
    # From here on time comes first: (W, R, S).
    mean, seen = halves.mean[index], halves.seen[index] & ((at >= 0) & (at < n)).T[:, :, None]
    own = model.spread[None, None, :, 1].astype(np.float32)
    gain = (halves.others[index] + own * levels.T[:, :, None]) * mean
    noise = np.float32(_PAIR_NOISE) * (np.float32(model.sigma**2) + np.float32(model.shot) * gain)
    residual = np.where(seen, halves.light[index] - gain, np.float32(0))
    gain = np.where(seen, gain, np.float32(0))
    kinds = _innovations(residual, gain, noise, _PICTURE_KINDS)
    return np.asarray(np.logaddexp.reduce(kinds, axis=0).sum(axis=1), np.float64)


def _innovations(
    residual: Float32Array, gain: Float32Array, noise: Float32Array, kinds: tuple[tuple[float, float], ...]
) -> Float32Array:
    """(kinds, R, S) log-likelihood, up to a constant, of light that follows the picture's deviation from its mean.

    Args:
        residual: (W, R, S) light less that of the mean picture.
        gain: (W, R, S) light per unit of relative deviation; 0 where nothing is seen.
        noise: (W, R, S) variance of the light.
        kinds: standard deviation of the process, and slots after which it is another one, of every kind of picture.
    """
    deviation, length = np.array(kinds, np.float32).T[:, :, None, None]
    keep, power = np.exp(np.float32(-0.5) / length), np.square(deviation)
    state = np.zeros((len(kinds), *residual.shape[1:]), np.float32)
    variance, total = state + power, state.copy()
    for light, slope, error in zip(residual, gain, noise, strict=True):
        shared = slope * variance
        spread = shared * slope
        spread += error
        innovation = light - slope * state
        step = innovation / spread
        innovation *= step
        total += innovation
        total += np.log(spread)
        np.divide(shared, spread, out=spread)
        step *= shared
        state += step
        state *= keep
        shared *= spread
        variance -= shared
        variance -= power
        variance *= keep * keep
        variance += power
    total *= np.float32(-0.5)
    return total


def _as_slots(score: FloatArray, words: NDArray[np.uint8], likely: NDArray[np.bool_]) -> FloatArray:
    """(J, 10) least corrections of single slots that add up to what words (J, K) score against the first of them."""
    score = score - np.where(likely, score, -np.inf).max(axis=1, keepdims=True)
    score = np.maximum(score, -_WORD_NATS)
    wanted = (score[:, 1:] - score[:, :1]) * likely[:, 1:]
    apart = (words[:, 1:].astype(np.float64) - words[:, :1]) * likely[:, 1:, None]
    across = apart @ apart.transpose(0, 2, 1) + _WORD_RIDGE * np.eye(apart.shape[1])
    return np.asarray((np.linalg.solve(across, wanted[..., None]).transpose(0, 2, 1) @ apart)[:, 0])
