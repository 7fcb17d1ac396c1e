"""From a locked clock to posteriors: light model and detection in turn. Part of the wiring."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import ReceiverError
from rxcli.options import ReceiverOptions
from rxcli.protocol import SLOTS_PER_SYMBOL, WEIGHTS
from rxcli.receiver import channel, sync
from rxcli.receiver.channel import denoise
from rxcli.receiver.decode import assemble, detect
from rxcli.receiver.locate import Lock, noise_of
from rxcli.types import BurstPosteriors, Clock, Float32Array, FloatArray, SlotSamples

#: Samples a slot: of first looks, and of those at columns that are still in doubt.
_COARSE, _FINE = 2, 4
_MAX_ITERATIONS = 3
#: Below so many rows a slot it shows that developing mixes rows; as how wide a box of rows, is tried.
_FEW_ROWS = 4.0
_MIXED_ROWS = (0.0, 1.0, 1.7, 2.4, 3.0)
#: A column whose packets have at least this confidence, or whose symbols this log probability whatever slots say,
#: is not looked at again. Of 2699 packets of simulated frames a quick look leaves 1322 so, two of them wrong.
_CERTAIN, _BEYOND_DOUBT = 0.99, -1e-3
#: A column whose slots stand out less than this has no light to speak of.
_DARK_SNR_DB = -3.0
#: Weights that a quick look finds this much less likely than the best are dropped, nats.
HOPELESS_WEIGHT = 20.0
#: A column with a packet of less confidence is looked at without the rows' own light, and gets a second opinion, in
#: which symbols of less than this log probability are weighed. Where the gate comes from: docs/auto_encoder.md.
_DOUBTFUL, _DOUBTFUL_WORD = 0.985, -1e-2
#: A column none of whose packets has symbols of at least this mean log probability is beyond repair: of 133 packets of
#: such columns no second opinion made one error-free.
_BEYOND_REPAIR = -1.0
#: Of symbols in doubt, so many words are weighed, down to so many nats below the best; not where even that is less
#: likely than this, a log probability: there is nothing to choose from.
_WORDS, _WORD_MARGIN, _HOPELESS_WORD = 4, 5.0, -1.4
#: Slots of strips that the network is shown, at most: it takes most of the time. Columns beyond them, the least sure,
#: have their words weighed alone.
_MOST_SHOWN = 58_000
#: A column whose slots are so much likelier packets than any slots, nats, has packets whether its header shows or not:
#: on wrong clocks columns show 74 at most.
_PACKETS_WITHOUT_HEADER = 100.0
#: A column whose symbols have a mean log probability below this may have settled on a wrong weight: it starts again,
#: after so many quick rounds.
_LOST, _FRESH_ROUNDS = -0.3, 2
#: Bursts are doubted where less than this share of the columns has packets of such a confidence, and where they are
#: not so much likelier than others by how alike copies are, nats.
_CLEAR_COLUMNS, _CLEAR, _PLAIN_BURSTS = 0.9, 0.9, 300.0


@dataclass(frozen=True, slots=True)
class Reception:
    """What was received of a frame."""

    clock: Clock
    #: Of the quick look: strips pooled in pairs.
    samples: SlotSamples
    posteriors: BurstPosteriors
    #: (C, N): squared contrast over variance of every slot.
    snr: Float32Array
    #: For the samples.
    model: channel.LightModel
    #: (C, N + memory, patterns).
    metrics: FloatArray
    #: What the auto-encoder may be shown: the fine grid without the rows' own light; None where nothing was in doubt.
    scene: denoise.Scene | None = None
    #: What was skipped: name -> columns.
    skipped: dict[str, int] = field(default_factory=dict)


def decode_likeliest(lock: Lock, skip: frozenset[str]) -> Reception:
    """What is decoded on the clock, and with the bursts, by which slots are packets most.

    Bursts are told apart by how alike copies are. Where symbols stay in doubt that may be why: copies of two packets,
    taken for one, decode to neither.

    Args:
        lock: the clock, perhaps another that it may be, and the row profiles.
        skip: shortcuts in use, see `rxcli.options.SKIPS`.
    """
    if lock.rival is not None:
        either = (replace(lock, clock=now, rival=None) for now in (lock.clock, lock.rival))
        return max((decode_likeliest(one, skip) for one in either), key=packet_evidence)
    seen = decode(lock, skip)
    confidence = np.where(_complete(seen), _confidence(seen), 0.0).max(axis=0)
    if not confidence.any() or (confidence > _CLEAR).mean() >= _CLEAR_COLUMNS:
        return seen
    possible = sync.possible_bursts(seen.clock, detect.slot_llr(seen.metrics), lock.screen.repeats)
    plain = len(possible) == 1 or possible[0][1] - possible[1][1] > _PLAIN_BURSTS
    if plain and np.array_equal(possible[0][0].burst, seen.clock.burst):
        return seen
    looks = [_first_look(replace(lock, burst=now.burst)) for now, _ in possible]
    likeliest = max(looks, key=packet_evidence).clock.burst
    if np.array_equal(likeliest, seen.clock.burst):
        return seen
    return max(seen, decode(replace(lock, burst=likeliest), skip), key=packet_evidence)


def decode(lock: Lock, skip: frozenset[str]) -> Reception:
    """A quick look first; where that leaves doubt, the light model in depth.

    Args:
        lock: the clock and the row profiles.
        skip: shortcuts in use, see `rxcli.options.SKIPS`.
    """
    seen = _first_look(lock)
    doubtful = _doubtful(seen, _CERTAIN) if "certain_columns" in skip else np.ones(seen.snr.shape[0], bool)
    if not doubtful.any():
        return replace(seen, skipped={"certain_columns": seen.snr.shape[0]})
    lock = lock.in_depth(np.flatnonzero(doubtful))
    seen = iterate(lock, seen, doubtful, skip)
    columns = doubtful_columns(seen)
    return without_row_light(lock, seen, columns) if columns.size else seen


def _first_look(lock: Lock) -> Reception:
    return quick_look(lock) if lock.clock.rows_per_slot >= _FEW_ROWS else _likeliest_mix(lock)


def quick_look(lock: Lock) -> Reception:
    """One pass over the strips pooled in pairs, from the first guess."""
    lock = lock.in_pairs()
    now = lock.clock
    samples = sync.sample_slots(lock.profiles, now, _COARSE)
    model = _light_model(lock, samples)
    contrast = sync.contrast(samples.light, samples.valid, _COARSE, model.sigma)
    first = channel.first_metrics(*contrast, model.taps)
    now = _in_bursts(lock, now, detect.slot_llr(first))
    lit = channel.on_grid(_first_guess(_by_burst(first, now), model.memory), now)
    columns = np.arange(samples.light.shape[0])
    likelihoods = channel.slot_likelihoods(samples, now, model, lit, columns, thorough=False)
    now = _in_bursts(lock, now, detect.slot_llr(likelihoods.metrics))
    now = sync.corrected(now, likelihoods.timing)
    posteriors = _detect(likelihoods.metrics, now)
    return Reception(now, samples, posteriors, likelihoods.snr, model, likelihoods.metrics)


def _first_guess(metrics: FloatArray, memory: int) -> Float32Array:
    """(B, C, packet) slots of bursts by the first guess of the metrics; longer exposures need the trellis."""
    if memory == 1:
        return detect.first_guess(metrics)
    return detect.detect(metrics, detect.plausible_weights(metrics, 0.0)).lit


def _likeliest_mix(lock: Lock) -> Reception:
    """The quick look with the exposure widened by the rows that demosaicing and denoising mixed, as the light has it.

    They tell on a slot of few rows: one of 1.5 rows that is exposed for 0.4 slots is seen as if for 1.2 and more.
    """
    lock, now = lock.in_pairs(), lock.clock
    widths = (np.hypot(now.exposure_slots, mixed / now.rows_per_slot) for mixed in _MIXED_ROWS)
    looks = [quick_look(replace(lock, clock=replace(now, exposure_slots=float(width)))) for width in widths]
    return max(looks, key=lambda seen: float(_evidence(seen.metrics, seen.clock).sum()))


def iterate(lock: Lock, seen: Reception, doubtful: NDArray[np.bool_], skip: frozenset[str]) -> Reception:
    """Light model and detection in turn, until every column is certain or nothing more is to be expected.

    Columns in doubt, (C,), are looked at on the coarse grid once, and those that still are on the fine one.
    """
    every = np.ones(seen.snr.shape[0], bool)
    wanted = ~_dark(seen.snr) if "dark_columns" in skip else every
    skipped = {"dark_columns": int((~wanted).sum()), "certain_columns": 0}
    for iteration in range(_MAX_ITERATIONS):
        columns = np.flatnonzero(wanted & doubtful)
        skipped["certain_columns"] += int(wanted.sum()) - columns.size
        if columns.size == 0:
            break
        before = seen.posteriors.index
        seen, timing = _look_again(lock, seen, columns, _COARSE if iteration == 0 else _FINE)
        if iteration == 0:
            seen = _with_bursts_of(lock, seen, detect.slot_llr(seen.metrics))
            seen = replace(seen, clock=sync.corrected(seen.clock, timing))
        doubtful = _unsettled(seen, before, iteration, skip)
    return replace(seen, skipped={name: count for name, count in skipped.items() if count})


def _look_again(
    lock: Lock, seen: Reception, columns: NDArray[np.int64], samples_per_slot: int
) -> tuple[Reception, FloatArray]:
    """What is seen with some columns looked at again, and the (C, 2) timing of all, 0 for the others."""
    samples, model = _view(lock, seen, columns, samples_per_slot)
    lit = channel.lit_on_grid(seen.posteriors, seen.clock)
    likelihoods = channel.slot_likelihoods(samples, seen.clock, model, lit, columns)
    metrics, snr, timing = seen.metrics.copy(), seen.snr.copy(), np.zeros((lit.shape[0], 2))
    metrics[columns], snr[columns], timing[columns] = likelihoods.metrics, likelihoods.snr, likelihoods.timing
    posteriors = _replaced(seen.posteriors, columns, _detect(metrics[columns], seen.clock))
    return replace(seen, metrics=metrics, snr=snr, posteriors=posteriors), timing


def _view(
    lock: Lock, seen: Reception, columns: NDArray[np.int64], samples_per_slot: int
) -> tuple[SlotSamples, channel.LightModel]:
    """All strips of some columns, and the light model of the quick look fitted to them."""
    now, quick = seen.clock, seen.samples
    samples = sync.sample_slots(lock.profiles, now, samples_per_slot, columns)
    n_strips = samples.light.shape[1]
    # A sample of the quick look has so many times the pixels.
    larger = n_strips / quick.light.shape[1]
    larger *= _rows_per_sample(now, quick.samples_per_slot) / _rows_per_sample(now, samples_per_slot)
    model = replace(
        seen.model,
        sigma=seen.model.sigma * larger**0.5,
        shot=seen.model.shot * larger,
        spread=channel.spread_matrix(n_strips, lock.screen.light_spread),
        taps=_taps(now, samples_per_slot),
    )
    return samples, model


def _replaced(every: BurstPosteriors, columns: NDArray[np.int64], some: BurstPosteriors) -> BurstPosteriors:
    """Posteriors of all columns, with those of some in their place."""

    def merged(name: str) -> Any:
        out = getattr(every, name).copy()
        out[_in_columns(name, columns)] = getattr(some, name)
        return out

    return BurstPosteriors(*(merged(field.name) for field in fields(BurstPosteriors)))


def of_columns(every: BurstPosteriors, columns: NDArray[np.int64]) -> BurstPosteriors:
    """Posteriors of some columns."""
    return BurstPosteriors(*(getattr(every, f.name)[_in_columns(f.name, columns)] for f in fields(BurstPosteriors)))


def _in_columns(name: str, columns: NDArray[np.int64]) -> Any:
    """Index of some columns in a field of the posteriors; bursts come first in all but the weights."""
    return columns if name.startswith("w") else (slice(None), columns)


def _dark(snr: Float32Array) -> NDArray[np.bool_]:
    """(C,) whether a column has too little light for the light model to make anything of it."""
    seen, lit = ((snr > least).sum(axis=1) for least in (0.0, 10 ** (_DARK_SNR_DB / 10)))
    return np.asarray((2 * lit < seen) | (seen == 0))


def _unsettled(seen: Reception, before: NDArray[np.int64], iteration: int, skip: frozenset[str]) -> NDArray[np.bool_]:
    """(C,) which columns are worth another iteration."""
    if "certain_columns" not in skip:
        return np.ones(seen.snr.shape[0], bool)
    doubtful = _doubtful(seen, _CERTAIN)
    index = seen.posteriors.index
    if iteration and before.shape == index.shape:
        # What does not change any more will not do so later.
        doubtful &= (before != index).any(axis=(0, 2))
    return doubtful


def second_opinion(
    lock: Lock, seen: Reception, options: ReceiverOptions
) -> tuple[Reception, frozenset[int], dict[str, Any] | None]:
    """Doubtful columns once more, with the auto-encoder's corrections and words weighed; kept where less doubt is left.

    Returns:
        What was received then, the columns whose corrections were kept, what to report; None where nothing was done.
    """
    if options.cae == "never":
        return seen, frozenset(), None
    if options.cae == "always":
        columns = np.arange(seen.snr.shape[0])
        seen = without_row_light(lock.in_depth(columns), seen, columns)
    else:
        columns = doubtful_columns(seen)
        columns = columns[_best_packet(seen)[columns] > _BEYOND_REPAIR]
    if columns.size == 0 or seen.scene is None:
        return seen, frozenset(), None
    report: dict[str, Any] = {"model": denoise.DEFAULT_MODEL, "columns": columns.size, "kept": 0}
    try:
        denoiser = _denoiser()
        corrections = np.zeros((columns.size, seen.clock.n_slots), np.float32)
        shown = np.arange(columns.size) if options.cae == "always" else _worth_showing(seen, seen.scene, columns)
        corrections[shown] = denoiser.slot_corrections(seen.scene, columns[shown])
    except ReceiverError as error:
        return seen, frozenset(), {**report, "columns": 0, "message": str(error)}
    metrics = seen.metrics[columns] + channel.metrics_of(corrections, seen.model.memory)
    metrics = _words_weighed(seen, seen.scene, columns, metrics)
    posteriors = _detect(metrics, seen.clock)
    before, after = (p.log_prob.sum(axis=(0, 2)) for p in (of_columns(seen.posteriors, columns), posteriors))
    better = np.flatnonzero(after > before)
    kept = columns[better]
    # The network is told where headers are; whether they show there, the light alone must say.
    corrected = replace(of_columns(posteriors, better), header_llr=seen.posteriors.header_llr[:, kept])
    of_all = seen.metrics.copy()
    of_all[kept] = metrics[better]
    report.update(model=denoiser.name, kept=kept.size)
    seen = replace(seen, metrics=of_all, posteriors=_replaced(seen.posteriors, kept, corrected))
    return seen, frozenset(kept.tolist()), report


def _worth_showing(seen: Reception, scene: denoise.Scene, columns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Places in `columns` of those that the network is shown: the surest, and no more than its time allows."""
    _, n_strips, _ = scene.samples.light.shape
    most = max(_MOST_SHOWN // (n_strips * seen.clock.n_slots), 1)
    return np.sort(np.argsort(-_best_packet(seen)[columns], kind="stable")[:most])


def _words_weighed(
    seen: Reception, scene: denoise.Scene, columns: NDArray[np.int64], metrics: FloatArray
) -> FloatArray:
    """Metrics of some columns with the likeliest words of every symbol in doubt weighed as a whole."""
    now = seen.clock
    bursts = _by_burst(metrics, now)
    candidates = detect.plausible_weights(bursts, HOPELESS_WEIGHT)
    posteriors, doubtful = detect.detect_with_words(bursts, candidates, _DOUBTFUL_WORD, _WORDS)
    asked = doubtful.log_prob[:, 0] > _HOPELESS_WORD
    places, words, log_prob = doubtful.places[asked], doubtful.words[asked], doubtful.log_prob[asked]
    model = channel.LightModel(
        scene.floor, scene.sigma, scene.shot, scene.spread, _taps(now, scene.samples.samples_per_slot)
    )
    samples = replace(scene.samples, light=scene.samples.light[columns], valid=scene.samples.valid[columns])
    lit = channel.lit_on_grid(_replaced(seen.posteriors, columns, posteriors), now)
    likely = log_prob > log_prob[:, :1] - _WORD_MARGIN
    corrections = channel.word_corrections(samples, now, model, lit, columns, places, words, likely)
    return metrics + channel.metrics_of(corrections, seen.model.memory)


def without_row_light(lock: Lock, seen: Reception, columns: NDArray[np.int64]) -> Reception:
    """Some columns looked at again once the light that a sensor row shows everywhere is taken off."""
    samples, model = _view(lock, seen, np.arange(seen.snr.shape[0]), denoise.SAMPLES_PER_SLOT)
    scene = denoise.without_row_light(_scene_of(seen, samples, model))
    asked = replace(samples, light=scene.samples.light[columns], valid=samples.valid[columns])
    likelihoods = channel.slot_likelihoods(asked, seen.clock, model, scene.lit, columns)
    metrics, snr = seen.metrics.copy(), seen.snr.copy()
    metrics[columns], snr[columns] = likelihoods.metrics, likelihoods.snr
    lost = np.flatnonzero(seen.posteriors.log_prob[:, columns].mean(axis=(0, 2)) < _LOST)
    if lost.size:
        there = columns[lost]
        light = replace(asked, light=asked.light[lost], valid=asked.valid[lost])
        fresh = _from_nothing(seen.clock, light, model, scene.lit, there)
        better = _evidence(fresh.metrics, seen.clock) > _evidence(metrics[there], seen.clock)
        metrics[there[better]], snr[there[better]] = fresh.metrics[better], fresh.snr[better]
    posteriors = _replaced(seen.posteriors, columns, _detect(metrics[columns], seen.clock))
    cleaned = replace(seen, metrics=metrics, snr=snr, posteriors=posteriors)
    return replace(cleaned, scene=_scene_of(cleaned, scene.samples, model))


def _from_nothing(
    now: Clock, samples: SlotSamples, model: channel.LightModel, lit: Float32Array, columns: NDArray[np.int64]
) -> channel.SlotLikelihoods:
    """The light model of some columns once more, without what was believed of them: it may have explained itself."""
    lit = lit.copy()
    lit[columns] = 0.5
    for _ in range(_FRESH_ROUNDS):
        quick = channel.slot_likelihoods(samples, now, model, lit, columns, thorough=False)
        lit[columns] = channel.lit_on_grid(_detect(quick.metrics, now), now)
    return channel.slot_likelihoods(samples, now, model, lit, columns)


def _evidence(metrics: FloatArray, now: Clock) -> FloatArray:
    """(C,) log evidence of columns, over all weights."""
    bursts = _by_burst(metrics, now)
    candidates = detect.plausible_weights(bursts, HOPELESS_WEIGHT)
    return np.asarray(np.logaddexp.reduce(detect.weight_evidence(bursts, candidates), axis=1))


def packet_evidence(seen: Reception) -> float:
    """Log-likelihood ratio of all columns' slots being packets, on the clock they were received with, over any slots.

    Copies that differ and words that are not in the codebook speak against it, headers or not.
    """
    # The light model is surer than it should be: a column that fits poorly, or is dark, says nothing.
    return float(np.logaddexp(_packets_over_any(seen, np.arange(seen.snr.shape[0])), 0.0).sum())


def _packets_over_any(seen: Reception, columns: NDArray[np.int64]) -> FloatArray:
    """Log-likelihood ratio of each column's slots being packets, over slots that are anything."""
    metrics = seen.metrics[columns]
    packets = _evidence(metrics, seen.clock) - np.log(len(WEIGHTS))
    return np.asarray(packets - detect.free_evidence(metrics, seen.posteriors.w[columns] / SLOTS_PER_SYMBOL))


def headerless(seen: Reception) -> NDArray[np.bool_]:
    """(C,) columns that show no packets: no header where it should be, and not so many words of the codebook.

    With few rows a slot or at the screen's edge light is not as the model has it, and headers are the first to tell.
    """
    out = assemble.without_header(seen.posteriors)
    if out.any():
        out[out] = _packets_over_any(seen, np.flatnonzero(out)) < _PACKETS_WITHOUT_HEADER
    return out


def doubtful_columns(seen: Reception) -> NDArray[np.int64]:
    """Columns that get a second opinion."""
    return np.flatnonzero(_doubtful(seen, _DOUBTFUL))


def support(seen: Reception) -> Float32Array:
    """(C, N) what the light says for every slot as decided, nats."""
    return detect.slot_support(seen.metrics, channel.lit_on_grid(seen.posteriors, seen.clock) > 0.5)


def _best_packet(seen: Reception) -> FloatArray:
    """(C,) mean log probability of the symbols of each column's surest packet that could be reported."""
    return np.asarray(np.where(_complete(seen), seen.posteriors.log_prob.mean(axis=2), -np.inf).max(axis=0))


def _complete(seen: Reception) -> NDArray[np.bool_]:
    """(B, C) packets that could be reported."""
    return assemble.complete(assemble.slots_seen(seen.samples, seen.clock))


def _confidence(seen: Reception) -> FloatArray:
    """(B, C) confidence of packets, the auto-encoder not yet asked."""
    by_burst = assemble.slot_support_by_burst(support(seen), seen.clock)
    n_columns, n_strips = seen.samples.light.shape[:2]
    return assemble.confidence(assemble.evidence(seen.posteriors, by_burst, np.zeros(n_columns, bool), n_strips))


@lru_cache(maxsize=1)
def _denoiser() -> denoise.Denoiser:
    return denoise.load_denoiser()


def _scene_of(seen: Reception, samples: SlotSamples, model: channel.LightModel) -> denoise.Scene:
    return denoise.Scene(
        samples=samples,
        clock=seen.clock,
        lit=channel.lit_on_grid(seen.posteriors, seen.clock),
        metrics=seen.metrics,
        w=seen.posteriors.w,
        floor=model.floor,
        sigma=model.sigma,
        shot=model.shot,
        spread=model.spread,
    )


def _in_bursts(lock: Lock, now: Clock, log_odds: Float32Array) -> Clock:
    if lock.burst is not None:
        return replace(now, burst=lock.burst)
    return sync.assign_bursts(now, log_odds, lock.screen.repeats)


def _with_bursts_of(lock: Lock, seen: Reception, log_odds: Float32Array) -> Reception:
    """Bursts told apart by log-odds that no copy has lent to another; symbols detected anew where that moves them."""
    now = _in_bursts(lock, seen.clock, log_odds)
    if np.array_equal(now.burst, seen.clock.burst):
        return seen
    return replace(seen, clock=now, posteriors=_detect(seen.metrics, now))


def _doubtful(seen: Reception, certain: float) -> NDArray[np.bool_]:
    """(C,) whether a packet that could be reported has less than the confidence `certain`."""
    doubtful = (_confidence(seen) < certain) & (seen.posteriors.log_prob.min(axis=2) < _BEYOND_DOUBT)
    return np.asarray((doubtful & _complete(seen)).any(axis=0))


def _detect(metrics: FloatArray, now: Clock) -> BurstPosteriors:
    bursts = _by_burst(metrics, now)
    return detect.detect(bursts, detect.plausible_weights(bursts, HOPELESS_WEIGHT))


def _by_burst(metrics: FloatArray, now: Clock) -> FloatArray:
    return channel.by_burst(metrics, now, memory=metrics.shape[1] - now.n_slots)


def _light_model(lock: Lock, samples: SlotSamples) -> channel.LightModel:
    now, profiles = lock.clock, lock.profiles
    rows = _rows_per_sample(now, samples.samples_per_slot)
    floor = channel.estimate_floor(samples, now)
    return channel.LightModel(
        floor=floor,
        sigma=channel.estimate_sigma(samples, floor, 0.5 * noise_of(profiles) / rows**0.5),
        shot=profiles.noise_slope / max(float(np.median(profiles.count)), 1.0) / rows,
        spread=channel.spread_matrix(samples.light.shape[1], lock.screen.light_spread),
        taps=_taps(now, samples.samples_per_slot),
    )


def _rows_per_sample(now: Clock, samples_per_slot: int) -> float:
    return max(now.rows_per_slot / samples_per_slot, 1.0)


def _taps(now: Clock, samples_per_slot: int) -> FloatArray:
    memory = channel.memory_for(now.exposure_slots)
    return channel.exposure_taps(now.exposure_slots, 1 / samples_per_slot, memory, samples_per_slot)
