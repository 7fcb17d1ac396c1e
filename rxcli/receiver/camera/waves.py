"""Light of the columns by slot position, and the slots decided from it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import local_mean
from rxcli.protocol import HEADER, PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, WEIGHTS, codebook
from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.strips import SAMPLES, Strips
from rxcli.receiver.camera.trellis import lit_probability, log_evidence, pattern_light
from rxcli.receiver.camera.views import View
from rxcli.receiver.light import SlotLight, light_of_columns
from rxcli.types import Float32Array, FloatArray

#: Exposures that are compared, slots; and those near one, as factors.
_EXPOSURES = np.array([0.3, 0.7, 1.1, 1.5, 1.9, 2.3, 2.8])
_AROUND_EXPOSURE = np.array([0.7, 0.85, 1.0, 1.17, 1.37])

#: (10, 10) share of the codewords that are lit, by weight (nothing for 0) and place. The codebook is the first part of
#: all words in ascending order: early slots are dark more often than late ones, of weights 2 to 5 the first one nearly
#: always. None is surer than a header's.
WORD_SHARES: FloatArray = np.clip(
    [np.full(SLOTS_PER_SYMBOL, 0.5), *(codebook(w).mean(axis=0) for w in WEIGHTS)], 0.01, 0.99
)


@dataclass(frozen=True, slots=True)
class Grid:
    """Where slot 0 stands in its packet."""

    first_slot: int
    packet_slots: int

    def log_odds(self, w: NDArray[np.int64], n: int) -> FloatArray:
        """(C, n) prior log-odds of slots 0..n: headers and dimming symbols are known, others lit as in codewords."""
        position = (np.arange(n) + self.first_slot) % self.packet_slots
        out = _log_odds(WORD_SHARES)[w][:, position % SLOTS_PER_SYMBOL]
        preamble = position < PREAMBLE_SLOTS
        symbol = np.arange(SLOTS_PER_SYMBOL) < w[:, None]
        known = np.concatenate([np.broadcast_to(np.array(HEADER, bool), symbol.shape), symbol], axis=1)
        out[:, preamble] = np.where(known[:, position[preamble]], SETTINGS.known_log_odds, -SETTINGS.known_log_odds)
        return out


@dataclass(frozen=True, slots=True)
class Slots:
    """What is believed of the columns' slots."""

    #: (C, N) float32: probability that a slot is lit.
    lit: Float32Array
    #: (C,) int64: weight of every column.
    w: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Waves:
    """Light of the columns on a grid of SAMPLES samples a slot."""

    #: (C, n) float32: levelled light, and its weight.
    value: Float32Array
    weight: Float32Array


def column_shares(strips: Strips) -> FloatArray:
    """(M, C) share of every column's light in every strip's, for columns that are lit alike."""
    light = light_of_columns(strips.light.shape[0], strips.n_columns, strips.light_spread)
    return np.asarray(light / light.sum(axis=1, keepdims=True))


def column_waves(view: View, time: Float32Array) -> Waves:
    """Levelled light of every column by slot position."""
    n_columns, n_strips = view.strips.n_columns, view.light.shape[0]
    n = (int(time.max()) + 2) * SAMPLES
    column = np.arange(n_strips) // (n_strips // n_columns)
    place = np.clip((time * np.float32(SAMPLES)).astype(np.int64), 0, n - 1) + (column * n)[:, None]
    total = np.bincount(place.ravel(), view.weight.ravel(), n_columns * n)
    summed = np.bincount(place.ravel(), view.light.ravel(), n_columns * n)
    value = (summed / (total + 1e-3)).reshape(n_columns, n)
    return Waves(value.astype(np.float32), total.reshape(value.shape).astype(np.float32))


def read_freely(waves: Waves, exposure_slots: float, w: int | None = None) -> tuple[Float32Array, Float32Array]:
    """Slots read without knowing anything of packets.

    Args:
        waves: light by slot position.
        exposure_slots: exposure.
        w: weight whose levels columns have to start from; None: what the skewness of their light says.

    Returns:
        (C, N) probability that each slot is lit; and (C, N) what the light says for that, log-odds.
    """
    pattern = pattern_light(exposure_slots, SAMPLES)
    shape = (waves.value.shape[0], waves.value.shape[1] // SAMPLES)
    levels = np.array([_expected_levels(one, exposure_slots) for one in WEIGHTS], np.float32)
    weights = likely_weights(waves, exposure_slots) if w is None else np.full(shape[0], w)
    gain, offset = (np.broadcast_to(one[weights - 1][:, None], waves.value.shape) for one in levels.T)
    power = np.full((shape[0], 1), SETTINGS.first_power, np.float32)
    prior = _log_odds(weights[:, None] / SLOTS_PER_SYMBOL) + np.zeros(shape)
    lit, _ = lit_probability(_pattern_metric(waves, gain, offset, power, pattern), prior)
    gain, offset, residual = _levels(waves, lit, exposure_slots)
    prior = _log_odds(np.clip(lit.mean(axis=1, keepdims=True, dtype=np.float64), *SETTINGS.free_duty)) + np.zeros(shape)
    lit, _ = lit_probability(_pattern_metric(waves, gain, offset, _power(waves, residual), pattern), prior)
    return lit, np.asarray(_log_odds(np.clip(lit.astype(np.float64), 1e-4, 1 - 1e-4)) - prior, np.float32)


def likely_weights(waves: Waves, exposure_slots: float) -> NDArray[np.int64]:
    """(C,) weight of every column by the skewness of its light: few lit slots stand out above, few dark ones below."""
    trust = _trust(waves)
    total = trust.sum(axis=1, keepdims=True) + np.float32(1e-6)
    centred = waves.value - (trust * waves.value).sum(axis=1, keepdims=True) / total
    square = centred * centred
    second, third = ((trust * moment).sum(axis=1) / total[:, 0] for moment in (square, square * centred))
    skewness = third / (second**1.5 + np.float32(1e-6))
    expected = np.array([_expected_skewness(w, exposure_slots) for w in WEIGHTS])
    return np.asarray(np.abs(skewness[:, None] - expected).argmin(axis=1) + 1)


def _log_odds(share: FloatArray) -> FloatArray:
    return np.asarray(np.log(share / (1 - share)))


def shared_weights(log_evidence: FloatArray) -> NDArray[np.int64]:
    """(C,) most probable weight of each column, where weights that many columns have are more probable."""
    prior = np.full((log_evidence.shape[0], 1), 1 / log_evidence.shape[0])
    for _ in range(SETTINGS.sharing_rounds):
        posterior = np.exp(log_evidence - log_evidence.max(axis=0)) * prior
        posterior /= posterior.sum(axis=0)
        prior = posterior.mean(axis=1, keepdims=True) + 0.01
    return np.asarray(posterior.argmax(axis=0))


def decide(waves: Waves, exposure_slots: float, grid: Grid, slots: Slots) -> Slots:
    """Levels from slots, and slots from levels; weights stay.

    Args:
        waves: light by slot position.
        exposure_slots: exposure.
        grid: where the headers are.
        slots: to start from.
    """
    n = waves.value.shape[1] // SAMPLES
    lit = fitted(slots.lit, n)
    gain, offset, residual = _levels(waves, lit, exposure_slots)
    metric = _pattern_metric(waves, gain, offset, _power(waves, residual), pattern_light(exposure_slots, SAMPLES))
    lit, _ = lit_probability(metric, grid.log_odds(slots.w, n))
    return Slots(lit, slots.w)


def fitted(lit: Float32Array, n: int) -> Float32Array:
    """Slots cut, or filled with doubt, to a number of `n`."""
    more = n - lit.shape[1]
    return lit[:, :n] if more <= 0 else np.pad(lit, ((0, 0), (0, more)), constant_values=0.5)


def packet_llr(waves: Waves, exposure_slots: float, grid: Grid, slots: Slots) -> float:
    """Log-likelihood ratio of headers and dimming symbols being where they must, over slots of any kind, nats."""
    n = slots.lit.shape[1]
    gain, offset, residual = _levels(waves, slots.lit, exposure_slots)
    metric = _pattern_metric(waves, gain, offset, _power(waves, residual), pattern_light(exposure_slots, SAMPLES))
    known = log_evidence(metric, grid.log_odds(slots.w, n))
    free = log_evidence(metric, _duty_log_odds(slots.w)[:, None] + np.zeros(n))
    # A column may be too dark to say anything.
    return float(np.logaddexp(known - free, 0.0).sum() - slots.w.size * np.log(2.0))


def _expected_levels(w: int, exposure_slots: float) -> tuple[float, float]:
    """Gain and offset of levelled light, which has no mean and a variance of one, for symbols of weight `w`."""
    mean, variance, _ = _expected_moments(w, exposure_slots)
    gain = 1 / np.sqrt(variance)
    return float(gain), float(-gain * mean)


def _expected_skewness(w: int, exposure_slots: float) -> float:
    _, variance, third = _expected_moments(w, exposure_slots)
    return float(third / variance**1.5)


@lru_cache(maxsize=128)
def _expected_moments(w: int, exposure_slots: float) -> tuple[float, float, float]:
    """Mean, variance and third central moment of the light 0..1 of symbols of weight `w`."""
    duty = w / SLOTS_PER_SYMBOL
    light = pattern_light(exposure_slots, SAMPLES)
    n_bits = light.shape[0].bit_length() - 1
    lit = np.array([bin(p).count("1") for p in range(light.shape[0])])
    share = duty**lit * (1 - duty) ** (n_bits - lit)
    mean = float((share @ light).mean())
    second, third = (float((share @ (light - mean) ** n).mean()) for n in (2, 3))
    return mean, second, third


def _duty_log_odds(w: NDArray[np.int64]) -> FloatArray:
    return _log_odds(w / SLOTS_PER_SYMBOL)


def _power(waves: Waves, residual: Float32Array) -> Float32Array:
    """(C, 1) weighted mean of squares that are left."""
    trust = _trust(waves)
    total = trust.sum(axis=1, keepdims=True) + np.float32(1e-6)
    return np.asarray((trust * residual).sum(axis=1, keepdims=True) / total + np.float32(1e-4))


def _trust(waves: Waves) -> Float32Array:
    """(C, n) say of every sample, 0 to 1."""
    return np.asarray(np.minimum(waves.weight / (np.median(waves.weight, axis=1, keepdims=True) + 1e-6), 1), np.float32)


def _pattern_metric(
    waves: Waves, gain: Float32Array, offset: Float32Array, power: Float32Array, pattern: FloatArray
) -> Float32Array:
    """(patterns, C, N) log-likelihood of every slot's samples at given levels and noise, up to a constant."""
    scale = _trust(waves) * np.float32(SETTINGS.sample_information / 2) / power
    shape = (waves.value.shape[0], -1)
    value, light = waves.value - offset, pattern.astype(np.float32)
    gain_scale = gain * scale
    square, expected, both = (
        one.reshape(-1, SAMPLES).T for one in (value * value * scale, gain * gain_scale, 2 * value * gain_scale)
    )
    metric = light @ both - (light * light) @ expected - square.sum(axis=0)
    return np.asarray(metric.reshape(light.shape[0], *shape))


def _levels(waves: Waves, lit: Float32Array, exposure_slots: float) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Of every sample: gain and offset of lit slots thereabouts, and the square that is expected to be left."""
    centres = (np.arange(waves.value.shape[1])[None] + 0.5) / SAMPLES
    wave = SlotLight(lit, 0.0).seen(centres, exposure_slots)
    unsure = SlotLight(lit * (1 - lit), 0.0).seen(centres, exposure_slots)
    unsure /= np.float32(max(exposure_slots, 1.0))
    weight = waves.weight
    near = Surroundings.of(waves.value, weight, SETTINGS.level_slots * SAMPLES).moments(wave, unsure)
    both, power = near.covariance, near.variance
    total = weight.sum(axis=1, keepdims=True) + np.float32(1e-6)
    overall = (both * weight).sum(axis=1, keepdims=True) / ((power * weight).sum(axis=1, keepdims=True) + 0.01 * total)
    own = np.float32(SETTINGS.gain_prior)
    gain = (np.maximum(both, 0) + own * np.maximum(overall, 0)) / (np.maximum(power, 0) + own)
    offset = near.value - gain * near.wave
    return gain, offset, (waves.value - offset - gain * wave) ** 2 + gain * gain * unsure


@dataclass(frozen=True, slots=True)
class Moments:
    """Weighted means, covariance and variance of light and of the wave that should explain it, thereabouts."""

    #: Share of the window that counts.
    share: Float32Array
    value: Float32Array
    wave: Float32Array
    covariance: Float32Array
    #: Of the wave.
    variance: Float32Array

    @property
    def gain(self) -> Float32Array:
        """Light per unit of the wave, never negative."""
        return np.asarray(np.maximum(self.covariance, 0) / (self.variance + np.float32(0.02)))


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Light with what is around every sample of it, whatever wave should explain it."""

    value: Float32Array
    weight: Float32Array
    #: Samples of the window along the last axis.
    window: int
    #: Share of the window that counts, and mean of the light there.
    share: Float32Array
    mean: Float32Array

    @staticmethod
    def of(value: Float32Array, weight: Float32Array, window: int) -> Surroundings:
        share = local_mean(weight, window) + np.float32(1e-3)
        return Surroundings(value, weight, window, share, local_mean(value * weight, window) / share)

    def mean_of(self, values: Float32Array) -> Float32Array:
        """Mean of other values of the same samples."""
        return np.asarray(local_mean(values * self.weight, self.window) / self.share)

    def moments(self, wave: Float32Array, unsure: Float32Array | float = 0.0) -> Moments:
        """Moments of the light and a wave; `unsure` is the variance of the wave itself."""
        mean_wave = self.mean_of(wave)
        covariance = self.mean_of(self.value * wave) - self.mean * mean_wave
        variance = self.mean_of(wave * wave + unsure) - mean_wave * mean_wave
        return Moments(self.share, self.mean, mean_wave, covariance, variance)


def residual_of(
    strips: Strips, near: Moments, gain: Float32Array, wave: Float32Array, window: int
) -> tuple[Float32Array, Float32Array]:
    """(M, R) light that a wave of some gain leaves over; and its variance thereabouts, the noise's with it."""
    residual = (strips.light - near.value - gain * (wave - near.wave)) * strips.inside
    spread = local_mean(residual * residual, window) / near.share + strips.noise.variance(near.value)
    return residual, spread


def exposure_of_known(waves: Waves, lit: Float32Array, near: float | None) -> tuple[float, float]:
    """Exposure by the blur of slots (C, N) that are known, near one or any; and its standard deviation."""
    known = SlotLight(fitted(lit, waves.value.shape[1] // SAMPLES), 0.0)
    tried = _EXPOSURES if near is None else near * _AROUND_EXPOSURE
    return _least(tried, np.log(_misfits(waves, known, tried.tolist())), waves)


def _least(tried: FloatArray, errors: FloatArray, waves: Waves) -> tuple[float, float]:
    """Where the logarithm of the misfit is least, by a parabola, and the standard deviation."""
    best = int(errors.argmin())
    inner = int(np.clip(best, 1, tried.size - 2))
    curvature, slope, _ = np.polyfit(tried[inner - 1 : inner + 2], errors[inner - 1 : inner + 2], 2)
    if curvature <= 0:
        return float(tried[best]), 0.3
    exposure = float(np.clip(-slope / (2 * curvature), tried[inner - 1], tried[inner + 1]))
    independent = waves.value.size / SAMPLES
    return exposure, float(np.clip(np.sqrt(1 / (curvature * independent)), 0.02, 0.5))


def _misfits(waves: Waves, known: SlotLight, exposures: list[float]) -> list[float]:
    """Weighted square of what the slots through each exposure leave of the waves, as a share."""
    around = Surroundings.of(waves.value, waves.weight, SETTINGS.local_slots * SAMPLES)
    centres = (np.arange(waves.value.shape[1])[None] + 0.5) / SAMPLES
    value, out = waves.value - around.mean, []
    total = max(float((waves.weight * value * value).sum()), 1e-9)
    for exposure in exposures:
        wave = known.seen(centres, exposure)
        near = around.moments(wave)
        residual = value - near.gain * (wave - near.wave)
        out.append(float((waves.weight * residual * residual).sum()) / total)
    return out
