"""Joint detection of slots and picture: a trellis whose paths each follow the picture (per-survivor processing).

Where every sample sees many slots, the picture behind a slot cannot be predicted from its neighbours before these are
decided. So each path through the trellis, given its slots, estimates the picture of every strip and copy by a Kalman
filter with a heavy-tailed error (Raheli, Polydoros, Tzou, IEEE Trans. Commun. 43(2/3/4), 1995), and is judged by how
well it predicts the next sample. Paths that agree in all slots that still matter are merged, unlikely ones are dropped.
Going back over the remaining paths gives the posterior of every symbol (Anastasopoulos, Chugg, IEEE Trans. Commun.
48(10), 2000).

A lane is the light of one column in one burst under one kind of words. Lanes differ much in the number of their paths,
so all paths stand in one row, ordered by lane, weight and last slots: merging is one sort, and sums over the paths of a
lane are sums over runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import TINY
from rxcli.protocol import (
    HEADER,
    PREAMBLE_SLOTS,
    SLOTS_PER_SYMBOL,
    WEIGHTS,
    codebook,
    dimming_symbol,
    slot_patterns,
)
from rxcli.receiver.decode.detect import posteriors_of, weight_shares
from rxcli.receiver.decode.settings import SURVIVORS, SurvivorSettings
from rxcli.receiver.light import Exposure
from rxcli.types import BoolArray, BurstPosteriors, BurstSamples, Float32Array, FloatArray, IntArray

#: Likelihood of a path against its lane's best one below which it is dropped: right paths come back from far.
_NEGLIGIBLE = 1e-20
#: Log probability of what cannot be.
_NEVER = -1e9
#: Least log-likelihood of a branch against its lane's best one, so that its share exists.
_LEAST = -700.0
#: Bits of a path's slots as a number, and those of a word.
_RECENT, _WORD = (1 << 2 * SLOTS_PER_SYMBOL) - 1, (1 << SLOTS_PER_SYMBOL) - 1
#: Books of words: header, codebooks by weight, dimming symbols, arbitrary slots.
_HEADER, _DIMMING, _ARBITRARY = 0, len(WEIGHTS) + 1, len(WEIGHTS) + 2
#: Bits of a weight in the order of paths.
_WEIGHT_BITS = 4


@dataclass(slots=True)
class _Paths:
    """Living paths of all lanes, in the order of their lanes; arrays (n,) or (n, copies and strips)."""

    lane: IntArray
    #: The weight (0 before the dimming symbol), and the last slots as a number.
    w: IntArray
    slots: IntArray
    log_likelihood: FloatArray
    #: Picture relative to the level of its light, and its variance.
    picture: Float32Array
    variance: Float32Array

    def taken(self, index: IntArray) -> _Paths:
        """The paths with the given numbers."""
        return _Paths(
            self.lane.take(index),
            self.w.take(index),
            self.slots.take(index),
            self.log_likelihood.take(index),
            self.picture.take(index, axis=0),
            self.variance.take(index, axis=0),
        )


@dataclass(frozen=True, slots=True)
class _Step:
    """What the way back needs of one slot: every path extends by branches, and branches merge into paths."""

    n_paths: int
    #: (J,) path that each branch extends; path that it became, -1 if it was dropped; its share of that path.
    origin: IntArray
    target: IntArray
    share: FloatArray


@dataclass(frozen=True, slots=True)
class _Words:
    """Paths at the end of a symbol, and the posterior of each in its lane."""

    lane: IntArray
    w: IntArray
    word: IntArray
    posterior: FloatArray

    def of_lanes(self, chosen: slice) -> _Words:
        """The paths of some lanes that follow each other, which count from 0."""
        own = slice(*np.searchsorted(self.lane, [chosen.start, chosen.stop]).tolist())
        return _Words(self.lane[own] - chosen.start, self.w[own], self.word[own], self.posterior[own])


@dataclass(frozen=True, slots=True)
class _Passed:
    """Result of a forward pass."""

    paths: _Paths
    steps: list[_Step]
    #: Slots at the ends of payload symbols, and the paths there.
    ends: dict[int, _Paths]
    #: (lanes,) log evidence.
    log_evidence: FloatArray
    #: (symbols, lanes) whether a symbol is followed as a word.
    is_word: BoolArray


def detect(
    samples: BurstSamples, settings: SurvivorSettings = SURVIVORS, *, has_common_weights: bool = False
) -> BurstPosteriors:
    """Posteriors of bursts from their samples; `header_llr` is 0.

    With `has_common_weights` the weights of all columns are the prior of each.
    """
    return _posteriors(samples, _forward(samples, settings), has_common_weights=has_common_weights)


def detect_against_free(
    samples: BurstSamples, settings: SurvivorSettings = SURVIVORS
) -> tuple[BurstPosteriors, FloatArray]:
    """`detect`, and (C,) log evidence of arbitrary slots, all bursts together; see `BurstPosteriors.log_evidence`."""
    passed = _forward(samples, settings, (False, True))
    free = passed.log_evidence[samples.light.shape[2] :]
    return _posteriors(samples, passed), free.reshape(samples.n_bursts, samples.n_columns).sum(axis=0)


def detect_free(samples: BurstSamples, settings: SurvivorSettings = SURVIVORS) -> tuple[Float32Array, FloatArray]:
    """(lanes, slots) probability that arbitrary slots are lit, one half before the payload; (lanes,) log evidence."""
    passed = _forward(samples, settings, (True,))
    lit = np.full((len(passed.log_evidence), samples.light.shape[0]), 0.5, np.float32)
    for end, words in zip(passed.ends, _backward(passed), strict=True):
        slots = (words.word[:, None] >> np.arange(SLOTS_PER_SYMBOL - 1, -1, -1)) & 1
        is_lit = np.add.reduceat(words.posterior[:, None] * slots, words.lane.searchsorted(np.arange(len(lit))), axis=0)
        lit[:, end + 1 - SLOTS_PER_SYMBOL : end + 1] = is_lit
    return lit, passed.log_evidence


def log_evidence_of(parts: Sequence[BurstSamples], settings: SurvivorSettings = SURVIVORS) -> FloatArray:
    """(parts, C) log evidence of packets in the columns of samples of the same slots; see `BurstPosteriors`."""
    by_lane = iter(_forward(side_by_side(parts), settings).log_evidence.reshape(-1, parts[0].n_columns))
    return np.stack([sum(next(by_lane) for _ in range(part.n_bursts)) for part in parts])


def shows_weight(samples: BurstSamples) -> BoolArray:
    """(B, C) whether more than half of the dimming symbol of each burst is in view, and a word: the border errs."""
    valid = samples.valid.max(axis=3).mean(axis=1)
    n_dimming, n_payload = valid[SLOTS_PER_SYMBOL:PREAMBLE_SLOTS].sum(axis=0), valid[PREAMBLE_SLOTS:].sum(axis=0)
    is_shown = (n_dimming > SLOTS_PER_SYMBOL / 2) & (n_payload >= SLOTS_PER_SYMBOL)
    return np.asarray(is_shown.reshape(samples.n_bursts, samples.n_columns))


def side_by_side(parts: Sequence[BurstSamples]) -> BurstSamples:
    """Samples of the same slots as lanes of one; bursts of fewer copies have some that are not valid."""
    if len(parts) == 1:
        return parts[0]
    widest = max(parts, key=lambda part: part.own.size)
    joined: dict[str, Any] = {}
    for name in ("light", "noise", "valid", "neighbours"):
        lanes = [getattr(part, name) for part in parts]
        missing = [(*3 * [(0, 0)], (0, widest.own.size - values.shape[3])) for values in lanes]
        blank = float(name == "noise")
        padded = (np.pad(values, by, constant_values=blank) for values, by in zip(lanes, missing, strict=True))
        joined[name] = np.concatenate(list(padded), axis=2)
    joined["exposure_slots"] = np.concatenate([_exposures(part) for part in parts])
    joined["log_scale"] = np.concatenate([part.log_scale for part in parts])
    log_priors = [part.w_log_prior for part in parts if part.w_log_prior is not None]
    joined["w_log_prior"] = np.concatenate(log_priors) if log_priors else None
    return replace(widest, **joined, n_bursts=sum(part.n_bursts for part in parts))


def _exposures(samples: BurstSamples) -> FloatArray:
    """(lanes,) exposures, slots."""
    return np.broadcast_to(samples.exposure_slots, samples.light.shape[2])


def _posteriors(samples: BurstSamples, passed: _Passed, *, has_common_weights: bool = False) -> BurstPosteriors:
    """Posteriors of bursts from the first lanes of a pass, which follow words."""
    n_bursts, n_columns, n_lanes = samples.n_bursts, samples.n_columns, samples.light.shape[2]
    words = [each.of_lanes(slice(0, n_lanes)) for each in _backward(passed)]
    of_weights = words[0].lane * len(WEIGHTS) + words[0].w - WEIGHTS[0]
    by_weight = np.bincount(of_weights, words[0].posterior, n_lanes * len(WEIGHTS))
    by_burst = np.log(np.maximum(by_weight, TINY)).reshape(n_bursts, n_columns, -1)
    # One weight for all bursts of a column; without the symbol that shows it, its paths may have been dropped.
    shown = shows_weight(samples)[..., None]
    w_log_prob = (by_burst * (shown | ~shown.any(axis=0))).sum(axis=0)
    w_log_prob = w_log_prob - np.logaddexp.reduce(w_log_prob, axis=1, keepdims=True)
    common = np.log(weight_shares(w_log_prob)) if has_common_weights else 0.0
    is_open = ~passed.is_word[-len(words) - 1 : -1, :n_lanes].T

    def of_words(w: int, columns: IntArray) -> FloatArray:
        posterior = np.stack([_word_posteriors(each, w, n_lanes) for each in words], axis=1)
        posterior[is_open] = 1 / posterior.shape[-1]
        return posterior.reshape(n_bursts, n_columns, *posterior.shape[1:])[:, columns]

    weights = (w_log_prob + common).argmax(axis=1) + 1
    evidence = passed.log_evidence[:n_lanes].reshape(n_bursts, n_columns).sum(axis=0)
    return posteriors_of(weights, w_log_prob, evidence, np.zeros((n_bursts, n_columns)), len(words), of_words)


def _word_posteriors(words: _Words, weight: int, n_lanes: int) -> FloatArray:
    """(lanes, words) posterior of the words of a weight, uniform where no path of that weight is left."""
    values = _values(codebook(weight))
    place_of = np.full(_WORD + 1, -1)
    place_of[values] = np.arange(len(values))
    place = np.where(words.w == weight, place_of[words.word], -1)
    own = np.flatnonzero(place >= 0)
    summed = np.bincount(words.lane[own] * len(values) + place[own], words.posterior[own], n_lanes * len(values))
    # A little for every word, since paths that were dropped are not impossible.
    of_words = summed.reshape(n_lanes, -1) + TINY
    return np.asarray(of_words / of_words.sum(axis=1, keepdims=True))


def _forward(samples: BurstSamples, settings: SurvivorSettings, kinds: tuple[bool, ...] = (False,)) -> _Passed:
    """Extend the paths slot by slot.

    Args:
        samples: of the bursts.
        settings: of the detection.
        kinds: for each kind of lanes, whether its slots are arbitrary; each has the lanes of `samples`.
    """
    n_slots, q, n_lanes = samples.light.shape[:3]
    information = settings.information_of(q)
    lanes, (light_of, reach) = np.arange(len(kinds) * n_lanes), _light_of(samples)
    drift, precision = np.float32(settings.drift_per_slot**2 / q), samples.valid / samples.noise
    packed = np.stack([samples.light, precision, samples.neighbours], axis=2)
    in_view = precision.max(axis=(2, 3)) > 0
    n_counting, is_word = _counting(samples, kinds, reach)
    paths = _start(samples, lanes, settings)
    steps: list[_Step] = []
    ends: dict[int, _Paths] = {}
    for n in range(n_slots + reach):
        symbol, place = divmod(n, SLOTS_PER_SYMBOL) if n < n_slots else (-1, n - n_slots)
        fixed = {0: _HEADER, 1: _DIMMING, -1: _HEADER}.get(symbol, paths.w)
        books = np.where(is_word[symbol].take(paths.lane), fixed, _ARBITRARY)
        gain = _log_slots()[place][books, paths.slots & ((1 << place) - 1)].ravel()
        used = np.flatnonzero(gain > _NEVER / 2)
        origin = used >> 1
        branches, n_paths = paths.taken(origin), len(paths.lane)
        branches.slots = ((branches.slots << 1) | (used & 1)) & _RECENT
        branches.log_likelihood += gain[used]
        if n == PREAMBLE_SLOTS - 1:
            _weigh(branches, is_word[symbol], samples.w_log_prior)
        if n >= reach and in_view[n - reach].any():
            sample_lane = branches.lane % n_lanes
            light = light_of(sample_lane, branches.slots)
            for each in np.flatnonzero(in_view[n - reach]).tolist():
                own, observed = samples.own * light[each][:, None], packed[n - reach, each].take(sample_lane, axis=1)
                gain = _follow(branches, own, observed, drift, settings)
                branches.log_likelihood += information / (2 * q) * gain
        # Words that differ so far differ still with a slot more.
        n_recent = np.maximum(n_counting[n], (place + 1) * is_word[symbol])
        paths, target, share = _merged(branches, lanes, (1 << n_recent) - 1, settings.max_paths)
        steps.append(_Step(n_paths, origin, target, share))
        if PREAMBLE_SLOTS <= n < n_slots and place == SLOTS_PER_SYMBOL - 1:
            ends[n] = paths
    of_noise = np.log(precision, out=np.zeros_like(precision), where=precision > 0).sum((0, 1, 3), np.float64) / (2 * q)
    of_noise = np.tile(information * (samples.log_scale + of_noise), len(kinds))
    return _Passed(paths, steps, ends, _log_totals(paths, lanes) + of_noise, is_word)


def _light_of(samples: BurstSamples) -> tuple[Callable[[IntArray, IntArray], Float32Array], int]:
    """Light in the Q samples (Q, n) by lanes of `samples` and last slots (n,); and slots beyond that of its start."""
    exposures, kind = np.unique(_exposures(samples), return_inverse=True)
    taps = [Exposure.by_start(exposure_slots, samples.light.shape[1]).taps for exposure_slots in exposures.tolist()]
    reach = max(each.shape[1] for each in taps) - 1
    patterns = slot_patterns(reach)
    levels = np.stack([patterns[:, : each.shape[1]] @ each.T for each in taps]).astype(np.float32)
    by_sample = np.ascontiguousarray(levels.reshape(-1, levels.shape[2]).T)

    def light_of(lane: IntArray, slots: IntArray) -> Float32Array:
        return by_sample.take(kind[lane] * len(patterns) + (slots & (len(patterns) - 1)), axis=1)

    return light_of, reach


def _counting(samples: BurstSamples, kinds: tuple[bool, ...], reach: int) -> tuple[IntArray, BoolArray]:
    """What the samples in view leave of a path's past.

    Returns:
        (slots + reach, lanes) number of last slots that a later sample sees; and (symbols + 1, lanes) whether a symbol,
        last the next header, is followed as a word. Of one that is mostly out of view there are as many words as there
        may be, so that it is followed as arbitrary slots.
    """
    in_view: BoolArray = np.asarray((samples.valid > 0).any(axis=(1, 3)))
    n_slots, lanes = in_view.shape
    slot, after = np.arange(n_slots + reach)[:, None], np.full(lanes, n_slots + reach)
    later = np.vstack([np.where(in_view, slot[:n_slots], n_slots + reach), np.tile(after, (reach, 1))])
    later = np.minimum.accumulate(later[::-1])[::-1]
    # The sample of slot n - reach is used up with slot n.
    next_sample = np.vstack([later, np.tile(after, (reach, 1))])[np.maximum(slot[:, 0] + 1 - reach, 0)]
    n_counting = np.clip(slot + 1 - next_sample, 0, reach)
    exposed = np.array([in_view[max(n + 1 - reach, 0) : n + 1].any(axis=0) for n in range(n_slots)])
    is_word = exposed.reshape(-1, SLOTS_PER_SYMBOL, lanes).sum(axis=1) > SLOTS_PER_SYMBOL // 2
    is_word[: PREAMBLE_SLOTS // SLOTS_PER_SYMBOL] = True
    is_word = np.vstack([is_word, np.ones((1, lanes), bool)])
    return np.tile(n_counting, len(kinds)), np.hstack([is_word & (not is_free) for is_free in kinds])


def _start(samples: BurstSamples, lanes: IntArray, settings: SurvivorSettings) -> _Paths:
    """One path for every lane, with the prior of its picture."""
    picture = np.full((lanes.size, samples.light.shape[3]), 2.0, np.float32)
    variance = np.float32(settings.first_deviation**2) * np.square(picture)
    return _Paths(lanes, 0 * lanes, 0 * lanes, np.zeros(lanes.size), picture, variance)


def _weigh(branches: _Paths, is_word: BoolArray, w_log_prior: FloatArray | None) -> None:
    """Set the weights that the dimming symbols show, where they are followed as words."""
    own = np.flatnonzero(is_word[branches.lane])
    branches.w[own] = w = np.bitwise_count(branches.slots[own] & _WORD)
    if w_log_prior is not None:
        branches.log_likelihood[own] += w_log_prior[branches.lane[own] % len(w_log_prior), w - WEIGHTS[0]]


def _follow(
    branches: _Paths, light: Float32Array, observed: Float32Array, drift: np.float32, settings: SurvivorSettings
) -> Float32Array:
    """Move the picture of the branches by a sample.

    Args:
        branches: their picture is changed.
        light: (J, F) of their own slots per unit of picture; is overwritten.
        observed: (3, J, F) the sample, one over the variance of its noise, 0 where it is not valid, and light of the
            adjacent columns; is overwritten.
        drift: variance of the picture's relative change from sample to sample.
        settings: of the detection.

    Returns:
        (J,) twice the log-likelihood of the sample, relative to that of its noise alone.
    """
    nu, (error, precision, neighbours), picture = np.float32(settings.degrees), observed, branches.picture
    light += neighbours
    # The picture drifts.
    power = np.square(picture)
    largest = np.float32(settings.max_variance) * power
    power *= drift
    variance = np.add(branches.variance, power, out=power)
    error -= np.multiply(light, picture, out=neighbours)
    gain = light * precision
    light *= gain
    widened = np.multiply(light, variance, out=neighbours)
    widened += 1
    # Student-t: variance of error**-1/2 (1 + squared / nu)**-(nu + 1) / 2, with nu = 3/2 by products and one root.
    wide = np.square(error)
    wide *= precision
    wide /= widened
    wide /= nu
    wide += 1
    density = np.sqrt(wide, out=precision)
    density *= wide
    density *= wide
    density *= widened
    total = np.log(density, out=density).sum(axis=1)
    # An outlier is a jump of the picture.
    wide *= nu / (nu + 1)
    np.maximum(wide, 1, out=wide)
    wide *= variance
    np.minimum(wide, largest, out=wide)
    light *= wide
    light += 1
    variance = np.divide(wide, light, out=wide)
    error *= gain
    error *= variance
    error += picture
    np.maximum(error, 1 / settings.max_picture, out=error)
    branches.picture, branches.variance = np.minimum(error, settings.max_picture, out=error), variance
    return np.asarray(-total)


def _merged(branches: _Paths, lanes: IntArray, recent: IntArray, max_paths: int) -> tuple[_Paths, IntArray, FloatArray]:
    """Merge branches that agree in weight and in their lane's `recent` slots, and keep the likeliest of each lane.

    Returns:
        The paths, each with the picture of its likeliest branch; (J,) the path that a branch is part of, -1 if it was
        dropped; (J,) its share of that path.
    """
    lane, log_likelihood = branches.lane, branches.log_likelihood
    top = np.maximum.reduceat(log_likelihood, lane.searchsorted(lanes))
    likelihood = np.exp(np.maximum(log_likelihood - top.take(lane), _LEAST))
    key = (((lane << _WEIGHT_BITS) | branches.w) << 2 * SLOTS_PER_SYMBOL) | (branches.slots & recent.take(lane))
    order = key.argsort(kind="stable")
    ordered = key.take(order)
    is_start = np.ones(order.size, bool)
    np.not_equal(ordered[1:], ordered[:-1], out=is_start[1:])
    group = np.empty_like(order)
    group[order] = is_start.cumsum() - 1
    total = np.bincount(group, likelihood)
    best = np.empty(total.size, np.int64)
    by_likelihood = log_likelihood.argsort(kind="stable")
    best[group.take(by_likelihood)] = by_likelihood
    of_lane = lane.take(best)
    starts = of_lane.searchsorted(lanes)
    is_living = total > _NEGLIGIBLE
    if total.size > max_paths:
        ranked = np.lexsort((-total, of_lane))
        is_living[ranked[np.arange(ranked.size) - starts.take(of_lane) >= max_paths]] = False
    living = np.flatnonzero(is_living)
    target = np.full(total.size, -1)
    target[living] = np.arange(living.size)
    paths, own = branches.taken(best.take(living)), total.take(living)
    # The remaining paths stand for the dropped ones: where nothing is visible, all are equally likely.
    missing = np.log(np.add.reduceat(total, starts) / np.add.reduceat(own, paths.lane.searchsorted(lanes)))
    paths.log_likelihood = np.log(own) + (top + missing).take(paths.lane)
    return paths, target.take(group), likelihood / total.take(group)


def _log_totals(paths: _Paths, lanes: IntArray) -> FloatArray:
    """(lanes,) log-likelihood of the paths of each lane together."""
    return np.asarray(np.logaddexp.reduceat(paths.log_likelihood, paths.lane.searchsorted(lanes)))


def _backward(passed: _Passed) -> list[_Words]:
    """Paths at the end of every payload symbol, with their posteriors."""
    paths, out = passed.paths, []
    totals = _log_totals(paths, np.arange(len(passed.log_evidence)))
    posterior = np.exp(paths.log_likelihood - totals[paths.lane])
    for n in range(len(passed.steps) - 1, PREAMBLE_SLOTS - 1, -1):
        if n in passed.ends:
            own = passed.ends[n]
            out.append(_Words(own.lane, own.w, own.slots & _WORD, posterior))
        step = passed.steps[n]
        posterior = np.bincount(step.origin, np.append(posterior, 0.0)[step.target] * step.share, step.n_paths)
    return out[::-1]


def _values(book: NDArray[np.integer[Any]]) -> IntArray:
    """Words of a book as numbers."""
    return np.asarray(book, np.int64) @ (1 << np.arange(SLOTS_PER_SYMBOL - 1, -1, -1))


@cache
def _log_slots() -> list[FloatArray]:
    """Of each place in a word, (books, slots so far as a number, 2) log probability that the next slot is dark, lit."""
    books = [
        [HEADER],
        *(codebook(w) for w in WEIGHTS),
        [dimming_symbol(w) for w in WEIGHTS],
        slot_patterns(SLOTS_PER_SYMBOL - 1),
    ]
    count = np.zeros((len(books), SLOTS_PER_SYMBOL + 1, _WORD + 1))
    for number, book in enumerate(books):
        values = _values(np.array(book))
        for length in range(SLOTS_PER_SYMBOL + 1):
            np.add.at(count[number, length], values >> (SLOTS_PER_SYMBOL - length), 1)
    log = np.where(count > 0, np.log(np.maximum(count, 1)), _NEVER)
    begun = [log[:, place, : 1 << place, None] for place in range(SLOTS_PER_SYMBOL)]
    return [
        log[:, place + 1, : 2 << place].reshape(*before.shape[:2], 2) - before for place, before in enumerate(begun)
    ]
