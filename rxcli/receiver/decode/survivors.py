"""Joint detection of slots and picture: a trellis whose paths each follow the picture (per-survivor processing).

Where every sample sees many slots, the picture behind a slot cannot be predicted from its neighbours before these are
decided. So each path through the trellis, given its slots, estimates the picture of every strip and copy by a Kalman
filter with a heavy-tailed error (Raheli, Polydoros, Tzou, IEEE Trans. Commun. 43(2/3/4), 1995), and is judged by how
well it predicts the next sample. Paths that agree in all slots that still matter are merged, unlikely ones are dropped.
A backward recursion over the remaining paths gives the posterior of every symbol (Anastasopoulos, Chugg, IEEE
Trans. Commun. 48(10), 2000).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

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
from rxcli.receiver.light import exposed_from
from rxcli.types import BoolArray, BurstPosteriors, BurstSamples, Float32Array, FloatArray, IntArray

#: Likelihood of a path against the best one's below which it is dropped: that of rounding in single precision.
_NEGLIGIBLE = float(np.finfo(np.float32).eps)
#: Log probability of what cannot be.
_NEVER = -1e9
#: Number of bits of a path's slots of a path as a number; the bits of a word.
_RECENT, _WORD = (1 << 2 * SLOTS_PER_SYMBOL) - 1, (1 << SLOTS_PER_SYMBOL) - 1
#: Books of words: header, codebooks by weight, dimming symbols, arbitrary slots.
_HEADER, _DIMMING, _ARBITRARY = 0, len(WEIGHTS) + 1, len(WEIGHTS) + 2
#: Of each word in order: posterior, weight and slots of the paths, (lanes, paths) each.
_Words = list[tuple[FloatArray, IntArray, IntArray]]


@dataclass(frozen=True, slots=True)
class _Step:
    """What the backward recursion needs of one slot: J branches from I paths; for every lane."""

    #: (I',) paths with branches and their first branches; number of paths, I.
    origins: IntArray
    starts: IntArray
    n_paths: int
    #: (lanes, J) path that a branch leads to, -1 if it was dropped; and its log-likelihood.
    target: IntArray
    gain: FloatArray


@dataclass(slots=True)
class _Paths:
    """Surviving paths; arrays (lanes, paths) or (lanes, paths, samples' strips)."""

    #: The last slots as a number, and the weight (0 before the dimming symbol).
    slots: IntArray
    w: IntArray
    log_likelihood: FloatArray
    #: Picture relative to the local light, and its variance.
    picture: Float32Array
    variance: Float32Array

    def taken(self, index: IntArray) -> _Paths:
        """The paths with the given numbers, (lanes, n), or (n,) of every lane."""
        lanes, n_paths = self.w.shape
        place = index + n_paths * np.arange(lanes)[:, None]
        of_paths = [values.take(place) for values in (self.slots, self.w, self.log_likelihood)]
        of_strips = [
            values.reshape(-1, values.shape[2]).take(place, axis=0) for values in (self.picture, self.variance)
        ]
        return _Paths(*of_paths, *of_strips)


def detect(
    samples: BurstSamples, settings: SurvivorSettings = SURVIVORS, *, has_common_weights: bool = False
) -> BurstPosteriors:
    """Posteriors of bursts from their samples; `header_llr` is 0.

    With `has_common_weights` the weights of all columns are the prior of each.
    """
    n_bursts, n_columns = samples.n_bursts, samples.n_columns
    paths, steps, ends, is_followed = _forward(samples, settings, is_free=False)
    words = _backward(steps, ends, np.zeros_like(paths.log_likelihood))
    posterior, of_paths, _ = words[0]
    by_weight = np.stack([(posterior * (of_paths == w)).sum(axis=1) for w in WEIGHTS], axis=1)
    by_burst = np.log(np.maximum(by_weight, TINY)).reshape(n_bursts, n_columns, -1)
    # One weight for all bursts of a column; without the symbol that shows it, its paths may have been dropped.
    shown = shows_weight(samples)[..., None]
    w_log_prob = (by_burst * (shown | ~shown.any(axis=0))).sum(axis=0)
    w_log_prob = w_log_prob - np.logaddexp.reduce(w_log_prob, axis=1, keepdims=True)
    common = np.log(weight_shares(w_log_prob)) if has_common_weights else 0.0
    is_word = is_followed[-len(words) :, :, 0].T

    def of_words(w: int, columns: IntArray) -> FloatArray:
        posterior = _word_posteriors(words, w)
        posterior[~is_word] = 1 / posterior.shape[-1]
        return posterior.reshape(n_bursts, n_columns, *posterior.shape[1:])[:, columns]

    weights = (w_log_prob + common).argmax(axis=1) + 1
    evidence = _log_evidence(paths, samples, settings).reshape(n_bursts, n_columns).sum(axis=0)
    return posteriors_of(weights, w_log_prob, evidence, np.zeros((n_bursts, n_columns)), len(words), of_words)


def shows_weight(samples: BurstSamples) -> BoolArray:
    """(B, C) whether more than half of the dimming symbol of each burst is in view, and a word: the border errs."""
    valid = samples.valid.max(axis=3).mean(axis=1)
    n_dimming, n_payload = valid[SLOTS_PER_SYMBOL:PREAMBLE_SLOTS].sum(axis=0), valid[PREAMBLE_SLOTS:].sum(axis=0)
    is_shown = (n_dimming > SLOTS_PER_SYMBOL / 2) & (n_payload >= SLOTS_PER_SYMBOL)
    return np.asarray(is_shown.reshape(samples.n_bursts, samples.n_columns))


def lane_log_evidence(samples: BurstSamples, settings: SurvivorSettings = SURVIVORS) -> FloatArray:
    """(lanes,) log evidence of packets in each burst and column; see `BurstPosteriors.log_evidence`."""
    paths, *_ = _forward(samples, settings, is_free=False)
    return _log_evidence(paths, samples, settings)


def side_by_side(parts: Sequence[BurstSamples]) -> BurstSamples:
    """Samples of one shape as lanes of one, since the number of lanes hardly counts for the time."""
    if len(parts) == 1:
        return parts[0]
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts], axis=2)
        for name in ("light", "noise", "valid", "neighbours")
    }
    log_scale = np.concatenate([part.log_scale for part in parts])
    log_priors = [part.w_log_prior for part in parts if part.w_log_prior is not None]
    joined["w_log_prior"] = np.concatenate(log_priors) if log_priors else None
    return replace(parts[0], **joined, log_scale=log_scale, n_bursts=len(parts) * parts[0].n_bursts)


def free_log_evidence(samples: BurstSamples, settings: SurvivorSettings = SURVIVORS) -> FloatArray:
    """(C,) log evidence of arbitrary slots, all bursts together; see `BurstPosteriors.log_evidence`."""
    paths, *_ = _forward(samples, settings, is_free=True)
    log_evidence = _log_evidence(paths, samples, settings)
    return np.asarray(log_evidence.reshape(samples.n_bursts, samples.n_columns).sum(axis=0))


def detect_free(samples: BurstSamples, settings: SurvivorSettings = SURVIVORS) -> tuple[Float32Array, FloatArray]:
    """(lanes, slots) probability that arbitrary slots are lit, one half before the payload; (lanes,) log evidence."""
    paths, steps, ends, _ = _forward(samples, settings, is_free=True)
    lit = np.full((len(paths.w), samples.light.shape[0]), 0.5, np.float32)
    words = _backward(steps, ends, np.zeros_like(paths.log_likelihood))
    for (n, _), (posterior, _, word) in zip(ends, words, strict=True):
        slots = (word[..., None] >> np.arange(SLOTS_PER_SYMBOL - 1, -1, -1)) & 1
        lit[:, n + 1 - SLOTS_PER_SYMBOL : n + 1] = (posterior[..., None] * slots).sum(axis=1)
    return lit, _log_evidence(paths, samples, settings)


def _log_evidence(paths: _Paths, samples: BurstSamples, settings: SurvivorSettings) -> FloatArray:
    """(lanes,) log evidence of the last paths together."""
    return np.asarray(np.logaddexp.reduce(paths.log_likelihood, axis=1) + samples.log_scale * settings.information)


def _forward(
    samples: BurstSamples, settings: SurvivorSettings, *, is_free: bool
) -> tuple[_Paths, list[_Step], list[tuple[int, _Paths]], BoolArray]:
    """Extend the paths slot by slot.

    Returns:
        The last paths, the steps, the paths at the end of every symbol, and what symbols are words, see `_counting`.
    """
    n_slots = samples.light.shape[0]
    taps = exposed_from(samples.exposure_slots, samples.light.shape[1])
    reach = taps.shape[1] - 1
    levels = (slot_patterns(reach) @ taps.T).T.astype(np.float32)
    paths = _start(samples, settings)
    steps: list[_Step] = []
    ends: list[tuple[int, _Paths]] = []
    n_counting, is_followed = _counting(samples)
    for n in range(n_slots + reach):
        symbol, place = divmod(n, SLOTS_PER_SYMBOL) if n < n_slots else (0, n - n_slots)
        is_dimming = symbol == 1 and n < n_slots
        book = _ARBITRARY if is_free else (_HEADER, _DIMMING)[symbol] if symbol < 2 else None
        books = 0 * paths.w + book if book is not None else np.where(is_followed[symbol], paths.w, _ARBITRARY)
        origin, branches, gain = _branches(paths, books, place)
        if is_dimming and place == SLOTS_PER_SYMBOL - 1 and not is_free:
            branches.w = np.bitwise_count(branches.slots & _WORD).astype(np.int64)
            if samples.w_log_prior is not None:
                gain = gain + np.take_along_axis(
                    samples.w_log_prior, np.clip(branches.w, WEIGHTS[0], WEIGHTS[-1]) - 1, 1
                )
        if n >= reach:
            gain = gain + settings.information * _update(branches, samples, n - reach, levels, settings)
        branches.log_likelihood = branches.log_likelihood + gain
        n_recent: IntArray | None = n_counting[n]
        if n < n_slots and not is_free:
            # Paths that differ in their word so far differ still with a slot more.
            is_plain = place >= reach and is_followed[symbol].all()
            n_recent = None if is_plain else np.maximum(n_counting[n], (place + 1) * is_followed[symbol])
        target, remaining = _merged(branches, n_recent, settings)
        is_start = np.ones(origin.size, bool)
        np.not_equal(origin[1:], origin[:-1], out=is_start[1:])
        starts = np.flatnonzero(is_start)
        steps.append(_Step(origin[starts], starts, paths.w.shape[1], target, gain))
        paths = remaining
        if PREAMBLE_SLOTS <= n < n_slots and place == SLOTS_PER_SYMBOL - 1:
            ends.append((n, paths))
    return paths, steps, ends, is_followed


def _counting(samples: BurstSamples) -> tuple[IntArray, BoolArray]:
    """What the samples in view leave of a path's past.

    Returns:
        (slots + reach, lanes, 1) number of last slots that a later sample sees; and (symbols, lanes, 1) whether a
        symbol is followed as a word. Of one that is mostly out of view there are as many words as there may be, so that
        it is followed as arbitrary slots.
    """
    reach = exposed_from(samples.exposure_slots, samples.light.shape[1]).shape[1] - 1
    in_view: BoolArray = np.asarray((samples.valid > 0).any(axis=(1, 3)))
    n_slots, lanes = in_view.shape
    slot, after = np.arange(n_slots + reach)[:, None], np.full(lanes, n_slots + reach)
    later = np.vstack([np.where(in_view, slot[:n_slots], n_slots + reach), np.tile(after, (reach, 1))])
    later = np.minimum.accumulate(later[::-1])[::-1]
    # The sample of slot n - reach is used up with slot n.
    next_sample = np.vstack([later, np.tile(after, (reach, 1))])[np.maximum(slot[:, 0] + 1 - reach, 0)]
    n_counting = np.clip(slot + 1 - next_sample, 0, reach)
    exposed = np.array([in_view[max(n + 1 - reach, 0) : n + 1].any(axis=0) for n in range(n_slots)])
    is_followed = exposed.reshape(-1, SLOTS_PER_SYMBOL, lanes).sum(axis=1) > SLOTS_PER_SYMBOL // 2
    is_followed[: PREAMBLE_SLOTS // SLOTS_PER_SYMBOL] = True
    return n_counting[..., None], is_followed[..., None]


def _start(samples: BurstSamples, settings: SurvivorSettings) -> _Paths:
    lanes, n_strips = samples.light.shape[2:]
    picture = np.full((lanes, 1, n_strips), 2.0, np.float32)
    none = np.zeros((lanes, 1), np.int64)
    variance = np.float32(settings.first_deviation**2) * np.square(picture)
    return _Paths(none, none, np.zeros((lanes, 1)), picture, variance)


def _branches(paths: _Paths, books: IntArray, place: int) -> tuple[IntArray, _Paths, FloatArray]:
    """Both next slots of every path.

    Args:
        paths: I paths.
        books: (lanes, I) the book of the current word of each.
        place: slots of that word that a path has.

    Returns:
        (J,) the path that each branch extends; the branches, only where a lane allows them; (lanes, J) the log
        probability of their slot.
    """
    gain = _log_slots()[place][books, paths.slots & ((1 << place) - 1)].reshape(len(books), -1)
    used = np.flatnonzero((gain > _NEVER / 2).any(axis=0))
    origin = used >> 1
    out = paths.taken(origin)
    out.slots = ((out.slots << 1) | (used & 1)) & _RECENT
    return origin, out, gain[:, used]


def _update(
    branches: _Paths, samples: BurstSamples, slot: int, levels: Float32Array, settings: SurvivorSettings
) -> FloatArray:
    """Log-likelihood of the samples whose exposure starts in `slot`; moves the picture of the branches."""
    window = branches.slots & (levels.shape[1] - 1)
    nu, q = np.float32(settings.degrees), samples.light.shape[1]
    drift = np.float32(settings.drift_per_slot**2 / q)
    picture, variance = branches.picture, branches.variance
    total = np.zeros(window.shape, np.float32)
    for place in range(q):
        valid = samples.valid[slot, place][:, None]
        least, most = valid.min(), valid.max()
        if not most:
            continue
        noise = samples.noise[slot, place][:, None]
        light: Float32Array = samples.own * levels[place].take(window)[..., None]
        light += samples.neighbours[slot, place][:, None]
        power = np.square(picture)
        largest = settings.max_variance * power
        power *= drift
        variance = np.add(variance, power, out=power)
        error = light * picture
        np.subtract(samples.light[slot, place][:, None], error, out=error)
        power = np.square(light)
        error_variance = power * variance
        error_variance += noise
        squared = np.square(error)
        squared /= error_variance
        # Student-t: error_variance**-1/2 (1 + squared / nu)**-(nu + 1) / 2, with nu = 3/2 by products and one root.
        wide = squared / nu
        wide += 1
        density = np.square(wide)
        density *= np.sqrt(wide, out=wide)
        density *= error_variance
        np.log(density, out=density)
        if not least:
            density *= valid
        total -= density.sum(axis=-1)
        # An outlier is a jump of the picture.
        squared += nu
        squared /= nu + 1
        np.maximum(squared, 1, out=squared)
        squared *= variance
        variance = np.minimum(squared, largest, out=squared)
        power *= variance
        power += noise
        gain = light * variance
        gain /= power
        if not least:
            gain *= valid
        error *= gain
        error += picture
        np.maximum(error, 1 / settings.max_picture, out=error)
        picture = np.minimum(error, settings.max_picture, out=error)
        gain *= light
        np.subtract(1, gain, out=gain)
        gain *= variance
        variance = np.maximum(gain, 0, out=gain)
    branches.picture, branches.variance = picture, variance
    return np.asarray(total / (2 * q), np.float64)


def _merged(branches: _Paths, n_recent: IntArray | None, settings: SurvivorSettings) -> tuple[IntArray, _Paths]:
    """Merge branches that agree in weight and in their lane's last `n_recent` slots, and keep the likeliest.

    None: all differ.

    Returns:
        (lanes, J) the path that a branch is part of, -1 if it was dropped; the paths.
    """
    likelihood = branches.log_likelihood
    lanes, n_groups = likelihood.shape
    lane = np.arange(lanes)[:, None]
    top = likelihood.max(axis=1, keepdims=True)
    share = np.exp(np.maximum(likelihood - top, -700))
    best = group = np.arange(lanes * n_groups).reshape(lanes, n_groups)
    if n_recent is not None:
        best, group, n_groups = _groups(branches, n_recent)
        share = np.bincount(group.ravel(), share.ravel(), lanes * n_groups).reshape(lanes, n_groups)
    n_chosen = min(settings.max_paths, int((share > _NEGLIGIBLE).sum(axis=1).max()), n_groups)
    chosen: IntArray = np.arange(n_groups) + 0 * lane
    if n_chosen < n_groups:
        chosen = np.argpartition(-share, n_chosen - 1, axis=1)[:, :n_chosen]
    elif n_recent is None:
        return chosen, branches
    chosen = chosen + n_groups * lane
    place_of = np.full(lanes * n_groups, -1)
    place_of[chosen] = np.arange(n_chosen)
    paths = branches.taken(best.take(chosen) - likelihood.shape[1] * lane)
    # The remaining paths stand for the dropped ones: where nothing is visible, all are equally likely.
    chosen_share = share.take(chosen)
    paths.log_likelihood = np.log(np.maximum(chosen_share, TINY**10)) + top
    paths.log_likelihood += np.log(share.sum(axis=1, keepdims=True) / chosen_share.sum(axis=1, keepdims=True))
    return place_of[group], paths


def _groups(branches: _Paths, n_recent: IntArray) -> tuple[IntArray, IntArray, int]:
    """Groups of branches that agree: (lanes, groups) number of the likeliest branch; (lanes, J) that of its group."""
    likelihood = branches.log_likelihood
    lanes, n_branches = likelihood.shape
    lane = np.arange(lanes)[:, None]
    key = (branches.w << 2 * SLOTS_PER_SYMBOL) | (branches.slots & ((np.int64(1) << n_recent) - 1))
    place = np.lexsort((-likelihood, key)) + n_branches * lane
    ordered = key.take(place)
    is_first = np.ones((lanes, n_branches), bool)
    np.not_equal(ordered[:, 1:], ordered[:, :-1], out=is_first[:, 1:])
    number = is_first.cumsum(axis=1) - 1
    n_groups = int(number[:, -1].max()) + 1
    number += n_groups * lane
    group = np.empty_like(number)
    group.put(place, number)
    best = np.repeat(n_branches * lane, n_groups, axis=1)
    best.put(number[is_first], place[is_first])
    return best, group, n_groups


def _backward(steps: list[_Step], ends: list[tuple[int, _Paths]], after: FloatArray) -> _Words:
    """Posterior, weight and word of the paths at the end of every symbol, (lanes, paths) each."""
    out: _Words = []
    pending = list(ends)
    for n in range(len(steps) - 1, PREAMBLE_SLOTS - 1, -1):
        if pending and pending[-1][0] == n:
            paths = pending.pop()[1]
            posterior = paths.log_likelihood + after
            posterior = np.exp(posterior - posterior.max(axis=1, keepdims=True))
            out.append((posterior / posterior.sum(axis=1, keepdims=True), paths.w, paths.slots & _WORD))
        step = steps[n]
        gain = step.gain + after.take(np.maximum(step.target, 0) + after.shape[1] * np.arange(len(after))[:, None])
        gain[step.target < 0] = _NEVER
        top = gain.max(axis=1, keepdims=True)
        total = np.add.reduceat(np.exp(gain - top), step.starts, axis=1)
        after = np.full((len(gain), step.n_paths), _NEVER)
        after[:, step.origins] = np.log(np.maximum(total, TINY**10)) + top
        after -= after.max(axis=1, keepdims=True)
    return out[::-1]


def _word_posteriors(words: _Words, weight: int) -> FloatArray:
    """(lanes, N, words) posterior of the words of a weight, uniform where no path of that weight is left."""
    place_of = np.full(_WORD + 1, -1)
    place_of[codebook(weight) @ (1 << np.arange(SLOTS_PER_SYMBOL - 1, -1, -1))] = np.arange(len(codebook(weight)))
    out = np.empty((len(words[0][0]), len(words), len(codebook(weight))))
    lane = np.arange(len(out))[:, None]
    for number, (posterior, w, word) in enumerate(words):
        # A little for every word, since paths that were dropped are not impossible.
        of_words = np.full((len(out), out.shape[-1]), TINY)
        place = place_of[word]
        np.add.at(of_words, (lane, np.maximum(place, 0)), np.where((w == weight) & (place >= 0), posterior, 0.0))
        out[:, number] = of_words / of_words.sum(axis=1, keepdims=True)
    return out


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
        values = np.array(book, np.int64) @ (1 << np.arange(SLOTS_PER_SYMBOL - 1, -1, -1))
        for length in range(SLOTS_PER_SYMBOL + 1):
            np.add.at(count[number, length], values >> (SLOTS_PER_SYMBOL - length), 1)
    log = np.where(count > 0, np.log(np.maximum(count, 1)), _NEVER)
    begun = [log[:, place, : 1 << place, None] for place in range(SLOTS_PER_SYMBOL)]
    return [
        log[:, place + 1, : 2 << place].reshape(*before.shape[:2], 2) - before for place, before in enumerate(begun)
    ]
