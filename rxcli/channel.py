"""The light model: picture, crosstalk and exposure, estimated blindly together with the slots.

What strip s of column c sees at exposure centre g (in slots) is

    z = floor + T * (sum over k of K[s, k] * m[c + k](g)),      m(g) = sum over slots n of lit[n] * h(g - n)

with T the picture there (textured, different in every strip), K the light spread from column c + k into the strip
(smooth, known from the screen), h a slot seen through the exposure (a trapezoid) and m the same for all strips. The
picture is predicted at every sample from the samples around it, but not from the slot itself, on several scales at
once; the scale that has predicted best thereabouts is taken, and its error is the variance of the prediction. The
metric of a slot pattern is then the sum over strips and samples of a Student-t log-likelihood: pictures have edges, and
an edge in one strip must not outweigh seven others.

The slots themselves are needed to predict the picture, so model and detection are iterated, from a first guess that
compares every sample to the extremes around it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rxcli.protocol import slot_patterns as patterns
from rxcli.types import BurstPosteriors, Clock, Float32Array, FloatArray, SlotSamples

#: Scales, in slots, over which the picture is predicted: fine texture to plain sky.
PICTURE_SCALES = (0.6, 1.2, 2.5, 6.0)
#: Samples closer than this many slots to a sample say nothing of its picture: they show the same slot.
_HOLE_SLOTS = 0.7
#: The error of the prediction is averaged over this many slots.
_ERROR_SLOTS = 28
#: Degrees of freedom of the Student-t likelihood.
_DEGREES = 4.0
#: Samples of one slot and strips of one column err alike; their summed log-likelihood counts this much.
_TEMPER = 0.5
#: Bounds on the relative variance of a predicted picture.
_TEXTURE_BOUNDS = (0.003, 2.0)
#: Log-likelihood ratio of a slot that the first guess sees at full contrast in all strips.
_FIRST_GUESS_LLR = 4.0
#: Strips of full contrast at which the first guess is as sure as it gets.
_FIRST_GUESS_STRIPS = 3.0
#: Positions in the packet of the header's middle dark slot, where only the floor is seen.
_DARK_FROM, _DARK_TO = 5.9, 7.1
#: Light over the floor up to which a sample counts as dark.
_DARK_MARGIN = 0.002


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
    """(S, 3) light of columns -1, 0, +1 in each strip of a column, for a Gaussian of sigma `light_spread` pitches."""
    across = (np.arange(n_strips) + 0.5) / n_strips - 0.5
    distance = across[:, None] - np.arange(-1, 2)
    return np.asarray(np.exp(-(distance**2) / (2 * max(light_spread, 1e-3) ** 2)))


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
    return max(float(np.median(np.abs(bend))) / (0.6745 * np.sqrt(6.0)), least)


def first_metrics(pooled: Float32Array, weight: Float32Array, memory: int) -> FloatArray:
    """Metrics of the first guess: every slot's contrast as a log-likelihood ratio, no memory.

    Args:
        pooled: (C, N) slots between their local extremes, -1 dark to 1 lit.
        weight: (C, N) strips of full contrast behind them.
        memory: slots of memory, for the shape.

    Returns:
        (C, N + memory, patterns).
    """
    llr = _FIRST_GUESS_LLR * np.clip(pooled, -1.5, 1.5) * np.minimum(weight, _FIRST_GUESS_STRIPS) / _FIRST_GUESS_STRIPS
    llr = np.pad(llr, ((0, 0), (0, memory)))
    return np.asarray(llr[..., None] / 2 * (2.0 * patterns(memory)[:, -1] - 1))


def lit_on_grid(posteriors: BurstPosteriors, clock: Clock) -> Float32Array:
    """(C, N) probability that each slot of the grid is lit."""
    copies = posteriors.lit[clock.burst].transpose(1, 0, 2)
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
class SlotLikelihoods:
    """What the light says of the slots of some columns."""

    #: (C, N + memory, patterns) float64: log-likelihood of every pattern of slots n - memory .. n.
    metrics: FloatArray
    #: (C, N) float32: (lit minus dark) squared over the noise's variance, of a slot.
    snr: Float32Array


def slot_likelihoods(
    samples: SlotSamples, clock: Clock, model: LightModel, lit: Float32Array, columns: NDArray[np.int64]
) -> SlotLikelihoods:
    """Log-likelihood of every slot pattern at every slot, given the present idea of all slots.

    Args:
        samples: C columns, S strips, N slots of Q samples.
        clock: the clock.
        model: the light model.
        lit: (C, N) probability that each slot is lit.
        columns: columns to look at; the result has these alone.
    """
    q = samples.samples_per_slot
    shape = _shape_on_grid(lit, model)
    own = model.spread[None, :, 1, None].astype(np.float32)
    others = _from_neighbours(shape, model, clock, q)[columns]
    valid = samples.valid[columns]
    light = (samples.light[columns] - np.float32(model.floor)) * valid
    expected = others + own * shape[columns, None]
    picture, variance = predict_picture(light, expected, valid, model.sigma, q)
    metrics = _pattern_metrics(light, valid, picture, variance, others, own, model)
    return SlotLikelihoods(metrics, _slot_snr(valid, picture * own, variance * own * own, model))


def _slot_snr(valid: Float32Array, contrast: Float32Array, variance: Float32Array, model: LightModel) -> Float32Array:
    """(C, N) squared contrast over variance, summed over the strips and samples of a slot as far as they are independent."""
    noise = np.float32(model.sigma**2) + np.float32(model.shot) * contrast + variance
    ratio = (contrast * contrast / noise * valid).sum(axis=1) * np.float32(_TEMPER)
    return np.asarray(ratio.reshape(ratio.shape[0], -1, model.taps.shape[0]).sum(axis=2), np.float32)


def _shape_on_grid(lit: Float32Array, model: LightModel) -> Float32Array:
    """(C, N * Q) mean of the exposure over the expected slots; unknown slots beyond the grid are half lit."""
    memory, q = model.memory, model.taps.shape[0]
    padded = np.pad(lit, ((0, 0), (memory, memory)), constant_values=0.5)
    windows = np.lib.stride_tricks.sliding_window_view(padded, memory + 1, axis=1)
    shape = (windows @ model.taps.T.astype(np.float32)).reshape(lit.shape[0], -1)
    skip = memory * q // 2
    return np.ascontiguousarray(shape[:, skip : skip + lit.shape[1] * q])


def _from_neighbours(shape: Float32Array, model: LightModel, clock: Clock, q: int) -> Float32Array:
    """(C, S, N * Q) light that the adjacent columns shed into each strip, per unit of picture."""
    left, right = np.zeros_like(shape), np.zeros_like(shape)
    left[1:], right[:-1] = shape[:-1], shape[1:]
    if clock.delay_slots.any():
        ahead = np.diff(clock.delay_slots) * q
        left[1:] = _shifted(left[1:], ahead)
        right[:-1] = _shifted(right[:-1], -ahead)
    spread = model.spread.astype(np.float32)
    return left[:, None] * spread[None, :, 0, None] + right[:, None] * spread[None, :, 2, None]


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
    light: Float32Array, expected: Float32Array, valid: Float32Array, sigma: float, samples_per_slot: int
) -> tuple[Float32Array, Float32Array]:
    """The picture at every sample from the samples around it, and the variance of that prediction.

    Args:
        light: (C, S, n) light over the floor, 0 where not valid.
        expected: (C, S, n) light per unit of picture, by the present idea of the slots.
        valid: (C, S, n) 1 or 0.
        sigma: standard deviation of a sample of no light.
        samples_per_slot: samples a slot.

    Returns:
        (C, S, n) float32 each.
    """
    weighted = expected * valid
    numerator, denominator = weighted * light, weighted * expected
    hole = max(int(np.ceil(_HOLE_SLOTS * samples_per_slot)) - 1, 0)
    near_numerator, near_denominator = _box(numerator, hole), _box(denominator, hole)
    picture = variance = None
    for scale in PICTURE_SCALES:
        half = hole + max(round(2 * scale * samples_per_slot), 1)
        seen = np.maximum(_box(denominator, half) - near_denominator, 0)
        guess = np.maximum(_box(numerator, half) - near_numerator, 0) / (seen + np.float32(1e-4))
        spread = guess * guess * _texture(light, guess * expected, valid, sigma, samples_per_slot)
        spread += np.float32(sigma * sigma) / (seen + np.float32(1e-6))
        if picture is None or variance is None:
            picture, variance = guess, spread
        else:
            better = spread < variance
            np.copyto(picture, guess, where=better)
            np.copyto(variance, spread, where=better)
    assert picture is not None
    assert variance is not None
    return picture, variance


def _texture(light: Float32Array, predicted: Float32Array, valid: Float32Array, sigma: float, q: int) -> Float32Array:
    """Relative variance of the predictions thereabouts, beyond the noise."""
    residual = (light - predicted) * valid
    half = _ERROR_SLOTS * q // 2
    error = _box(residual * residual - np.float32(sigma * sigma) * valid, half)
    power = _box(predicted * predicted * valid, half) + np.float32(1e-5) * _box(valid, half) + np.float32(1e-9)
    return np.clip(error / power, *map(np.float32, _TEXTURE_BOUNDS))


def _pattern_metrics(
    light: Float32Array,
    valid: Float32Array,
    picture: Float32Array,
    variance: Float32Array,
    others: Float32Array,
    own: Float32Array,
    model: LightModel,
) -> FloatArray:
    """Student-t log-likelihoods summed over strips and the samples of a metric; (C, N + memory, patterns)."""
    q, memory = model.taps.shape[0], model.memory
    n_columns, _, n = light.shape
    lead = memory * q // 2
    out = np.zeros((n_columns, n // q + memory, 1 << (memory + 1)))
    noise = np.float32(model.sigma**2)
    shot = np.float32(model.shot) * picture
    weight = np.float32(_TEMPER) * valid
    for number, levels in enumerate(patterns(memory) @ model.taps.T):
        # Sample i belongs to metric (i + lead) // q.
        mine = np.resize(np.roll(levels, -(lead % q)), n).astype(np.float32)
        shape = others + own * mine
        spread = noise + shape * (shot + variance * shape)
        residual = light - picture * shape
        log_likelihood = -0.5 * (_DEGREES + 1) * np.log1p(residual * residual / (spread * np.float32(_DEGREES)))
        log_likelihood -= 0.5 * np.log(spread)
        summed = (log_likelihood * weight).sum(axis=1)
        padded = np.pad(summed, ((0, 0), (lead, memory * q - lead)))
        out[:, :, number] = padded.reshape(n_columns, -1, q).sum(axis=2)
    return out
