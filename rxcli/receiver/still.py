"""From a locked clock to posteriors: light model and detection in turn. Part of the wiring."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import ReceiverError
from rxcli.options import ReceiverOptions
from rxcli.receiver import channel, sync
from rxcli.receiver.acquisition import Acquisition, noise_of
from rxcli.receiver.channel import denoise
from rxcli.receiver.decode import detect
from rxcli.receiver.light import Crosstalk, Exposure, NoiseModel
from rxcli.receiver.reception import (
    Reception,
    best_log_prob,
    complete_packets,
    dark_columns,
    has_doubtful_packet,
    packet_llr,
    word_log_prob,
)
from rxcli.receiver.settings import SETTINGS, STILL
from rxcli.types import BurstPosteriors, Clock, Float32Array, FloatArray, SlotSamples


def decode_photograph(acquisition: Acquisition, skip: frozenset[str], first: Reception) -> Reception:
    """Decode a photograph from its initial pass; what shows no packets there is not looked at further.

    Args:
        acquisition: the clock and the row profiles.
        skip: shortcuts in use, see `rxcli.options.SKIPS`.
        first: the initial pass.
    """
    if "no_packets" in skip and not _may_show_packets(first):
        return replace(first, skipped={"no_packets": first.snr.shape[0]})
    return decode(acquisition, skip, first)


def _may_show_packets(first: Reception) -> bool:
    """Whether an initial pass leaves hope of packets; one that is in no doubt is hope enough."""
    if (first.packet_confidence[complete_packets(first)] > STILL.doubtful).any():
        return True
    return packet_llr(first) + max(float(first.posteriors.header_llr.sum()), 0.0) > SETTINGS.min_packets_llr


def decode(acquisition: Acquisition, skip: frozenset[str], first: Reception | None = None) -> Reception:
    """An initial pass, and where that leaves doubt the others of `_PASSES`.

    Args:
        acquisition: the clock and the row profiles.
        skip: shortcuts in use, see `rxcli.options.SKIPS`.
        first: what the initial pass showed, where there was one.
    """
    reception = first or initial_pass(acquisition)
    asked = doubtful_columns(reception) if "certain_columns" in skip else np.arange(reception.snr.shape[0])
    lit = asked[~dark_columns(reception.snr)[asked]] if "dark_columns" in skip else asked
    skipped = {"certain_columns": reception.snr.shape[0] - asked.size, "dark_columns": asked.size - lit.size}
    for look, least in _PASSES:
        columns = np.intersect1d(lit, doubtful_columns(reception, least)) if "certain_columns" in skip else lit
        if columns.size:
            reception = look(acquisition, reception, columns)
    return replace(reception, skipped={name: count for name, count in skipped.items() if count})


def initial_pass(acquisition: Acquisition) -> Reception:
    """One pass over the strips pooled in pairs, from a first guess of the slots."""
    acquisition = acquisition.binned()
    clock = acquisition.clock
    # Demosaicing and denoising mix neighbouring rows: with few rows per slot this widens the effective exposure.
    exposure_slots = float(np.hypot(clock.exposure_slots, STILL.mixed_rows / clock.rows_per_slot))
    clock = replace(clock, exposure_slots=exposure_slots)
    samples = sync.sample_slots(acquisition.profiles, clock, STILL.coarse_samples)
    model = _light_model(acquisition, clock, samples)
    contrast = sync.contrast(samples.light, samples.valid, STILL.coarse_samples, model.noise.sigma)
    first = channel.initial_metrics(*contrast, model.exposure)
    clock = _in_bursts(acquisition, clock, first)
    lit = clock.on_grid(_first_decision(channel.by_burst(first, clock), model.exposure.isi_memory))
    columns = np.arange(samples.light.shape[0])
    likelihoods = channel.slot_likelihoods(samples, clock, model, lit, columns, thorough=False)
    clock = _in_bursts(acquisition, clock, likelihoods.metrics)
    clock = sync.corrected(clock, likelihoods.timing)
    posteriors = _detect(likelihoods.metrics, clock)
    return Reception(clock, samples, posteriors, likelihoods.snr, model, likelihoods.metrics)


def _first_decision(metrics: FloatArray, isi_memory: int) -> Float32Array:
    """(B, C, packet) slots of bursts by the first guess of the metrics; longer exposures need the trellis."""
    if isi_memory == 1:
        return detect.initial_slot_probability(metrics)
    return detect.detect(metrics, detect.plausible_weights(metrics, 0.0)).lit


def doubtful_columns(reception: Reception, beyond_repair: float = -np.inf) -> NDArray[np.int64]:
    """Columns that get a second opinion: in doubt, but not beyond repair."""
    return np.flatnonzero(has_doubtful_packet(reception, STILL.doubtful) & (best_log_prob(reception) > beyond_repair))


def _coarse(acquisition: Acquisition, reception: Reception, columns: NDArray[np.int64]) -> Reception:
    """All strips, the picture on all scales; the clock is corrected after it."""
    after, timing = _seen_again(acquisition, reception, columns, STILL.coarse_samples)
    return replace(after, clock=sync.corrected(after.clock, timing))


def _fine(acquisition: Acquisition, reception: Reception, columns: NDArray[np.int64]) -> Reception:
    """The same with more samples a slot."""
    return _seen_again(acquisition, reception, columns, STILL.fine_samples)[0]


def _seen_again(
    acquisition: Acquisition, reception: Reception, columns: NDArray[np.int64], samples_per_slot: int
) -> tuple[Reception, FloatArray]:
    """What is seen with some columns looked at again, and the (C, 2) timing of all, 0 for the others."""
    samples, model = _view(acquisition, reception, columns, samples_per_slot)
    lit = reception.clock.on_grid(reception.posteriors.lit)
    asked = samples_per_slot == STILL.coarse_samples
    likelihoods = channel.slot_likelihoods(samples, reception.clock, model, lit, columns, timing=asked)
    timing = np.zeros((lit.shape[0], 2))
    timing[columns] = likelihoods.timing
    return _with_metrics(reception, columns, likelihoods.metrics, likelihoods.snr), timing


def _with_metrics(
    reception: Reception, columns: NDArray[np.int64], metrics: FloatArray, snr: Float32Array | None = None
) -> Reception:
    """The same with other metrics of some columns, their words detected from these."""
    of_all, snr_of_all = reception.metrics.copy(), reception.snr.copy()
    of_all[columns] = metrics
    if snr is not None:
        snr_of_all[columns] = snr
    posteriors = reception.posteriors.with_columns(columns, _detect(metrics, reception.clock))
    return replace(reception, metrics=of_all, snr=snr_of_all, posteriors=posteriors)


def _view(
    acquisition: Acquisition, reception: Reception, columns: NDArray[np.int64], samples_per_slot: int
) -> tuple[SlotSamples, channel.ObservationModel]:
    """All strips of some columns, and the light model of the quick look fitted to them."""
    clock, quick = reception.clock, reception.samples
    samples = sync.sample_slots(acquisition.profiles, clock, samples_per_slot, columns)
    n_strips = samples.light.shape[1]
    # A sample of the quick look has so many times the pixels.
    larger = n_strips / quick.light.shape[1]
    larger *= _rows_per_sample(clock, quick.samples_per_slot) / _rows_per_sample(clock, samples_per_slot)
    model = replace(
        reception.model,
        noise=reception.model.noise.of_mean(1 / larger),
        crosstalk=Crosstalk.of(n_strips, acquisition.screen.light_spread),
        exposure=Exposure.of(clock.exposure_slots, samples_per_slot),
    )
    return samples, model


def apply_autoencoder(
    acquisition: Acquisition, reception: Reception, options: ReceiverOptions
) -> tuple[Reception, frozenset[int], dict[str, Any] | None]:
    """The last pass: doubtful columns once more, with the auto-encoder's corrections and words weighed.

    Returns:
        What was received then, the columns whose corrections were kept, what to report; None where nothing was done.
    """
    if options.cae == "never":
        return reception, frozenset(), None
    always = options.cae == "always"
    if always:
        columns = np.arange(reception.snr.shape[0])
        reception = _without_row_noise(acquisition, reception, columns)
    else:
        columns = doubtful_columns(reception, STILL.beyond_repair_log_prob)
    if columns.size == 0 or reception.cleaned is None:
        return reception, frozenset(), None
    shown = columns if always else _worth_showing(reception, columns)
    report: dict[str, Any] = {"model": denoise.DEFAULT_MODEL, "columns": columns.size, "kept": 0}
    try:
        denoiser = options.denoiser or _denoiser()
        after = _second_opinion(reception, columns, shown, denoiser)
    except ReceiverError as error:
        return reception, frozenset(), {**report, "columns": 0, "message": str(error)}
    kept = columns[(word_log_prob(after) > word_log_prob(reception))[columns]]
    report.update(model=denoiser.name, kept=kept.size)
    metrics = reception.metrics.copy()
    metrics[kept] = after.metrics[kept]
    posteriors = reception.posteriors.with_columns(kept, after.posteriors.of_columns(kept))
    return replace(reception, metrics=metrics, posteriors=posteriors), frozenset(kept.tolist()), report


def _second_opinion(
    reception: Reception, columns: NDArray[np.int64], shown: NDArray[np.int64], denoiser: denoise.Denoiser
) -> Reception:
    """Some columns with words weighed, and those `shown` to the auto-encoder with its corrections."""
    scene = reception.scene
    assert scene is not None
    corrections = np.zeros((reception.snr.shape[0], reception.clock.n_slots), np.float32)
    corrections[shown] = denoiser.slot_corrections(scene, shown)
    metrics = reception.metrics[columns] + channel.metrics_of(corrections[columns], reception.model.exposure.isi_memory)
    after = _with_metrics(reception, columns, _words_weighed(reception, scene, columns, metrics))
    # The network is told where headers are; whether they show there, the light alone must say.
    return replace(after, posteriors=replace(after.posteriors, header_llr=reception.posteriors.header_llr))


def _worth_showing(reception: Reception, columns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Those of `columns` that the network is shown: the surest, and no more than its time allows."""
    assert reception.cleaned is not None
    n_strips = reception.cleaned[0].light.shape[1]
    most = max(STILL.max_network_slots // (n_strips * reception.clock.n_slots), 1)
    return np.sort(columns[np.argsort(-best_log_prob(reception)[columns], kind="stable")[:most]])


def _words_weighed(
    reception: Reception, scene: denoise.DenoiserInput, columns: NDArray[np.int64], metrics: FloatArray
) -> FloatArray:
    """Metrics of some columns with the likeliest words of every symbol in doubt weighed as a whole."""
    clock = reception.clock
    bursts = channel.by_burst(metrics, clock)
    candidates = detect.plausible_weights(bursts, SETTINGS.weight_margin)
    posteriors, doubtful = detect.detect_with_candidates(
        bursts, candidates, STILL.doubtful_word_log_prob, STILL.n_candidate_words
    )
    samples = replace(scene.samples, light=scene.samples.light[columns], valid=scene.samples.valid[columns])
    lit = clock.on_grid(reception.posteriors.with_columns(columns, posteriors).lit)
    asked = doubtful.log_prob[:, 0] > STILL.hopeless_word_log_prob
    places, words = doubtful.places[asked], doubtful.words[asked]
    corrections = channel.word_corrections(samples, clock, scene.model, lit, columns, places, words)
    return metrics + channel.metrics_of(corrections, reception.model.exposure.isi_memory)


def _without_row_noise(acquisition: Acquisition, reception: Reception, columns: NDArray[np.int64]) -> Reception:
    """Some columns on the fine grid once the light that a sensor row shows everywhere is taken off."""
    samples, model = _view(acquisition, reception, np.arange(reception.snr.shape[0]), denoise.SAMPLES_PER_SLOT)
    scene = denoise.remove_row_noise(reception.scene_of(samples, model))
    asked = replace(scene.samples, light=scene.samples.light[columns], valid=scene.samples.valid[columns])
    likelihoods = channel.slot_likelihoods(asked, reception.clock, model, scene.lit, columns, timing=False)
    cleaned = replace(reception, cleaned=(scene.samples, model))
    return _with_metrics(cleaned, columns, likelihoods.metrics, likelihoods.snr)


#: Looks at columns in doubt, after the initial pass and before the auto-encoder. Each sees more of the light than the
#: one before and takes its place: kept only where words are likelier then, they lose 1 to 3 % of the packets. Columns
#: of a lower mean log probability, see `StillSettings`, are left.
_PASSES = (
    (_coarse, -np.inf),
    (_fine, -np.inf),
    (_fine, STILL.beyond_repair_log_prob),
    (_without_row_noise, STILL.beyond_repair_log_prob),
)


@lru_cache(maxsize=1)
def _denoiser() -> denoise.Denoiser:
    return denoise.load_denoiser()


def _in_bursts(acquisition: Acquisition, clock: Clock, metrics: FloatArray) -> Clock:
    """The clock with its copies in bursts as they were given, or as metrics (C, N + memory, patterns) tell them."""
    if acquisition.burst is not None:
        return replace(clock, burst=acquisition.burst)
    return sync.assign_bursts(clock, detect.slot_llr(metrics), acquisition.repeats)


def _detect(metrics: FloatArray, clock: Clock) -> BurstPosteriors:
    bursts = channel.by_burst(metrics, clock)
    return detect.detect(bursts, detect.plausible_weights(bursts, SETTINGS.weight_margin))


def _light_model(acquisition: Acquisition, clock: Clock, samples: SlotSamples) -> channel.ObservationModel:
    profiles = acquisition.profiles
    rows = _rows_per_sample(clock, samples.samples_per_slot)
    black_level = channel.estimate_black_level(samples, clock)
    sigma = channel.estimate_sigma(samples, black_level, 0.5 * noise_of(profiles) / rows**0.5)
    return channel.ObservationModel(
        black_level=black_level,
        noise=NoiseModel(sigma**2, profiles.noise_slope / max(float(np.median(profiles.count)), 1.0) / rows),
        crosstalk=Crosstalk.of(samples.light.shape[1], acquisition.screen.light_spread),
        exposure=Exposure.of(clock.exposure_slots, samples.samples_per_slot),
    )


def _rows_per_sample(clock: Clock, samples_per_slot: int) -> float:
    return max(clock.rows_per_slot / samples_per_slot, 1.0)
